// The stack of charts: one time axis, one cursor. States that nobody measures first, then the others, NIS, innovations.

import { betweenCurves, drawBetween } from "./between.js";
import { Chart, apart, band, clipped, colour, dots, edge, line } from "./chart.js";
import { $, setText } from "./dom.js";
import { bracketed, clock, compact, decimals, fixed, spaced, withDeviation, words } from "./format.js";
import { groupCharts, groupsOf } from "./groups.js";
import { Lane } from "./lane.js";
import { Layout } from "./layout.js";
import { marks } from "./marks.js";
import { Pins } from "./pins.js";
import { Smoothed } from "./smoothed.js";
import { Strong } from "./strong.js";
import { TimeAxis } from "./time_axis.js";
import { Range, extent, shownExtent, within } from "./ranges.js";

const MOST = 24; // charts of states or rows
const FEW = 6; // states of which those that nobody measures have more room; rows that are charted at first
const DENSITY = 1.6; // px to a group of rows

// The columns of a state's chart from the live lane, in the order of its series.
const OF_STATE = ["upper", "lower", "truth", "mean"];
const STILL = 500; // ms without a frame
const BEFORE = 3; // which of them is that of the revision before
const UNBOUNDED = 100; // times the band, or the value itself, from which on a bound says that nothing bounds it
const MOST_GROWTH = 4; // halvings of the window while there is less than that to show
const NIS_TICKS = [1, 0.1, 10, 0.01, 100, 1000, 0.3, 3, 0.03, 30, 300]; // those that matter most first
const OF_ROW = ["reading", "held", "refused", "screened"];

export class Charts {
  constructor(node, model, link, view) {
    Object.assign(this, { node, model, link, view });
    this.live = new Lane();
    this.previous = new Lane();
    this.overview = new Lane(); // the bar of time's, which is always there
    this.episodes = [];
    this.shown = true;
    this.range = [0, model.window];
    const order = (this.states = [...model.states].sort((a, b) => (a.rows.length > 0) - (b.rows.length > 0)).slice(0, MOST));
    const actions = {
      select: (since, until) => view.show(since, until),
      home: () => view.follow(view.configured),
      wheel: (event, plot) => this.wheel(event, plot),
      save: (chart, button) => this.saving.chart(chart, button),
    };
    this.strong = new Strong(this, link);
    const groups = groupsOf(model.states);
    const grouped = new Set(groups.flatMap(({ members }) => members.map((state) => state.name)));
    this.groups = groups.flatMap((group) => groupCharts(this, group));
    this.parts = [
      ...this.groups,
      ...order.map((state) => ({ ...stateChart(this, state), further: grouped.has(state.name) })),
      nisChart(this),
      ...model.rows.slice(0, MOST).map((row, k) => innovationChart(this, row, model.rows.length > FEW && k >= FEW)),
    ];
    this.charts = this.parts.map((part) => new Chart(part, actions));
    node.replaceChildren(...this.charts.map((chart) => chart.node));
    for (const chart of this.charts) {
      chart.span = this.range;
      chart.begin();
    }
    this.axis = new TimeAxis($("axis"));
    this.pins = new Pins(this, model, link, actions);
    this.smoothed = new Smoothed(this, link);
    $("layout").after(this.smoothed.button);
    this.layout = new Layout(this.charts, node, $("layout"), model.twin, () => this.ask());
    view.addEventListener("change", () => this.ask());
    link.addEventListener("frames", () => this.draw());
    link.addEventListener("episodes", (event) => {
      this.episodes = event.detail;
      if (performance.now() - this.drawnAt > STILL) this.draw(); // of a twin that has ended, no frame would bring them
    });
    link.addEventListener("status", (event) => this.told(event.detail));
    this.width = new ResizeObserver(() => this.ask());
    this.width.observe(node);
    this.ask();
  }

  // What the charts that are chosen draw.
  get columns() {
    const shown = new Set(this.layout.shown().map(([key]) => key));
    const states = this.states.filter((state) => shown.has(`state:${state.name}`));
    const rows = this.model.rows.slice(0, MOST).filter((row) => shown.has(`innovation:${row.name}`));
    const groups = this.groups.filter((group) => shown.has(group.key)).flatMap((group) => group.columns);
    return [
      ...new Set([...groups, ...states.flatMap((state) => OF_STATE.map((kind) => `${kind}:${state.name}`))]),
      ...new Set(states.flatMap((state) => state.rows.flatMap((row) => OF_ROW.map((kind) => `${kind}:${row}`)))),
      ...rows.flatMap((row) => ["innovation", "innovation_upper", "innovation_lower"].map((kind) => `${kind}:${row.name}`)),
      "nis", "nis_mean", "nis_low", "nis_high",
    ];
  }

