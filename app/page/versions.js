// The tuning versions that are kept beside the twin: one to load, and a run to keep as one.

import { element, setText } from "./dom.js";

export class Versions {
  constructor(link) {
    this.link = link;
    this.select = element("select", { "aria-label": "Tuning version" });
    this.load = element("button", { type: "button", title: "Load this version: the history is folded again with it", onclick: () => this.ask("/api/tunings/load", { name: this.select.value }) }, "load");
    this.error = element("p", { class: "error", role: "alert", hidden: true });
    this.node = element("div", { class: "versions" }, element("label", {}, "Version ", this.select), this.load, this.error);
  }

  // Asked for while somebody looks; what was chosen stays chosen.
  async list() {
    const answer = await fetch("/api/tunings").catch(() => null);
    if (!answer?.ok) return;
    const { running, versions } = await answer.json();
    const title = (item) => item.error ?? [item.note, item.saved?.slice(0, 16).replace("T", " "), item.holds ? "guards go by it" : null].filter(Boolean).join("; ");
    const chosen = this.select.value || running.replace("*", "");
    this.select.replaceChildren(...versions.map((item) => element("option", { value: item.name, title: title(item), disabled: Boolean(item.error), selected: item.name === chosen }, `${item.name}${item.name === running ? " ▸" : ""}${item.holds ? " ✓" : ""}`)));
  }

  // Says why where it is refused; whether it was done.
  async ask(path, fields) {
    const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(fields) }).catch(() => null);
    const reason = answer?.ok ? null : ((await answer?.json().catch(() => null))?.error ?? "no answer");
    setText(this.error, reason ?? "");
    this.error.hidden = !reason;
    await this.list();
    return !reason;
  }

  keep(run) {
    return this.ask("/api/tunings", { run: run.number, name: run.name.trim().replaceAll(" ", "_"), note: run.note });
  }
}
