// The stack of charts: one time axis, one cursor. The kinds of charts are the files of the folder charts.

import { Chart, declared, TimeAxis } from "./chart.js";
import { $, changed, element, setAttribute, setText } from "./dom.js";
import { Pins, Previous, Smoothed, Strong } from "./layers.js";
import { Stream } from "./stream.js";
import { SIGNS } from "./trust.js";

const DENSITY = 1.6; // px to a group of rows
const REDRAW_AFTER_MS = 500; // ms without a frame
const MAX_HALVINGS = 4; // of the window, while there is less than that to show
const LEGEND_DELAY_MS = 400; // ms after a drawing
const MOMENT_ROWS = 400; // rows before a moment, in which the last value of each column is looked for (chart.js)
const MOMENT_POINTS = 1000; // rows of these, at most
const HOVER_PERIOD_MS = 60; // ms between two questions for the row at the pointer
const EQUAL_S = 1e-6; // s

// Marks in the order of the legend: text, where the charts differ, and tooltip.
const LEGEND = {
  estimate: ["estimate", "Estimate of the filter"],
  band: ["± 2σ", "Estimate ± 2 standard deviations"],
  "band-noise": ["of which noise", "Part of the band that is noise and the prior; the paler rest is the uncertainty of considered parameters, and while the state is suspect, what its corrections were too large by"],
  integrity: [null, "Protection level: the largest error that one undetected fault can cause"],
  truth: [null, "Known true value, for comparison only"],
  reading: [null, "Measurement that the filter used"],
  "reading ring": [null, "Measurement of a held-out sensor: predicted and scored, not used"],
  refused: [null, "Measurement rejected by the gate"],
  "refused ring": [null, "Measurement outside its plausible range or rate"],
  smoothed: [null, "Estimate that also uses later measurements"],
  previous: [null, "Estimate of the run before"],
  quiet: ["single value", "NIS of one measurement, or one state of a group"],
  bounds: ["95 % range", "Range in which a consistent filter has 95 % of these values"],
  "episode-strip": [null, "Time of a fault episode: see Episodes"],
  "health-advisory": [null, "Time of an advisory: bands are wider than necessary, or the gate rejects outliers"],
  outside: [null, "Value beyond the axis; the furthest has its value beside it"],
};

export class Charts {
  constructor(node, model, link, view, kinds) {
    Object.assign(this, { node, model, link, view });
    this.live = new Stream(link, "charts");
    this.overview = new Stream(); // of the time bar, which is always there
    this.episodes = [];
    this.notes = []; // of users, by time
    this.draft = null; // the one that is being written
    this.nisDof = 1; // mean degrees of freedom of a measurement
    this.visible = true;
    this.range = [0, model.window];
    const actions = {
      select: (since, until) => view.show(since, until),
      home: () => view.follow(view.configured),
      wheel: (event, plot) => this.wheel(event, plot),
      save: (chart, button) => this.saving.chart(chart, button),
      note: (...place) => this.noting(...place),
      hover: (seconds) => this.hover(seconds),
    };
    this.strong = new Strong(this, link);
    this.layers = [];
    this.charts = declared(kinds, this).map((what) => new Chart(what, actions));
    node.replaceChildren(...this.charts.map((chart) => chart.node));
    // Charts draw both extremes of a group of rows; the values at the pointer, or at a moment, are those of its row.
    this.moment = new Stream(link, "moment");
    this.hovered = null; // time at the pointer, s
    this.fewer = 1; // share of the stretch before a moment that has no more rows than are sent
    const strong = { choose() {}, stream: this.moment, edges: () => [[], []] };
    const exact = declared(kinds, Object.create(this, { live: { value: this.moment }, strong: { value: strong }, ask: { value: () => {} } }));
    this.charts.forEach((chart, k) => {
      chart.span = this.range;
      chart.begin();
      chart.exact = () => this.exactly(chart, exact[k]);
    });
    this.axis = new TimeAxis($("axis"));
    this.pins = new Pins(this, link, actions);
    this.smoothed = new Smoothed(this, link);
    this.layers = [new Previous(this, link), this.smoothed, this.pins];
    $("layout").after(this.smoothed.button);
    this.layout = new Layout(this.charts, node, $("layout"), model.twin, () => this.ask());
    view.addEventListener("change", () => this.ask());
    link.addEventListener("frames", ({ detail: arrived }) => {
      const read = arrived.has("moment") && arrived.size === 1;
      if (arrived.has("moment")) this.narrow();
      if (read) return this.read();
      this.draw();
      this.askMoment();
    });
    link.addEventListener("episodes", (event) => {
      this.episodes = event.detail;
      clearTimeout(this.marking);
      // Of a twin that has ended, no frame follows.
      if (performance.now() - this.drawnAt > REDRAW_AFTER_MS) this.draw();
      else this.marking = setTimeout(() => this.draw(), REDRAW_AFTER_MS);
    });
    link.addEventListener("annotations", (event) => {
      this.notes = event.detail;
      this.draw();
    });
    link.addEventListener("status", (event) => this.update(event.detail));
    new ResizeObserver(() => this.ask()).observe(node);
    this.ask();
  }

