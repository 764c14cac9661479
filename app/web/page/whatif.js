// What if: the twin goes on from now without readings, with inputs that are chosen here. A fan for each state, and when
// it reaches a limit. Nothing is asked while this is hidden.

import { Chart, TimeAxis, band, dots, edge, line } from "./chart.js";
import { element, refusal, setText, showText } from "./dom.js";
import { angular } from "./drawing.js";
import { compact, spaced, span, withDeviation } from "./format.js";
import { get, post } from "./http.js";
import { Range, shownExtent, until } from "./ranges.js";
import { Stream } from "./stream.js";
import { inputChart, inputRow, levels, probability, profile } from "./whatif_inputs.js";

const AGAIN = 2000; // ms between two forecasts, while the twin goes on
const REST = 2; // times as long as a forecast took, at least
const LONGEST_REST = 10000; // ms
const SOON = 120; // ms after an edit
const PAST = 0.35; // of the horizon, shown before now
const MARGIN = 0.02; // of the horizon, before what is shown
const MAX_CHARTED_STATES = 24; // states
const STEPS = 200; // of the horizon's slider

export class WhatIf {
  constructor(node, model, link) {
    Object.assign(this, { node, model, link });
    this.key = `nisus.whatif.${model.twin}`;
    const kept = JSON.parse(localStorage.getItem(this.key) ?? "{}");
    this.horizon = kept.horizon ?? null;
    const names = model.states.map((state) => state.name);
    this.limits = Object.fromEntries(Object.entries(kept.limits ?? {}).filter(([name]) => names.includes(name)));
    this.inputs = {}; // what was chosen: {kind, value, after}, by name
    this.stream = new Stream(link, "whatif");
    this.states = [...model.states].sort((a, b) => (a.rows.length > 0) - (b.rows.length > 0)).slice(0, MAX_CHARTED_STATES);
    this.shown = false;
    link.addEventListener("frames", () => this.shown && this.draw());
  }

  show() {
    this.shown = true;
    if (!this.parts) this.begin();
    this.look();
    this.ask();
  }

  hide() {
    if (!this.shown) return;
    this.shown = false;
    clearTimeout(this.timer);
    this.stream.ask(null);
  }

  begin() {
    this.slider = element("input", { type: "range", min: 0, max: STEPS, step: 1, "aria-label": "Horizon", oninput: () => this.turn() });
    this.length = element("output", {});
    this.problem = refusal();
    this.method = element("span", {});
    this.state = element("span", { class: "state", role: "status" });
    this.rows = new Map(this.model.inputs.map((input) => [input.name, inputRow(this, input)]));
    const asked = element(
      "section", { class: "asked", "aria-label": "Forecast settings" },
      element("label", { class: "choice" }, element("b", {}, "Horizon"), this.slider, this.length),
      ...[...this.rows.values()].map((row) => row.node),
    );
    this.charts = element("div", { class: "fans" });
    const axis = element("div", { class: "axis", "aria-hidden": "true" });
    this.node.replaceChildren(asked, this.problem, this.charts, axis, element("p", { class: "faint foot" }, "Dashed: prediction of the running filter without measurements. Bands ± 1σ, ± 2σ. ", this.method, this.state));
    const { states } = this;
    const actions = (this.actions = { select: () => {}, home: () => {}, wheel: () => {}, save: (chart, button) => this.saving.chart(chart, button) });
    this.parts = states.map((state) => new Chart(fan(this, state), actions));
    this.charts.append(...this.parts.map((chart) => chart.node));
    this.parts.forEach((chart, k) => {
      chart.span = [0, 1];
      chart.begin();
      if (!states[k].probability && !states[k].circular) chart.head.insertBefore(limitField(this, states[k]), chart.reading);
    });
    this.axis = new TimeAxis(axis);
  }

  // History before now, in the style of the charts.
  look() {
    const columns = [
      ...this.states.flatMap((state) => ["mean", "upper", "lower", "truth"].map((kind) => `${kind}:${state.name}`)),
      ...this.states.flatMap((state) => state.rows.map((row) => `reading:${row}`)),
      ...this.model.inputs.map((input) => `input:${input.name}`),
    ];
    // More than is shown, as a forecast may be seconds old.
    const past = 1.5 * PAST * (this.horizon ?? this.model.window) + LONGEST_REST / 1000;
    this.stream.ask({ span: past, points: 400, columns });
  }

