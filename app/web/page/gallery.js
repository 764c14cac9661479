// The gallery: every twin with its picture, lesson and question; beside them the recordings.

import { keys } from "./controls.js";
import { $, element, setText } from "./dom.js";
import { drops, Recordings } from "./recordings.js";
import { card, post, progress, Session } from "./session.js";

const settings = JSON.parse(document.body.dataset.settings);
const session = new Session(settings.boot);

$("theme").addEventListener("click", () => {
  const root = document.documentElement;
  root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
  localStorage.setItem("nisus.theme", root.dataset.theme);
});

let shown = [];
// A link to a moment of a twin that does not run: the address keeps it for the twin's page.
const linked = new URLSearchParams(location.hash.slice(1)).get("twin");
let told = ""; // what was wrong with a file, until something else is done
const open = () => location.assign(linked ? `/${location.hash}` : "/");
const start = (name) => {
  told = "";
  session.tell(post("/api/gallery/start", { twin: name }));
};
const stop = () => session.tell(post("/api/gallery/stop", {}));

function say(text, wrong = false) {
  told = wrong ? text : "";
  setText($("sending"), wrong ? "" : text);
  if (session.state) draw(session.state);
}
const files = drops({ twins: () => shown.filter((item) => item.log), say, follow: () => session.ask() });
const recordings = new Recordings($("recordings"), { open: files.open, drop: files.take, say: (text) => say(text, true) });

function draw(state) {
  for (const item of shown) item.sync(state);
  const { running, starting, failed } = state;
  const now = [];
  if (starting) now.push(element("span", { class: "pill", dataset: { health: "suspect" } }, `${starting.title}: ${progress(starting)}`));
  if (running)
    now.push(
      element("span", { class: "pill", dataset: { health: "tracking" } }, `● ${running.title} ${running.review ? "is open" : "runs"}`),
      element("button", { type: "button", class: "go", onclick: open }, "Back to it"),
      element("button", { type: "button", class: "go", onclick: stop }, running.review ? "Close" : "Stop"),
    );
  const key = JSON.stringify([running, starting]);
  if ($("now").dataset.key !== key) {
    $("now").dataset.key = key;
    $("now").replaceChildren(...now);
  }
  const wrong = told || (failed ? `${failed.title} did not start. ${failed.text}` : "");
  $("failed").hidden = !wrong;
  setText($("failed"), wrong);
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

const commands = [
  ["/", "find a twin", () => $("find").focus()],
  ["a", "add a file to the recordings", () => recordings.choose.click()],
  ["g", "back to the twin that runs", () => session.state?.running && open()],
];
keys(commands);

const answer = await fetch("/api/gallery");
if (!answer.ok) {
  setText($("none"), "The twins could not be listed; reload the page.");
  throw new Error(await answer.text());
}
shown = (await answer.json()).map((item) => card(item, { start, open }));
$("cards").replaceChildren(...shown.map((item) => item.node));
commands.push(...shown.filter((item) => item.ready).map((item) => ["", `start ${item.short}`, () => start(item.name)]));
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
window.nisus = { session, cards: shown.length };
