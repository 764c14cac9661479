// Files dropped on the page: sent in pieces to the folder of recordings, then opened. A recording opens for review; a log
// opens with its signals, the twins that fit, and a draft of a twin.

import { changed, element, setText, table } from "./dom.js";
import { clock, compact, count, span, spaced } from "./format.js";
import { get, post } from "./http.js";
import { nearest } from "./ranges.js";

const RECORDING = ".rrd";
const DATABASE = ".dbc";
const POLL_MS = 300;
const OPEN_GROUP_ROWS = 40; // a longer group starts closed
const PAGE_ROWS = 100; // rows of a group that are added at once
const CURVE_BATCH = 40;
const GAP_INTERVALS = 6; // median intervals beyond which a curve is broken

const address = (name) => `gallery#log=${encodeURIComponent(name)}`;
const ending = (name) => name.slice(name.lastIndexOf(".")).toLowerCase();

// `say` reports progress and errors, `follow` the progress of opening, `show` opens a log where it was dropped.
export function drops({ say, follow, show = (name) => location.assign(address(name)), described = () => false }) {
  const over = element("div", { class: "drop-here", hidden: true }, element("p", {}, "Drop to open: a recording for review, a log with its signals, a DBC for CAN logs"));
  document.body.append(over);
  let depth = 0;
  const files = (event) => event.dataTransfer?.types.includes("Files");
  const cover = (change) => {
    depth = Math.max(0, depth + change);
    over.hidden = depth === 0;
  };
  addEventListener("dragenter", (event) => files(event) && (event.preventDefault(), cover(1)));
  addEventListener("dragleave", (event) => files(event) && cover(-1));
  addEventListener("dragover", (event) => files(event) && event.preventDefault());
  addEventListener("drop", (event) => {
    if (!files(event)) return;
    event.preventDefault();
    depth = 0;
    cover(0);
    const on = event.target.closest?.("[data-log]")?.dataset.name;
    take([...event.dataTransfer.files], on);
  });

  // Keep all of them, then open the first recording or log; DBC files go first, so that a log is read with them.
  async function take(given, twin) {
    const kept = [];
    for (const file of given.toSorted((a, b) => (ending(b.name) === DATABASE) - (ending(a.name) === DATABASE))) {
      say(`${file.name}: sending`);
      const answer = await send(file, (share) => say(`${file.name}: ${Math.round(100 * share)} %`));
      if (answer.error) return say(answer.error, true);
      kept.push(answer.name);
    }
    say("");
    const first = kept.find((name) => ending(name) !== DATABASE);
    if (first) open(first, twin);
    else if (kept.length && !described(kept)) say(`${kept.join(", ")} is kept: CAN logs that have its ids are read with it`);
  }

  async function open(name, twin) {
    if (ending(name) !== RECORDING && !twin) return show(name);
    const answer = await post("api/gallery/recordings/open", twin ? { name, twin } : { name });
    say(answer.error ?? "", Boolean(answer.error));
    if (!answer.error) follow();
  }
  return { take, open };
}

async function send(file, tell) {
  const { piece } = await get("api/gallery/recordings");
  for (let offset = 0; ; offset += piece) {
    const last = offset + piece >= file.size;
    const query = new URLSearchParams({ name: file.name, offset, ...(last ? { last: 1 } : {}) });
    let answer;
    try {
      const sent = await fetch(`api/gallery/recordings/drop?${query}`, {
        method: "POST", headers: { "Content-Type": "application/octet-stream" }, body: file.slice(offset, offset + piece),
      });
      answer = await sent.json();
    } catch {
      answer = { error: `${file.name}: it could not be sent; check that Nisus runs, and drop it again` };
    }
    if (answer.error || last) return answer;
    tell(Math.min(1, (offset + piece) / file.size));
  }
}

const ROLES = [
  ["state", "State", "measured, with a state of its own"],
  ["sensor", "Sensor", "another measurement of a state"],
  ["input", "Input", "known quantity that drives the states"],
  ["held out", "Held out", "predicted and scored, never used"],
  ["", "Ignore", "not in the twin"],
];

