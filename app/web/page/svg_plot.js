// A small plot of Diagnose as an SVG file of its own: what it is and of when above it, in the light theme.

import { lightPalette } from "./svg_chart.js";

const HEAD = 34; // of the viewBox, for two lines
const [TITLE, BOLD] = [8.5, 0.62]; // its size, and the width of a letter as a share of it
const WIDE = 2.5; // px of the file for one of the viewBox
const OWN = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-dasharray", "font-size"];

// node: the plot, where the page's style reaches it. Gives the text of the file.
export function plotSvg(node, [title, about]) {
  const { width, height } = node.viewBox.baseVal;
  const palette = lightPalette();
  const copy = node.cloneNode(true);
  for (const [name, value] of palette) copy.style.setProperty(name, value);
  copy.style.position = "absolute";
  node.parentNode.append(copy);
  // The page's style does not go with the file.
  for (const part of copy.querySelectorAll("*")) {
    const style = getComputedStyle(part);
    for (const name of OWN) part.setAttribute(name, style.getPropertyValue(name));
    part.removeAttribute("class");
  }
  copy.remove();
  const root = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const wide = Math.max(width, 12 + BOLD * TITLE * title.length);
  const size = { viewBox: `0 0 ${wide} ${height + HEAD}`, width: Math.round(WIDE * wide), height: Math.round(WIDE * (height + HEAD)) };
  for (const [name, value] of Object.entries(size)) root.setAttribute(name, value);
  root.setAttribute("font-family", "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif");
  const put = (name, attributes, text = "") => {
    const made = document.createElementNS(root.namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.textContent = text;
    root.append(made);
    return made;
  };
  put("title", {}, title);
  put("rect", { width: wide, height: height + HEAD, fill: palette.get("--panel") });
  put("text", { x: 6, y: 13, "font-size": TITLE, "font-weight": 650, fill: palette.get("--ink") }, title);
  put("text", { x: 6, y: 25, "font-size": 6.5, fill: palette.get("--faint") }, about);
  put("g", { transform: `translate(0 ${HEAD})` }).append(...copy.childNodes);
  return new XMLSerializer().serializeToString(root);
}
