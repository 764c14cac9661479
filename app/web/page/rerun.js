// The few messages of Rerun's viewer control that the page needs (viewer_control.proto of rerun 0.41), in protobuf's
// wire format: fields of a varint (0), 64 bits (1), bytes (2) or 32 bits (5).

import { PageSocket } from "./socket.js";

const text = new TextEncoder();
const words = new TextDecoder();

function varint(value) {
  const bytes = [];
  let rest = BigInt.asUintN(64, BigInt(value));
  do {
    const low = Number(rest & 127n);
    rest >>= 7n;
    bytes.push(rest ? low | 128 : low);
  } while (rest);
  return bytes;
}

function field(number, value) {
  if (typeof value === "bigint" || typeof value === "boolean") return [...varint(number << 3), ...varint(value)];
  const bytes = typeof value === "string" ? text.encode(value) : value;
  return [...varint((number << 3) | 2), ...varint(bytes.length), ...bytes];
}

// {field number: [values]}; a value is a bigint or bytes.
function fields(bytes) {
  const found = {};
  let at = 0;
  const number = () => {
    let value = 0n;
    for (let shift = 0n; ; shift += 7n) {
      const byte = bytes[at++];
      value |= BigInt(byte & 127) << shift;
      if (byte < 128) return value;
    }
  };
  while (at < bytes.length) {
    const key = Number(number());
    let value = null;
    if ((key & 7) === 0) value = BigInt.asIntN(64, number());
    else if ((key & 7) === 1) at += 8;
    else if ((key & 7) === 5) at += 4;
    else {
      const length = Number(number());
      value = bytes.subarray(at, at + length);
      at += length;
    }
    (found[key >> 3] ??= []).push(value);
  }
  return found;
}

const string = (bytes) => (bytes ? words.decode(bytes) : null);

export const PAUSED = 1n; // play states; FOLLOWING keeps to the newest row
export const FOLLOWING = 3n;

// {active, recordings: [{id, timeline, time, play, ends: {timeline: last time}}]}; times are bigints or null.
function readState(bytes) {
  const state = fields(bytes);
  const recordings = (state[3] ?? []).map((entry) => {
    const recording = fields(entry);
    const cursor = recording[3] ? fields(recording[3][0]) : {};
    const timeline = cursor[1] ? string(fields(cursor[1][0])[1]?.[0]) : null;
    const ends = {};
    for (const item of recording[2] ?? []) {
      const known = fields(item);
      const name = string(fields(known[1][0])[1]?.[0]);
      if (known[3]) ends[name] = fields(known[3][0])[2]?.[0] ?? 0n;
    }
    const time = cursor[3] ? (fields(cursor[3][0])[1]?.[0] ?? 0n) : null;
    return { id: string(recording[1]?.[0]), timeline, time, play: recording[5]?.[0] ?? null, ends };
  });
  return { active: string(state[2]?.[0]), recordings };
}

function closeRecordings(ids) {
  const list = ids.flatMap((id) => field(1, id));
  return new Uint8Array(field(1, field(1 + 2, list)));
}

// A cursor that follows has no time of its own: given one, the viewer would be paused there.
export function setTimeCursor(id, timeline, time, play) {
  const place = play === FOLLOWING ? [] : field(3, field(1, time));
  const request = [...field(1, id), ...field(2, field(1, timeline)), ...place, ...field(5, play)];
  return new Uint8Array(field(6, request));
}

// Rerun's web viewer in a canvas of this page. It has no connection of its own: the page hands its data over.

const CHANNEL = "nisus";
const FEED_TIMEOUT_MS = 30000; // ms until bytes must have been taken in

const frame = () => new Promise((resolve) => requestAnimationFrame(resolve));

function loadScript(url) {
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = url;
    script.onload = resolve;
    script.onerror = () => reject(new Error(`${url} was not served`));
    document.head.append(script);
  });
}

async function fetched(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(await answer.text());
  return answer;
}

// By default a browser drops what WebGL has drawn as soon as it is on the screen, and then nobody can copy it.
function keepPicture(canvas) {
  const getContext = canvas.getContext.bind(canvas);
  canvas.getContext = (kind, options) => getContext(kind, { ...options, preserveDrawingBuffer: true });
}

export class Viewer {
  // cover: a canvas over the viewer's, hidden; see `hold`.
  static async open(canvas, cover, base, theme) {
    const wasm = await fetched(`${base}/re_viewer_bg.wasm`);
    await loadScript(`${base}/re_viewer.js`);
    const viewer = new Viewer(canvas, cover);
    await wasm_bindgen({ module_or_path: wasm });
    viewer.handle = new wasm_bindgen.WebHandle({
      url: [],
      hide_welcome_screen: true,
      persist: false,
      theme,
      check_for_updates_on_startup: false,
      memory_limit: "1GB",
      enable_history: false,
      notebook: false,
      panel_state_overrides: { top: "Hidden", blueprint: "Hidden", selection: "Hidden" },
    });
    keepPicture(canvas);
    await viewer.handle.start(canvas);
    viewer.handle.open_channel(CHANNEL, "Nisus");
    return viewer;
  }

