// Files dropped on the page: sent in pieces to the folder of recordings, then opened. A recording opens for review, a log
// with its signals (dropped_log.js).

import { element } from "./dom.js";
import { get, post } from "./http.js";

const RECORDING = ".rrd";
export const DATABASE = ".dbc";

const ending = (name) => name.slice(name.lastIndexOf(".")).toLowerCase();

// `say` reports progress and errors, `follow` the progress of opening, `show` opens a log where it was dropped.
export function drops({ say, follow, show = (name) => location.assign(`gallery#log=${encodeURIComponent(name)}`), described = () => false }) {
  const over = element("div", { class: "drop-here", hidden: true }, element("p", {}, "Drop to open: a recording for review, a log with its signals, a DBC for CAN logs"));
  document.body.append(over);
  let depth = 0;
  const files = (event) => event.dataTransfer?.types.includes("Files");
  const cover = (change) => {
    depth = Math.max(0, depth + change);
    over.hidden = depth === 0;
  };
  addEventListener("dragenter", (event) => files(event) && (event.preventDefault(), cover(1)));
  addEventListener("dragleave", (event) => files(event) && cover(-1));
  addEventListener("dragover", (event) => files(event) && event.preventDefault());
  addEventListener("drop", (event) => {
    if (!files(event)) return;
    event.preventDefault();
    depth = 0;
    cover(0);
    const on = event.target.closest?.("[data-log]")?.dataset.name;
    take([...event.dataTransfer.files], on);
  });

  // Keep all of them, then open the first recording or log; DBC files go first, so that a log is read with them.
  async function take(given, twin) {
    const kept = [];
    for (const file of given.toSorted((a, b) => (ending(b.name) === DATABASE) - (ending(a.name) === DATABASE))) {
      say(`${file.name}: sending`);
      const answer = await send(file, (share) => say(`${file.name}: ${Math.round(100 * share)} %`));
      if (answer.error) return say(answer.error, true);
      kept.push(answer.name);
    }
    say("");
    const first = kept.find((name) => ending(name) !== DATABASE);
    if (first) open(first, twin);
    else if (kept.length && !described(kept)) say(`${kept.join(", ")} is kept: CAN logs that have its ids are read with it`);
  }

  async function open(name, twin) {
    if (ending(name) !== RECORDING && !twin) return show(name);
    const answer = await post("api/gallery/recordings/open", twin ? { name, twin } : { name });
    say(answer.error ?? "", Boolean(answer.error));
    if (!answer.error) follow();
  }
  return { take, open };
}

async function send(file, tell) {
  const { piece, error } = await get("api/gallery/recordings");
  if (error) return { error };
  for (let offset = 0; ; offset += piece) {
    const last = offset + piece >= file.size;
    const query = new URLSearchParams({ name: file.name, offset, ...(last ? { last: 1 } : {}) });
    let answer;
    try {
      const sent = await fetch(`api/gallery/recordings/drop?${query}`, {
        method: "POST", headers: { "Content-Type": "application/octet-stream" }, body: file.slice(offset, offset + piece),
      });
      answer = await sent.json();
    } catch {
      answer = { error: `${file.name}: it could not be sent; check that Nisus runs, and drop it again` };
    }
    if (answer.error || last) return answer;
    tell(Math.min(1, (offset + piece) / file.size));
  }
}
