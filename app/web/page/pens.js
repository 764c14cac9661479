// The same drawing on a canvas of the page, or as SVG for a file. Colours are named; places are pixels.

import { colour } from "./chart.js";

export class CanvasPen {
  constructor(ctx) {
    this.ctx = ctx;
    ctx.font = "11px system-ui, sans-serif";
  }

  curve(points, tone, width = 1, dash = []) {
    const { ctx } = this;
    ctx.strokeStyle = colour(tone);
    ctx.lineWidth = width;
    ctx.setLineDash(dash);
    ctx.beginPath();
    for (const point of points) ctx.lineTo(...point);
    ctx.stroke();
    ctx.setLineDash([]);
  }

  // Within a frame [left, top, width, height].
  dots(points, tone, radius, frame) {
    const { ctx } = this;
    ctx.save();
    ctx.beginPath();
    ctx.rect(...frame);
    ctx.clip();
    ctx.fillStyle = colour(tone);
    for (const point of points) {
      ctx.beginPath();
      ctx.arc(...point, radius, 0, 2 * Math.PI);
      ctx.fill();
    }
    ctx.restore();
  }

  text(words, [x, y], align = "center", upright = false) {
    const { ctx } = this;
    ctx.save();
    ctx.fillStyle = colour("faint");
    ctx.textAlign = align;
    ctx.translate(x, y);
    if (upright) ctx.rotate(-Math.PI / 2);
    ctx.fillText(words, 0, 0);
    ctx.restore();
  }
}

const ANCHORS = { center: "middle", right: "end", left: "start" };
const round = (value) => Math.round(10 * Math.min(1e5, Math.max(-1e5, value))) / 10;
const escaped = (text) => text.replace(/[&<>"]/g, (sign) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[sign]);

export class SvgPen {
  // tone(name): a colour
  constructor(tone) {
    this.tone = tone;
    this.parts = [];
  }

  curve(points, tone, width = 1, dash = []) {
    const path = points.map(([x, y], k) => `${k ? "L" : "M"}${round(x)} ${round(y)}`).join("");
    if (path) this.parts.push(`<path d="${path}" fill="none" stroke="${this.tone(tone)}" stroke-width="${width}"${dash.length ? ` stroke-dasharray="${dash.join(" ")}"` : ""}/>`);
  }

  dots(points, tone, radius, [left, top, width, height]) {
    const inside = points.filter(([x, y]) => x >= left && x <= left + width && y >= top && y <= top + height);
    this.parts.push(`<g fill="${this.tone(tone)}">${inside.map(([x, y]) => `<circle cx="${round(x)}" cy="${round(y)}" r="${radius}"/>`).join("")}</g>`);
  }

  text(words, [x, y], align = "center", upright = false) {
    const place = upright ? `transform="translate(${round(x)} ${round(y)}) rotate(-90)"` : `x="${round(x)}" y="${round(y)}"`;
    this.parts.push(`<text ${place} text-anchor="${ANCHORS[align]}">${escaped(words)}</text>`);
  }

  // The whole file; lines: [title, smaller line] above the drawing.
  file(width, height, [title, about]) {
    const top = 48;
    return [
      `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${width} ${height + top}" width="${width}" height="${height + top}" font-size="11" fill="${this.tone("faint")}" font-family="system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif">`,
      `<title>${escaped(title)}</title><rect width="${width}" height="${height + top}" fill="${this.tone("panel")}"/>`,
      `<text x="10" y="19" fill="${this.tone("ink")}" font-size="14" font-weight="650">${escaped(title)}</text><text x="10" y="37">${escaped(about)}</text>`,
      `<g transform="translate(0 ${top})">`, ...this.parts, "</g></svg>",
    ].join("\n");
  }
}
