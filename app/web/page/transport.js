// The bar of time: pause, step, speed, where we are, health and events on a track; click to look there.

import { $, element, setAttribute, setText } from "./dom.js";
import { colour, fill, fineContext } from "./drawing.js";
import { clock, span } from "./format.js";
import { Stream } from "./stream.js";
import { SIGNS } from "./trust.js";

const HEALTH = ["waiting", "tracking", "advisory", "suspect", "degraded", "diverged", "stale"];
const SPEEDS = [["0.1×", 0.1], ["0.25×", 0.25], ["0.5×", 0.5], ["1×", 1], ["2×", 2], ["5×", 5], ["10×", 10], ["max", "inf"]];
const WINDOWS = [10, 30, 60, 120, 300, 900, 3600];
const [MIN_REPLAY_S, MAX_REPLAY_S] = [60, 3600]; // s of a replay whose speed nobody has chosen
const POINTS = 400;
const NEAR = 6; // px from a note

const offered = ([text, value]) => element("option", { value }, text);

// Choose a value of a list of numbers. Another than those that it has is added in its place among them, and returned.
function choose(select, value, text) {
  const known = [...select.options];
  const added = known.some((option) => option.value === value) ? null : offered([text, value]);
  if (added) select.insertBefore(added, known.find((option) => !(Number(option.value) < Number(value))));
  select.value = value;
  return added;
}

