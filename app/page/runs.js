// Every revision: what was changed for it, and what it was worth. Pinned ones stay on the charts.

import { element } from "./dom.js";
import { compact } from "./format.js";

export class Runs {
  constructor(node, link) {
    Object.assign(this, { node, link });
    link.addEventListener("status", (event) => this.heard(event.detail));
  }

  async heard(status) {
    const key = `${status.revision}/${status.refolding}/${status.scored ?? ""}`;
    if (key === this.key) return;
    this.key = key;
    const answer = await fetch("/api/runs").catch(() => null);
    if (answer?.ok) this.show(await answer.json());
  }

  show(runs) {
    const cell = (value, digits = 3) => element("td", {}, typeof value === "number" ? compact(value, digits) : "–");
    const head = ["run", "what changed", "NIS", "RMSE", "logL"].map((text) => element("th", { scope: "col" }, text));
    const rows = [...runs].reverse().map((run) =>
      element("tr", { dataset: { revision: run.revision } }, element("td", {}, `r${run.revision}`), element("td", { title: run.what }, run.what), cell(run.nis), cell(run.rmse), cell(run.log_likelihood, 5)),
    );
    this.node.replaceChildren(element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows)));
  }
}
