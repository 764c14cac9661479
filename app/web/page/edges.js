// What lies outside of a chart's value axis: marks at its edge where that is, and of the furthest how far. The axis does
// not follow every wild value (ranges.js); none of them is lost.

const APART = 7; // px from one mark to the next
const UNTOLD = new Set(["previous", "bound", "integrity"]); // tones of lines that may leave a chart without a word

// The marks: [{x, value, tone, above, furthest}] of columns in the order of `series`; `place(x)` in px.
export function outsiders(data, series, [since, until], [low, high], place) {
  const found = [];
  const x = data[0];
  for (const above of [true, false]) {
    const slots = new Map();
    series.forEach(({ mark, tone }, k) => {
      if (!mark || UNTOLD.has(tone)) return;
      const values = data[k + 1] ?? [];
      for (let i = 0; i < x.length; i++) {
        const value = values[i];
        if (typeof value !== "number" || (above ? value <= high : value >= low) || x[i] < since || x[i] > until) continue;
        const slot = Math.round(place(x[i]) / APART);
        const known = slots.get(slot);
        if (!known || (above ? value > known.value : value < known.value)) slots.set(slot, { x: x[i], value, tone, above });
      }
    });
    const marks = [...slots.values()];
    const furthest = marks.reduce((most, mark) => (most === null || (above ? mark.value > most.value : mark.value < most.value) ? mark : most), null);
    if (furthest) furthest.furthest = true;
    found.push(...marks);
  }
  return found;
}

// On the canvas of a plot; `says(value)`: what is written beside the furthest.
export function drawOutsiders(plot, series, says, colour) {
  const { ctx, bbox } = plot;
  const scale = devicePixelRatio;
  const { x: { min: since, max: until }, y: { min: low, max: high } } = plot.scales;
  const place = (time) => plot.valToPos(time, "x", true) / scale;
  const marks = outsiders(plot.data, series, [since, until], [low, high], place);
  if (!marks.length) return marks;
  const size = 4.5 * scale;
  ctx.save();
  ctx.font = `${11 * scale}px system-ui, sans-serif`;
  for (const { x, tone, above } of marks) {
    const at = plot.valToPos(x, "x", true);
    const [tip, base] = above ? [bbox.top + scale, bbox.top + 2 * size] : [bbox.top + bbox.height - scale, bbox.top + bbox.height - 2 * size];
    ctx.fillStyle = colour(tone);
    ctx.beginPath();
    ctx.moveTo(at, tip);
    ctx.lineTo(at - size, base);
    ctx.lineTo(at + size, base);
    ctx.fill();
  }
  for (const { x, value, above } of marks.filter((mark) => mark.furthest)) {
    const at = plot.valToPos(x, "x", true);
    const tip = above ? bbox.top + scale : bbox.top + bbox.height - scale;
    const late = at > bbox.left + 0.8 * bbox.width;
    const text = says(value);
    const { width } = ctx.measureText(text);
    const left = at + (late ? -1.6 * size - width : 1.6 * size);
    // On a plate, as there may be much beneath it.
    ctx.fillStyle = colour("panel");
    ctx.fillRect(left - 2 * scale, above ? tip : tip - 12 * scale, width + 4 * scale, 12 * scale);
    ctx.fillStyle = colour("faint");
    ctx.textAlign = "left";
    ctx.textBaseline = above ? "top" : "bottom";
    ctx.fillText(text, left, tip);
  }
  ctx.restore();
  return marks;
}
