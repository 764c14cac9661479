// A table of all runs, newest first: filter, scores and change of each. Pinned ones stay on the charts; the menu of a row
// has everything else.

import { element, keepFocus, refusal, showText, table } from "./dom.js";
import { bracketed, compact, count, spaced, span, words } from "./format.js";
import { get, post } from "./http.js";
import { swatch } from "./layers.js";
import { gone } from "./save.js";

const RUNS_POLL_MS = 300; // ms between two looks at whether there is something new
const AGAIN = 5000; // ms between two looks at the scores while the log grows
const BEYOND = { above: " ▲", below: " ▼" }; // of a mean NIS outside its bounds
const ALIKE = 0.8; // share of the longest time from which on scores can be compared

export class Runs {
  constructor(node, link) {
    Object.assign(this, { node, link });
    this.runs = [];
    this.chosen = []; // numbers of those that are compared, two at most
    this.subject = null; // whose RMSE is shown
    this.noted = null; // number of the run whose note is open
    this.error = refusal();
    this.compared = element("section", { class: "compared", "aria-label": "Two runs compared", hidden: true });
    this.table = element("table", { class: "runs" });
    this.of = element("label", { class: "error-of faint" });
    this.versions = new Versions(link);
    node.replaceChildren(this.versions.node, this.error, this.of, this.table, this.compared);
    // Not by the status: a twin whose source has ended says no more.
    setInterval(() => link.connected && link.status.runs && this.heard(link.status), RUNS_POLL_MS);
  }

  // While the tab is shown, and nothing is being typed.
  async heard(status) {
    if (!this.node.checkVisibility() || this.asking || (this.key && !this.link.settled)) return;
    const key = `${status.runs.version}/${status.revision}/${status.refolding}`;
    if (key === this.key && (status.finished || performance.now() - this.when < AGAIN)) return;
    if (this.node.contains(document.activeElement) && document.activeElement.matches("input, textarea")) return;
    if (this.noted !== null || document.querySelector("#save-menu:popover-open")) return;
    this.asking = true;
    const runs = await get("api/runs");
    this.asking = false;
    if (runs.error) return;
    Object.assign(this, { key, when: performance.now(), runs });
    this.versions.list();
    this.show();
  }

  async ask(command, fields) {
    const reason = await this.link.ask(command, fields);
    showText(this.error, reason);
    this.key = null;
    return reason;
  }

  // Between what runs and the run before it, and back.
  swap() {
    const last = this.link.status.runs?.last;
    return typeof last === "number" ? this.ask("Load", { number: last }) : this.ask("Load", { number: this.link.status.revision });
  }

  show() {
    const subjects = [...new Map(this.runs.flatMap((run) => run.score?.fits ?? []).map((fit) => [fit.name, fit])).values()];
    if (!subjects.some((fit) => fit.name === this.subject)) this.subject = (subjects.findLast((fit) => fit.against === "truth") ?? subjects.at(-1))?.name ?? null;
    const best = bests(this.runs, this.subject);
    keepFocus(this.node, "data-focus", () => this.table.replaceChildren(this.head(subjects), ...[...this.runs].reverse().map((run) => this.run(run, best))));
    this.compare();
  }

  head(subjects) {
    const select = subjects.length
      ? element("select", { "aria-label": "State or sensor of the error", title: words(this.subject), dataset: { focus: "subject" }, onchange: () => ((this.subject = select.value), this.show()) },
          ...subjects.map((fit) => element("option", { value: fit.name, selected: fit.name === this.subject }, `${words(fit.name)}${fit.against === "truth" ? "" : " (held out)"}`)))
      : null;
    const unit = bracketed(subjects.find((fit) => fit.name === this.subject)?.unit);
    const cell = (title, ...text) => element("th", { scope: "col", title }, ...text);
    this.of.replaceChildren(...(select ? ["Error of ", select] : []));
    return element("thead", {}, element("tr", {},
      cell("Run; its circle pins it to the charts", "run"), cell("Estimator", "filter"),
      cell("Mean NIS per degree of freedom of used measurements: 1 is consistent (▲ above, ▼ below its 95 % bounds)", "NIS / dof"),
      cell("Root mean square error against the truth, or of predictions of a held-out sensor", `error ${unit}`.trim()),
      cell("Log-likelihood per measurement, with a penalty for rejected ones", "log L"),
      cell("Computing time per event", "time [µs]"), element("th", { "aria-label": "Menu" })));
  }

