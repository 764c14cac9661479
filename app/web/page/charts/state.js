// Each state: estimate and band, truth, the sensors that measure it directly, and what other runs say.

import { band, dots, edge, line } from "../chart.js";
import { angular, marks } from "../drawing.js";
import { compact, decimals, fixed, spaced, withDeviation } from "../format.js";
import { Range, shownExtent, union, within } from "../ranges.js";
import { groupsOf } from "./group.js";

export const order = 2;

const MAX_CHARTS = 24;
const MAX_SENSORS = 8; // whose measurements are drawn over one state
const FEW_STATES = 6; // up to so many, those that nobody measures have more room
const LASTING = 5; // rejected measurements in a row, from which they are in view: an offset lasts, a spike does not
const UNBOUNDED = 100; // times the band, or the value itself, beyond which a protection level is shown as unbounded

const NOISE = /_(disturbance|error)$/;

const MEASURED = {
  reading: () => dots("reading", 4),
  held: () => dots("reading", 5, true),
  refused: () => dots("refused", 6),
  screened: () => dots("refused", 7, true),
};

export default function (charts) {
  // Those that nobody measures first; what only models noise with memory last.
  const rank = ({ name, rows }) => (rows.length ? 1 : NOISE.test(name) ? 2 : 0);
  const states = charts.model.states.toSorted((a, b) => rank(a) - rank(b));
  const grouped = new Set(groupsOf(states).flatMap(({ members }) => members.map((state) => state.name)));
  return states.slice(0, MAX_CHARTS).map((state) => ({ ...chartOf(charts, state), further: grouped.has(state.name) }));
}

function chartOf(charts, state) {
  const axisRange = new Range();
  const { live } = charts;
  const drawn = state.rows.slice(0, MAX_SENSORS);
  const measured = drawn.flatMap((row) => Object.keys(MEASURED).map((kind) => `${kind}:${row}`));
  // Of a twin that considers parameters: the part of the band that is noise. The file of a report has one shade.
  const inner = charts.model.columns?.includes(`noise_upper:${state.name}`) ? ["noise_upper", "noise_lower"] : [];
  const own = Object.fromEntries(["upper", "lower", ...inner, "truth", "mean"].map((kind) => [kind, `${kind}:${state.name}`]));
  const marked = (kinds) => Object.fromEntries(measured.filter((name) => kinds.includes(name.split(":")[0])).map((name) => [name, MEASURED[name.split(":")[0]]()]));
  const level = () => charts.integrity?.[state.name]?.bound;
  return {
    key: `state:${state.name}`,
    title: state.label,
    state: state.name,
    unit: state.unit,
    note: !state.rows.length ? "not measured" : state.rows.length > drawn.length ? `measurements of ${drawn.length} of ${state.rows.length} sensors` : null,
    help: "Estimate ± 2σ; in brackets the protection level: the largest error that one undetected fault can cause",
    weight: state.rows.length || NOISE.test(state.name) || charts.model.states.length > FEW_STATES ? 1 : 1.5,
    columns: [...Object.values(own), ...measured],
    // What matters most lies on top: the band over the measurements that are as expected.
    series: {
      ...marked(["reading", "held"]),
      upper: edge(),
      lower: edge(),
      ...Object.fromEntries(inner.map((name) => [name, edge()])),
      ...marked(["refused", "screened"]),
      truth: line("truth", { dash: [5, 3], spanGaps: true }),
      mean: line("estimate", { width: 1.75 }),
    },
    bands: [band("band", "upper", "lower"), ...(inner.length ? [band("band-noise", ...inner)] : [])],
    data: () => {
      const columns = Object.fromEntries([...Object.entries(own), ...measured.map((name) => [name, name])].map(([kind, name]) => [kind, live.column(name)]));
      return { x: live.x, ...(state.circular ? angular(columns, columns.mean) : columns) };
    },
    curves: () => [
      ...charts.layers.flatMap((layer) => layer.curves(state)),
      ...protection(live.x, live.column(own.mean), level()),
    ],
    paint: (plot) => marks(plot, charts, [state.name, ...state.rows]),
    range: (data, span) => {
      if (state.probability) return [-0.03, 1.03];
      const all = { lines: [data.truth, data.mean], bands: [[data.lower, data.upper]], dots: measured.map((name) => data[name]) };
      const place = within(data.x, span);
      const offset = drawn.map((row) => rejectedExtent(data[`refused:${row}`], data[`reading:${row}`], ...place));
      const shown = offset.reduce(union, shownExtent(all, ...place));
      return axisRange.fit(...charts.layers.reduce((range, layer) => layer.widened?.(range, state, span) ?? range, shown));
    },
    says: (value) => {
      const [upper, lower, truth, mean] = ["upper", "lower", "truth", "mean"].map(value);
      if (!Number.isFinite(mean) && upper > lower) return `withheld: ${charts.withheld?.[state.name] ?? `± ${compact((upper - lower) / 2, 2)}${spaced(state.unit)}`}`;
      const deviation = upper - mean;
      const bound = level();
      const known = !Number.isFinite(bound) ? "" : bound > UNBOUNDED * Math.max(deviation, Math.abs(mean)) ? "  (unbounded)" : `  (≤ ${compact(bound, 2)})`;
      const off = !Number.isFinite(truth) ? "" : `  truth ${deviation > 0 ? fixed(truth, decimals(deviation)) : compact(truth, 4)}`;
      if (state.probability) return `${fixed(mean, 3)}${off && `  truth ${fixed(truth, 0)}`}`;
      return withDeviation(mean, deviation, state.unit) + known + off;
    },
  };
}

// Lowest and highest of the measurements that were rejected in a row.
function rejectedExtent(rejected, used, from, to) {
  let [low, high] = [Infinity, -Infinity];
  let row = [];
  for (let k = from; k <= to; k++) {
    if (typeof rejected[k] === "number") row.push(rejected[k]);
    else if (typeof used[k] === "number") row = [];
    if (row.length === LASTING) [low, high] = [Math.min(low, ...row), Math.max(high, ...row)];
    else if (row.length > LASTING) [low, high] = [Math.min(low, row.at(-1)), Math.max(high, row.at(-1))];
  }
  return [low, high];
}

// The protection level to either side of the estimate.
function protection(x, mean, bound) {
  if (!Number.isFinite(bound)) return [];
  const values = (side) => mean.map((value) => (typeof value === "number" ? value + side * bound : value));
  return [-1, 1].map((side) => ({ over: true, legend: "protection level", tone: "integrity", dash: [2, 3], x, values: values(side) }));
}
