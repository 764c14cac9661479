// The strip on top: which filter, may it be trusted and if not why, NIS in its bounds, a light for each sensor.

import { $, changed, element, refusal, setAttribute, setText, showText } from "./dom.js";
import { clock, compact, inChartTime, spaced, span, words } from "./format.js";
import { get, post } from "./http.js";

// Signs beside the colours, for users who cannot distinguish them.
export const SIGNS = {
  waiting: "…", tracking: "●", advisory: "◆", suspect: "◐", degraded: "▲", diverged: "✖", stale: "◌", "held out": "○", screened: "⊘",
};
const MOST_LIGHTS = 8;
const CALM = ["tracking", "advisory", "held out", "waiting"];

// What is shown as one: groups of sensors, and those in none, in the order of their first sensors: {name, sensors, declared}.
export function unitsOf({ sensors, groups }) {
  const grouped = new Map(groups.flatMap((group) => group.sensors.map((name) => [name, group])));
  return [...new Set(sensors.map((name) => grouped.get(name) ?? name))].map((item) => (typeof item === "string" ? { name: item, sensors: [item], declared: true } : item));
}

// A group's numbers in one sentence; `group` is its summary in the status.
export function groupText({ name, sensors }, group) {
  const states = Object.entries(group.states).map(([state, count]) => `${grouped(count)} ${state}`).join(", ");
  const [worst, most] = group.worst[0] ?? [];
  const nis = group.nis === null ? "" : `. NIS / dof ${compact(group.nis, 3)}; largest ${compact(most, 3)} (${words(worst)})`;
  return `${words(name)}, ${grouped(sensors.length)} sensors: ${states}${nis}`;
}

export class Trust {
  constructor(model, link, open) {
    this.model = model;
    this.lights = new Map();
    this.units = unitsOf(model);
    for (const { name, sensors } of this.units.slice(0, MOST_LIGHTS)) {
      const shown = () => (sensors.length > 1 ? link.dispatchEvent(new CustomEvent("group", { detail: name })) : open("episodes"));
      const light = element("button", { type: "button", class: "light", onclick: shown }, element("i", {}, "○"), element("span", {}, words(name)));
      this.lights.set(name, light);
    }
    $("lights").replaceChildren(...this.lights.values());
    if (this.units.length > MOST_LIGHTS) $("lights").append(element("span", { class: "more", id: "more-lights" }));
    $("health").addEventListener("click", () => open("episodes"));
    $("cause").addEventListener("click", () => open("episodes"));
    link.addEventListener("status", (event) => this.show(event.detail));
    link.addEventListener("connection", (event) => this.connection(event.detail));
  }

  // Health, cause, NIS and lights are those of the time that the page shows.
  show(present) {
    const status = { ...present, ...present.moment };
    document.title = `${SIGNS[status.health] ?? ""} ${status.twin} · Nisus`;
    setText($("twin"), status.twin);
    setAttribute($("twin"), "title", status.title);
    const turned = Object.keys(status.turned).length > 0;
    setText($("began"), status.began_as === "recorded" ? (turned ? "recorded, turned" : "as recorded") : "");
    const lost = status.lost !== null;
    const since = lost ? status.lost : status.since;
    const lasting = lost || (!["tracking", "waiting"].includes(status.health) && since !== null);
    const name = lost ? "not a number" : status.health;
    setText($("health"), `${SIGNS[status.health] ?? "●"} ${name}${lasting ? ` ${span((status.t - since) / 1e9)}` : ""}`);
    $("health").dataset.health = lost ? "diverged" : status.health;
    const cause = lost ? "The estimate is not a number. Reset it, or choose another filter." : inChartTime(status.cause, status.origin);
    const first = status.episodes_open > 1 && cause ? `1 of ${status.episodes_open}: ` : ""; // ahead, as the end may be cut
    setText($("cause"), first + cause);
    setAttribute($("cause"), "title", first + cause);
    this.gauge(status);
    // A cause needs the room: healthy sensors show their light without a name.
    $("lights").dataset.brief = String(Boolean(cause));
    const known = this.units.map((unit) => stateOf(unit, status));
    this.units.slice(0, MOST_LIGHTS).forEach(({ name, sensors }, k) => {
      const [light, { state, text, faults }] = [this.lights.get(name), known[k]];
      light.dataset.health = state;
      setText(light.firstChild, SIGNS[state] ?? "●");
      if (sensors.length > 1) setText(light.lastChild, `${words(name)} (${faults ? `${grouped(faults)} of ` : ""}${grouped(sensors.length)})`);
      setAttribute(light, "title", text);
    });
    if ($("more-lights")) {
      const bad = known.slice(MOST_LIGHTS).filter(({ state }) => !CALM.includes(state));
      setText($("more-lights"), `+${known.length - MOST_LIGHTS}${bad.length ? `, ${bad.length} with faults` : ""}`);
      setAttribute($("more-lights"), "title", bad.map(({ text }) => text).join("\n"));
    }
    setText($("folding"), refolding(status));
    setAttribute($("record"), "aria-pressed", String(status.recording !== null));
    const file = status.recording?.split(/[\\/]/).pop() ?? "";
    const where = `Recording ${file} into ${status.recording_folder}`;
    setAttribute($("record"), "title", file ? `${where}: end it (R)` : "Record into a new .rrd file (R)");
    showText($("recording"), file);
    setAttribute($("recording"), "title", where);
    const latency = typeof status.latency_ms === "number" ? `latency ${span(status.latency_ms / 1000)}` : "";
    setText($("latency"), latency);
  }

