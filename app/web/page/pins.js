// Pinned runs on the charts: their lines over those of each state, and beneath them by how much they differ from what
// runs. The head of that chart is their legend.

import { Chart, clipped, colour } from "./chart.js";
import { element, setText } from "./dom.js";
import { bracketed, compact } from "./format.js";
import { Lane } from "./lane.js";
import { Range, within } from "./ranges.js";

// A colour of its own for each place, and a dash for who cannot tell the colours apart.
export const DASHES = [[], [9, 3], [3, 2], [10, 3, 2, 3]];
const REACH = 1; // spans of a chart's own by which pinned runs may widen its axis to either side

export class Pins {
  constructor(charts, model, link, actions) {
    Object.assign(this, { charts, model, link });
    this.pinned = []; // {number, place, name, running, lane, less}
    this.state = model.states.find((state) => !state.rows.length) ?? model.states[0];
    const range = new Range();
    this.chart = new Chart(
      {
        key: "difference", title: "pinned − running", unit: bracketed(this.state.unit), weight: 1,
        series: [{ show: false }],
        data: () => [charts.range, [null, null]],
        filled: () => this.pinned.some((pin) => pin.less?.x.length),
        extras: () => this.curves("less", this.state),
        over: (plot) => this.pinned.forEach((pin) => trace(plot, pin.less, this.state, pin.place)),
        range: () => {
          const [low, high] = this.extent("less", this.state.name);
          return range.fit(Math.min(0, low), Math.max(0, high));
        },
        says: () => this.read(),
      },
      actions,
    );
    this.select = element("select", { "aria-label": "State whose difference is shown", onchange: () => this.choose(this.select.value) },
      ...model.states.map((state) => element("option", { value: state.name, selected: state === this.state }, state.label)));
    this.legend = element("ul", { class: "pins", "aria-label": "Pinned runs" });
    this.chart.head.children[0].after(this.select);
    this.chart.head.querySelector(".space").before(this.legend);
    this.chart.node.classList.add("difference");
    this.chart.node.hidden = true;
    charts.node.after(this.chart.node);
    link.addEventListener("status", (event) => this.told(event.detail));
  }

  told(status) {
    const pinned = status.runs?.pinned ?? [];
    const key = JSON.stringify(pinned);
    if (key === this.key) return;
    this.key = key;
    for (const pin of this.pinned) if (!pinned.some((item) => item.number === pin.number && !item.running)) this.close(pin);
    this.pinned = pinned.map((item) => ({ lane: new Lane(), less: new Lane(), reading: element("output", {}), ...this.pinned.find((pin) => pin.number === item.number), ...item }));
    this.legend.replaceChildren(
      ...this.pinned.map((pin) =>
        element("li", { style: `color: var(--pin-${pin.place})` },
          swatch(pin.place), element("span", {}, `${pin.number}${pin.name ? ` ${pin.name}` : ""}${pin.running ? " (runs)" : ""}`), pin.reading,
          element("button", { type: "button", title: `Unpin run ${pin.number}`, "aria-label": `Unpin run ${pin.number}`, onclick: () => this.link.ask("Unpin", { number: pin.number }) }, "×")),
      ),
    );
    this.chart.node.hidden = !this.pinned.length;
    if (this.pinned.length && !this.chart.plot) {
      this.chart.span = this.charts.range;
      this.chart.begin();
    }
    this.ask(this.place);
    this.charts.draw();
  }

  close(pin) {
    pin.asked = null;
    this.link.look(`run ${pin.number}`, null);
    this.link.look(`less ${pin.number}`, null);
  }

  choose(name) {
    this.state = this.model.states.find((state) => state.name === name);
    setText(this.chart.head.querySelector(".unit"), bracketed(this.state.unit));
    this.ask(this.place);
  }

  // Lanes for the same stretch of time as the charts' own; place: {since, until, span, points}, null for none
  ask(place) {
    this.place = place;
    if (!place) {
      for (const pin of this.pinned) if (pin.asked) this.close(pin);
      return;
    }
    const columns = this.model.states.map((state) => `mean:${state.name}`);
    const own = [`mean:${this.state.name}`];
    for (const pin of this.pinned) {
      const wanted = JSON.stringify([place, own]);
      if (pin.running || pin.asked === wanted) continue;
      pin.asked = wanted;
      this.link.look(`run ${pin.number}`, { ...place, run: String(pin.number), columns }, (...frame) => pin.lane.take(...frame));
      this.link.look(`less ${pin.number}`, { ...place, run: `difference:${pin.number}`, columns: own }, (...frame) => pin.less.take(...frame));
    }
  }