  // Hidden behind another tab they ask for nothing.
  visible(shown) {
    if (shown === this.shown) return;
    this.shown = shown;
    this.asked = null;
    this.ask();
  }

  // Ask for what the view shows, in as many points as there are pixels for.
  ask() {
    if (!this.layout) return; // not yet
    if (!this.shown) return this.rest();
    const points = Math.max(50, Math.min(2000, Math.round((this.node.clientWidth - 60) / DENSITY)));
    const place = { ...this.view.wanted(), points };
    const { columns } = this;
    const wanted = JSON.stringify([place, columns]);
    // Of the same stretch another moment may be looked at.
    if (wanted === this.asked) return this.view.following ? undefined : this.draw();
    this.asked = wanted;
    this.link.look("charts", { ...place, columns }, (...frame) => this.live.take(...frame));
    const before = this.states.map((state) => `mean:${state.name}`);
    this.link.look("previous", { ...place, run: "previous", columns: before }, (...frame) => this.previous.take(...frame));
    this.pins.ask(place);
    this.smoothed.ask(place);
    this.strong.ask(place);
    if (!this.view.following) this.draw(); // what is there already, until the points for it come
  }

  rest() {
    if (this.asked !== "nothing") {
      this.asked = "nothing";
      this.link.look("charts", null);
      this.link.look("previous", null);
      this.pins.ask(null);
      this.smoothed.ask(null);
      this.strong.ask(null);
    }
    this.draw();
  }

  // Of charts without a row it is said why there is none.
  told(status) {
    setText($("no-rows"), status.t === null ? status.cause || "waiting for the first reading" : "");
    if (status.integrity) this.integrity = status.integrity;
  }

  draw() {
    const { x } = this.shown ? this.live : this.overview;
    if (!this.view.following) this.range = [this.view.since, this.view.until];
    else if (x.length) this.range = followed(x[0], x.at(-1), this.view.span);
    if (!this.shown || !x.length) return;
    for (const chart of this.charts) if (!chart.node.hidden) chart.show(chart.what.data(), this.range, this.view.at);
    this.pins.show(this.range);
    this.axis.show(this.range);
    this.drawnAt = performance.now();
    window.nisus.drawn = (window.nisus.drawn ?? 0) + 1;
    window.nisus.revision = this.live.revision;
    this.node.dataset.revision = this.live.revision;
    this.dispatch?.();
  }

  wheel(event, plot) {
    if (!event.ctrlKey && !event.shiftKey && !event.metaKey) return; // the wheel alone scrolls the stack
    event.preventDefault();
    const at = plot.posToVal(event.offsetX, "x");
    if (event.shiftKey) this.view.pan(((event.deltaY || event.deltaX) / 600) * (this.range[1] - this.range[0]), this.range);
    else this.view.zoom(event.deltaY > 0 ? 1.25 : 0.8, at, this.range);
  }

  // The place of the cursor in seconds, or null.
  get cursor() {
    const { plot } = this.charts[0];
    return plot.cursor.left >= 0 ? plot.posToVal(plot.cursor.left, "x") : null;
  }

  get newest() {
    return (this.shown ? this.live : this.overview).x.at(-1) ?? Infinity;
  }

  end() {
    this.width.disconnect();
    this.smoothed.button.remove();
    this.charts.forEach((chart) => chart.end());
  }
}

// What is followed: the last seconds; while there are fewer, a part of the window that they fill from the left.
function followed(start, end, span) {
  if (span === null) return [start, Math.max(end, start + 1)];
  if (end - start >= span) return [end - span, end + 0.004 * span];
  let length = span;
  for (let k = 0; k < MOST_GROWTH && end - start < length / 2; k++) length /= 2;
  return [start, start + length];
}