  // NIS per degree of freedom on a logarithmic scale of two decades about its bounds. Its colour is that of the health:
  // of a consistent filter, too, 5 % of the means lie outside the bounds.
  gauge({ nis, nis_judged: judged, nis_low: low, nis_high: high, nis_dof: dof, nis_words: said }) {
    const known = [nis, judged, low, high].every((value) => typeof value === "number" && value > 0);
    setText($("nis"), known ? compact(nis / dof, 3) : "–");
    $("gauge").hidden = !known;
    if (!known) return;
    const middle = Math.log10(Math.sqrt(low * high));
    const place = (value) => `${Math.min(98, Math.max(2, 50 + 50 * (Math.log10(value) - middle)))}%`;
    $("gauge").style.setProperty("--low", place(low));
    $("gauge").style.setProperty("--high", place(high));
    $("gauge").style.setProperty("--nis", place(judged));
    $("gauge").dataset.health = $("health").dataset.health;
    setAttribute($("gauge"), "title", `Latest measurements: ${said}`);
  }

  connection(state) {
    const text = {
      live: "", waiting: "Connection lost, trying again", hidden: "",
      ended: "This session has ended; open the address that Nisus printed last",
    }[state];
    showText($("connection"), text);
    $("connection").dataset.state = state;
  }
}

// State of a sensor or a group: {state, text, faults}; the state of a group is that of its worst member.
function stateOf(unit, status) {
  const group = unit.sensors.length > 1 && status.groups[unit.name];
  if (group) return { state: group.state, text: groupText(unit, group), faults: group.alarms };
  const { state, text } = status.sensors[unit.name] ?? { state: "waiting", text: "" };
  return { state, text: `${words(unit.name)}: ${state}${text ? `. ${text}` : ""}`, faults: 0 };
}

// The filter being compiled, the refold under way, or the revision.
function refolding({ awaited, compiling, refolding: waits, revision }) {
  if (awaited !== null) return `compiling ${awaited}, ${Math.round(compiling[awaited] ?? 0)} s …`;
  return waits ? `folding r${revision + 1} …` : `r${revision}`;
}

// Episodes, newest first, each with its remedy; and notices.

const MAX_EPISODES = 200;

// Names of measurement counts; a count of zero is not shown.
const KINDS = [
  ["used", "used"], ["gated", "rejected by the gate"], ["held out", "held out"], ["screened", "implausible"], ["missing", "empty"],
  ["failed", "failed"], ["stale", "dropped: too late"], ["wrong time", "dropped: wrong time"], ["inflated", "late, with R inflated"], ["held", "waiting for a clock check"], ["silenced", "dropped by an injected fault"],
];

