// One twin of the gallery: picture, question, what it teaches, and a button to start it, or why it cannot.

import { element, setAttribute, setText } from "./dom.js";
import { progress } from "./session.js";

const many = (count, word) => `${count.toLocaleString("en")} ${word}${count === 1 ? "" : "s"}`;

// The name of a twin without folder and ending, as its page and its links have it; and the card of that name that can
// be started, if there is one.
const brief = (name) => name.split(/[\\/]/).pop().replace(/\.ya?ml$/, "");
export const named = (items, short) => items.find((item) => brief(item.name) === short && !item.missing && !item.error);

// `item` is a card of /api/gallery; `act` has start(name) and open().
export function card(item, act) {
  const short = brief(item.name);
  const ready = !item.missing && !item.error;
  const button = element("button", { type: "button", class: "start", onclick: () => (button.dataset.runs === "true" ? act.open() : act.start(item.name)) }, "Start");
  const facts = item.error ? "" : [item.source, many(item.states, "state"), many(item.rows, "row"), item.estimator].join(" · ");
  const node = element(
    "li", { class: "card", dataset: { ready: String(ready), name: item.name, ...(item.log ? { log: "true" } : {}) } },
    picture(item),
    element("div", { class: "words" },
      item.question ? element("p", { class: "question" }, item.question) : null,
      element("h2", {}, ready ? element("button", { type: "button", class: "name", onclick: () => button.click() }, short) : short), element("p", { class: "title" }, item.title),
      item.teaches ? element("p", { class: "teaches" }, item.teaches) : null,
      reason(item),
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
  const answer = await fetch(`/api/gallery/picture?twin=${encodeURIComponent(name)}`).catch(() => null);
  if (!answer?.ok) return;
  const svg = new DOMParser().parseFromString(await answer.text(), "image/svg+xml").documentElement;
  if (svg.nodeName === "svg") place.replaceChildren(document.importNode(svg, true));
}