const rate = (value) => (value === null ? "" : value >= 0.1 ? `${compact(value, 3)} Hz` : `every ${span(1 / value)}`);

// The view of one log. `ask` has run(log, twin), which starts a twin on it, drop(files), and follow(), which reports how a
// twin starts.
export class LogView {
  constructor(node, ask) {
    Object.assign(this, { node, ask, name: null, rows: new Map() });
    this.seen = new IntersectionObserver((entries) => this.visible(entries), { root: null, rootMargin: "200px" });
  }

  get request() {
    const { name, dbc, time, unit, zone } = this;
    return { name, ...(dbc ? { dbc } : {}), ...(time ? { time, unit, zone } : {}) };
  }

  open(name) {
    if (name === this.name) return;
    Object.assign(this, { name, dbc: null, time: null, unit: "s", zone: null, log: null, roles: new Map(), proposed: null, drafts: false });
    changed(this.node, null);
    this.node.replaceChildren(element("p", { class: "faint reading", role: "status" }, `${name}: reading …`));
    this.read();
  }

  close() {
    clearTimeout(this.timer);
    this.name = null;
    this.seen.disconnect();
    this.node.replaceChildren();
  }

  // DBC files were dropped: the log is read again if it is a CAN log.
  describe(files) {
    if (this.log?.kind !== "can_log") return false;
    this.read({ dbc: [...new Set([...(this.log.databases ?? []).filter((one) => one.used).map((one) => one.name), ...files])] });
    return true;
  }

  read(change = {}) {
    Object.assign(this, change, { roles: new Map(), proposed: null });
    clearTimeout(this.timer);
    this.poll();
  }

  async poll() {
    const request = JSON.stringify(this.request);
    const answer = await post("api/gallery/log", this.request);
    if (request !== JSON.stringify(this.request)) return; // something else was asked meanwhile
    if (answer.state === "reading") {
      const note = this.node.querySelector(".reading") ?? element("p", { class: "faint reading", role: "status" });
      setText(note, `${this.name}: reading … ${Math.floor(answer.seconds)} s`);
      if (!note.isConnected) this.node.prepend(note);
    } else this.draw(answer.error ? { ...answer, name: this.name } : answer);
    if (answer.state === "reading" || answer.proposing) this.timer = setTimeout(() => this.poll(), POLL_MS);
  }

  draw(log) {
    this.log = log;
    if (changed(this.node, { ...log, roles: null, proposing: null, unproposed: null, draft_name: null })) {
      this.seen.disconnect();
      this.rows.clear();
      this.node.replaceChildren(this.head(log), ...(log.error ? [this.failure(log)] : [this.body(log)]));
    }
    this.propose();
  }

  head(log) {
    const facts = log.error ? "" : [
      log.kind === "can_log" ? `CAN log, ${count(log.number, "frame")}` : log.number ? `table, ${count(log.number, "row")}` : `table, ${count(log.choices.length, "column")}`,
      log.seconds ? span(log.seconds) : null, log.start > 1e8 ? `from ${new Date(1000 * log.start).toISOString().slice(0, 19).replace("T", " ")} UTC` : null,
      log.gaps ? count(log.gaps, "gap") : null, log.kind === "can_log" ? count(log.ids, "id") : null, log.time ? `time: ${log.time}` : null,
    ].filter(Boolean).join(" · ");
    return element("header", { class: "log-head" },
      element("a", { href: "gallery", class: "go" }, "← All twins"), element("h2", {}, log.name), element("p", { class: "faint" }, facts));
  }

  // Never a dead end: the file stays, and another reading of it, or another file, is one step away.
  failure(log) {
    return element("div", { class: "log-failure" },
      element("p", { class: "banner", role: "alert" }, log.error),
      element("p", {}, "The file is kept in the list of recordings. Correct it and drop it again, drop another one here, or go back to all twins."),
      element("button", { type: "button", class: "go", onclick: () => this.read() }, "Read it again"));
  }