  run(run, best) {
    const { number, score } = run;
    const fit = score?.fits.find((item) => item.name === this.subject);
    const cell = (key, text, title) => element("td", { class: best[key] === number ? "best" : null, title: best[key] === number ? `Best. ${title ?? ""}` : title }, text);
    const scores = score
      ? [
          cell("nis", `${compact(score.nis / score.nis_dof, 3)}${BEYOND[score.nis_place] ?? ""}`, `Of the whole run: ${score.nis_words}; ${count(score.readings, "measurement")} in ${span(score.seconds)}, ${compact(100 * (score.refused ?? 0), 2)} % rejected`),
          cell("rmse", fit ? compact(fit.rmse, 3) : "–", fit ? `${words(fit.name)}, ${fit.against}: mean error ${compact(fit.bias, 2)}${spaced(fit.unit)}, ${compact(100 * fit.coverage, 3)} % inside the 95 % band` : "Needs a known truth or a held-out sensor"),
          cell("likelihood", compact(score.log_likelihood_reading, 3), `In all ${compact(score.log_likelihood, 6)}`),
          cell("step", compact(score.step_us, 3)),
        ]
      : [element("td", { colspan: 4, class: "faint" }, run.unscored)];
    const menu = element("button", { type: "button", class: "menu-button", title: `Menu of run ${number}`, "aria-label": `Menu of run ${number}`, "aria-haspopup": "menu", dataset: { focus: `menu${number}` }, onclick: () => this.saving.open(menu, this.items(run)) }, "⋯");
    const what = [run.name ? element("b", {}, run.name) : null, element("span", {}, run.what), score ? element("span", { class: "over" }, `over ${span(score.seconds)}`) : null];
    return element("tbody", { dataset: { number, running: run.running, first: run.first } },
      element("tr", { class: "scores" },
        element("th", { scope: "row", title: run.running ? "Running" : `Since ${new Date(1000 * run.began).toLocaleTimeString()}` }, element("div", {}, this.pin(run), `${number}${run.running ? " ▸" : ""}`)),
        element("td", { title: run.title }, run.estimator), ...scores, element("td", {}, menu)),
      element("tr", { class: "what" }, element("td", { colspan: 7 }, ...what)),
      this.noted === number ? element("tr", { class: "note" }, element("td", { colspan: 7 }, this.form(run))) : run.note ? element("tr", { class: "note" }, element("td", { colspan: 7 }, run.note)) : null);
  }

  pin(run) {
    const pinned = run.place !== null;
    return element("button", {
      type: "button", class: "pin", "aria-pressed": String(pinned), "aria-label": `Pin run ${run.number}`, title: pinned ? "Take off the charts" : "Show on the charts",
      dataset: { focus: `pin${run.number}` }, onclick: () => this.ask(pinned ? "Unpin" : "Pin", { number: run.number }),
    }, pinned ? swatch(run.place) : "○");
  }

  // Entries of the menu: [text, title, click, reason why not].
  items(run) {
    const { number } = run;
    const lost = run.kept ? null : gone(number);
    const fetched = (address) => element("a", { href: address, download: "" }).click();
    const others = this.runs.filter((other) => other.number !== number);
    const other = others.find((item) => item.running) ?? others.at(-1);
    const compare = () => ((this.chosen = other ? [other.number, number] : []), this.show());
    const note = () => ((this.noted = number), this.show(), this.table.querySelector(`tbody[data-number="${number}"] .note input`)?.focus());
    return [
      ["Load", "Fold the history again with this filter and tuning", () => this.ask("Load", { number }), run.running ? "it is running" : null],
      ["Name and note", "Name this run, and write a note", note],
      [other ? `Compare with run ${other.number}` : "Compare", "List the entries in which two runs differ", compare, other ? null : "there is no other run"],
      ["Report: HTML", "Scores, charts, episodes and tuning in one file", () => fetched(`api/report.html?run=${number}`), lost],
      ["Track: CSV", "One line per event", () => fetched(`api/track.csv?run=${number}`), lost],
      ["Tuning: YAML", "The twin's file with this tuning", () => fetched(`api/runs/${number}.yaml`)],
      ["Keep as a version", "Save beside the twin, under the run's name", () => this.versions.keep(run), run.name ? null : "give it a name first"],
    ];
  }

