// The signals of a dropped log: rows in groups, each with its curve and its role in a draft. Rows and curves are made as they
// come into view.

import { element, setText } from "./dom.js";
import { clock, compact, count, span, spaced } from "./format.js";
import { post } from "./http.js";
import { nearest } from "./ranges.js";

const OPEN_GROUP_ROWS = 40; // a longer group starts closed
const PAGE_ROWS = 100; // rows of a group that are added at once
const CURVE_BATCH = 40;
const GAP_INTERVALS = 6; // median intervals beyond which a curve is broken

export const ROLES = [
  ["state", "State", "measured, with a state of its own"],
  ["sensor", "Sensor", "another measurement of a state"],
  ["input", "Input", "known quantity that drives the states"],
  ["held out", "Held out", "predicted and scored, never used"],
  ["", "Ignore", "not in the twin"],
];

export const rate = (value) => (value === null ? "" : value >= 0.1 ? `${compact(value, 3)} Hz` : `every ${span(1 / value)}`);

export class Signals {
  // request: the log, as it is asked for; roles: by index of a signal; chosen(): a role was changed
  constructor(log, request, roles, chosen) {
    Object.assign(this, { log, request, roles, chosen, rows: new Map(), waiting: new Set() });
    this.seen = new IntersectionObserver((entries) => this.visible(entries), { root: null, rootMargin: "200px" });
    this.find = element("input", { type: "search", placeholder: "Find a signal", "aria-label": "Find a signal", oninput: () => this.filter() });
    this.tally = element("span", { class: "faint", role: "status" });
    this.bar = element("div", { class: "signals-bar" }, element("h2", {}, "Signals"), this.tally, element("span", { class: "space" }), this.find);
    this.list = element("div", { class: "signals" });
    this.groups = this.grouped(log);
    this.filter();
  }

  close() {
    this.closed = true;
    this.seen.disconnect();
  }

  grouped({ signals }) {
    const groups = new Map();
    signals.forEach((signal, index) => {
      if (!groups.has(signal.group)) groups.set(signal.group, []);
      groups.get(signal.group).push(index);
    });
    // Constants last: they say the least.
    for (const members of groups.values()) members.sort((a, b) => (signals[a].kind === "constant") - (signals[b].kind === "constant"));
    const small = signals.length <= 3 * OPEN_GROUP_ROWS;
    return [...groups].map(([name, members], k) => {
      const rows = element("div", { class: "rows" });
      const title = element("span", {}, name || "Columns");
      const tally = element("span", { class: "faint" });
      const node = element("details", { class: "group", open: (small || k < 4) && members.length <= OPEN_GROUP_ROWS || groups.size === 1 }, element("summary", {}, title, " ", tally), rows);
      const group = { name, members, rows, tally, node, matching: members, filled: 0 };
      node.addEventListener("toggle", () => node.open && !group.filled && this.fill(group));
      return group;
    });
  }

  filter() {
    const words = this.find.value.toLowerCase().split(/\s+/).filter(Boolean);
    let left = 0;
    for (const group of this.groups) {
      group.matching = group.members.filter((index) => {
        const text = `${group.name} ${this.log.signals[index].name} ${this.log.signals[index].unit}`.toLowerCase();
        return words.every((word) => text.includes(word));
      });
      left += group.matching.length;
      group.node.hidden = !group.matching.length;
      if (words.length && group.matching.length && group.matching.length <= OPEN_GROUP_ROWS) group.node.open = true;
      setText(group.tally, group.matching.length === group.members.length ? count(group.members.length, "signal") : `${group.matching.length} of ${count(group.members.length, "signal")}`);
      group.filled = 0;
      group.rows.replaceChildren();
      if (group.node.open) this.fill(group);
    }
    setText(this.tally, words.length ? `${left} of ${this.log.signals.length}` : String(this.log.signals.length));
    this.list.replaceChildren(...this.groups.map((group) => group.node));
  }

  // The next rows of a group.
  fill(group) {
    group.rows.querySelector(".more")?.remove();
    const next = group.matching.slice(group.filled, group.filled + PAGE_ROWS);
    group.filled += next.length;
    for (const index of next) {
      if (!this.rows.has(index)) this.rows.set(index, this.row(index));
      const row = this.rows.get(index);
      group.rows.append(row.node);
      this.seen.observe(row.node);
    }
    const more = group.matching.length - group.filled;
    if (more > 0) group.rows.append(element("button", { type: "button", class: "go more", onclick: () => this.fill(group) }, `Show ${Math.min(more, PAGE_ROWS)} more of ${more}`));
  }

  row(index) {
    const signal = this.log.signals[index];
    const chart = element("div", { class: "spark", tabindex: "0", role: "img", "aria-label": `${signal.name}: ${compact(signal.low)} to ${compact(signal.high)}${spaced(signal.unit)}` });
    const reading = element("p", { class: "faint readout" }, "");
    const select = element("select", { "aria-label": `Role of ${signal.name}`, onchange: () => this.choose(row, select.value) },
      ...ROLES.map(([value, text, title]) => element("option", { value, title }, text)));
    const facts = [count(signal.number, "value"), rate(signal.rate), signal.missing ? `${signal.missing} missing` : null, signal.kind === "signal" ? null : signal.kind].filter(Boolean).join(" · ");
    const row = { index, chart, reading, select, curve: null };
    row.node = element("div", { class: "signal", dataset: { index: String(index), signal: signal.name } },
      element("div", { class: "what" }, element("b", { title: signal.name }, signal.name), element("span", { class: "unit" }, signal.unit ? ` [${signal.unit}]` : ""), element("p", { class: "faint" }, facts), reading),
      chart, select);
    chart.addEventListener("pointermove", (event) => this.point(row, event));
    chart.addEventListener("pointerleave", () => this.point(row, null));
    chart.addEventListener("click", () => this.enlarge(row));
    chart.addEventListener("keydown", (event) => event.key === "Enter" && this.enlarge(row));
    this.role(row);
    return row;
  }