  body(log) {
    this.find = element("input", { type: "search", placeholder: "Find a signal", "aria-label": "Find a signal", oninput: () => this.filter() });
    this.tally = element("span", { class: "faint", role: "status" });
    this.list = element("div", { class: "signals" });
    const signals = element("section", { class: "log-signals", "aria-label": "Signals" },
      ...log.faults.filter(() => log.needs !== "time").map((text) => element("p", { class: "note-line" }, text)),
      log.kind === "can_log" ? this.databases(log) : this.times(log),
      log.signals.length ? element("div", { class: "signals-bar" }, element("h2", {}, "Signals"), this.tally, element("span", { class: "space" }), this.find) : null,
      this.list,
      log.frames.length ? this.frames(log) : null);
    if (log.signals.length) {
      this.groups = this.grouped(log);
      this.filter();
    }
    return element("div", { class: "log-body" }, signals, element("aside", { class: "log-side", "aria-label": "Twins for this log" }, this.drafting(log), ...this.twins(log)));
  }

  // What a CAN log needs, and the databases that are here.
  databases(log) {
    const toggle = (one) => this.read({ dbc: log.databases.filter((other) => (other === one) !== other.used).map((other) => other.name) });
    const known = log.databases.map((one) => element("li", {},
      element("label", {},
        element("input", { type: "checkbox", checked: one.used, disabled: Boolean(one.error), onchange: () => toggle(one) }), ` ${one.name} `,
        element("span", { class: "faint" }, one.error ?? `knows ${one.ids} of ${count(log.ids, "id")}${one.twins.length ? `, used by ${one.twins.join(", ")}` : ""}`))));
    const choose = element("input", { type: "file", accept: DATABASE, multiple: true, hidden: true, onchange: () => this.ask.drop([...choose.files]) });
    return element("section", { class: "needs", dataset: { needed: String(log.needs === "database") } },
      element("h2", {}, log.needs === "database" ? "This CAN log needs a DBC" : "Databases"),
      log.needs === "database" ? element("p", {}, `Its ${count(log.number, "frame")} hold raw bytes. A DBC file says which bits are which signal, with scale and unit. Drop the vehicle's .dbc here${known.length ? ", or use one of these:" : ", or choose it."}`) : null,
      known.length ? element("ul", {}, ...known) : null,
      element("button", { type: "button", class: "go", onclick: () => choose.click() }, "Choose a DBC"), choose);
  }

  // Which column holds the time of a table, and its unit.
  times(log) {
    const option = (value, text, chosen) => element("option", { value, selected: chosen }, text);
    const column = element("select", { "aria-label": "Time column" }, ...(log.time ? [] : [option("", "choose", true)]), ...log.choices.map((name) => option(name, name, name === log.time)));
    const units = [["s", "seconds"], ["ms", "milliseconds"], ["us", "microseconds"], ["ns", "nanoseconds"], ["min", "minutes"], ["h", "hours"], ["excel", "Excel dates"], ["matlab", "MATLAB datenum"]];
    const unit = element("select", { "aria-label": "Unit of the time" }, ...units.map(([value, text]) => option(value, text, value === this.unit)));
    const change = () => column.value && this.read({ time: column.value, unit: unit.value });
    column.addEventListener("change", change);
    unit.addEventListener("change", change);
    const needed = log.needs === "time";
    return element("section", { class: "needs", dataset: { needed: String(needed) } },
      element("h2", {}, needed ? "Which column holds the time?" : "Time"),
      needed ? element("p", {}, log.time ? `${log.faults.join("; ")}.` : `No column of ${log.name} has a usual name of a time, or dates. Choose the one with the time of each row; if there is none, add it to the file and drop it again.`) : null,
      element("p", {}, "Column ", column, " numbers in ", unit, element("span", { class: "faint" }, " (dates are recognised)")));
  }