// Causes of episodes in words, where their names are not.
const CAUSES = {
  narrow: "band too narrow", wide: "band too wide", shifted: "offset", correlated: "correlated innovations", alternating: "alternating innovations",
  spiky: "outliers", refused: "rejected", disagreeing: "rows disagree", agreeing: "rows closer than their noise", missed: "truth outside the band",
  screened: "implausible", silent: "dropout", "never heard": "no measurement yet", outside: "outside the fitted range",
  impoverished: "few particles left", stale: "no measurements", dropped: "measurements dropped",
};

const MAX_CAUSES = 5; // of the change of one state

const grouped = (n) => n.toLocaleString("en");

export class Episodes {
  // notes: the list of notes of users
  constructor(node, link, view, charts, notes) {
    Object.assign(this, { node, link, view, charts });
    this.body = element("div", {});
    this.notices = [];
    this.known = -1; // number of the last one
    this.held = []; // offsets of held-out sensors, in words
    this.counts = element("dl", { class: "counts", "aria-label": "Measurement counts" });
    this.change = element("ol", { "aria-live": "polite" });
    const explain = element("button", { type: "button", class: "go", title: "Of all that the charts show: by the model, each input and each sensor", onclick: () => this.explain(...this.charts.range) }, "Explain");
    const why = element("section", { class: "why", "aria-label": "What moved the estimate" }, element("header", {}, element("h3", {}, "What moved the estimate"), explain), this.change);
    this.commands = element("ol", {});
    const log = element("details", { class: "commands", ontoggle: () => log.open && this.list() }, element("summary", {}, "Commands"), this.commands);
    node.replaceChildren(this.counts, notes, this.baseline(), why, this.body, log);
    link.addEventListener("episodes", (event) => this.show(event.detail));
    link.addEventListener("notices", (event) => {
      // After a reconnection all arrive again.
      const fresh = event.detail.filter((notice) => notice.number > this.known);
      this.known = Math.max(this.known, ...fresh.map((notice) => notice.number));
      // The notices of a fold of a whole recording come sensor by sensor.
      const newest = (a, b) => b.run - a.run || b.from - a.from || b.number - a.number;
      this.notices = [...fresh, ...this.notices].sort(newest).slice(0, MAX_EPISODES);
      this.show(this.link.episodes);
    });
    link.addEventListener("status", ({ detail }) => {
      this.count(detail);
      this.holds(detail.sensors);
    });
    this.show([]);
  }

  // Of a twin of the user's own that has none yet: its file then has one, and the history is folded again with it.
  baseline() {
    const { commissioned, baseline_storable: storable } = this.charts.model;
    const said = element("p", { role: "status" }, "Alarms compare the innovations with white noise.");
    const ask = async (force) => {
      setText(said, "folding …");
      const answer = await post("api/baseline", { force });
      store.hidden = !answer.error;
      setText(said, answer.error ?? `Stored in ${answer.file}: alarms now report changes from it.`);
      anyway.hidden = !answer.error;
    };
    const store = element("button", { type: "button", class: "go", title: "Store the statistics of these innovations as normal; alarms then report changes", onclick: () => ask(false) }, "Store baseline");
    const anyway = element("button", { type: "button", class: "go", hidden: true, title: "Store it, marked with this reason", onclick: () => ask(true) }, "Store anyway");
    const node = element("section", { class: "baseline", "aria-label": "Baseline", hidden: commissioned || !storable }, element("header", {}, element("h3", {}, "Baseline"), store), said, anyway);
    return node;
  }

  // Measurement counts; those of each sensor in the tooltip.
  count({ counts }) {
    const found = KINDS.filter(([key]) => counts[key]).map(([key, name]) => [key, name, counts[key]]);
    if (!changed(this.counts, [found, counts.readings])) return;
    const whose = (key) => Object.entries(counts).filter(([name]) => name.startsWith(`${key} `)).map(([name, n]) => `${words(name.slice(key.length + 1))} ${n}`).join("\n");
    this.counts.replaceChildren(
      element("dt", {}, "measurements"), element("dd", {}, grouped(counts.readings ?? 0)),
      ...found.flatMap(([key, name, n]) => [element("dt", { title: whose(key) }, name), element("dd", { title: whose(key) }, `${grouped(n)}${key === "used" || !counts.readings ? "" : ` (${compact((100 * n) / counts.readings, 2)} %)`}`)]),
    );
  }

