// One time for page and Rerun: scrubbing there moves the page's charts, going somewhere on the page moves Rerun's
// cursor, and what follows the newest row here follows it there.

import { FOLLOWING, PAUSED, setTimeCursor } from "./rerun_wire.js";

const TIMELINE = "time"; // on which Rerun's rows stand, ns
const LOOK = 200; // ms between two looks at Rerun's cursor
const PATIENCE = 2000; // ms in which Rerun's older cursor is not taken for a new one

export class ExploreTime {
  constructor(viewer, { link, view, charts }) {
    Object.assign(this, { viewer, link, view, charts });
    this.known = null; // {time, play} of Rerun's cursor, as it was read or set last
    this.wanted = null; // the same as it was set, until Rerun has it
    view.addEventListener("change", () => this.leading || this.push());
  }

  // While somebody sees it.
  wake() {
    this.timer ??= setInterval(() => this.look(), LOOK);
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
    this.wanted = { time, play, until: performance.now() + PATIENCE };
    viewer.control(setTimeCursor(viewer.id, TIMELINE, time, play));
  }

  // By how much Rerun's newest row is older than the twin's, s.
  get lag() {
    const now = this.link.status.t;
    return typeof now === "number" && this.end !== undefined ? (now - Number(this.end)) / 1e9 : 0;
  }
}