  frames(log) {
    return element("details", { class: "frames", open: !log.signals.length },
      element("summary", {}, `${count(log.frames.length, "id")} that no database describes`),
      table(["Bus", "Id", "Frames", "Rate"], log.frames.map((one) => [one.bus, one.id, one.number.toLocaleString("en"), rate(one.rate)])));
  }

  // Signals

  grouped(log) {
    const groups = new Map();
    log.signals.forEach((signal, index) => {
      if (!groups.has(signal.group)) groups.set(signal.group, []);
      groups.get(signal.group).push(index);
    });
    // Constants last: they say the least.
    for (const members of groups.values()) members.sort((a, b) => (log.signals[a].kind === "constant") - (log.signals[b].kind === "constant"));
    const small = log.signals.length <= 3 * OPEN_GROUP_ROWS;
    return [...groups].map(([name, members], k) => {
      const rows = element("div", { class: "rows" });
      const title = element("span", {}, name || "Columns");
      const tally = element("span", { class: "faint" });
      const node = element("details", { class: "group", open: (small || k < 4) && members.length <= OPEN_GROUP_ROWS || groups.size === 1 }, element("summary", {}, title, " ", tally), rows);
      const group = { name, members, rows, tally, node, matching: members, filled: 0 };
      node.addEventListener("toggle", () => node.open && !group.filled && this.fill(group));
      return group;
    });
  }

  filter() {
    const words = this.find.value.toLowerCase().split(/\s+/).filter(Boolean);
    let left = 0;
    for (const group of this.groups) {
      group.matching = group.members.filter((index) => {
        const text = `${group.name} ${this.log.signals[index].name} ${this.log.signals[index].unit}`.toLowerCase();
        return words.every((word) => text.includes(word));
      });
      left += group.matching.length;
      group.node.hidden = !group.matching.length;
      if (words.length && group.matching.length && group.matching.length <= OPEN_GROUP_ROWS) group.node.open = true;
      setText(group.tally, group.matching.length === group.members.length ? count(group.members.length, "signal") : `${group.matching.length} of ${count(group.members.length, "signal")}`);
      group.filled = 0;
      group.rows.replaceChildren();
      if (group.node.open) this.fill(group);
    }
    setText(this.tally, words.length ? `${left} of ${this.log.signals.length}` : String(this.log.signals.length));
    this.list.replaceChildren(...this.groups.map((group) => group.node));
  }

  // The next rows of a group.
  fill(group) {
    group.rows.querySelector(".more")?.remove();
    const next = group.matching.slice(group.filled, group.filled + PAGE_ROWS);
    group.filled += next.length;
    for (const index of next) {
      if (!this.rows.has(index)) this.rows.set(index, this.row(index));
      const row = this.rows.get(index);
      group.rows.append(row.node);
      this.seen.observe(row.node);
    }
    const more = group.matching.length - group.filled;
    if (more > 0) group.rows.append(element("button", { type: "button", class: "go more", onclick: () => this.fill(group) }, `Show ${Math.min(more, PAGE_ROWS)} more of ${more}`));
  }

  row(index) {
    const signal = this.log.signals[index];
    const chart = element("div", { class: "spark", tabindex: "0", role: "img", "aria-label": `${signal.name}: ${compact(signal.low)} to ${compact(signal.high)}${spaced(signal.unit)}` });
    const reading = element("p", { class: "faint readout" }, "");
    const select = element("select", { "aria-label": `Role of ${signal.name}`, onchange: () => this.choose(index, select.value) },
      ...ROLES.map(([value, text, title]) => element("option", { value, title }, text)));
    const facts = [count(signal.number, "value"), rate(signal.rate), signal.missing ? `${signal.missing} missing` : null, signal.kind === "signal" ? null : signal.kind].filter(Boolean).join(" · ");
    const row = { index, chart, reading, select, curve: null };
    row.node = element("div", { class: "signal", dataset: { index: String(index), signal: signal.name } },
      element("div", { class: "what" }, element("b", { title: signal.name }, signal.name), element("span", { class: "unit" }, signal.unit ? ` [${signal.unit}]` : ""), element("p", { class: "faint" }, facts), reading),
      chart, select);
    chart.addEventListener("pointermove", (event) => this.point(row, event));
    chart.addEventListener("pointerleave", () => this.point(row, null));
    chart.addEventListener("click", () => this.enlarge(row));
    chart.addEventListener("keydown", (event) => event.key === "Enter" && this.enlarge(row));
    this.role(row);
    return row;
  }

