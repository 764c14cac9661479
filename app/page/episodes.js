// What was and is wrong, newest first, each with its remedy; and what else happened.

import { element } from "./dom.js";
import { clock, words } from "./format.js";

const MOST = 200;

export class Episodes {
  constructor(node, link, view, charts) {
    Object.assign(this, { node, link, view, charts });
    this.notices = [];
    link.addEventListener("episodes", (event) => this.show(event.detail));
    link.addEventListener("notices", (event) => {
      // After a break all are told again.
      const known = this.notices[0]?.number ?? -1;
      const fresh = event.detail.filter((notice) => notice.number > known).reverse();
      this.notices = [...fresh, ...this.notices].slice(0, MOST);
      this.show(this.link.episodes);
    });
    this.show([]);
  }

  show(episodes) {
    const open = episodes.filter((episode) => episode.end === null).reverse();
    const over = episodes.filter((episode) => episode.end !== null).reverse();
    const list = (items, entry) => element("ol", {}, ...items.map(entry));
    this.node.replaceChildren(
      element("h3", {}, open.length ? `Now (${open.length})` : "Now: nothing is wrong"),
      list(open, (item) => this.entry(item)),
      over.length ? element("h3", {}, `Before (${over.length})`) : "",
      list(over.slice(0, MOST), (item) => this.entry(item)),
      element("h3", {}, "Events"),
      list(this.notices, (item) => this.event(item)),
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

  event(notice) {
    const when = notice.from === null ? "" : clock(notice.from);
    return element("li", { class: "event", dataset: { level: notice.level } }, element("time", {}, when), element("span", {}, notice.text));
  }
}
