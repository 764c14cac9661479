// Small plots as SVG, drawn from arrays: bars, stems, points, lines, a map of correlations. Colours are the page's own.

import { element } from "./dom.js";
import { compact } from "./format.js";

const W = 260;
const H = 128;
const LEFT = 30;
const BOTTOM = 18;
const TOP = 6;
const RIGHT = 6;

const svg = (name, attributes, ...children) => element(`svg:${name}`, attributes, ...children);
const two = (value) => (Math.abs(value) < 0.005 ? "0.00" : value.toFixed(2));
const round = (value) => Math.round(10 * value) / 10;

// A frame of axes: x(v) and y(v) give places, `node` is what to append to.
function frame([x0, x1], [y0, y1], label, { xs = [], ys = [] } = {}) {
  const x = (value) => round(LEFT + ((value - x0) / (x1 - x0 || 1)) * (W - LEFT - RIGHT));
  const y = (value) => round(H - BOTTOM - ((value - y0) / (y1 - y0 || 1)) * (H - BOTTOM - TOP));
  const node = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": label });
  for (const [value, text] of ys) {
    node.append(svg("line", { class: "grid", x1: LEFT, x2: W - RIGHT, y1: y(value), y2: y(value) }));
    node.append(svg("text", { x: LEFT - 4, y: y(value) + 3.5, "text-anchor": "end" }, text ?? compact(value, 3)));
  }
  for (const [value, text] of xs) node.append(svg("text", { x: x(value), y: H - 5, "text-anchor": "middle" }, text ?? compact(value, 3)));
  return { node, x, y };
}

const path = (points) => points.map(([x, y], k) => `${k ? "L" : "M"}${x} ${y}`).join("");

// Counts as shares by bin, beside the normal density.
export function distribution({ low, high, counts }, label) {
  const n = counts.reduce((sum, count) => sum + count, 0) || 1;
  const width = (high - low) / counts.length;
  const heights = counts.map((count) => count / n / width);
  const top = Math.max(0.45, 1.05 * Math.max(...heights));
  const { node, x, y } = frame([low, high], [0, top], label, { xs: [[-3, "−3σ"], [0, "0"], [3, "3σ"]], ys: [[0], [0.4]] });
  heights.forEach((height, k) => {
    if (height) node.append(svg("rect", { class: "bar", x: x(low + k * width) + 0.3, width: x(low + width) - x(low) - 0.6, y: y(height), height: y(0) - y(height) }));
  });
  const curve = Array.from({ length: 81 }, (_, k) => low + (k / 80) * (high - low)).map((v) => [x(v), y(Math.exp(-0.5 * v * v) / Math.sqrt(2 * Math.PI))]);
  node.append(svg("path", { class: "expected", d: path(curve) }));
  return node;
}

// Correlation at each lag, and the band in which those of a white series stay.
export function stems({ r, bound }, label, step) {
  const known = r.filter((value) => value !== null);
  const most = Math.max(0.3, ...known.map(Math.abs));
  const end = r.length;
  const { node, x, y } = frame([0, end], [-most, most], label, { xs: [[end / 2, `${compact((end / 2) * step, 2)} s`], [end, `${compact(end * step, 2)} s`]], ys: [[-most], [0], [most]].map(([v]) => [v, compact(v, 2)]) });
  node.lastChild.setAttribute("text-anchor", "end");
  if (bound !== null) node.append(svg("rect", { class: "bounds", x: x(0), width: x(end) - x(0), y: y(bound), height: y(-bound) - y(bound) }));
  r.forEach((value, k) => {
    if (value !== null) node.append(svg("line", { class: "stem", x1: x(k + 1), x2: x(k + 1), y1: y(0), y2: y(value) }));
  });
  return node;
}

// What was, over what a normal variable would have been.
export function quantiles(pairs, label) {
  const most = Math.max(3, ...pairs.flat().map((value) => Math.min(8, Math.abs(value))));
  const ends = [-most, most];
  const { node, x, y } = frame(ends, ends, label, { xs: [[-2, "−2σ"], [0, "0"], [2, "2σ"]], ys: [[-2], [0], [2]] });
  node.append(svg("line", { class: "expected", x1: x(-most), y1: y(-most), x2: x(most), y2: y(most) }));
  for (const [normal, own] of pairs) node.append(svg("circle", { class: "dot", r: 1.8, cx: x(normal), cy: y(Math.max(-most, Math.min(most, own))) }));
  return node;
}

