// One line of the Tune panel: name, a logarithmic or linear slider with a tick at the configured value, the value with
// its unit, ×10, ÷10 and back. It never argues with the user who turns it.

import { $, element, refusal, setAttribute, setText, showText } from "./dom.js";
import { compact, spaced, words } from "./format.js";
import { get } from "./http.js";

const DECADES = 3; // powers of ten to either side of the configured value
const STEPS = 1000;
const EDIT_HOLD_MS = 2000; // ms after an edit in which the engine's older value does not snap the line back
const TURN = 60; // ms between two values of a drag that are sent
const BURST_MS = 1000; // ms between two keys of one gesture

// Names of gestures: one from pointer-down to pointer-up, one for keys in quick succession.
export class Gestures {
  constructor() {
    this.last = -Infinity;
  }

  begin() {
    this.held = true;
    this.name = crypto.randomUUID();
  }

  end() {
    this.held = false;
    this.last = -Infinity;
  }

  get next() {
    const now = performance.now();
    if (!this.held && now - this.last > BURST_MS) this.name = crypto.randomUUID();
    this.last = now;
    return this.name;
  }
}

export class Knob {
  // what: {label, unit, low, high, configured, logarithmic, whole, help}; send(value, gesture) resolves to a reason why not, or null
  constructor(what, send) {
    this.what = what;
    this.send = send;
    this.value = what.configured;
    this.edited = 0;
    this.gestures = new Gestures();
    this.logarithmic = what.logarithmic && what.configured > 0;
    this.slides = this.logarithmic || (Number.isFinite(what.low) && Number.isFinite(what.high) && what.high > what.low);
    const label = words(what.label);
    this.slider = this.slides
      ? element("input", {
          type: "range", min: 0, max: STEPS, step: 1, "aria-label": label, title: what.help,
          oninput: () => this.turned(this.at(this.slider.valueAsNumber / STEPS)),
          onchange: () => this.flush(),
          onpointerdown: () => this.gestures.begin(),
          onpointerup: () => this.gestures.end(),
          onpointercancel: () => this.gestures.end(),
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
    this.error = refusal();
    this.below = element("div", { class: "below" });
    this.node = element(
      "div", { class: `knob${this.slides ? "" : " plain"}`, dataset: { key: what.key ?? what.label } },
      element("label", { title: what.help ? `${label}: ${what.help}` : label }, ...label.split(/(?<=\.)/).flatMap((part, k) => (k ? [element("wbr"), part] : [part]))),
      element("span", { class: "field" }, this.field, element("span", { class: "unit", title: what.unit }, what.unit && what.unit !== "1" ? what.unit : "")),
      this.logarithmic ? element("span", { class: "steps" }, step(0.1, "÷10"), step(10, "×10")) : null,
      this.back,
      this.slider ? element("span", { class: "track" }, this.slider, this.scale = element("span", { class: "scale", "aria-hidden": "true" }), this.said) : null,
      this.error, this.below,
    );
    this.graduate();
    this.show(what.configured);
  }

  // Ticks below the slider: powers of ten, or both ends; and the configured value.
  graduate() {
    if (!this.slider) return;
    const { configured, low, high } = this.what;
    const middle = Math.log10(configured);
    const first = Math.ceil(middle - DECADES - 1e-9);
    const powers = Array.from({ length: Math.floor(middle + DECADES + 1e-9) - first + 1 || 0 }, (_, k) => Number(`1e${first + k}`));
    const tick = (value, text, name) => element("i", { class: name, style: `--place:${this.place(value)}` }, text);
    this.scale.replaceChildren(
      ...(this.logarithmic ? powers : [low, high]).map((value) => tick(value, compact(value, 3))), tick(configured, "", "configured"));
  }

  // Another value is the configured one.
  configure(value) {
    this.what.configured = value;
    setAttribute(this.back, "title", `Back to the configured ${compact(value)}`);
    this.graduate();
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
    else if (performance.now() - this.edited > EDIT_HOLD_MS && document.activeElement !== this.field) this.show(value);
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
    this.wanted = [value, this.gestures.next];
    this.timer ??= setTimeout(() => this.flush(), TURN);
  }

  flush() {
    clearTimeout(this.timer);
    this.timer = null;
    if (this.wanted === undefined) return;
    const wanted = this.wanted;
    this.wanted = undefined;
    this.submit(...wanted);
  }

  set(value, gesture) {
    this.expect(value);
    this.submit(value, gesture);
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
      this.set(Number((this.value * 10 ** (step * (event.shiftKey ? 1 : 0.1))).toPrecision(3)), this.gestures.next);
    }
  }

  async submit(value, gesture) {
    this.complain(await this.send(value, gesture));
  }

  complain(reason) {
    showText(this.error, reason);
    setAttribute(this.field, "aria-invalid", reason ? "true" : null);
  }
}

// Around a slider: a small curve of likelihood and NIS over values near the present one, folded in the background, and
// the values of R and Q that the innovations suggest.

const [WIDTH, HEIGHT, EDGE] = [260, 64, 6]; // of the drawing
const MAX_OPEN_CURVES = 3; // curves that stay open
const CURVE_POLL_MS = 300; // ms between two looks at whether something is wanted
const AGAIN = 10_000; // ms between two looks at what the innovations say
const SOON = 1000; // the same while it is being folded
const DROPS = 3; // how many of the values nearest the optimum rule the height of the curve

export class Around {
  // tune: whose knobs; turn(key, value) resolves to a reason why not, or null
  constructor(model, link, tune) {
    Object.assign(this, { model, link, tune });
    this.open = new Map(); // key: {curve}
    this.said = { R: {}, Q: null };
    for (const [key, knob] of tune.knobs) {
      const label = knob.node.querySelector("label");
      for (const [name, value] of Object.entries({ role: "button", tabindex: 0, "aria-expanded": "false", title: `${label.title}: likelihood and NIS around its value` })) setAttribute(label, name, value);
      label.addEventListener("click", () => this.toggle(key));
      label.addEventListener("keydown", (event) => ["Enter", " "].includes(event.key) && (event.preventDefault(), event.stopPropagation(), this.toggle(key)));
    }
    setInterval(() => link.connected && link.status.tuning && this.heard(link.status), CURVE_POLL_MS);
  }

