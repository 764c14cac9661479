// One chart over time: a canvas of uPlot's, below a line with its name and its values at the cursor. A chart is declared
// by an object, with columns by name; the page, its SVG files and the HTML report draw it by this file.
//
//   key, title, unit, note, help       help: tooltip of the values
//   control                            element in its head
//   weight                             share of the height
//   columns                            columns of the main stream that it needs
//   series                             {name: line() | dots() | edge()}, drawn in this order
//   bands                              [band(tone, upper, lower)], by names of series
//   data()                             {x, name: values}; times in seconds since the first event
//   range(data, span)                  [low, high] of the value axis
//   says(value)                        text of the values at the cursor; value(name) is a number or NaN
//   curves()                           curves of other streams (drawing.js): drawn above the bands, `over: true` on top
//   paint(plot), over(plot)            further drawings, behind and on top of everything
//   axis, amount(value)                labels of the value axis, a value as text; where the axis is not a plain one
//   filled()                           whether it shows something without data of its own
//   names                              {tone: legend text} of a file, where it differs from NAMES; "" for none
//   ramp()                             colour bar of a picture in its head: {colors, low, high}
//   further                            hidden at first
//   sync                               charts of one name share their cursor

import { element, setAttribute, setText } from "./dom.js";
import { colour, drawNotes, drawOutsiders, trace, writeNotes } from "./drawing.js";
import { bracketed, clock, compact, decimals, fixed, spaced } from "./format.js";
import { within } from "./ranges.js";
import { drawnOn, svgFile } from "./svg.js";

const LABELS = 52; // px for the labels of the value axis
const TIME = 22; // px for those of the time axis
const FILE = [960, 330]; // px of a file
const MIN_DRAG = 4; // px, from which a click is a drag
const NEAR_NOTE = 6; // px from a note at which its text is shown

const NAMES = {
  estimate: "estimate", truth: "truth", reading: "measurement", "reading ring": "held out", refused: "rejected",
  "refused ring": "implausible", bound: "bounds", quiet: "single value", band: "± 2σ", "band-noise": "of which noise", bounds: "bounds",
};

export const line = (tone, options = {}) => ({
  mark: "line", tone, stroke: () => colour(tone), width: 1.5, points: { show: false }, spanGaps: false, ...options,
});

export const edge = () => ({ stroke: () => "transparent", width: 0, points: { show: false } });

// Where there are many, they are drawn smaller and see-through (`sparse`), so that the band beneath stays visible.
export const dots = (tone, size = 4, ring = false) => ({
  mark: "dots", tone, ring, size, sparse: 1, stroke: () => colour(tone),
  paths: () => null,
  points: {
    show: true, size, width: ring ? 1.5 : 0, stroke: () => colour(tone),
    fill: (self, k) => (ring ? "transparent" : faded(colour(tone), self.series[k].sparse)),
  },
});

const DENSE = 0.25; // dots a px of width, from which on they are drawn smaller
const SMALLEST = 2; // px
const FAINTEST = 0.55; // opacity

