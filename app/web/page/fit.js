// Fit: a small panel beside the Tune column. What is fitted and over what, how far it is, and what came of it, which is
// offered only if it won on what it had not seen.

import { element, setText } from "./dom.js";
import { fitted } from "./fitted.js";
import { span, words } from "./format.js";
import { Panel } from "./panel.js";

const LOOK = 300; // ms between two looks at how far it is
const GROUPS = { Q: "Q", R: "R", p: "parameters", options: "options" };
const FIRST = ["Q", "R"]; // what is ticked at first
const LAST = [100_000, 20_000, 5_000]; // of so many events, where there are more
const BUSY = ["running", "cancelling"];

export class Fit {
  // tune: whose head has the button, and which puts in what was found
  constructor(model, link, tune) {
    Object.assign(this, { model, link, tune });
    this.button = element("button", { type: "button", id: "fit", title: "Fit noises and parameters to what was read" }, "Fit…");
    tune.restoreButton.before(this.button);
    this.form = element("div", { class: "form" });
    this.progress = element("div", { class: "progress", role: "status", hidden: true });
    this.error = element("p", { class: "error", role: "alert", hidden: true });
    this.result = element("div", { class: "result" });
    const opened = () => {
      if (this.estimator !== link.status.estimator) this.offer();
      return this.ask("GET");
    };
    this.box = new Panel(this.button, "fit-panel", "Fit to what was read", opened, this.form, this.progress, this.error, this.result);
    this.panel = this.box.node;
    this.count = element("output", {});
    this.progress.append(element("progress", { "aria-label": "Folding" }), this.count, this.cancelButton = element("button", { type: "button", id: "fit-cancel", class: "go", onclick: () => this.ask("DELETE") }, "Cancel"));
    link.addEventListener("status", ({ detail }) => {
      if (this.estimator !== detail.estimator && this.box.open) this.offer();
      if (this.told?.result && this.revision !== detail.revision) this.ask("GET");
      this.revision = detail.revision;
    });
  }

  // What may be fitted: a box a group, and under it one an entry.
  offer() {
    this.estimator = this.link.status.estimator;
    const options = this.model.estimators.find((entry) => entry.name === this.estimator)?.options ?? [];
    const keys = [...this.model.tuning.map((item) => item.key), ...options.filter((item) => !item.choices.length && !item.whole).map((item) => `options.${item.name}`)];
    this.groups = Object.entries(GROUPS).map(([prefix, title]) => group(prefix, title, keys.filter((key) => key.startsWith(`${prefix}.`)))).filter(Boolean);
    this.over = element("select", { id: "fit-over", "aria-label": "Over what" });
    this.beginButton = element("button", { type: "button", id: "fit-begin", class: "go", onclick: () => this.begin() }, "Fit");
    this.form.replaceChildren(
      element("div", { class: "groups", role: "group", "aria-label": "What is fitted" }, ...this.groups.map((item) => item.head)),
      element("details", { class: "entries" }, element("summary", {}, "single entries"), ...this.groups.map((item) => item.list)),
      element("div", { class: "pair" }, this.over, this.beginButton),
      element("p", { class: "about" }, "Every third block of time takes no part in the fit: it decides whether the result is better."));
  }

  begin() {
    const wanted = this.groups.flatMap((item) => item.wanted());
    return this.ask("POST", { wanted, ...(this.over.value ? { events: Number(this.over.value) } : {}) });
  }