  toggle(key) {
    if (this.open.has(key)) this.close(key);
    else this.show(key);
  }

  close(key) {
    this.open.delete(key);
    const { node, below } = this.tune.knobs.get(key);
    setAttribute(node.querySelector("label"), "aria-expanded", "false");
    below.replaceChildren();
  }

  // The line of a knob that was turned opens by itself, and stays: closing another would move it under the pointer.
  show(key) {
    if (this.open.has(key) || !this.tune.knobs.has(key)) return;
    const oldest = [...this.open.keys()][0];
    if (this.open.size === MAX_OPEN_CURVES && this.below(oldest, key)) this.close(oldest);
    setAttribute(this.tune.knobs.get(key).node.querySelector("label"), "aria-expanded", "true");
    this.open.set(key, new Curve(this, key, this.tune.knobs.get(key)));
  }

  // Whether a line stands beneath another, so that closing it moves nothing that is being turned.
  below(line, other) {
    const [a, b] = [line, other].map((key) => this.tune.knobs.get(key).node);
    return Boolean(b.compareDocumentPosition(a) & Node.DOCUMENT_POSITION_FOLLOWING);
  }

  heard(status) {
    if (status.refolding || !this.link.settled || this.asking || !$("tune").checkVisibility()) return;
    const now = performance.now();
    const wait = this.said.Q?.done ? AGAIN : SOON;
    const due = this.revision !== status.revision || now - this.when > wait;
    const curves = [...this.open.values()].filter((curve) => curve.due(status.revision, now));
    if (!due && !curves.length) return;
    this.asking = true;
    this.ask(due, curves).finally(() => {
      this.asking = false;
      if (due) [this.revision, this.when] = [status.revision, performance.now()];
    });
  }

