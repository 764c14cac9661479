// Viser's scene in a frame, and the choices about it, which also hold for a window of its own.

import { $, changed, element, setAttribute, setText } from "./dom.js";
import { clock, span, words } from "./format.js";
import { post } from "./http.js";

const MAX_LEAD_S = 1; // s by which the scene may differ from the charts without a word
const LARGE = "nisus.stage.large";

export class SceneFrame {
  constructor(there, theme, link, view) {
    Object.assign(this, { there, theme, link });
    this.frame = $("stage");
    this.choices = {};
    // Until its document is there, which a busy server sends late, the frame is blank.
    setAttribute($("scene"), "data-loading", there ? "" : null);
    this.frame.addEventListener("load", () => this.frame.hasAttribute("src") && setAttribute($("scene"), "data-loading", null));
    $("stage-alone").href = this.address(false);
    $("stage-large").addEventListener("click", () => this.enlarge());
    this.enlarge(localStorage.getItem(LARGE) === "1");
    link.addEventListener("status", () => this.offer(link.status.scene ?? []));
    // All windows share the scene: it shows the time to which one of them pointed last.
    const place = () => {
      const { scene_at: pointed, origin, t } = link.status;
      const newest = (t - Number(origin)) / 1e9;
      const shown = pointed == null ? newest : Math.min(newest, (pointed - Number(origin)) / 1e9);
      const ahead = shown - Math.min(newest, view.at ?? newest);
      const apart = Math.abs(ahead) > MAX_LEAD_S ? `, ${span(Math.abs(ahead))} ${ahead > 0 ? "later" : "earlier"} than the charts` : "";
      setText($("stage-time"), Number.isFinite(shown) && (pointed != null || apart) ? `at ${clock(shown, 1)}${apart}` : "");
    };
    link.addEventListener("status", place);
    view.addEventListener("change", place);
  }

  // Address of Viser's page; `scene` leaves the link to this page out. The frame uses this machine's
  // other name: a browser draws another site in a process of its own, so charts and sliders do not wait for three.js.
  // Cookies are not sent there, so a pass is.
  address(framed) {
    const names = { "127.0.0.1": "localhost", localhost: "127.0.0.1" };
    const other = framed && this.there?.pass && names[location.hostname];
    const base = new URL("viser/", document.baseURI);
    if (other) base.hostname = other;
    const query = `theme=${this.theme}${other ? `&pass=${this.there.pass}` : ""}`;
    const socket = encodeURIComponent(`${base.protocol.replace("http", "ws")}//${base.host}${base.pathname}?${query}`);
    const dark = this.theme === "dark" ? "&darkMode" : "";
    return `${base.href}?${framed ? "scene&" : ""}${other ? `pass=${this.there.pass}&` : ""}websocket=${socket}${dark}`;
  }

  // Nothing is sent for a scene that nobody sees.
  visible(seen) {
    if (!this.there) return;
    if (!seen) this.frame.removeAttribute("src");
    // After the charts: three.js takes its time.
    else if (!this.frame.hasAttribute("src")) {
      setAttribute($("scene"), "data-loading", "");
      this.frame.src = this.address(true);
    }
  }

  // Scene and charts change places.
  enlarge(large = !document.body.classList.contains("staged")) {
    document.body.classList.toggle("staged", large);
    setAttribute($("stage-large"), "aria-pressed", String(large));
    localStorage.setItem(LARGE, large ? "1" : "0");
  }

  offer(choices) {
    if (changed($("stage-choices"), choices.map(({ key, options }) => [key, options]))) {
      this.choices = Object.fromEntries(choices.map((choice) => [choice.key, this.select(choice)]));
      $("stage-choices").replaceChildren(
        ...choices.map((choice) => element("label", {}, element("span", {}, choice.label), this.choices[choice.key])),
      );
    }
    for (const { key, value } of choices) if (document.activeElement !== this.choices[key]) this.choices[key].value = value;
  }

  select({ key, label, options, value }) {
    const choose = async () => {
      const answer = await post("api/scene", { key, value: select.value });
      select.blur();
      if (!answer.error) this.offer(answer);
    };
    const select = element("select", { "aria-label": `Scene: ${label}`, onchange: choose }, ...options.map((option) => element("option", { value: option, selected: option === value }, words(option))));
    return select;
  }
}