  async ask(method, body) {
    clearTimeout(this.timer);
    const answer = await fetch("/api/fit", { method, ...(body ? { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) } : {}) }).catch(() => null);
    const told = answer?.headers.get("content-type")?.includes("json") ? await answer.json() : { error: "the twin does not answer" };
    this.say(told.error ?? "");
    if (!told.error) this.take(told);
    else if (BUSY.includes(this.told?.state)) this.timer = setTimeout(() => this.ask("GET"), 10 * LOOK);
  }

  say(reason) {
    setText(this.error, reason);
    this.error.hidden = !reason;
  }

  take(told) {
    const focused = this.panel.contains(document.activeElement) ? document.activeElement : null;
    this.show(told);
    // What is disabled, hidden or gone loses the focus: it goes to what can be done next.
    if (focused?.disabled || focused?.checkVisibility() === false) (this.progress.hidden ? this.beginButton : this.cancelButton).focus();
  }

  show(told) {
    const busy = BUSY.includes(told.state);
    this.lengths(told.available);
    this.progress.hidden = !busy;
    for (const item of this.form.querySelectorAll("input, select, button")) item.disabled = busy;
    this.cancelButton.disabled = told.state === "cancelling";
    setText(this.button, busy ? "Fitting…" : "Fit…");
    if (busy) {
      setText(this.count, `${told.state === "cancelling" ? "ending … " : ""}${told.folds} folds of ${told.events.toLocaleString("en")} events, ${span(told.elapsed)}`);
      this.timer = setTimeout(() => this.ask("GET"), LOOK);
    }
    if (told.state === "failed") this.say(told.reason);
    const key = `${told.number}/${told.state}/${told.current}`;
    if (key === this.key) return;
    [this.key, this.told] = [key, told];
    if (told.state === "cancelled") this.result.replaceChildren(element("p", { class: "faint" }, `Cancelled after ${told.folds} folds.`));
    else this.result.replaceChildren(...(told.result ? fitted(told, this.offers(told)) : []));
  }

  // Over what it may be: all, or the last of it.
  lengths(available) {
    const choices = [0, ...LAST.filter((most) => most < available)];
    const texts = choices.map((most) => (most ? `the last ${most.toLocaleString("en")} events` : `all ${available.toLocaleString("en")} events`));
    const known = [...this.over.options];
    if (known.length !== choices.length) this.over.replaceChildren(...choices.map((most) => element("option", { value: most || "" })));
    [...this.over.options].forEach((option, k) => setText(option, texts[k]));
  }

  // What can be done with a result: put in what won; of the rest, only what is clearly marked.
  offers(told) {
    const { proposed } = told.result;
    if (!Object.keys(told.values).length) return [];
    const late = told.current ? null : `It was fitted from run ${told.revision}; another runs now`;
    const use = element("button", { type: "button", id: "fit-use", class: proposed ? "go first" : "go quiet", disabled: Boolean(late), title: late ?? "One edit, which U takes back", onclick: () => this.use(told) }, proposed ? "Use it" : "use it all the same: it did not win");
    return [use, ...(proposed ? this.keeping(told) : []), late ? element("span", { class: "faint" }, late) : null].filter(Boolean);
  }

  // Under a name, whether it is put in or not.
  keeping(told) {
    const name = element("input", { type: "text", id: "fit-name", "aria-label": "Name of the version", placeholder: "name", maxlength: 60, value: `fit-${told.number}` });
    const keep = async () => {
      const note = `fitted: ${told.wanted.join(", ")}`;
      const answer = await fetch("/api/fit/keep", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ name: name.value.trim(), note }) }).catch(() => null);
      this.say(answer?.ok ? "" : ((await answer?.json().catch(() => null))?.error ?? "the twin does not answer"));
      setText(kept, answer?.ok ? `kept as ${name.value.trim()}, see Runs` : "");
    };
    const kept = element("span", { class: "faint", role: "status" });
    return [element("span", { class: "space" }), name, element("button", { type: "button", id: "fit-keep", class: "go", title: "Beside the twin, with what it was worth on the blocks held out", onclick: keep }, "Keep as a version"), kept];
  }

  async use(told) {
    const before = Object.fromEntries(told.result.entries.filter((line) => line.key in told.values).map((line) => [line.key, line.before]));
    this.say((await this.tune.edit(`fit ${told.number}`, "SetTunings", { values: told.values }, { values: before })) ?? "");
  }
}

function group(prefix, title, keys) {
  if (!keys.length) return null;
  const chosen = FIRST.includes(prefix);
  const all = element("input", { type: "checkbox", checked: chosen, onchange: () => boxes.forEach((box) => (box.checked = all.checked)) });
  const follow = () => {
    const count = boxes.filter((box) => box.checked).length;
    all.checked = count === boxes.length;
    all.indeterminate = count > 0 && count < boxes.length;
  };
  const boxes = keys.map((key) => element("input", { type: "checkbox", checked: chosen, value: key, onchange: follow }));
  const list = element("div", { class: "entry-list" }, ...boxes.map((box) => element("label", {}, box, words(box.value))));
  const wanted = () => (all.checked ? [prefix] : boxes.filter((box) => box.checked).map((box) => box.value));
  return { head: element("label", { title: keys.join(", ") }, all, `${title} `, element("small", {}, String(keys.length))), list, wanted };
}
