// Every revision: what was changed for it, and what it was worth. Pinned ones stay on the charts; any can be named,
// noted, loaded, saved as YAML, and compared with another.

import { element, setText } from "./dom.js";
import { compact, spaced, span } from "./format.js";
import { swatch } from "./layers.js";
import { gone } from "./save.js";
import { Versions } from "./versions.js";

const LOOK = 300; // ms between two looks at whether there is something new
const AGAIN = 5000; // ms between two looks at the scores while the log grows
const COVERED = 0.95; // share of errors that their 95 % band should hold
const BEYOND = { above: " ▲", below: " ▼" }; // of a mean NIS outside its bounds
const ALIKE = 0.8; // share of the longest time from which on scores can be compared

export class Runs {
  constructor(node, link) {
    Object.assign(this, { node, link });
    this.runs = [];
    this.chosen = []; // numbers of those that are compared, two at most
    this.subject = null; // whose RMSE is shown
    this.noted = null; // number of the run whose note is open
    this.error = element("p", { class: "error", role: "alert", hidden: true });
    this.compared = element("section", { class: "compared", "aria-label": "Two runs compared", hidden: true });
    this.table = element("table", { class: "runs" });
    this.versions = new Versions(link);
    node.replaceChildren(this.versions.node, this.error, this.table, this.compared);
    // Not by the status: a twin whose source has ended says no more.
    setInterval(() => link.socket && link.status.runs && this.heard(link.status), LOOK);
  }

  // While somebody looks, and is not just writing.
  async heard(status) {
    if (!this.node.checkVisibility() || this.asking || (this.key && !this.link.settled)) return;
    const key = `${status.runs.version}/${status.revision}/${status.refolding}`;
    if (key === this.key && (status.finished || performance.now() - this.when < AGAIN)) return;
    if (this.node.contains(document.activeElement) && document.activeElement.matches("input, textarea")) return;
    this.asking = true;
    const answer = await fetch("/api/runs").catch(() => null);
    this.asking = false;
    if (!answer?.ok) return;
    [this.key, this.when, this.runs] = [key, performance.now(), await answer.json()];
    this.versions.list();
    this.show();
  }

  async ask(command, fields) {
    const reason = await this.link.ask(command, fields);
    setText(this.error, reason ?? "");
    this.error.hidden = !reason;
    this.key = null;
    return reason;
  }

  // Between what runs and the run before it, and back.
  swap() {
    const last = this.link.status.runs?.last;
    return typeof last === "number" ? this.ask("Load", { number: last }) : this.ask("Load", { number: this.link.status.revision });
  }

  show() {
    const focused = this.node.contains(document.activeElement) ? document.activeElement.dataset.focus : null;
    const subjects = [...new Map(this.runs.flatMap((run) => run.score?.fits ?? []).map((fit) => [fit.name, fit])).values()];
    if (!subjects.some((fit) => fit.name === this.subject)) this.subject = subjects.at(-1)?.name ?? null;
    const best = bests(this.runs, this.subject);
    this.table.replaceChildren(this.head(subjects), ...[...this.runs].reverse().map((run) => this.run(run, best)));
    if (focused) this.table.querySelector(`[data-focus="${focused}"]`)?.focus();
    this.compare();
  }

  head(subjects) {
    const select = subjects.length
      ? element("select", { "aria-label": "RMSE of what", dataset: { focus: "subject" }, onchange: () => ((this.subject = select.value), this.show()) },
          ...subjects.map((fit) => element("option", { value: fit.name, selected: fit.name === this.subject }, `${fit.name}${fit.against === "truth" ? "" : " (held out)"}`)))
      : null;
    const cell = (title, ...text) => element("th", { scope: "col", title }, ...text);
    return element("thead", {}, element("tr", {},
      cell("Mean NIS of the readings that were used; ▲ above, ▼ below its 95 % bounds; bold: nearest to what it should be", "NIS"),
      cell("Root mean square error against the truth, or of predictions of a sensor held out", "RMSE ", select ?? "–"),
      cell("Share of errors inside their 95 % band", "in 95 %"),
      cell("Log-likelihood of a reading, refused ones priced", "log L"),
      cell("Elapsed time of folding one event, µs", "µs/step")));
  }

  run(run, best) {
    const { number, score } = run;
    const fit = score?.fits.find((item) => item.name === this.subject);
    const cell = (key, text, title) => element("td", { class: best[key] === number ? "best" : null, title: best[key] === number ? `Best. ${title ?? ""}` : title }, text);
    const scores = score
      ? element("tr", { class: "scores" },
          cell("nis", `${compact(score.nis, 3)}${BEYOND[score.nis_place] ?? ""}`, `Of the whole run: ${score.nis_words}; ${score.readings} readings in ${span(score.seconds)}, ${compact(100 * (score.refused ?? 0), 2)} % refused`),
          cell("rmse", fit ? compact(fit.rmse, 3) : "–", fit ? `${fit.name}, ${fit.against}: mean error ${compact(fit.bias, 2)}${spaced(fit.unit)}` : "No truth, and no sensor is held out"),
          cell("coverage", fit ? `${compact(100 * fit.coverage, 3)} %` : "–"),
          cell("likelihood", compact(score.log_likelihood_reading, 4), `In all ${compact(score.log_likelihood, 6)}`),
          cell("step", compact(score.step_us, 3)))
      : element("tr", { class: "scores" }, element("td", { colspan: 5 }, run.unscored));
    return element("tbody", { dataset: { number, running: run.running } },
      element("tr", { class: "title" }, element("th", { scope: "rowgroup", colspan: 5 }, element("div", {}, this.pin(run), ...this.names(run), element("span", { class: "does" }, ...this.buttons(run))))),
      element("tr", { class: "what" }, element("td", { colspan: 5, title: `${run.title}; since ${new Date(1000 * run.began).toLocaleTimeString()}` }, run.what, score ? element("span", { class: "over" }, `over ${span(score.seconds)}`) : null)),
      this.noted === number || run.note ? this.note(run) : null,
      scores);
  }