function stateChart(charts, state) {
  const range = new Range();
  const { live, previous } = charts;
  const rows = state.rows.flatMap((row) => OF_ROW.map((kind) => `${kind}:${row}`));
  const own = OF_STATE.map((kind) => `${kind}:${state.name}`);
  const readings = state.circular ? [] : rows.filter((name) => name.startsWith("reading:"));
  const marksOf = { reading: () => dots("reading", 4), held: () => dots("reading", 5, true), refused: () => dots("refused", 6), screened: () => dots("refused", 7, true) };
  return {
    key: `state:${state.name}`,
    title: state.label,
    unit: bracketed(state.unit),
    note: state.rows.length ? null : "not measured",
    weight: state.rows.length || charts.model.states.length > FEW ? 1 : 1.5,
    // upper, lower, previous mean, readings …, truth, mean: what matters most lies on top
    series: [
      edge(), edge(), line("previous", { width: 1 }), ...rows.map((name) => marksOf[name.split(":")[0]]()),
      line("truth", { width: 1.5, dash: [5, 3], spanGaps: true }), line("estimate", { width: 1.75 }),
    ],
    bands: [band("band", [1, 2])],
    under: (plot) => marks(plot, charts.episodes, charts.view.at),
    between: (plot, series) => series === BEFORE && (drawBetween(plot, live, readings), charts.smoothed.draw(plot, state), charts.pins.draw(plot, state)), // over the band, beneath the estimate
    over: (plot) => integrityLines(plot, charts, state),
    extras: (chart) => [...betweenCurves(live, readings), ...integrityCurves(chart, charts, state), ...charts.smoothed.curves(state), ...charts.pins.curves("lane", state)],
    data: () => {
      let [upper, lower, truth, mean] = own.map((name) => live.column(name));
      let dotted = rows.map((name) => live.column(name));
      let before = previous.column(`mean:${state.name}`);
      if (state.circular) {
        [upper, lower] = [upper, lower].map((side) => side.map((value, k) => (value === null ? null : turned(mean[k]) + value - mean[k])));
        [truth, mean, before] = [truth, mean, before].map(unbroken);
        dotted = dotted.map((values) => values.map(turned));
      }
      return joined([live.x, upper, lower, ...dotted, truth, mean], [previous.x, before], 3);
    },
    range: (chart) => {
      if (state.probability) return [-0.03, 1.03];
      const [x, upper, lower, , ...others] = chart.data; // what was before does not rule the axis
      const drawn = { lines: others.slice(rows.length), bands: [[lower, upper]], dots: others.slice(0, rows.length) };
      return range.fit(...charts.pins.widened(...shownExtent(drawn, ...within(x, charts.range)), state.name));
    },
    help: "± 2σ of what is modelled; unseen: how far off it may be by one fault that no alarm would tell",
    says: (value) => {
      const [upper, truth, mean] = [value(1), value(4 + rows.length), value(5 + rows.length)];
      const bound = charts.integrity?.[state.name]?.bound;
      const deviation = upper - mean;
      const unseen = Number.isFinite(bound) ? `  (${bound > UNBOUNDED * Math.max(deviation, Math.abs(mean)) ? "no bound" : `${compact(bound, 2)} unseen`})` : "";
      const off = !Number.isFinite(truth) ? "" : `  truth ${deviation > 0 ? fixed(truth, decimals(deviation)) : compact(truth, 4)}`;
      if (state.probability) return `${fixed(mean, 3)}${off && `  truth ${fixed(truth, 0)}`}`;
      return withDeviation(mean, deviation, state.unit) + unseen + off;
    },
  };
}

// Drawn by its logarithm: from a stuck sensor's 0.02 to an outlier's 200 everything can be read.
function nisChart(charts) {
  const { live } = charts;
  const names = ["nis_high", "nis_low", "nis", "nis_mean"];
  const log = (value) => (typeof value === "number" ? Math.log10(Math.max(value, 1e-9)) : value);
  return {
    key: "nis",
    title: "NIS",
    unit: "",
    note: `mean of the last readings, in its 95 % bounds${charts.model.commissioned ? " as commissioned" : ""}`,
    names: { estimate: "mean", bound: "" },
    weight: 1,
    series: [line("bound", { width: 1 }), line("bound", { width: 1 }), dots("quiet", 2.5), line("estimate", { width: 1.75 })],
    bands: [band("bounds", [1, 2])],
    axis: {
      // One first, then as many of the others as have room.
      splits: (self, axis, low, high) => apart(NIS_TICKS.map(Math.log10).filter((v) => low <= v && v <= high), self, "y"),
      values: (self, splits) => splits.map((v) => compact(10 ** v, 1)),
    },
    under: (plot) => marks(plot, charts.episodes, charts.view.at),
    data: () => {
      const [low] = nisRange(charts);
      // Readings that fit are of no interest.
      const large = (value) => (typeof value !== "number" || log(value) < low ? null : log(value));
      return [live.x, ...names.map((name) => live.column(name).map(name === "nis" ? large : log))];
    },
    range: () => nisRange(charts),
    amount: (value) => compact(10 ** value, 2),
    says: (value) => `${compact(10 ** value(4), 3)}  bounds ${compact(10 ** value(2), 3)} – ${compact(10 ** value(1), 3)}`,
  };
}