  enlarge(row) {
    row.node.classList.toggle("tall");
    plot(row, this.log);
  }

  // Ask for the curves of rows that come into view, some at a time.
  visible(entries) {
    for (const entry of entries) if (entry.isIntersecting) {
      this.seen.unobserve(entry.target);
      (this.waiting ??= new Set()).add(Number(entry.target.dataset.index));
    }
    if (this.waiting?.size && !this.asking) this.fetchCurves();
  }

  async fetchCurves() {
    this.asking = true;
    const { request, log } = this;
    while (this.waiting?.size && log === this.log) {
      const signals = [...this.waiting].slice(0, CURVE_BATCH);
      for (const index of signals) this.waiting.delete(index);
      const answer = await post("api/gallery/log/curves", { ...request, signals });
      if (answer.error || log.name !== this.name) break;
      signals.forEach((index, k) => {
        const row = this.rows.get(index);
        if (row) plot(Object.assign(row, { curve: answer.curves[k] }), log);
      });
    }
    this.asking = false;
  }

  point(row, event) {
    const marker = row.chart.querySelector(".marker");
    if (!row.curve || !marker) return;
    marker.hidden = !event;
    if (!event) return setText(row.reading, "");
    const box = row.chart.querySelector("svg").getBoundingClientRect();
    const [t, low, high] = row.curve;
    const at = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width)) * this.log.seconds;
    const k = nearest(t, at);
    const signal = this.log.signals[row.index];
    marker.style.left = `${(100 * t[k]) / (this.log.seconds || 1)}%`;
    setText(row.reading, `${clock(t[k], this.log.seconds < 60 ? 1 : 0)}  ${low[k] === high[k] ? compact(low[k]) : `${compact(low[k])} to ${compact(high[k])}`}${spaced(signal.unit)}`);
  }

  // Twins

  twins(log) {
    const fitting = log.twins.filter((twin) => twin.runs);
    const others = log.twins.filter((twin) => !twin.runs && (twin.found.length || twin.missing.length));
    const reasons = new Map();
    for (const twin of log.twins) if (!twin.runs && !others.includes(twin)) reasons.set(twin.blocking, [...(reasons.get(twin.blocking) ?? []), twin.short]);
    const lines = (twin) => [
      twin.found.length ? element("p", {}, element("b", {}, "has "), twin.found.join(", ")) : null,
      ...twin.missing.slice(0, 6).map((text) => element("p", { class: "lacks" }, text)),
      twin.missing.length > 6 ? element("p", { class: "lacks" }, `and ${twin.missing.length - 6} more`) : null,
    ];
    const start = (twin) => element("button", { type: "button", class: "start", "aria-label": `Run ${twin.short} on this log`, onclick: () => this.ask.run(log.name, twin.name) }, "Run");
    const share = (twin) => (twin.missing.length ? `${twin.found.length} of ${count(twin.found.length + twin.missing.length, "channel")}` : `all ${count(twin.found.length, "channel")}`);
    return [
      element("section", { "aria-label": "Twins that fit" },
        element("h2", {}, fitting.length ? "Twins that fit" : log.twins.length ? "No twin here fits this log" : "Twins that fit"),
        log.twins.length ? null : element("p", { class: "faint" }, "They are compared once the log can be read."),
        element("ol", { class: "fits" }, ...fitting.map((twin) => element("li", { dataset: { twin: twin.short } },
          element("div", { class: "row" }, element("h3", {}, twin.short), element("span", { class: "faint" }, share(twin)), element("span", { class: "space" }), start(twin)),
          element("p", { class: "faint" }, twin.title), element("details", {}, element("summary", {}, "Channels"), ...lines(twin)))))),
      log.twins.length > fitting.length ? element("details", { class: "unfit", open: !fitting.length },
        element("summary", {}, `Why ${count(log.twins.length - fitting.length, "other twin")} ${log.twins.length - fitting.length === 1 ? "does" : "do"} not`),
        ...others.map((twin) => element("details", { dataset: { twin: twin.short } }, element("summary", {}, element("b", {}, twin.short), ` ${twin.blocking}`), ...lines(twin))),
        ...[...reasons].map(([reason, names]) => element("p", { class: "faint" }, element("b", {}, names.join(", ")), `: ${reason}`))) : null,
    ].filter(Boolean);
  }

  // Draft

  drafting(log) {
    const head = element("h2", {}, "Draft a twin from this log");
    if (!log.signals.length) return element("section", { class: "draft" }, head, element("p", { class: "faint" }, log.needs === "time" ? "Name the time column first." : "Give a DBC first: a draft is made of signals."));
    this.twin = element("input", { type: "text", value: log.draft_name, "aria-label": "Name of the twin", spellcheck: "false" });
    this.chosen = element("p", { class: "chosen", role: "status" }, "finding roles …");
    this.start = element("button", { type: "button", class: "start", disabled: true, onclick: () => this.draft() }, "Draft and run");
    this.stop = element("button", { type: "button", class: "go", hidden: true, onclick: () => post("api/gallery/log/draft/stop", {}) }, "Stop");
    this.progress = element("p", { role: "status", class: "faint" });
    this.wrong = element("p", { class: "error", role: "alert" });
    return element("section", { class: "draft", "aria-label": "Draft a twin" }, head,
      element("p", { class: "faint" }, "A model of generic motions, fitted to the first half of the log and checked on the second. The role of each signal is proposed; change it beside its chart."),
      this.chosen,
      element("label", {}, "Name ", this.twin),
      element("div", { class: "row" }, this.start, this.stop, this.progress), this.wrong);
  }

  // The roles that the server proposes, unless they were chosen already.
  propose() {
    const { roles, proposing } = this.log;
    if (!this.log.signals?.length || this.proposed === this.name || (!roles && proposing)) return;
    this.proposed = this.name;
    (roles ?? []).forEach(([role], index) => this.roles.has(index) || this.roles.set(index, role));
    for (const row of this.rows.values()) this.role(row);
    this.sum();
  }

  role(row) {
    const role = this.roles.get(row.index) ?? "";
    row.node.dataset.role = role;
    row.select.value = role;
    const [proposed, reason] = this.log.roles?.[row.index] ?? [];
    if (reason) row.select.title = `Proposed: ${ROLES.find(([value]) => value === proposed)?.[1] ?? proposed}, ${reason}`;
  }

  choose(index, role) {
    this.roles.set(index, role);
    this.role(this.rows.get(index));
    this.sum();
  }

  // What the draft will be made of; each name leads to its row.
  sum() {
    const lines = ROLES.slice(0, -1).map(([value, text]) => [text, this.members(value)]).filter(([, members]) => members.length);
    const link = (index) => element("button", { type: "button", class: "signal-link", onclick: () => this.reveal(index) }, this.log.signals[index].name);
    this.chosen.replaceChildren(...lines.flatMap(([text, members]) => [element("span", { class: "role" }, element("b", {}, `${text}: `), ...members.slice(0, 12).map(link), members.length > 12 ? ` and ${members.length - 12} more` : null)]));
    const able = this.members("state").length + this.members("sensor").length > 0;
    if (!able) setText(this.chosen, `${this.log.unproposed ? `No roles could be proposed (${this.log.unproposed}). ` : ""}Give at least one signal the role State or Sensor.`);
    this.start.disabled = !able || this.drafts;
  }

  members(role) {
    return [...this.roles].filter(([, other]) => other === role).map(([index]) => index).sort((a, b) => a - b);
  }

  // Its row, whatever group it is in.
  reveal(index) {
    this.find.value = this.log.signals[index].name;
    this.filter();
    const group = this.groups.find((item) => item.matching.includes(index));
    group.node.open = true;
    if (!group.filled) this.fill(group);
    this.rows.get(index)?.select.focus();
  }

  async draft() {
    const roles = { states: this.members("state"), sensors: this.members("sensor"), inputs: this.members("input"), held_out: this.members("held out") };
    this.follow(await post("api/gallery/log/draft", { ...this.request, twin: this.twin.value.trim(), roles }));
  }

  // Progress of the draft, until the session starts the twin.
  follow(answer) {
    this.drafts = answer.state === "running";
    const { doing, seconds, summary } = answer;
    setText(this.progress, this.drafts ? `${doing} … ${Math.floor(seconds)} s` : answer.state === "done" ? `${summary}: starting` : answer.state === "stopped" ? "stopped" : "");
    setText(this.wrong, answer.error ?? "");
    this.stop.hidden = !this.drafts;
    this.start.disabled = this.drafts;
    if (answer.state === "done") this.ask.follow();
    if (this.drafts) setTimeout(() => this.name && this.progressed(answer), POLL_MS);
  }

  // The next answer; while the session cannot be reached, the last one.
  async progressed(last) {
    const found = await get("api/gallery/log/draft");
    if (this.name) this.follow(found.state ? found : last);
  }
}