  // Attribute the change of each state between two times to its causes, the largest first.
  async explain(since, until) {
    this.change.replaceChildren(element("li", { class: "faint" }, "folding …"));
    const found = await get(`api/why?since=${since}&until=${until}`);
    if (found.error) return this.change.replaceChildren(element("li", { class: "error" }, found.error));
    this.change.replaceChildren(
      element("li", { class: "faint" }, `${clock(found.start)} – ${clock(found.end)}`),
      ...Object.entries(found.states).map(([name, state]) => element("li", {}, element("b", {}, words(name)), ` ${this.moved(state)}`)),
    );
    window.nisus.explained = (window.nisus.explained ?? 0) + 1;
  }

  // The audit log, newest first: who changed what, from where.
  async list() {
    const entries = await get("api/audit");
    const item = ({ at, user, role, address, path, body, revision }) => {
      const { command, gesture, ...fields } = body;
      const what = [command ?? path.replace(/^\/api\//, ""), ...Object.entries(fields).map(([key, value]) => `${key} ${typeof value === "object" ? JSON.stringify(value) : value}`)].join(", ");
      const when = new Date(1000 * at).toLocaleString("en-GB", { dateStyle: "short", timeStyle: "medium" });
      return element("li", { class: "event", dataset: { level: "info" } }, element("time", {}, when), element("span", {}, `${user}${role && role !== user ? ` (${role})` : ""}${address ? ` from ${address}` : ""}, run ${revision}: ${what}`));
    };
    this.commands.replaceChildren(...(entries.length ? entries.slice(-MAX_EPISODES).reverse().map(item) : [element("li", { class: "faint" }, entries.error ? "Nisus does not answer." : "None yet.")]));
  }

  moved({ unit, before, after, model, inputs, sensors, restarts, largest }) {
    const causes = [["model", model], ["restarts", restarts], ...Object.entries(inputs), ...Object.entries(sensors)].filter(([, change]) => change);
    causes.sort(([, a], [, b]) => Math.abs(b) - Math.abs(a));
    const signed = (value) => `${value < 0 ? "−" : "+"}${compact(Math.abs(value), 2)}`;
    const parts = causes.slice(0, MAX_CAUSES).map(([name, change]) => `${words(name)} ${signed(change)}`);
    const left = causes.length > MAX_CAUSES ? `, ${causes.length - MAX_CAUSES} more` : "";
    const [most] = largest;
    const once = most ? `; most at once: ${words(most.sensor)} at ${clock(most.t)}, ${signed(most.change)}` : "";
    return `${compact(before)} to ${compact(after)}${spaced(unit)}: ${parts.join(", ")}${left}${once}`;
  }

  // Held-out sensors have no episodes, but their offsets are shown.
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
    this.body.replaceChildren(
      element("h3", {}, open.length ? `Now (${open.length})` : `Now: no faults${this.held.length ? " in the sensors in use" : ""}`),
      list(open, (item) => this.entry(item)),
      this.held.length ? element("h3", {}, "Held out") : "",
      list(this.held, (text) => element("li", { class: "event held-out" }, element("span", {}, inChartTime(text, this.link.status.origin)))),
      over.length ? element("h3", {}, `Before (${over.length})`) : "",
      list(over.slice(0, MAX_EPISODES), (item) => this.entry(item)),
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
      "li", { class: "episode", dataset: { open: String(episode.end === null), severity: episode.severity ?? "", grade: episode.grade } },
      element("button", { type: "button", title: "Show in the charts", onclick: show }, element("time", {}, times), element("b", {}, `${words(episode.subject)}: ${CAUSES[episode.cause] ?? episode.cause}`)),
      element("p", {}, inChartTime(episode.text, this.link.status.origin)),
      element("button", { type: "button", class: "go", onclick: () => this.explain(episode.from, episode.to ?? this.charts.newest) }, "what moved the estimate"),
      element("a", { href: `alarms#${episode.help.split("#")[1]}`, target: "_blank" }, `about “${CAUSES[episode.cause] ?? episode.cause}”`),
    );
  }

  // Newest first, with a line between runs, which fold the same time again.
  event(notice, after) {
    const when = notice.from === null ? "" : clock(notice.from);
    const line = element("li", { class: "event", dataset: { level: notice.level } }, element("time", {}, when), element("span", {}, inChartTime(notice.text, this.link.status.origin)));
    return after && after.run !== notice.run ? [element("li", { class: "run-before" }, `run ${notice.run}`), line] : [line];
  }
}

// Notes of users at moments: a list with the episodes, and a field that opens in the charts.

const MAX_NOTE = 500; // characters

export class UserNotes {
  // reveal(): shows the charts, where they are behind another tab
  constructor(link, view, charts, reveal) {
    Object.assign(this, { link, view, charts, reveal });
    this.title = element("h3", {}, "Notes");
    this.list = element("ol", {});
    const add = element("button", { type: "button", class: "go", title: "Note at the cursor (N, or Alt-click in a chart)", onclick: () => this.write() }, "Add");
    this.node = element("section", { class: "notes", "aria-label": "Notes" }, element("header", {}, this.title, add), this.list);
    this.when = element("time", {});
    this.field = element("input", { type: "text", maxlength: MAX_NOTE, "aria-label": "Note", placeholder: "Note" });
    this.error = refusal();
    this.form = element(
      "form", { id: "note", popover: "manual", "aria-label": "Note at a moment", onsubmit: (event) => (event.preventDefault(), this.save()), onkeydown: (event) => event.key === "Escape" && this.close() },
      this.when, this.field, element("button", { type: "submit", class: "go" }, "Save"), element("button", { type: "button", onclick: () => this.close() }, "Cancel"), this.error,
    );
    document.body.append(this.form);
    charts.noting = (seconds, there) => this.write(seconds, there);
    link.addEventListener("annotations", () => this.show());
    this.show();
  }

