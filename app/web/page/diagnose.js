// Diagnose: are the innovations what the filter says they are, is the cloud healthy, what can be told, what could be
// wrong unnoticed. Small multiples with one sentence each; nothing is asked while this is hidden.

import { changed, element, keepFocus, setText, table } from "./dom.js";
import { compact, count, inChartTime, spaced, span, words } from "./format.js";
import { get } from "./http.js";

const AGAIN = 3000; // ms between two looks
const MAX_OPEN_ROWS = 6; // rows that are all open
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
    this.drawn = false;
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
    const found = await get("api/diagnose");
    if (found.error && !this.drawn) setText(this.node, `No answer from the twin: ${found.error}`);
    else if (!found.error && this.shown && changed(this.node, found)) keepFocus(this.node, "aria-label", () => this.draw(found));
    if (this.shown) this.timer = setTimeout(() => this.ask(), AGAIN);
  }

  draw(found) {
    const good = found.rows.filter((row) => row.tone === "good").length;
    const but = good && ["above", "below"].includes(found.nis_place) ? `, but the mean NIS is ${found.nis_place} its bounds` : "";
    const left = found.rows_in_all > found.rows.length ? ` (the first of ${found.rows_in_all})` : "";
    const rows = [...found.rows].sort((a, b) => ORDER.indexOf(a.tone) - ORDER.indexOf(b.tone));
    const open = (row) => this.turned.get(row.name) ?? (found.rows.length <= MAX_OPEN_ROWS || row.tone === "bad");
    const cost = found.cost === null ? "" : ` ${compact(found.cost, 3)} µs per event.`;
    this.node.replaceChildren(
      element("p", { class: "summary" }, element("b", {}, `${good} of ${found.rows.length} sensor rows${left} are consistent${but}. `), `Last ${found.events.toLocaleString("en")} events, ${span(found.span)}, ${found.estimator}: ${found.nis}.${cost}`),
      ...rows.map((row) => rowCard({ ...row, verdict: inChartTime(row.verdict, this.link.status.origin) }, found.marginal, open(row), (now) => this.turned.set(row.name, now))),
      element("div", { class: "cards" }, ...[ranksCard(found), particlesCard(found), varianceCard(found), correlationCard(found), ...unseenCards(found)].filter(Boolean)),
    );
    this.drawn = true;
    this.savable(found.events);
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

// A plot below its name and the description of a good one.
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
      figure("Coverage [%]", "good: 95 at all times", coverage(row.coverage, `Coverage of the 95 % band of ${name} over time`)),
    ),
    element("p", { class: "faint" }, figures(row)),
  );
  return card;
}

// Sizes with their 95 % intervals.
function figures(row) {
  const interval = ([value, low, high]) => (low === null ? compact(value, 2) : `${compact(value, 2)} (${compact(low, 2)} to ${compact(high, 2)})`);
  const parts = [count(row.n, "measurement")];
  if (row.scale?.[0] != null) parts.push(`band scale ${interval(row.scale)}`);
  if (row.bias?.[0] != null) parts.push(`bias ${interval(row.bias)} σ`);
  if (row.correlation?.[0] != null) parts.push(`lag-1 correlation ${interval(row.correlation)}`);
  if (row.refused !== null) parts.push(`${compact(100 * row.refused, 2)} % rejected`);
  if (!row.used) parts.push("held out");
  const [inside, factor] = row.coverage.adaptive ?? [null, null];
  if (/ at /.test(row.coverage.operating)) parts.push(`lowest coverage ${words(row.coverage.operating)}`);
  if (factor !== null) parts.push(`adaptive 95 % interval ${compact(factor, 2)} × band, ${compact(100 * inside, 3)} % inside`);
  return parts.join(" · ");
}

const card = (name, good, verdict, ...body) =>
  element("article", { class: "card", "aria-label": name }, element("header", {}, element("b", {}, name), element("span", { class: "faint" }, good)), verdict ? element("p", {}, verdict) : null, ...body);

function ranksCard({ ranks }) {
  if (!ranks) return null;
  const { counts, low, high } = ranks;
  const n = counts.reduce((sum, count) => sum + count, 0);
  return card("Rank histogram", "good: flat, within the band", `Of ${n.toLocaleString("en")} values since the start: ${shape(counts, n)}.`, flat(ranks, "Rank histogram of the ensemble"));
}

// Deviations that matter in practice, not those that a test finds among many values.
function shape(counts, n) {
  const expected = n / counts.length;
  const ends = (counts[0] + counts.at(-1)) / (2 * expected);
  const low = counts.slice(0, counts.length / 2).reduce((sum, count) => sum + count, 0) / n;
  if (Math.abs(low - 0.5) > LEANS) return `most ranks are ${low > 0.5 ? "low" : "high"}: the prediction is biased ${low > 0.5 ? "high" : "low"}`;
  if (ends > UNEVEN) return `extreme ranks occur ${compact(ends, 2)} times as often as expected: the spread is too small`;
  if (ends < 1 / UNEVEN) return `extreme ranks occur ${compact(ends, 2)} times as often as expected: the spread is too large`;
  return "about flat: the spread is right";
}

