// Drawings as SVG files: a context that records what is drawn on it, and plots that are SVG already. In the light theme.

import { element } from "./dom.js";
import { inLight, lightPalette } from "./drawing.js";

const FAMILY = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif";
const ANCHORS = { center: "middle", right: "end", end: "end" };
const BASELINES = { middle: 0.36, top: 0.85, bottom: -0.15 }; // of the size of a letter
const STATE = ["fillStyle", "strokeStyle", "lineWidth", "globalAlpha", "font", "textAlign", "textBaseline", "dash", "clipId", "x", "y", "angle"];

const round = (value) => Math.round(10 * Math.min(1e5, Math.max(-1e5, value))) / 10;
const escaped = (text) => String(text).replace(/[&<>"]/g, (sign) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[sign]);

// In place of Path2D.
class SvgPath {
  constructor(other) {
    this.d = other?.d ?? "";
  }

  moveTo(x, y) {
    this.d += `M${round(x)} ${round(y)}`;
  }

  lineTo(x, y) {
    this.d += `${this.d ? "L" : "M"}${round(x)} ${round(y)}`;
  }

  rect(x, y, width, height) {
    this.d += `M${round(x)} ${round(y)}h${round(width)}v${round(height)}h${round(-width)}Z`;
  }

  // Circles alone.
  arc(x, y, radius) {
    const r = round(radius);
    this.d += `M${round(x - radius)} ${round(y)}a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0Z`;
  }
}

// In place of a canvas's context, as far as uPlot and drawing.js use one.
class SvgContext {
  constructor() {
    Object.assign(this, { parts: [], clips: [], stack: [], path: new SvgPath() });
    Object.assign(this, { fillStyle: "#000", strokeStyle: "#000", lineWidth: 1, globalAlpha: 1, font: "11px", textAlign: "left", textBaseline: "alphabetic", dash: [], clipId: null, x: 0, y: 0, angle: 0 });
    this.measure = document.createElement("canvas").getContext("2d");
  }

  save() {
    this.stack.push(Object.fromEntries(STATE.map((name) => [name, this[name]])));
  }

  restore() {
    Object.assign(this, this.stack.pop());
  }

  translate(x, y) {
    this.x += x;
    this.y += y;
  }

  rotate(angle) {
    this.angle += angle;
  }

  setLineDash(dash) {
    this.dash = dash;
  }

  clearRect() {}

  beginPath() {
    this.path = new SvgPath();
  }

  clip(path = this.path) {
    const within = this.clipId === null ? "" : ` clip-path="url(#frame${this.clipId})"`;
    this.clips.push(`<clipPath id="frame${this.clips.length}"${within}><path d="${path.d}"/></clipPath>`);
    this.clipId = this.clips.length - 1;
  }

  stroke(path = this.path) {
    const dash = this.dash.length ? ` stroke-dasharray="${this.dash.join(" ")}"` : "";
    if (path.d && this.lineWidth && this.strokeStyle !== "transparent") this.add("path", `d="${path.d}" fill="none" stroke="${this.strokeStyle}" stroke-width="${round(this.lineWidth)}"${dash}`);
  }

  fill(path = this.path) {
    if (path.d && this.fillStyle !== "transparent") this.add("path", `d="${path.d}" fill="${this.fillStyle}"`);
  }

  fillRect(x, y, width, height) {
    this.add("rect", `x="${round(x)}" y="${round(y)}" width="${round(width)}" height="${round(height)}" fill="${this.fillStyle}"`);
  }

  fillText(text, x, y) {
    if (text === null || text === "") return;
    const size = parseFloat(this.font.match(/[\d.]+(?=px)/)?.[0] ?? 11);
    const [left, top] = [x + this.x, y + this.y + size * (BASELINES[this.textBaseline] ?? 0)];
    const place = this.angle ? `transform="translate(${round(left)} ${round(top)}) rotate(${round((180 * this.angle) / Math.PI)})"` : `x="${round(left)}" y="${round(top)}"`;
    this.parts.push(`<text ${place} fill="${this.fillStyle}" font-size="${size}" text-anchor="${ANCHORS[this.textAlign] ?? "start"}">${escaped(text)}</text>`);
  }

  measureText(text) {
    this.measure.font = this.font;
    return this.measure.measureText(text);
  }

  drawImage(canvas, x, y, width, height) {
    this.add("image", `x="${round(x)}" y="${round(y)}" width="${round(width)}" height="${round(height)}" preserveAspectRatio="none" style="image-rendering:pixelated" href="${canvas.toDataURL()}"`);
  }

  add(tag, attributes) {
    const clip = this.clipId === null ? "" : ` clip-path="url(#frame${this.clipId})"`;
    const alpha = this.globalAlpha === 1 ? "" : ` opacity="${round(100 * this.globalAlpha) / 100}"`;
    const moved = this.x || this.y ? ` transform="translate(${this.x} ${this.y})"` : "";
    this.parts.push(`<${tag} ${attributes}${clip}${alpha}${moved}/>`);
  }
}

// What draws a path adds to the one that was begun.
for (const name of ["moveTo", "lineTo", "rect", "arc"])
  SvgContext.prototype[name] = function (...place) {
    this.path[name](...place);
  };

const HEAD_PX = 50; // px for title, smaller line and legend

// The text of an SVG file. draw(ctx, width, height) draws below the lines [title, smaller line] and the legend:
// [[text, {tone, mark, ring, dash, width, colors}]]. Paths that uPlot makes meanwhile record as well. Drawings are in pixels of
// the screen, `scale` of which are one of the file.
export function svgFile([width, height], [title, about], legend, draw, scale = devicePixelRatio) {
  return inLight(() => {
    const tone = lightPalette();
    const colour = (name) => tone.get(`--${name}`);
    const context = new SvgContext();
    const { Path2D } = window;
    window.Path2D = SvgPath;
    try {
      draw(context, width, height - HEAD_PX);
    } finally {
      window.Path2D = Path2D;
    }
    return [
      `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${width} ${height}" width="${width}" height="${height}" font-family="${FAMILY}">`,
      `<title>${escaped(title)}</title><rect width="${width}" height="${height}" fill="${colour("panel")}"/>`,
      `<text x="10" y="19" fill="${colour("ink")}" font-size="14" font-weight="650">${escaped(title)}</text><text x="10" y="38" fill="${colour("faint")}" font-size="11.5">${escaped(about)}</text>`,
      `<g transform="translate(0 ${HEAD_PX})${scale === 1 ? "" : ` scale(${1 / scale})`}">`, ...context.clips, ...context.parts, "</g>", legendText(legend, width, colour), "</svg>",
    ].join("\n");
  });
}

function legendText(legend, width, colour) {
  let at = width - 16;
  const parts = legend.toReversed().map(([name, { tone, mark, ring, colors = [], dash = [], width: thick = 1.5 }]) => {
    at -= Math.round(6.6 * name.length) + 4;
    const text = `<text x="${at}" y="0" font-size="12" fill="${colour("faint")}">${escaped(name)}</text>`;
    at -= mark === "ramp" ? 9 * colors.length + 5 : 20;
    const stroke = `fill="none" stroke="${colour(tone)}" stroke-width="${thick}"`;
    const sample = {
      dots: `<circle cx="${at + 9}" cy="-4" r="3" ${ring ? stroke : `fill="${colour(tone)}"`}/>`,
      ramp: colors.map((color, k) => `<rect x="${at + 9 * k}" y="-9" width="9" height="10" fill="${color}"/>`).join(""),
      area: `<rect x="${at}" y="-8" width="15" height="8" fill="${colour(tone)}"/>`,
    }[mark] ?? `<path d="M${at} -4h15" ${stroke}${dash.length ? ` stroke-dasharray="${dash.join(" ")}"` : ""}/>`;
    at -= 10;
    return text + sample;
  });
  return `<g transform="translate(0 19)">${parts.join("")}</g>`;
}

// What `make` returns, with the canvas that it makes drawing on a context.
export function drawnOn(context, make) {
  const { getContext } = HTMLCanvasElement.prototype;
  HTMLCanvasElement.prototype.getContext = () => context;
  try {
    return make();
  } finally {
    HTMLCanvasElement.prototype.getContext = getContext;
  }
}

// The same as PNG, twice as fine.
export async function pngOf(svg) {
  const url = URL.createObjectURL(new Blob([svg], { type: "image/svg+xml" }));
  try {
    const image = new Image();
    image.src = url;
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [2 * image.naturalWidth, 2 * image.naturalHeight];
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    return await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
  } finally {
    URL.revokeObjectURL(url);
  }
}

// A plot of Diagnose, which is SVG on the page already

const PLOT_HEAD = 34; // of the viewBox, for two lines
const [TITLE, BOLD] = [8.5, 0.62]; // its size, and the width of a letter as a share of it
const WIDE = 2.5; // px of the file for one of the viewBox
const COPIED = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-dasharray", "font-size"];

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
    for (const name of COPIED) part.setAttribute(name, style.getPropertyValue(name));
    part.removeAttribute("class");
  }
  copy.remove();
  const [wide, high] = [Math.max(width, 12 + BOLD * TITLE * title.length), height + PLOT_HEAD];
  const root = element("svg:svg", { viewBox: `0 0 ${wide} ${high}`, width: Math.round(WIDE * wide), height: Math.round(WIDE * high), "font-family": FAMILY },
    element("svg:title", {}, title),
    element("svg:rect", { width: wide, height: high, fill: palette.get("--panel") }),
    element("svg:text", { x: 6, y: 13, "font-size": TITLE, "font-weight": 650, fill: palette.get("--ink") }, title),
    element("svg:text", { x: 6, y: 25, "font-size": 6.5, fill: palette.get("--faint") }, about),
    element("svg:g", { transform: `translate(0 ${PLOT_HEAD})` }, ...copy.childNodes));
  return new XMLSerializer().serializeToString(root);
}
