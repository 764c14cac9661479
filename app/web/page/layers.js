// Curves of other streams over the charts of states: the run before, the smoothed estimate, pinned runs; and the bands
// of the states that charts of groups draw strong. Each asks for the same stretch of time as the charts.

import { Chart } from "./chart.js";
import { angular, unbroken } from "./drawing.js";
import { $, changed, element, keyed, setText } from "./dom.js";
import { bracketed, compact } from "./format.js";
import { extent, Range, union, within } from "./ranges.js";
import { Stream } from "./stream.js";

const meanOf = (stream, state) => {
  const mean = stream.column(`mean:${state.name}`);
  return state.circular ? unbroken(mean) : mean;
};

export class Previous {
  constructor(charts, link) {
    this.charts = charts;
    this.stream = new Stream(link, "previous");
  }

  // place: {since, until, span, points}; null for nothing.
  ask(place) {
    const columns = this.charts.model.states.filter((state) => this.charts.shown(`state:${state.name}`)).map((state) => `mean:${state.name}`);
    this.stream.ask(place && { ...place, run: "previous", columns });
  }

  curves(state) {
    return [{ legend: "run before", tone: "previous", x: this.stream.x, values: meanOf(this.stream, state) }];
  }
}

// The estimate given the measurements after each moment too. The server smooths only while this is on.
export class Smoothed {
  constructor(charts, link) {
    this.charts = charts;
    this.stream = new Stream(link, "smoothed");
    this.on = !link || localStorage.getItem("nisus.smoothed") === "on";
    this.button = element("button", { type: "button", id: "smoothed", "aria-pressed": String(this.on), title: "Estimate that also uses later measurements", onclick: () => this.toggle() }, "Smoothed");
  }

  toggle() {
    this.on = !this.on;
    localStorage.setItem("nisus.smoothed", this.on ? "on" : "off");
    this.button.setAttribute("aria-pressed", String(this.on));
    this.stream.clear();
    this.ask(this.place);
    this.charts.draw();
  }

  ask(place) {
    this.place = place;
    const columns = this.charts.model.states.filter((state) => this.charts.shown(`state:${state.name}`)).flatMap((state) => ["lower", "mean", "upper"].map((kind) => `${kind}:${state.name}`));
    this.stream.ask(place && this.on && columns.length ? { ...place, run: "smoothed", columns } : null);
  }

  // A fine edge to either side of the mean.
  curves(state) {
    const { x } = this.stream;
    if (!this.on || !x.length) return [];
    const columns = Object.fromEntries(["lower", "upper", "mean"].map((kind) => [kind, this.stream.column(`${kind}:${state.name}`)]));
    return Object.entries(state.circular ? angular(columns, columns.mean) : columns).map(([kind, values]) =>
      ({ legend: kind === "mean" ? "smoothed" : "", tone: "smoothed", width: kind === "mean" ? 1.25 : 0.75, x, values }));
  }
}

// Bands of the states that charts of groups draw strong: asked for alone, as those of all would be many.
export class Strong {
  constructor(charts, link) {
    this.charts = charts;
    this.stream = new Stream(link, "strong");
    this.states = new Map(); // by the key of the chart
  }

  choose(key, name) {
    if (this.states.get(key) === name) return;
    this.states.set(key, name);
    this.ask(this.place);
  }

  ask(place) {
    this.place = place;
    const names = [...new Set([...this.states].flatMap(([key, name]) => (name && this.charts.shown(key) ? [name] : [])))].sort();
    this.stream.ask(place && names.length ? { ...place, columns: names.flatMap((name) => [`upper:${name}`, `lower:${name}`]) } : null);
  }

  edges(name) {
    return ["upper", "lower"].map((side) => this.stream.column(`${side}:${name}`));
  }
}

// Each place has its own colour, and its own dash beside the colour.
const DASHES = [[], [9, 3], [3, 2], [10, 3, 2, 3]];
const MAX_PIN_SPANS = 1; // spans of a chart's own by which pinned runs may widen its axis to either side

// Pinned runs: their lines on each state's chart, and below the charts their difference from the running one. The head
// of that chart is their legend.
export class Pins {
  constructor(charts, link, actions) {
    const { model } = charts;
    Object.assign(this, { charts, model, link });
    this.pinned = []; // {number, place, name, running, stream, less}
    this.state = model.states.find((state) => !state.rows.length) ?? model.states[0];
    const range = new Range();
    this.chart = new Chart(
      {
        key: "difference", title: "pinned − running", unit: this.state.unit, weight: 1,
        series: { none: { show: false } }, // a value axis needs one
        data: () => ({ x: charts.range }),
        filled: () => this.pinned.some((pin) => pin.less?.x.length),
        curves: () => this.curvesOf("less", this.state),
        range: () => range.fit(...union([0, 0], this.extent("less", this.state.name, charts.range))),
        says: () => this.read(),
      },
      actions,
    );
    this.select = element("select", { "aria-label": "State of the difference", onchange: () => this.choose(this.select.value) },
      ...model.states.map((state) => element("option", { value: state.name, selected: state === this.state }, state.label)));
    this.legend = element("ul", { class: "pins", "aria-label": "Pinned runs" });
    this.chart.head.children[0].after(this.select);
    this.chart.head.querySelector(".space").before(this.legend);
    this.chart.node.classList.add("difference");
    this.chart.node.hidden = true;
    charts.node.after(this.chart.node);
    link.addEventListener("status", (event) => this.update(event.detail));
  }