// Decades about the bounds, and more where the mean itself leaves them, once it has settled, or more than a few readings.
function nisRange({ live, range }) {
  const middle = Math.log10(Math.sqrt(live.last("nis_low") * live.last("nis_high"))) || 0;
  const decades = (name) => live.column(name).map((value) => (typeof value === "number" && value > 0 ? Math.log10(value) : null));
  const place = within(live.x, range);
  const [low, high] = shownExtent({ lines: [decades("nis_mean")] }, ...place);
  if (!Number.isFinite(low)) return [middle - 1, middle + 1];
  const [, most] = shownExtent({ dots: [decades("nis")] }, ...place);
  return [Math.min(middle - 1, low - 0.15), Math.max(middle + 1, high + 0.15, Math.min(most + 0.1, high + 1.5))];
}

function innovationChart(charts, row, further) {
  const range = new Range();
  const { live } = charts;
  const names = ["innovation_upper", "innovation_lower", "innovation"].map((kind) => `${kind}:${row.name}`);
  return {
    key: `innovation:${row.name}`,
    further,
    title: words(row.name),
    unit: bracketed(row.unit),
    note: "innovation, reading − prediction",
    names: { reading: "innovation", bound: "", bounds: "± 2σ expected" },
    weight: 0.62,
    series: [line("bound", { width: 1, spanGaps: true }), line("bound", { width: 1, spanGaps: true }), dots("reading", 3)],
    bands: [band("bounds", [1, 2])],
    under: (plot) => marks(plot, charts.episodes, charts.view.at),
    between: (plot, series) => series === 2 && drawBetween(plot, live, [names[2]]),
    extras: () => betweenCurves(live, [names[2]]),
    data: () => [live.x, ...names.map((name) => live.column(name))],
    range: (chart) => {
      const [x, upper, lower, values] = chart.data;
      const most = Math.max(...shownExtent({ bands: [[lower, upper]], dots: [values] }, ...within(x, charts.range)).map(Math.abs));
      return range.fit(-most, most);
    },
    says: (value) => (Number.isFinite(value(3)) ? `${compact(value(3), 3)}${spaced(row.unit)}  ± ${compact(value(1), 3)} expected` : "no reading"),
  };
}

// How wrong the state could be by one fault that nobody sees, to either side of the estimate.
function integrityLines(plot, charts, state) {
  const found = charts.integrity?.[state.name];
  if (!found || !Number.isFinite(found.bound)) return;
  const x = plot.data[0];
  const mean = plot.data[plot.data.length - 1];
  const ctx = clipped(plot);
  ctx.strokeStyle = colour("integrity");
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([2 * devicePixelRatio, 3 * devicePixelRatio]);
  for (const side of [-1, 1]) {
    ctx.beginPath();
    let open = false;
    for (let k = 0; k < x.length; k++) {
      if (mean[k] === null) open = false; // a gap; what is undefined is a row of another table
      if (typeof mean[k] !== "number") continue;
      const [px, py] = [plot.valToPos(x[k], "x", true), plot.valToPos(mean[k] + side * found.bound, "y", true)];
      if (open) ctx.lineTo(px, py);
      else ctx.moveTo(px, py);
      open = true;
    }
    ctx.stroke();
  }
  ctx.restore();
}

// The same as curves of a file.
function integrityCurves({ data }, charts, state) {
  const bound = charts.integrity?.[state.name]?.bound;
  if (!Number.isFinite(bound)) return [];
  const values = (side) => data.at(-1).map((value) => (typeof value === "number" ? value + side * bound : value));
  return [-1, 1].map((side) => ({ tone: "integrity", dash: [2, 3], width: 1, x: data[0], values: values(side) }));
}

// An angle between -π and π, and a curve of such, which leaves the chart at one edge and comes back at the other.
const turned = (value) => (typeof value === "number" ? value - 2 * Math.PI * Math.round(value / (2 * Math.PI)) : value);

export function unbroken(values) {
  const angles = values.map(turned);
  return angles.map((value, k) => (k && Math.abs(value - angles[k - 1]) > Math.PI ? null : value));
}

// Two tables of other times as one, in which the other's columns stand from place `at` on. Where a table has no row it says undefined, over which its lines go on; rows of one
// time stay apart, as those of several sensors are.
function joined(table, other, at) {
  const [a, b] = [table[0], other[0]];
  if (!b.length) return table.toSpliced(at, 0, ...other.slice(1).map(() => new Array(a.length)));
  const x = [];
  const from = []; // index in the first table, or -1 - index in the second
  for (let i = 0, j = 0; i < a.length || j < b.length; ) {
    const first = j >= b.length || (i < a.length && a[i] <= b[j]);
    x.push(first ? a[i] : b[j]);
    from.push(first ? i++ : -1 - j++);
  }
  const mine = table.map((values) => from.map((k) => (k >= 0 ? values[k] : undefined)));
  mine[0] = x;
  return mine.toSpliced(at, 0, ...other.slice(1).map((values) => from.map((k) => (k < 0 ? values[-1 - k] : undefined))));
}
