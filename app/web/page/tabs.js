// Tabs: buttons that say with data-tab which element they show. The choice is kept.

export class Tabs {
  constructor(node, key, shown = () => {}) {
    Object.assign(this, { key, shown });
    this.buttons = [...node.querySelectorAll("[data-tab]")];
    for (const button of this.buttons) {
      button.setAttribute("role", "tab");
      button.addEventListener("click", () => this.show(button.dataset.tab));
      button.addEventListener("keydown", (event) => {
        const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        if (!step) return;
        const next = this.buttons[(this.buttons.indexOf(button) + step + this.buttons.length) % this.buttons.length];
        next.focus();
        this.show(next.dataset.tab);
        event.stopPropagation();
      });
    }
    const kept = key && localStorage.getItem(key);
    this.chosen = this.buttons.some((button) => button.dataset.tab === kept) ? kept : null;
  }

  show(name) {
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
