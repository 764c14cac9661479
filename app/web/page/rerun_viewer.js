// Rerun's web viewer in a canvas of this page. It has no connection of its own: what it shows is handed to it.

import { FOLLOWING, closeRecordings, readState, setTimeCursor } from "./rerun_wire.js";

const CHANNEL = "nisus";
const PATIENCE = 30000; // ms until bytes must have been taken in

const frame = () => new Promise((resolve) => requestAnimationFrame(resolve));
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

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

  // The viewer shows another recording before it has its rows and colours: until then, what was shown last covers it.
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
    while (performance.now() - begun < PATIENCE) {
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
