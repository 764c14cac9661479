// The page: two panes, a header, and what the user chose of their looks.

import { Stream } from "./stream.js";
import { Viewer } from "./viewer.js";

const settings = JSON.parse(document.body.dataset.settings);
const $ = (id) => document.getElementById(id);
const dark = matchMedia("(prefers-color-scheme: dark)");
const chosen = localStorage.getItem("nisus.theme");
const theme = chosen ?? (dark.matches ? "dark" : "light");

document.documentElement.dataset.theme = theme;
$("theme").addEventListener("click", () => {
  localStorage.setItem("nisus.theme", theme === "dark" ? "light" : "dark");
  // Rerun's viewer takes its theme when it starts.
  location.reload();
});

// The panes

const sideways = () => innerWidth > 800;
const left = $("left");
const setShare = (share) => {
  const percent = Math.min(85, Math.max(15, share));
  left.style.setProperty("--left", `${percent}%`);
  $("divider").setAttribute("aria-valuenow", String(Math.round(percent)));
  localStorage.setItem("nisus.left", String(percent));
};
const getShare = () => Number(localStorage.getItem("nisus.left")) || 50;
setShare(getShare());

$("divider").addEventListener("pointerdown", (event) => {
  event.preventDefault();
  $("divider").setPointerCapture(event.pointerId);
  document.body.classList.add("dragging");
});
$("divider").addEventListener("pointermove", (event) => {
  if (!document.body.classList.contains("dragging")) return;
  const box = document.querySelector("main").getBoundingClientRect();
  setShare(100 * (sideways() ? (event.clientX - box.left) / box.width : (event.clientY - box.top) / box.height));
});
for (const end of ["pointerup", "pointercancel"])
  $("divider").addEventListener(end, () => document.body.classList.remove("dragging"));
$("divider").addEventListener("keydown", (event) => {
  const step = { ArrowLeft: -2, ArrowUp: -2, ArrowRight: 2, ArrowDown: 2 }[event.key];
  if (step) setShare(getShare() + step);
});
$("divider").addEventListener("dblclick", () => setShare(50));

if (settings.viser) {
  const socket = `ws://${location.host}/viser/`;
  $("viser").src = `/viser/?websocket=${encodeURIComponent(socket)}${theme === "dark" ? "&darkMode" : ""}`;
} else {
  left.hidden = $("divider").hidden = true;
}

// The header

const spell = (seconds) => (seconds < 120 ? `${Math.floor(seconds)} s` : `${Math.floor(seconds / 60)} min`);

// Beside the colours, for whoever cannot tell them.
const SIGNS = { waiting: "○", tracking: "●", suspect: "◐", degraded: "▲", diverged: "✖", stale: "◌" };

function show(status) {
  document.title = `${status.twin} · Nisus`;
  $("twin").textContent = status.twin;
  const turned = Object.keys(status.turned).length > 0;
  const recorded = status.began_as === "recorded" ? (turned ? " · recorded, turned" : " · as recorded") : "";
  $("title").textContent = status.title + recorded;
  const lost = status.lost !== null;
  const lasting = lost || (!["tracking", "waiting"].includes(status.health) && status.since !== null);
  const condition = lost ? "not a number" : status.health;
  const since = lost ? status.lost : status.since;
  const sign = SIGNS[status.health] ?? "●";
  $("health").textContent = `${sign} ${lasting ? `${condition} for ${spell((status.t - since) / 1e9)}` : condition}`;
  $("health").title = lost
    ? "The estimate is not a number: reset it, or choose another filter"
    : "Health of the estimate";
  $("health").dataset.health = status.health;
  if ($("cause").textContent !== status.cause) $("cause").textContent = $("cause").title = status.cause;
  $("cause").hidden = lost || !status.cause;
  $("estimator").textContent = status.estimator.toUpperCase();
  $("revision").textContent = status.refolding ? `${status.revision} …` : status.revision;
  compare(status.revision);
  const number = (value) => (typeof value === "number" ? value.toPrecision(3) : "–");
  const bounded = typeof status.nis === "number";
  $("nis").textContent = bounded ? `${number(status.nis)} (${number(status.nis_low)} – ${number(status.nis_high)})` : "–";
  $("latency").textContent = typeof status.latency_ms === "number" ? `${status.latency_ms.toFixed(1)} ms` : "–";
  $("recording").hidden = status.recording === null;
  $("recording").title = status.recording ?? "";
  const playing = status.finished ? "ended" : status.paused ? "paused" : null;
  $("playing").hidden = playing === null;
  $("playing").textContent = playing ?? "";
}

// The newest revision that was heard of, and the one that the right pane's viewer has drawn.
const revisions = { newest: null, drawn: null };

function compare(revision) {
  revisions.newest = Math.max(revision, revisions.newest ?? 0);
  const late = revisions.drawn !== null && revisions.drawn !== revisions.newest;
  const text = late ? `revision ${revisions.drawn} still; drawing ${revisions.newest} …` : "";
  if ($("behind").textContent === text) return;
  $("behind").textContent = text;
  $("behind").hidden = !late;
}

function offer(names) {
  const wanted = names.join("\n");
  if ($("recordings").dataset.names === wanted) return;
  $("recordings").dataset.names = wanted;
  $("recordings").replaceChildren(
    ...names.slice(-3).map((name) => {
      const link = document.createElement("a");
      link.href = `/rec/${encodeURIComponent(name)}`;
      link.textContent = name;
      link.title = "Download this recording";
      link.download = name;
      return link;
    }),
  );
}

const CONNECTION = {
  live: "live",
  waiting: "connection lost, trying again",
  hidden: "hidden",
  failed: "charts stopped",
  ended: "this session has ended; open the address that Nisus printed last",
};

function connection(state) {
  $("connection").dataset.state = state === "live" ? "live" : ["waiting", "failed", "ended"].includes(state) ? "lost" : "idle";
  $("connection").textContent = CONNECTION[state];
}

function note(text) {
  $("notice").textContent = text;
  $("notice").hidden = false;
}

// The right pane

try {
  const viewer = await Viewer.open($("rerun"), $("before"), settings.viewer, theme);
  window.nisus = { viewer, revision: null, drawn: 0, status: null };
  new Stream({
    viewer,
    changed: connection,
    told: (message) => {
      if (message.boot && message.boot !== settings.boot) location.reload(); // another server, perhaps another twin
      if (message.status) show((window.nisus.status = message.status));
      if (message.recordings) offer(message.recordings);
      if (message.recording) compare((window.nisus.revision = message.revision));
      if (message.drawn) {
        // Unless it lost patience with the viewer, that shows the recording announced last.
        if (!viewer.announced) revisions.drawn = window.nisus.revision;
        compare(window.nisus.revision);
        window.nisus.drawn += 1;
        $("notice").hidden = true;
      }
      if (message.failed) note(`The charts stopped: ${message.failed}. Reload the page.`);
    },
  });
} catch (error) {
  connection("failed");
  note(`The charts could not be loaded: ${error.message}`);
}
