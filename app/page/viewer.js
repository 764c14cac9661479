// Rerun's web viewer in a canvas of this page. It has no connection of its own: what it shows is handed to it.

import { closeRecordings, readState, setTimeCursor } from "./wire.js";

const SCRUBBED = 2_000_000_000n; // ns before the end, from which on the user has chosen the time and we keep it
const CHANNEL = "nisus";

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

export class Viewer {
  static async open(canvas, base, theme) {
    const wasm = await fetched(`${base}/re_viewer_bg.wasm`);
    await loadScript(`${base}/re_viewer.js`);
    const viewer = new Viewer();
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
    await viewer.handle.start(canvas);
    viewer.handle.open_channel(CHANNEL, "Nisus");
    return viewer;
  }

  constructor() {
    this.announced = null;
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
    const { active, recordings } = this.state();
    const shown = recordings.find((recording) => recording.id === active);
    const scrubbed = shown && shown.time !== null && shown.end !== null && shown.end - shown.time > SCRUBBED;
    if (scrubbed) this.kept = shown;
    this.announced = id;
  }

  // Hand bytes over and wait until the viewer has drawn them. Resolves to the milliseconds that took.
  async feed(bytes) {
    const begun = performance.now();
    this.handle.send_rrd_to_channel(CHANNEL, bytes);
    await frame();
    await frame();
    if (this.announced !== null) await this.swap();
    return performance.now() - begun;
  }

  async swap() {
    const id = this.announced;
    for (let turn = 0; turn < 100; turn++) {
      if (this.announced !== id) return;
      if (this.state().active === id) break;
      await pause(20);
    }
    this.announced = null;
    const { active, recordings } = this.state();
    if (active !== id) return;
    const kept = this.kept;
    this.kept = null;
    if (kept?.timeline) await this.control(setTimeCursor(id, kept.timeline, kept.time));
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
