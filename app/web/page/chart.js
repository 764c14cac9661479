// One chart: a canvas of uPlot's with a line above it that says what it is and what it reads at the cursor.

import { element, setText } from "./dom.js";
import { drawOutsiders } from "./edges.js";
import { compact } from "./format.js";
import { within } from "./ranges.js";

export const GAP = 52; // px for the labels of the value axis
export const CURSOR = "time";

const styles = getComputedStyle(document.documentElement);
export const colour = (name) => styles.getPropertyValue(`--${name}`).trim();

// A value of the value axis in words.
export const amount = (what, value) => what.amount?.(value) ?? `${compact(value, 3)} ${what.unit.replace(/^\[|\]$/g, "")}`.trim();

// The context of a plot in which nothing leaves its frame, until it is restored.
export function clipped({ ctx, bbox }) {
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  return ctx;
}

// What uPlot draws, and for a file: the name of its colour, and which mark it is.
export const line = (name, options = {}) => ({
  mark: "line", tone: name, stroke: () => colour(name), width: 1.5, points: { show: false }, spanGaps: false, ...options,
});

export const edge = (options = {}) => ({ stroke: () => "transparent", width: 0, points: { show: false }, ...options });

export const band = (name, series) => ({ series, tone: name, fill: () => colour(name) });

export const dots = (name, size = 4, ring = false) => ({
  mark: "dots", tone: name, ring, stroke: () => colour(name),
  paths: () => null,
  points: { show: true, size, width: ring ? 1.5 : 0, stroke: () => colour(name), fill: () => (ring ? "transparent" : colour(name)) },
});

export class Chart {
  // what: {title, unit, note, weight, series, bands, range(self, low, high), scale, draw: [hook], values: [label of a tick],
  // sync: charts of one name share their cursor, names: what a file calls its colours, help: on what it reads, extras: more lines of a file,
  // amount(value): a value in words, where the axis is no plain one; filled(): whether it draws beside its data}
  constructor(what, { select, home, wheel, save }) {
    this.what = what;
    this.reading = element("output", { class: "reading", title: what.help });
    this.head = element(
      "header", {},
      element("b", {}, what.title), element("span", { class: "unit" }, what.unit ?? ""),
      what.note ? element("span", { class: "note" }, what.note) : null,
      element("span", { class: "space" }), this.reading,
      save ? element("button", { type: "button", class: "save", title: "Save this chart", "aria-label": `Save the chart of ${what.title}`, "aria-haspopup": "menu", onclick: (event) => save(this, event.currentTarget) }, "⤓") : null,
    );
    this.canvas = element("div", { class: "plot" });
    this.node = element("article", { class: "chart", style: `--weight:${what.weight}`, "aria-label": `Chart of ${what.title}` }, this.head, this.canvas);
    this.data = [[], ...what.series.map(() => [])];
    this.actions = { select, home, wheel };
    this.visible = true;
    this.empty = true;
  }

  // Once it is in the page, and has a size.
  begin() {
    const { what } = this;
    this.plot = new uPlot(
      {
        width: Math.max(50, this.canvas.clientWidth),
        height: Math.max(40, this.canvas.clientHeight),
        legend: { show: false },
        padding: [6, 10, null, 0],
        cursor: {
          sync: { key: what.sync ?? CURSOR, scales: ["x", null] },
          drag: { x: true, y: false, setScale: false },
          points: { show: false },
          y: false,
          bind: { dblclick: () => () => (this.actions.home(), null) },
        },
        scales: {
          x: { time: false, range: () => this.span },
          y: { ...what.scale, range: (self, low, high) => what.range(this, low, high) },
        },
        axes: [
          { ...axis(), size: 3, values: (self, splits) => splits.map(() => null) }, // time stands below all charts
          { ...axis(), size: GAP, splits, values: (self, values) => (this.empty ? [] : values.map((value) => compact(value, 7))), ...(what.axis ?? {}) },
        ],
        series: [{}, ...what.series],
        bands: what.bands ?? [],
        hooks: {
          setSelect: [(self) => this.selected(self)],
          drawAxes: what.under ? [(self) => what.under(self, this)] : [],
          drawSeries: what.between ? [(self, series) => what.between(self, series)] : [],
          draw: [(self) => what.over?.(self, this), (self) => this.outside(self)],
          setCursor: [(self) => this.pointed(self)],
        },
      },
      this.data,
      this.canvas,
    );
    this.plot.over.addEventListener("wheel", (event) => this.actions.wheel(event, this.plot), { passive: false });
    this.sized = new ResizeObserver(() => {
      const { clientWidth: width, clientHeight: height } = this.canvas;
      if (width > 0 && height > 0 && (width !== this.plot.width || height !== this.plot.height)) this.plot.setSize({ width, height });
    });
    this.sized.observe(this.canvas);
    this.seen = new IntersectionObserver(([entry]) => {
      this.visible = entry.isIntersecting;
      if (this.visible && this.waiting) this.draw();
    });
    this.seen.observe(this.node);
  }

