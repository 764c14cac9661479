// The assets of a fleet, the worst first. Only the rows in view are asked for and drawn.

import { keys, themeButton } from "../page/controls.js";
import { $, element, keepFocus, setAttribute, setText, showText } from "../page/dom.js";
import { bracketed, compact, count, span, withDeviation } from "../page/format.js";

const POLL_MS = 1000;
const ROW = 32; // px, as in fleet.css
const SPARE = 10; // rows before and after those in view
const MAX_STATES = 4; // columns of states; the distribution has all

const settings = JSON.parse(document.body.dataset.settings);
const states = settings.states.slice(0, MAX_STATES);
const nx = settings.states.length;
const query = { sort: "health", down: true, find: "", health: "", column: settings.columns[0], differs: false };
let answer = null;
let asking = null;
let again = false;
let timer = 0;

document.title = `${settings.fleet} · Nisus`;
setText($("place"), settings.fleet);
setText($("about"), `${settings.title} · ${settings.estimator}`);
document.body.style.setProperty("--columns", `repeat(${states.length}, minmax(110px, 1fr))`);

themeButton();

// Columns: name of the order, heading, and whether it holds numbers.
const heads = [
  ["asset", "Asset"], ["health", "Health"], ["lasting", "For", true], [null, "Cause"],
  ...states.map((name) => [name, `${name.replaceAll("_", " ")} ${bracketed(settings.units[name])}`, true]),
  ["nis", "NIS", true], ["age", "Age", true],
];
$("heads").replaceChildren(...heads.map(([name, text, number]) => {
  const head = element("span", { role: "columnheader", class: number ? "number" : null });
  if (name) head.append(element("button", { type: "button", onclick: () => sort(name) }, text));
  else head.append(element("span", { class: "faint" }, text));
  head.dataset.sort = name ?? "";
  return head;
}));

// Ask for other rows, from the first one on.
function choose(change) {
  Object.assign(query, change);
  $("window").scrollTop = 0;
  ask(true);
}

const sort = (name) => choose({ sort: name, down: query.sort === name ? !query.down : name !== "asset" });

function visible() {
  const first = Math.max(0, Math.floor($("window").scrollTop / ROW) - SPARE);
  return { first, count: Math.ceil($("window").clientHeight / ROW) + 2 * SPARE };
}

// Ask for the rows in view; unless something was changed, the answer to the version that is known is short.
async function ask(changed = false) {
  clearTimeout(timer);
  again ||= changed;
  if (asking || document.hidden) return;
  const fresh = again || !answer;
  again = false;
  const asked = { ...query, ...visible(), version: fresh ? -1 : answer.version };
  asking = fetch(`api/fleet?${new URLSearchParams(asked)}`).catch(() => null);
  const found = await asking;
  asking = null;
  if (found?.ok) {
    const next = await found.json();
    if (next.rows) draw((answer = next));
  }
  setText($("state"), found?.ok ? stateText() : found ? "" : "Nisus does not answer");
  if (found && !found.ok) showText($("failed"), await found.text());
  clearTimeout(timer);
  if (again) ask();
  else timer = setTimeout(() => ask(), POLL_MS);
}

const stateText = () => (answer ? ["", count(answer.assets, "asset"), answer.ended ? "source has ended" : "live", answer.stale ? `${count(answer.stale, "late event")} dropped` : null, answer.refused ? count(answer.refused, "problem") : null].filter(Boolean).join(" · ") : "");

function draw({ rows, first, found, assets, counts, histogram, siblings, failure }) {
  $("rows").style.height = `${found * ROW}px`;
  keepFocus($("rows"), "href", () => $("rows").replaceChildren(...rows.map((row, k) => item(row, first + k))));
  showText($("none"), found ? "" : assets ? "No asset of that kind." : "No measurements yet.");
  for (const head of $("heads").children) setAttribute(head, "aria-sort", head.dataset.sort && head.dataset.sort === query.sort ? (query.down ? "descending" : "ascending") : null);
  grades(counts, assets);
  distribution(histogram);
  beside(siblings);
  showText($("failed"), failure);
}

