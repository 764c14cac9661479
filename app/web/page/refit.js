// Dual estimation: what was fitted on the last window beside the running twin. What won is a card above the knobs, to be
// accepted or dismissed; every fit, with its evidence, is in a panel.

import { element, setText } from "./dom.js";
import { fitted } from "./fitted.js";
import { clock, compact, span, spaced, words } from "./format.js";
import { Panel } from "./panel.js";

export class Refit {
  constructor(model, link, tune) {
    Object.assign(this, { model, link, opened: new Set() });
    this.said = element("span", { class: "faint", role: "status" });
    this.button = element("button", { type: "button", id: "refit-open", title: "Every fit, with its evidence" }, "Fits…");
    this.offer = element("div", {});
    this.error = element("p", { class: "error", role: "alert", hidden: true });
    const head = element("div", { class: "refit-head" }, element("h3", { title: "A fit of parameters on the last readings, at set times, beside the filter of the state" }, "Dual estimation"), this.said, element("span", { class: "space" }), this.button);
    this.card = element("section", { id: "refit", "aria-label": "Dual estimation", hidden: true }, head, this.offer, this.error);
    tune.sections.before(this.card);
    this.about = element("p", { class: "about" });
    this.begin = element("button", { type: "button", id: "refit-begin", class: "go", title: "Fit the last window at once", onclick: () => this.post("/api/refit", {}) }, "Fit now");
    this.list = element("div", { class: "fits" });
    this.panel = new Panel(this.button, "refit-panel", "Dual estimation", () => this.look(), this.about, element("div", { class: "progress" }, this.begin), this.list);
    link.addEventListener("status", ({ detail }) => {
      this.card.hidden = !detail.refit;
      if (this.card.hidden) return;
      const key = JSON.stringify([detail.refit, detail.reloads]);
      if (key === this.key) return;
      this.key = key;
      this.look();
    });
  }

  async look() {
    const answer = await fetch("/api/refit").catch(() => null);
    if (answer?.ok) this.show(await answer.json());
  }

  // Says why where it is refused.
  async post(path, fields) {
    const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(fields) }).catch(() => null);
    const reason = answer?.ok ? "" : ((await answer?.json().catch(() => null))?.error ?? "the twin does not answer");
    setText(this.error, reason);
    this.error.hidden = !reason;
    await this.look();
  }

  show({ section, due, fits }) {
    if (!section) return;
    const origin = Number(this.link.status.origin ?? 0);
    const at = (time) => clock((Number(time) - origin) / 1e9);
    const busy = fits[0]?.state === "fitting";
    setText(this.said, busy ? "fitting …" : due ? `next at ${at(due)}` : "");
    this.begin.disabled = busy;
    const rule = section.adopt === "by hand" ? "what is better waits here for you" : "what is better is adopted, and said";
    setText(this.about, `${section.entries.map(words).join(", ")}: fitted every ${span(section.every)} on the last ${span(section.window)}; ${rule}.`);
    const proposed = fits.find((fit) => fit.state === "proposed");
    const held = this.offer.contains(document.activeElement);
    this.offer.replaceChildren(...(proposed ? this.proposal(proposed) : []));
    if (held) (this.offer.querySelector("button") ?? this.button).focus();
    this.list.replaceChildren(...fits.map((fit) => this.fit(fit, at)));
  }

  proposal(fit) {
    const { verdict, entries } = fit.result;
    const rows = entries.filter((line) => !line.alone).map((line) => element("tr", {},
      element("th", { scope: "row" }, words(line.key)),
      element("td", { title: `95 % interval ${compact(line.low, 3)} … ${compact(line.high, 3)}${spaced(line.unit)}` }, `${compact(line.before)} → `, element("b", {}, compact(line.after)), spaced(line.unit)),
      element("td", { title: "Standard deviations of its estimate by which it moved" }, `${line.sigma < 0 ? "−" : "+"}${Math.abs(line.sigma).toFixed(1)} σ`)));
    const decide = (what) => () => this.post(`/api/refit/${what}`, { number: fit.number });
    return [
      element("table", {}, element("tbody", {}, ...rows)),
      element("p", { class: "about" }, `Better on the blocks held out: +${compact(verdict.gain, 3)} ± ${compact(verdict.error, 2)} nats a reading.`),
      element("div", { class: "offers" },
        element("button", { type: "button", id: "refit-accept", class: "go first", title: "Keep it as a tuning version with its evidence, and fold again with it", onclick: decide("accept") }, "Accept"),
        element("button", { type: "button", id: "refit-dismiss", class: "go", title: "Leave things as they are, until the data say something else", onclick: decide("dismiss") }, "Dismiss")),
    ];
  }

  fit(fit, at) {
    const done = fit.name ? `${fit.state} as ${fit.name}` : fit.state;
    const node = element("details", { open: this.opened.has(fit.number), dataset: { state: fit.state } },
      element("summary", { title: fit.text }, element("b", {}, `${fit.number}`), ` ${at(fit.start)} to ${at(fit.end)}: ${done}`),
      element("p", {}, fit.text), ...(fit.result ? fitted(fit, []) : []));
    node.addEventListener("toggle", () => (node.open ? this.opened.add(fit.number) : this.opened.delete(fit.number)));
    return node;
  }
}
