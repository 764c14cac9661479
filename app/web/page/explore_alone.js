// Rerun's viewer in a window of its own. It shares the time of a page of the same twin that is open in this browser.

import { $, setText } from "./dom.js";
import { Explore } from "./explore.js";
import { RemoteView } from "./view.js";

const settings = JSON.parse(document.body.dataset.settings);
window.nisus = {};
const view = (window.nisus.view = new RemoteView(settings.boot));
const link = { status: {} };
// Where charts are, Rerun's cursor is in their seconds: here there are none.
const charts = { range: [-Infinity, Infinity], newest: Infinity };
const say = () => setText($("shared"), view.paired ? "one time with the page" : "a time of its own: no page of this twin is open in this browser");
view.addEventListener("change", say);
say();
const explore = new Explore(settings.viewer, document.documentElement.dataset.theme, { link, view, charts, heard: (status) => Object.assign(link.status, status) });
explore.show();
