// What came of a fit: the verdict in words, every entry before and after, and what both predict, of what was fitted to
// and of what was held out.

import { element } from "./dom.js";
import { compact, spaced, words } from "./format.js";

const ALONE = "left alone: the data cannot tell";
const EDGE = "at the edge of its range: the best may lie beyond";
const BOUND = "only a bound: the data cannot tell it from none";

// told: the answer of /api/fit; offers: buttons
export function fitted(told, offers) {
  const { result } = told;
  return [verdict(result), element("div", { class: "offers" }, ...offers), entries(result), scores(result), about(told)];
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
  const group = (title, readings) => element("th", { scope: "colgroup", colspan: 2 }, `${title}, ${readings.toLocaleString("en")} readings`);
  const head = element("thead", {},
    element("tr", {}, element("td", {}), group("fitted to", before.fitted.readings), group("held out", before.held_out.readings)),
    element("tr", {}, element("td", {}), ...["before", "after", "before", "after"].map((text) => element("th", { scope: "col" }, text))));
  return element("table", { class: "scores" }, head, element("tbody", {}, ...rows));
}

const about = ({ result, revision, events, elapsed }) =>
  element("p", { class: "about" }, `From run ${revision}, ${result.estimator}: ${result.folds} folds of ${events.toLocaleString("en")} events in ${compact(elapsed, 2)} s.${result.power < 1 ? ` Of what the fitted blocks say ${compact(result.power, 2)} is believed, in the intervals too: with more of it the others are predicted no better.` : ""}`);