  // Whether a chart is shown.
  shown(key) {
    return this.layout?.shown().some(([other]) => other === key) ?? false;
  }

  // The columns that the shown charts need.
  get columns() {
    const shown = new Set(this.layout.shown().map(([key]) => key));
    return [...new Set(this.charts.flatMap(({ what }) => (shown.has(what.key) ? (what.columns ?? []) : [])))];
  }

  // Hidden behind another tab they ask for nothing.
  show(visible) {
    if (visible === this.visible) return;
    this.visible = visible;
    this.asked = null;
    this.ask();
  }

  // Request the visible span, with as many points as there are pixels.
  ask() {
    if (!this.layout) return; // not yet
    const points = Math.max(50, Math.min(2000, Math.round((this.node.clientWidth - 60) / DENSITY)));
    const place = this.visible ? { ...this.view.wanted(), points } : null;
    const { columns } = this;
    const asked = JSON.stringify([place, columns]);
    const changed = asked !== this.asked;
    this.asked = asked;
    if (changed) {
      this.fewer = 1;
      this.live.ask(place && { ...place, columns });
      for (const layer of [...this.layers, this.strong]) layer.ask(place);
    }
    this.askMoment();
    // What is there already is drawn until the new points come; of the same stretch another moment may be looked at.
    if (!this.visible || !this.view.following) this.draw();
  }

  // The time whose values are shown: at the pointer, else the moment that is looked at; null is the newest row.
  get looked() {
    return this.hovered ?? this.view.at;
  }

  hover(seconds) {
    if (seconds === this.hovered) return;
    this.hovered = seconds;
    this.hovering ??= setTimeout(() => {
      this.hovering = null;
      this.askMoment();
      this.read();
    }, HOVER_PERIOD_MS);
  }

  // Request the rows before that time. None where the points of the charts are rows themselves.
  askMoment() {
    const { looked } = this;
    const { size } = this.live;
    const groups = (MOMENT_ROWS / size) * this.fewer;
    // Of one digit: the same question while the charts follow.
    this.reach = Number(((groups * (this.range[1] - this.range[0]) * DENSITY) / Math.max(1, this.node.clientWidth - 60)).toPrecision(1));
    const grouped = this.visible && (size > 1 || this.live.each > 1);
    const stretch = looked === null ? { span: this.reach } : { since: looked - this.reach, until: looked + EQUAL_S };
    this.moment.ask(grouped ? { ...stretch, points: MOMENT_POINTS, columns: this.columns } : null);
  }

  // Rows lie closer there than elsewhere.
  narrow() {
    const { size } = this.moment;
    if (size === 1) return;
    this.fewer /= size;
    this.askMoment();
  }

  // Show the values of all charts again.
  read() {
    for (const chart of this.charts) if (!chart.node.hidden && chart.plot) chart.pointed(chart.plot);
  }

  // The text of a chart at the time that is looked at, null while its row is not there; undefined if the points of the
  // charts are rows.
  exactly(chart, what) {
    if (this.live.size === 1 && this.live.each === 1) return undefined;
    const { x, size } = this.moment;
    const { looked } = this;
    const row = size > 1 ? -1 : looked === null ? x.length - 1 : x.findLastIndex((time) => time <= looked + EQUAL_S);
    if (row < 0 || (looked !== null && x[row] < looked - this.reach)) return null;
    const data = what.data();
    return what.says((name) => chart.at(name, row, data, MOMENT_POINTS));
  }

  update(status) {
    setText($("no-rows"), status.t === null ? status.cause || "waiting for the first measurement" : "");
    if (status.integrity) this.integrity = status.integrity;
    const { states, withheld } = { ...status, ...status.moment };
    if (withheld) this.withheld = withheld;
    for (const chart of states ? this.charts : []) {
      const own = states[chart.what.state];
      if (own) chart.graded(own, own.grade === "withheld" ? "⊘ withheld" : SIGNS[own.grade]);
    }
    if (status.nis_dof) this.nisDof = status.nis_dof;
  }

