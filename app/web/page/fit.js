// Fit: a panel beside the Tune column with the fitted entries, progress and result. A result is offered only if it won
// on held-out data.

import { Panel } from "./controls.js";
import { changed, element, refusal, setText, showText } from "./dom.js";
import { clock, compact, count, spaced, span, words } from "./format.js";
import { get, post } from "./http.js";

const FIT_PERIOD = 300; // ms between two progress queries
const GROUPS = { Q: "Q", R: "R", p: "parameters", options: "options" };
const FIRST = ["Q", "R"]; // ticked at first
const LAST = [100_000, 20_000, 5_000]; // of so many events, where there are more
const BUSY = ["running", "stopping", "cancelling"];

export class Fit {
  // tune: its head has the button, and it applies results
  constructor(model, link, tune) {
    Object.assign(this, { model, link, tune });
    this.button = element("button", { type: "button", id: "fit", title: "Fit noises and parameters to the log" }, "Fit…");
    tune.restoreButton.before(this.button);
    this.form = element("div", { class: "form" });
    this.progress = element("div", { class: "progress", role: "status", hidden: true });
    this.error = refusal();
    this.result = element("div", { class: "result" });
    const opened = () => {
      if (this.estimator !== link.status.estimator) this.offer();
      return this.ask("GET");
    };
    this.box = new Panel(this.button, "fit-panel", "Fit to the log", opened, this.form, this.progress, this.error, this.result);
    this.panel = this.box.node;
    this.count = element("output", {});
    this.best = element("p", { class: "about" });
    this.bar = element("progress", { max: 1, "aria-label": "Share of the fit done" });
    this.cancelButton = element("button", { type: "button", id: "fit-cancel", class: "go", title: "End the search and keep the best values so far", onclick: () => this.ask("DELETE") }, "Stop");
    this.progress.append(this.bar, this.count, this.cancelButton, this.best);
    link.addEventListener("status", ({ detail }) => {
      if (this.estimator !== detail.estimator && this.box.open) this.offer();
      if (this.told?.result && this.revision !== detail.revision) this.ask("GET");
      this.revision = detail.revision;
    });
  }

  // Entries that may be fitted: a box for each group, and below it one for each entry.
  offer() {
    this.estimator = this.link.status.estimator;
    const options = this.model.estimators.find((entry) => entry.name === this.estimator)?.options ?? [];
    const keys = [...this.model.tuning.map((item) => item.key), ...options.filter((item) => !item.choices.length && !item.whole).map((item) => `options.${item.name}`)];
    this.groups = Object.entries(GROUPS).map(([prefix, title]) => group(prefix, title, keys.filter((key) => key.startsWith(`${prefix}.`)))).filter(Boolean);
    this.over = element("select", { id: "fit-over", "aria-label": "Events" });
    this.beginButton = element("button", { type: "button", id: "fit-begin", class: "go", onclick: () => this.begin() }, "Fit");
    this.form.replaceChildren(
      element("div", { class: "groups", role: "group", "aria-label": "Fitted entries" }, ...this.groups.map((item) => item.head)),
      element("details", { class: "entries" }, element("summary", {}, "single entries"), ...this.groups.map((item) => item.list)),
      element("div", { class: "pair" }, this.over, this.beginButton),
      element("p", { class: "about" }, "Every third block of time is held out to judge the result."));
  }

  begin() {
    const wanted = this.groups.flatMap((item) => item.wanted());
    return this.ask("POST", { wanted, ...(this.over.value ? { events: Number(this.over.value) } : {}) });
  }

