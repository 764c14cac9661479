// Behind the curves of a chart: episodes as shades, where something was wrong, and the moment that is looked at.

import { colour } from "./chart.js";

export function marks(plot, episodes, at = null) {
  const { ctx, bbox } = plot;
  const [low, high] = [plot.scales.x.min, plot.scales.x.max];
  ctx.save();
  ctx.fillStyle = colour("episode");
  ctx.beginPath();
  for (const episode of episodes) {
    const start = Math.max(episode.from ?? episode.start, low);
    const end = Math.min(episode.to ?? episode.end ?? high, high);
    if (end <= start && !(episode.start >= low && episode.start <= high)) continue;
    const left = plot.valToPos(start, "x", true);
    const right = Math.max(left + 2, plot.valToPos(end, "x", true));
    ctx.rect(left, bbox.top, right - left, bbox.height);
  }
  ctx.fill(); // once, so that several at one time are no darker
  if (at !== null && at > low && at < high) {
    ctx.fillStyle = colour("faint");
    ctx.fillRect(Math.round(plot.valToPos(at, "x", true)), bbox.top, devicePixelRatio, bbox.height);
  }
  ctx.restore();
}