  // Charts of the inputs that were chosen stand beneath the fans.
  showInputs() {
    for (const [name, row] of this.rows) {
      const wanted = Boolean(this.found.chosen[name]);
      if (wanted && !row.chart) {
        row.chart = new Chart(inputChart(this, row.input), this.actions);
        this.charts.append(row.chart.node);
        row.chart.span = [0, 1];
        row.chart.begin();
      } else if (!wanted && row.chart) {
        row.chart.end();
        row.chart = null;
      }
    }
  }

  turn() {
    this.horizon = this.shortest * (this.longest / this.shortest) ** (this.slider.value / STEPS);
    this.placeSlider();
    this.changed();
    this.look();
  }

  placeSlider() {
    const place = (STEPS * Math.log(this.horizon / this.shortest)) / Math.log(this.longest / this.shortest);
    if (document.activeElement !== this.slider) this.slider.value = Math.round(place);
    this.slider.setAttribute("aria-valuetext", span(this.horizon));
    setText(this.length, span(this.horizon));
  }

  changed() {
    localStorage.setItem(this.key, JSON.stringify({ horizon: this.horizon, limits: this.limits }));
    this.asked = null;
    this.next(SOON);
  }

  next(delay) {
    clearTimeout(this.timer);
    if (this.shown) this.timer = setTimeout(() => this.ask(), delay);
  }

  get question() {
    const inputs = Object.fromEntries(Object.entries(this.inputs).map(([name, chosen]) => [name, profile(chosen, this.rows.get(name).now, this.horizon)]));
    return { horizon: this.horizon, inputs, limits: this.limits };
  }

  async ask() {
    if (this.busy) return this.next(SOON);
    const status = this.link.status;
    const asked = `${status.t} ${status.revision} ${JSON.stringify(this.question)}`;
    if (asked === this.asked) return this.next(AGAIN); // paused: nothing would come out differently
    this.busy = true;
    setText(this.state, "computing …");
    const begun = performance.now();
    const unknown = this.longest ? null : await this.learn();
    const { question } = this;
    const found = unknown ?? (await post("api/forecast", question));
    showText(this.problem, found.error);
    if (!found.error) {
      this.asked = asked;
      this.take(found);
    }
    this.busy = false;
    setText(this.state, "");
    // What was chosen meanwhile is asked for at once.
    const rest = Math.max(AGAIN, Math.min(LONGEST_REST, REST * (performance.now() - begun)));
    this.next(JSON.stringify(question) === JSON.stringify(this.question) ? rest : SOON);
  }

  // How far can be asked for. Resolves to {error} where that is not known.
  async learn() {
    const may = await get("api/forecast");
    if (may.error) return may;
    this.longest = may.longest;
    this.shortest = Math.min(may.longest / 2, 10 * may.step);
    const horizon = this.horizon ?? 3 * this.model.window;
    this.horizon = Math.min(this.longest, Math.max(this.shortest, horizon));
    this.placeSlider();
    this.look();
    return null;
  }

  take(found) {
    this.found = found;
    this.origin = Number(this.link.status.origin ?? 0) / 1e9;
    this.times = found.t.map((t) => found.now - this.origin + t);
    setText(this.method, `Limits: ${found.method}.`);
    for (const [name, row] of this.rows) row.show(found.inputs[name], this.stream.columns[`input:${name}`] ?? []);
    this.showInputs();
    for (const [name, output] of Object.entries(this.said ?? {})) setText(output, sentence(this, name, found.limits[name]));
    this.draw();
    window.nisus.forecasts = (window.nisus.forecasts ?? 0) + 1;
  }

  draw() {
    if (!this.found) return;
    const now = this.times[0];
    const horizon = this.found.t.at(-1);
    const first = Math.max(now - PAST * horizon, Math.min(now, this.stream.x[0] ?? now));
    const range = [first - MARGIN * horizon, this.times.at(-1)];
    const inputs = [...this.rows.values()].flatMap((row) => row.chart ?? []);
    for (const chart of [...this.parts, ...inputs]) chart.show(chart.what.data(), range);
    this.axis.show(range);
    this.explain(this.parts);
  }
}

function limitField(whatif, state) {
  const said = element("output", { class: "said", "aria-label": `When ${state.label} reaches its limit` });
  (whatif.said ??= {})[state.name] = said;
  const field = element("input", {
    type: "text", inputmode: "decimal", placeholder: "none", value: whatif.limits[state.name] ?? "", "aria-label": `Limit of ${state.label}${spaced(state.unit)}`,
    onchange: () => {
      const value = Number(field.value.replace(",", "."));
      if (field.value.trim() === "" || !Number.isFinite(value)) {
        delete whatif.limits[state.name];
        field.value = "";
        setText(said, "");
      } else whatif.limits[state.name] = value;
      whatif.changed();
    },
  });
  return element("label", { class: "limit" }, "limit ", field, said);
}

