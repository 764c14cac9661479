// Behind the curves of a chart: where something was wrong, and the moment that is looked at.

import { colour } from "./chart.js";

const STRIP = 2; // px
const SHARE = 0.15; // of a chart, beyond which its tint fades, as what covers all tells nothing

// Episodes between two times as stretches that do not overlap, [[from, to]], and how strong their tint is, up to 1.
export function stretches(episodes, [low, high]) {
  const found = [];
  const inside = episodes
    .map(({ from, to }) => [Math.max(from ?? low, low), Math.min(to ?? high, high)])
    .filter(([from, to]) => to >= from)
    .sort(([a], [b]) => a - b);
  for (const [from, to] of inside) {
    const last = found.at(-1);
    if (last && from <= last[1]) last[1] = Math.max(last[1], to);
    else found.push([from, to]);
  }
  const covered = found.reduce((sum, [from, to]) => sum + to - from, 0);
  return { found, strength: Math.min(1, (SHARE * (high - low)) / (covered || 1e-9)) };
}

export function marks(plot, episodes, at = null) {
  const { ctx, bbox } = plot;
  const [low, high] = [plot.scales.x.min, plot.scales.x.max];
  const { found, strength } = stretches(episodes, [low, high]);
  ctx.save();
  for (const [from, to] of found) {
    const left = plot.valToPos(from, "x", true);
    const width = Math.max(2, plot.valToPos(to, "x", true) - left);
    ctx.fillStyle = colour("episode");
    ctx.globalAlpha = strength;
    ctx.fillRect(left, bbox.top, width, bbox.height);
    ctx.fillStyle = colour("episode-strip");
    ctx.globalAlpha = 1;
    ctx.fillRect(left, bbox.top, width, STRIP * devicePixelRatio);
  }
  if (at !== null && at > low && at < high) {
    ctx.fillStyle = colour("faint");
    ctx.fillRect(Math.round(plot.valToPos(at, "x", true)), bbox.top, devicePixelRatio, bbox.height);
  }
  ctx.restore();
}
