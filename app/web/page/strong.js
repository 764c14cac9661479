// The bands of the states that charts of groups draw strong: asked for alone, as those of all would be many.

import { clipped, colour } from "./chart.js";
import { Lane } from "./lane.js";
import { bandExtent, within } from "./ranges.js";

export class Strong {
  constructor(charts, link) {
    Object.assign(this, { charts, link });
    this.lane = new Lane();
    this.states = new Map(); // by the key of the chart: which state it draws strong
  }

  // A chart draws that one strong, or none.
  choose(key, name) {
    if (this.states.get(key) === name) return;
    this.states.set(key, name);
    this.ask(this.place);
  }

  // For the same stretch of time as the charts; null for none.
  ask(place) {
    this.place = place;
    const shown = new Set(this.charts.layout?.shown().map(([key]) => key));
    const names = [...new Set([...this.states].flatMap(([key, name]) => (name && shown.has(key) ? [name] : [])))].sort();
    const wanted = place && names.length ? { ...place, columns: names.flatMap((name) => [`upper:${name}`, `lower:${name}`]) } : null;
    const asked = JSON.stringify(wanted);
    if (asked === this.asked) return;
    this.asked = asked;
    this.link.look("strong", wanted, (...frame) => this.lane.take(...frame));
  }

  edges(name) {
    return ["upper", "lower"].map((side) => this.lane.column(`${side}:${name}`));
  }

  // Beneath all lines.
  draw(plot, name) {
    const { x } = this.lane;
    if (!name || !x.length) return;
    const [upper, lower] = this.edges(name);
    const [from, to] = within(x, [plot.scales.x.min, plot.scales.x.max]);
    const rows = [];
    for (let k = Math.max(0, from - 1); k <= Math.min(x.length - 1, to + 1); k++) if (typeof upper[k] === "number" && typeof lower[k] === "number") rows.push(k);
    const ctx = clipped(plot);
    ctx.fillStyle = colour("band");
    ctx.beginPath();
    for (const k of rows) ctx.lineTo(plot.valToPos(x[k], "x", true), plot.valToPos(upper[k], "y", true));
    for (const k of rows.reverse()) ctx.lineTo(plot.valToPos(x[k], "x", true), plot.valToPos(lower[k], "y", true));
    ctx.fill();
    ctx.restore();
  }

  // What its band spans of a stretch of time.
  extent(name, range) {
    const { x } = this.lane;
    if (!name || !x.length) return [Infinity, -Infinity];
    const [upper, lower] = this.edges(name);
    return bandExtent(lower, upper, ...within(x, range));
  }

  // Its edges as curves of a file.
  curves(name) {
    const { x } = this.lane;
    if (!name || !x.length) return [];
    const [from, to] = within(x, this.charts.range);
    return this.edges(name).map((values) => ({ name: "± 2σ", tone: "estimate", dash: [2, 2], width: 0.75, x: x.slice(from, to + 1), values: values.slice(from, to + 1) }));
  }
}
