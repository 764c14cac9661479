// The Tune panel: filter and options, noises, parameters, gate, sensors. Undo and redo.

import { $, changed, element, refusal, setAttribute, setText, showText } from "./dom.js";
import { Advice, Fit, Refit } from "./fit.js";
import { compact, words } from "./format.js";
import { Around, Gestures, Knob } from "./knob.js";
import { groupText, SIGNS, unitsOf } from "./trust.js";

const GROUPS = { Q: "Process noise Q", R: "Sensor noise R", p: "Parameters" };
const HINTS = {
  Q: "Variance that is added in one second: how much the model is distrusted",
  R: "Variance of the readings: how much the sensors are distrusted",
  p: "Numbers of the model",
};
const GATES = [["off", null], ["95 %", 0.95], ["99 %", 0.99], ["99.73 %", 0.9973], ["99.99 %", 0.9999]];
const MAX_OPEN_ENTRIES = 8; // entries from which on a group is closed at first
const MAX_LISTED = 24; // entries or sensors of a group that are listed at once; the others are found by name
const WORST = ["stale", "degraded", "suspect", "advisory", "waiting", "held out", "tracking"];

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
    this.notice = refusal();
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
    const knobOf = (item) => {
      if (this.knobs.has(item.key)) return this.knobs.get(item.key).node;
      const knob = new Knob(
        {
          key: item.key, label: item.key.slice(2), unit: item.unit, low: item.low, high: item.high, configured: item.configured,
          logarithmic: prefix !== "p",
        },
        (value, gesture) => this.turn(item.key, value, gesture),
      );
      this.knobs.set(item.key, knob);
      if (this.status) knob.sync(this.status.tuning[item.key]);
      return knob.node;
    };
    const body = items.length <= MAX_LISTED ? items.map(knobOf) : [this.found(title, items, (item) => item.key.slice(2), knobOf)];
    return section(title, HINTS[prefix], items.length <= MAX_OPEN_ENTRIES, all, ...body);
  }

  // A search field, and its first results.
  found(title, items, nameOf, nodeOf) {
    const list = element("div", {});
    const left = element("p", { class: "about" });
    const fill = () => {
      const matching = matches(items, nameOf, field.value);
      list.replaceChildren(...matching.slice(0, MAX_LISTED).map(nodeOf));
      setText(left, matching.length > MAX_LISTED ? `${matching.length - MAX_LISTED} more` : "");
    };
    const field = element("input", { type: "text", class: "find", placeholder: `Find among ${items.length}`, "aria-label": `Find in ${title}`, oninput: fill });
    fill();
    return element("div", {}, field, list, left);
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
    for (const { key } of this.model.tuning) {
      if (!key.startsWith(`${prefix}.`)) continue;
      const knob = this.knobs.get(key);
      values[key] = Number(((knob?.value ?? this.status.tuning[key]) * factor).toPrecision(6));
      knob?.expect(values[key]);
    }
    return this.edit("SetTunings", { values });
  }

  gateSection() {
    const choose = () => this.turn("gate", this.gate.value === "off" ? null : Number(this.gate.value));
    this.gate = element("select", { "aria-label": "Gate", title: "Probability that a good measurement passes; off: every measurement is used", onchange: choose });
    this.kind = element(
      "select", { "aria-label": "Kind of gate", title: "Treatment of a measurement beyond the gate", onchange: () => this.turn("gate.kind", this.kind.value) },
      element("option", { value: "hard" }, "reject"), element("option", { value: "soft" }, "soften"),
    );
    return section("Gate", "Rejects or down-weights measurements that are too far from the prediction", true, element("div", { class: "pair" }, this.gate, this.kind));
  }

  sensorSection() {
    this.sensors = []; // lines: [box or null, note, names], of groups also their summary and list
    this.units = unitsOf(this.model);
    const rows = this.units.map((unit) => (unit.sensors.length > 1 ? this.sensorGroup(unit) : this.sensorLine(unit.name, unit.sensors, true)));
    const many = this.model.sensors.length > MAX_LISTED;
    const search = element("input", { type: "text", class: "find", placeholder: `Find among ${this.model.sensors.length} sensors`, "aria-label": "Find a sensor", oninput: () => this.find(search.value) });
    const made = section("Sensors in use", "Off: held out (predicted and scored, but not used)", this.units.length <= MAX_OPEN_ENTRIES, many ? search : null, ...rows);
    this.link.addEventListener("group", ({ detail }) => {
      const { node } = this.sensors.find((line) => line.unit?.name === detail);
      made.open = node.open = true;
      node.scrollIntoView({ block: "nearest" });
      node.querySelector("summary").focus();
    });
    return made;
  }

  sensorLine(name, names, kept) {
    const box = element("input", { type: "checkbox", onchange: () => this.use(name, box.checked) });
    const note = element("em", {});
    const node = element("label", { class: "sensor", title: "Off: held out (predicted and scored, but not used)" }, box, element("span", {}, words(name)), note);
    const line = { node, box, note, names };
    if (kept) this.sensors.push(line);
    return kept ? node : line;
  }

  // A closed line with the number of sensors and the state of the worst; opened, it lists members, those in alarm first.
  sensorGroup(unit) {
    const { name, sensors, declared } = unit;
    const box = declared ? element("input", { type: "checkbox", "aria-label": `Use ${words(name)}`, onclick: (event) => event.stopPropagation(), onchange: () => this.use(name, box.checked) }) : null;
    const [light, note, list, left] = [element("i", {}, "○"), element("em", {}), element("div", {}), element("p", { class: "about" })];
    const label = element("label", { class: "sensor" }, box, light, element("span", {}, `${words(name)} (${sensors.length})`), note);
    const node = element("details", { class: "sensor-group", dataset: { group: name } }, element("summary", {}, label), list, left);
    const line = { node, box, note, names: sensors, unit, light, list, left, members: [], text: "" };
    // A label would pass the click on to its box.
    label.addEventListener("click", (event) => event.target !== box && (event.preventDefault(), (node.open = !node.open)));
    node.addEventListener("toggle", () => this.list(line));
    this.sensors.push(line);
    return node;
  }

  // The list of an open group: those whose names match, in alarm first, then by NIS. It keeps its order while it is open.
  list(line) {
    const { unit, node, list, left, text } = line;
    if (!node.open || !this.status) {
      list.replaceChildren();
      line.members = [];
      return setText(left, "");
    }
    const worst = new Map(this.status.groups[unit.name].worst.map(([name], k) => [name, k]));
    const place = (name) => WORST.indexOf(this.status.sensors[name]?.state ?? "tracking") * MAX_LISTED + (worst.get(name) ?? MAX_LISTED - 1);
    const matching = matches(unit.sensors, String, text).map((name) => [place(name), name]).sort(([a], [b]) => a - b);
    line.members = matching.slice(0, MAX_LISTED).map(([, name]) => this.sensorLine(name, [name], false));
    for (const { node: row, names: [name] } of line.members) {
      row.append(element("button", { type: "button", title: `Chart the innovation of ${words(name)}`, "aria-label": `Chart ${words(name)}`, onclick: (event) => (event.preventDefault(), this.link.dispatchEvent(new CustomEvent("member", { detail: name }))) }, "chart"));
    }
    list.replaceChildren(...line.members.map((member) => member.node));
    setText(left, matching.length > MAX_LISTED ? `${matching.length - MAX_LISTED} more: type a name above` : "");
    for (const member of line.members) this.state(member, this.status);
  }

  find(text) {
    for (const line of this.sensors) {
      const matching = matches(line.names, String, text).length > 0;
      line.node.hidden = !matching;
      if (!line.unit) continue;
      line.text = text;
      line.node.open = Boolean(text) && matching;
      this.list(line);
    }
  }

  // `nis` of one whose NIS is among the largest of its group.
  state({ box, note, names }, status, nis) {
    if (box) {
      const used = names.every((name) => status.used[name]);
      if (document.activeElement !== box || box.checked === used) box.checked = used;
    }
    const states = [...new Set(names.map((name) => status.sensors[name]?.state ?? "tracking"))].filter((state) => state !== "tracking");
    setText(note, [...states, ...(nis ? [`NIS / dof ${compact(nis, 2)}`] : [])].join(", "));
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
    for (const [key, knob] of this.knobs) knob.sync(status.tuning[key]);
    this.syncGate(status);
    for (const line of this.sensors) {
      this.state(line, status);
      const group = line.unit && status.groups[line.unit.name];
      if (!group) continue;
      line.light.dataset.health = group.state;
      setText(line.light, SIGNS[group.state]);
      setText(line.note, `${group.alarms ? `${group.alarms} in alarm` : group.state === "tracking" ? "" : group.state}${group.nis === null ? "" : ` NIS / dof ${compact(group.nis, 2)}`}`.trim());
      setAttribute(line.node, "title", groupText(line.unit, group));
      const worst = new Map(group.worst);
      for (const member of line.members) this.state(member, status, worst.get(member.names[0]));
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
    if (changed(this.gate, known)) this.gate.replaceChildren(...known.map(([text, value]) => element("option", { value: value === null ? "off" : value }, text)));
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
    showText(this.notice, reason);
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

// Those whose name, as it is or in words, contains the text.
const matches = (items, nameOf, text) => items.filter((item) => [nameOf(item), words(nameOf(item))].some((name) => name.toLowerCase().includes(text.trim().toLowerCase())));

export function section(title, hint, open, ...children) {
  return element("details", { class: "section", open }, element("summary", { title: hint }, title), ...children);
}

// Of a filter that is not compiled yet: for how long it has been, or that it is to come.
function unready(compiling, name) {
  if (!(name in compiling)) return "";
  return compiling[name] === null ? " · to be compiled" : ` · compiling, ${Math.round(compiling[name])} s`;
}
