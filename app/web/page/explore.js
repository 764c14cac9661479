// Explore: Rerun's viewer in a tab, started when it is first shown, asleep while it is hidden.

import { $, setText } from "./dom.js";
import { ExploreStream } from "./explore_stream.js";
import { ExploreTime } from "./explore_time.js";
import { span } from "./format.js";
import { Viewer } from "./rerun_viewer.js";

const LATE = 1; // s by which Rerun may be behind without a word

export class Explore {
  // page: {link, view, charts}, whose time it shares; heard(status): in a window of its own, which has no link
  constructor(base, theme, page) {
    Object.assign(this, { base, theme, page });
    this.revisions = { newest: null, drawn: null };
  }

  async show() {
    if (this.stream) {
      this.time?.wake();
      return this.stream.wake();
    }
    if (this.starting) return;
    this.starting = true;
    try {
      this.viewer = await Viewer.open($("rerun"), $("before"), this.base, this.theme);
      this.stream = new ExploreStream({ viewer: this.viewer, changed: () => {}, told: (message) => this.told(message) });
      window.nisus.viewer = this.viewer;
      this.time = window.nisus.exploreTime = new ExploreTime(this.viewer, this.page);
      this.time.wake();
    } catch (error) {
      this.note(`Rerun could not be loaded: ${error.message}`);
      this.starting = false;
    }
  }

  hide() {
    this.time?.sleep();
    this.stream?.sleep();
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
    const text = late ? `Rerun still shows revision ${drawn}; drawing ${newest} …` : lag > LATE ? `Rerun is ${span(lag)} behind` : "";
    setText($("behind"), text);
    $("behind").hidden = !text;
    if (message.failed) this.note(`Rerun stopped: ${message.failed}. Reload the page.`);
  }

  note(text) {
    setText($("notice"), text);
    $("notice").hidden = false;
  }
}
