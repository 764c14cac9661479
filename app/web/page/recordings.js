// The list of recordings and logs: open, download, delete once it was asked again, and drop a file to add one.

import { element, setText } from "./dom.js";
import { compact, spaced, span } from "./format.js";
import { post } from "./session.js";

const REST = 1500; // ms, while some file is still being looked through
const POLL_MS = 5000;

// `ask` has open(name, log) and say(text): what goes wrong.
export class Recordings {
  constructor(node, ask) {
    Object.assign(this, { node, ask, key: null });
    this.list = element("ol", { class: "files" });
    this.where = element("p", { class: "faint where" });
    this.choose = element("input", { type: "file", multiple: true, hidden: true, onchange: () => this.ask.drop([...this.choose.files]) });
    this.node.replaceChildren(
      element("header", { class: "panel-head" }, element("h2", {}, "Recordings"), element("span", { class: "space" }),
        element("button", { type: "button", class: "go", onclick: () => this.choose.click(), title: "Add a recording (.rrd) or a log; or drop it on the page" }, "Add a file"), this.choose),
      this.list, this.where,
    );
    document.addEventListener("visibilitychange", () => this.refresh());
    this.refresh();
  }

  async refresh() {
    clearTimeout(this.timer);
    if (document.hidden) return;
    const answer = await fetch("/api/gallery/recordings").catch(() => null);
    if (answer?.ok) this.draw(await answer.json());
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.refresh(), this.looking ? REST : POLL_MS);
  }

  draw({ folder, files }) {
    this.looking = files.some((file) => file.looking);
    const key = JSON.stringify(files);
    if (key === this.key) return;
    this.key = key;
    setText(this.where, `Kept in ${folder}. Record one on a twin's page (R), or drop a recording or a log here: CSV, Parquet, MF4, BLF, ASC and others.`);
    // What is asked of one file stays asked while the list is drawn anew.
    const asked = this.list.querySelector("[data-asked]")?.dataset.name;
    this.list.replaceChildren(...files.map((file) => this.item(file)));
    if (asked) [...this.list.children].find((item) => item.dataset.name === asked)?.querySelector(".delete")?.click();
    if (!files.length) this.list.replaceChildren(element("li", { class: "nothing" }, "None yet."));
  }

  item(file) {
    const { summary } = file;
    const error = summary?.error;
    const facts = [
      file.folder ? `in ${file.folder}` : null, file.twin, file.seconds ? span(file.seconds) : null, summary?.estimator ?? file.estimator, size(file.bytes),
    ].filter(Boolean).join(" · ");
    const ratio = (value) => compact(value / (summary.nis_dof ?? 1), 3);
    const scores = [
      summary?.nis ? `NIS / dof ${ratio(summary.nis)} [${ratio(summary.nis_low)}, ${ratio(summary.nis_high)}]` : null,
      error ? `RMSE ${error.name} ${compact(error.rmse, 3)}${spaced(error.unit)}${error.against === "truth" ? "" : `, ${error.against}`}${typeof error.coverage === "number" ? `, ${compact(100 * error.coverage, 3)} % in band` : ""}` : null,
    ].filter(Boolean).join(" · ");
    const confirm = element("div", { class: "confirm", hidden: true });
    const node = element(
      "li", { class: "file", dataset: { name: file.name } },
      element("div", { class: "row" },
        element("button", { type: "button", class: "name", title: file.log ? `Run a twin on ${file.name}` : `Review ${file.name}`, onclick: () => this.ask.open(file.name, file.log) }, file.name),
        element("a", { href: `/recordings/${encodeURIComponent(file.name)}`, download: file.name, title: "Download", "aria-label": `Download ${file.name}` }, "↓"),
        element("button", { type: "button", class: "delete", title: "Delete", "aria-label": `Delete ${file.name}`, onclick: () => this.confirm(node, confirm, file.name) }, "✕")),
      element("p", { class: "faint" }, `${when(file.modified)} · ${file.log ? "log · " : ""}${file.looking ? "looking …" : facts}`),
      scores ? element("p", { class: "faint", title: summary.nis_words }, scores) : null,
      file.error ? element("p", { class: "faint" }, file.error) : null,
      confirm,
    );
    return node;
  }

  confirm(node, place, name) {
    node.dataset.asked = "true";
    const back = () => {
      place.hidden = true;
      delete node.dataset.asked;
      node.querySelector(".delete").focus();
    };
    const remove = async () => {
      const answer = await post("/api/gallery/recordings/delete", { name });
      delete node.dataset.asked;
      if (answer.error) this.ask.say(answer.error);
      this.key = null;
      this.refresh();
    };
    const yes = element("button", { type: "button", class: "go danger", onclick: remove }, "Delete for good");
    place.replaceChildren(yes, element("button", { type: "button", class: "go", onclick: back }, "Keep"));
    place.hidden = false;
    yes.focus();
  }
}

const size = (bytes) => (bytes < 1e6 ? `${Math.max(1, Math.round(bytes / 1e3))} kB` : bytes < 1e9 ? `${compact(bytes / 1e6, 3)} MB` : `${compact(bytes / 1e9, 3)} GB`);

function when(seconds) {
  const date = new Date(1000 * seconds);
  const today = date.toDateString() === new Date().toDateString();
  const time = date.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" });
  return today ? `today ${time}` : `${date.toLocaleDateString("en-GB", { day: "numeric", month: "short", year: "numeric" })} ${time}`;
}

// Files that are dropped on the page: sent in pieces to the folder of recordings, then opened.

const RECORDING = ".rrd";

// `twins` lists the twins that could read a log, the most likely first; `say` reports progress and errors,
// `follow` reports the progress of opening.
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
    const dialog = element("dialog", { class: "choose", "aria-label": "Twin for this log" });
    const close = (value) => {
      dialog.close();
      dialog.remove();
      done(value);
    };
    dialog.append(
      element("h2", {}, "Twin for this log"), element("p", { class: "faint" }, `${name} takes the place of the twin's own recording.`),
      element("ul", {}, ...twins.map((twin) => element("li", {}, element("button", { type: "button", onclick: () => close(twin.name) }, element("b", {}, twin.short), " ", element("span", { class: "faint" }, twin.title))))),
      element("button", { type: "button", class: "go", onclick: () => close(null) }, "Cancel"),
    );
    if (!twins.length) setText(dialog.querySelector("p"), "No twin here reads logs.");
    dialog.addEventListener("cancel", () => close(null));
    document.body.append(dialog);
    dialog.showModal();
  });
}
