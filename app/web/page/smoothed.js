// What the readings after each moment add: the smoothed mean of a state and its band, beside the filter's. The server
// smooths only while this is on.

import { clipped, colour } from "./chart.js";
import { element } from "./dom.js";
import { Lane } from "./lane.js";
import { within } from "./ranges.js";

const KINDS = ["lower", "mean", "upper"];

export class Smoothed {
  constructor(charts, link) {
    Object.assign(this, { charts, link });
    this.lane = new Lane();
    this.shown = localStorage.getItem("nisus.smoothed") === "on";
    this.button = element("button", { type: "button", id: "smoothed", "aria-pressed": String(this.shown), title: "The estimate given the readings after each moment too", onclick: () => this.toggle() }, "Smoothed");
  }

  toggle() {
    this.shown = !this.shown;
    localStorage.setItem("nisus.smoothed", this.shown ? "on" : "off");
    this.button.setAttribute("aria-pressed", String(this.shown));
    this.lane = new Lane();
    this.asked = null;
    this.ask(this.place);
    this.charts.draw();
  }

  // For the same stretch of time as the charts; place: {since, until, span, points}, null for none.
  ask(place) {
    this.place = place;
    const columns = this.charts.states.flatMap((state) => KINDS.map((kind) => `${kind}:${state.name}`));
    const wanted = place && this.shown ? { ...place, run: "smoothed", columns } : null;
    const asked = JSON.stringify(wanted);
    if (asked === this.asked) return;
    this.asked = asked;
    this.link.look("smoothed", wanted, (...frame) => this.lane.take(...frame));
  }

  // Beneath the line of the estimate: a fine edge to either side, and the mean between them.
  draw(plot, state) {
    if (!this.shown || !this.lane.x.length) return;
    const ctx = clipped(plot);
    ctx.strokeStyle = colour("smoothed");
    for (const kind of KINDS) {
      ctx.lineWidth = (kind === "mean" ? 1.25 : 0.75) * devicePixelRatio;
      this.trace(plot, state, kind);
    }
    ctx.restore();
  }

  trace(plot, state, kind) {
    const { ctx } = plot;
    const { x } = this.lane;
    const [mean, values] = [this.lane.column(`mean:${state.name}`), this.lane.column(`${kind}:${state.name}`)];
    const [from, to] = within(x, [plot.scales.x.min, plot.scales.x.max]);
    ctx.beginPath();
    let last = null;
    for (let k = Math.max(0, from - 1); k <= Math.min(x.length - 1, to + 1); k++) {
      if (typeof values[k] !== "number" || typeof mean[k] !== "number") {
        last = null;
        continue;
      }
      // An angle keeps its edges about its mean, and has no line from π to -π.
      const turns = state.circular ? 2 * Math.PI * Math.round(mean[k] / (2 * Math.PI)) : 0;
      const value = values[k] - turns;
      const place = [plot.valToPos(x[k], "x", true), plot.valToPos(value, "y", true)];
      if (last !== null && !(state.circular && Math.abs(value - last) > Math.PI)) ctx.lineTo(...place);
      else ctx.moveTo(...place);
      last = value;
    }
    ctx.stroke();
  }

  // The same as curves of a file.
  curves(state) {
    if (!this.shown || !this.lane.x.length) return [];
    const [from, to] = within(this.lane.x, this.charts.range);
    const part = (kind) => this.lane.column(`${kind}:${state.name}`).slice(from, to + 1);
    return KINDS.map((kind) => ({ name: kind === "mean" ? "smoothed" : `smoothed, ${kind}`, tone: "smoothed", dash: [], x: this.lane.x.slice(from, to + 1), values: part(kind) }));
  }
}
