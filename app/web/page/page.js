// The page: trust on top, tuning to the left, charts in the middle, scene and lists to the right, time below.

import { Charts } from "./charts.js";
import { keys, Tabs, themeButton } from "./controls.js";
import { Diagnose } from "./diagnose.js";
import { $, changed, element, setAttribute, setText, showText } from "./dom.js";
import { Explore } from "./explore.js";
import { Faults } from "./faults.js";
import { clock, setLabels } from "./format.js";
import { get } from "./http.js";
import { Link } from "./link.js";
import { Runs } from "./runs.js";
import { Save } from "./save.js";
import { Leave } from "./session.js";
import { SceneFrame } from "./scene_frame.js";
import { Transport } from "./transport.js";
import { Episodes, Trust, UserNotes } from "./trust.js";
import { Tune } from "./tune.js";
import { goTo, SharedTime, twinOf, View } from "./view.js";
import { WhatIf } from "./whatif.js";
import { XY } from "./xy.js";

const settings = JSON.parse(document.body.dataset.settings);
const theme = document.documentElement.dataset.theme;

themeButton(() => location.reload()); // Rerun's and Viser's pages take their theme when they start

const model = await get("api/model");
if (model.error) throw new Error(model.error);
setLabels(model);
const kinds = await Promise.all(settings.charts.map((name) => import(`./charts/${name}`)));
window.nisus = { model, drawn: 0, revision: null };

// Nothing is awaited from here on: what arrives before all listen would be lost.
const link = new Link(settings.boot);
window.nisus.link = link;

// Times of episodes, notes and events as the charts count them.
link.addEventListener("status", () => {
  const origin = link.status.origin;
  if (origin !== link.origin) {
    link.origin = origin;
    place();
  }
});
function place() {
  const origin = Number(link.status.origin ?? 0) / 1e9;
  for (const episode of link.episodes) {
    episode.from = episode.start - origin;
    episode.to = episode.end === null ? null : episode.end - origin;
  }
  for (const note of link.annotations) note.from = note.at - origin;
}
link.addEventListener("episodes", place);
link.addEventListener("annotations", place);
link.addEventListener("notices", (event) => {
  const origin = link.status.origin;
  for (const notice of event.detail) notice.from = origin && notice.t ? (notice.t - Number(origin)) / 1e9 : null;
});

const view = new View(model.recorded ? null : model.window);
const charts = new Charts($("charts"), model, link, view, kinds);
window.nisus.charts = charts;
window.nisus.view = view;

// Scenes about as wide as high; one of many cells is not.
const square = model.field || ["belief", "gripper"].includes(model.scene) || (model.scene === "battery" && model.states.length < 8);
setAttribute($("right"), "data-square", String(square));
settings.panels.forEach((title, k) => {
  $("side-tabs").append(element("button", { type: "button", "data-tab": `panel-${k}` }, title));
  const node = element("div", { id: `panel-${k}`, role: "tabpanel", hidden: "" });
  $("right").append(node);
  const failed = (error) => node.append(element("p", { class: "error" }, `${title}: ${error.message}`));
  import(new URL(`panels/${encodeURIComponent(title)}`, document.baseURI)).then((script) => script.default(node, window.nisus)).catch(failed);
});
const side = new Tabs($("side-tabs"), "nisus.side");
new Trust(model, link, (tab) => side.show(tab));
const tune = (window.nisus.tune = new Tune(model, link));
new Faults($("faults"), model, link);
const notes = new UserNotes(link, view, charts, () => middle.show("charts-panel"));
new Episodes($("episodes"), link, view, charts, notes.node);
const runs = new Runs($("runs"), link);
new SharedTime(settings.boot, view, charts);
view.addEventListener("change", () => link.point(view.at));
const transport = new Transport(model, link, view, charts);
const explore = new Explore(settings.viewer, theme, { link, view, charts });
const sceneFrame = new SceneFrame(settings.viser ? { pass: settings.stage_pass } : null, theme, link, view);

// What is hidden neither computes nor asks.
const panes = { explore, whatif: new WhatIf($("whatif"), model, link), diagnose: new Diagnose($("diagnose"), link, (...plot) => saving.plot(...plot)) };
const middle = new Tabs($("middle-tabs"), null, (shown) => {
  for (const [name, pane] of Object.entries(panes)) if (name !== shown) pane.hide();
  panes[shown]?.show();
  charts.show(shown === "charts-panel");
  if (shown === "charts-panel") charts.explain();
  $("layout").hidden = $("smoothed").hidden = shown !== "charts-panel";
  $("legend").hidden = shown !== "charts-panel" && shown !== "whatif";
  if (side.into) side.shown(shown);
});
window.nisus.panes = panes;
panes.whatif.explain = (parts) => charts.explain(parts);
const saving = new Save(model, link, view, charts);
charts.saving = runs.saving = panes.whatif.saving = window.nisus.saving = saving;
$("save").addEventListener("click", () => saving.run($("save")));
$("copy-link").addEventListener("click", () => saving.copyLink());
saving.said = (text) => {
  setText($("said"), text);
  clearTimeout(saving.timer);
  saving.timer = setTimeout(() => setText($("said"), ""), 5000);
};