// Counts that should be equal, and the band in which they would stay.
export function flat({ counts, low, high }, label) {
  const top = 1.1 * Math.max(high, ...counts, 1);
  const { node, x, y } = frame([0, counts.length], [0, top], label, { xs: [[0.5, "lowest"], [counts.length - 0.7, "highest"]], ys: [[0], [high]].map(([v]) => [v, compact(v, 2)]) });
  counts.forEach((count, k) => node.append(svg("rect", { class: "bar", x: x(k) + 1, width: x(1) - x(0) - 2, y: y(count), height: y(0) - y(count) })));
  node.append(svg("rect", { class: "bounds", x: x(0), width: x(counts.length) - x(0), y: y(high), height: y(Math.max(0, low)) - y(high) }));
  return node;
}

// Lines over time, on a logarithmic axis: [[values, class], …].
export function decades(t, lines, most, label, ends) {
  const log = (value) => Math.log10(Math.max(1, value));
  const top = log(most || Math.max(...lines.flatMap(([values]) => values)));
  const ticks = Array.from({ length: Math.floor(top) + 1 }, (_, k) => [k, k < 3 ? String(10 ** k) : `${10 ** (k - 3)}k`]);
  const { node, x, y } = frame([t[0], t.at(-1)], [0, top || 1], label, { xs: [[t[0], ends[0]], [t.at(-1), ends[1]]], ys: ticks });
  const texts = node.querySelectorAll('text[text-anchor="middle"]');
  texts[0]?.setAttribute("text-anchor", "start");
  texts[1]?.setAttribute("text-anchor", "end");
  for (const [values, kind] of lines) {
    const points = values.flatMap((value, k) => (value === null ? [] : [[x(t[k]), y(log(value))]]));
    node.append(svg("path", { class: kind, d: path(points) }));
  }
  return node;
}

// Correlations from -1 to 1, by name.
export function correlations(names, matrix, label) {
  const n = names.length;
  const side = Math.max(9, Math.min(44, 230 / n));
  const room = Math.min(90, 8 + 5.6 * Math.max(...names.map((name) => name.length)));
  const node = svg("svg", { viewBox: `0 0 ${round(room + n * side + 4)} ${round(n * side + room)}`, role: "img", "aria-label": label, class: "map" });
  matrix.forEach((row, i) => {
    if (side >= 9) node.append(svg("text", { x: room - 4, y: round((i + 0.5) * side + 3.5), "text-anchor": "end" }, names[i]));
    const at = `${round(room + (i + 0.5) * side + 3)} ${round(n * side + 5)}`;
    node.append(svg("text", { transform: `translate(${at}) rotate(-90)`, "text-anchor": "end" }, names[i]));
    row.forEach((value, j) => {
      const place = { x: round(room + j * side), y: round(i * side), width: side - 1, height: side - 1 };
      const cell = svg("rect", { ...place, class: value < 0 ? "against" : "with", "fill-opacity": value === null ? 0 : Math.abs(value) });
      cell.append(svg("title", {}, `${names[i]}, ${names[j]}: ${value === null ? "–" : two(value)}`));
      node.append(cell);
      if (side >= 26 && value !== null) node.append(svg("text", { x: round(place.x + side / 2), y: round(place.y + side / 2 + 3.5), "text-anchor": "middle", class: Math.abs(value) > 0.6 ? "over" : "" }, two(value)));
    });
  });
  return node;
}

// Shares from 0 to 1, a bar for each name.
export function shares(entries, label) {
  const table = element("table", { class: "shares", "aria-label": label });
  for (const [name, share] of entries)
    table.append(element("tr", {}, element("th", {}, name), element("td", {}, element("i", { style: `width:${round(100 * Math.min(1, share))}%` })), element("td", {}, `${compact(100 * share, 2)} %`)));
  return table;
}