function item({ asset, id, health, cause, values }, place) {
  const at = 2 * nx;
  const [nis, low, high, lasting, age] = values.slice(at).map((value) => value ?? NaN);
  const number = (text, title) => element("span", { class: "number", role: "cell", title }, text);
  const node = element(
    "a", { class: "asset", role: "row", href: `twins/${encodeURIComponent(id)}/` },
    element("b", { role: "cell", title: asset }, asset),
    element("span", { class: "pill", role: "cell", dataset: { health } }, health),
    number(Number.isFinite(lasting) ? span(lasting) : "–", `${health} since then`),
    element("span", { class: "cause faint", role: "cell" }, cause === health ? "" : cause),
    ...states.map((name, k) => number(withDeviation(values[k] ?? NaN, 2 * (values[nx + k] ?? NaN)), "estimate ± 2σ")),
    number(compact(nis, 3), Number.isFinite(low) ? `95 % bounds ${compact(low, 3)} to ${compact(high, 3)}` : null),
    number(Number.isFinite(age) ? span(age) : "–"),
  );
  node.style.top = `${place * ROW}px`;
  return node;
}

function grades(counts, assets) {
  const list = $("grades");
  const entries = Object.entries(counts);
  if (!list.children.length)
    list.replaceChildren(...entries.map(([name]) => element("li", {}, element("button", { type: "button", dataset: { health: name }, title: `Show the assets that are ${name}`, onclick: () => choose({ health: query.health === name ? "" : name }) }, element("span", {}, name), element("i"), element("output")))));
  const most = Math.max(1, ...Object.values(counts));
  entries.forEach(([name, number], k) => {
    const button = list.children[k].firstElementChild;
    setAttribute(button, "aria-pressed", String(query.health === name));
    setAttribute(button, "data-empty", String(!number));
    button.querySelector("i").style.width = `${(100 * number) / most}%`;
    setText(button.querySelector("output"), number.toLocaleString("en"));
    setAttribute(button.querySelector("output"), "title", `${compact((100 * number) / Math.max(1, assets), 3)} %`);
  });
}

function distribution(found) {
  const unit = bracketed(settings.units[query.column]);
  if (!found) return $("distribution").replaceChildren(element("p", { class: "faint" }, "No values yet."));
  const most = Math.max(...found.counts);
  const width = 100 / found.counts.length;
  const bars = found.counts.map((number, k) => {
    const low = found.low + ((found.high - found.low) * k) / found.counts.length;
    const height = number ? Math.max(0.7, (100 * number) / most) : 0;
    return element("svg:rect", { x: k * width, y: 100 - height, width: width * 0.9, height }, element("svg:title", {}, `from ${compact(low)}: ${count(number, "asset")}`));
  });
  $("distribution").replaceChildren(
    element("svg:svg", { viewBox: "0 0 100 100", preserveAspectRatio: "none", role: "img", "aria-label": `Distribution of ${query.column}` }, ...bars),
    element("div", { class: "ends" }, element("span", {}, compact(found.low)), element("span", {}, unit), element("span", {}, compact(found.high))));
}

// Assets that differ from the others in the state of the distribution; a click shows them alone.
function beside(found) {
  $("siblings").hidden = !found;
  if (!found) return;
  setText($("spread"), `Asset to asset ${withDeviation(found.mean, 2 * found.std, settings.units[query.column])}`);
  setText($("differ"), query.differs ? "Show all assets" : `${count(found.differ, "asset")} differ${found.differ === 1 ? "s" : ""}`);
  setAttribute($("differ"), "aria-pressed", String(query.differs));
  $("differ").disabled = !found.differ && !query.differs;
}

$("differ").addEventListener("click", () => choose({ differs: !query.differs }));

$("column").replaceChildren(...settings.columns.map((name) => element("option", { value: name }, name.replace(/_std$/, " σ").replaceAll("_", " "))));
$("column").addEventListener("change", () => {
  query.column = $("column").value;
  query.differs = false;
  ask(true);
});
$("find").addEventListener("input", () => choose({ find: $("find").value }));
let drawn = 0; // place at which the rows were asked for last
$("window").addEventListener("scroll", () => {
  const { first } = visible();
  if (Math.abs(first - drawn) < SPARE / 2 && first !== 0) return;
  drawn = first;
  ask(true);
});
addEventListener("resize", () => ask(true));
document.addEventListener("visibilitychange", () => ask(true));
keys([["/", "find an asset", () => $("find").focus()], ["", "worst health first", () => sort("health")]]);
ask(true);
window.nisus = { query, answer: () => answer };
