// Saving a chart as a picture, the track as a table, a report, or a link: one menu, beside the button that was pressed.

import { heading } from "./chart.js";
import { element } from "./dom.js";
import { clock, words } from "./format.js";
import { plotSvg, pngOf } from "./svg.js";
import { link as momentLink } from "./view.js";

// Why there is nothing to save of a run.
export const gone = (number) => `the track of run ${number} is gone: load it, and it is folded again`;

const CENTURY = 1e18; // ns since 1970 from which on a time has a date

export class Save {
  constructor(model, link, view, charts) {
    Object.assign(this, { model, link, view, charts });
    this.menu = element("div", { id: "save-menu", popover: "auto", role: "menu", "aria-label": "Save" });
    this.menu.addEventListener("keydown", (event) => this.keyed(event));
    document.body.append(this.menu);
  }

  // items: [text, title, run, reason]; with a reason it is disabled and shows it
  open(button, items) {
    this.menu.replaceChildren(
      ...items.map(([text, title, run, reason]) =>
        element("button", { type: "button", role: "menuitem", title: reason || title, "aria-disabled": reason ? "true" : null, onclick: () => reason || (this.menu.hidePopover(), button.focus(), run()) }, text, reason ? element("small", {}, reason) : null)),
    );
    this.menu.showPopover();
    const [box, own] = [button.getBoundingClientRect(), this.menu.getBoundingClientRect()];
    this.menu.style.left = `${Math.max(4, Math.min(innerWidth - own.width - 4, box.right - own.width))}px`;
    this.menu.style.top = `${box.bottom + own.height + 4 < innerHeight ? box.bottom + 2 : box.top - own.height - 2}px`;
    this.menu.firstChild.focus();
  }

  keyed(event) {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (!step) return;
    event.preventDefault();
    event.stopPropagation();
    const items = [...this.menu.children];
    items[(items.indexOf(document.activeElement) + step + items.length) % items.length].focus();
  }

  chart(chart, button) {
    const { what } = chart;
    const draw = () => chart.svg([`${this.model.twin}: ${heading(what)}`, this.about(chart.span, what.note)]);
    this.offer(button, draw, (what.key ?? what.title).replace(/^state:/, ""));
  }

  xy(xy, button) {
    const [across, up] = xy.pair;
    this.offer(button, () => xy.svg([`${this.model.twin}: ${words(up)} over ${words(across)}`, this.about(this.charts.range)]), `${up}-over-${across}`);
  }

  // A plot of Diagnose, over the last `events` of a run.
  plot(node, button, events) {
    const label = node.getAttribute("aria-label");
    const title = this.model.estimators.find((entry) => entry.name === this.link.status.estimator)?.title;
    const about = `${title}, run ${this.link.status.revision}, the last ${events.toLocaleString("en")} events until ${clock(this.charts.newest, 1)}`;
    const text = plotSvg(node, [`${this.model.twin}: ${label}`, about]);
    this.offer(button, () => text, label);
  }

  // A chart as a picture or a drawing; draw() gives the text of the SVG.
  offer(button, draw, name) {
    const save = (kind, title) => [kind.toUpperCase(), title, () => this.picture(draw(), name, kind)];
    this.open(button, [save("png", "Picture of this chart"), save("svg", "Drawing of this chart")]);
  }

  run(button) {
    const number = this.link.status.revision;
    const fetched = (address) => this.fetched(number, address);
    const [since, until] = this.charts.range.map((time) => Number(time.toFixed(6)));
    const whole = (kind) => `api/track.${kind}?run=${number}`;
    const part = (kind) => `${whole(kind)}&since=${since}&until=${until}`;
    const reason = this.link.status.t === null ? "no measurement has arrived yet" : null;
    this.open(button, [
      ["Track, shown part: CSV", "One line per event", () => fetched(part("csv")), reason],
      ["Track, shown part: Parquet", "One row per event, with types", () => fetched(part("parquet")), reason],
      ["Track, all: CSV", "One line per event", () => fetched(whole("csv")), reason],
      ["Track, all: Parquet", "One row per event, with types", () => fetched(whole("parquet")), reason],
      ["Report: HTML", "Scores, charts, episodes and tuning in one file", () => fetched(`api/report.html?run=${number}`), reason],
      ["Copy a link to this moment (L)", "For browsers of this session: time, span and charts", () => this.copyLink()],
    ]);
  }

  // A run may have given way since the menu was opened, and its track be gone: then that is said.
  fetched(number, address) {
    const { runs } = this.link.status;
    if (runs.kept.includes(number)) element("a", { href: address, download: "" }).click();
    else this.said?.(`${gone(number)}; nothing is saved`);
  }

  // The time of the newest row that is shown, ns.
  get instant() {
    return Number(this.link.status.origin ?? 0) + Math.min(this.charts.range[1], this.charts.newest) * 1e9;
  }

  async picture(svg, name, kind) {
    const blob = kind === "svg" ? new Blob([svg], { type: "image/svg+xml" }) : await pngOf(svg);
    download(blob, `${this.model.twin}-${name.replace(/[^\p{L}\p{N}]+/gu, "_")}-${this.stamp()}.${kind}`);
  }

  // What filter, which run, of when.
  about([since, until], note) {
    const { status } = this.link;
    const title = this.model.estimators.find((entry) => entry.name === status.estimator)?.title ?? status.estimator;
    const origin = Number(status.origin ?? 0);
    const date = origin > CENTURY ? `, 0:00 is ${new Date(origin / 1e6).toISOString().replace("T", " ").slice(0, 19)} UTC` : "";
    return `${title}, run ${status.revision}, ${clock(since, 1)} to ${clock(until, 1)}${date}${note ? `; ${note}` : ""}`;
  }

  stamp() {
    return this.instant > CENTURY ? new Date(this.instant / 1e6).toISOString().replace(/[-:]/g, "").slice(0, 15) : `${Math.round(this.instant / 1e9)}s`;
  }

  async copyLink() {
    const url = momentLink(this);
    // In the address too, for where a page may not write to the clipboard.
    history.replaceState(null, "", url);
    await navigator.clipboard?.writeText(url).catch(() => {});
    this.said?.("Link copied");
  }
}

function download(blob, name) {
  const url = URL.createObjectURL(blob);
  element("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
