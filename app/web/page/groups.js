// Many states of one kind in one chart: a line each, the one that is furthest from the others drawn strong, with its band;
// of a dozen and more a picture, time to the right, one row a state, and beneath it how far they are apart and how sure.

import { band, clipped, edge, line } from "./chart.js";
import { bracketed, compact, spaced, words } from "./format.js";
import { marks } from "./marks.js";
import { Range, extent, shownExtent, within } from "./ranges.js";

const FEWEST = 4; // of one kind that are a group
const PICTURED = 12; // from which on lines would hide each other
const MOST_SURE = 120; // states of whose bands the page is told
const NUMBERED = /^(.*?)(?:_(\d+)|\[(\d+)\])$/;
const WARM = ["#0b1354", "#3b2e8c", "#7b2f8d", "#b73779", "#e8604c", "#f9a03f", "#fcf3a6"]; // as of pictures of fields

// States that are numbered, of one name and unit: [{name, unit, members: [state]}], by number.
export function groupsOf(states) {
  const kinds = new Map();
  for (const state of states) {
    const [, name, ...numbers] = state.name.match(NUMBERED) ?? [];
    if (!name || state.probability || state.circular) continue;
    const key = `${name}/${state.unit}`;
    if (!kinds.has(key)) kinds.set(key, { name, unit: state.unit, members: [] });
    kinds.get(key).members.push({ ...state, number: Number(numbers.find((digits) => digits !== undefined)) });
  }
  const groups = [...kinds.values()].filter(({ members }) => members.length >= FEWEST);
  for (const { members } of groups) members.sort((a, b) => a.number - b.number);
  return groups;
}

export const groupCharts = (charts, group) => (group.members.length < PICTURED ? [lines(charts, group)] : [picture(charts, group), spread(charts, group)]);

function common(charts, { name, unit, members }) {
  return {
    key: `group:${name}`,
    title: words(name),
    unit: bracketed(unit),
    columns: members.map((state) => `mean:${state.name}`),
    under: (plot) => marks(plot, charts.episodes, charts.view.at),
  };
}

function lines(charts, group) {
  const range = new Range();
  const { members, unit } = group;
  const names = members.map((state) => words(state.label));
  const own = common(charts, group);
  let furthest = -1;
  const strong = () => members[furthest]?.name;
  return {
    ...own,
    note: `${members[0].number} to ${members.at(-1).number}; strong: furthest from the others`,
    names: { quiet: "each", estimate: "furthest from the others" },
    weight: 1.6,
    series: [...members.map(() => line("quiet", { width: 1 })), line("estimate", { width: 2 })],
    under: (plot) => {
      own.under(plot);
      charts.strong.draw(plot, strong());
    },
    extras: () => charts.strong.curves(strong()),
    data: () => {
      const values = own.columns.map((name) => charts.live.column(name));
      furthest = outlier(values.map((column) => column.findLast((value) => typeof value === "number") ?? NaN));
      charts.strong.choose(own.key, strong());
      return [charts.live.x, ...values, furthest < 0 ? [] : values[furthest]];
    },
    range: (chart) => {
      const [x, ...values] = chart.data;
      const [low, high] = shownExtent({ lines: values }, ...within(x, charts.range));
      const [under, over] = charts.strong.extent(strong(), charts.range);
      return range.fit(Math.min(low, under), Math.max(high, over));
    },
    says: (value) => {
      const known = names.map((name, k) => [value(k + 1), name]).filter(([number]) => Number.isFinite(number)).sort(([a], [b]) => a - b);
      if (!known.length) return "";
      const [[low, lowest], [high, highest]] = [known[0], known.at(-1)];
      return `${lowest} ${compact(low, 4)} lowest · median ${compact(median(known.map(([number]) => number)), 4)} · ${highest} ${compact(high, 4)}${spaced(unit)} highest`;
    },
  };
}

const median = (sorted) => (sorted[(sorted.length - 1) >> 1] + sorted[sorted.length >> 1]) / 2;

