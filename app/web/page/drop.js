// Files that are dropped on the page: sent in pieces to the folder of recordings, then opened.

import { element, setText } from "./dom.js";
import { post } from "./session.js";

const RECORDING = ".rrd";

// `twins` gives the names of those that could read a log, the likeliest first; `say` tells what goes on and what not,
// `follow` how it goes with what is being opened.
export function drops({ twins, say, follow }) {
  const over = element("div", { class: "drop-here", hidden: true }, element("p", {}, "Drop it: a recording opens for review, a log is read by a twin"));
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

  // Keep all of them, then open the first.
  async function take(given, twin) {
    const kept = [];
    for (const file of given) {
      const answer = await send(file, (share) => say(`${file.name}: ${Math.round(100 * share)} %`));
      if (answer.error) return say(answer.error, true);
      kept.push(answer.name);
    }
    say("");
    if (kept.length) open(kept[0], !kept[0].endsWith(RECORDING), twin);
  }

  async function open(name, log, twin) {
    const reader = log ? (twin ?? (await choose(name, await twins()))) : null;
    if (log && !reader) return;
    const answer = await post("/api/gallery/recordings/open", log ? { name, twin: reader } : { name });
    say(answer.error ?? "", Boolean(answer.error));
    if (!answer.error) follow();
  }
  return { take, open };
}

async function send(file, tell) {
  const { piece } = await (await fetch("/api/gallery/recordings")).json();
  for (let offset = 0; ; offset += piece) {
    const last = offset + piece >= file.size;
    const query = new URLSearchParams({ name: file.name, offset, ...(last ? { last: 1 } : {}) });
    let answer;
    try {
      const sent = await fetch(`/api/gallery/recordings/drop?${query}`, {
        method: "POST", headers: { "Content-Type": "application/octet-stream" }, body: file.slice(offset, offset + piece),
      });
      answer = await sent.json();
    } catch {
      answer = { error: `${file.name}: it could not be sent` };
    }
    if (answer.error || last) return answer;
    tell(Math.min(1, (offset + piece) / file.size));
  }
}

// Which twin is to read a log; null if none after all.
function choose(name, twins) {
  return new Promise((done) => {
    const dialog = element("dialog", { class: "choose", "aria-label": "Which twin reads it?" });
    const close = (value) => {
      dialog.close();
      dialog.remove();
      done(value);
    };
    dialog.append(
      element("h2", {}, "Which twin reads it?"), element("p", { class: "faint" }, `${name} takes the place of the twin's own recording.`),
      element("ul", {}, ...twins.map((twin) => element("li", {}, element("button", { type: "button", onclick: () => close(twin.name) }, element("b", {}, twin.short), " ", element("span", { class: "faint" }, twin.title))))),
      element("button", { type: "button", class: "go", onclick: () => close(null) }, "Cancel"),
    );
    if (!twins.length) setText(dialog.querySelector("p"), "No twin here reads logs.");
    dialog.addEventListener("cancel", () => close(null));
    document.body.append(dialog);
    dialog.showModal();
  });
}
