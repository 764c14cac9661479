// Diagnose: are the innovations what the filter says they are, is the cloud healthy, what can be told, what could be
// wrong unnoticed. Small multiples with one sentence each; nothing is asked while this is hidden.

import { element, setText } from "./dom.js";
import { compact, span, spaced, words } from "./format.js";
import { correlations, decades, distribution, flat, quantiles, shares, stems } from "./plots.js";

const AGAIN = 3000; // ms between two looks
const FEW = 6; // rows that are all open
const LEANS = 0.1; // share of the readings in one half of the ranks, beyond a half of them
const UNEVEN = 1.4; // of the outer ranks against the others
const ORDER = ["bad", "unknown", "good"];
const SIGNS = { good: "●", bad: "◐", unknown: "○" };
const HEALTH = { good: "tracking", bad: "suspect", unknown: "waiting" };

export class Diagnose {
  // save(plot, button, events): of a plot that is to be kept
  constructor(node, link, save) {
    Object.assign(this, { node, link, save });
    this.shown = false;
    this.drawn = null;
    this.turned = new Map(); // rows that the user has opened or closed, by name
  }

  show() {
    this.shown = true;
    this.ask();
  }

  hide() {
    this.shown = false;
    clearTimeout(this.timer);
  }

  async ask() {
    clearTimeout(this.timer);
    try {
      const answer = await fetch("/api/diagnose");
      if (!answer.ok) throw new Error((await answer.text()).trim());
      const text = await answer.text();
      if (this.shown && text !== this.drawn) {
        this.drawn = text;
        this.draw(JSON.parse(text));
      }
    } catch (error) {
      if (!this.drawn) setText(this.node, `The twin does not answer: ${error.message}`);
    }
    if (this.shown) this.timer = setTimeout(() => this.ask(), AGAIN);
  }

  draw(found) {
    const good = found.rows.filter((row) => row.tone === "good").length;
    const but = good && ["above", "below"].includes(found.nis_place) ? `, but the mean NIS is ${found.nis_place} its bounds` : "";
    const left = found.rows_in_all > found.rows.length ? ` (the first of ${found.rows_in_all})` : "";
    const rows = [...found.rows].sort((a, b) => ORDER.indexOf(a.tone) - ORDER.indexOf(b.tone));
    const open = (row) => this.turned.get(row.name) ?? (found.rows.length <= FEW || row.tone === "bad");
    const focused = this.node.contains(document.activeElement) ? document.activeElement.getAttribute("aria-label") : null;
    const cost = found.cost === null ? "" : ` An event costs ${compact(found.cost, 3)} µs.`;
    this.node.replaceChildren(
      element("p", { class: "summary" }, element("b", {}, `${good} of ${found.rows.length} sensor rows${left} are as they should be${but}. `), `Last ${found.events.toLocaleString("en")} events, ${span(found.span)}, ${found.estimator}: ${found.nis}.${cost}`),
      ...rows.map((row) => rowCard(row, found.marginal, open(row), (now) => this.turned.set(row.name, now))),
      element("div", { class: "cards" }, ...[ranksCard(found), particlesCard(found), correlationCard(found), ...unseenCards(found)].filter(Boolean)),
    );
    this.savable(found.events);
    if (focused) this.node.querySelector(`[aria-label="${CSS.escape(focused)}"]`)?.focus();
    window.nisus.diagnosed = (window.nisus.diagnosed ?? 0) + 1;
  }

  // Each plot has its own button.
  savable(events) {
    for (const plot of this.node.querySelectorAll("svg[aria-label]")) {
      const label = plot.getAttribute("aria-label");
      const button = element("button", { type: "button", class: "save", title: "Save this plot", "aria-label": `Save the plot: ${label}`, "aria-haspopup": "menu", onclick: () => this.save(plot, button, events) }, "⤓");
      (plot.closest("figure")?.querySelector("figcaption") ?? plot.closest("article").querySelector("header")).append(button);
    }
  }
}

// A plot under its name and what a good one looks like.
const figure = (name, good, plot) => element("figure", {}, element("figcaption", {}, element("b", {}, name), " ", element("span", { class: "faint" }, good)), plot);