function particlesCard({ particles }) {
  if (!particles) return null;
  const { t, effective, ancestors, count, lag } = particles;
  const least = Math.min(...effective);
  const roots = ancestors.filter((value) => value !== null);
  const descent = roots.length ? ` ${compact(roots.at(-1), 3)} ancestors${lag ? ` ${compact(lag, 3)} measurements ago` : ""}.` : "";
  const verdict = least < 0.02 * count ? "too few at times" : "sufficient";
  return card(
    "Effective particles", "good: far above 1",
    `At least ${compact(least, 3)} of ${compact(count, 6)}: ${verdict}.${descent}`,
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
  const verdict = Math.abs(value) > 0.9 ? `${words(names[i])} and ${words(names[j])} are hardly distinguishable (${value.toFixed(2)}).` : n(names.length, value, words(names[i]), words(names[j]));
  return card("Correlation of the estimates", "good: pale off the diagonal", reason ? `${verdict} ${reason}.` : verdict, correlations(names.map(words), matrix, "Correlations of the present covariance"), element("p", { class: "faint key" }, element("i", { class: "swatch" }), "together ", element("i", { class: "swatch against" }), "opposed"));
}

const n = (count, value, a, b) => (count < 2 ? "There is one state." : `All are distinguishable; most correlated: ${a} and ${b} (${value.toFixed(2)}).`);

// Of a twin with considered parameters: whose uncertainty the bands come from.
function varianceCard({ variance, gain }) {
  const entries = Object.entries(variance);
  if (!entries.length) return null;
  return card(
    "Sources of uncertainty", "good: none that a measurement could remove",
    "Share of each state's variance by considered parameter; noise is the rest: sensors, process and prior. Last column: the parameter whose measurement would reduce σ most.",
    table(["state", "variance from", "if measured"], entries.map(([name, text]) => [words(name), words(text), words(gain[name])])),
  );
}

// One card where all three have the same reason.
function unseenCards(found) {
  const reason = found.observability.reason;
  if (reason && reason === found.unseen_reason) return [card("Observability, visible faults, protection levels", "", `${reason}.`)];
  return [observabilityCard(found), faultsCard(found), integrityCard(found)];
}

function observabilityCard({ observability }) {
  const { reason, rank, of, conditioning, states, weakest, span: seconds, note } = observability;
  if (reason) return card("Observability", "", `${reason}.`);
  const told = rank === of ? `${span(seconds)} of measurements inform all ${of} directions` : `${span(seconds)} of measurements inform ${rank} of ${of} directions`;
  const between = conditioning === null ? "" : `; best to worst 1 : ${compact(conditioning, 2)}`;
  return card(
    "Observability", "good: small share for every state",
    `${told}${between}. Weakest: ${weakest}.${note ? ` ${note}.` : ""}`,
    shares(Object.entries(states).map(([name, share]) => [words(name), share]), "Share of the prior deviation that remains in each state"),
  );
}

function faultsCard({ faults, unseen_reason: reason }) {
  if (reason || !faults.length) return card("Smallest visible faults", "", `${reason || "Nothing to nudge"}.`);
  const blind = faults.filter((item) => item.share === null).length;
  const verdict = blind ? `${blind} of ${faults.length} are undetectable at any size.` : "All are detectable if large enough.";
  return card(
    "Smallest visible faults", "good: small compared with your tolerance", verdict,
    table(["fault of", "detected from", "undetected"], faults.map((item) => [words(item.subject), plain(item.size), plain(item.unseen)])),
  );
}

function integrityCard({ integrity, unseen_reason: reason }) {
  const entries = Object.entries(integrity);
  if (reason || !entries.length) return card("Protection levels", "", `${reason || "No state has one"}.`);
  const [worst, item] = entries.reduce((a, b) => ((b[1].bound ?? Infinity) / b[1].two_sigma > (a[1].bound ?? Infinity) / a[1].two_sigma ? b : a));
  const far = item.bound === null ? "without limit" : `by ${compact(item.bound, 2)}${spaced(item.unit)}`;
  return card(
    "Protection levels", "good: near 2σ",
    `One undetected fault can shift ${words(worst)} ${far} (2σ: ${compact(item.two_sigma, 2)}${spaced(item.unit)}).`,
    table(["state", "2σ", "level", "fault"], entries.map(([name, entry]) => [words(name), `${compact(entry.two_sigma, 2)}${spaced(entry.unit)}`, entry.bound === null ? "none" : `${compact(entry.bound, 2)}${spaced(entry.unit)}`, words(entry.fault)])),
  );
}

// "4.9e+03 %" as 4900 %.
const plain = (text) => text.replace(/\d+(\.\d+)?e\+\d+/g, (figures) => String(Math.round(Number(figures))));

// Small plots as SVG, drawn from arrays: bars, stems, points, lines, a map of correlations. Colours are the page's own.

const W = 260;
const H = 128;
const LEFT = 30;
const BOTTOM = 18;
const TOP = 6;
const RIGHT = 6;

const svg = (name, attributes, ...children) => element(`svg:${name}`, attributes, ...children);
const two = (value) => (Math.abs(value) < 0.005 ? "0.00" : value.toFixed(2));
const round = (value) => Math.round(10 * value) / 10;

// A frame of axes: x(v) and y(v) give places, `node` is what to append to.
function frame([x0, x1], [y0, y1], label, { xs = [], ys = [] } = {}) {
  const x = (value) => round(LEFT + ((value - x0) / (x1 - x0 || 1)) * (W - LEFT - RIGHT));
  const y = (value) => round(H - BOTTOM - ((value - y0) / (y1 - y0 || 1)) * (H - BOTTOM - TOP));
  const node = svg("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": label });
  for (const [value, text] of ys) {
    node.append(svg("line", { class: "grid", x1: LEFT, x2: W - RIGHT, y1: y(value), y2: y(value) }));
    node.append(svg("text", { x: LEFT - 4, y: y(value) + 3.5, "text-anchor": "end" }, text ?? compact(value, 3)));
  }
  for (const [value, text, anchor = "middle"] of xs) node.append(svg("text", { x: x(value), y: H - 5, "text-anchor": anchor }, text));
  return { node, x, y };
}

