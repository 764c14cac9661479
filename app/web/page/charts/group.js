// Many states of one kind in one chart: a line each, the one furthest from the others drawn strong, with its band. Of a
// dozen and more a picture, time to the right and a row for each state; below it their spread and uncertainty.

import { band, edge, line } from "../chart.js";
import { area, clipped, marks } from "../drawing.js";
import { compact, decimals, fixed, spaced, words } from "../format.js";
import { bandExtent, extent, Range, shownExtent, union, within } from "../ranges.js";

export const order = 1;

const MIN_MEMBERS = 4;
const PICTURE_MEMBERS = 12; // from which on lines would hide each other
const MAX_BANDS = 120; // states of whose bands the page is told
const NUMBERED = /^(.*?)(?:_(\d+)|\[(\d+)\])$/;
const WARM = ["#0b1354", "#3b2e8c", "#7b2f8d", "#b73779", "#e8604c", "#f9a03f", "#fcf3a6"]; // as of pictures of fields
const RAMP = WARM.map((text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16)));

// Numbered states of one name and unit: [{name, unit, members: [state]}], by number.
export function groupsOf(states) {
  const kinds = new Map();
  for (const state of states) {
    const [, name, ...numbers] = state.name.match(NUMBERED) ?? [];
    if (!name || state.probability || state.circular) continue;
    const key = `${name}/${state.unit}`;
    if (!kinds.has(key)) kinds.set(key, { name, unit: state.unit, members: [] });
    kinds.get(key).members.push({ ...state, number: Number(numbers.find((digits) => digits !== undefined)) });
  }
  const groups = [...kinds.values()].filter(({ members }) => members.length >= MIN_MEMBERS);
  for (const { members } of groups) members.sort((a, b) => a.number - b.number);
  return groups;
}

export default (charts) =>
  groupsOf(charts.model.states).flatMap((group) => (group.members.length < PICTURE_MEMBERS ? [lines(charts, group)] : [picture(charts, group), spread(charts, group)]));

function common(charts, { name, unit, members }) {
  return {
    key: `group:${name}`,
    title: words(name),
    unit,
    columns: members.map((state) => `mean:${state.name}`),
    paint: (plot) => marks(plot, charts, members.flatMap((state) => [state.name, ...state.rows])),
  };
}

function lines(charts, group) {
  const range = new Range();
  const { members, unit } = group;
  const own = common(charts, group);
  const { strong } = charts;
  let furthest = null;
  return {
    ...own,
    note: `${members[0].number} to ${members.at(-1).number}; strong: furthest from the others`,
    names: { quiet: "each", estimate: "furthest from the others" },
    weight: 1.6,
    series: { ...Object.fromEntries(members.map((state) => [state.name, line("quiet", { width: 1 })])), furthest: line("estimate", { width: 2 }) },
    curves: () => (furthest === null ? [] : [{ legend: "± 2σ", tone: "band", fill: 1, ...area(strong.stream.x, ...strong.edges(furthest)) }]),
    data: () => {
      const columns = Object.fromEntries(members.map((state) => [state.name, charts.live.lineColumn(`mean:${state.name}`)]));
      const place = outlier(Object.values(columns).map((column) => column.findLast((value) => typeof value === "number") ?? NaN));
      furthest = members[place]?.name ?? null;
      strong.choose(own.key, furthest);
      return { x: charts.live.lineTimes, ...columns, furthest: columns[furthest] ?? [] };
    },
    range: (data, span) => {
      const shown = shownExtent({ lines: members.map((state) => data[state.name]) }, ...within(data.x, span));
      return range.fit(...(furthest === null ? shown : union(shown, bandExtent(...strong.edges(furthest).toReversed(), ...within(strong.stream.x, span)))));
    },
    says: (value) => {
      const known = members.map((state) => [value(state.name), state.number]).filter(([number]) => Number.isFinite(number)).sort(([a], [b]) => a - b);
      if (!known.length) return "";
      const [[low, lowest], [high, highest]] = [known[0], known.at(-1)];
      const figure = (number) => (high > low ? fixed(number, decimals(high - low)) : compact(number));
      return `lowest ${figure(low)} (${lowest}) · median ${figure(median(known.map(([number]) => number)))} · highest ${figure(high)}${spaced(unit)} (${highest})`;
    },
  };
}

const median = (sorted) => (sorted[(sorted.length - 1) >> 1] + sorted[sorted.length >> 1]) / 2;

// The place of the value furthest from the median of all; -1 where none is known.
function outlier(values) {
  const middle = median(values.filter(Number.isFinite).sort((a, b) => a - b));
  let [place, most] = [-1, -1];
  values.forEach((value, k) => {
    if (Math.abs(value - middle) > most) [place, most] = [k, Math.abs(value - middle)];
  });
  return place;
}