  form(run) {
    const name = element("input", { type: "text", value: run.name, placeholder: "name", maxlength: 60, "aria-label": `Name of run ${run.number}` });
    const note = element("textarea", { rows: 2, maxlength: 2000, "aria-label": `Note on run ${run.number}`, placeholder: "note" });
    note.value = run.note;
    const done = () => {
      this.noted = null;
      this.ask("Note", { number: run.number, name: name.value, note: note.value });
      this.show();
    };
    const cancel = () => ((this.noted = null), this.show());
    return element("form", { onsubmit: (event) => (event.preventDefault(), done()), onkeydown: (event) => event.key === "Escape" && cancel() },
      name, note, element("button", { type: "submit", class: "go" }, "Save"), element("button", { type: "button", onclick: cancel }, "Cancel"));
  }

  // The entries in which two differ.
  async compare() {
    const known = new Set(this.runs.map((run) => run.number));
    this.chosen = this.chosen.filter((number) => known.has(number));
    this.compared.hidden = this.chosen.length < 2;
    if (this.compared.hidden) return;
    const [a, b] = this.chosen;
    const differ = await get(`api/runs/${a}/against/${b}`);
    if (differ.error) return;
    this.compared.replaceChildren(differences([`run ${a}`, `run ${b}`], differ), ...(differ.length ? [] : [element("p", { class: "faint" }, "No differences.")]));
  }
}

// By column the number of the run that is best there, of those that were scored over much the same time; none where
// there is nothing to choose.
function bests(runs, subject) {
  const longest = Math.max(...runs.map((run) => run.score?.seconds ?? 0));
  const scored = runs.filter((run) => run.score?.seconds >= ALIKE * longest);
  const least = (measure) => {
    const known = scored.map((run) => [measure(run.score, run.score.fits.find((fit) => fit.name === subject)), run.number]).filter(([value]) => Number.isFinite(value));
    const lowest = Math.min(...known.map(([value]) => value));
    const winners = known.filter(([value]) => value === lowest);
    return known.length > 1 && winners.length < known.length ? winners.at(-1)[1] : null;
  };
  return {
    nis: least((score) => score.nis_judged > 0 && Math.abs(Math.log(score.nis_judged / Math.sqrt(score.nis_low * score.nis_high)))),
    rmse: least((score, fit) => fit?.rmse),
    likelihood: least((score) => (score.log_likelihood_reading === null ? NaN : -score.log_likelihood_reading)),
    step: least((score) => score.step_us ?? NaN),
  };
}

// Tuning versions beside the twin: list them with their scores, load one, compare one with the running tuning, or save
// a run as a new one.

class Versions {
  constructor(link) {
    this.link = link;
    this.compared = null; // name of the one that is compared with what runs
    this.table = element("table", {});
    this.error = refusal();
    this.name = element("input", { type: "text", "aria-label": "Name of the version", placeholder: "name", maxlength: 60 });
    this.note = element("input", { type: "text", "aria-label": "Note on the version", placeholder: "note", maxlength: 2000 });
    const keep = element("button", { type: "submit", class: "go", title: "Save the running tuning as a version" }, "keep");
    this.form = element("form", { onsubmit: (event) => (event.preventDefault(), this.keepRunning()) }, this.name, this.note, keep);
    this.guard = element("p", { class: "guard faint", hidden: true });
    this.node = element("details", { class: "versions" }, element("summary", { title: "Named filters and tunings, saved beside the twin" }, "Tuning versions"), this.table, this.guard, this.form, this.error);
  }