// A link to a moment, once it is known from when seconds count; and when another is opened in this window.
let arriving = false;
function follow() {
  arriving = true;
  const reason = goTo(location.hash, { model, link, view, charts });
  arriving = false;
  if (!reason) return;
  saving.said(reason);
  if (twinOf(location.hash) !== model.twin) leave?.offer(twinOf(location.hash), reason);
}
function begun() {
  if (!link.status.origin) return;
  link.removeEventListener("status", begun);
  follow();
  window.addEventListener("hashchange", follow);
}
link.addEventListener("status", begun);
// A recording is folded to its end at once: then the cursor goes to the moment that the twin names, unless the user was faster.
function folded({ detail: status }) {
  if (!status.finished) return;
  link.removeEventListener("status", folded);
  if (view.following && view.span === null && !location.hash) view.show(...transport.extent, model.at ?? transport.extent[1]);
}
if (model.recorded) link.addEventListener("status", folded);
// Elsewhere, or following again: the address says no longer what is shown.
view.addEventListener("change", () => location.hash && !arriving && history.replaceState(null, "", location.pathname));

const turn = (name) => middle.show(middle.chosen === name ? "charts-panel" : name);
const xy = (window.nisus.xy = new XY($("xy"), model, link, view, charts));
xy.saving = saving;
let chartsDrawn = false;
middle.show("charts-panel");
side.shown = (name) => {
  xy.visible(name === "xy");
  if (chartsDrawn) sceneFrame.visible(name === "scene");
};
side.show(side.chosen ?? "scene");
// Where there is no room for three columns, one list of tabs has all panels; see style.css.
const narrow = matchMedia("(max-width: 1100px)");
const arrange = () => side.join(narrow.matches ? middle : null);
narrow.addEventListener("change", arrange);
arrange();
// The scene once the charts stand: its three.js keeps the page busy while it starts.
link.addEventListener("frames", () => setTimeout(() => ((chartsDrawn = true), side.shown(side.current)), 300), { once: true });

async function record() {
  if (link.status.recording) await link.ask("Record", { path: null });
  else {
    const stamp = new Date().toISOString().replace(/[-:]/g, "").replace("T", "-").slice(0, 15);
    await link.ask("Record", { path: `${model.twin}-${stamp}.rrd` });
  }
}
$("record").addEventListener("click", record);

link.addEventListener("status", (event) => {
  const names = event.detail.recordings ?? [];
  if (!changed($("recordings"), names)) return;
  $("recordings").replaceChildren(
    ...names.slice(-3).map((name) => element("a", { href: `rec/${encodeURIComponent(name)}`, download: name, title: "Download recording" }, name)),
  );
});

// One twin of a service has its overview in place of a gallery.
if (settings.overview) for (const id of ["gallery", "others"]) setAttribute($(id), "href", settings.overview);
const leave = settings.gallery ? new Leave(model, settings.boot) : null;

// Saved files of the twin: errors in them, and new configured values.
let reloads = null;
link.addEventListener("status", async ({ detail: { unread, reloads: now } }) => {
  showText($("unread"), unread ? `${unread}. The running twin goes on unchanged.` : "");
  if (reloads !== null && now !== reloads) tune.configure((await get("api/model")).tuning);
  reloads = now;
});

const drawer = () => {
  const open = document.body.classList.toggle("tuning");
  setAttribute($("drawer"), "aria-expanded", String(open));
};
$("drawer").addEventListener("click", drawer);

keys([
  ["space", "pause or continue", () => transport.pause()],
  [".", "step one event, while paused", () => link.ask("Step")],
  ["ArrowLeft", "move charts back", () => view.pan(-0.1 * (charts.range[1] - charts.range[0]), charts.range)],
  ["ArrowRight", "move charts forward", () => view.pan(0.1 * (charts.range[1] - charts.range[0]), charts.range)],
  ["f", "follow the newest data", () => view.follow()],
  ["0", "default width of the charts", () => view.follow(view.configured)],
  ["n", "note at the cursor (Alt-click in a chart)", () => notes.write()],
  ["r", "start or stop recording", record],
  ["u", "undo the last edit", () => tune.undo()],
  ["U", "redo", () => tune.redo()],
  ["b", "switch to the previous run and back", () => runs.swap()],
  ["e", "episodes", () => side.show("episodes")],
  ["y", "state over state (XY)", () => side.show("xy")],
  ["s", "scene; again: enlarge or shrink", () => (side.current === "scene" ? sceneFrame.enlarge() : side.show("scene"))],
  ["x", "explore in Rerun", () => turn("explore")],
  ["w", "what if", () => turn("whatif")],
  ["d", "diagnose", () => turn("diagnose")],
  ["l", "copy a link to this moment", () => saving.copyLink()],
  ["o", "save track or report", () => saving.run($("save"))],
  ["t", "show the tuning panel", drawer],
  ...(leave?.commands ?? []),
]);

$("clock").title = `Time since the first reading; ${clock(0)}`;
