// The Tune panel: filter and options, noises, parameters, gate, sensors. Undo and redo.

import { $, element, setAttribute, setText } from "./dom.js";
import { Advice, Fit, Refit } from "./fit.js";
import { words } from "./format.js";
import { Around, Gestures, Knob } from "./knob.js";

const GROUPS = { Q: "Process noise Q", R: "Sensor noise R", p: "Parameters" };
const HINTS = {
  Q: "Variance that is added in one second: how much the model is distrusted",
  R: "Variance of the readings: how much the sensors are distrusted",
  p: "Numbers of the model",
};
const GATES = [["off", null], ["95 %", 0.95], ["99 %", 0.99], ["99.73 %", 0.9973], ["99.99 %", 0.9999]];
const MAX_OPEN_ENTRIES = 8; // entries from which on a group is closed at first

export class Tune {
  constructor(model, link) {
    Object.assign(this, { model, link });
    this.knobs = new Map();
    this.picks = new Gestures(); // of filters, with the keys of the list
    this.sections = element("div", { class: "sections" });
    $("tune").replaceChildren(this.head(), this.sections);
    this.marks = element("p", { class: "faint marks", hidden: true }, "◆ suggested by the data · ◇ no suggestion");
    this.sections.append(this.filterSection(), this.marks);
    for (const [prefix, title] of Object.entries(GROUPS)) {
      const items = model.tuning.filter((item) => item.key.startsWith(`${prefix}.`));
      if (items.length) this.sections.append(this.group(prefix, title, items));
    }
    this.sections.append(this.gateSection(), this.sensorSection());
    this.around = new Around(model, link, this);
    this.fit = new Fit(model, link, this);
    this.advice = new Advice(model, link, this);
    this.refit = new Refit(model, link, this);
    link.addEventListener("status", (event) => this.sync(event.detail));
  }

  head() {
    const button = (id, text, title, click) => element("button", { type: "button", id, title, "aria-label": title, onclick: click, disabled: true }, text);
    this.undoButton = button("undo", "↶", "Undo the last edit (U)", () => this.undo());
    this.redoButton = button("redo", "↷", "Redo (Shift-U)", () => this.redo());
    this.restoreButton = button("restore", "Restore", "Filter and tuning as the session began with", () => this.link.ask("Restore"));
    this.notice = element("p", { class: "error", role: "alert", hidden: true });
    return element("header", { class: "panel-head" }, element("h2", {}, "Tune"), element("span", { class: "space" }), this.undoButton, this.redoButton, this.restoreButton, this.notice);
  }

  filterSection() {
    const applies = this.model.estimators.filter((entry) => !entry.reason);
    const refused = this.model.estimators.filter((entry) => entry.reason);
    const option = (entry) => element("option", { value: entry.name, disabled: Boolean(entry.reason), title: entry.reason ?? entry.assumes, "data-title": entry.title }, entry.title);
    this.estimator = element(
      "select", { id: "estimator", "aria-label": "Estimator", onchange: () => this.choose(this.estimator.value) },
      element("optgroup", { label: "Estimators" }, ...applies.map(option)),
      refused.length ? element("optgroup", { label: "Do not apply here" }, ...refused.map(option)) : null,
    );
    this.choices = new Map([...this.estimator.querySelectorAll("option:enabled")].map((item) => [item.value, item]));
    $("estimator-place").replaceChildren(this.estimator);
    this.about = element("p", { class: "about" });
    this.options = element("div", { class: "options" });
    const reasons = refused.length
      ? element("details", { class: "refused" }, element("summary", {}, `${refused.length} do not apply here: why`),
          element("dl", {}, ...refused.flatMap((entry) => [element("dt", {}, entry.title), element("dd", {}, entry.reason)])))
      : null;
    return section("Filter", "Assumptions, options and why others do not apply", false, this.about, this.options, reasons);
  }