  async ask(due, curves) {
    for (const curve of curves) {
      const swept = await get(`api/around?key=${encodeURIComponent(curve.key)}`);
      if (!swept.error) curve.take(swept);
    }
    if (!due) return;
    const said = await get("api/noise");
    if (said.error) return;
    this.said = said;
    this.mark();
  }

  // The suggestion for a key, {value, text, take}, or null. Q has one common factor: sizes alone do not determine more.
  saying(key) {
    const knob = this.tune.knobs.get(key);
    if (key.startsWith("Q.")) {
      const level = this.said.Q?.level;
      if (!level || !(knob.value > 0)) return null;
      if (this.said.Q.doubt) return { value: null, text: this.said.Q.doubt };
      return { value: Number((knob.value * level).toPrecision(3)), text: `the innovations are as large as the filter says with all of Q ×${compact(level, 3)}`, take: () => this.tune.scale("Q", level) };
    }
    const found = this.said.R[key];
    if (!found) return null;
    if (found.doubt) return { value: null, text: found.doubt };
    if (found.value === null) return { value: null, text: "innovations are smaller than Q alone explains: no R is left" };
    return { value: Number(found.value.toPrecision(3)), text: `the innovations say ${compact(found.value, 3)} ± ${compact(found.std, 2)}${spaced(knob.what.unit)}` };
  }

