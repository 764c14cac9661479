// The gallery: every twin with its picture, lesson and question; beside them the recordings. Of a log (#log=NAME) its
// signals instead.

import { keys, themeButton } from "./controls.js";
import { $, changed, element, keyed, setAttribute, setText, showText } from "./dom.js";
import { Downloads } from "./downloads.js";
import { LogView } from "./dropped_log.js";
import { drops } from "./drops.js";
import { compact, count, size, spaced, span } from "./format.js";
import { get, post } from "./http.js";
import { card, progress, Session } from "./session.js";

const SUMMARY_POLL_MS = 1500; // while a file is being summarised
const POLL_MS = 5000;

// The list of recordings and logs: open, download, delete after a confirmation. `ask` has open(file), drop(files) and
// say(text), which reports an error.
class Recordings {
  constructor(node, ask) {
    Object.assign(this, { node, ask });
    this.list = element("ol", { class: "files" });
    this.where = element("p", { class: "faint where" });
    this.choose = element("input", { type: "file", multiple: true, hidden: true, onchange: () => this.ask.drop([...this.choose.files]) });
    this.node.replaceChildren(
      element("header", { class: "panel-head" }, element("h2", {}, "Recordings"), element("span", { class: "space" }),
        element("button", { type: "button", class: "go", onclick: () => this.choose.click(), title: "Add a recording (.rrd), a log or a DBC; or drop it on the page" }, "Add a file"), this.choose),
      this.list, this.where,
    );
    document.addEventListener("visibilitychange", () => this.refresh());
    this.refresh();
  }

  async refresh() {
    clearTimeout(this.timer);
    if (document.hidden) return;
    const found = await get("api/gallery/recordings");
    if (!found.error) this.draw(found);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.refresh(), this.looking ? SUMMARY_POLL_MS : POLL_MS);
  }

  draw({ folder, files }) {
    this.looking = files.some((file) => file.looking);
    if (!changed(this.list, files)) return;
    setText(this.where, `Kept in ${folder}. Record one on a twin's page (R), or drop a recording, a log (CSV, Excel, Parquet, MF4, TDMS, BLF, ASC, candump, MAT, NPZ, MCAP, or a ZIP of these) or a DBC here.`);
    // What is asked of one file stays asked while the list is drawn anew.
    const asked = this.list.querySelector("[data-asked]")?.dataset.name;
    this.list.replaceChildren(...files.map((file) => this.item(file)));
    if (asked) [...this.list.children].find((item) => item.dataset.name === asked)?.querySelector(".delete")?.click();
    if (!files.length) this.list.replaceChildren(element("li", { class: "nothing" }, "None yet."));
  }

  item(file) {
    const { summary } = file;
    const error = summary?.error;
    const facts = [
      file.folder ? `in ${file.folder}` : null, file.twin, file.seconds ? span(file.seconds) : null, summary?.estimator ?? file.estimator, size(file.bytes),
    ].filter(Boolean).join(" · ");
    const ratio = (value) => compact(value / (summary.nis_dof ?? 1), 3);
    const scores = [
      summary?.nis ? `NIS / dof ${ratio(summary.nis)} [${ratio(summary.nis_low)}, ${ratio(summary.nis_high)}]` : null,
      error ? `RMSE ${error.name} ${compact(error.rmse, 3)}${spaced(error.unit)}${error.against === "truth" ? "" : `, ${error.against}`}${typeof error.coverage === "number" ? `, ${compact(100 * error.coverage, 3)} % in band` : ""}` : null,
    ].filter(Boolean).join(" · ");
    const confirm = element("div", { class: "confirm", hidden: true });
    const node = element(
      "li", { class: "file", dataset: { name: file.name } },
      element("div", { class: "row" },
        element("button", { type: "button", class: "name", title: file.database ? `${file.name} describes CAN logs` : file.log ? `Signals of ${file.name}, and twins for it` : `Review ${file.name}`, disabled: file.database, onclick: () => this.ask.open(file) }, file.name),
        element("a", { href: `recordings/${encodeURIComponent(file.name)}`, download: file.name, title: "Download", "aria-label": `Download ${file.name}` }, "↓"),
        element("button", { type: "button", class: "delete", title: "Delete", "aria-label": `Delete ${file.name}`, onclick: () => this.confirm(node, confirm, file.name) }, "✕")),
      element("p", { class: "faint" }, `${when(file.modified)} · ${file.log ? "log · " : file.database ? "DBC · " : ""}${file.looking ? "looking …" : facts}`),
      scores ? element("p", { class: "faint", title: summary.nis_words }, scores) : null,
      file.error ? element("p", { class: "faint" }, file.error) : null,
      confirm,
    );
    return node;
  }

  confirm(node, place, name) {
    node.dataset.asked = "true";
    const back = () => {
      place.hidden = true;
      delete node.dataset.asked;
      node.querySelector(".delete").focus();
    };
    const remove = async () => {
      const answer = await post("api/gallery/recordings/delete", { name });
      delete node.dataset.asked;
      if (answer.error) this.ask.say(answer.error);
      changed(this.list, null); // without what is asked there
      this.refresh();
    };
    const yes = element("button", { type: "button", class: "go danger", onclick: remove }, "Delete for good");
    place.replaceChildren(yes, element("button", { type: "button", class: "go", onclick: back }, "Keep"));
    place.hidden = false;
    yes.focus();
  }
}