  pin(run) {
    const pinned = run.place !== null;
    const title = pinned ? "Unpin" : run.kept ? "Pin: keep it on the charts" : "Its track is gone: load it to pin it";
    return element("button", {
      type: "button", class: "pin", "aria-pressed": String(pinned), "aria-label": `Pin run ${run.number}`, title, disabled: !run.kept && !pinned,
      dataset: { focus: `pin${run.number}` }, onclick: () => this.ask(pinned ? "Unpin" : "Pin", { number: run.number }),
    }, pinned ? swatch(run.place) : "○");
  }

  names(run) {
    const keep = () => this.ask("Note", { number: run.number, name: name.value, note: run.note });
    const name = element("input", {
      type: "text", class: "name", value: run.name, placeholder: run.estimator, maxlength: 60, "aria-label": `Name of run ${run.number}`,
      onchange: keep, onkeydown: (event) => event.key === "Enter" && name.blur(),
    });
    return [element("b", { title: run.running ? "Runs now" : null }, run.running ? `${run.number} ▸` : String(run.number)), name];
  }

  buttons(run) {
    const { number } = run;
    const button = (text, title, click, attributes = {}) => element("button", { type: "button", title, "aria-label": `${title}: run ${number}`, dataset: { focus: `${text}${number}` }, onclick: click, ...attributes }, text);
    const choose = () => {
      this.chosen = this.chosen.includes(number) ? this.chosen.filter((item) => item !== number) : [...this.chosen, number].slice(-2);
      this.show();
    };
    return [
      run.running ? null : button("load", "Load: back to this filter and tuning", () => this.ask("Load", { number })),
      button("note", "Write a note", () => ((this.noted = this.noted === number ? null : number), this.show(), this.table.querySelector(`tbody[data-number="${number}"] textarea`)?.focus())),
      button("⇄", "Compare with another", choose, { "aria-pressed": String(this.chosen.includes(number)) }),
      this.download(run, "report", `/api/report.html?run=${number}`, "Save a report: scores, charts, checks, episodes and tuning in one file", `Save a report of run ${number}`),
      this.download(run, "csv", `/api/track.csv?run=${number}`, "Save the track as CSV", `Save the track of run ${number}`),
      button("keep", run.name ? `Keep as version ${run.name}, beside the twin` : "Keep as a version beside the twin, under the run's name: give it one", () => this.versions.keep(run), { disabled: !run.name }),
      element("a", { href: `/api/runs/${number}.yaml`, download: "", title: "Save the tuning as lines of the twin's YAML", "aria-label": `Save run ${number} as YAML` }, "yaml"),
    ];
  }

  // Of a run whose track is gone there is nothing to save, and it says why.
  download(run, text, href, title, label) {
    if (run.kept) return element("a", { href, download: "", title, "aria-label": label }, text);
    return element("button", { type: "button", class: "gone", disabled: true, title: gone(run.number), "aria-label": `${label}: ${gone(run.number)}` }, text);
  }

  note(run) {
    const text = element("textarea", {
      rows: 2, maxlength: 2000, "aria-label": `Note on run ${run.number}`, placeholder: "What was tried, and what came of it",
      onchange: () => ((this.noted = null), this.ask("Note", { number: run.number, name: run.name, note: text.value })),
    });
    text.value = run.note;
    return element("tr", { class: "note" }, element("td", { colspan: 5 }, text));
  }

  // The entries in which two differ.
  async compare() {
    const known = new Set(this.runs.map((run) => run.number));
    this.chosen = this.chosen.filter((number) => known.has(number));
    this.compared.hidden = this.chosen.length < 2;
    if (this.compared.hidden) return;
    const [a, b] = this.chosen;
    const answer = await fetch(`/api/runs/${a}/against/${b}`).catch(() => null);
    if (!answer?.ok) return;
    const differ = await answer.json();
    const shown = (value) => (typeof value === "number" ? compact(value, 6) : value === null ? "off" : String(value));
    const head = element("tr", {}, element("th", { scope: "col" }, "differs in"), ...[a, b].map((number) => element("th", { scope: "col" }, `run ${number}`)));
    const rows = differ.map((entry) => element("tr", {}, element("th", { scope: "row" }, entry.key), ...entry.values.map((value) => element("td", {}, shown(value)))));
    this.compared.replaceChildren(element("table", {}, element("thead", {}, head), element("tbody", {}, ...rows)), ...(rows.length ? [] : [element("p", { class: "faint" }, "Filter and tuning are the same.")]));
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
    coverage: least((score, fit) => fit && Math.abs(fit.coverage - COVERED)),
    likelihood: least((score) => (score.log_likelihood_reading === null ? NaN : -score.log_likelihood_reading)),
    step: least((score) => score.step_us ?? NaN),
  };
}