const faded = (tone, sparse) => (sparse < 1 && /^#.{6}$/.test(tone) ? tone + Math.round(255 * Math.max(FAINTEST, sparse)).toString(16).padStart(2, "0") : tone);

// Sizes of the dots of a plot for their number in view.
function thin(self) {
  const { min, max } = self.scales.x;
  const [x] = self.data;
  if (!x.length) return;
  const [from, to] = within(x, [min, max]);
  const width = self.over.clientWidth || self.bbox.width / devicePixelRatio;
  self.series.forEach((series, k) => {
    if (series.mark !== "dots") return;
    let count = 0;
    for (let i = from; i <= to; i++) if (typeof self.data[k]?.[i] === "number") count += 1;
    series.sparse = Math.min(1, Math.sqrt((DENSE * width) / Math.max(1, count)));
    series.points.size = Math.max(Math.min(SMALLEST, series.size), series.size * series.sparse);
  });
}

export const band = (tone, upper, lower) => ({ tone, edges: [upper, lower] });

// "magnet [°C]"
export const heading = (what) => `${what.title} ${bracketed(what.unit)}`.trim();

// kinds: modules of the folder charts. Gives the declarations of all charts, from top to bottom; see chart.js.
export const declared = (kinds, context) => kinds.toSorted((a, b) => a.order - b.order).flatMap((kind) => kind.default(context));

export class Chart {
  // select(since, until), home(), wheel(event, plot), save(chart, button), note(seconds, there), hover(seconds): on gestures
  constructor(what, { select, home, wheel, save, note, hover } = {}) {
    this.what = what;
    this.names = Object.keys(what.series);
    this.reading = element("output", { class: "reading", title: what.help });
    this.ramp = what.ramp && element("span", { class: "ramp", role: "img" }, element("span"), element("i", { style: `background: linear-gradient(to right, ${what.ramp().colors.join()})` }), element("span"));
    this.grade = element("span", { class: "grade", hidden: true });
    this.head = element(
      "header", {},
      this.grade, element("h3", {}, what.title), element("span", { class: "unit" }, bracketed(what.unit)),
      what.note ? element("span", { class: "note" }, what.note) : null,
      what.control ?? null, this.ramp ?? null,
      element("span", { class: "space" }), this.reading,
      save ? element("button", { type: "button", class: "save", title: "Save this chart", "aria-label": `Save the chart of ${what.title}`, "aria-haspopup": "menu", onclick: (event) => save(this, event.currentTarget) }, "⤓") : null,
    );
    this.canvas = element("div", { class: "plot" });
    this.node = element("article", { class: "chart", style: `--weight:${what.weight}`, dataset: { kind: what.key.split(":")[0] }, "aria-label": `Chart of ${what.title}` }, this.head, this.canvas);
    this.data = { x: [], ...Object.fromEntries(this.names.map((name) => [name, []])) };
    this.actions = { select, home, wheel, note, hover };
    this.notes = []; // notes of users, [{from, text}] by time
    this.visible = true;
    this.empty = true;
  }

  // Mark a state that is not tracking, and why.
  graded({ grade, reason }, sign) {
    this.grade.hidden = ["tracking", "waiting"].includes(grade);
    this.grade.dataset.health = grade;
    setText(this.grade, sign);
    setAttribute(this.grade, "title", `${grade}${reason ? `: ${reason}` : ""}`);
  }

  // Once it is in the page, and has a size. withTime: labels of time below it.
  begin(withTime = false) {
    const options = this.options(Math.max(50, this.canvas.clientWidth), Math.max(40, this.canvas.clientHeight), withTime);
    this.plot = new uPlot(
      {
        ...options,
        cursor: {
          sync: { key: this.what.sync ?? "time", scales: ["x", null] },
          drag: { x: true, y: false, setScale: false },
          points: { show: false },
          y: false,
          bind: { dblclick: () => () => (this.actions.home?.(), null) },
        },
        hooks: {
          ...options.hooks,
          setSelect: [(self) => this.selected(self)],
          setCursor: [(self) => (this.actions.hover?.(hoveredTime(self)), this.pointed(self))],
        },
      },
      this.table,
      this.canvas,
    );
    if (this.actions.wheel) this.plot.over.addEventListener("wheel", (event) => this.actions.wheel(event, this.plot), { passive: false });
    if (this.actions.note) {
      let pressed = 0; // px; a drag zooms, and is no click
      this.plot.over.addEventListener("pointerdown", (event) => (pressed = event.clientX));
      this.plot.over.addEventListener("click", (event) => event.altKey && Math.abs(event.clientX - pressed) < MIN_DRAG && this.actions.note(this.plot.posToVal(event.offsetX, "x"), this.notesAt(event.offsetX)[0]));
    }
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

  // Options of uPlot. The axes and marks of a file are the page's.
  options(width, height, withTime) {
    const { what } = this;
    const index = (name) => this.names.indexOf(name) + 1;
    const bands = what.bands ?? [];
    const last = Math.max(0, ...bands.flatMap(({ edges }) => edges.map(index)));
    let curves = [];
    const draw = (self, over) => curves.forEach((curve) => Boolean(curve.over) === over && trace(self, curve));
    return {
      width, height,
      legend: { show: false },
      padding: [6, 10, null, 0],
      scales: {
        x: { time: false, range: () => this.span },
        y: { range: () => what.range(this.data, this.span) },
      },
      axes: [
        withTime ? timeAxis() : { ...axis(), size: 6, values: (self, splits) => splits.map(() => null) },
        { ...axis(), size: LABELS, splits, values: (self, values) => (this.empty ? [] : values.map((value) => compact(value, 7))), ...(what.axis ?? {}) },
      ],
      series: [{}, ...Object.values(what.series)],
      bands: bands.map(({ tone, edges }) => ({ series: edges.map(index), fill: () => colour(tone) })),
      hooks: {
        drawClear: [thin],
        drawAxes: [(self) => what.paint?.(self), (self) => ((curves = what.curves?.() ?? []), last || draw(self, false))],
        drawSeries: [(self, series) => series === last && draw(self, false)],
        draw: [
          (self) => draw(self, true),
          (self) => what.over?.(self),
          (self) => drawNotes(self, this.notes),
          (self) => (this.outsiders = drawOutsiders(self, Object.values(what.series), (value) => this.amount(value))),
          (self) => (this.written = this.naming ? writeNotes(self, this.notes, this.moment ?? null, this.outsiders.some((mark) => mark.above && mark.furthest)) : []),
        ],
      },
    };
  }

  get table() {
    const { x } = this.data;
    return [x, ...this.names.map((name) => this.data[name] ?? new Array(x.length).fill(null))];
  }

  // span: seconds at both ends of the axis; moment: that which is looked at, or null; naming: with the texts of notes.
  show(data, span, moment = null, notes = [], naming = false) {
    Object.assign(this, { data, span, moment, notes, naming });
    if (this.visible) this.draw();
    else this.waiting = true;
  }

  draw() {
    this.waiting = false;
    const { table } = this;
    this.empty = !this.what.filled?.() && !table.slice(1).some((values) => values.some((value) => typeof value === "number"));
    this.plot.batch(() => {
      this.plot.setData(table, false);
      this.plot.setScale("x", { min: this.span[0], max: this.span[1] });
    });
    this.pointed(this.plot);
    if (this.ramp) this.scale();
  }

  // Both ends of the colour bar, with the unit.
  scale() {
    const { low, high } = this.what.ramp();
    // Of a narrow scale, three digits would write both ends alike.
    const text = (end) => (high > low && compact(low, 3) === compact(high, 3) ? fixed(end, decimals(high - low)) : compact(end, 3));
    const [from, to] = [low, high].map((end) => (Number.isFinite(end) ? text(end) : ""));
    setText(this.ramp.firstChild, from);
    setText(this.ramp.lastChild, to && `${to}${spaced(this.what.unit)}`);
    setAttribute(this.ramp, "aria-label", `Colours of ${heading(this.what)}: ${this.ramp.firstChild.textContent} to ${this.ramp.lastChild.textContent}`);
    setAttribute(this.ramp, "title", this.ramp.ariaLabel);
  }

  // uPlot fires this hook for every chart that shares the cursor; only the dragged one has a pointer event.
  selected(self) {
    const { left, width } = self.select;
    const ends = [self.posToVal(left, "x"), self.posToVal(left + width, "x")];
    self.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    if (width < MIN_DRAG || !self.cursor.event) return;
    this.actions.select?.(...ends);
  }

  // Show the values at the cursor, else at the moment that is looked at, else the newest ones. Where points are extremes
  // of groups of rows, `exact()` gives those of the row as text, null while it is not there; undefined: points are rows.
  pointed(self) {
    const { left, idx } = self.cursor;
    const { x } = this.data;
    const exact = this.exact?.();
    if (exact !== null) {
      const here = this.moment === null || this.moment === undefined ? x.length - 1 : within(x, [-Infinity, this.moment])[1];
      const at = hoveredTime(self) === null ? here : idx;
      setText(this.reading, exact ?? (at < 0 ? "" : this.what.says((name) => this.at(name, at))));
    }
    setAttribute(self.over, "title", this.notesAt(left).map((note) => `${clock(note.from, 1)} ${note.text}`).join("\n") || null);
  }

  // Notes at a place, px from the left.
  notesAt(left) {
    return left < 0 ? [] : this.notes.filter(({ from }) => Math.abs(this.plot.valToPos(from, "x") - left) < NEAR_NOTE);
  }

  // The value of a column there, or the last one before it.
  at(name, index, data = this.data, reach = 256) {
    const values = data[name];
    for (let k = index; k >= Math.max(0, index - reach); k--) if (typeof values?.[k] === "number") return values[k];
    return NaN;
  }

  // A value of the value axis as text.
  amount(value) {
    return this.what.amount?.(value) ?? `${compact(value, 3)}${spaced(this.what.unit)}`;
  }

  // The chart as the text of an SVG file, as it is shown now, with the texts of notes.
  svg(lines, size = FILE) {
    const { naming } = this;
    this.naming = true;
    const text = svgFile(size, lines, this.legend, (context, width, height) => {
      const options = this.options(width, height, true);
      const { min, max } = this.plot.scales.y;
      options.scales.y.range = () => [min, max];
      const plot = drawnOn(context, () => new uPlot({ ...options, pxAlign: 0, cursor: { show: false } }, this.table));
      plot.batch(() => plot.setScale("x", { min: this.span[0], max: this.span[1] }));
      plot.destroy();
    });
    this.naming = naming;
    return text;
  }

  // Legend of a file: [[text, style]] of everything that has values.
  get legend() {
    const { what } = this;
    const found = new Map();
    const add = (text, style) => text && !found.has(text) && found.set(text, style);
    const named = (key) => what.names?.[key] ?? NAMES[key] ?? key;
    const shown = (name) => this.data[name]?.some((value) => typeof value === "number");
    for (const { tone, edges } of what.bands ?? []) if (shown(edges[0])) add(named(tone), { tone, mark: "area" });
    for (const [name, style] of Object.entries(what.series)) if (style.mark && shown(name)) add(named(style.ring ? `${style.tone} ring` : style.tone), style);
    for (const curve of what.curves?.() ?? []) if (curve.x.length) add(curve.legend, { ...curve, mark: curve.fill ? "area" : "line" });
    if (this.ramp) add(`${this.ramp.firstChild.textContent} to ${this.ramp.lastChild.textContent}`, { mark: "ramp", colors: what.ramp().colors });
    return [...found];
  }

  end() {
    this.sized?.disconnect();
    this.seen?.disconnect();
    this.plot?.destroy();
    this.node.remove();
  }
}

// Time at the pointer, s; null where it is elsewhere.
const hoveredTime = ({ cursor, posToVal }) => (cursor.left >= 0 && cursor.idx !== null && cursor.idx !== undefined ? posToVal(cursor.left, "x") : null);

// Value axis

const LABEL = 15; // px from one label of the value axis to the next, at least
const ROOMY = 26; // px where there is room

// Round values along the value axis: two of them at least, or a low chart would have no scale.
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

export const multiples = (low, high, step) => {
  const first = Math.ceil(low / step - 1e-9);
  const count = Math.floor(high / step + 1e-9) - first + 1;
  return Array.from({ length: count }, (_, k) => Number(((first + k) * step).toPrecision(12)));
};

// The smallest of 1, 2, 5 · 10ⁿ that is at least so much.
export function rounded(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].find((factor) => factor * power >= least * (1 - 1e-9)) * power;
}

// Those of some values, in the order of their weight, whose labels do not overlap.
export function apart(values, self, scale) {
  const height = self.over.clientHeight || self.bbox.height / devicePixelRatio;
  const { min, max } = self.scales[scale];
  const least = (LABEL * (max - min)) / height;
  const found = [];
  for (const value of values) if (found.every((other) => Math.abs(other - value) >= least)) found.push(value);
  return found.sort((a, b) => a - b);
}

const axis = () => ({
  stroke: () => colour("faint"),
  font: "11px system-ui, sans-serif",
  grid: { stroke: () => colour("grid"), width: 1 },
  ticks: { show: false },
  gap: 4,
});

// Time axis

const LABEL_OVERHANG_PX = 24; // px that a label at the right end may take from the axis to its left

// Steps of a clock, s.
const STEPS = [
  0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800,
  21600, 43200, 86400, 172800, 345600, 864000, 2592000, 8640000, 31536000,
];

const DAY = 86400; // s
const [CLOCK_PX, DAY_CLOCK_PX] = [60, 84]; // px of a label, without and with a day

const timeAxis = () => ({ ...axis(), size: TIME, values: clocks, incrs: STEPS, space: (self, k, low, high) => (high > DAY ? DAY_CLOCK_PX : CLOCK_PX) });

function clocks(self, splits) {
  const step = splits.length > 1 ? splits[1] - splits[0] : 1;
  const fraction = step >= 1 ? 0 : Math.min(3, Math.ceil(-Math.log10(step)));
  // One at the very end would be cut off.
  const last = self.posToVal((self.over.clientWidth || self.bbox.width / devicePixelRatio) + 10 - LABEL_OVERHANG_PX, "x");
  return splits.map((value) => (value > last ? "" : step >= DAY ? `${Math.round(value / DAY)} d` : clock(value, fraction)));
}

// Labels of time alone, below a stack of charts wherever it is scrolled to.
export class TimeAxis {
  constructor(node) {
    this.node = node;
    this.span = [0, 1];
    const height = TIME + 2;
    this.plot = new uPlot(
      {
        width: Math.max(50, node.clientWidth), height, padding: [0, 10, 0, 0],
        legend: { show: false }, cursor: { show: false },
        scales: { x: { time: false, range: () => this.span }, y: { range: () => [0, 1] } },
        axes: [timeAxis(), { ...axis(), size: LABELS, values: () => [], splits: () => [] }],
        series: [{}, { show: false }],
      },
      [[], []],
      node,
    );
    new ResizeObserver(() => this.plot.setSize({ width: node.clientWidth, height })).observe(node);
  }

  show(span) {
    this.span = span;
    this.plot.setData([span, [0, 0]], false);
    this.plot.setScale("x", { min: span[0], max: span[1] });
  }
}
