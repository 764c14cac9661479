// Which charts are shown, in which order and how high: chosen in a menu, kept in the browser, for each twin.

import { element } from "./dom.js";

const LOWEST = 40; // px
const HIGHEST = 1200;

export class Layout {
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
    const grip = element("div", { class: "grip", role: "separator", "aria-orientation": "horizontal", "aria-label": `Height of ${chart.what.title}`, tabindex: 0, title: "Drag: height. Double click: as before" });
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

  // Show these and no others, as a link says; what the user has chosen is kept for the next time.
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
    });
    this.told();
  }

  // Of a sensor with many rows, such as a grid of thermocouples, the first few are enough until more are asked for.
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
    const again = element("button", { type: "button", class: "go", onclick: () => ((this.kept = {}), this.changed()) }, "As at first");
    this.menu.replaceChildren(element("summary", { title: "Which charts, in which order" }, "Shown"), element("div", { class: "menu" }, element("ol", {}, ...this.order.map(row)), again));
  }

  changed() {
    this.keep();
    this.apply();
    this.offer();
  }
}