// "reaches 80 °C in 4.2 min (68 % within 10 min)". To have been beyond is likelier than to be beyond at some time, which
// is all that moments tell.
function sentence(whatif, name, found) {
  if (!found) return "";
  const { unit } = whatif.model.states.find((state) => state.name === name);
  const { members, t } = whatif.found;
  const limit = `${compact(found.limit)}${spaced(unit)}`;
  const within = span(t.at(-1));
  const share = found.overall > 0.995 ? "over 99 %" : `${members ? "" : "at least "}${Math.round(100 * found.overall)} %`;
  if (found.middle !== null) return `${found.above ? "reaches" : "falls to"} ${limit} in ${span(found.middle)} (${share} within ${within})`;
  if (found.overall >= 0.005) return `${found.above ? "may reach" : "may fall to"} ${limit}: ${share} within ${within}`;
  const side = `${found.above ? "below" : "above"} ${limit}`;
  return members ? `stays ${side} for ${within} (over 99 %)` : `${side} at any time for ${within} (over 99 %)`;
}

// A chart of one state: the past, and to the right of now a fan of the forecast.
function fan(whatif, state) {
  const range = new Range();
  const { stream } = whatif;
  const readings = state.rows.map((row) => `reading:${row}`);
  const past = { upper: `upper:${state.name}`, lower: `lower:${state.name}`, truth: `truth:${state.name}`, mean: `mean:${state.name}`, ...Object.fromEntries(readings.map((name) => [name, name])) };
  const future = { upper2: "upper2", lower2: "lower2", upper1: "upper1", lower1: "lower1", forecast: "mean" };
  return {
    key: `whatif:${state.name}`,
    title: state.label,
    unit: state.unit,
    note: state.rows.length ? null : "not measured",
    names: { band: "± 1σ, ± 2σ" },
    weight: state.rows.length ? 1 : 1.4,
    sync: "future",
    series: {
      upper: edge(), lower: edge(), ...Object.fromEntries(readings.map((name) => [name, dots("reading", 4)])),
      truth: line("truth", { dash: [5, 3], spanGaps: true }), mean: line("estimate", { width: 1.75 }),
      upper2: edge(), lower2: edge(), upper1: edge(), lower1: edge(), forecast: line("estimate", { width: 1.75, dash: [6, 3] }),
    },
    bands: [band("band", "upper", "lower"), band("band", "upper2", "lower2"), band("band", "upper1", "lower1")],
    over: (plot) => {
      probability(plot, whatif.times, whatif.found?.limits[state.name]);
      levels(plot, whatif.times?.[0], whatif.limits[state.name]);
    },
    data: () => {
      const { found, times } = whatif;
      const before = until(stream.x, times[0]);
      const none = new Array(times.length).fill(null);
      const empty = new Array(before).fill(null);
      const told = found.states[state.name];
      const drawn = (columns, mean) => (state.circular ? angular(columns, columns[mean]) : columns);
      const was = drawn(Object.fromEntries(Object.entries(past).map(([kind, name]) => [kind, stream.column(name).slice(0, before)])), "mean");
      const will = drawn(Object.fromEntries(Object.entries(future).map(([kind, name]) => [kind, told[name] ?? none])), "forecast");
      return {
        x: [...stream.x.slice(0, before), ...times],
        ...Object.fromEntries(Object.entries(was).map(([name, values]) => [name, [...values, ...none]])),
        ...Object.fromEntries(Object.entries(will).map(([name, values]) => [name, [...empty, ...values]])),
      };
    },
    range: (data) => {
      if (state.probability) return [-0.03, 1.03];
      const limit = whatif.limits[state.name];
      // The fan is in view as far as it opens; of the past, only what is not wild.
      const drawn = { bands: [[data.upper, data.lower]], dots: readings.map((name) => data[name]), lines: ["truth", "mean", ...Object.keys(future)].map((name) => data[name]) };
      const [low, high] = shownExtent(drawn, 0, data.x.length - 1);
      return range.fit(Math.min(low, limit ?? low), Math.max(high, limit ?? high));
    },
    says: (value) => {
      const [x, upper, lower, mean] = ["x", "upper2", "lower2", "forecast"].map(value);
      const now = whatif.times?.[0] ?? 0;
      if (!(x >= now)) return "";
      if (!Number.isFinite(mean) && upper > lower) return `in ${span(x - now)} withheld: ± ${compact((upper - lower) / 2, 2)}${spaced(state.unit)}`;
      return `in ${span(x - now)} ${withDeviation(mean, (upper - lower) / 2, state.unit)}`;
    },
  };
}
