// Recordings of bundled twins, from their public sources: host, size and licence, and after a second click the download.

import { element, setText } from "./dom.js";
import { size } from "./format.js";
import { get, post } from "./http.js";

const POLL_MS = 300;

export class Downloads {
  // `arrived(twin)` is called once a recording is there.
  constructor(arrived) {
    Object.assign(this, { arrived, recordings: [], job: null, drawn: [] });
    this.offer = this.offer.bind(this);
  }

  // The recordings; none without the extension that gets them.
  async ask() {
    this.drawn = [];
    this.take(await get("api/gallery/data"));
  }

  take({ recordings, job }) {
    Object.assign(this, { recordings: recordings ?? this.recordings, job: job ?? this.job });
    if (this.job?.state !== "running") return;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.poll(), POLL_MS);
  }

  async poll() {
    this.take(await get("api/gallery/data"));
    for (const draw of this.drawn) draw();
    if (this.job.state === "done") this.arrived(this.twin);
  }

  // The element for the card of a twin whose recording is missing.
  offer(item) {
    const recording = this.recordings.find(({ twins }) => twins.includes(item.name));
    if (!recording) return null;
    const { name, host, bytes, licence, source, by_hand: byHand } = recording;
    const text = element("p", { role: "status" });
    const wrong = element("p", { class: "error", role: "alert" });
    const ask = element("button", { type: "button", class: "go", "aria-label": `Get recording of ${item.name}`, onclick: () => asked(true) }, "Get recording");
    const yes = element("button", { type: "button", class: "go", onclick: () => begin() }, "Download");
    const no = element("button", { type: "button", class: "go", onclick: () => asked(false) }, "Not now");
    const link = element("a", { href: source, target: "_blank", rel: "noreferrer" }, source);
    const asked = (really) => {
      text.replaceChildren(...(!really ? [] : byHand ? [`${byHand} `, link] : [`From ${host}: ${size(bytes)}, licence ${licence}. `, link]));
      ask.hidden = really;
      no.hidden = !really;
      yes.hidden = !really || Boolean(byHand);
      if (really) (byHand ? no : yes).focus();
    };
    const begin = async () => {
      this.twin = item.name;
      const answer = await post("api/gallery/data/get", { name });
      if (answer.error) return setText(wrong, answer.error);
      this.take(answer);
      for (const draw of this.drawn) draw();
    };
    const draw = () => {
      const own = this.job?.name === name ? this.job : null;
      const runs = own?.state === "running";
      if (!runs && !ask.disabled) return;
      asked(false);
      ask.disabled = runs;
      setText(text, runs ? `Downloading: ${own.doing} …` : "");
      setText(wrong, own?.error ?? "");
    };
    asked(false);
    draw();
    this.drawn.push(draw);
    return element("div", { class: "recording" }, text, wrong, element("div", { class: "confirm" }, ask, yes, no));
  }
}