function when(seconds) {
  const date = new Date(1000 * seconds);
  const today = date.toDateString() === new Date().toDateString();
  const time = date.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" });
  return today ? `today ${time}` : `${date.toLocaleDateString("en-GB", { day: "numeric", month: "short", year: "numeric" })} ${time}`;
}

const settings = JSON.parse(document.body.dataset.settings);
const session = new Session(settings.boot);

themeButton();

let shown = [];
// A link to a moment of a twin that does not run: the address keeps it for the twin's page.
const linked = new URLSearchParams(location.hash.slice(1)).get("twin");
let told = ""; // what was wrong with a file, until something else is done
const open = () => location.assign(linked ? `/${location.hash}` : "/");
const start = (name) => {
  told = "";
  session.tell(post("api/gallery/start", { twin: name }));
};
const stop = () => session.tell(post("api/gallery/stop", {}));

function say(text, wrong = false) {
  told = wrong ? text : "";
  setText($("sending"), wrong ? "" : text);
  if (session.state) draw(session.state);
}
const showLog = (name) => {
  if (location.hash === `#log=${encodeURIComponent(name)}`) view.open(name);
  else location.hash = `log=${encodeURIComponent(name)}`;
};
// The twins of a service: each card has its health, the worst first, and buttons for its process alone.
function serve(twins) {
  const found = Object.fromEntries(shown.map((item) => [item.name, item]));
  if (twins.some(({ name }) => !found[name]) || shown.length !== twins.length) return list(); // of a folder that changed
  keyed($("cards"), twins, ({ name }) => name, ({ name }) => found[name].node).forEach((node, k) => {
    const twin = twins[k];
    const runs = twin.state === "running";
    const health = runs ? twin.health ?? "waiting" : twin.state === "failed" ? "diverged" : "waiting";
    const again = twin.again_in === null ? "" : `; again in ${Math.ceil(twin.again_in)} s`;
    const cause = runs ? twin.unread || twin.cause || (twin.episodes ? `${twin.episodes} open episodes` : "") : `${twin.text}${again}`;
    const facts = runs ? [count(twin.measurements ?? 0, "measurement"), twin.age === null || twin.age === undefined ? null : `last ${span(twin.age)} ago`, twin.memory ? size(twin.memory) : null, twin.starts > 1 ? `${twin.starts} starts` : null].filter(Boolean).join(" · ") : "";
    let served = node.querySelector(".served");
    if (!served) {
      served = element("div", { class: "served" }, element("p", {}, element("span", { class: "pill" }), element("span", {})), element("p", { class: "faint" }));
      node.querySelector("footer").before(served);
      node.querySelector(".picture").hidden = !node.querySelector(".picture svg");
      node.querySelector("h2 .name").onclick = () => node.querySelector("footer a")?.click();
    }
    for (const part of [node, served.querySelector(".pill")]) setAttribute(part, "data-health", health);
    setText(served.querySelector(".pill"), !runs ? twin.state : health === "stale" && twin.age ? `stale for ${span(twin.age)}` : health);
    setText(served.querySelector(".pill + span"), cause ? ` ${cause}` : "");
    setText(served.lastElementChild, facts);
    // Buttons stay as long as they are the same, so that they keep the focus.
    if (node.dataset.state === twin.state) return;
    node.dataset.state = twin.state;
    node.dataset.runs = String(runs);
    const act = (what) => () => post(`api/gallery/${what}`, { twin: twin.name }).then((answer) => (answer.error ? say(answer.error, true) : session.ask()));
    const buttons = twin.state === "stopped" ? [["Start", act("start")]] : [["Restart", act("restart")], ["Stop", act("stop")]];
    node.querySelector("footer").replaceChildren(
      runs ? element("a", { class: "start", href: `twins/${encodeURIComponent(twin.name)}/` }, "Open") : "",
      ...buttons.map(([text, onclick]) => element("button", { type: "button", class: "go", "aria-label": `${text} ${twin.name}`, onclick }, text)));
  });
}

