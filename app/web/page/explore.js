// Explore: Rerun's viewer in a tab, started when it is first shown, asleep while it is hidden.

import { $, showText } from "./dom.js";
import { span } from "./format.js";
import { ExploreStream, FOLLOWING, PAUSED, setTimeCursor, Viewer } from "./rerun.js";

const MAX_LAG_S = 1; // s by which Rerun may be behind without a word

export class Explore {
  // page: {link, view, charts}, whose time it shares; heard(status): in a window of its own, which has no link
  constructor(base, theme, page) {
    Object.assign(this, { base, theme, page });
    this.revisions = { newest: null, drawn: null };
  }

  async show() {
    if (this.stream) {
      this.time?.wake();
      return this.stream.sleep(false);
    }
    if (this.starting) return;
    this.starting = true;
    try {
      this.viewer = await Viewer.open($("rerun"), $("before"), this.base, this.theme);
      this.stream = new ExploreStream({ viewer: this.viewer, told: (message) => this.told(message) });
      window.nisus.viewer = this.viewer;
      this.time = window.nisus.exploreTime = new ExploreTime(this.viewer, this.page);
      this.time.wake();
    } catch (error) {
      showText($("notice"), `Rerun could not be loaded: ${error.message}`);
      this.starting = false;
    }
  }

  hide() {
    this.time?.sleep();
    this.stream?.sleep(true);
  }

  told(message) {
    if (message.recording) this.revisions.announced = message.revision;
    if (message.status) {
      this.revisions.newest = message.status.revision;
      this.page.heard?.({ ...message.status, origin: message.origin });
    }
    if (message.drawn) {
      // Unless it lost patience with the viewer, that shows the recording announced last.
      if (!this.viewer.announced) this.revisions.drawn = this.revisions.announced;
      window.nisus.explored = (window.nisus.explored ?? 0) + 1;
      $("notice").hidden = true;
    }
    const { newest, drawn } = this.revisions;
    const late = drawn !== null && drawn !== undefined && newest !== null && drawn !== newest;
    const lag = this.time?.lag ?? 0;
    const text = late ? `Rerun still shows revision ${drawn}; drawing ${newest} …` : lag > MAX_LAG_S ? `Rerun is ${span(lag)} behind` : "";
    showText($("behind"), text);
    if (message.failed) showText($("notice"), `Rerun stopped: ${message.failed}. Reload the page.`);
  }
}

// One time for page and Rerun: scrubbing there moves the page's charts, going somewhere on the page moves Rerun's
// cursor, and what follows the newest row here follows it there.

const TIMELINE = "time"; // on which Rerun's rows stand, ns
const CURSOR_POLL_MS = 200; // ms between two looks at Rerun's cursor
const CURSOR_HOLD_MS = 2000; // ms in which Rerun's older cursor is not taken for a new one

class ExploreTime {
  constructor(viewer, { link, view, charts }) {
    Object.assign(this, { viewer, link, view, charts });
    this.known = null; // {time, play} of Rerun's cursor, as it was read or set last
    this.wanted = null; // the same as it was set, until Rerun has it
    view.addEventListener("change", () => this.leading || this.push());
  }

  // While somebody sees it.
  wake() {
    this.timer ??= setInterval(() => this.look(), CURSOR_POLL_MS);
    this.known = null;
  }

  sleep() {
    clearInterval(this.timer);
    this.timer = null;
  }

  // Rerun's cursor, if it shows our timeline of the newest recording.
  get cursor() {
    const { viewer } = this;
    if (viewer.announced || viewer.broken) return null;
    const { active, recordings } = viewer.state();
    const shown = recordings.find((item) => item.id === active && item.id === viewer.id);
    return shown?.timeline === TIMELINE && shown.time !== null ? shown : null;
  }

  get origin() {
    return BigInt(this.link.status.origin ?? 0);
  }

  look() {
    const found = this.cursor;
    if (!found) return;
    this.end = found.ends[TIMELINE];
    const { time, play } = found;
    if (this.known === null) return this.begin(time, play);
    const same = (play === FOLLOWING && this.known.play === FOLLOWING) || (time === this.known.time && play === this.known.play);
    if (this.wanted) {
      const arrived = play === this.wanted.play && (play === FOLLOWING || time === this.wanted.time);
      if (!arrived && performance.now() < this.wanted.until) return;
      this.wanted = null;
      this.known = { time, play };
      return;
    }
    this.known = { time, play };
    if (same) return;
    this.leading = true;
    if (play === FOLLOWING) this.view.follow();
    else this.view.goTo(Number(time - this.origin) / 1e9, this.charts.range, this.charts.newest);
    this.leading = false;
  }

  // Just come to be seen: the page's time holds.
  begin(time, play) {
    this.known = { time, play };
    if (this.view.following !== (play === FOLLOWING) || !this.view.following) this.push();
  }

  push() {
    const { viewer, view } = this;
    if (!this.timer || this.known === null || this.end === undefined || viewer.announced) return;
    const asked = view.following ? this.end : this.origin + BigInt(Math.round(view.at * 1e9));
    const time = asked < this.end ? asked : this.end;
    const play = view.following ? FOLLOWING : PAUSED;
    this.wanted = { time, play, until: performance.now() + CURSOR_HOLD_MS };
    viewer.control(setTimeCursor(viewer.id, TIMELINE, time, play));
  }

  // By how much Rerun's newest row is older than the twin's, s.
  get lag() {
    const now = this.link.status.t;
    return typeof now === "number" && this.end !== undefined ? (now - Number(this.end)) / 1e9 : 0;
  }
}