  async ask(method, body) {
    clearTimeout(this.timer);
    const told = await post("api/fit", body, method);
    showText(this.error, told.error);
    if (!told.error) this.take(told);
    else if (BUSY.includes(this.told?.state)) this.timer = setTimeout(() => this.ask("GET"), 10 * FIT_PERIOD);
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
    setText(this.cancelButton, told.state === "running" ? "Stop" : "Discard");
    setText(this.button, busy ? `Fit ${percent(told.expected ? told.folds / told.expected : 0)}` : "Fit…");
    if (busy) {
      const share = told.expected ? told.folds / told.expected : null;
      bar(this.bar, share);
      setText(this.count, told.state === "stopping" ? "Judging the best values so far …" : told.state === "cancelling" ? "ending …" : left(told.left, told.elapsed));
      this.count.title = `${told.folds} of about ${told.expected ?? "?"} folds of ${told.events.toLocaleString("en")} events`;
      setText(this.best, told.gain > 0 ? `Best so far: +${compact(told.gain, 3)} on the fitted blocks (${told.best})` : "No better values yet.");
      this.timer = setTimeout(() => this.ask("GET"), FIT_PERIOD);
    }
    if (told.state === "failed") showText(this.error, told.reason);
    if (!changed(this.result, [told.number, told.state, told.current])) return;
    this.told = told;
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
    const use = element("button", { type: "button", id: "fit-use", class: proposed ? "go first" : "go quiet", disabled: Boolean(late), title: late ?? "Apply as one edit (U to undo)", onclick: () => this.use(told) }, proposed ? "Use it" : "use it all the same: it did not win");
    return [use, ...(proposed ? this.keeping(told) : []), late ? element("span", { class: "faint" }, late) : null].filter(Boolean);
  }

  // Under a name, whether it is put in or not.
  keeping(told) {
    const name = element("input", { type: "text", id: "fit-name", "aria-label": "Name of the version", placeholder: "name", maxlength: 60, value: `fit-${told.number}` });
    const keep = async () => {
      const note = `fitted: ${told.wanted.join(", ")}`;
      const { error = "" } = await post("api/fit/keep", { name: name.value.trim(), note });
      showText(this.error, error);
      setText(kept, error ? "" : `kept as ${name.value.trim()}, see Runs`);
    };
    const kept = element("span", { class: "faint", role: "status" });
    return [element("span", { class: "space" }), name, element("button", { type: "button", id: "fit-keep", class: "go", title: "Save as a tuning version, with its scores on the held-out blocks", onclick: keep }, "Keep as a version"), kept];
  }

  async use(told) {
    showText(this.error, await this.tune.edit("SetTunings", { values: told.values }));
  }
}

// A bar without a value moves to and fro.
function bar(node, share) {
  if (share === null) node.removeAttribute("value");
  else node.value = Math.min(1, share);
}

const percent = (share) => `${Math.round(100 * Math.min(1, share))} %`;
const left = (seconds, elapsed) => (seconds === null ? `${span(elapsed)} so far` : `about ${span(seconds)} left, ${span(elapsed)} so far`);

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

// Result of a fit: verdict, every entry before and after, and predictions on fitted and held-out data.

const ALONE = "left alone: the data cannot tell";
const EDGE = "at the edge of its range: the best may lie beyond";
const BOUND = "only a bound: not distinguishable from zero";

// told: the answer of /api/fit; offers: buttons
function fitted(told, offers) {
  const { result } = told;
  return [result.stopped ? element("p", { class: "faint" }, "Ended early: these are the best values so far; better ones may exist.") : "", verdict(result), element("div", { class: "offers" }, ...offers), entries(result), scores(result), about(told)];
}

function verdict({ proposed, verdict: { gain, error, reasons } }) {
  const gained = gain === null ? "" : `${gain < 0 ? "−" : "+"}${compact(Math.abs(gain), 3)} ± ${compact(error, 2)} nats a reading`;
  const said = proposed ? `Better on the blocks held out: ${gained}.` : "Not better on what was held out: it is not proposed.";
  return element("div", { class: "verdict", dataset: { proposed } },
    element("p", {}, element("b", {}, said)), ...(proposed ? [] : [element("ul", {}, ...reasons.map((reason) => element("li", {}, reason)))]));
}