  draw() {
    const { x } = this.visible ? this.live : this.overview;
    if (!this.view.following) this.range = [this.view.since, this.view.until];
    else if (x.length) this.range = followed(x[0], x.at(-1), this.view.span);
    if (!this.visible || !x.length) return;
    const notes = this.draft ? [...this.notes.filter((note) => note.number !== this.draft.number), this.draft] : this.notes;
    const [[first]] = [...this.layout.shown(), []];
    for (const chart of this.charts) if (!chart.node.hidden) chart.show(chart.what.data(), this.range, this.view.at, notes, chart.what.key === first);
    this.pins.show(this.range, notes);
    this.axis.show(this.range);
    this.drawnAt = performance.now();
    this.explaining ??= setTimeout(() => ((this.explaining = null), this.visible && this.explain()), LEGEND_DELAY_MS);
    window.nisus.drawn = (window.nisus.drawn ?? 0) + 1;
    window.nisus.revision = this.live.revision;
    this.node.dataset.revision = this.live.revision;
  }

  // Legend of the shown charts, each mark once. Pinned runs are added where they are drawn (layers.js).
  explain(shown = this.charts.filter((chart) => !chart.node.hidden)) {
    const found = new Map();
    const add = (key, text, style) => key in LEGEND && !found.has(key) && found.set(key, [LEGEND[key][0] ?? text, style]);
    for (const chart of shown) for (const [text, style] of chart.legend) add(style.ring ? `${style.tone} ring` : style.tone, text, style);
    if (shown.some((chart) => chart.plot?.marked)) add("episode-strip", "fault episode", { mark: "line", tone: "episode-strip", width: 2.5 });
    if (shown.some((chart) => chart.plot?.advised)) add("health-advisory", "advisory", { mark: "line", tone: "health-advisory", width: 2.5 });
    if (shown.some((chart) => chart.outsiders?.length)) add("outside", "off scale", { mark: "triangle", tone: "faint" });
    const items = Object.keys(LEGEND).flatMap((key) => (found.has(key) ? [[key, ...found.get(key)]] : []));
    if (!changed($("legend"), items.map(([, text]) => text))) return;
    $("legend").querySelectorAll("li:not(.pinned)").forEach((item) => item.remove());
    $("legend").append(...items.map(([key, text, style]) => element("li", { title: LEGEND[key][1], dataset: { key } }, sample(style), text)));
  }

  wheel(event, plot) {
    if (!event.ctrlKey && !event.shiftKey && !event.metaKey) return; // the wheel alone scrolls the stack
    event.preventDefault();
    const at = plot.posToVal(event.offsetX, "x");
    if (event.shiftKey) this.view.pan(((event.deltaY || event.deltaX) / 600) * (this.range[1] - this.range[0]), this.range);
    else this.view.zoom(event.deltaY > 0 ? 1.25 : 0.8, at, this.range);
  }

  // Px from the left edge of the window to a moment.
  placeOf(seconds) {
    const plot = this.charts.find((chart) => !chart.node.hidden)?.plot;
    return plot ? plot.over.getBoundingClientRect().left + plot.valToPos(seconds, "x") : 0;
  }

  // Where the pointer is, else the moment that is looked at, else the newest row, s.
  get pointed() {
    const plot = this.charts.find((chart) => !chart.node.hidden)?.plot;
    return plot?.cursor.left >= 0 ? plot.posToVal(plot.cursor.left, "x") : (this.view.at ?? this.newest);
  }

  get newest() {
    return (this.visible ? this.live : this.overview).x.at(-1) ?? Infinity;
  }
}

// A mark as the legend shows it.
function sample({ mark, tone, ring, dash = [], width = 1.5 }) {
  const kind = { area: "box", dots: ring ? "ring" : "dot", triangle: "triangle" }[mark] ?? "line";
  const stroke = dash[0] > 3 ? "dashed" : dash.length ? "dotted" : "solid";
  return element("i", { class: kind, "aria-hidden": "true", style: `color: var(--${tone})${kind === "line" ? `; border-top: ${Math.max(1.5, width)}px ${stroke}` : ""}` });
}

// The last seconds; while there are fewer, a part of the window that they fill from the left.
function followed(start, end, span) {
  if (span === null) return [start, Math.max(end, start + 1)];
  if (end - start >= span) return [end - span, end + 0.004 * span];
  let length = span;
  for (let k = 0; k < MAX_HALVINGS && end - start < length / 2; k++) length /= 2;
  return [start, start + length];
}

// Selection, order and height of the charts: chosen in a menu, kept in the browser, for each twin.

const LOWEST = 40; // px
const HIGHEST = 1200;

class Layout {
  // charts: [Chart] in the order in which they stand by themselves; each has a key. told(): others are shown
  constructor(charts, node, menu, twin, told) {
    Object.assign(this, { charts, node, menu, told });
    this.key = `nisus.charts.${twin}`;
    this.kept = JSON.parse(localStorage.getItem(this.key) ?? "{}");
    for (const chart of charts) this.prepare(chart);
    this.apply();
    this.offer();
    document.addEventListener("pointerdown", (event) => menu.contains(event.target) || menu.removeAttribute("open"));
    menu.addEventListener("keydown", (event) => event.key === "Escape" && menu.removeAttribute("open"));
  }

