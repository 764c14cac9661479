// Any two states against each other: where the estimate came from, its ellipses of 1 and 2 σ, particles or sigma points.

import { multiples, rounded } from "./chart.js";
import { element } from "./dom.js";
import { clipped, colour, fineContext, stroke } from "./drawing.js";
import { bracketed, compact, words } from "./format.js";
import { within } from "./ranges.js";
import { Stream } from "./stream.js";
import { svgFile } from "./svg.js";

const ROOM = { left: 46, right: 10, top: 8, bottom: 34 };
const POINTS = 600;
const FILE = [640, 530]; // px of a file

export class XY {
  constructor(node, model, link, view, charts) {
    Object.assign(this, { node, model, link, view, charts });
    this.stream = new Stream(link, "xy");
    this.belief = null;
    const names = model.states.map((state) => state.name);
    const first = model.pairs[0] ?? names.slice(0, 2);
    const kept = (localStorage.getItem(this.key) ?? "").split("/").filter((name) => names.includes(name));
    this.pair = kept.length === 2 ? kept : first;
    const choice = (k, label) => {
      const select = element("select", { "aria-label": label, onchange: () => this.choose(k, select.value) }, ...model.states.map((state) => element("option", { value: state.name }, state.label)));
      select.value = this.pair[k];
      return select;
    };
    const save = element("button", { type: "button", class: "save", title: "Save this chart", "aria-label": "Save the chart of two states", "aria-haspopup": "menu", onclick: () => this.saving.xy(this, save) }, "⤓");
    this.canvas = element("canvas", { role: "img", "aria-label": "Two states against each other" });
    this.text = element("p", { class: "faint" });
    if (names.length < 2) return node.replaceChildren(element("p", { class: "faint" }, "This twin has one state only."));
    node.replaceChildren(element("header", {}, choice(1, "Upwards"), element("span", {}, " over "), choice(0, "To the right"), save), this.canvas, this.text);
    link.addEventListener("frames", () => this.draw());
    link.addEventListener("belief", (event) => {
      this.belief = event.detail;
      this.draw();
    });
    view.addEventListener("change", () => this.shown && this.ask());
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  get key() {
    return `nisus.xy.${this.model.twin}`;
  }

  choose(k, name) {
    this.pair = this.pair.with(k, name);
    localStorage.setItem(this.key, this.pair.join("/"));
    this.ask();
  }

  visible(shown) {
    this.shown = shown && this.model.states.length > 1;
    this.ask();
  }

  ask() {
    if (!this.shown) {
      this.stream.ask(null);
      this.link.watch(null);
      return;
    }
    this.belief = null;
    const columns = this.pair.flatMap((name) => [`mean:${name}`, `truth:${name}`]);
    this.stream.ask({ ...this.view.wanted(), columns, points: POINTS });
    this.link.watch(this.pair);
  }

  draw() {
    const { canvas } = this;
    if (!this.shown || !canvas.clientWidth) return;
    const belief = this.paint(fineContext(canvas), canvas.clientWidth, canvas.clientHeight);
    const { withheld } = this.charts;
    const hidden = this.pair.filter((name) => withheld?.[name]).map((name) => `${words(name)} withheld: ${withheld[name]}`);
    this.text.textContent = belief ? `correlation ${compact(belief.cov[1] / Math.sqrt(belief.cov[0] * belief.cov[2]), 2)}` : hidden.join("; ");
  }

  // As a file.
  svg(lines) {
    return svgFile(FILE, lines, [], (...drawing) => this.paint(...drawing), 1);
  }

  // Draw in pixels of the page; returns the estimate that was drawn, or null.
  paint(ctx, width, height) {
    const [from, to] = within(this.stream.x, this.charts.range);
    const [mx, tx, my, ty] = this.pair.flatMap((name) => [this.stream.column(`mean:${name}`), this.stream.column(`truth:${name}`)]);
    const { belief } = this;
    const places = [];
    for (let k = from; k <= to; k++) if (typeof mx[k] === "number" && typeof my[k] === "number") places.push([mx[k], my[k]]);
    const truth = [];
    let [lastX, lastY] = [null, null];
    for (let k = from; k <= to; k++) {
      lastX = tx[k] ?? lastX;
      lastY = ty[k] ?? lastY;
      if ((tx[k] !== null || ty[k] !== null) && lastX !== null && lastY !== null) truth.push([lastX, lastY]);
    }
    const ellipses = belief ? [1, 2].map((size) => ellipse(belief, size)) : [];
    const axes = new Axes(ctx, width, height, [...places, ...truth, ...(ellipses[1] ?? [])], this.model.states, this.pair);
    axes.frame();
    axes.dots(belief?.points ?? [], "quiet", 1.5);
    axes.curve(truth, "truth", 1.5, [5, 3]);
    axes.curve(places, "estimate", 1.5);
    for (const outline of ellipses) axes.curve(outline, "estimate", 1.25);
    if (belief) axes.dots([belief.mean], "estimate", 3.5);
    return belief;
  }
}

// The outline of an ellipse of so many σ: its covariance is [a, b, c] of [[a, b], [b, c]].
function ellipse({ mean, cov }, size) {
  const [a, b, c] = cov;
  const middle = (a + c) / 2;
  const root = Math.hypot((a - c) / 2, b);
  const [major, minor] = [Math.sqrt(Math.max(0, middle + root)), Math.sqrt(Math.max(0, middle - root))];
  const angle = Math.atan2(2 * b, a - c) / 2;
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  return Array.from({ length: 73 }, (_, k) => {
    const turn = (k / 72) * 2 * Math.PI;
    const [u, v] = [size * major * Math.cos(turn), size * minor * Math.sin(turn)];
    return [mean[0] + u * cos - v * sin, mean[1] + u * sin + v * cos];
  });
}

class Axes {
  constructor(ctx, width, height, points, states, pair) {
    Object.assign(this, { ctx, width, height });
    ctx.font = "11px system-ui, sans-serif";
    this.labels = pair.map((name) => {
      const state = states.find((item) => item.name === name);
      return `${words(state.label)} ${bracketed(state.unit)}`.trim();
    });
    const units = pair.map((name) => states.find((item) => item.name === name).unit);
    this.spans = [0, 1].map((k) => {
      const values = points.map((point) => point[k]);
      const [low, high] = values.length ? [Math.min(...values), Math.max(...values)] : [0, 1];
      const margin = 0.06 * (high - low) || Math.max(1e-9, Math.abs(high) * 1e-3);
      return [low - margin, high + margin];
    });
    // Lengths in metres are as long in both directions.
    if (units[0] === units[1] && units[0] === "m") this.even();
  }

