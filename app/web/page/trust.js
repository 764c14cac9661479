// The strip on top: which filter, may it be trusted and if not why, NIS in its bounds, a light for each sensor.

import { $, element, setAttribute, setText } from "./dom.js";
import { compact, span, words } from "./format.js";

// Beside the colours, for whoever cannot tell them.
export const SIGNS = {
  waiting: "○", tracking: "●", suspect: "◐", degraded: "▲", diverged: "✖", stale: "◌", "held out": "–", screened: "⊘",
};
const MOST_LIGHTS = 8;

export class Trust {
  constructor(model, link, open) {
    this.model = model;
    this.lights = new Map();
    const names = model.sensors.slice(0, MOST_LIGHTS);
    for (const name of names) {
      const light = element("button", { type: "button", class: "light", onclick: () => open("episodes") }, element("i", {}, "○"), element("span", {}, words(name)));
      this.lights.set(name, light);
    }
    $("lights").replaceChildren(...this.lights.values());
    if (model.sensors.length > names.length) $("lights").append(element("span", { class: "more", id: "more-lights" }));
    $("health").addEventListener("click", () => open("episodes"));
    $("cause").addEventListener("click", () => open("episodes"));
    link.addEventListener("status", (event) => this.show(event.detail));
    link.addEventListener("connection", (event) => this.connection(event.detail));
  }

  show(status) {
    document.title = `${SIGNS[status.health] ?? ""} ${status.twin} · Nisus`;
    setText($("twin"), status.twin);
    setAttribute($("twin"), "title", status.title);
    const turned = Object.keys(status.turned).length > 0;
    setText($("began"), status.began_as === "recorded" ? (turned ? "recorded, turned" : "as recorded") : "");
    const lost = status.lost !== null;
    const since = lost ? status.lost : status.since;
    const lasting = lost || (!["tracking", "waiting"].includes(status.health) && since !== null);
    const name = lost ? "not a number" : status.health;
    setText($("health"), `${SIGNS[status.health] ?? "●"} ${name}${lasting ? ` ${span((status.t - since) / 1e9)}` : ""}`);
    $("health").dataset.health = lost ? "diverged" : status.health;
    const cause = lost ? "The estimate is not a number: reset it, or choose another filter" : status.cause;
    const first = status.episodes_open > 1 && cause ? `1 of ${status.episodes_open}: ` : ""; // ahead, as the end may be cut
    setText($("cause"), first + cause);
    setAttribute($("cause"), "title", first + cause);
    this.gauge(status);
    // What is wrong needs the room: sensors that are in order keep their light alone.
    $("lights").dataset.brief = String(Boolean(cause));
    for (const [sensor, light] of this.lights) {
      const { state, text } = status.sensors[sensor] ?? { state: "waiting", text: "" };
      light.dataset.health = state;
      setText(light.firstChild, SIGNS[state] ?? "●");
      setAttribute(light, "title", `${words(sensor)}: ${state}${text ? `. ${text}` : ""}`);
    }
    const rest = Object.entries(status.sensors).filter(([sensor]) => !this.lights.has(sensor));
    const bad = rest.filter(([, item]) => !["tracking", "held out", "waiting"].includes(item.state));
    if ($("more-lights")) {
      setText($("more-lights"), `+${rest.length}${bad.length ? `, ${bad.length} not well` : ""}`);
      setAttribute($("more-lights"), "title", bad.map(([sensor, item]) => `${words(sensor)}: ${item.state}`).join("\n"));
    }
    setText($("folding"), refolding(status));
    setAttribute($("record"), "aria-pressed", String(status.recording !== null));
    const file = status.recording?.split(/[\\/]/).pop() ?? "";
    const where = `Recording ${file} into ${status.recording_folder}`;
    setAttribute($("record"), "title", file ? `${where}: end it (R)` : "Record into a new .rrd file (R)");
    $("recording").hidden = !file;
    setText($("recording"), file);
    setAttribute($("recording"), "title", where);
    const latency = typeof status.latency_ms === "number" ? `${compact(status.latency_ms, 2)} ms` : "";
    setText($("latency"), latency);
  }

  // NIS on a logarithmic scale of two decades about its bounds.
  gauge({ nis, nis_judged: judged, nis_low: low, nis_high: high, nis_place: where, nis_words: said }) {
    const known = [nis, judged, low, high].every((value) => typeof value === "number" && value > 0);
    setText($("nis"), known ? compact(nis, 3) : "–");
    $("gauge").hidden = !known;
    if (!known) return;
    const middle = Math.log10(Math.sqrt(low * high));
    const place = (value) => `${Math.min(98, Math.max(2, 50 + 50 * (Math.log10(value) - middle)))}%`;
    $("gauge").style.setProperty("--low", place(low));
    $("gauge").style.setProperty("--high", place(high));
    $("gauge").style.setProperty("--nis", place(judged));
    $("gauge").dataset.inside = String(where === "inside");
    setAttribute($("gauge"), "title", `Of the last readings: ${said}`);
  }

  connection(state) {
    const text = {
      live: "", waiting: "connection lost, trying again", hidden: "",
      ended: "this session has ended; open the address that Nisus printed last",
    }[state];
    setText($("connection"), text ?? "");
    $("connection").hidden = !text;
    $("connection").dataset.state = state;
  }
}

// What a refold waits for, or the revision.
function refolding({ awaited, compiling, refolding: waits, revision }) {
  if (awaited !== null) return `compiling ${awaited}, ${Math.round(compiling[awaited] ?? 0)} s …`;
  return waits ? `folding r${revision + 1} …` : `r${revision}`;
}
