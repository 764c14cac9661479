// Rerun's viewer in a window of its own.

import { Explore } from "./explore.js";

const settings = JSON.parse(document.body.dataset.settings);
window.nisus = {};
new Explore(settings.viewer, document.documentElement.dataset.theme).show();
