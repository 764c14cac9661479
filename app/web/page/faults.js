// Faults on demand and maintenance: put something wrong into what the source says, and see how soon the twin tells.

import { element, keyed, refusal, setText, showText } from "./dom.js";
import { spaced, words } from "./format.js";
import { get } from "./http.js";
import { section } from "./tune.js";

export class Faults {
  constructor(node, model, link) {
    Object.assign(this, { node, model, link });
    this.begin();
  }

  async begin() {
    this.catalogue = await get("api/faults");
    if (this.catalogue.error) return;
    this.node.append(element("h2", { class: "unseen" }, "Faults and maintenance"), this.faultSection(), this.maintenanceSection());
    this.link.addEventListener("status", (event) => this.show(event.detail));
    this.show(this.link.status);
  }

  faultSection() {
    const { kinds, available } = this.catalogue;
    const hint = "Put something wrong into what the source says, and see how soon the twin tells";
    if (!available) return section("Faults on demand", hint, false, element("p", { class: "about" }, "A recording that is reviewed holds what came, faults included."));
    this.kind = element("select", { "aria-label": "Fault", onchange: () => this.offer() }, ...kinds.map((kind) => element("option", { value: kind.name, title: kind.help }, words(kind.name))));
    this.target = element("select", { "aria-label": "Target", onchange: () => this.offerRows() });
    this.row = element("select", { "aria-label": "Row", onchange: () => this.showUnits() });
    this.other = element("select", { "aria-label": "Swapped with" });
    this.help = element("p", { class: "about" });
    this.numbers = element("div", { class: "numbers" });
    this.note = refusal();
    this.list = element("ul", { class: "held" });
    const inject = element("button", { type: "button", id: "inject", class: "go", onclick: () => this.inject() }, "Inject");
    const made = section("Faults on demand", hint, false, element("div", { class: "pair" }, this.kind, this.target),
      element("div", { class: "pair" }, this.row, this.other), this.help, this.numbers, inject, this.note, this.list);
    this.offer();
    return made;
  }

  offer() {
    const kind = this.catalogue.kinds.find((item) => item.name === this.kind.value);
    const known = { sensor: Object.keys(this.catalogue.sensors), input: Object.keys(this.catalogue.inputs), parameter: Object.keys(this.catalogue.parameters), all: [""] };
    const option = (what) => (name) => element("option", { value: name && what !== "sensor" ? `${what}.${name}` : name }, name ? `${words(name)}${what === "sensor" ? "" : ` (${what})`}` : "the whole source");
    const targets = ["sensor", "input", "parameter"].filter((what) => kind.of.includes(what)).flatMap((what) => known[what].map(option(what)));
    if (!kind.of.some((what) => what in known) || kind.of.some((what) => !["sensor", "input", "parameter"].includes(what))) targets.push(option("all")(""));
    this.target.replaceChildren(...targets);
    setText(this.help, kind.help);
    this.fields = new Map();
    const rows = kind.parameters.map((number) => {
      const field = element("input", { type: "text", inputmode: "decimal", "aria-label": words(number.name), placeholder: number.default ?? "" });
      this.fields.set(number.name, field);
      return element("label", { title: number.help }, element("span", {}, words(number.name)), field, element("span", { class: "unit", dataset: { unit: number.unit ?? "" } }));
    });
    const duration = element("input", { type: "text", inputmode: "decimal", "aria-label": "duration", placeholder: "until stopped" });
    this.fields.set("duration", duration);
    this.numbers.replaceChildren(...rows, element("label", {}, element("span", {}, "duration"), duration, element("span", { class: "unit" }, "s")));
    this.offerRows();
  }

  offerRows() {
    const kind = this.catalogue.kinds.find((item) => item.name === this.kind.value);
    const rows = (kind.rows && this.catalogue.sensors[this.target.value]) || [];
    this.row.replaceChildren(element("option", { value: "" }, "all rows"), ...rows.map((row) => element("option", { value: row.name }, words(row.name))));
    this.row.hidden = rows.length < 2;
    const others = kind.other ? Object.keys(this.catalogue.sensors).filter((name) => name !== this.target.value) : [];
    this.other.replaceChildren(...others.map((name) => element("option", { value: name }, words(name))));
    this.other.hidden = !others.length;
    this.showUnits();
  }

  /* "row" in a unit is the unit of the chosen sensor; rows of several units have none in common. */
  showUnits() {
    const { sensors, inputs, parameters } = this.catalogue;
    const [what, name] = this.target.value.split(/\.(.*)/s);
    const rows = (sensors[this.target.value] ?? []).filter((row) => this.row.hidden || !this.row.value || row.name === this.row.value);
    const units = new Set(what in { input: 1, parameter: 1 } && name ? [{ input: inputs, parameter: parameters }[what][name]] : rows.map((row) => row.unit));
    const own = units.size === 1 ? [...units][0] : "";
    for (const node of this.numbers.querySelectorAll("[data-unit]")) {
      const unit = node.dataset.unit.replace("row", own);
      setText(node, own || !node.dataset.unit.includes("row") ? spaced(unit).trim() : "");
    }
  }

  async inject() {
    const fields = { kind: this.kind.value };
    if (this.target.value) fields.target = this.target.value;
    if (!this.row.hidden && this.row.value) fields.row = this.row.value;
    if (!this.other.hidden) fields.other = this.other.value;
    for (const [name, field] of this.fields) {
      const text = field.value.trim().replace(",", ".");
      if (text !== "") fields[name] = Number.isFinite(Number(text)) ? Number(text) : text;
    }
    showText(this.note, await this.link.ask("InjectFault", fields));
  }

  show(status) {
    if (!this.list) return; // of a recording there is none to put in
    const held = status.faults ?? [];
    const stop = ({ number }) => element("button", { type: "button", onclick: () => this.link.ask("ClearFault", { number }) }, "stop");
    const entries = keyed(this.list, held, ({ number }) => number, (fault) => element("li", {}, element("span", {}), stop(fault)));
    held.forEach((fault, k) => setText(entries[k].firstChild, fault.text ?? words(fault.kind)));
  }

  maintenanceSection() {
    const what = element("input", { type: "text", placeholder: "changed part", "aria-label": "Changed part", maxlength: 200 });
    const which = element("select", { "aria-label": "States concerned" }, element("option", { value: "" }, "all states"), ...this.model.states.map((state) => element("option", { value: state.name }, words(state.name))));
    const note = refusal();
    const done = async () => {
      const states = which.value ? [which.value] : this.model.states.map((state) => state.name);
      const reason = await this.link.ask("Maintenance", { what: what.value.trim(), states });
      showText(note, reason);
      if (!reason) what.value = "";
    };
    const reset = element("button", { type: "button", id: "reset", title: "Restart the estimate from the prior", onclick: () => this.link.ask("Reset") }, "Reset the estimate");
    return section("Maintenance", "Something of the asset was changed: states start again, a new version of the model begins", false,
      element("div", { class: "pair" }, what, which), element("div", { class: "pair" }, element("button", { type: "button", class: "go", onclick: done }, "Done"), reset), note);
  }
}
