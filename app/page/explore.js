// Explore: Rerun's viewer in a tab, started when it is first shown, asleep while it is hidden.

import { $, setText } from "./dom.js";
import { ExploreStream } from "./explore_stream.js";
import { Viewer } from "./rerun_viewer.js";

export class Explore {
  constructor(base, theme) {
    Object.assign(this, { base, theme });
    this.revisions = { newest: null, drawn: null };
  }

  async show() {
    if (this.stream) return this.stream.wake();
    if (this.starting) return;
    this.starting = true;
    try {
      this.viewer = await Viewer.open($("rerun"), $("before"), this.base, this.theme);
      this.stream = new ExploreStream({ viewer: this.viewer, changed: () => {}, told: (message) => this.told(message) });
      window.nisus.viewer = this.viewer;
    } catch (error) {
      this.note(`Rerun could not be loaded: ${error.message}`);
      this.starting = false;
    }
  }

  hide() {
    this.stream?.sleep();
  }

  told(message) {
    if (message.recording) this.revisions.announced = message.revision;
    if (message.status) this.revisions.newest = message.status.revision;
    if (message.drawn) {
      // Unless it lost patience with the viewer, that shows the recording announced last.
      if (!this.viewer.announced) this.revisions.drawn = this.revisions.announced;
      window.nisus.explored = (window.nisus.explored ?? 0) + 1;
      $("notice").hidden = true;
    }
    const { newest, drawn } = this.revisions;
    const late = drawn !== null && drawn !== undefined && newest !== null && drawn !== newest;
    setText($("behind"), late ? `Rerun still shows revision ${drawn}; drawing ${newest} …` : "");
    $("behind").hidden = !late;
    if (message.failed) this.note(`Rerun stopped: ${message.failed}. Reload the page.`);
  }

  note(text) {
    setText($("notice"), text);
    $("notice").hidden = false;
  }
}