  constructor(canvas, cover) {
    this.canvas = canvas;
    this.cover = cover;
    this.id = null;
    this.frames = 0n;
    this.announced = false;
    this.kept = null;
  }

  get broken() {
    return this.handle.has_panicked() ? this.handle.panic_message() ?? "unknown" : null;
  }

  state() {
    return readState(this.handle.viewer_state());
  }

  // Another recording follows: note where the user is, to come back to it.
  announce(id) {
    if (this.id !== null) this.hold();
    const { active, recordings } = this.state();
    const shown = recordings.find((recording) => recording.id === active);
    // Once only: a revision that is overtaken by the next has no place of its own yet.
    if (!this.announced && shown && shown.time !== null && shown.play !== FOLLOWING) this.kept = shown;
    this.id = id;
    this.frames = 0n;
    this.announced = true;
  }

  // The viewer shows another recording before it has its rows and colours: until then the last picture covers it.
  hold() {
    this.cover.width = this.canvas.width;
    this.cover.height = this.canvas.height;
    this.cover.getContext("2d").drawImage(this.canvas, 0, 0);
    this.cover.hidden = false;
  }

  // Hand bytes over and wait until the viewer has drawn them. Resolves to the milliseconds that took.
  async feed(bytes) {
    const begun = performance.now();
    const { id } = this;
    this.frames += 1n;
    this.handle.send_rrd_to_channel(CHANNEL, bytes);
    // The viewer takes in only so much between two frames.
    while (performance.now() - begun < FEED_TIMEOUT_MS) {
      await frame();
      if (this.broken) throw new Error(this.broken);
      const { active, recordings } = this.state();
      const taken = recordings.find((recording) => recording.id === id)?.ends.frame ?? 0n;
      if (taken < this.frames) continue;
      if (!this.announced) break;
      if (active === id) {
        await this.arrive(recordings);
        break;
      }
    }
    await frame();
    this.cover.hidden = true;
    return performance.now() - begun;
  }

  // The announced recording is shown: go to where the user was, and close those before.
  async arrive(recordings) {
    this.announced = false;
    const { id, kept } = this;
    this.kept = null;
    // After seeking back, the place where the user was is yet to come: then the charts follow.
    const end = recordings.find((recording) => recording.id === id)?.ends[kept?.timeline] ?? 0n;
    if (kept?.timeline && kept.time <= end) await this.control(setTimeCursor(id, kept.timeline, kept.time, kept.play));
    const old = recordings.map((recording) => recording.id).filter((other) => other !== id);
    if (old.length) await this.control(closeRecordings(old));
  }

  async control(request) {
    try {
      await this.handle.viewer_control(request);
    } catch (error) {
      console.warn("Rerun's viewer refused:", error);
    }
  }
}

// The stream of frames for Rerun, for as long as somebody can see them.

const DRAWING_SHARE = 0.5; // part of the time that drawing may take; the panel beside it needs the rest
const SLOW_PICTURE_MS = 1000; // ms from which on a picture is dear, as where no graphics card draws it
const SLOW_DRAWING_SHARE = 0.2; // then the twin itself may need the processor
const MAX_REST = 8000; // ms

export class ExploreStream {
  // told(message): JSON messages
  constructor({ viewer, told }) {
    this.viewer = viewer;
    this.told = told;
    this.layout = true;
    // One message after the other: each is drawn before the next is looked at.
    let queue = Promise.resolve();
    this.line = new PageSocket({
      address: () => `rerun/stream?layout=${this.layout ? 1 : 0}&theme=${document.documentElement.dataset.theme}`,
      taken: (data, socket) => (queue = queue.then(() => this.take(socket, data)).catch((error) => this.fail(error))),
      changed: () => {},
    });
    this.line.open();
  }

  sleep(asleep) {
    this.line.sleep(asleep);
  }

  async take(socket, data) {
    if (this.line.socket !== socket) return;
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.recording) this.viewer.announce(message.recording);
      // What the user just asked for is worth a picture at once.
      const revision = message.status?.revision ?? this.revision;
      if (revision !== this.revision && this.resting) this.ask(socket);
      this.revision = revision;
      this.told(message);
      return;
    }
    const took = await this.viewer.feed(new Uint8Array(data));
    this.layout = false;
    this.told({ drawn: true });
    const share = took < SLOW_PICTURE_MS ? DRAWING_SHARE : SLOW_DRAWING_SHARE;
    this.resting = setTimeout(() => this.ask(socket), Math.min(MAX_REST, took * (1 / share - 1)));
  }

  // Ask for the next frame.
  ask(socket) {
    clearTimeout(this.resting);
    this.resting = null;
    if (socket.readyState === WebSocket.OPEN) socket.send("drawn");
  }

  fail(error) {
    const reason = this.viewer.broken;
    console.error(reason ?? error);
    this.line.close("failed");
    this.told({ failed: String(reason ?? error) });
  }
}
