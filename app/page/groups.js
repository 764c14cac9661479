// Many states of one kind in one chart: a line each, the one that is furthest from the others drawn strong; of a dozen
// and more a picture, time to the right, one row a state.

import { edge, line } from "./chart.js";
import { bracketed, compact, spaced, words } from "./format.js";
import { marks } from "./marks.js";
import { Range, extent, within } from "./ranges.js";

const FEWEST = 4; // of one kind that are a group
const PICTURED = 12; // from which on lines would hide each other
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

export const groupChart = (charts, group) => (group.members.length < PICTURED ? lines(charts, group) : picture(charts, group));

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
  return {
    ...own,
    note: `${members[0].number} to ${members.at(-1).number}; drawn strong: the one furthest from the others`,
    names: { quiet: "each", estimate: "furthest from the others" },
    weight: 1.6,
    series: [...members.map(() => line("quiet", { width: 1 })), line("estimate", { width: 2 })],
    data: () => {
      const values = own.columns.map((name) => charts.live.column(name));
      furthest = outlier(values.map((column) => column.findLast((value) => typeof value === "number") ?? NaN));
      return [charts.live.x, ...values, furthest < 0 ? [] : values[furthest]];
    },
    range: (chart) => range.fit(...extent(chart.data.slice(1), ...within(chart.data[0], charts.range))),
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
      const { ctx, bbox } = plot;
      ctx.save();
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
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

// A colour of the scale, from 0 to 1.
function warm(share) {
  const place = Math.min(0.9999, Math.max(0, share)) * (WARM.length - 1);
  const [a, b] = [RAMP[Math.floor(place)], RAMP[Math.floor(place) + 1]];
  return a.map((part, k) => Math.round(part + (place % 1) * (b[k] - part)));
}

const RAMP = WARM.map((text) => [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16)));