function rowCard(row, marginal, open, turned) {
  const name = words(row.name);
  const [first, ...rest] = row.verdict.split(": ");
  const head = element("summary", { "data-health": HEALTH[row.tone] }, element("i", {}, SIGNS[row.tone]), element("b", {}, words(first)), element("span", {}, rest.join(": ")));
  const card = element("details", { class: "row", open, "aria-label": `Innovations of ${name}` }, head);
  head.addEventListener("click", () => turned(!card.open)); // a key's click, too
  if (!row.n) return card;
  const third = marginal
    ? figure("Ranks", "good: flat, within the band", flat(row.ranks, `Rank histogram of ${name}`))
    : figure("Quantiles", "good: on the line", quantiles(row.quantiles, `Quantiles of ${name} against normal ones`));
  card.append(
    element(
      "div", { class: "plots" },
      figure("Distribution", "good: bars along the curve", distribution(row.histogram, `Distribution of the innovations of ${name}, beside N(0, 1)`)),
      figure("Autocorrelation", "good: within the band", stems(row.autocorrelation, `Autocorrelation of the innovations of ${name}`, row.period ?? 1)),
      third,
    ),
    element("p", { class: "faint" }, figures(row)),
  );
  return card;
}

// Sizes with their 95 % intervals.
function figures(row) {
  const interval = ([value, low, high]) => (low === null ? compact(value, 2) : `${compact(value, 2)} (${compact(low, 2)} to ${compact(high, 2)})`);
  const parts = [`${row.n.toLocaleString("en")} readings`];
  if (row.scale?.[0] != null) parts.push(`bands should be ${interval(row.scale)} times as wide`);
  if (row.bias?.[0] != null) parts.push(`bias ${interval(row.bias)} σ`);
  if (row.correlation?.[0] != null) parts.push(`each with the next ${interval(row.correlation)}`);
  if (row.refused !== null) parts.push(`${compact(100 * row.refused, 2)} % refused`);
  if (!row.used) parts.push("held out");
  return parts.join(" · ");
}

const card = (name, good, verdict, ...body) =>
  element("article", { class: "card", "aria-label": name }, element("header", {}, element("b", {}, name), element("span", { class: "faint" }, good)), verdict ? element("p", {}, verdict) : null, ...body);

function ranksCard({ ranks }) {
  if (!ranks) return null;
  const { counts, low, high } = ranks;
  const n = counts.reduce((sum, count) => sum + count, 0);
  return card("Readings among the members", "good: flat, within the band", `Of ${n.toLocaleString("en")} values since the start: ${shape(counts, n)}.`, flat(ranks, "Rank histogram of the ensemble"));
}

// What matters, not what a test would find among so many.
function shape(counts, n) {
  const expected = n / counts.length;
  const ends = (counts[0] + counts.at(-1)) / (2 * expected);
  const low = counts.slice(0, counts.length / 2).reduce((sum, count) => sum + count, 0) / n;
  if (Math.abs(low - 0.5) > LEANS) return `most lie ${low > 0.5 ? "low" : "high"}, so the prediction reads too ${low > 0.5 ? "high" : "low"}`;
  if (ends > UNEVEN) return `the ends hold ${compact(ends, 2)} times what they should, so the spread is too small`;
  if (ends < 1 / UNEVEN) return `the ends hold ${compact(ends, 2)} of what they should, so the spread is too large`;
  return "about flat, so the spread is right";
}

function particlesCard({ particles }) {
  if (!particles) return null;
  const { t, effective, ancestors, count, lag } = particles;
  const least = Math.min(...effective);
  const roots = ancestors.filter((value) => value !== null);
  const descent = roots.length ? ` They descend from ${compact(roots.at(-1), 3)}${lag ? ` of ${compact(lag, 3)} readings ago` : ""}.` : "";
  const verdict = least < 0.02 * count ? "few carry the estimate at times" : "enough carry the estimate";
  return card(
    "Particles that count", "good: far above 1, most of the time",
    `Of ${compact(count, 6)} at least ${compact(least, 3)} count: ${verdict}.${descent}`,
    decades(t, [[effective, "line"], [ancestors, "line second"]], count, "Effective sample size and ancestors over time", [`−${span(-t[0])}`, "now"]),
    element("p", { class: "faint key" }, element("i", { class: "swatch" }), "effective sample size ", element("i", { class: "swatch second" }), "ancestors"),
  );
}