const path = (points) => points.map(([x, y], k) => `${k ? "L" : "M"}${x} ${y}`).join("");

// Counts as shares by bin, beside the normal density.
function distribution({ low, high, counts }, label) {
  const n = counts.reduce((sum, count) => sum + count, 0) || 1;
  const width = (high - low) / counts.length;
  const heights = counts.map((count) => count / n / width);
  const top = Math.max(0.45, 1.05 * Math.max(...heights));
  const { node, x, y } = frame([low, high], [0, top], label, { xs: [[-3, "−3σ"], [0, "0"], [3, "3σ"]], ys: [[0], [0.4]] });
  heights.forEach((height, k) => {
    if (height) node.append(svg("rect", { class: "bar", x: x(low + k * width) + 0.3, width: x(low + width) - x(low) - 0.6, y: y(height), height: y(0) - y(height) }));
  });
  const curve = Array.from({ length: 81 }, (_, k) => low + (k / 80) * (high - low)).map((v) => [x(v), y(Math.exp(-0.5 * v * v) / Math.sqrt(2 * Math.PI))]);
  node.append(svg("path", { class: "expected", d: path(curve) }));
  return node;
}

// Correlation at each lag, and the band in which those of a white series stay.
function stems({ r, bound }, label, step) {
  const known = r.filter((value) => value !== null);
  const most = Math.max(0.3, ...known.map(Math.abs));
  const end = r.length;
  const { node, x, y } = frame([0, end], [-most, most], label, { xs: [[end / 2, `${compact((end / 2) * step, 2)} s`], [end, `${compact(end * step, 2)} s`, "end"]], ys: [[-most], [0], [most]].map(([v]) => [v, compact(v, 2)]) });
  if (bound !== null) node.append(svg("rect", { class: "bounds", x: x(0), width: x(end) - x(0), y: y(bound), height: y(-bound) - y(bound) }));
  r.forEach((value, k) => {
    if (value !== null) node.append(svg("line", { class: "stem", x1: x(k + 1), x2: x(k + 1), y1: y(0), y2: y(value) }));
  });
  return node;
}

// What was, over what a normal variable would have been.
function quantiles(pairs, label) {
  const most = Math.max(3, ...pairs.flat().map((value) => Math.min(8, Math.abs(value))));
  const ends = [-most, most];
  const mark = Math.floor(0.8 * most); // where the labels of both axes have room
  const { node, x, y } = frame(ends, ends, label, { xs: [[-mark, `−${mark}σ`], [0, "0"], [mark, `${mark}σ`]], ys: [[-mark], [0], [mark]] });
  node.append(svg("line", { class: "expected", x1: x(-most), y1: y(-most), x2: x(most), y2: y(most) }));
  for (const [normal, own] of pairs) node.append(svg("circle", { class: "dot", r: 1.8, cx: x(normal), cy: y(Math.max(-most, Math.min(most, own))) }));
  return node;
}