  group(prefix, title, items) {
    const all = prefix === "p" || items.length < 2 ? null : this.together(prefix, title);
    const knobs = items.map((item) => {
      const knob = new Knob(
        {
          key: item.key, label: item.key.slice(2), unit: item.unit, low: item.low, high: item.high, configured: item.configured,
          logarithmic: prefix !== "p",
        },
        (value, gesture) => this.turn(item.key, value, gesture),
      );
      this.knobs.set(item.key, knob);
      return knob.node;
    });
    return section(title, HINTS[prefix], items.length <= MAX_OPEN_ENTRIES, all, ...knobs);
  }

  // One line that scales all of a group.
  together(prefix, title) {
    const button = (text, factor) => element("button", { type: "button", title: `All of ${title} ${text}`, onclick: () => this.scale(prefix, factor) }, text);
    const data = prefix === "Q"
      ? element("button", { type: "button", id: "scale-Q", disabled: true, onclick: () => this.scale("Q", Number(data.dataset.level)) }, "◇ none")
      : null;
    return element("div", { class: "together" }, element("span", {}, "all"), button("÷10", 0.1), button("÷2", 0.5), button("×2", 2), button("×10", 10), data);
  }

  // All of a group at once: one command, one revision, one undo. Their own curves are not what is looked for then.
  scale(prefix, factor) {
    const values = {};
    for (const [key, knob] of this.knobs) {
      if (!key.startsWith(`${prefix}.`)) continue;
      values[key] = Number((knob.value * factor).toPrecision(6));
      knob.expect(values[key]);
    }
    return this.edit("SetTunings", { values });
  }

  gateSection() {
    const choose = () => this.turn("gate", this.gate.value === "off" ? null : Number(this.gate.value));
    this.gate = element("select", { "aria-label": "Gate", title: "Probability that a good measurement passes", onchange: choose });
    this.kind = element(
      "select", { "aria-label": "Kind of gate", title: "Treatment of a measurement beyond the gate", onchange: () => this.turn("gate.kind", this.kind.value) },
      element("option", { value: "hard" }, "reject"), element("option", { value: "soft" }, "soften"),
    );
    return section("Gate", "Readings that a good sensor would hardly give", true, element("div", { class: "pair" }, this.gate, this.kind));
  }

  sensorSection() {
    this.sensors = new Map();
    // The sensors of a family, one for each landmark, share a row.
    const members = new Map();
    for (const name of this.model.sensors) {
      const shared = this.model.families[name] ?? name;
      members.set(shared, [...(members.get(shared) ?? []), name]);
    }
    const rows = [...members].map(([name, names]) => {
      const box = element("input", { type: "checkbox", onchange: () => this.use(name, box.checked) });
      const row = element("label", { class: "sensor", title: "Off: held out (predicted and scored, but not used)" }, box, element("span", {}, names.length > 1 ? `${words(name)} (${names.length})` : words(name)), element("em", {}));
      this.sensors.set(name, [box, row.lastChild, names]);
      return row;
    });
    return section("Sensors in use", "Off: held out (predicted and scored, but not used)", this.model.sensors.length <= MAX_OPEN_ENTRIES, ...rows);
  }

  sync(status) {
    this.status = status;
    if (document.activeElement !== this.estimator) this.estimator.value = status.estimator;
    for (const [name, option] of this.choices) setText(option, option.dataset.title + unready(status.compiling, name));
    const entry = this.model.estimators.find((item) => item.name === status.estimator);
    setAttribute($("estimator-place"), "data-title", entry.title);
    if (this.entry !== entry) this.build(entry);
    for (const [name, knob] of this.optionKnobs) {
      if (knob instanceof Knob) knob.sync(status.options[name]);
      else if (document.activeElement !== knob) knob.value = String(Math.round(status.options[name]));
    }
    for (const [key, value] of Object.entries(status.tuning)) this.knobs.get(key)?.sync(value);
    this.syncGate(status);
    for (const [box, note, names] of this.sensors.values()) {
      const used = names.every((name) => status.used[name]);
      if (document.activeElement !== box || box.checked === used) box.checked = used;
      const states = [...new Set(names.map((name) => status.sensors[name]?.state ?? "tracking"))].filter((state) => state !== "tracking");
      setText(note, states.join(", "));
    }
    this.offerUndo(status.edits);
    const turned = Object.keys(status.turned).length;
    this.restoreButton.disabled = !turned;
    setText(this.restoreButton, turned ? `Restore ${turned}` : "Restore");
    setAttribute(this.restoreButton, "title", turned ? `Turned since the start: ${Object.keys(status.turned).join(", ")}` : "Nothing was turned");
  }

