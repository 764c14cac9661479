// Tabs: buttons that name with data-tab the panel they show. The choice is kept.

import { $, element } from "./dom.js";

export class Tabs {
  constructor(node, key, shown = () => {}) {
    Object.assign(this, { node, key, shown });
    this.own = this.buttons;
    for (const button of this.own) {
      const panel = $(button.dataset.tab);
      const attributes = { role: "tab", id: `tab-${panel.id}`, "aria-controls": panel.id };
      for (const [name, value] of Object.entries(attributes)) button.setAttribute(name, value);
      panel.setAttribute("aria-labelledby", button.id);
      panel.before(element("h2", { class: "unseen" }, button.textContent));
      button.addEventListener("click", () => this.show(button.dataset.tab));
      button.addEventListener("keydown", (event) => {
        const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        if (!step) return;
        const buttons = (this.into ?? this).buttons.filter((item) => item.checkVisibility());
        const next = buttons[(buttons.indexOf(button) + step + buttons.length) % buttons.length];
        next.focus();
        this.show(next.dataset.tab);
        event.stopPropagation();
      });
    }
    const kept = key && localStorage.getItem(key);
    this.chosen = this.own.some((button) => button.dataset.tab === kept) ? kept : null;
  }

  get buttons() {
    return [...this.node.querySelectorAll("[data-tab]")];
  }

  // The tab that is shown, of this list or of the one it has joined.
  get current() {
    return (this.into ?? this).chosen;
  }

  // Move tabs and panels behind those of another list; null moves them back.
  join(into) {
    const from = this.into;
    if (into === (from ?? null)) return;
    this.into = into;
    const list = into ?? this;
    (into ? into.own.at(-1) : null)?.after(...this.own);
    if (!into) this.node.append(...this.own);
    for (const { dataset } of this.own) list.node.parentElement.append($(dataset.tab).previousElementSibling, $(dataset.tab));
    if (into) return into.show(into.chosen);
    const mine = this.own.some((button) => button.dataset.tab === from.chosen);
    if (mine) this.chosen = from.chosen;
    from.show(mine ? from.own[0].dataset.tab : from.chosen);
    this.show(this.chosen);
  }

  show(name) {
    if (this.into) return this.into.show(name);
    this.chosen = name;
    if (this.key) localStorage.setItem(this.key, name);
    for (const button of this.buttons) {
      const mine = button.dataset.tab === name;
      button.setAttribute("aria-selected", String(mine));
      button.tabIndex = mine ? 0 : -1;
      document.getElementById(button.dataset.tab).hidden = !mine;
    }
    this.shown(name);
  }
}

// The button between light and dark. turned(): what follows.
export function themeButton(turned = () => {}) {
  const root = document.documentElement;
  $("theme").addEventListener("click", () => {
    root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
    localStorage.setItem("nisus.theme", root.dataset.theme);
    turned();
  });
}

// A panel that a button opens beside the Tune column, over the charts, and that stays until it is closed.

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

// Keys for everything, and Ctrl-K to find it.

const TYPING = "input:not([type=range]):not([type=checkbox]), textarea, select, [contenteditable]";

// commands: [key, text, run]
export function keys(commands) {
  const named = new Map(commands.map(([key, , run]) => [key === "space" ? " " : key, run]));
  const palette = $("palette");
  const field = element("input", { type: "text", placeholder: "Command", "aria-label": "Find a command" });
  const list = element("ul", {});
  palette.replaceChildren(field, list);
  const offer = () => {
    const wanted = field.value.toLowerCase();
    const found = commands.filter(([, what]) => what.toLowerCase().includes(wanted));
    list.replaceChildren(
      ...found.map(([key, what, run]) =>
        element("li", {}, element("button", { type: "button", onclick: () => (palette.close(), run()) }, element("span", {}, what), element("kbd", {}, key))),
      ),
    );
  };
  field.addEventListener("input", offer);
  field.addEventListener("keydown", (event) => {
    if (event.key === "Enter") list.querySelector("button")?.click();
    if (event.key === "ArrowDown") list.querySelector("button")?.focus();
  });
  document.addEventListener("keydown", (event) => {
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "k") {
      event.preventDefault();
      field.value = "";
      offer();
      palette.showModal();
      return;
    }
    if (event.ctrlKey || event.metaKey || event.altKey || palette.open || event.target.closest?.(TYPING)) return;
    if (event.target.closest?.("input[type=range], [role=tab], canvas") && event.key.startsWith("Arrow")) return;
    if (event.key === " " && event.target.closest?.("button, summary, input")) return;
    const run = named.get(event.key);
    if (!run) return;
    event.preventDefault();
    run();
  });
}