function correlationCard({ correlation }) {
  const { names, matrix, reason } = correlation;
  if (!names.length) return card("Correlation of the estimates", "", `${reason}.`);
  let most = [0, 0, 0];
  matrix.forEach((row, i) => row.forEach((value, j) => i < j && value !== null && Math.abs(value) > Math.abs(most[0]) && (most = [value, i, j])));
  const [value, i, j] = most;
  const verdict = Math.abs(value) > 0.9 ? `${words(names[i])} and ${words(names[j])} can hardly be told apart (${value.toFixed(2)}).` : n(names.length, value, words(names[i]), words(names[j]));
  return card("Correlation of the estimates", "good: pale beside the diagonal", reason ? `${verdict} ${reason}.` : verdict, correlations(names.map(words), matrix, "Correlations of the present covariance"), element("p", { class: "faint key" }, element("i", { class: "swatch" }), "together ", element("i", { class: "swatch against" }), "opposed"));
}

const n = (count, value, a, b) => (count < 2 ? "There is one state." : `All can be told apart; closest are ${a} and ${b} (${value.toFixed(2)}).`);

// One word for all where one reason speaks against all.
function unseenCards(found) {
  const reason = found.observability.reason;
  if (reason && reason === found.unseen_reason) return [card("Observability, visible faults, integrity", "", `${reason}.`)];
  return [observabilityCard(found), faultsCard(found), integrityCard(found)];
}

function observabilityCard({ observability }) {
  const { reason, rank, of, conditioning, states, weakest, span: seconds, note } = observability;
  if (reason) return card("Observability", "", `${reason}.`);
  const told = rank === of ? `The readings of ${span(seconds)} tell more of all ${of} directions than the prior did` : `The readings of ${span(seconds)} tell more than the prior of ${rank} of ${of} directions`;
  const between = conditioning === null ? "" : `; best to worst 1 : ${compact(conditioning, 2)}`;
  return card(
    "Observability", "good: little left of every state",
    `${told}${between}. Weakest: ${weakest}.${note ? ` ${note}.` : ""}`,
    shares(Object.entries(states).map(([name, share]) => [words(name), share]), "Share of the prior's deviation that the readings leave of each state"),
  );
}

function faultsCard({ faults, unseen_reason: reason }) {
  if (reason || !faults.length) return card("Smallest visible faults", "", `${reason || "Nothing to nudge"}.`);
  const blind = faults.filter((item) => item.share === null).length;
  const verdict = blind ? `${blind} of ${faults.length} pass unseen, as large as they can be.` : "Every one is seen, if it is large enough.";
  return card(
    "Smallest visible faults", "good: small beside what matters to you", verdict,
    table(["fault of", "seen from", "unseen"], faults.map((item) => [words(item.subject), plain(item.size), plain(item.unseen)])),
  );
}

function integrityCard({ integrity, unseen_reason: reason }) {
  const entries = Object.entries(integrity);
  if (reason || !entries.length) return card("Integrity", "", `${reason || "Nothing is bounded"}.`);
  const [worst, item] = entries.reduce((a, b) => ((b[1].bound ?? Infinity) / b[1].two_sigma > (a[1].bound ?? Infinity) / a[1].two_sigma ? b : a));
  const far = item.bound === null ? "without limit" : `by ${compact(item.bound, 2)}${spaced(item.unit)}`;
  return card(
    "Integrity", "good: the bound is near 2σ",
    `One fault that nobody sees could put ${words(worst)} off ${far}, not ${compact(item.two_sigma, 2)}${spaced(item.unit)}.`,
    table(["state", "2σ", "bound", "by"], entries.map(([name, entry]) => [words(name), `${compact(entry.two_sigma, 2)}${spaced(entry.unit)}`, entry.bound === null ? "none" : `${compact(entry.bound, 2)}${spaced(entry.unit)}`, words(entry.fault)])),
  );
}

// "4.9e+03 %" as 4900 %.
const plain = (text) => text.replace(/\d+(\.\d+)?e\+\d+/g, (figures) => String(Math.round(Number(figures))));

const table = (heads, rows) => element("table", {}, element("tr", {}, ...heads.map((head) => element("th", {}, head))), ...rows.map((row) => element("tr", {}, ...row.map((cell) => element("td", {}, cell)))));