  prepare(chart) {
    const grip = element("div", { class: "grip", role: "separator", "aria-orientation": "horizontal", "aria-valuemin": LOWEST, "aria-valuemax": HIGHEST, "aria-label": `Height of ${chart.what.title}`, tabindex: 0, title: "Drag to change the height, double-click to reset it" });
    let from = null;
    grip.addEventListener("pointerdown", (event) => {
      grip.setPointerCapture(event.pointerId);
      from = [event.clientY, chart.node.clientHeight];
    });
    grip.addEventListener("pointermove", (event) => from && this.size(chart, from[1] + event.clientY - from[0]));
    for (const end of ["pointerup", "pointercancel"]) grip.addEventListener(end, () => ((from = null), this.keep()));
    grip.addEventListener("dblclick", () => (this.size(chart, null), this.keep()));
    grip.addEventListener("keydown", (event) => {
      const step = { ArrowUp: -12, ArrowDown: 12 }[event.key];
      if (!step) return;
      event.preventDefault();
      this.size(chart, chart.node.clientHeight + step);
      this.keep();
    });
    chart.node.append(grip);
  }

  size(chart, height) {
    this.kept.heights ??= {};
    if (height === null) delete this.kept.heights[chart.what.key];
    else this.kept.heights[chart.what.key] = Math.min(HIGHEST, Math.max(LOWEST, Math.round(height)));
    this.apply();
  }

  get order() {
    const place = new Map((this.kept.order ?? []).map((key, k) => [key, k]));
    const own = (chart) => place.get(chart.what.key) ?? this.charts.indexOf(chart);
    return [...this.charts].sort((a, b) => own(a) - own(b));
  }

  // What is shown, in its order: [key, height or null].
  shown() {
    return this.order.filter((chart) => !chart.node.hidden).map(({ what: { key } }) => [key, this.kept.heights?.[key] ?? null]);
  }

  // Show these and no others, for a link; the user's own choice is kept for the next visit.
  use(shown) {
    const wanted = new Map(shown);
    const others = this.charts.map((chart) => chart.what.key).filter((key) => !wanted.has(key));
    const heights = shown.flatMap(([key, height]) => (height >= LOWEST && height <= HIGHEST ? [[key, height]] : []));
    this.kept = { order: [...wanted.keys(), ...others], hidden: others, heights: Object.fromEntries(heights) };
    this.apply();
    this.offer();
  }

  apply() {
    const hidden = new Set(this.hidden);
    this.order.forEach((chart, k) => {
      chart.node.style.order = k;
      chart.node.hidden = hidden.has(chart.what.key);
      const height = this.kept.heights?.[chart.what.key];
      chart.node.style.flex = height ? `0 0 ${height}px` : "";
      setAttribute(chart.node.querySelector(".grip"), "aria-valuenow", chart.node.clientHeight);
    });
    this.told();
  }

  // Of a sensor with many rows, only the first few are shown by default.
  get hidden() {
    return this.kept.hidden ?? this.charts.filter((chart) => chart.what.further).map((chart) => chart.what.key);
  }

  keep() {
    localStorage.setItem(this.key, JSON.stringify(this.kept));
  }

  offer() {
    const hidden = new Set(this.hidden);
    const show = (chart, shown) => {
      if (shown) hidden.delete(chart.what.key);
      else hidden.add(chart.what.key);
      this.kept.hidden = [...hidden];
      this.changed();
    };
    const move = (chart, step) => {
      const keys = this.order.map((item) => item.what.key);
      const from = keys.indexOf(chart.what.key);
      const to = Math.min(keys.length - 1, Math.max(0, from + step));
      keys.splice(to, 0, ...keys.splice(from, 1));
      this.kept.order = keys;
      this.changed();
    };
    const row = (chart) => {
      const box = element("input", { type: "checkbox", onchange: () => show(chart, box.checked) });
      box.checked = !hidden.has(chart.what.key);
      const button = (text, label, step) => element("button", { type: "button", "aria-label": `${chart.what.title} ${label}`, onclick: () => move(chart, step) }, text);
      return element("li", {}, element("label", {}, box, chart.what.title, element("span", { class: "faint" }, chart.what.note ?? "")), button("↑", "up", -1), button("↓", "down", 1));
    };
    const again = element("button", { type: "button", class: "go", onclick: () => ((this.kept = {}), this.changed()) }, "Reset");
    this.menu.replaceChildren(element("summary", { title: "Choose and order the charts" }, "Shown"), element("div", { class: "menu" }, element("ol", {}, ...this.order.map(row)), again));
  }

  changed() {
    this.keep();
    this.apply();
    this.offer();
  }
}