// The quick chart of a row: its curve, the scale at the left, and the time below if it is tall.
function plot(row, log) {
  if (!row.curve) return;
  const signal = log.signals[row.index];
  const [t, low, high] = row.curve;
  const span_ = log.seconds || 1;
  const range = signal.high - signal.low || Math.abs(signal.high) || 1;
  const bottom = signal.high === signal.low ? signal.low - range / 2 : signal.low;
  const x = (value) => (1000 * value) / span_;
  const y = (value) => 97 - (94 * (value - bottom)) / range;
  const apart = t.slice(1).map((value, k) => value - t[k]).sort((a, b) => a - b);
  const limit = GAP_INTERVALS * Math.max(apart[apart.length >> 1] ?? 0, span_ / 300);
  let d = "";
  for (let k = 0; k < t.length; k++) {
    const at = x(t[k]).toFixed(1);
    const open = k && t[k] - t[k - 1] <= limit;
    d += !open ? `M${at} ${y(low[k]).toFixed(1)}` : signal.kind === "switch" ? `H${at}V${y(low[k]).toFixed(1)}` : `L${at} ${y(low[k]).toFixed(1)}`;
    d += high[k] === low[k] ? (open ? "" : "h.01") : `V${y(high[k]).toFixed(1)}`;
  }
  const tall = row.node.classList.contains("tall");
  const grid = tall ? [0.25, 0.5, 0.75].map((part) => `M${1000 * part} 0V100M0 ${100 * part}H1000`).join("") : "";
  const path = (name, shape) => element("svg:path", { class: name, d: shape, "vector-effect": "non-scaling-stroke" });
  const ticks = tall ? [1, 0.5, 0] : [1, 0];
  const times = tall ? [0, 0.25, 0.5, 0.75, 1] : [];
  row.chart.replaceChildren(
    element("div", { class: "levels", "aria-hidden": "true" }, ...ticks.map((part) => element("span", {}, compact(signal.low === signal.high ? signal.low + (part - 0.5) * range : signal.low + part * range, 3)))),
    element("div", { class: "plot" }, element("svg:svg", { viewBox: "0 0 1000 100", preserveAspectRatio: "none", "aria-hidden": "true" }, path("grid", grid), path("curve", d)), element("i", { class: "marker", hidden: true })),
    ...(tall ? [element("div", { class: "times", "aria-hidden": "true" }, ...times.map((part) => element("span", {}, clock(part * span_, span_ < 60 ? 1 : 0))))] : []));
  row.node.dataset.drawn = "true";
}