  mark() {
    this.tune.marks.hidden = false;
    for (const [key, knob] of this.tune.knobs) knob.say(key[1] === "." && key[0] !== "p" ? this.saying(key) : null);
    for (const curve of this.open.values()) curve.write();
    const doubt = this.said.Q?.doubt;
    const level = doubt ? null : this.said.Q?.level;
    const scale = $("scale-Q");
    if (!scale) return;
    scale.disabled = !level;
    setText(scale, level ? `◆ ×${compact(level, 2)}` : "◇ none");
    setAttribute(scale, "aria-label", `All of Q as the data suggest: ${level ? `×${compact(level, 2)}` : "no factor"}`);
    setAttribute(scale, "title", level
      ? `All of Q ×${compact(level, 3)}: there the innovations are as large as the filter says. Take it`
      : doubt ? `Not to be taken: ${doubt}` : this.said.Q?.done ? "Between ×0.1 and ×10 no level of Q makes the innovations as large as the filter says" : "Being folded in the background …");
    scale.dataset.level = level ?? "";
  }
}

// The drawing under one knob.
class Curve {
  constructor(around, key, knob) {
    Object.assign(this, { around, key, knob });
    this.drawing = element("svg:svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, class: "curve", role: "img", onpointermove: (event) => this.point(event), onpointerleave: () => this.write() });
    this.line = element("output", {});
    // They stay: a button that is replaced under the pointer cannot be pressed.
    this.buttons = [0, 1].map((k) => element("button", { type: "button", class: "go", hidden: "", onclick: () => this.knob.set(this.offers[k][0]) }));
    this.why = element("span", { class: "faint" });
    this.takes = element("span", { class: "takes" }, ...this.buttons, this.why);
    const close = element("button", { type: "button", title: "Close", "aria-label": `Close the curve of ${knob.what.label}`, onclick: () => around.close(key) }, "×");
    this.node = element("div", { class: "around" }, this.drawing, element("div", { class: "said" }, this.line, close), this.takes);
    knob.below.replaceChildren(this.node);
    setText(this.line, "folding …");
  }

  // Whether it is to be asked for: another revision runs, or not all is there.
  due(revision, now) {
    return this.swept?.revision !== revision || !this.swept.done || now - this.when > AGAIN;
  }

  take(swept) {
    this.when = performance.now();
    if (!swept.points.length && !swept.done && this.swept) return; // keep the older curve
    this.swept = swept;
    this.node.dataset.done = swept.done;
    this.draw();
    this.write();
  }

  draw() {
    const points = this.swept.points.filter((point) => point.log_likelihood !== null && point.nis !== null);
    const factors = this.swept.points.map((point) => Math.log(point.factor));
    const [left, right] = [Math.min(...factors, -2.4), Math.max(...factors, 2.4)];
    const x = (point) => EDGE + ((WIDTH - 2 * EDGE) * (Math.log(point.factor) - left)) / (right - left);
    const top = Math.max(...points.map((point) => point.log_likelihood));
    // What is far off would flatten all else: it stands at the bottom.
    const drops = points.map((point) => top - point.log_likelihood).sort((a, b) => a - b);
    const most = Math.max(1, 1.5 * (drops[Math.min(DROPS, drops.length - 1)] ?? 0));
    const y = (point) => EDGE + (HEIGHT - 2 * EDGE) * Math.min(1, (top - point.log_likelihood) / most);
    const level = (nis) => HEIGHT / 2 - ((HEIGHT / 2 - EDGE) * Math.max(-1, Math.min(1, Math.log10(nis))));
    const path = (height) => points.map((point, k) => `${k ? "L" : "M"}${x(point).toFixed(1)} ${height(point).toFixed(1)}`).join("");
    const best = points.find((point) => point.value === this.swept.best);
    const now = { factor: 1 };
    this.x = x;
    this.drawing.replaceChildren(
      element("svg:line", { class: "one", x1: 0, x2: WIDTH, y1: HEIGHT / 2, y2: HEIGHT / 2 }),
      element("svg:line", { class: "now", x1: x(now), x2: x(now), y1: 0, y2: HEIGHT }),
      element("svg:path", { class: "nis", d: path((point) => level(point.nis)) }),
      element("svg:path", { class: "likelihood", d: path(y) }),
      ...points.map((point) => element("svg:circle", { class: point === best ? "best" : null, cx: x(point), cy: y(point), r: point === best ? 4 : 2 })),
    );
    setAttribute(this.drawing, "aria-label", `log-likelihood and NIS over ${this.knob.what.label}: ${points.map((point) => this.words(point, top)).join("; ")}`);
  }

  words(point, top) {
    const less = top - point.log_likelihood;
    return `${compact(point.value, 3)}: log L ${less < 0.05 ? "best" : `−${compact(less, 3)}`}, NIS ${compact(point.nis, 3)}`;
  }

  // The value under the pointer.
  point(event) {
    const points = this.swept?.points.filter((point) => point.log_likelihood !== null) ?? [];
    if (!points.length) return;
    const at = (event.offsetX / this.drawing.clientWidth) * WIDTH;
    const nearest = points.reduce((a, b) => (Math.abs(this.x(a) - at) <= Math.abs(this.x(b) - at) ? a : b));
    setText(this.line, this.words(nearest, Math.max(...points.map((point) => point.log_likelihood))));
  }

  write() {
    const { swept } = this;
    if (!swept) return;
    const best = swept.points.find((point) => point.value === swept.best);
    const last = swept.points.length > 1 && best && (best === swept.points[0] || best === swept.points.at(-1)) ? ", or beyond" : "";
    setText(this.line, swept.reason || (best ? `likeliest at ${compact(best.value, 3)}${last}, NIS ${compact(best.nis, 3)}${swept.done ? "" : " …"}` : swept.done ? "no value can be folded" : "folding …"));
    const said = this.key.startsWith("R.") ? this.around.saying(this.key) : null;
    // The likelihood, too, is that of white innovations.
    const doubted = Boolean(this.around.said.R[this.key]?.doubt);
    const offers = [best && best.factor !== 1 && !doubted ? [best.value, "likeliest of those that were folded"] : null, said?.value ? [said.value, said.text] : null].filter(Boolean);
    this.offers = offers;
    for (const [k, button] of this.buttons.entries()) {
      button.hidden = !offers[k];
      if (!offers[k]) continue;
      const [value, title] = offers[k];
      setText(button, `${k || !best || best.factor === 1 ? "◆ take" : "take"} ${compact(value, 3)}`);
      setAttribute(button, "title", `Take it: ${title}`);
    }
    setText(this.why, said && !said.value ? said.text : "");
  }
}
