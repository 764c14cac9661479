// One dropped log: its content and signals, the twins that fit, and a draft of a twin.

import { changed, element, keepFocus, setText, table } from "./dom.js";
import { DATABASE } from "./drops.js";
import { Signals, rate, ROLES } from "./dropped_signals.js";
import { count, span } from "./format.js";
import { get, post } from "./http.js";

const POLL_MS = 300;

const UNITS = { s: "seconds", ms: "milliseconds", us: "microseconds", ns: "nanoseconds", min: "minutes", h: "hours", d: "days", excel: "Excel dates", matlab: "MATLAB datenum" };

// How a log is read, as the options of `nisus log`.
const FIELDS = {
  Format: "Format of dates, as in strptime: %d.%m.%Y %H:%M:%S", Zone: "Time zone of dates without an offset: Europe/Berlin",
  Heading: "Line with the names of the columns, or none", Delimiter: "Sign between cells, or tab or space", Decimal: "Decimal sign, . or ,",
  Skip: "Lines before the table, which are left out", Sheet: "Sheet of a workbook, or group of a TDMS file",
};

// The view of one log. `ask` has run(log, twin), which starts a twin on it, drop(files), and follow(), which reports how a
// twin starts.
export class LogView {
  constructor(node, ask) {
    Object.assign(this, { node, ask, name: null, roles: new Map() });
  }

  get request() {
    return { name: this.name, ...this.how };
  }

  open(name) {
    if (name === this.name) return;
    Object.assign(this, { name, how: {}, log: null, proposed: null, drafts: false });
    changed(this.node, null);
    this.node.replaceChildren(element("p", { class: "faint reading", role: "status" }, `${name}: reading …`));
    this.read();
  }

  close() {
    clearTimeout(this.timer);
    this.name = null;
    this.signals?.close();
    this.node.replaceChildren();
  }

  // DBC files were dropped: the log is read again if it is a CAN log.
  describe(files) {
    if (this.log?.kind !== "can_log") return false;
    this.read("dbc", [...new Set([...(this.log.databases ?? []).filter((one) => one.used).map((one) => one.name), ...files])]);
    return true;
  }

