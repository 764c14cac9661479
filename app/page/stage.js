// The stage: Viser's scene in a frame, and what may be chosen about it. Its panel is for a window of its own; here the
// page has all that.

import { $, element, setAttribute, setText } from "./dom.js";
import { span } from "./format.js";

const LATE = 1; // s by which the scene may be ahead of the charts without a word
const LARGE = "nisus.stage.large";

export class Stage {
  constructor(there, theme, link, view, charts) {
    Object.assign(this, { there, theme, link });
    this.frame = $("stage");
    this.choices = {};
    $("stage-alone").href = this.address("");
    $("stage-large").addEventListener("click", () => this.enlarge());
    this.enlarge(localStorage.getItem(LARGE) === "1");
    link.addEventListener("status", () => this.offer(link.status.scene ?? []));
    // The scene shows the newest row; the charts may be held elsewhere.
    const place = () => {
      const ahead = view.following ? 0 : charts.newest - view.at;
      setText($("stage-time"), ahead > LATE && Number.isFinite(ahead) ? `${span(ahead)} later than the charts` : "");
    };
    link.addEventListener("status", place);
    view.addEventListener("change", place);
  }

  // Of Viser's page. The query of the socket's address says what is shown, so that no more than that is sent.
  address(part) {
    const socket = `ws://${location.host}/viser/?theme=${this.theme}${part}`;
    return `/viser/?websocket=${encodeURIComponent(socket)}${this.theme === "dark" ? "&darkMode" : ""}`;
  }

  // Nothing is sent for a scene that nobody sees.
  visible(seen) {
    if (!this.there) return;
    if (!seen) this.frame.removeAttribute("src");
    else if (!this.frame.hasAttribute("src")) {
      // After the charts: three.js takes its time.
      this.frame.src = this.address("&part=scene");
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

  // Scene and charts change places.
  enlarge(large = !document.body.classList.contains("staged")) {
    document.body.classList.toggle("staged", large);
    setAttribute($("stage-large"), "aria-pressed", String(large));
    localStorage.setItem(LARGE, large ? "1" : "0");
  }

  offer(choices) {
    const shape = JSON.stringify(choices.map(({ key, options }) => [key, options]));
    if (shape !== this.shape) {
      this.shape = shape;
      this.choices = Object.fromEntries(choices.map((choice) => [choice.key, this.select(choice)]));
      $("stage-choices").replaceChildren(
        ...choices.map((choice) => element("label", {}, element("span", {}, choice.label), this.choices[choice.key])),
      );
    }
    for (const { key, value } of choices) if (document.activeElement !== this.choices[key]) this.choices[key].value = value;
  }

  select({ key, label, options, value }) {
    const select = element("select", { "aria-label": `Scene: ${label}` });
    select.append(...options.map((option) => element("option", { value: option }, option.replaceAll("_", " "))));
    select.value = value;
    select.addEventListener("change", async () => {
      const answer = await fetch("/api/scene", {
        method: "POST",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify({ key, value: select.value }),
      }).catch(() => null);
      select.blur();
      if (answer?.ok) this.offer(await answer.json());
    });
    return select;
  }
}

const PANELS = `
  [data-dock-region], [data-dock-region-handle], [data-floating-window], .mantine-Paper-root, .mantine-Notifications-root { display: none !important; }
  [data-dock-root] > div { inset: 0 !important; width: 100% !important; }
`;
