// The stage: Viser's scene in a frame. Its own panel is for a window of its own; here the page has all that.

import { $ } from "./dom.js";

export class Stage {
  constructor(there, theme) {
    Object.assign(this, { there, theme });
    this.frame = $("stage");
  }

  // Nothing is sent for a scene that nobody sees.
  visible(seen) {
    if (!this.there) return;
    if (!seen) this.frame.removeAttribute("src");
    else if (!this.frame.hasAttribute("src")) {
      const socket = `ws://${location.host}/viser/`;
      // After the charts: three.js takes its time.
      this.frame.src = `/viser/?websocket=${encodeURIComponent(socket)}${this.theme === "dark" ? "&darkMode" : ""}`;
      this.frame.addEventListener("load", () => this.dress(), { once: true });
    }
  }

  dress() {
    const inside = this.frame.contentDocument;
    if (!inside?.head) return;
    const style = inside.createElement("style");
    style.textContent = PANELS;
    inside.head.append(style);
  }
}

const PANELS = `
  [data-dock-region], [data-dock-region-handle], [data-floating-window], .mantine-Paper-root, .mantine-Notifications-root { display: none !important; }
  [data-dock-root] > div { inset: 0 !important; width: 100% !important; }
`;