  // span: seconds at both ends of the axis; moment: that which is looked at, or null; origin-based times in data[0].
  show(data, span, moment = null) {
    this.data = data;
    this.span = span;
    this.moment = moment;
    if (this.visible) this.draw();
    else this.waiting = true;
  }

  draw() {
    this.waiting = false;
    this.empty = !this.what.filled?.() && !this.data.slice(1).some((values) => values.some((value) => typeof value === "number"));
    this.plot.batch(() => {
      this.plot.setData(this.data, false);
      this.plot.setScale("x", { min: this.span[0], max: this.span[1] });
    });
    this.pointed(this.plot);
  }

  // uPlot fires this hook for every chart that shares the cursor; only the dragged one has a pointer event.
  selected(self) {
    const { left, width } = self.select;
    const ends = [self.posToVal(left, "x"), self.posToVal(left + width, "x")];
    self.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    if (width < 4 || !self.cursor.event) return;
    this.actions.select(...ends);
  }

  // What the line above says: at the cursor, else at the moment that is looked at, else of the newest row.
  pointed(self) {
    const { left, idx } = self.cursor;
    const [x] = this.data;
    const here = this.moment === null || this.moment === undefined ? x.length - 1 : within(x, [-Infinity, this.moment])[1];
    const at = left >= 0 && idx !== null && idx !== undefined ? idx : here;
    setText(this.reading, at < 0 ? "" : this.what.says((series) => this.at(series, at)));
  }

  // What does not fit the axis is marked at its edge.
  outside(self) {
    this.outsiders = drawOutsiders(self, this.what.series, (value) => amount(this.what, value), colour);
  }

  // The value of a series there, or the last one before it.
  at(series, index) {
    const values = this.data[series];
    for (let k = index; k >= Math.max(0, index - 64); k--) if (typeof values?.[k] === "number") return values[k];
    return NaN;
  }

  end() {
    this.sized?.disconnect();
    this.seen?.disconnect();
    this.plot?.destroy();
    this.node.remove();
  }
}

const LABEL = 15; // px from one label of the value axis to the next, at least
const ROOMY = 26; // px where there is room

// Round values along the value axis: two of them at least, or a low chart would say nothing of its scale.
function splits(self, axis, low, high) {
  const height = self.over.clientHeight || self.bbox.height / devicePixelRatio;
  if (!(high > low) || !(height > 0)) return [low];
  const per = (high - low) / height;
  const [wide, narrow] = [multiples(low, high, rounded(ROOMY * per)), multiples(low, high, rounded(LABEL * per))];
  if (wide.length > 1) return wide;
  if (narrow.length > 1) return narrow;
  const fine = multiples(low, high, rounded((high - low) / 20));
  return [fine[0], fine[fine.length - 1]];
}

const multiples = (low, high, step) => {
  const first = Math.ceil(low / step - 1e-9);
  const count = Math.floor(high / step + 1e-9) - first + 1;
  return Array.from({ length: count }, (_, k) => Number(((first + k) * step).toPrecision(12)));
};

// The smallest of 1, 2, 5 · 10ⁿ that is at least so much.
function rounded(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].find((factor) => factor * power >= least * (1 - 1e-9)) * power;
}

// Those of some values, in the order of their weight, whose labels do not lie on each other.
export function apart(values, self, scale) {
  const height = self.over.clientHeight || self.bbox.height / devicePixelRatio;
  const { min, max } = self.scales[scale];
  const least = (LABEL * (max - min)) / height;
  const found = [];
  for (const value of values) if (found.every((other) => Math.abs(other - value) >= least)) found.push(value);
  return found.sort((a, b) => a - b);
}

export const axis = () => ({
  stroke: () => colour("faint"),
  font: "11px system-ui, sans-serif",
  grid: { stroke: () => colour("grid"), width: 1 },
  ticks: { show: false },
  gap: 4,
});