// The place of the value that is furthest from the median of all; -1 where none is known.
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
  const first = members[0].number;
  let [low, high] = [NaN, NaN];
  const paint = (x, columns, height) => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [Math.max(1, x.length), height];
    const context = canvas.getContext("2d");
    const image = context.createImageData(canvas.width, canvas.height);
    columns.forEach((values, row) =>
      values.forEach((value, k) => {
        const at = 4 * ((height - 1 - row) * canvas.width + k);
        const [red, green, blue] = typeof value === "number" ? warm((value - low) / (high - low || 1)) : [128, 128, 128];
        image.data.set([red, green, blue, 255], at);
      }));
    context.putImageData(image, 0, 0);
    return canvas;
  };
  return {
    ...own,
    note: `rows: ${first} to ${members.at(-1).number}, the first below`,
    weight: 2.4,
    series: members.map(() => edge()),
    data: () => [charts.live.x, ...own.columns.map((name) => charts.live.column(name))],
    range: () => [first - 0.5, members.at(-1).number + 0.5],
    // Over the grid: the columns stand where their times are.
    between: (plot, series) => {
      if (series !== 1) return;
      const [x, ...columns] = plot.data;
      const [from, to] = within(x, charts.range);
      if (!(to > from)) return;
      [low, high] = range.fit(...extent(columns, from, to));
      const canvas = paint(x, columns, members.length);
      const { bbox } = plot;
      const ctx = clipped(plot);
      ctx.imageSmoothingEnabled = false;
      for (let k = from; k <= to; k++) {
        const left = plot.valToPos(x[k], "x", true);
        const right = k < x.length - 1 ? plot.valToPos(x[k + 1], "x", true) : left + 2;
        ctx.drawImage(canvas, k, 0, 1, members.length, left, bbox.top, Math.ceil(right - left) + 0.5, bbox.height);
      }
      ctx.restore();
      marks(plot, charts.episodes, charts.view.at);
    },
    image: () => {
      const [x, ...columns] = [charts.live.x, ...own.columns.map((name) => charts.live.column(name))];
      return { url: paint(x, columns, members.length).toDataURL(), from: x[0], to: x.at(-1) };
    },
    says: (value) => {
      const known = members.map((state, k) => value(k + 1)).filter(Number.isFinite);
      return known.length ? `${compact(Math.min(...known), 3)} to ${compact(Math.max(...known), 3)}${spaced(unit)}; dark ${compact(low, 2)}, light ${compact(high, 2)}` : "";
    },
  };
}

// How far they are apart, and how sure the estimate is of one of them.
function spread(charts, group) {
  const { name, members, unit } = group;
  const range = new Range();
  const own = common(charts, group);
  const uppers = members.length <= MOST_SURE ? members.map((state) => `upper:${state.name}`) : [];
  return {
    ...own,
    key: `spread:${name}`,
    title: `${words(name)}, all`,
    columns: [...own.columns, ...uppers],
    note: `mean of ${members.length}; grey: lowest to highest${uppers.length ? "; blue: ± 2σ of one" : ""}`,
    names: { estimate: "mean of all", bounds: "lowest to highest", band: "± 2σ of one" },
    weight: 1,
    series: [edge(), edge(), edge(), edge(), line("estimate", { width: 1.75 })],
    bands: [band("bounds", [1, 2]), band("band", [3, 4])],
    data: () => [charts.live.x, ...overall(own.columns.map((name) => charts.live.column(name)), uppers.map((name) => charts.live.column(name)))],
    range: (chart) => {
      const [x, highest, lowest, upper, lower, mean] = chart.data;
      return range.fit(...shownExtent({ lines: [mean], bands: [[lowest, highest], [lower, upper]] }, ...within(x, charts.range)));
    },
    says: (value) => (Number.isFinite(value(5)) ? `mean ${compact(value(5), 4)}${spaced(unit)} · ${compact(value(2), 4)} to ${compact(value(1), 4)}${uppers.length ? ` · ± ${compact((value(3) - value(5)) / 2, 2)} of one` : ""}` : ""),
  };
}

// Row by row of all means: highest, lowest; their mean and twice the root mean square of σ to either side of it; the mean.
export function overall(means, uppers) {
  const none = () => new Array(means[0].length).fill(null);
  const [highest, lowest, upper, lower, middle] = [none(), none(), none(), none(), none()];
  for (let row = 0; row < means[0].length; row++) {
    let [count, sum, low, high, squares, sure] = [0, 0, Infinity, -Infinity, 0, 0];
    means.forEach((values, k) => {
      const value = values[row];
      if (typeof value !== "number") return;
      [count, sum, low, high] = [count + 1, sum + value, Math.min(low, value), Math.max(high, value)];
      const over = uppers[k]?.[row];
      if (typeof over === "number") [squares, sure] = [squares + (over - value) ** 2, sure + 1];
    });
    if (!count) continue;
    [highest[row], lowest[row], middle[row]] = [high, low, sum / count];
    if (sure) [upper[row], lower[row]] = [1, -1].map((side) => middle[row] + side * Math.sqrt(squares / sure));
  }
  return [highest, lowest, upper, lower, middle];
}

// A colour of the scale, from 0 to 1.
function warm(share) {
  const place = Math.min(0.9999, Math.max(0, share)) * (WARM.length - 1);
  const [a, b] = [RAMP[Math.floor(place)], RAMP[Math.floor(place) + 1]];
  return a.map((part, k) => Math.round(part + (place % 1) * (b[k] - part)));
}

const RAMP = WARM.map((text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16)));
