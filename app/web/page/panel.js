// A panel that a button opens beside the Tune column, over the charts, and that stays until it is closed.

import { $, element } from "./dom.js";

export class Panel {
  // opened(): resolves once there is something to show
  constructor(button, id, title, opened, ...children) {
    Object.assign(this, { button, opened });
    this.node = element("section", { id, class: "beside", popover: "manual", role: "dialog", "aria-label": title, tabindex: "-1" },
      element("header", {}, element("h2", {}, title), element("span", { class: "space" }), element("button", { type: "button", title: "Close (Esc)", "aria-label": "Close", onclick: () => this.toggle(false) }, "×")),
      ...children);
    document.addEventListener("keydown", (event) => {
      // A button of it that is greyed while it works loses the focus to the page.
      const { activeElement: at } = document;
      if (event.key === "Escape" && this.open && (at === document.body || at === button || this.node.contains(at))) this.toggle(false);
    });
    button.setAttribute("aria-haspopup", "dialog");
    button.setAttribute("aria-expanded", "false");
    button.addEventListener("click", () => this.toggle());
    document.body.append(this.node);
  }

  get open() {
    return this.node.matches(":popover-open");
  }

  toggle(open = !this.open) {
    if (open === this.open) return;
    this.button.setAttribute("aria-expanded", String(open));
    if (!open) {
      this.node.hidePopover();
      this.button.focus();
      return;
    }
    // One at a time: they would lie over each other.
    for (const other of document.querySelectorAll(".beside:popover-open")) other.querySelector("header button").click();
    this.node.showPopover();
    const [column, bar] = [$("tune").getBoundingClientRect(), this.button.getBoundingClientRect()];
    this.node.style.left = `${Math.max(4, Math.min(column.right + 6, innerWidth - this.node.offsetWidth - 4))}px`;
    this.node.style.top = `${bar.bottom + 4}px`;
    this.opened().then(() => (this.node.querySelector("input, .go:enabled") ?? this.node).focus());
  }
}
