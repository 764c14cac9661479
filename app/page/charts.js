// The stack of charts: one time axis, one cursor. States that nobody measures first, then the others, NIS, innovations.

import { Chart, CURSOR, colour, dots, edge, line } from "./chart.js";
import { bracketed, clock, compact, spaced, withDeviation, words } from "./format.js";
import { Lane } from "./lane.js";
import { marks } from "./marks.js";
import { Range, bandExtent, extent, within } from "./ranges.js";

const MOST = 24; // charts of states or rows
const DENSITY = 1.6; // px to a group of rows

// The columns of a state's chart from the live lane, in the order of its series.
const OF_STATE = ["upper", "lower", "truth", "mean"];
const OF_ROW = ["reading", "held", "refused", "screened"];

export class Charts {
  constructor(node, model, link, view) {
    Object.assign(this, { node, model, link, view });
    this.live = new Lane();
    this.previous = new Lane();
    this.episodes = [];
    this.shown = null;
    this.range = [0, model.window];
    const order = [...model.states].sort((a, b) => (a.rows.length > 0) - (b.rows.length > 0)).slice(0, MOST);
    const actions = {
      select: (since, until) => view.show(since, until),
      home: () => view.follow(view.configured),
      wheel: (event, plot) => this.wheel(event, plot),
    };
    this.parts = [
      ...order.map((state) => stateChart(this, state)),
      nisChart(this),
      ...model.rows.slice(0, MOST).map((row) => innovationChart(this, row)),
    ];
    this.charts = this.parts.map((part) => new Chart(part, actions));
    node.replaceChildren(...this.charts.map((chart) => chart.node));
    this.charts.forEach((chart, k) => {
      chart.span = this.range;
      chart.begin(k === this.charts.length - 1);
    });
    view.addEventListener("change", () => this.ask());
    link.addEventListener("frames", () => this.draw());
    link.addEventListener("episodes", (event) => (this.episodes = event.detail));
    link.addEventListener("status", (event) => this.told(event.detail));
    this.width = new ResizeObserver(() => this.ask());
    this.width.observe(node);
    this.ask();
  }

  get columns() {
    const { model } = this;
    return [
      ...model.states.flatMap((state) => OF_STATE.map((kind) => `${kind}:${state.name}`)),
      ...model.rows.flatMap((row) => [...OF_ROW, "innovation", "innovation_upper", "innovation_lower"].map((kind) => `${kind}:${row.name}`)),
      "nis", "nis_mean", "nis_low", "nis_high",
    ];
  }

  // Ask for what the view shows, in as many points as there are pixels for.
  ask() {
    const points = Math.max(50, Math.min(2000, Math.round((this.node.clientWidth - 60) / DENSITY)));
    const wanted = JSON.stringify({ ...this.view.wanted(), points });
    if (wanted === this.asked) return;
    this.asked = wanted;
    const place = JSON.parse(wanted);
    this.link.look("charts", { ...place, columns: this.columns }, (...frame) => this.live.take(...frame));
    const before = this.model.states.map((state) => `mean:${state.name}`);
    this.link.look("previous", { ...place, run: "previous", columns: before }, (...frame) => this.previous.take(...frame));
    if (!this.view.following) {
      this.range = [this.view.since, this.view.until];
      this.draw(); // what is there already, until the points for it come
    }
  }

  told(status) {
    if (status.integrity) this.integrity = status.integrity;
  }

