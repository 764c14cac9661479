// Advice: which estimator the log speaks for, as cards. One for what is recommended, which applies itself, and one for each
// claim with the figure that made it; where noises are off, its card opens the fit.

import { element, setText } from "./dom.js";
import { compact, words } from "./format.js";
import { Panel } from "./panel.js";

const LOOK = 500; // ms between two looks at whether it is there

export class Advice {
  constructor(model, link, tune) {
    Object.assign(this, { model, link, tune });
    this.button = element("button", { type: "button", id: "advise", title: "Which estimator what was read speaks for, and why" }, "Advice…");
    tune.restoreButton.before(this.button);
    this.measure = element("button", { type: "button", id: "advice-begin", class: "go", onclick: () => this.ask("POST") }, "Measure");
    this.said = element("span", { class: "faint", role: "status" });
    this.error = element("p", { class: "error", role: "alert", hidden: true });
    this.cards = element("div", { class: "claims" });
    this.panel = new Panel(this.button, "advice-panel", "Which estimator, and why", () => this.ask("GET"),
      element("div", { class: "progress" }, this.measure, this.said), this.error, this.cards);
    link.addEventListener("status", ({ detail }) => {
      if (this.told?.advice && this.revision !== detail.revision && this.panel.open) this.ask("GET");
      this.revision = detail.revision;
    });
  }

  async ask(method) {
    clearTimeout(this.timer);
    const answer = await fetch("/api/advice", { method, ...(method === "POST" ? { headers: { "Content-Type": "application/json" }, body: "{}" } : {}) }).catch(() => null);
    const told = answer?.headers.get("content-type")?.includes("json") ? await answer.json() : { error: "the twin does not answer" };
    this.say(told.error ?? told.reason);
    if (told.error) return;
    const busy = told.state === "running";
    if (busy && this.panel.open) this.timer = setTimeout(() => this.ask("GET"), LOOK);
    this.measure.disabled = busy;
    setText(this.said, busy ? "folding the log by one filter after another …" : told.advice && !told.current ? `of run ${told.revision}; another runs now` : told.advice ? "" : "nothing measured yet: it folds the log by one filter after another");
    const key = `${told.state}/${told.revision}/${told.current}`;
    if (key === this.key) return;
    this.key = key;
    this.told = told;
    this.cards.replaceChildren(...(told.advice ? [this.recommended(told), ...told.advice.claims.map((claim) => this.claim(claim, told.advice.because))] : []));
  }

  say(reason) {
    setText(this.error, reason ?? "");
    this.error.hidden = !reason;
  }

  recommended({ advice }) {
    const title = this.model.estimators.find((entry) => entry.name === advice.estimator)?.title ?? advice.estimator;
    const options = Object.entries(advice.options).map(([name, value]) => `${words(name)} ${compact(value)}`).join(", ");
    const has = advice.has === advice.estimator && !options;
    return element("article", { class: "first" },
      element("header", {}, element("h3", {}, has ? `${title}: as it is` : title), element("span", { class: "space" }),
        has ? null : element("button", { type: "button", id: "advice-apply", class: "go first", title: "One edit, which U takes back", onclick: () => this.apply(advice) }, "Apply")),
      options ? element("p", {}, options) : null, ...advice.reasons.map((reason) => element("p", {}, `because ${reason}`)));
  }

  claim(claim, because) {
    const figure = claim.figure === null || claim.threshold === null ? null : element("p", { class: "faint" }, `${compact(claim.figure, 3)} ${claim.of}, limit ${compact(claim.threshold, 3)}`);
    const fit = claim.key === "consistent" && claim.answer === "no" ? element("button", { type: "button", class: "go", onclick: () => this.tune.fit.box.toggle(true) }, "Fit…") : null;
    return element("article", { dataset: { decides: because.includes(claim.key) } },
      element("header", {}, element("h3", {}, claim.question), element("span", { class: "space" }), element("b", {}, claim.answer)),
      figure, element("p", {}, claim.reason), claim.remedy ? element("p", { class: "remedy" }, claim.remedy) : null, fit);
  }

  async apply(advice) {
    const { estimator: name, options } = this.link.status;
    this.say(await this.tune.edit(`estimator ${advice.estimator}`, "SetEstimator", { name: advice.estimator, options: advice.options }, { name, options: numbers(options) }));
    // Its card is about to be another.
    this.measure.focus();
  }
}

// What a status gives as text is infinite: that is the option's own default.
const numbers = (options) => Object.fromEntries(Object.entries(options).filter(([, value]) => typeof value === "number"));
