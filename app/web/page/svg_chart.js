// A chart as an SVG file of its own, from the points that it shows: title, axes, units, legend, in the light theme.

import { amount } from "./chart.js";
import { outsiders } from "./edges.js";
import { bracketed, clock, compact } from "./format.js";
import { stretches } from "./marks.js";

const [W, H] = [960, 330]; // px
const [LEFT, RIGHT, TOP, BOTTOM] = [64, 16, 50, 30];
const FONT = 'font-family="system-ui, -apple-system, \'Segoe UI\', Roboto, sans-serif"';
const NAMES = {
  estimate: "estimate", truth: "truth", previous: "run before", reading: "reading", "reading ring": "held out", refused: "refused",
  "refused ring": "screened", bound: "bounds", quiet: "of a reading", band: "± 2σ", bounds: "bounds", integrity: "one unseen fault",
};
const STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400]; // s

const escaped = (text) => text.replace(/[&<>"]/g, (sign) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[sign]);
const round = (value) => Math.round(10 * Math.min(1e5, Math.max(-1e5, value))) / 10;

// The colours of the light theme, whatever is shown: from the page's own style, where they stand once.
export function lightPalette() {
  for (const sheet of document.styleSheets)
    for (const rule of sheet.cssRules)
      if (rule.selectorText === ":root" && rule.style.getPropertyValue("--estimate"))
        return new Map([...rule.style].filter((name) => name.startsWith("--")).map((name) => [name, rule.style.getPropertyValue(name).trim()]));
  throw new Error("the page has no style");
}

export function lightColours() {
  const palette = lightPalette();
  return (name) => palette.get(`--${name}`);
}

// chart: of chart.js; lines: [title, smaller line]; episodes: shades. Resolves to the text of the file.
export function chartSvg(chart, [title, about], episodes, tone = lightColours()) {
  const { what, data, span, plot } = chart;
  const { min: low, max: high } = plot.scales.y;
  const x = (value) => LEFT + ((value - span[0]) / (span[1] - span[0] || 1)) * (W - LEFT - RIGHT);
  const y = (value) => TOP + ((high - value) / (high - low || 1)) * (H - TOP - BOTTOM);
  const marks = [];
  const legend = new Map();
  const add = (key, mark, sample) => {
    marks.push(mark);
    const name = what.names?.[key] ?? NAMES[key] ?? key;
    if (mark && name && !legend.has(name)) legend.set(name, sample);
  };
  const { found, strength } = stretches(episodes, span);
  for (const [from, to] of found) {
    const place = `x="${round(x(from))}" y="${TOP}" width="${Math.max(2, round(x(to) - x(from)))}"`;
    marks.push(`<rect ${place} height="${H - TOP - BOTTOM}" fill="${tone("episode")}" opacity="${strength.toFixed(3)}"/>`);
    marks.push(`<rect ${place} height="3" fill="${tone("episode-strip")}"/>`);
  }
  const times = data[0];
  const finite = (value) => typeof value === "number";
  for (const { series: [over, under], tone: name } of what.bands ?? []) {
    const rows = times.flatMap((_, k) => (finite(data[over][k]) && finite(data[under][k]) ? [k] : []));
    const edge = (values, list) => list.map((k) => `${round(x(times[k]))} ${round(y(values[k]))}`).join("L");
    const path = rows.length ? `<path d="M${edge(data[over], rows)}L${edge(data[under], rows.toReversed())}Z" fill="${tone(name)}"/>` : "";
    add(name, path, (at) => `<rect x="${at}" y="-8" width="15" height="8" fill="${tone(name)}"/>`);
  }
  const curve = (xs, values, { tone: name, dash = [], width = 1.5, spanGaps, fill }) => {
    let path = "";
    let open = false;
    xs.forEach((time, k) => {
      if (finite(values[k])) path += `${open ? "L" : "M"}${round(x(time))} ${round(y(values[k]))}`;
      // What is undefined is a row of another table: the line goes on.
      open = finite(values[k]) || (open && (spanGaps || values[k] === undefined));
    });
    const stroke = `fill="none" stroke="${tone(name)}" stroke-width="${width}"${dash.length ? ` stroke-dasharray="${dash.join(" ")}"` : ""}`;
    const style = fill ? `fill="${tone(name)}" fill-opacity="${fill}"` : stroke;
    return [path && `<path d="${path}" ${style}/>`, (at) => `<path d="M${at} -4h15" ${style}/>`];
  };
  what.series.forEach((series, k) => {
    const values = data[k + 1] ?? [];
    if (series.mark === "line") add(series.tone, ...curve(times, values, series));
    if (series.mark !== "dots") return;
    const style = series.ring ? `fill="none" stroke="${tone(series.tone)}" stroke-width="1.5"` : `fill="${tone(series.tone)}"`;
    const radius = series.points.size / 2;
    const dots = times.flatMap((time, i) => (finite(values[i]) && time >= span[0] && time <= span[1] ? [`<circle cx="${round(x(time))}" cy="${round(y(values[i]))}" r="${radius}"/>`] : [])).join("");
    add(series.ring ? `${series.tone} ring` : series.tone, dots && `<g ${style}>${dots}</g>`, (at) => `<circle cx="${at + 9}" cy="-4" r="${radius}" ${style}/>`);
  });
  const image = what.image?.(chart);
  if (image) marks.push(`<image x="${round(x(image.from))}" y="${TOP}" width="${round(x(image.to) - x(image.from))}" height="${H - TOP - BOTTOM}" preserveAspectRatio="none" style="image-rendering:pixelated" href="${image.url}"/>`);
  for (const { x: time, value, tone: name, above, furthest } of outsiders(data, what.series, span, [low, high], x)) {
    const [at, tip, base] = [round(x(time)), above ? TOP + 1 : H - BOTTOM - 1, above ? TOP + 9 : H - BOTTOM - 9];
    marks.push(`<path d="M${at} ${tip}L${at - 4.5} ${base}h9Z" fill="${tone(name)}"/>`);
    const late = at > LEFT + 0.8 * (W - LEFT - RIGHT);
    if (furthest) marks.push(`<text x="${at + (late ? -8 : 8)}" y="${above ? TOP + 10 : H - BOTTOM - 2}" text-anchor="${late ? "end" : "start"}">${escaped(amount(what, value))}</text>`);
  }
  for (const extra of what.extras?.(chart) ?? []) add(extra.name ?? extra.tone, ...curve(extra.x, extra.values, extra));
  return [
    `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${W} ${H}" width="${W}" height="${H}" font-size="12" fill="${tone("faint")}" ${FONT}>`,
    `<title>${escaped(title)}</title><rect width="${W}" height="${H}" fill="${tone("panel")}"/>`,
    `<text x="${LEFT}" y="19" fill="${tone("ink")}" font-size="14" font-weight="650">${escaped(title)}</text><text x="${LEFT}" y="38">${escaped(about)}</text>`,
    ...valueAxis(what, plot, low, high, y, tone("grid")),
    ...timeTicks(...span).map((time) => `<path d="M${round(x(time))} ${TOP}v${H - TOP - BOTTOM}" stroke="${tone("grid")}"/><text x="${round(x(time))}" y="${H - 11}" text-anchor="middle">${clock(time, span[1] - span[0] < 8 ? 2 : 0)}</text>`),
    `<clipPath id="frame"><rect x="${LEFT}" y="${TOP}" width="${W - LEFT - RIGHT}" height="${H - TOP - BOTTOM}"/></clipPath>`,
    `<g clip-path="url(#frame)">`, ...marks.filter(Boolean), "</g>", legendText(legend), "</svg>",
  ].join("\n");
}

function valueAxis(what, plot, low, high, y, grid) {
  const values = what.axis ? what.axis.splits(plot, 1, low, high) : ticks(low, high, 6);
  const texts = what.axis ? what.axis.values(plot, values) : values.map((value) => compact(value, 6));
  return values.map((value, k) => `<path d="M${LEFT} ${round(y(value))}h${W - LEFT - RIGHT}" stroke="${grid}"/><text x="${LEFT - 6}" y="${round(y(value) + 4)}" text-anchor="end">${escaped(texts[k])}</text>`);
}

function legendText(legend) {
  let at = W - RIGHT;
  const parts = [...legend].toReversed().map(([name, sample]) => {
    at -= Math.round(6.6 * name.length) + 4;
    const text = `<text x="${at}" y="0">${escaped(name)}</text>`;
    at -= 20;
    const drawn = sample(at);
    at -= 10;
    return text + drawn;
  });
  return `<g transform="translate(0 19)">${parts.join("")}</g>`;
}

// About so many round numbers in a span.
export function ticks(low, high, about) {
  const rough = (high - low) / about;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((size) => size >= rough) ?? 10 * power;
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(Number((k * step).toPrecision(12)));
  return found;
}

function timeTicks(low, high) {
  const rough = (high - low) / 9;
  if (rough < STEPS[0]) return ticks(low, high, 9);
  const step = STEPS.find((size) => size >= rough) ?? 86400 * Math.ceil(rough / 86400);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high; k++) found.push(k * step);
  return found;
}

// The same as PNG, twice as fine.
export async function pngOf(svg) {
  const url = URL.createObjectURL(new Blob([svg], { type: "image/svg+xml" }));
  try {
    const image = new Image();
    image.src = url;
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [2 * image.naturalWidth, 2 * image.naturalHeight];
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    return await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
  } finally {
    URL.revokeObjectURL(url);
  }
}

// "magnet [°C]"
export const heading = (what) => `${what.title} ${bracketed(what.unit.replace(/^\[|\]$/g, ""))}`.trim();