  draw() {
    const { x } = this.live;
    if (!x.length) return;
    const end = x[x.length - 1];
    if (this.view.following) {
      const span = this.view.span ?? Math.max(1, end - x[0]);
      this.range = [end - span, end + 0.005 * span];
    }
    const ended = this.range;
    for (const chart of this.charts) chart.show(chart.what.data(), ended);
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

  end() {
    this.width.disconnect();
    this.charts.forEach((chart) => chart.end());
  }
}

export { CURSOR };

function stateChart(charts, state) {
  const range = new Range();
  const { live, previous } = charts;
  const rows = state.rows.flatMap((row) => OF_ROW.map((kind) => `${kind}:${row}`));
  const own = OF_STATE.map((kind) => `${kind}:${state.name}`);
  const marksOf = { reading: () => dots("reading", 4), held: () => dots("reading", 5, true), refused: () => dots("refused", 6), screened: () => dots("refused", 7, true) };
  return {
    title: state.label,
    unit: bracketed(state.unit),
    note: state.rows.length ? null : "not measured",
    weight: state.rows.length ? 1 : 1.5,
    // upper, lower, truth, mean, readings …, bounds of integrity, previous mean
    series: [
      edge(), edge(), line("truth", { width: 1.5, dash: [5, 3], spanGaps: true }), line("estimate", { width: 1.75 }),
      ...rows.map((name) => marksOf[name.split(":")[0]]()),
      line("previous", { width: 1 }),
    ],
    bands: [{ series: [1, 2], fill: () => colour("band") }],
    ticks: ticks,
    under: (plot) => marks(plot, charts.episodes, charts.model),
    over: (plot) => integrityLines(plot, charts, state),
    data: () => {
      const columns = [live.x, ...own.map((name) => live.column(name)), ...rows.map((name) => live.column(name))];
      return joined(columns, [previous.x, previous.column(`mean:${state.name}`)]);
    },
    range: (chart) => {
      if (state.probability) return [-0.03, 1.03];
      const [x, upper, lower, ...lines] = chart.data;
      const [from, to] = within(x, charts.range);
      const [lowest, highest] = extent(lines.slice(0, -1), from, to);
      const [under, over] = bandExtent(lower, upper, from, to);
      return range.fit(Math.min(lowest, under), Math.max(highest, over));
    },
    says: (value) => {
      const [upper, mean] = [value(1), value(4)];
      const truth = value(3);
      const bound = charts.integrity?.[state.name]?.bound;
      const unseen = Number.isFinite(bound) ? `  (${compact(bound, 2)} unseen)` : "";
      const off = Number.isFinite(truth) ? `  truth ${compact(truth, 4)}` : "";
      return withDeviation(mean, upper - mean, state.unit) + unseen + off;
    },
  };
}

function nisChart(charts) {
  const { live } = charts;
  const names = ["nis_high", "nis_low", "nis_mean", "nis"];
  const logarithmic = (value) => (typeof value === "number" ? Math.max(value, 1e-12) : value);
  return {
    title: "NIS",
    unit: "",
    note: "mean of the last readings, in its 95 % bounds",
    weight: 1,
    series: [line("bound", { width: 1, dash: [4, 4] }), line("bound", { width: 1, dash: [4, 4] }), line("estimate"), dots("quiet", 2.5)],
    bands: [{ series: [1, 2], fill: () => colour("bounds") }],
    scale: { distr: 3 },
    axis: { filter: (self, splits) => splits.map((v) => (String(v).match(/^[0.]*1[0.]*$|^10*$/) ? v : null)) },
    ticks,
    under: (plot) => marks(plot, charts.episodes, charts.model),
    data: () => {
      const [low, high] = nisRange(live);
      const clamp = (v) => (typeof v === "number" ? Math.min(high, Math.max(low, v)) : v);
      return [live.x, ...names.map((name) => live.column(name).map(name === "nis" ? clamp : logarithmic))];
    },
    range: () => nisRange(live),
    says: (value) => `${compact(value(3), 3)}  bounds ${compact(value(2), 3)} – ${compact(value(1), 3)}`,
  };
}

// A decade about the bounds, and more where the mean itself leaves it.
function nisRange(live) {
  const middle = Math.sqrt(live.last("nis_low") * live.last("nis_high")) || 1;
  const [low, high] = extent([live.column("nis_mean")], 0, live.x.length - 1);
  return [Math.min(middle / 10, low / 1.5), Math.max(middle * 10, high * 1.5)];
}

function innovationChart(charts, row) {
  const range = new Range();
  const { live } = charts;
  const names = ["innovation_upper", "innovation_lower", "innovation"].map((kind) => `${kind}:${row.name}`);
  return {
    title: words(row.name),
    unit: bracketed(row.unit),
    note: "innovation, reading − prediction",
    weight: 0.62,
    series: [line("bound", { width: 1, spanGaps: true }), line("bound", { width: 1, spanGaps: true }), dots("reading", 3)],
    bands: [{ series: [1, 2], fill: () => colour("bounds") }],
    ticks,
    under: (plot) => marks(plot, charts.episodes, charts.model),
    data: () => [live.x, ...names.map((name) => live.column(name))],
    range: (chart) => {
      const [x, upper, lower, values] = chart.data;
      const [from, to] = within(x, charts.range);
      const [, over] = bandExtent(lower, upper, from, to);
      const [low, high] = extent([values], from, to);
      const most = Math.max(Math.abs(low), Math.abs(high), over);
      return range.fit(-most, most);
    },
    says: (value) => `${compact(value(3), 3)}${spaced(row.unit)}  ± ${compact(value(1), 3)} expected`,
  };
}

function ticks(self, splits) {
  const step = splits.length > 1 ? splits[1] - splits[0] : 1;
  const fraction = step >= 1 ? 0 : Math.min(3, Math.ceil(-Math.log10(step)));
  return splits.map((value) => clock(value, fraction));
}

// How wrong the state could be by one fault that nobody sees, to either side of the estimate.
function integrityLines(plot, charts, state) {
  const found = charts.integrity?.[state.name];
  if (!found || !Number.isFinite(found.bound)) return;
  const { ctx, bbox } = plot;
  const [x, , , , mean] = plot.data;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.strokeStyle = colour("integrity");
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([2 * devicePixelRatio, 3 * devicePixelRatio]);
  for (const side of [-1, 1]) {
    ctx.beginPath();
    let open = false;
    for (let k = 0; k < x.length; k++) {
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

// Two tables of other times as one; where one has no row the other's line goes on.
function joined(table, other) {
  if (!other[0].length) return [...table, new Array(table[0].length).fill(null)];
  return uPlot.join([table, other], [table.map(() => 2).slice(1), [2]].map((modes) => [0, ...modes]));
}