  show() {
    const { annotations } = this.link;
    setText(this.title, annotations.length ? `Notes (${annotations.length})` : "Notes");
    const hint = element("li", { class: "faint" }, "N, or Alt-click in a chart, adds one.");
    this.list.replaceChildren(...(annotations.length ? annotations.map((note) => this.entry(note)) : [hint]));
  }

  entry(note) {
    const at = clock(note.from, 1);
    const go = () => (this.reveal(), this.view.goTo(note.from, this.charts.range, this.charts.newest));
    const edit = () => (go(), this.write(note.from, note));
    const remove = () => this.link.ask("DeleteAnnotation", { number: note.number });
    return element("li", { dataset: { number: note.number } },
      element("button", { type: "button", class: "at", title: "Show in the charts", onclick: go }, element("time", {}, at), element("span", {}, note.text)),
      element("button", { type: "button", title: "Edit", "aria-label": `Edit the note at ${at}`, onclick: edit }, "✎"),
      element("button", { type: "button", title: "Delete", "aria-label": `Delete the note at ${at}`, onclick: remove }, "×"));
  }

  // Open the field for a new note at a moment, or for a note of the list.
  write(seconds = this.charts.pointed, note = null) {
    const { charts } = this;
    if (!Number.isFinite(charts.newest)) return; // no measurement has arrived yet
    const from = note?.from ?? Math.min(charts.newest, Math.max(0, seconds));
    this.draft = charts.draft = { number: note?.number, from, text: note?.text ?? "" };
    setText(this.when, clock(from, 1));
    this.field.value = this.draft.text;
    this.error.hidden = true;
    this.reveal();
    this.form.showPopover();
    const box = charts.node.getBoundingClientRect();
    const left = charts.placeOf(from);
    // Beside its flag.
    const width = this.form.offsetWidth + 10;
    this.form.style.left = `${left + width < box.right ? left + 10 : Math.max(4, left - width)}px`;
    this.form.style.top = `${box.top + 24}px`;
    this.field.focus();
    charts.draw();
  }

  close() {
    this.charts.draft = null;
    this.form.hidePopover();
    this.charts.draw();
  }

  async save() {
    const { number, from } = this.draft;
    const at = number === undefined ? { at: Number(this.link.status.origin) / 1e9 + from } : { number };
    const reason = await this.link.ask("Annotate", { text: this.field.value, ...at });
    showText(this.error, reason);
    if (!reason) this.close();
  }
}