function entries(result) {
  const head = ["entry", "before", "after", "95 % interval"].map((text) => element("th", { scope: "col" }, text));
  const rows = result.entries.map((line) => {
    const name = element("th", { scope: "row", title: line.unit }, words(line.key));
    if (line.alone) return element("tr", {}, name, element("td", {}, compact(line.before)), element("td", { class: "faint", colspan: 2 }, ALONE));
    const ends = `${compact(line.low, 3)} … ${compact(line.high, 3)}`;
    return element("tr", {}, name, element("td", {}, compact(line.before)), element("td", {}, element("b", {}, compact(line.after))),
      element("td", { title: !line.told ? BOUND : line.edge ? EDGE : line.profile ? "By profile likelihood" : null }, !line.told ? `${ends} (bound)` : line.edge ? `${ends} (edge)` : ends));
  });
  const skipped = result.skipped.map((item) => element("tr", {}, element("th", { scope: "row" }, words(item.key)), element("td", { class: "faint", colspan: 3 }, `not fitted: ${item.reason}`)));
  const pairs = result.correlated.map((pair) => `${pair.entries.map(words).join(" with ")} (${pair.correlation.toFixed(2)})`);
  return element("div", {}, element("table", { class: "entries" }, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows, ...skipped)),
    pairs.length ? element("p", { class: "faint" }, `Hardly told apart: ${pairs.join(", ")}.`) : "");
}

function scores({ before, after }) {
  const parts = [before.fitted, after.fitted, before.held_out, after.held_out];
  const row = (title, hint, text) => element("tr", {}, element("th", { scope: "row", title: hint }, title), ...parts.map((part) => element("td", {}, text(part))));
  const share = (value, digits = 1) => (value === null ? "–" : `${(100 * value).toFixed(digits)} %`);
  const rows = [
    row("log density", "Of a reading, nats: greater is better", (part) => compact(part.log_density, 4)),
    row("NIS / dof", "1 where the filter is consistent", (part) => compact(part.nis, 3)),
    row("in 95 %", "Share of innovations inside their 95 % band", (part) => share(part.coverage)),
  ];
  for (const [group, title] of [["sensors", "Sensors, each predicted by the others: RMS error, in 95 %"], ["withheld", "Sensors that are never used: RMS error, in 95 %"], ["states", "States, against the truth: RMS error, in 95 %"]]) {
    const names = new Set(parts.flatMap((part) => Object.keys(part[group])));
    if (names.size) rows.push(element("tr", {}, element("th", { scope: "rowgroup", colspan: 5, class: "faint" }, title)));
    for (const name of names) {
      const unit = parts.map((part) => part[group][name]?.unit).find(Boolean);
      rows.push(row(`${words(name)}${spaced(unit)}`, null, (part) => (part[group][name] ? `${compact(part[group][name].rms, 3)}, ${share(part[group][name].coverage, 0)}` : "–")));
    }
  }
  const group = (title, readings) => element("th", { scope: "colgroup", colspan: 2 }, `${title}, ${count(readings, "reading")}`);
  const head = element("thead", {},
    element("tr", {}, element("td", {}), group("fitted to", before.fitted.readings), group("held out", before.held_out.readings)),
    element("tr", {}, element("td", {}), ...["before", "after", "before", "after"].map((text) => element("th", { scope: "col" }, text))));
  return element("table", { class: "scores" }, head, element("tbody", {}, ...rows));
}

const about = ({ result, revision, events, elapsed }) =>
  element("p", { class: "about" }, `From run ${revision}, ${result.estimator}: ${result.folds} folds of ${events.toLocaleString("en")} events in ${compact(elapsed, 2)} s.${result.power < 1 ? ` The likelihood of the fitted blocks is weighted by ${compact(result.power, 2)}, also in the intervals: a larger weight does not improve the held-out predictions.` : ""} ${prior(result)}`);

// Whether the values are those of maximum likelihood, and the entries that the prior moves most.
function prior({ penalised, entries }) {
  if (!penalised) return "Plain maximum likelihood.";
  const moved = entries.filter((line) => Math.abs(line.pull) >= 0.1).map((line) => `${words(line.key)} by ${line.pull.toFixed(1)} σ`);
  return `Penalised: a weak prior about the twin's values moves ${moved.join(", ") || "no entry by 0.1 σ or more"}.`;
}

