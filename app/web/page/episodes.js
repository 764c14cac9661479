// What was and is wrong, newest first, each with its remedy; and what else happened.

import { element } from "./dom.js";
import { clock, compact, words } from "./format.js";

const MOST = 200;

// What can become of a reading, by the key of its count; those of which there are none are not shown.
const KINDS = [
  ["used", "used"], ["gated", "refused by the gate"], ["held out", "held out"], ["screened", "screened at the edge"], ["missing", "empty"],
  ["failed", "failed"], ["stale", "dropped: too late"], ["wrong time", "dropped: wrong time"], ["inflated", "late, with R inflated"], ["held", "waiting for their time to be believed"], ["silenced", "lost by a fault on demand"],
];

const grouped = (n) => n.toLocaleString("en");

export class Episodes {
  constructor(node, link, view, charts) {
    Object.assign(this, { node, link, view, charts });
    this.notices = [];
    this.held = []; // what sensors show that are held out, in words
    this.counts = element("dl", { class: "counts", "aria-label": "What became of the readings" });
    link.addEventListener("episodes", (event) => this.show(event.detail));
    link.addEventListener("notices", (event) => {
      // After a break all are told again.
      const known = this.notices[0]?.number ?? -1;
      const fresh = event.detail.filter((notice) => notice.number > known).reverse();
      this.notices = [...fresh, ...this.notices].slice(0, MOST);
      this.show(this.link.episodes);
    });
    link.addEventListener("status", ({ detail }) => {
      this.count(detail);
      this.holds(detail.sensors);
    });
    this.show([]);
  }

  // What became of the readings; the sensors' own counts when pointed at.
  count({ counts }) {
    const found = KINDS.filter(([key]) => counts[key]).map(([key, name]) => [key, name, counts[key]]);
    const text = JSON.stringify([found, counts.readings]);
    if (text === this.counted) return;
    this.counted = text;
    const whose = (key) => Object.entries(counts).filter(([name]) => name.startsWith(`${key} `)).map(([name, n]) => `${words(name.slice(key.length + 1))} ${n}`).join("\n");
    this.counts.replaceChildren(
      element("dt", {}, "readings"), element("dd", {}, grouped(counts.readings ?? 0)),
      ...found.flatMap(([key, name, n]) => [element("dt", { title: whose(key) }, name), element("dd", { title: whose(key) }, `${grouped(n)}${key === "used" || !counts.readings ? "" : ` (${compact((100 * n) / counts.readings, 2)} %)`}`)]),
    );
  }

  // Nothing of a sensor that is held out is tested; what it reads is shown all the same.
  holds(sensors) {
    const held = Object.values(sensors).filter(({ state, text }) => state === "held out" && text).map(({ text }) => text);
    if (held.join() === this.held.join()) return;
    this.held = held;
    this.show(this.link.episodes);
  }

  show(episodes) {
    const open = episodes.filter((episode) => episode.end === null).reverse();
    const over = episodes.filter((episode) => episode.end !== null).reverse();
    const list = (items, entry) => element("ol", {}, ...items.map(entry));
    this.node.replaceChildren(
      this.counts,
      element("h3", {}, open.length ? `Now (${open.length})` : `Now: nothing is wrong${this.held.length ? " with the sensors in use" : ""}`),
      list(open, (item) => this.entry(item)),
      this.held.length ? element("h3", {}, "Held out") : "",
      list(this.held, (text) => element("li", { class: "event held-out" }, element("span", {}, text))),
      over.length ? element("h3", {}, `Before (${over.length})`) : "",
      list(over.slice(0, MOST), (item) => this.entry(item)),
      element("h3", {}, "Events"),
      element("ol", {}, ...this.notices.flatMap((item, k) => this.event(item, this.notices[k - 1]))),
    );
  }

  entry(episode) {
    const times = `${clock(episode.from)} – ${episode.to === null ? "now" : clock(episode.to)}`;
    const show = () => {
      const [since, until] = this.charts.range;
      const length = Math.max(until - since, 1.5 * ((episode.to ?? until) - episode.from));
      this.view.show(episode.from - 0.2 * length, episode.from + 0.8 * length);
    };
    return element(
      "li", { class: "episode", dataset: { open: String(episode.end === null), severity: episode.severity ?? "" } },
      element("button", { type: "button", title: "Show it in the charts", onclick: show }, element("time", {}, times), element("b", {}, `${words(episode.subject)}: ${episode.cause}`)),
      element("p", {}, episode.text),
      element("a", { href: `/alarms#${episode.help.split("#")[1]}`, target: "_blank" }, `more on ${episode.cause}`),
    );
  }

  // The last told first. Another run folds the same time again, which a line between them says.
  event(notice, after) {
    const when = notice.from === null ? "" : clock(notice.from);
    const line = element("li", { class: "event", dataset: { level: notice.level } }, element("time", {}, when), element("span", {}, notice.text));
    return after && after.run !== notice.run ? [element("li", { class: "run-before" }, `run ${notice.run}`), line] : [line];
  }
}
