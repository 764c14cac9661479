// The tuning versions that are kept beside the twin: listed with what they were worth, loaded, compared with what runs;
// and what runs, or any run, kept as another one.

import { element, setText } from "./dom.js";
import { compact } from "./format.js";

export class Versions {
  constructor(link) {
    this.link = link;
    this.compared = null; // name of the one that is compared with what runs
    this.table = element("table", {});
    this.error = element("p", { class: "error", role: "alert", hidden: true });
    this.name = element("input", { type: "text", "aria-label": "Name of the version", placeholder: "name", maxlength: 60 });
    this.note = element("input", { type: "text", "aria-label": "Note on the version", placeholder: "note", maxlength: 2000 });
    const keep = element("button", { type: "submit", class: "go", title: "Keep what runs as a version, beside the twin" }, "keep");
    this.form = element("form", { onsubmit: (event) => (event.preventDefault(), this.keepRunning()) }, this.name, this.note, keep);
    this.guard = element("p", { class: "guard faint", hidden: true });
    this.node = element("details", { class: "versions", open: true }, element("summary", { title: "Filter and tuning under a name, in files beside the twin" }, "Tuning versions"), this.table, this.guard, this.form, this.error);
  }

  // Asked for while somebody looks; what has the focus keeps it.
  async list() {
    const answer = await fetch("/api/tunings").catch(() => null);
    if (!answer?.ok) return;
    const { running, versions, guard } = await answer.json();
    this.guard.hidden = !guard.length;
    this.guard.replaceChildren(...guard.map((each) => guarded(each, versions)));
    const differ = this.compared && (await this.difference(this.compared));
    const focused = this.table.contains(document.activeElement) ? document.activeElement.dataset.focus : null;
    const head = element("tr", {}, element("th", { scope: "col" }, "version"), element("th", { scope: "col", title: "Mean NIS where it was scored" }, "NIS"), element("th", { scope: "col", title: "Log-likelihood of a reading where it was scored" }, "log L"), element("th", {}));
    this.table.replaceChildren(element("thead", {}, head), ...versions.map((item) => this.version(item, running, differ)));
    if (focused) this.table.querySelector(`[data-focus="${focused}"]`)?.focus();
  }

  version(item, running, differ) {
    const { name, scores = {}, holds, error } = item;
    const runs = running === name;
    const button = (text, title, click, attributes = {}) => element("button", { type: "button", title, "aria-label": `${title}: version ${name}`, dataset: { focus: `${text}${name}` }, disabled: Boolean(error), onclick: click, ...attributes }, text);
    const compare = () => ((this.compared = this.compared === name ? null : name), this.list());
    const about = error ?? [item.note, item.fitted_on?.length ? `fitted on ${item.fitted_on.join(", ")}` : "", item.accepted?.note ? `accepted: ${item.accepted.note}` : "", item.saved?.slice(0, 16).replace("T", " ") ?? "what the twin's file says"].filter(Boolean).join(" · ");
    return element("tbody", { dataset: { version: name, running: runs } },
      element("tr", {},
        element("th", { scope: "row" }, name, holds ? element("i", { title: "Accepted: nisus guard goes by it" }, " ✓") : null, runs ? element("i", { title: "Runs now" }, " ▸") : running === `${name}*` ? element("i", { title: "What runs began with it; since then something was turned" }, " ▸*") : null),
        element("td", {}, compact(scores.nis, 3)), element("td", {}, compact(scores.log_likelihood, 4)),
        element("td", {}, button("load", "Load: the history is folded again with it", () => this.ask("/api/tunings/load", { name })), button("⇄", "Compare with what runs", compare, { "aria-pressed": String(this.compared === name) }))),
      element("tr", { class: error ? "error" : "faint" }, element("td", { colspan: 4 }, about)),
      this.compared === name && differ ? element("tr", {}, element("td", { colspan: 4 }, differences(name, differ))) : null);
  }

  async difference(name) {
    const answer = await fetch(`/api/tunings/${encodeURIComponent(name)}/against`).catch(() => null);
    if (answer?.ok) return answer.json();
    this.say((await answer?.json().catch(() => null))?.error ?? "no answer");
    return null;
  }

  say(reason) {
    setText(this.error, reason ?? "");
    this.error.hidden = !reason;
  }

  // Says why where it is refused; whether it was done.
  async ask(path, fields) {
    const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(fields) }).catch(() => null);
    const reason = answer?.ok ? null : ((await answer?.json().catch(() => null))?.error ?? "no answer");
    this.say(reason);
    await this.list();
    return !reason;
  }

  keep(run) {
    return this.ask("/api/tunings", { run: run.number, name: run.name.trim().replaceAll(" ", "_"), note: run.note });
  }

  async keepRunning() {
    const kept = await this.ask("/api/tunings", { run: this.link.status.revision, name: this.name.value.trim().replaceAll(" ", "_"), note: this.note.value });
    if (kept) this.name.value = this.note.value = "";
  }
}

// What `nisus guard` said last of one recording: what got worse is shown, the rest is told.
function guarded(each, versions) {
  const { recording, at, version, figures, worse, better, failure } = each;
  const verdict = failure || (worse.length ? `${worse.length} of ${figures} figures worse: ${worse[0]}` : `none of ${figures} figures worse${better.length ? `, ${better.length} better` : ""}`);
  const holds = versions.find((item) => item.holds)?.name;
  const since = holds && version && holds !== version ? `; since then ${holds} was accepted` : "";
  const title = [...worse, ...better.map((text) => `better: ${text}`)].join("\n") || "What nisus guard compared with the recorded scores";
  return element("span", { class: failure || worse.length ? "error" : "", title, dataset: { guarded: recording } }, `${failure || worse.length ? "✗" : "✓"} guard, ${at.slice(0, 16).replace("T", " ")} UTC, ${recording} with ${version || "?"}: ${verdict}${since}`);
}

function differences(name, differ) {
  if (!differ.length) return "Filter and tuning are what runs.";
  const shown = (value) => (typeof value === "number" ? compact(value, 6) : value === null ? "off" : String(value));
  const head = element("tr", {}, ...["differs in", name, "what runs"].map((text) => element("th", { scope: "col" }, text)));
  return element("table", {}, element("thead", {}, head), element("tbody", {}, ...differ.map((entry) => element("tr", {}, element("th", { scope: "row" }, entry.key), ...entry.values.map((value) => element("td", {}, shown(value)))))));
}