  // Read it, with another value of an option; an empty one leaves it out.
  read(key, value) {
    const { [key]: before, ...how } = this.how;
    Object.assign(this, { how: value ? { ...how, [key]: value } : how, proposed: null });
    this.roles.clear();
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
      this.signals?.close();
      this.proposed = null;
      keepFocus(this.node, "name", () => this.node.replaceChildren(this.head(log), log.error ? this.failure(log) : this.body(log)));
    }
    this.propose();
  }

  head(log) {
    const facts = log.error ? "" : [
      log.kind === "can_log" ? `CAN log, ${count(log.number, "frame")}` : log.number ? `table, ${count(log.number, "row")}` : `table, ${count(log.choices.length, "column")}`,
      log.seconds ? span(log.seconds) : null, log.start > 1e8 ? `from ${new Date(1000 * log.start).toISOString().slice(0, 19).replace("T", " ")} UTC` : null,
      log.kind === "can_log" ? count(log.ids, "id") : null,
    ].filter(Boolean).join(" · ");
    return element("header", { class: "log-head" },
      element("a", { href: "gallery", class: "go" }, "← All twins"), element("h2", {}, log.name), element("p", { class: "faint" }, facts));
  }

  // Never a dead end: the file stays, and another reading of it, or another file, is one step away.
  failure(log) {
    return element("div", { class: "log-failure" },
      element("p", { class: "banner", role: "alert" }, log.error),
      element("p", {}, "The file is kept in the list of recordings. Correct it and drop it again, drop another one here, or go back to all twins."),
      this.times(log),
      element("button", { type: "button", class: "go", onclick: () => this.read() }, "Read it again"));
  }

  body(log) {
    this.signals = new Signals(log, this.request, this.roles, () => this.sum());
    const signals = element("section", { class: "log-signals", "aria-label": "Signals" },
      ...log.faults.filter(() => log.needs !== "time").map((text) => element("p", { class: "note-line" }, text)),
      log.kind === "can_log" ? this.databases(log) : this.times(log),
      ...log.facts.map((text) => element("p", { class: "note-line" }, text)),
      log.signals.length ? this.signals.bar : null,
      this.signals.list,
      log.frames.length ? this.frames(log) : null);
    return element("div", { class: "log-body" }, signals, element("aside", { class: "log-side", "aria-label": "Twins for this log" }, this.drafting(log), ...this.twins(log)));
  }

  // The need of a CAN log, and the databases at hand.
  databases(log) {
    const toggle = (one) => this.read("dbc", log.databases.filter((other) => (other === one) !== other.used).map((other) => other.name));
    const known = log.databases.map((one) => element("li", {},
      element("label", {},
        element("input", { type: "checkbox", checked: one.used, disabled: Boolean(one.error), onchange: () => toggle(one) }), ` ${one.name} `,
        element("span", { class: "faint" }, one.error ?? `knows ${one.ids} of ${count(log.ids, "id")}${one.twins.length ? `, used by ${one.twins.join(", ")}` : ""}`))));
    const choose = element("input", { type: "file", accept: DATABASE, multiple: true, hidden: true, onchange: () => this.ask.drop([...choose.files]) });
    return element("section", { class: "needs", dataset: { needed: String(log.needs === "database") } },
      element("h2", {}, log.needs === "database" ? "This CAN log needs a DBC" : "Databases"),
      log.needs === "database" ? element("p", {}, `Its ${count(log.number, "frame")} hold raw bytes. A DBC file says which bits are which signal, with scale and unit. Drop the vehicle's .dbc here${known.length ? ", or use one of these:" : ", or choose it."}`) : null,
      known.length ? element("ul", {}, ...known) : null,
      element("button", { type: "button", class: "go", onclick: () => choose.click() }, "Choose a DBC"), choose, this.field("Zone"));
  }

  field(label) {
    const key = label.toLowerCase();
    const read = ({ target }) => this.read(key, key === "skip" ? Number(target.value) : target.value.trim());
    return element("label", { title: FIELDS[label] }, `${label} `, element("input", { name: key, type: key === "skip" ? "number" : "text", min: "0", value: this.how[key], placeholder: { zone: "UTC", skip: "0" }[key] ?? "detected", spellcheck: "false", onchange: read }));
  }

  select(label, key, options, chosen) {
    return element("label", {}, `${label} `, element("select", { name: key, "aria-label": label, onchange: ({ target }) => this.read(key, target.value) }, ...options.map(([value, text]) => element("option", { value, selected: value === chosen }, text))));
  }

  // Where the time of a table is, and how it is written.
  times(log) {
    const needed = log.needs === "time";
    const reason = log.error ?? log.faults.join("; ");
    const formats = [...reason.matchAll(/"(%.*?)"/g)].map(([, format]) => element("button", { type: "button", class: "go", onclick: () => this.read("format", format) }, format));
    const written = Object.keys(FIELDS).slice(2);
    return element("section", { class: "needs", dataset: { needed: String(needed) } },
      element("h2", {}, needed ? formats.length ? "How is the time written?" : "Which column holds the time?" : "Time"),
      needed ? element("p", {}, `${reason}. `, ...formats) : null,
      log.choices ? this.select("Column", "time", [...(log.time ? [] : [["", "detected"]]), ...log.choices.map((name) => [name, name])], log.time) : null,
      this.select("Unit", "unit", Object.entries(UNITS), log.unit ?? this.how.unit), this.field("Format"), this.field("Zone"),
      element("details", { open: needed || Boolean(log.error) || written.some((label) => this.how[label.toLowerCase()]) }, element("summary", {}, "How the file is written"), ...written.map((label) => this.field(label))));
  }

  frames(log) {
    return element("details", { class: "frames", open: !log.signals.length },
      element("summary", {}, `${count(log.frames.length, "id")} that no database describes`),
      table(["Bus", "Id", "Frames", "Rate"], log.frames.map((one) => [one.bus, one.id, one.number.toLocaleString("en"), rate(one.rate)])));
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
    if (!log.signals.length) return element("section", { class: "draft" }, head, element("p", { class: "faint" }, log.needs === "time" ? "Complete the fields of the time first." : "Give a DBC first: a draft is made of signals."));
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
    this.signals.propose(roles);
    this.sum();
  }

  // What the draft will be made of; each name leads to its row.
  sum() {
    const lines = ROLES.slice(0, -1).map(([value, text]) => [text, this.members(value)]).filter(([, members]) => members.length);
    const link = (index) => element("button", { type: "button", class: "signal-link", onclick: () => this.signals.reveal(index) }, this.log.signals[index].name);
    this.chosen.replaceChildren(...lines.flatMap(([text, members]) => [element("span", { class: "role" }, element("b", {}, `${text}: `), ...members.slice(0, 12).map(link), members.length > 12 ? ` and ${members.length - 12} more` : null)]));
    const able = this.members("state").length + this.members("sensor").length > 0;
    if (!able) setText(this.chosen, `${this.log.unproposed ? `No roles could be proposed (${this.log.unproposed}). ` : ""}Give at least one signal the role State or Sensor.`);
    this.start.disabled = !able || this.drafts;
  }

  members(role) {
    return [...this.roles].filter(([, other]) => other === role).map(([index]) => index).sort((a, b) => a - b);
  }

  async draft() {
    const roles = { states: this.members("state"), sensors: this.members("sensor"), inputs: this.members("input"), held_out: this.members("held out") };
    this.follow(await post("api/gallery/log/draft", { ...this.request, twin: this.twin.value.trim(), roles }));
  }

  // Progress of the draft, until the session starts the twin; while the session cannot be reached, the last answer.
  follow(answer) {
    this.drafts = answer.state === "running";
    const { doing, seconds, summary } = answer;
    setText(this.progress, this.drafts ? `${doing} … ${Math.floor(seconds)} s` : answer.state === "done" ? `${summary}: starting` : answer.state === "stopped" ? "stopped" : "");
    setText(this.wrong, answer.error ?? "");
    this.stop.hidden = !this.drafts;
    this.start.disabled = this.drafts;
    if (answer.state === "done") this.ask.follow();
    if (this.drafts) setTimeout(async () => {
      const found = this.name && (await get("api/gallery/log/draft"));
      if (this.name) this.follow(found.state ? found : answer);
    }, POLL_MS);
  }
}