  // While the tab is shown; the focus stays where it is.
  async list() {
    const { running, versions, guard, error } = await get("api/tunings");
    if (error) return;
    // Open from the start if there is something to choose.
    if (this.listed === undefined) this.node.open = versions.length > 1 || guard.some((each) => each.failure || each.worse.length);
    this.listed = versions.length;
    this.guard.hidden = !guard.length;
    this.guard.replaceChildren(...guard.map((each) => guarded(each, versions)));
    const differ = this.compared && (await this.difference(this.compared));
    const head = element("tr", {}, element("th", { scope: "col" }, "version"), element("th", { scope: "col", title: "NIS per degree of freedom when it was saved: 1 where the filter is consistent" }, "NIS / dof"), element("th", { scope: "col", title: "Log-likelihood per measurement when it was saved" }, "log L"), element("th", {}));
    keepFocus(this.table, "data-focus", () => this.table.replaceChildren(element("thead", {}, head), ...versions.map((item) => this.version(item, running, differ))));
  }

  version(item, running, differ) {
    const { name, scores = {}, holds, error } = item;
    const runs = running === name;
    const button = (text, title, click, attributes = {}) => element("button", { type: "button", title, "aria-label": `${title}: version ${name}`, dataset: { focus: `${text}${name}` }, disabled: Boolean(error), onclick: click, ...attributes }, text);
    const compare = () => ((this.compared = this.compared === name ? null : name), this.list());
    const about = error ?? [item.note, item.fitted_on?.length ? `fitted on ${item.fitted_on.join(", ")}` : "", item.accepted?.note ? `accepted: ${item.accepted.note}` : "", item.saved?.slice(0, 16).replace("T", " ") ?? "from the twin's file"].filter(Boolean).join(" · ");
    return element("tbody", { dataset: { version: name, running: runs } },
      element("tr", {},
        element("th", { scope: "row" }, name, holds ? element("i", { title: "Accepted: reference of nisus guard" }, " ✓") : null, runs ? element("i", { title: "Running" }, " ▸") : running === `${name}*` ? element("i", { title: "Running, with edits since it was loaded" }, " ▸*") : null),
        element("td", {}, compact(scores.nis, 3)), element("td", {}, compact(scores.log_likelihood, 4)),
        element("td", {}, button("load", "Load and fold the history again", () => this.ask("api/tunings/load", { name })), button("⇄", "Compare with the running tuning", compare, { "aria-pressed": String(this.compared === name) }))),
      element("tr", { class: error ? "error" : "faint" }, element("td", { colspan: 4 }, about)),
      this.compared === name && differ ? element("tr", {}, element("td", { colspan: 4 }, differ.length ? differences([name, "running"], differ) : "No differences from the running tuning.")) : null);
  }

  async difference(name) {
    const differ = await get(`api/tunings/${encodeURIComponent(name)}/against`);
    if (!differ.error) return differ;
    showText(this.error, differ.error);
    return null;
  }

  // Show the reason of a refusal; resolves to whether it was done.
  async ask(path, fields) {
    const { error } = await post(path, fields);
    showText(this.error, error);
    await this.list();
    return !error;
  }

  keep(run) {
    return this.ask("api/tunings", { run: run.number, name: run.name.trim().replaceAll(" ", "_"), note: run.note });
  }

  async keepRunning() {
    const kept = await this.ask("api/tunings", { run: this.link.status.revision, name: this.name.value.trim().replaceAll(" ", "_"), note: this.note.value });
    if (kept) this.name.value = this.note.value = "";
  }
}

// Last result of `nisus guard` for one recording.
function guarded(each, versions) {
  const { recording, at, version, figures, worse, better, failure } = each;
  const verdict = failure || (worse.length ? `${worse.length} of ${figures} figures worse: ${worse[0]}` : `none of ${figures} figures worse${better.length ? `, ${better.length} better` : ""}`);
  const holds = versions.find((item) => item.holds)?.name;
  const since = holds && version && holds !== version ? `; since then ${holds} was accepted` : "";
  const title = [...worse, ...better.map((text) => `better: ${text}`)].join("\n") || "Last result of nisus guard";
  return element("span", { class: failure || worse.length ? "error" : "", title, dataset: { guarded: recording } }, `${failure || worse.length ? "✗" : "✓"} guard, ${at.slice(0, 16).replace("T", " ")} UTC, ${recording} with ${version || "?"}: ${verdict}${since}`);
}

// The entries in which two differ: a column for each of the two.
function differences(names, differ) {
  const shown = (value) => (typeof value === "number" ? compact(value, 6) : value === null ? "off" : String(value));
  return table(["entry", ...names], differ.map(({ key, values }) => [element("th", { scope: "row" }, key), ...values.map(shown)]));
}
