// Around a knob: a small curve of likelihood and NIS over values about the present one, folded in the background, and
// what the innovations themselves say of each R and of Q.

import { $, element, setAttribute, setText } from "./dom.js";
import { compact, spaced } from "./format.js";

const [WIDTH, HEIGHT, EDGE] = [260, 64, 6]; // of the drawing
const MOST = 3; // curves that stay open
const LOOK = 300; // ms between two looks at whether something is wanted
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
    setInterval(() => link.socket && link.status.tuning && this.heard(link.status), LOOK);
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
    if (this.open.size === MOST && this.below(oldest, key)) this.close(oldest);
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
      const answer = await fetch(`/api/around?key=${encodeURIComponent(curve.key)}`).catch(() => null);
      if (answer?.ok) curve.take(await answer.json());
    }
    if (!due) return;
    const answer = await fetch("/api/noise").catch(() => null);
    if (!answer?.ok) return;
    this.said = await answer.json();
    this.mark();
  }

  // What is said of a key: {value, text, take}, or null. Of Q it is one factor of all: sizes alone tell no more.
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
    for (const [key, knob] of this.tune.knobs) knob.say(key[1] === "." && key[0] !== "p" ? this.saying(key) : null);
    for (const curve of this.open.values()) curve.write();
    const doubt = this.said.Q?.doubt;
    const level = doubt ? null : this.said.Q?.level;
    const scale = $("scale-Q");
    if (!scale) return;
    scale.disabled = !level;
    setText(scale, level ? `data ×${compact(level, 2)}` : "data –");
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
    if (!swept.points.length && !swept.done && this.swept) return; // the older curve says more than none
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
      setText(button, `${k || !best || best.factor === 1 ? "data say" : "take"} ${compact(value, 3)}`);
      setAttribute(button, "title", `Take it: ${title}`);
    }
    setText(this.why, said && !said.value ? said.text : "");
  }
}