  syncGate(status) {
    const gate = status.gate ?? null;
    const known = [...GATES];
    if (!known.some(([, value]) => value === gate)) known.push([`${Number((100 * gate).toPrecision(8))} %`, gate]);
    const wanted = JSON.stringify(known);
    if (this.gates !== wanted) {
      this.gates = wanted;
      this.gate.replaceChildren(...known.map(([text, value]) => element("option", { value: value === null ? "off" : value }, text)));
    }
    if (document.activeElement !== this.gate) this.gate.value = gate === null ? "off" : String(gate);
    if (document.activeElement !== this.kind) this.kind.value = status.gate_kind ?? "hard";
    this.kind.disabled = gate === null;
  }

  build(entry) {
    this.entry = entry;
    this.optionKnobs = new Map();
    setText(this.about, entry.assumes);
    setAttribute(this.about, "title", `Fails when ${entry.fails_when}. ${entry.source}`);
    const rows = entry.options.map((option) => {
      if (option.choices.length) {
        const select = element("select", { "aria-label": option.name, title: option.meaning, onchange: () => this.option(option.name, Number(select.value)) },
          ...option.choices.map((text, k) => element("option", { value: k }, text)));
        this.optionKnobs.set(option.name, select);
        return element("div", { class: "knob plain" }, element("label", { title: option.meaning }, words(option.name)), select);
      }
      const knob = new Knob(
        {
          key: `option.${option.name}`, label: option.name, unit: option.unit, low: option.low, high: option.high ?? Infinity,
          configured: option.configured, logarithmic: option.whole && option.configured > 20, whole: option.whole, help: option.meaning,
        },
        (value, gesture) => this.option(option.name, option.whole ? Math.round(value) : value, gesture),
      );
      this.optionKnobs.set(option.name, knob);
      return knob.node;
    });
    this.options.replaceChildren(...rows);
  }

  // The twin's file was saved: other values are the configured ones.
  configure(items) {
    for (const item of items) this.knobs.get(item.key)?.configure(item.configured);
  }

  // Edits. Those of one gesture are one run and one undo.

  choose(name) {
    return this.edit("SetEstimator", { name, gesture: this.picks.next });
  }

  turn(key, value, gesture = "") {
    this.around.show(key);
    return this.edit("SetTuning", { key, value, gesture });
  }

  option(name, value, gesture = "") {
    return this.edit("SetOption", { name, value, gesture });
  }

  use(name, used) {
    return this.edit("UseSensor", { name, used });
  }

  async edit(command, fields) {
    const reason = await this.link.ask(command, fields);
    setText(this.notice, reason ?? "");
    this.notice.hidden = !reason;
    return reason;
  }

  // Undo and redo are the session's, whichever browser made the edit.
  undo() {
    return this.status.edits.undo === null ? null : this.edit("Undo");
  }

  redo() {
    return this.status.edits.redo === null ? null : this.edit("Redo");
  }

  offerUndo({ undo, redo }) {
    for (const [button, what, text, key] of [[this.undoButton, undo, "Undo", "U"], [this.redoButton, redo, "Redo", "Shift-U"]]) {
      button.disabled = what === null;
      setAttribute(button, "title", what === null ? `Nothing to ${text.toLowerCase()}` : `${text} ${what} (${key})`);
    }
  }
}

export function section(title, hint, open, ...children) {
  return element("details", { class: "section", open }, element("summary", { title: hint }, title), ...children);
}

// Of a filter that is not compiled yet: for how long it has been, or that it is to come.
function unready(compiling, name) {
  if (!(name in compiling)) return "";
  return compiling[name] === null ? " · to be compiled" : ` · compiling, ${Math.round(compiling[name])} s`;
}
