// Keys for everything, and Ctrl-K to find it.

import { $, element } from "./dom.js";

const TYPING = "input:not([type=range]):not([type=checkbox]), textarea, select, [contenteditable]";

// commands: [key, what it does, run]
export function keys(commands) {
  const named = new Map(commands.map(([key, , run]) => [key === "space" ? " " : key, run]));
  const palette = $("palette");
  const field = element("input", { type: "text", placeholder: "What to do?", "aria-label": "Find a command" });
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
