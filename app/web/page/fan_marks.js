// On a fan of what may be: now, the limit, and how likely it is passed.

import { colour } from "./chart.js";

const SURE = 0.25; // of a chart's height, of certainty

// At the foot of the chart, as high as a quarter of it: how likely the limit has been passed by each time.
export function probability(plot, times, found) {
  if (!found || !times || !(found.overall >= 0.005)) return;
  const { ctx, bbox } = plot;
  const foot = bbox.top + bbox.height;
  const place = (share, k) => [plot.valToPos(times[k], "x", true), foot - SURE * bbox.height * share];
  ctx.save();
  ctx.setLineDash([]);
  ctx.beginPath();
  ctx.moveTo(plot.valToPos(times[0], "x", true), foot);
  found.probability.forEach((share, k) => ctx.lineTo(...place(share ?? 0, k)));
  ctx.lineTo(plot.valToPos(times.at(-1), "x", true), foot);
  ctx.fillStyle = colour("bounds");
  ctx.fill();
  ctx.beginPath();
  found.probability.forEach((share, k) => ctx.lineTo(...place(share ?? 0, k)));
  ctx.strokeStyle = colour("ink");
  ctx.lineWidth = devicePixelRatio;
  ctx.stroke();
  const [x, y] = place(found.probability.at(-1) ?? 0, times.length - 1);
  ctx.fillStyle = colour("faint");
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "right";
  ctx.textBaseline = "bottom";
  ctx.fillText(`P ${Math.round(100 * found.probability.at(-1))} %`, x - 4 * devicePixelRatio, y - 2 * devicePixelRatio);
  ctx.restore();
}

// Now, upright; the limit, level.
export function lines(plot, now, limit) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.lineWidth = devicePixelRatio;
  const draw = (name, dash, ...points) => {
    ctx.strokeStyle = colour(name);
    ctx.setLineDash(dash.map((length) => length * devicePixelRatio));
    ctx.beginPath();
    ctx.moveTo(...points[0]);
    ctx.lineTo(...points[1]);
    ctx.stroke();
  };
  if (now !== undefined) {
    const x = plot.valToPos(now, "x", true);
    draw("faint", [], [x, bbox.top], [x, bbox.top + bbox.height]);
  }
  if (limit !== undefined) {
    const y = plot.valToPos(limit, "y", true);
    draw("ink", [8, 4], [bbox.left, y], [bbox.left + bbox.width, y]);
  }
  ctx.restore();
}
