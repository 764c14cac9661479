// Recordings of bundled twins, from their public sources: host, size and licence, and after a second click the download.

import { element } from "./dom.js";
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
    for (const [name, draw] of this.drawn) if (name === this.job?.name) draw();
    clearTimeout(this.timer);
    if (this.job?.state === "running") this.timer = setTimeout(() => this.poll(), POLL_MS);
  }

  async poll() {
    this.take(await get("api/gallery/data"));
    if (this.job.state === "done") this.arrived(this.twin);
  }

  // The element for the card of a twin whose recording is missing.
  offer(item) {
    const recording = this.recordings.find(({ twins }) => twins.includes(item.name));
    if (!recording) return null;
    const { name, host, bytes, licence, source, by_hand: byHand } = recording;
    const node = element("div", { class: "recording", role: "status" });
    const button = (text, onclick) => element("button", { type: "button", class: "go", "aria-label": `${text}: ${item.name}`, onclick }, text);
    const begin = async () => {
      this.twin = item.name;
      const answer = await post("api/gallery/data/get", { name });
      if (answer.error) draw(false, answer.error);
      else this.take(answer);
    };
    const draw = (asked = false, refused = null) => {
      const { state, doing, error } = this.job?.name === name ? this.job : {};
      const link = element("a", { href: source, target: "_blank", rel: "noreferrer" }, source);
      const wrong = refused ?? error;
      if (state === "running") node.replaceChildren(`Downloading: ${doing} …`);
      else if (asked) node.replaceChildren(byHand ?? `From ${host}: ${size(bytes)}, licence ${licence}.`, " ", link, element("div", { class: "confirm" }, byHand ? null : button("Download", begin), button("Not now", () => draw())));
      else node.replaceChildren(wrong ? element("p", { class: "error", role: "alert" }, wrong) : "", button("Get recording", () => draw(true)));
      if (asked) node.querySelector("button").focus();
    };
    draw();
    this.drawn.push([name, draw]);
    return node;
  }
}