// Dual estimation: fits of the last window beside the running twin. A proposal is a card above the sliders, to be accepted
// or dismissed; every fit, with its evidence, is in a panel.

export class Refit {
  constructor(model, link, tune) {
    Object.assign(this, { model, link, opened: new Set() });
    this.said = element("span", { class: "faint", role: "status" });
    this.button = element("button", { type: "button", id: "refit-open", title: "All fits with their evidence" }, "Fits…");
    this.offer = element("div", {});
    this.error = refusal();
    const head = element("div", { class: "refit-head" }, element("h3", { title: "Parameters are fitted to the latest measurements at set times" }, "Dual estimation"), this.said, element("span", { class: "space" }), this.button);
    this.card = element("section", { id: "refit", "aria-label": "Dual estimation", hidden: true }, head, this.offer, this.error);
    tune.sections.before(this.card);
    this.about = element("p", { class: "about" });
    this.begin = element("button", { type: "button", id: "refit-begin", class: "go", title: "Fit the latest window now", onclick: () => this.post("api/refit", {}) }, "Fit now");
    this.list = element("div", { class: "fits" });
    this.panel = new Panel(this.button, "refit-panel", "Dual estimation", () => this.look(), this.about, element("div", { class: "progress" }, this.begin), this.list);
    link.addEventListener("status", ({ detail }) => {
      this.card.hidden = !detail.refit;
      if (this.card.hidden) return;
      if (changed(this.card, [detail.refit, detail.reloads])) this.look();
    });
  }

  async look() {
    this.show(await get("api/refit"));
  }

  // Says why where it is refused.
  async post(path, fields) {
    showText(this.error, (await post(path, fields)).error);
    await this.look();
  }