  enlarge(row) {
    row.node.classList.toggle("tall");
    plot(row, this.log);
  }

  // Ask for the curves of rows that come into view, some at a time.
  visible(entries) {
    for (const entry of entries) if (entry.isIntersecting) {
      this.seen.unobserve(entry.target);
      this.waiting.add(Number(entry.target.dataset.index));
    }
    if (this.waiting.size && !this.asking) this.fetchCurves();
  }

  async fetchCurves() {
    this.asking = true;
    while (this.waiting.size && !this.closed) {
      const signals = [...this.waiting].slice(0, CURVE_BATCH);
      for (const index of signals) this.waiting.delete(index);
      const answer = await post("api/gallery/log/curves", { ...this.request, signals });
      if (answer.error) break;
      signals.forEach((index, k) => plot(Object.assign(this.rows.get(index), { curve: answer.curves[k] }), this.log));
    }
    this.asking = false;
  }

  point(row, event) {
    const marker = row.chart.querySelector(".marker");
    if (!row.curve || !marker) return;
    marker.hidden = !event;
    if (!event) return setText(row.reading, "");
    const box = row.chart.querySelector("svg").getBoundingClientRect();
    const [t, low, high] = row.curve;
    const at = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width)) * this.log.seconds;
    const k = nearest(t, at);
    const signal = this.log.signals[row.index];
    marker.style.left = `${(100 * t[k]) / (this.log.seconds || 1)}%`;
    setText(row.reading, `${clock(t[k], this.log.seconds < 60 ? 1 : 0)}  ${low[k] === high[k] ? compact(low[k]) : `${compact(low[k])} to ${compact(high[k])}`}${spaced(signal.unit)}`);
  }

  choose(row, role) {
    this.roles.set(row.index, role);
    this.role(row);
    this.chosen();
  }

  // Show the present roles, and why the server proposed them: [[role, reason]] by signal.
  propose(proposed) {
    this.proposed = proposed;
    for (const row of this.rows.values()) this.role(row);
  }

  role(row) {
    const role = this.roles.get(row.index) ?? "";
    row.node.dataset.role = role;
    row.select.value = role;
    const [proposed, reason] = this.proposed?.[row.index] ?? [];
    if (reason) row.select.title = `Proposed: ${ROLES.find(([value]) => value === proposed)?.[1] ?? proposed}, ${reason}`;
  }

  // Its row, whatever group it is in.
  reveal(index) {
    this.find.value = this.log.signals[index].name;
    this.filter();
    const group = this.groups.find((item) => item.matching.includes(index));
    group.node.open = true;
    if (!group.filled) this.fill(group);
    this.rows.get(index)?.select.focus();
  }
}

// The quick chart of a row: its curve, the scale at the left, and the time below if it is tall.
function plot(row, log) {
  if (!row.curve) return;
  const signal = log.signals[row.index];
  const [t, low, high] = row.curve;
  const span_ = log.seconds || 1;
  const range = signal.high - signal.low || Math.abs(signal.high) || 1;
  const bottom = signal.high === signal.low ? signal.low - range / 2 : signal.low;
  const x = (value) => (1000 * value) / span_;
  const y = (value) => 97 - (94 * (value - bottom)) / range;
  const apart = t.slice(1).map((value, k) => value - t[k]).sort((a, b) => a - b);
  const limit = GAP_INTERVALS * Math.max(apart[apart.length >> 1] ?? 0, span_ / 300);
  let d = "";
  for (let k = 0; k < t.length; k++) {
    const at = x(t[k]).toFixed(1);
    const open = k && t[k] - t[k - 1] <= limit;
    d += !open ? `M${at} ${y(low[k]).toFixed(1)}` : signal.kind === "switch" ? `H${at}V${y(low[k]).toFixed(1)}` : `L${at} ${y(low[k]).toFixed(1)}`;
    d += high[k] === low[k] ? (open ? "" : "h.01") : `V${y(high[k]).toFixed(1)}`;
  }
  const tall = row.node.classList.contains("tall");
  const grid = tall ? [0.25, 0.5, 0.75].map((part) => `M${1000 * part} 0V100M0 ${100 * part}H1000`).join("") : "";
  const path = (name, shape) => element("svg:path", { class: name, d: shape, "vector-effect": "non-scaling-stroke" });
  const ticks = tall ? [1, 0.5, 0] : [1, 0];
  const times = tall ? [0, 0.25, 0.5, 0.75, 1] : [];
  row.chart.replaceChildren(
    element("div", { class: "levels", "aria-hidden": "true" }, ...ticks.map((part) => element("span", {}, compact(signal.low === signal.high ? signal.low + (part - 0.5) * range : signal.low + part * range, 3)))),
    element("div", { class: "plot" }, element("svg:svg", { viewBox: "0 0 1000 100", preserveAspectRatio: "none", "aria-hidden": "true" }, path("grid", grid), path("curve", d)), element("i", { class: "marker", hidden: true })),
    ...(tall ? [element("div", { class: "times", "aria-hidden": "true" }, ...times.map((part) => element("span", {}, clock(part * span_, span_ < 60 ? 1 : 0))))] : []));
  row.node.dataset.drawn = "true";
}