const files = settings.service ? null : drops({ say, follow: () => session.ask(), show: showLog, described: (names) => view.describe(names) });
const view = new LogView($("log"), {
  drop: files?.take,
  run: (name, twin) => files.open(name, twin),
  follow: () => session.ask(),
});
if (settings.service) $("recordings").remove();
const recordings = settings.service ? null : new Recordings($("recordings"), { open: (file) => files.open(file.name), drop: files.take, say: (text) => say(text, true) });

const title = $("place").textContent;
function route() {
  const name = new URLSearchParams(location.hash.slice(1)).get("log");
  document.body.dataset.view = name ? "log" : "shelf";
  $("log").hidden = !name;
  $("find").hidden = Boolean(name);
  setText($("place"), name ? "Log" : title);
  document.title = `${name ?? title} · Nisus`;
  if (name) view.open(name);
  else view.close();
}
addEventListener("hashchange", route);

function draw(state) {
  if (state.twins) serve(state.twins);
  else for (const item of shown) item.sync(state);
  const { running, starting, failed } = state;
  const pill = (text, health) => [text, () => element("span", { class: "pill", dataset: { health } }, text)];
  const button = (text, onclick) => [text, () => element("button", { type: "button", class: "go", onclick }, text)];
  const now = [
    ...(starting ? [pill(`${starting.title}: ${progress(starting)}`, "suspect")] : []),
    ...(running ? [pill(`● ${running.title} ${running.review ? "is open" : "runs"}`, "tracking"), button("Back to it", open), button(running.review ? "Close" : "Stop", stop)] : []),
  ];
  keyed($("now"), now, ([text]) => text, ([, make]) => make());
  showText($("failed"), told || (failed ? `${failed.title} did not start. ${failed.text}` : ""));
}
session.addEventListener("state", (event) => draw(event.detail));

const find = () => {
  const wanted = $("find").value.toLowerCase().split(/\s+/);
  let left = 0;
  for (const item of shown) {
    item.node.hidden = !wanted.every((word) => item.words.includes(word));
    left += !item.node.hidden;
  }
  $("none").hidden = left > 0;
};
$("find").addEventListener("input", find);

const commands = [["/", "find a twin", () => $("find").focus()]];
if (recordings) commands.push(["a", "add a file to the recordings", () => recordings.choose.click()], ["g", "back to the twin that runs", () => session.state?.running && open()]);
keys(commands);

async function list() {
  const twins = await get("api/gallery");
  if (twins.error) {
    setText($("none"), "The twins could not be listed; reload the page.");
    throw new Error(twins.error);
  }
  await downloads?.ask();
  shown = twins.map((item) => card(item, { start, open, recording: downloads?.offer }));
  $("cards").replaceChildren(...shown.map((item) => item.node));
}
// Of a recording that has arrived: its cards can be started, the one first from which it was asked for.
async function arrived(name) {
  await list();
  if (session.state) draw(session.state);
  find();
  shown.find((item) => item.name === name)?.node.querySelector(".start").focus();
}
const downloads = settings.service ? null : new Downloads(arrived);
await list();
if (!settings.service) commands.push(...shown.filter((item) => item.ready).map((item) => ["", `start ${item.short}`, () => start(item.name)]));
if (session.state) draw(session.state);
setText($("none"), "No twin of that name, question or kind.");
find();
const asked = shown.find((item) => item.short === linked && item.ready);
if (asked) {
  say(`The link is of ${linked}: start it to go there`);
  asked.node.scrollIntoView({ block: "center" });
  asked.node.querySelector(".start").focus();
} else if (linked) say(`The link is of ${linked}; there is no such twin here that can be started`, true);
if (location.hash === "#recordings") $("recordings").querySelector("button").focus();
route();
window.nisus = { session, cards: shown.length, view };
