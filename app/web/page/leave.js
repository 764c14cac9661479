// From a twin's page to what else there is: the gallery, the recordings, and files that are dropped here.

import { named } from "./card.js";
import { $, element, setAttribute, setText } from "./dom.js";
import { drops } from "./drop.js";
import { post, progress, Session } from "./session.js";

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

  // A link of another twin was opened: what runs goes on, unless that is started. The address stays, and with it the
  // moment to which the other twin's page goes.
  async offer(twin, reason) {
    const all = await fetch("/api/gallery").then((answer) => answer.json()).catch(() => []);
    const item = named(all, twin);
    if (!item) return this.say(`${reason}. No twin of that name can be started here`, true);
    const start = async () => {
      const answer = await post("/api/gallery/start", { twin: item.name });
      if (answer.error) this.say(answer.error, true);
      else this.follow();
    };
    this.say(`${reason}. `);
    $("toast").append(
      element("button", { type: "button", class: "go", onclick: start }, `Start ${twin}`),
      element("button", { type: "button", class: "go", onclick: () => (history.replaceState(null, "", location.pathname), this.say("")) }, `Stay with ${this.model.twin}`),
    );
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