  show(range) {
    if (this.pinned.length) this.chart.show([range, [null, null]], range);
  }

  // Beneath the lines of a state's own chart.
  draw(plot, state) {
    for (const pin of this.pinned) trace(plot, pin.lane, state, pin.place);
  }

  // The same as curves of a file.
  curves(which, state) {
    return this.pinned.map((pin) => {
      const [from, to] = pin[which].x.length ? within(pin[which].x, this.charts.range) : [0, -1];
      const values = pin[which].column(`mean:${state.name}`).slice(from, to + 1);
      return { name: `run ${pin.number}${pin.name ? ` ${pin.name}` : ""}`, tone: `pin-${pin.place}`, dash: DASHES[pin.place], x: pin[which].x.slice(from, to + 1), values };
    });
  }

  // Lowest and highest that is shown of a state; of all pinned runs.
  extent(which, name) {
    let [low, high] = [Infinity, -Infinity];
    for (const pin of this.pinned) {
      const values = pin[which].column(`mean:${name}`);
      if (!values.length) continue;
      const [from, to] = within(pin[which].x, this.charts.range);
      for (let k = from; k <= to; k++) {
        if (typeof values[k] !== "number") continue;
        low = Math.min(low, values[k]);
        high = Math.max(high, values[k]);
      }
    }
    return [low, high];
  }

  // The axis of a state's chart, widened for them, but not by one that is far off.
  widened(low, high, name) {
    const [under, over] = this.extent("lane", name);
    const reach = REACH * (high - low);
    return [Math.min(low, Math.max(under, low - reach)), Math.max(high, Math.min(over, high + reach))];
  }

  // What the differences are at the cursor, else at the end: each beside its name in the legend.
  read() {
    const at = this.chart.plot.cursor.left >= 0 ? this.chart.plot.posToVal(this.chart.plot.cursor.left, "x") : (this.charts.view.at ?? Infinity);
    for (const pin of this.pinned) {
      const values = pin.less.column(`mean:${this.state.name}`);
      const index = pin.less.x.findLastIndex((x, k) => x <= at && typeof values[k] === "number");
      setText(pin.reading, index < 0 ? "" : compact(values[index], 2));
    }
    return "";
  }
}

// The line of a run as its legend shows it.
export function swatch(place) {
  const line = element("svg:svg", { class: "swatch", width: 22, height: 8, "aria-hidden": "true" });
  line.append(element("svg:line", { x1: 0, y1: 4, x2: 22, y2: 4, stroke: `var(--pin-${place})`, "stroke-width": 2, "stroke-dasharray": DASHES[place].join(" ") || null }));
  return line;
}

// Draw a lane's mean of a state; its points stand at times of their own. An angle has no line from π to -π.
function trace(plot, lane, state, place) {
  const round = 2 * Math.PI;
  const mean = lane.column(`mean:${state.name}`);
  const values = state.circular ? mean.map((value) => (typeof value === "number" ? value - round * Math.round(value / round) : value)) : mean;
  const { min, max } = plot.scales.x;
  const ctx = clipped(plot);
  ctx.strokeStyle = colour(`pin-${place}`);
  ctx.lineWidth = 1.5 * devicePixelRatio;
  ctx.setLineDash(DASHES[place].map((length) => length * devicePixelRatio));
  ctx.beginPath();
  let open = false;
  const [from, to] = lane.x.length ? within(lane.x, [min, max]) : [0, -1];
  for (let k = Math.max(0, from - 1); k <= Math.min(lane.x.length - 1, to + 1); k++) {
    if (typeof values[k] !== "number") {
      open = false;
      continue;
    }
    const [x, y] = [plot.valToPos(lane.x[k], "x", true), plot.valToPos(values[k], "y", true)];
    if (open && !(state.circular && Math.abs(values[k] - values[k - 1]) > Math.PI)) ctx.lineTo(x, y);
    else ctx.moveTo(x, y);
    open = true;
  }
  ctx.stroke();
  ctx.restore();
}