  show({ section, due, fits }) {
    if (!section) return;
    const origin = Number(this.link.status.origin ?? 0);
    const at = (time) => clock((Number(time) - origin) / 1e9);
    const busy = fits[0]?.state === "fitting";
    setText(this.said, busy ? "fitting …" : due ? `next at ${at(due)}` : "");
    this.begin.disabled = busy;
    const rule = section.adopt === "by hand" ? "what is better waits here for you" : "a better fit is adopted and listed among the events";
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
      element("td", { title: "Change in standard deviations of the estimate" }, `${line.sigma < 0 ? "−" : "+"}${Math.abs(line.sigma).toFixed(1)} σ`)));
    const decide = (what) => () => this.post(`api/refit/${what}`, { number: fit.number });
    return [
      element("table", {}, element("tbody", {}, ...rows)),
      element("p", { class: "about" }, `Better on the blocks held out: +${compact(verdict.gain, 3)} ± ${compact(verdict.error, 2)} nats a reading.`),
      element("div", { class: "offers" },
        element("button", { type: "button", id: "refit-accept", class: "go first", title: "Save as a tuning version and fold again with it", onclick: decide("accept") }, "Accept"),
        element("button", { type: "button", id: "refit-dismiss", class: "go", title: "Keep the current tuning", onclick: decide("dismiss") }, "Dismiss")),
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

// Advice on the estimator, as cards: one for the recommendation, with a button that applies it, and one per finding with its
// figures behind a line; a card about wrong noise opens the fit.

const ADVICE_PERIOD = 500; // ms between two looks at whether it is there

export class Advice {
  constructor(model, link, tune) {
    Object.assign(this, { model, link, tune });
    this.button = element("button", { type: "button", id: "advise", title: "Recommended estimator for this log, with reasons" }, "Advice…");
    tune.restoreButton.before(this.button);
    this.measure = element("button", { type: "button", id: "advice-begin", class: "go", onclick: () => this.ask("POST") }, "Measure");
    this.stop = element("button", { type: "button", id: "advice-cancel", class: "go", hidden: true, onclick: () => this.ask("DELETE") }, "Cancel");
    this.bar = element("progress", { max: 1, hidden: true, "aria-label": "Share of the questions answered" });
    this.said = element("span", { class: "faint", role: "status" });
    this.error = refusal();
    this.cards = element("div", { class: "claims" });
    this.panel = new Panel(this.button, "advice-panel", "Which estimator, and why", () => this.ask("GET"),
      element("div", { class: "progress" }, this.measure, this.bar, this.said, this.stop), this.error, this.cards);
    link.addEventListener("status", ({ detail }) => {
      if (this.told?.advice && this.revision !== detail.revision && this.panel.open) this.ask("GET");
      this.revision = detail.revision;
    });
  }

  async ask(method) {
    clearTimeout(this.timer);
    const told = await post("api/advice", method === "POST" ? {} : undefined, method);
    showText(this.error, told.error ?? told.reason);
    if (told.error) return;
    const busy = BUSY.includes(told.state);
    if (busy) this.timer = setTimeout(() => this.ask("GET"), ADVICE_PERIOD);
    this.measure.hidden = busy;
    this.bar.hidden = this.stop.hidden = !busy;
    this.stop.disabled = told.state === "cancelling";
    bar(this.bar, told.progress.share);
    setText(this.button, busy ? `Advice ${percent(told.progress.share ?? 0)}` : "Advice…");
    const idle = told.advice ? (told.current ? "" : `of run ${told.revision}; another runs now`) : told.state === "cancelled" ? "Cancelled." : "nothing measured yet: it folds the log by one filter after another";
    setText(this.said, told.state === "cancelling" ? "ending …" : busy ? `${told.progress.question} ${left(told.progress.left, told.progress.elapsed)}` : idle);
    if (!changed(this.cards, [told.state, told.revision, told.current])) return;
    this.told = told;
    this.cards.replaceChildren(...(told.advice ? [this.recommended(told), this.excluded(told.advice), ...told.advice.claims.map((claim) => this.claim(claim, told.advice.because))].filter(Boolean) : []));
  }

  recommended({ advice }) {
    const title = this.model.estimators.find((entry) => entry.name === advice.estimator)?.title ?? advice.estimator;
    const options = Object.entries(advice.options).map(([name, value]) => `${words(name)} ${compact(value)}`).join(", ");
    const has = advice.has === advice.estimator && !options;
    return element("article", { class: "first" },
      element("header", {}, element("h3", {}, has ? `${title}: as it is` : title), element("span", { class: "space" }),
        has ? null : element("button", { type: "button", id: "advice-apply", class: "go first", title: "Apply as one edit (U to undo)", onclick: () => this.apply(advice) }, "Apply")),
      options ? element("p", {}, options) : null, ...advice.reasons.map((reason) => element("p", {}, `${reason}.`)));
  }

  // Readings of sensors in known faults: no finding rests on them.
  excluded({ excluded }) {
    if (!excluded.length) return null;
    const at = (seconds) => clock(seconds - Number(this.link.status.origin ?? 0) / 1e9);
    const text = (item) => `${words(item.row)}, ${at(item.start)} to ${at(item.end)}: ${item.cause} (${count(item.readings, "reading")})`;
    return element("article", { class: "excluded" }, element("h3", {}, "Excluded: faults of sensors"), element("ul", {}, ...excluded.map((item) => element("li", { title: item.text }, text(item)))));
  }

  claim(claim, because) {
    const fit = claim.key === "consistent" && claim.answer === "no" ? element("button", { type: "button", class: "go", onclick: () => this.tune.fit.box.toggle(true) }, "Fit…") : null;
    return element("article", { dataset: { decides: because.includes(claim.key), key: claim.key } },
      element("h3", {}, `${claim.finding}.`), claim.remedy ? element("p", { class: "remedy" }, claim.remedy) : null, fit,
      element("details", {}, element("summary", {}, "details"), element("p", {}, `${claim.question} ${claim.answer}: ${claim.details}`)));
  }

  async apply(advice) {
    showText(this.error, await this.tune.edit("SetEstimator", { name: advice.estimator, options: advice.options }));
    // Its card is about to be another.
    this.measure.focus();
  }
}

// What a status gives as text is infinite: that is the option's own default.