  even() {
    const rooms = [this.width - ROOM.left - ROOM.right, this.height - ROOM.top - ROOM.bottom];
    const scale = Math.max(...this.spans.map(([low, high], k) => (high - low) / rooms[k]));
    this.spans = this.spans.map(([low, high], k) => {
      const [middle, half] = [(low + high) / 2, (scale * rooms[k]) / 2];
      return [middle - half, middle + half];
    });
  }

  place([x, y]) {
    const [[left, right], [low, high]] = this.spans;
    return [
      ROOM.left + ((x - left) / (right - left)) * (this.width - ROOM.left - ROOM.right),
      this.height - ROOM.bottom - ((y - low) / (high - low)) * (this.height - ROOM.top - ROOM.bottom),
    ];
  }

  frame() {
    const [right, bottom] = [this.width - ROOM.right, this.height - ROOM.bottom];
    for (const value of ticks(...this.spans[0], 4)) {
      const [x] = this.place([value, 0]);
      stroke(this.ctx, [[x, ROOM.top], [x, bottom]], "grid", 1);
      this.text(compact(value), [x, bottom + 13]);
    }
    for (const value of ticks(...this.spans[1], 5)) {
      const [, y] = this.place([0, value]);
      stroke(this.ctx, [[ROOM.left, y], [right, y]], "grid", 1);
      this.text(compact(value), [ROOM.left - 5, y + 4], "right");
    }
    this.text(this.labels[0], [(ROOM.left + right) / 2, this.height - 5]);
    this.text(this.labels[1], [10, (ROOM.top + bottom) / 2], "center", true);
  }

  text(words, [x, y], align = "center", upright = false) {
    const { ctx } = this;
    ctx.save();
    ctx.fillStyle = colour("faint");
    ctx.textAlign = align;
    ctx.translate(x, y);
    if (upright) ctx.rotate(-Math.PI / 2);
    ctx.fillText(words, 0, 0);
    ctx.restore();
  }

  curve(points, tone, width, dash) {
    stroke(this.ctx, points.map((point) => this.place(point)), tone, width, dash);
  }

  dots(points, tone, radius) {
    const ctx = clipped({ ctx: this.ctx, bbox: { left: ROOM.left, top: ROOM.top, width: this.width - ROOM.left - ROOM.right, height: this.height - ROOM.top - ROOM.bottom } });
    ctx.fillStyle = colour(tone);
    for (const point of points) {
      ctx.beginPath();
      ctx.arc(...this.place(point), radius, 0, 2 * Math.PI);
      ctx.fill();
    }
    ctx.restore();
  }
}

// About so many round numbers in a span.
const ticks = (low, high, about) => multiples(low, high, rounded((high - low) / about));
