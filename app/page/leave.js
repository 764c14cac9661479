// From a twin's page to what else there is: the gallery, the recordings, and files that are dropped here.

import { $, setAttribute, setText } from "./dom.js";
import { drops } from "./drop.js";
import { Session, progress } from "./session.js";

const READ = 8000; // ms that a line stays

export class Leave {
  constructor(model, boot) {
    for (const id of ["gallery", "others"]) setAttribute($(id), "href", "/gallery");
    this.boot = boot;
    this.model = model;
    drops({ twins: () => this.twins(), say: (text, wrong) => this.say(text, wrong), follow: () => this.follow() });
    const go = (where) => location.assign(where);
    this.commands = [
      ["g", "gallery: another twin", () => go("/gallery")],
      ["", "recordings: open, download, delete", () => go("/gallery#recordings")],
    ];
  }

  // Those that could read a log, this one first.
  async twins() {
    const all = (await (await fetch("/api/gallery")).json()).filter((item) => item.log && !item.error);
    const short = (name) => name.split(/[\\/]/).pop().replace(/\.ya?ml$/, "");
    return all.map((item) => ({ ...item, short: short(item.name) })).sort((a, b) => (b.short === this.model.twin) - (a.short === this.model.twin));
  }

  // What becomes of a file that was dropped: while another twin is being started this page goes on.
  say(text, wrong = false) {
    setText($("toast"), text);
    $("toast").hidden = !text;
    $("toast").dataset.wrong = String(wrong);
    clearTimeout(this.timer);
    if (wrong) this.timer = setTimeout(() => this.say(""), READ);
  }

  follow() {
    this.session?.close();
    this.session = new Session(this.boot);
    this.session.addEventListener("state", ({ detail: { starting, failed } }) => {
      if (starting) setText($("toast"), `${starting.title}: ${progress(starting)}`);
      $("toast").hidden = !starting;
      if (starting) return;
      this.session.close();
      this.session = null;
      if (failed) this.say(`${failed.title} did not start. ${failed.text}`, true);
    });
  }
}
