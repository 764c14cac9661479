// State of the session: the running twin, a start under way, a start that failed. Polled while the page is visible.

import { $, element, setAttribute, setText, showText } from "./dom.js";
import { drops } from "./drops.js";
import { count } from "./format.js";
import { get, post } from "./http.js";

const REST = 700; // ms
const HASTE = 250; // while something is being started

export class Session extends EventTarget {
  constructor(boot) {
    super();
    this.boot = boot;
    this.state = null;
    this.woken = () => this.ask();
    document.addEventListener("visibilitychange", this.woken);
    this.ask();
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    document.removeEventListener("visibilitychange", this.woken);
  }

  async ask() {
    clearTimeout(this.timer);
    if (document.hidden || this.closed) return;
    const state = await get("api/session");
    if (!state.error && !this.closed) this.take(state);
    clearTimeout(this.timer);
    if (!this.closed) this.timer = setTimeout(() => this.ask(), this.state?.starting ? HASTE : REST);
  }

  take(state) {
    // Something else runs than when this page was opened: whoever looks goes there.
    if (state.boot !== this.boot) leave();
    this.state = state;
    this.dispatchEvent(new CustomEvent("state", { detail: state }));
  }

  // The answer to a question that changes the state; why not, if it was refused.
  async tell(asked) {
    const answer = await asked;
    if (!answer.error) this.take(answer);
    else this.dispatchEvent(new CustomEvent("state", { detail: { ...this.state, failed: { title: "Start", text: answer.error } } }));
    this.ask();
  }
}

// To what runs now; a link to a moment of it goes along.
function leave() {
  if (location.pathname === "/") location.reload();
  else location.replace(location.hash.includes("twin=") ? `/${location.hash}` : "/");
}

// How far what is being started has come.
export const progress = ({ doing, seconds }) => `${doing || "starting"} … ${Math.floor(seconds)} s`;

// One twin of the gallery: picture, question, lesson, and a button to start it, or the reason why it cannot.

// The name of a twin without folder and ending, as its page and its links have it; and the card of that name that can
// be started, if there is one.
const brief = (name) => name.split(/[\\/]/).pop().replace(/\.ya?ml$/, "");
const named = (items, short) => items.find((item) => brief(item.name) === short && !item.missing && !item.error);

// `item` is a card of /api/gallery; `act` has start(name), open() and, where recordings can be had, recording(item), which
// is an element for the card of a twin whose recording is missing.
export function card(item, act) {
  const short = brief(item.name);
  const ready = !item.missing && !item.error;
  const button = element("button", { type: "button", class: "start", onclick: () => (button.dataset.runs === "true" ? act.open() : act.start(item.name)) }, "Start");
  const facts = item.error ? "" : [item.source, count(item.states, "state"), count(item.rows, "row"), item.estimator].join(" · ");
  const node = element(
    "li", { class: "card", dataset: { ready: String(ready), name: item.name, ...(item.log ? { log: "true" } : {}) } },
    picture(item),
    element("div", { class: "words" },
      item.question ? element("p", { class: "question" }, item.question) : null,
      element("h2", {}, ready ? element("button", { type: "button", class: "name", onclick: () => button.click() }, short) : short), element("p", { class: "title" }, item.title),
      item.teaches ? element("p", { class: "teaches" }, item.teaches) : null,
      reason(item), item.missing ? act.recording?.(item) : null,
    ),
    element("footer", {}, element("span", { class: "facts" }, facts), ready ? button : null),
  );
  const sync = ({ running, starting }) => {
    const runs = Boolean(running) && running.name === item.name;
    const begins = Boolean(starting) && starting.name === item.name;
    setAttribute(node, "data-runs", runs ? "true" : null);
    button.dataset.runs = String(runs);
    button.disabled = Boolean(starting);
    setText(button, runs ? "Back to it" : begins ? progress(starting) : "Start");
    setAttribute(button, "aria-label", `${runs ? "Back to" : "Start"} ${short}`);
  };
  const words = [item.name, item.title, item.question, item.teaches, facts].join(" ").toLowerCase();
  return { node, sync, ready, words, name: item.name, short, title: item.title, log: item.log };
}

// The reason, and on demand the place and the remedy, which take some lines.
function reason(item) {
  if (item.error) return element("p", { class: "error" }, item.error);
  if (!item.missing) return null;
  const [what, ...remedy] = item.missing.replace(/^\S+?:\d+: \S+ /, "").split("; ");
  return element(
    "details", { class: "missing" },
    element("summary", {}, "Its recording is not here: how to get it"),
    element("p", {}, `It ${what}.`), ...remedy.map((line) => element("p", {}, `${line[0].toUpperCase()}${line.slice(1)}.`)),
  );
}

function picture(item) {
  const place = element("div", { class: "picture", "aria-hidden": "true" });
  if (item.picture) draw(place, item.name);
  else place.append(element("span", { class: "faint" }, "no picture yet"));
  return place;
}

// Into the page itself, so that it has the colours of the theme.
async function draw(place, name) {
  // A page that is being left gets none.
  const answer = await fetch(`api/gallery/picture?twin=${encodeURIComponent(name)}`).catch(() => null);
  if (!answer?.ok) return;
  const svg = new DOMParser().parseFromString(await answer.text(), "image/svg+xml").documentElement;
  if (svg.nodeName === "svg") place.replaceChildren(document.importNode(svg, true));
}

// From a twin's page to what else there is: the gallery, the recordings, and files that are dropped here.

const READ = 8000; // ms that a line stays

export class Leave {
  constructor(model, boot) {
    for (const id of ["gallery", "others"]) setAttribute($(id), "href", "gallery");
    this.boot = boot;
    this.model = model;
    drops({ say: (text, wrong) => this.say(text, wrong), follow: () => this.follow() });
    const go = (where) => location.assign(where);
    this.commands = [
      ["g", "gallery: another twin", () => go("gallery")],
      ["", "recordings: open, download, delete", () => go("gallery#recordings")],
    ];
  }

  // A link of another twin was opened: what runs goes on, unless that is started. The address stays, and with it the
  // moment to which the other twin's page goes.
  async offer(twin, reason) {
    const all = await get("api/gallery");
    const item = !all.error && named(all, twin);
    if (!item) return this.say(`${reason}. No twin of that name can be started here`, true);
    const start = async () => {
      const answer = await post("api/gallery/start", { twin: item.name });
      if (answer.error) this.say(answer.error, true);
      else this.follow();
    };
    this.say(`${reason}. `);
    $("toast").append(
      element("button", { type: "button", class: "go", onclick: start }, `Start ${twin}`),
      element("button", { type: "button", class: "go", onclick: () => (history.replaceState(null, "", location.pathname), this.say("")) }, `Stay with ${this.model.twin}`),
    );
  }

  // What becomes of a file that was dropped: while another twin is being started this page goes on.
  say(text, wrong = false) {
    showText($("toast"), text);
    $("toast").dataset.wrong = String(wrong);
    clearTimeout(this.timer);
    if (wrong) this.timer = setTimeout(() => this.say(""), READ);
  }

  follow() {
    this.session?.close();
    this.session = new Session(this.boot);
    this.session.addEventListener("state", ({ detail: { starting, failed } }) => {
      showText($("toast"), starting && `${starting.title}: ${progress(starting)}`);
      if (starting) return;
      this.session.close();
      this.session = null;
      if (failed) this.say(`${failed.title} did not start. ${failed.text}`, true);
    });
  }
}
