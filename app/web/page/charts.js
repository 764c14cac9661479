// The stack of charts: one time axis, one cursor. The kinds of charts are the files of the folder charts.

import { Chart, TimeAxis, declared } from "./chart.js";
import { $, setText } from "./dom.js";
import { Layout } from "./layout.js";
import { Pins, Previous, Smoothed, Strong } from "./layers.js";
import { Stream } from "./stream.js";

const DENSITY = 1.6; // px to a group of rows
const QUIET = 500; // ms without a frame
const MAX_HALVINGS = 4; // of the window, while there is less than that to show

export class Charts {
  constructor(node, model, link, view, kinds) {
    Object.assign(this, { node, model, link, view });
    this.live = new Stream(link, "charts");
    this.overview = new Stream(); // of the time bar, which is always there
    this.episodes = [];
    this.visible = true;
    this.range = [0, model.window];
    const actions = {
      select: (since, until) => view.show(since, until),
      home: () => view.follow(view.configured),
      wheel: (event, plot) => this.wheel(event, plot),
      save: (chart, button) => this.saving.chart(chart, button),
    };
    this.strong = new Strong(this, link);
    this.layers = [];
    this.charts = declared(kinds, this).map((what) => new Chart(what, actions));
    node.replaceChildren(...this.charts.map((chart) => chart.node));
    for (const chart of this.charts) {
      chart.span = this.range;
      chart.begin();
    }
    this.axis = new TimeAxis($("axis"));
    this.pins = new Pins(this, link, actions);
    this.smoothed = new Smoothed(this, link);
    this.layers = [new Previous(this, link), this.smoothed, this.pins];
    $("layout").after(this.smoothed.button);
    this.layout = new Layout(this.charts, node, $("layout"), model.twin, () => this.ask());
    view.addEventListener("change", () => this.ask());
    link.addEventListener("frames", () => this.draw());
    link.addEventListener("episodes", (event) => {
      this.episodes = event.detail;
      if (performance.now() - this.drawnAt > QUIET) this.draw(); // of a twin that has ended, no frame follows
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

  // Ask for what the view shows, in as many points as there are pixels for.
  ask() {
    if (!this.layout) return; // not yet
    const points = Math.max(50, Math.min(2000, Math.round((this.node.clientWidth - 60) / DENSITY)));
    const place = this.visible ? { ...this.view.wanted(), points } : null;
    const { columns } = this;
    const asked = JSON.stringify([place, columns]);
    const changed = asked !== this.asked;
    this.asked = asked;
    if (changed) {
      this.live.ask(place && { ...place, columns });
      for (const layer of [...this.layers, this.strong]) layer.ask(place);
    }
    // What is there already is drawn until the new points come; of the same stretch another moment may be looked at.
    if (!this.visible || !this.view.following) this.draw();
  }

  update(status) {
    setText($("no-rows"), status.t === null ? status.cause || "waiting for the first measurement" : "");
    if (status.integrity) this.integrity = status.integrity;
  }

  draw() {
    const { x } = this.visible ? this.live : this.overview;
    if (!this.view.following) this.range = [this.view.since, this.view.until];
    else if (x.length) this.range = followed(x[0], x.at(-1), this.view.span);
    if (!this.visible || !x.length) return;
    for (const chart of this.charts) if (!chart.node.hidden) chart.show(chart.what.data(), this.range, this.view.at);
    this.pins.show(this.range);
    this.axis.show(this.range);
    this.drawnAt = performance.now();
    window.nisus.drawn = (window.nisus.drawn ?? 0) + 1;
    window.nisus.revision = this.live.revision;
    this.node.dataset.revision = this.live.revision;
  }

  wheel(event, plot) {
    if (!event.ctrlKey && !event.shiftKey && !event.metaKey) return; // the wheel alone scrolls the stack
    event.preventDefault();
    const at = plot.posToVal(event.offsetX, "x");
    if (event.shiftKey) this.view.pan(((event.deltaY || event.deltaX) / 600) * (this.range[1] - this.range[0]), this.range);
    else this.view.zoom(event.deltaY > 0 ? 1.25 : 0.8, at, this.range);
  }

  get newest() {
    return (this.visible ? this.live : this.overview).x.at(-1) ?? Infinity;
  }
}

// The last seconds; while there are fewer, a part of the window that they fill from the left.
function followed(start, end, span) {
  if (span === null) return [start, Math.max(end, start + 1)];
  if (end - start >= span) return [end - span, end + 0.004 * span];
  let length = span;
  for (let k = 0; k < MAX_HALVINGS && end - start < length / 2; k++) length /= 2;
  return [start, start + length];
}