  update(status) {
    const pinned = status.runs?.pinned ?? [];
    if (!changed(this.legend, pinned)) return;
    for (const pin of this.pinned) if (!pinned.some((item) => item.number === pin.number && !item.running)) close(pin);
    this.pinned = pinned.map((item) => ({
      stream: new Stream(this.link, `run ${item.number}`), less: new Stream(this.link, `less ${item.number}`), reading: element("output", {}),
      ...this.pinned.find((pin) => pin.number === item.number), ...item,
    }));
    const entry = (pin) =>
      element("li", { style: `color: var(--pin-${pin.place})` },
        swatch(pin.place), element("span", {}), pin.reading,
        element("button", { type: "button", title: `Unpin run ${pin.number}`, "aria-label": `Unpin run ${pin.number}`, onclick: () => this.link.ask("Unpin", { number: pin.number }) }, "×"));
    keyed(this.legend, this.pinned, ({ number, place }) => `${number}/${place}`, entry).forEach((node, k) => {
      const { number, name, running } = this.pinned[k];
      setText(node.children[1], `${number}${name ? ` ${name}` : ""}${running ? " (running)" : ""}`);
    });
    // First in the legend of the charts, where the last entries give way.
    $("legend").querySelectorAll(".pinned").forEach((item) => item.remove());
    $("legend").prepend(...this.pinned.filter((pin) => !pin.running).map((pin) => element("li", { class: "pinned" }, swatch(pin.place), `run ${pin.number}${pin.name ? `: ${pin.name}` : ""}`)));
    this.chart.node.hidden = !this.pinned.length;
    if (this.pinned.length && !this.chart.plot) {
      this.chart.span = this.charts.range;
      this.chart.begin();
    }
    this.ask(this.place);
    this.charts.draw();
  }

  choose(name) {
    this.state = this.model.states.find((state) => state.name === name);
    setText(this.chart.head.querySelector(".unit"), bracketed(this.state.unit));
    this.ask(this.place);
  }

  ask(place) {
    this.place = place;
    const columns = this.model.states.map((state) => `mean:${state.name}`);
    for (const pin of this.pinned) {
      if (pin.running) continue;
      pin.stream.ask(place && { ...place, run: String(pin.number), columns });
      pin.less.ask(place && { ...place, run: `difference:${pin.number}`, columns: [`mean:${this.state.name}`] });
    }
  }

  show(range, notes) {
    if (this.pinned.length) this.chart.show({ x: range }, range, null, notes);
  }

  curves(state) {
    return this.curvesOf("stream", state);
  }

  curvesOf(which, state) {
    return this.pinned.map((pin) => ({
      legend: `run ${pin.number}${pin.name ? ` ${pin.name}` : ""}`, tone: `pin-${pin.place}`, dash: DASHES[pin.place], width: 1.5,
      x: pin[which].x, values: meanOf(pin[which], state),
    }));
  }

  // Lowest and highest of all pinned runs that is shown of a state.
  extent(which, name, span) {
    const streams = this.pinned.map((pin) => pin[which]).filter(({ x }) => x.length);
    return streams.map((stream) => extent([stream.column(`mean:${name}`)], ...within(stream.x, span))).reduce(union, [Infinity, -Infinity]);
  }

  // The axis of a state's chart, widened for them, but not by one that is far off.
  widened([low, high], state, span) {
    const [under, over] = this.extent("stream", state.name, span);
    const reach = MAX_PIN_SPANS * (high - low);
    return [Math.min(low, Math.max(under, low - reach)), Math.max(high, Math.min(over, high + reach))];
  }

  // The differences at the cursor, else at the end: each beside its name in the legend.
  read() {
    const { cursor } = this.chart.plot;
    const at = cursor.left >= 0 ? this.chart.plot.posToVal(cursor.left, "x") : (this.charts.view.at ?? Infinity);
    for (const pin of this.pinned) {
      const values = pin.less.column(`mean:${this.state.name}`);
      const index = pin.less.x.findLastIndex((x, k) => x <= at && typeof values[k] === "number");
      setText(pin.reading, index < 0 ? "" : compact(values[index], 2));
    }
    return "";
  }
}

function close(pin) {
  pin.stream.ask(null);
  pin.less.ask(null);
}

// The line of a run as its legend shows it.
export function swatch(place) {
  const line = element("svg:svg", { class: "swatch", width: 22, height: 8, "aria-hidden": "true" });
  line.append(element("svg:line", { x1: 0, y1: 4, x2: 22, y2: 4, stroke: `var(--pin-${place})`, "stroke-width": 2, "stroke-dasharray": DASHES[place].join(" ") || null }));
  return line;
}
