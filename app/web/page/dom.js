// Elements, made in one expression.

// element("button", {class: "quiet", onclick: f, title: "…"}, "text", child, …); an attribute that is null is left out.
export function element(name, attributes = {}, ...children) {
  const [tag, space] = name.startsWith("svg:") ? [name.slice(4), "http://www.w3.org/2000/svg"] : [name, null];
  const made = space ? document.createElementNS(space, tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "dataset") Object.assign(made.dataset, value);
    else made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

// Children of a node, one for each item by its key. Those of items that stay are left where they are: a button that is moved
// or made anew under the pointer cannot be pressed.
export function keyed(node, items, keyOf, make) {
  const known = new Map([...node.children].map((child) => [child.dataset.key, child]));
  const children = items.map((item) => {
    const key = String(keyOf(item));
    const child = known.get(key) ?? make(item);
    child.dataset.key = key;
    return child;
  });
  for (const child of [...node.children]) if (!children.includes(child)) child.remove();
  children.forEach((child, k) => child === node.children[k] || node.insertBefore(child, node.children[k] ?? null));
  return children;
}

export const $ = (id) => document.getElementById(id);

// Writing the same text again would still cost a layout.
export function setText(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

const shown = new WeakMap(); // what was drawn last in a node, as JSON

// Whether a value is another than that which was drawn last in a node.
export function changed(node, value) {
  const text = JSON.stringify(value);
  if (text === shown.get(node)) return false;
  shown.set(node, text);
  return true;
}

// A table of texts; cells may be elements of their own, such as the names of rows.
export const table = (heads, rows) => element("table", {},
  element("thead", {}, element("tr", {}, ...heads.map((head) => element("th", { scope: "col" }, head)))),
  element("tbody", {}, ...rows.map((cells) => element("tr", {}, ...cells.map((cell) => (cell instanceof Element ? cell : element("td", {}, cell)))))));

// Draw anew, and give the focus back to what had it in a node, found by an attribute.
export function keepFocus(node, attribute, draw) {
  const focused = node.contains(document.activeElement) ? document.activeElement.getAttribute(attribute) : null;
  draw();
  if (focused) node.querySelector(`[${attribute}="${CSS.escape(focused)}"]`)?.focus({ preventScroll: true });
}

// The text of a node that is hidden while it has none.
export function showText(node, text) {
  setText(node, text ?? "");
  node.hidden = !text;
}

// A line for the reason why something was refused.
export const refusal = () => element("p", { class: "error", role: "alert", hidden: true });

export function setAttribute(node, name, value) {
  if (value === null || value === false) {
    if (node.hasAttribute(name)) node.removeAttribute(name);
  } else if (node.getAttribute(name) !== String(value)) node.setAttribute(name, value);
}
