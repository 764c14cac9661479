// One line of the Tune panel: name, a logarithmic or linear slider with a tick at the configured value, the value with
// its unit, ×10, ÷10 and back. It never argues with the user who turns it.

import { element, setAttribute, setText } from "./dom.js";
import { compact, words } from "./format.js";

const DECADES = 3; // powers of ten to either side of the configured value
const STEPS = 1000;
const PATIENCE = 2000; // ms after an edit in which the engine's older value does not snap the line back
const TURN = 60; // ms between two values of a drag that are sent

export class Knob {
  // what: {label, unit, low, high, configured, logarithmic, whole, help}; send(value) resolves to a reason why not, or null
  constructor(what, send) {
    this.what = what;
    this.send = send;
    this.value = what.configured;
    this.edited = 0;
    this.logarithmic = what.logarithmic && what.configured > 0;
    this.slides = this.logarithmic || (Number.isFinite(what.low) && Number.isFinite(what.high) && what.high > what.low);
    const label = words(what.label);
    this.slider = this.slides
      ? element("input", {
          type: "range", min: 0, max: STEPS, step: 1, "aria-label": label, title: what.help,
          oninput: () => this.turned(this.at(this.slider.valueAsNumber / STEPS)),
          onchange: () => this.flush(),
        })
      : null;
    this.field = element("input", {
      type: "text", inputmode: "decimal", spellcheck: "false", autocomplete: "off", "aria-label": `${label}, value`,
      onchange: () => this.typed(), onfocus: () => this.field.select(),
      onkeydown: (event) => this.keyed(event),
    });
    this.back = element("button", { type: "button", class: "back", title: `Back to the configured ${compact(what.configured)}`, "aria-label": `${label}: as configured`, onclick: () => this.set(this.what.configured) }, "↺");
    const step = (factor, text) =>
      element("button", { type: "button", title: `${text} ${label}`, "aria-label": `${label} ${text}`, onclick: () => this.set(this.value * factor) }, text);
    this.said = element("button", { type: "button", class: "data-says", hidden: true, onclick: () => this.take() }, "◆");
    this.error = element("p", { class: "error", role: "alert", hidden: true });
    this.below = element("div", { class: "below" });
    this.node = element(
      "div", { class: `knob${this.slides ? "" : " plain"}`, dataset: { key: what.key ?? what.label } },
      element("label", { title: what.help ? `${label}: ${what.help}` : label }, ...label.split(/(?<=\.)/).flatMap((part, k) => (k ? [element("wbr"), part] : [part]))),
      this.slider ? element("span", { class: "track", style: `--tick:${100 * this.place(what.configured)}%` }, this.slider, this.said) : null,
      element("span", { class: "field" }, this.field, element("span", { class: "unit", title: what.unit }, what.unit && what.unit !== "1" ? what.unit : "")),
      this.logarithmic ? element("span", { class: "steps" }, step(0.1, "÷10"), step(10, "×10")) : null,
      this.back, this.error, this.below,
    );
    this.show(what.configured);
  }

  // Another value is the configured one.
  configure(value) {
    this.what.configured = value;
    setAttribute(this.back, "title", `Back to the configured ${compact(value)}`);
    this.edited = 0;
    this.show(this.value);
  }

  // What the data say the value is: a mark on the slider that takes it, or a hollow one at its end that
  // says why none is to be taken. saying: {value, text, take}, or null.
  say(saying) {
    this.take = saying?.take ?? (() => saying.value && this.set(saying.value));
    this.said.hidden = !saying;
    if (this.said.hidden) return;
    setText(this.said, saying.value ? "◆" : "◇");
    setAttribute(this.said, "aria-disabled", String(!saying.value));
    if (!saying.value) {
      this.said.style.setProperty("--place", 1);
      setAttribute(this.said, "title", `No value from the data: ${saying.text}`);
      setAttribute(this.said, "aria-label", `${words(this.what.label)}: no value from the data, ${saying.text}`);
      return;
    }
    this.said.style.setProperty("--place", this.place(saying.value));
    setAttribute(this.said, "title", `Data: ${saying.text}. Take ${compact(saying.value, 3)}`);
    setAttribute(this.said, "aria-label", `${words(this.what.label)}: take ${compact(saying.value, 3)}, as the data say`);
  }

  // Where on the slider a value is, from 0 to 1, and back.
  place(value) {
    const { configured, low, high } = this.what;
    const place = this.logarithmic ? (Math.log10(Math.max(value, 1e-300) / configured) + DECADES) / (2 * DECADES) : (value - low) / (high - low);
    return Math.min(1, Math.max(0, place));
  }

  at(place) {
    const { configured, low, high, whole } = this.what;
    if (this.logarithmic) return Number((configured * 10 ** (2 * DECADES * place - DECADES)).toPrecision(3));
    const value = low + place * (high - low);
    return whole ? Math.round(value) : Number(value.toPrecision(4));
  }

  // The engine's value, unless the user's own is still on its way there.
  sync(value) {
    if (typeof value !== "number") return;
    if (Math.abs(value - this.value) <= 1e-9 * Math.abs(value)) this.edited = 0;
    else if (performance.now() - this.edited > PATIENCE && document.activeElement !== this.field) this.show(value);
  }

  show(value) {
    this.value = value;
    if (this.slider) this.slider.value = Math.round(STEPS * this.place(value));
    if (document.activeElement !== this.field || this.edited) this.field.value = this.what.whole ? String(Math.round(value)) : compact(value);
    setAttribute(this.node, "data-turned", value !== this.what.configured ? "" : null);
    setAttribute(this.slider ?? this.field, "aria-valuetext", `${compact(value)} ${this.what.unit ?? ""}`);
  }

  // A drag: every value is shown, and the last of many is sent.
  turned(value) {
    this.edited = performance.now();
    this.show(value);
    this.wanted = value;
    this.timer ??= setTimeout(() => this.flush(), TURN);
  }

  flush() {
    clearTimeout(this.timer);
    this.timer = null;
    if (this.wanted === undefined) return;
    const value = this.wanted;
    this.wanted = undefined;
    this.submit(value);
  }

  set(value) {
    this.expect(value);
    this.submit(value);
  }

  // Another has asked for this value.
  expect(value) {
    this.edited = performance.now();
    this.wanted = undefined;
    this.show(value);
  }

  typed() {
    const text = this.field.value.trim().replace(",", ".");
    const value = Number(text);
    if (text === "" || !Number.isFinite(value)) return this.complain(`${words(this.what.label)} is “${text}”; it must be a number`);
    this.set(value);
  }

  keyed(event) {
    const step = { ArrowUp: 1, ArrowDown: -1 }[event.key];
    if (event.key === "Enter") this.field.blur();
    else if (event.key === "Escape") {
      this.field.value = compact(this.value);
      this.field.blur();
    } else if (step && this.logarithmic) {
      event.preventDefault();
      this.set(Number((this.value * 10 ** (step * (event.shiftKey ? 1 : 0.1))).toPrecision(3)));
    }
  }

  async submit(value) {
    this.complain(await this.send(value));
  }

  complain(reason) {
    setText(this.error, reason ?? "");
    this.error.hidden = !reason;
    setAttribute(this.field, "aria-invalid", reason ? "true" : null);
  }
}