function picture(charts, group) {
  const { members, unit } = group;
  const own = common(charts, group);
  const range = new Range();
  const names = members.map((state) => state.name);
  const first = members[0].number;
  let [low, high] = [NaN, NaN];

  // A column of pixels for each of the screen, a row for each state.
  const paint = (plot, data) => {
    const { bbox } = plot;
    const [canvas, width, height] = [document.createElement("canvas"), Math.max(1, Math.round(bbox.width)), names.length];
    [canvas.width, canvas.height] = [width, height];
    const context = canvas.getContext("2d");
    const image = context.createImageData(width, height);
    const { min, max } = plot.scales.x;
    let k = 0;
    for (let column = 0; column < width; column++) {
      const time = min + ((column + 0.5) / width) * (max - min);
      while (k < data.x.length - 1 && data.x[k + 1] <= time) k++;
      if (!(data.x[0] <= time && time <= data.x.at(-1))) continue;
      names.forEach((name, row) => {
        const value = data[name][k];
        image.data.set([...(typeof value === "number" ? warm((value - low) / (high - low || 1)) : [128, 128, 128]), 255], 4 * ((height - 1 - row) * width + column));
      });
    }
    context.putImageData(image, 0, 0);
    const ctx = clipped(plot);
    ctx.imageSmoothingEnabled = false;
    ctx.drawImage(canvas, bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.restore();
  };
  const chart = {
    ...own,
    note: `rows ${first} to ${members.at(-1).number}, upwards`,
    weight: 2.4,
    series: Object.fromEntries(names.map((name) => [name, edge()])),
    data: () => ({ x: charts.live.lineTimes, ...Object.fromEntries(names.map((name) => [name, charts.live.lineColumn(`mean:${name}`)])) }),
    range: () => [first - 0.5, members.at(-1).number + 0.5],
    ramp: () => ({ colors: WARM, low, high }),
    paint: (plot) => {
      const data = chart.data();
      const [from, to] = within(data.x, charts.range);
      if (to > from) {
        [low, high] = range.fit(...extent(names.map((name) => data[name]), from, to));
        paint(plot, data);
      }
      own.paint(plot);
    },
    says: (value) => {
      const known = names.map(value).filter(Number.isFinite);
      return known.length ? `${compact(Math.min(...known), 3)} to ${compact(Math.max(...known), 3)}${spaced(unit)}` : "";
    },
  };
  return chart;
}

// Spread of the means, and the mean uncertainty of one.
function spread(charts, group) {
  const { name, members, unit } = group;
  const range = new Range();
  const own = common(charts, group);
  const uppers = members.length <= MAX_BANDS ? members.map((state) => `upper:${state.name}`) : [];
  return {
    ...own,
    key: `spread:${name}`,
    title: `${words(name)}, all`,
    columns: [...own.columns, ...uppers],
    note: `mean of ${members.length}; grey: lowest to highest${uppers.length ? "; blue: ± 2σ of one" : ""}`,
    names: { estimate: "mean of all", bounds: "lowest to highest", band: "± 2σ of one" },
    weight: 1,
    series: { highest: edge(), lowest: edge(), upper: edge(), lower: edge(), mean: line("estimate", { width: 1.75 }) },
    bands: [band("bounds", "highest", "lowest"), band("band", "upper", "lower")],
    data: () => ({ x: charts.live.lineTimes, ...overall(own.columns.map((column) => charts.live.lineColumn(column)), uppers.map((column) => charts.live.lineColumn(column))) }),
    range: ({ x, highest, lowest, upper, lower, mean }, span) =>
      range.fit(...shownExtent({ lines: [mean], bands: [[lowest, highest], [lower, upper]] }, ...within(x, span))),
    says: (value) => {
      if (!Number.isFinite(value("mean"))) return "";
      const one = uppers.length ? ` · ± ${compact((value("upper") - value("mean")) / 2, 2)} of one` : "";
      return `mean ${compact(value("mean"), 4)}${spaced(unit)} · ${compact(value("lowest"), 4)} to ${compact(value("highest"), 4)}${one}`;
    },
  };
}

// Row by row of all means: highest, lowest and mean; and twice the root mean square of σ to either side of the mean.
function overall(means, uppers) {
  const found = Object.fromEntries(["highest", "lowest", "upper", "lower", "mean"].map((name) => [name, new Array(means[0].length).fill(null)]));
  for (let row = 0; row < means[0].length; row++) {
    let [count, sum, low, high, squares, bands] = [0, 0, Infinity, -Infinity, 0, 0];
    means.forEach((values, k) => {
      const value = values[row];
      if (typeof value !== "number") return;
      [count, sum, low, high] = [count + 1, sum + value, Math.min(low, value), Math.max(high, value)];
      const over = uppers[k]?.[row];
      if (typeof over === "number") [squares, bands] = [squares + (over - value) ** 2, bands + 1];
    });
    if (!count) continue;
    const mean = sum / count;
    [found.highest[row], found.lowest[row], found.mean[row]] = [high, low, mean];
    if (bands) [found.upper[row], found.lower[row]] = [1, -1].map((side) => mean + side * Math.sqrt(squares / bands));
  }
  return found;
}

// A colour of the scale, from 0 to 1.
function warm(share) {
  const place = Math.min(0.9999, Math.max(0, share)) * (WARM.length - 1);
  const [a, b] = [RAMP[Math.floor(place)], RAMP[Math.floor(place) + 1]];
  return a.map((part, k) => Math.round(part + (place % 1) * (b[k] - part)));
}
