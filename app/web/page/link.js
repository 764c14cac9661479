// Connection of the page to the twin: status, episodes, notices and chart points arrive here; commands leave here.

import { post } from "./http.js";
import { PageSocket } from "./socket.js";
import { unpack } from "./stream.js";

const STATUS_REPEAT_MS = 1000; // ms without news after which the last status is told again
const SETTLED_AFTER_MS = 700; // ms after the last edit or revision
const POINT_PERIOD_MS = 100; // ms between two times that are sent while the cursor is dragged

// Events: "status", "episodes", "annotations", "notices", "frames", "connection"; each with `detail`.
export class Link extends EventTarget {
  constructor(boot) {
    super();
    this.boot = boot;
    this.status = {};
    this.episodes = [];
    this.annotations = []; // notes of users
    this.streams = {}; // queries by name, to ask again after a break
    this.takers = {}; // by stream: take(header, seconds, columns)
    this.arrived = new Set(); // streams of the frames that are not drawn yet
    this.turned = -Infinity; // when something was edited, or folded anew
    this.line = new PageSocket({
      address: () => "api/stream",
      taken: (data) => this.take(data),
      changed: (state) => {
        this.tell("connection", state);
        if (state === "live") this.say({ streams: this.streams, pair: this.pair ?? null, at: this.at ?? null });
      },
    });
    // A twin whose source has ended has no news, but ages and answers that are waited for go on.
    setInterval(() => this.connected && this.told && performance.now() - this.told > STATUS_REPEAT_MS && this.tell("status", this.status), STATUS_REPEAT_MS);
    this.line.open();
  }

  get connected() {
    return Boolean(this.line.socket);
  }

  // Whether a drag is over: scores and likelihood curves are not computed for every value on the way.
  get settled() {
    return performance.now() - this.turned > SETTLED_AFTER_MS;
  }

  say(message) {
    this.line.send(JSON.stringify(message));
  }

  tell(type, detail) {
    if (type === "status") this.told = performance.now();
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  // Ask for a chart stream (app/charts/chart_stream.py) in place of the one of that name; null closes it.
  look(name, wanted, take) {
    if (wanted === null) {
      delete this.streams[name];
      delete this.takers[name];
    } else {
      this.streams[name] = wanted;
      this.takers[name] = take;
    }
    this.say({ streams: { [name]: wanted } });
  }

  // The belief over a pair of states now, told as "belief" as it changes; null for no more.
  watch(pair) {
    this.pair = pair;
    this.say({ pair });
  }

  // The time that the page shows, s; null is the newest row. Status ("moment"), belief and scene are those of that time.
  point(at) {
    if (at === (this.at ?? null)) return;
    this.at = at;
    this.pointing ??= setTimeout(() => {
      this.pointing = null;
      this.say({ at: this.at });
    }, POINT_PERIOD_MS);
  }

  take(data) {
    if (typeof data !== "string") {
      const [header, seconds, columns] = unpack(data);
      this.takers[header.stream]?.(header, seconds, columns);
      this.arrived.add(header.stream);
      return;
    }
    const message = JSON.parse(data);
    if (message.boot && message.boot !== this.boot) location.reload(); // another server, perhaps another twin
    if (message.status) {
      if ("revision" in message.status) this.turned = performance.now();
      Object.assign(this.status, message.status);
      // Of fields with many entries only the changed ones come.
      for (const [field, entries] of Object.entries(message.entries ?? {})) Object.assign(this.status[field], entries);
      this.tell("status", this.status);
    }
    if (message.episodes) this.tell("episodes", (this.episodes = message.episodes));
    if (message.annotations) this.tell("annotations", (this.annotations = message.annotations));
    if (message.notices) this.tell("notices", message.notices);
    if (message.belief) this.tell("belief", message.belief);
    if (message.error) console.error(message.error);
    if (message.frames) {
      this.tell("frames", this.arrived);
      this.arrived.clear();
      // The next ones when these are on the screen.
      requestAnimationFrame(() => this.say({ drawn: true }));
    }
  }

  // Ask something of the twin. Resolves to null, or to the reason why not.
  async ask(command, fields = {}) {
    this.turned = performance.now();
    return (await post("api/command", { command, ...fields })).error ?? null;
  }
}