// Counts that should be equal, and the band in which they would stay.
function flat({ counts, low, high }, label) {
  const top = 1.1 * Math.max(high, ...counts, 1);
  const { node, x, y } = frame([0, counts.length], [0, top], label, { xs: [[0.5, "lowest"], [counts.length - 0.7, "highest"]], ys: [[0], [high]].map(([v]) => [v, compact(v, 2)]) });
  counts.forEach((count, k) => node.append(svg("rect", { class: "bar", x: x(k) + 1, width: x(1) - x(0) - 2, y: y(count), height: y(0) - y(count) })));
  node.append(svg("rect", { class: "bounds", x: x(0), width: x(counts.length) - x(0), y: y(high), height: y(Math.max(0, low)) - y(high) }));
  return node;
}

// Share of measurements inside the 95 % band in each part of the time, with its interval.
function coverage({ t, share }, label) {
  const low = Math.min(0.8, ...share.map(([value, under]) => under ?? value));
  const [from, to] = [t[0]?.[0] ?? 0, t.at(-1)?.[1] ?? 1];
  const { node, x, y } = frame([from, to], [Math.max(0, low - 0.02), 1], label, { xs: [[from, `−${span(to - from)}`, "start"], [to, "now", "end"]], ys: [[0.95, "95"], [1, ""], [low, String(Math.round(100 * low))]] });
  node.append(svg("line", { class: "expected", x1: x(from), x2: x(to), y1: y(0.95), y2: y(0.95) }));
  share.forEach(([value, under, over], k) => {
    const middle = x((t[k][0] + t[k][1]) / 2);
    if (under !== null) node.append(svg("line", { class: "stem", x1: middle, x2: middle, y1: y(under), y2: y(over) }));
    node.append(svg("circle", { class: "dot", r: 2.4, cx: middle, cy: y(value) }));
  });
  return node;
}

// Lines over time, on a logarithmic axis: [[values, class], …].
function decades(t, lines, most, label, ends) {
  const log = (value) => Math.log10(Math.max(1, value));
  const top = log(most || Math.max(...lines.flatMap(([values]) => values)));
  const ticks = Array.from({ length: Math.floor(top) + 1 }, (_, k) => [k, k < 3 ? String(10 ** k) : `${10 ** (k - 3)}k`]);
  const { node, x, y } = frame([t[0], t.at(-1)], [0, top || 1], label, { xs: [[t[0], ends[0], "start"], [t.at(-1), ends[1], "end"]], ys: ticks });
  for (const [values, kind] of lines) {
    const points = values.flatMap((value, k) => (value === null ? [] : [[x(t[k]), y(log(value))]]));
    node.append(svg("path", { class: kind, d: path(points) }));
  }
  return node;
}

const MAX_NAME = 25; // characters beside the map of correlations

// Correlations from -1 to 1, by name.
function correlations(names, matrix, label) {
  const n = names.length;
  const written = names.map((name) => (name.length > MAX_NAME ? `…${name.slice(1 - MAX_NAME)}` : name));
  const side = Math.max(9, Math.min(44, 230 / n));
  const room = 8 + 5.6 * Math.max(...written.map((name) => name.length));
  const node = svg("svg", { viewBox: `0 0 ${round(room + n * side + 4)} ${round(n * side + room)}`, role: "img", "aria-label": label, class: "map" });
  matrix.forEach((row, i) => {
    if (side >= 9) node.append(svg("text", { x: room - 4, y: round((i + 0.5) * side + 3.5), "text-anchor": "end" }, written[i]));
    const at = `${round(room + (i + 0.5) * side + 3)} ${round(n * side + 5)}`;
    node.append(svg("text", { transform: `translate(${at}) rotate(-90)`, "text-anchor": "end" }, written[i]));
    row.forEach((value, j) => {
      const place = { x: round(room + j * side), y: round(i * side), width: side - 1, height: side - 1 };
      const cell = svg("rect", { ...place, class: value < 0 ? "against" : "with", "fill-opacity": value === null ? 0 : Math.abs(value) });
      cell.append(svg("title", {}, `${names[i]}, ${names[j]}: ${value === null ? "–" : two(value)}`));
      node.append(cell);
      if (side >= 26 && value !== null) node.append(svg("text", { x: round(place.x + side / 2), y: round(place.y + side / 2 + 3.5), "text-anchor": "middle", class: Math.abs(value) > 0.6 ? "over" : "" }, two(value)));
    });
  });
  return node;
}

// Shares from 0 to 1, a bar for each name.
function shares(entries, label) {
  const table = element("table", { class: "shares", "aria-label": label });
  for (const [name, share] of entries)
    table.append(element("tr", {}, element("th", {}, name), element("td", {}, element("i", { style: `width:${round(100 * Math.min(1, share))}%` })), element("td", {}, `${compact(100 * share, 2)} %`)));
  return table;
}