export class Transport {
  constructor(model, link, view, charts) {
    Object.assign(this, { model, link, view, charts });
    this.stream = charts.overview = new Stream(link, "overview");
    this.episodes = [];
    this.canvas = $("timeline");
    const spans = [...new Set([...WINDOWS, model.window])].sort((a, b) => a - b);
    $("window").replaceChildren(...spans.map((s) => element("option", { value: s }, s < 60 ? `${s} s` : s < 3600 ? `${s / 60} min` : s < 172800 ? `${s / 3600} h` : span(s))), element("option", { value: "all" }, "all"));
    $("window").value = model.recorded ? "all" : String(model.window);
    $("window").addEventListener("change", () => view.follow($("window").value === "all" ? null : Number($("window").value)));
    $("speed").replaceChildren(...SPEEDS.map(offered));
    $("speed").addEventListener("change", () => link.ask("Speed", { factor: $("speed").value === "inf" ? "inf" : Number($("speed").value) }));
    $("pause").addEventListener("click", () => this.pause());
    $("step").addEventListener("click", () => link.ask("Step"));
    $("follow").addEventListener("click", () => (this.ended ? view.show(...this.extent, view.at) : view.hold(charts.range)));
    this.canvas.addEventListener("pointerdown", (event) => this.press(event));
    this.canvas.addEventListener("pointermove", (event) => this.hover(event));
    this.canvas.addEventListener("keydown", (event) => this.keyed(event));
    this.stream.ask({ columns: ["health"], points: POINTS });
    link.addEventListener("frames", () => this.draw());
    link.addEventListener("episodes", (event) => {
      this.episodes = event.detail;
      this.draw();
    });
    link.addEventListener("annotations", () => this.draw());
    link.addEventListener("status", (event) => this.show(event.detail));
    view.addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  // The time span of the charts, also after a drag in a chart or a replay.
  showSpan() {
    const select = $("window");
    if (document.activeElement === select) return;
    const { view } = this;
    const width = view.following ? view.span : view.until - view.since;
    const value = width === null || this.whole ? "all" : String(Number(width.toPrecision(3)));
    const added = choose(select, value, span(Number(value)));
    if (!added) return;
    this.otherSpan?.remove();
    this.otherSpan = added;
  }

  // Ends of the track in seconds: of the whole recording where that is known.
  get ends() {
    const { x } = this.stream;
    const [first, last] = x.length ? [x[0], x[x.length - 1]] : [0, 1];
    const length = this.status?.length;
    return [Math.min(0, first), Math.max(last, typeof length === "number" ? length : last, first + 1)];
  }

  // From the first event to the last one folded, s.
  get extent() {
    return [this.ends[0], (Number(this.status.t) - Number(this.status.origin)) / 1e9];
  }

  // A recording that is folded has no newest row to follow.
  get ended() {
    return Boolean(this.status?.seekable && this.status.finished);
  }

  // Whether the charts show all of it.
  get whole() {
    return this.ended && this.charts.range[0] <= this.extent[0] && this.extent[1] <= this.charts.range[1];
  }

  // A replay is paused, or played again after its end; of a live source only the charts are held.
  pause() {
    if (this.ended) this.replay(this.view.at ?? this.extent[0]);
    else if (this.status?.seekable) this.link.ask("Pause", { paused: !this.status.paused });
    else this.view.hold(this.charts.range);
  }

  // Speed of a replay: that of the twin, or a power of ten of it where that would take hours.
  get pace() {
    const [start, end] = this.extent;
    const length = (end - start) / this.model.speed;
    return this.model.speed * (length > MAX_REPLAY_S ? 10 ** Math.floor(Math.log10(length / MIN_REPLAY_S)) : 1);
  }

  // Play from a moment on: the same log and fold, at the pace of the asset. At the end, from the start.
  async replay(from) {
    const [start, end] = this.extent;
    if (this.status.speed === "inf" || this.status.speed === null) await this.link.ask("Speed", { factor: this.pace });
    if (this.status.paused) await this.link.ask("Pause", { paused: false });
    await this.link.ask("Seek", { seconds: from < end ? from : start });
    this.view.follow(this.model.window);
  }

  show(status) {
    this.status = status;
    const { ended } = this;
    const held = ended || (status.seekable ? status.paused : !this.view.following);
    setText($("pause"), held ? "▶" : "❚❚");
    setAttribute($("pause"), "title", ended ? "Replay from the cursor (space)" : status.seekable ? (held ? "Continue (space)" : "Pause the replay (space)") : "Hold the charts (space)");
    $("step").hidden = $("speed").hidden = !status.seekable;
    $("step").disabled = !status.paused;
    if (status.seekable && document.activeElement !== $("speed")) {
      for (const speed of [...(ended ? [this.pace] : []), status.speed ?? 1]) choose($("speed"), String(speed), `${Number(speed).toLocaleString("en")}×`);
    }
    setText($("state"), status.finished ? "ended" : status.paused ? "paused" : "");
    const now = status.origin && status.t !== null ? this.now : NaN;
    setText($("now"), clock(now, 1));
  }

  get now() {
    return this.stream.x.at(-1) ?? NaN;
  }

  draw() {
    this.showSpan();
    $("follow").hidden = this.view.following || this.whole;
    setText($("follow"), this.ended ? "all" : "follow ▸");
    setAttribute($("follow"), "title", this.ended ? "Show the whole recording" : "Follow the newest data (F)");
    setText($("at"), this.view.at === null || this.now - this.view.at < 0.05 ? "" : `at ${clock(Math.min(this.view.at, this.now), 1)}`);
    const { canvas } = this;
    const [from, to] = this.ends;
    const seconds = Math.min(this.view.at ?? Infinity, Number.isFinite(this.now) ? this.now : from);
    const values = { "aria-valuemin": Math.floor(from), "aria-valuemax": Math.ceil(to), "aria-valuenow": Math.round(seconds), "aria-valuetext": clock(seconds) };
    for (const [name, value] of Object.entries(values)) setAttribute(canvas, name, value);
    const width = canvas.clientWidth;
    const ctx = fineContext(canvas);
    const [start, end] = this.ends;
    const place = (seconds) => ((seconds - start) / (end - start)) * width;
    ctx.fillStyle = colour("rule");
    ctx.fillRect(0, 14, width, 10);
    const { x } = this.stream;
    const health = this.stream.column("health");
    for (let k = 0; k < x.length; ) {
      let next = k + 1;
      while (next < x.length && health[next] === health[k]) next += 1;
      ctx.fillStyle = colour(`health-${HEALTH[health[k]] ?? "waiting"}`);
      const until = next < x.length ? place(x[next]) : place(x[x.length - 1]);
      ctx.fillRect(place(x[k]), 14, Math.max(1, until - place(x[k])), 10);
      k = next;
    }
    ctx.font = "11px system-ui, sans-serif";
    ctx.textAlign = "center";
    for (const episode of this.episodes) {
      ctx.fillStyle = colour(episode.grade === "advisory" ? "health-advisory" : "ink");
      ctx.fillText("▾", Math.min(width - 5, Math.max(5, place(episode.from))), 12);
    }
    // Notes of users: flags below the track.
    for (const { from } of this.charts.notes) {
      const left = Math.min(width - 5, Math.max(0, place(from)));
      fill(ctx, [[left, 26], [left + 6, 29], [left, 32]], "ink");
    }
    ctx.fillStyle = colour("ink");
    // What the charts show.
    const [since, until] = this.charts.range;
    ctx.strokeStyle = colour("ink");
    ctx.lineWidth = 1.5;
    const left = Math.max(0, place(since));
    ctx.strokeRect(left + 0.75, 11.75, Math.max(3, Math.min(width, place(until)) - left - 1.5), 14.5);
    if (this.view.at !== null) ctx.fillRect(Math.min(width - 2, Math.max(0, place(this.view.at) - 1)), 8, 2, 22);
    ctx.fillStyle = colour("faint");
    ctx.textAlign = "left";
    ctx.fillText(clock(start), 0, 38);
    ctx.textAlign = "right";
    ctx.fillText(clock(end), width, 38);
  }

  time(event) {
    const box = this.canvas.getBoundingClientRect();
    const [start, end] = this.ends;
    return start + (Math.min(1, Math.max(0, (event.clientX - box.left) / box.width))) * (end - start);
  }

  // The past is looked at; the future of a recording is sought.
  press(event) {
    const time = this.time(event);
    if (time <= this.now && !event.shiftKey) this.view.goTo(time, this.charts.range, this.now);
    else if (this.status?.seekable) {
      this.link.ask("Seek", { seconds: time });
      this.view.follow();
    }
  }

  hover(event) {
    const time = this.time(event);
    const near = this.episodes.filter((episode) => episode.from <= time && time <= (episode.to ?? Infinity));
    const future = time > this.now ? (this.status?.seekable ? ": click to play on from here" : "") : "";
    const [start, end] = this.ends;
    const notes = this.charts.notes.filter(({ from }) => Math.abs(from - time) * this.canvas.clientWidth < NEAR * (end - start));
    setAttribute(this.canvas, "title", [clock(time, 1) + future, ...notes.map((note) => `⚑ ${note.text}`), ...near.map((episode) => `${SIGNS[episode.grade] ?? SIGNS.suspect} ${episode.text}`)].join("\n"));
  }

  keyed(event) {
    const step = { ArrowLeft: -0.1, ArrowRight: 0.1, PageDown: -1, PageUp: 1 }[event.key];
    if (step) this.view.pan(step * (this.charts.range[1] - this.charts.range[0]), this.charts.range);
    else if (event.key === "Home") this.view.goTo(this.ends[0], this.charts.range);
    else if (event.key === "End") this.view.follow();
    else return;
    event.preventDefault();
  }
}
