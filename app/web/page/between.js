// Of rows in groups only the extremes have come: a faint box from one to the other stands for the readings between, so
// that noise does not look like two rows of marks.

import { clipped, colour } from "./chart.js";

const FAINT = 0.22;

// The boxes of a column: first and last time of a group, its first and last extreme.
function boxes(lane, name) {
  const found = [];
  const column = lane.each === 2 ? lane.column(name) : [];
  for (let k = 0; k + 1 < column.length; k += 2)
    if (typeof column[k] === "number" && typeof column[k + 1] === "number") found.push([lane.x[k], lane.x[k + 1], column[k], column[k + 1]]);
  return found;
}

export function drawBetween(plot, lane, names) {
  const ctx = clipped(plot);
  ctx.globalAlpha = FAINT;
  ctx.fillStyle = colour("reading");
  for (const [since, until, one, other] of names.flatMap((name) => boxes(lane, name))) {
    const [left, right] = [since, until].map((time) => plot.valToPos(time, "x", true));
    const [from, to] = [one, other].map((value) => plot.valToPos(value, "y", true));
    ctx.fillRect(left, from, Math.max(devicePixelRatio, right - left), to - from);
  }
  ctx.restore();
}

// The same as outlines of a file.
export const betweenCurves = (lane, names) => names.map((name) => {
  const found = boxes(lane, name);
  return {
    tone: "reading", name: "", fill: FAINT,
    x: found.flatMap(([since, until]) => [since, until, until, since, since]),
    values: found.flatMap(([, , one, other]) => [one, one, other, other, null]),
  };
});
