// Drawings on a plot beside its series: curves of other streams, episodes, values beyond the axis. They draw alike on
// the page's canvas and into a file (svg.js).

import { within } from "./ranges.js";

const styles = getComputedStyle(document.documentElement);
let light = null;

// A colour of the page's theme, or of the light one while a file is drawn.
export const colour = (name) => light?.get(`--${name}`) ?? styles.getPropertyValue(`--${name}`).trim();

// Draw in the colours of the light theme, which stand in the page's own style.
export function inLight(draw) {
  light = lightPalette();
  try {
    return draw();
  } finally {
    light = null;
  }
}

export function lightPalette() {
  for (const sheet of document.styleSheets)
    for (const rule of sheet.cssRules)
      if (rule.selectorText === ":root" && rule.style.getPropertyValue("--estimate"))
        return new Map([...rule.style].filter((name) => name.startsWith("--")).map((name) => [name, rule.style.getPropertyValue(name).trim()]));
  throw new Error("the style sheet of the page was not loaded; reload the page");
}

// The context of a canvas, cleared and as fine as the screen, to draw in px of the page.
export function fineContext(canvas) {
  const size = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.round(length * devicePixelRatio));
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  const ctx = canvas.getContext("2d");
  ctx.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
  ctx.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  return ctx;
}

// The context of a plot in which nothing leaves its frame, until it is restored.
export function clipped({ ctx, bbox }) {
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  return ctx;
}

// A line through places of a canvas, px.
export function stroke(ctx, places, tone, width = devicePixelRatio, dash = []) {
  ctx.strokeStyle = colour(tone);
  ctx.lineWidth = width;
  ctx.setLineDash(dash);
  ctx.beginPath();
  for (const place of places) ctx.lineTo(...place);
  ctx.stroke();
}

// The area within places of a canvas, px.
export function fill(ctx, places, tone) {
  ctx.fillStyle = colour(tone);
  ctx.beginPath();
  for (const place of places) ctx.lineTo(...place);
  ctx.fill();
}

// A curve {x, values, tone, width, dash}, broken where a value is null; undefined values are skipped. With `fill`, a
// share of opacity, an area with that outline.
export function trace(plot, { x, values, tone, width = 1, dash = [], fill: opacity }) {
  if (!x.length) return;
  const ctx = clipped(plot);
  const scale = devicePixelRatio;
  const [from, to] = opacity ? [0, x.length - 1] : within(x, [plot.scales.x.min, plot.scales.x.max]);
  ctx.beginPath();
  let open = false;
  for (let k = Math.max(0, from - 1); k <= Math.min(x.length - 1, to + 1); k++) {
    if (values[k] === null) open = false;
    if (typeof values[k] !== "number") continue;
    const place = [plot.valToPos(x[k], "x", true), plot.valToPos(values[k], "y", true)];
    if (open) ctx.lineTo(...place);
    else ctx.moveTo(...place);
    open = true;
  }
  if (opacity) {
    ctx.globalAlpha = opacity;
    ctx.fillStyle = colour(tone);
    ctx.fill();
  } else {
    ctx.strokeStyle = colour(tone);
    ctx.lineWidth = width * scale;
    ctx.setLineDash(dash.map((length) => length * scale));
    ctx.stroke();
  }
  ctx.restore();
}

// The outline of a band, for `trace`.
export function area(x, upper, lower) {
  const rows = x.flatMap((_, k) => (typeof upper[k] === "number" && typeof lower[k] === "number" ? [k] : []));
  const back = rows.toReversed();
  return { x: [...rows, ...back].map((k) => x[k]), values: [...rows.map((k) => upper[k]), ...back.map((k) => lower[k])] };
}

// An angle between -π and π; and a curve of such, which leaves the chart at one edge and comes back at the other.
const wrapped = (value) => (typeof value === "number" ? value - 2 * Math.PI * Math.round(value / (2 * Math.PI)) : value);

export function unbroken(values) {
  let before = NaN;
  return values.map((given) => {
    const value = wrapped(given);
    if (typeof value !== "number") return value;
    const leaves = Math.abs(value - before) > Math.PI;
    before = value;
    return leaves ? null : value;
  });
}

// The edge of a band of an angle, about its wrapped mean.
const aboutMean = (mean, values) => values.map((value, k) => (typeof value === "number" && typeof mean[k] === "number" ? wrapped(mean[k]) + value - mean[k] : value));

// Columns of an angle by name, as they are drawn: measurements and curves between -π and π, edges of bands about their mean.
export const angular = (columns, mean) =>
  Object.fromEntries(Object.entries(columns).map(([name, values]) => [name, name.includes(":") ? values.map(wrapped) : /(^|_)(upper|lower)/.test(name) ? aboutMean(mean, values) : unbroken(values)]));

// Episodes

const STRIP = 2; // px
const MAX_TINTED_SHARE = 0.15; // of a chart, beyond which the tint of episodes fades; their strip stays

// Episodes between two times as stretches that do not overlap, [[from, to]], and the strength of their tint, up to 1.
function stretches(episodes, [low, high]) {
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
  return { found, strength: Math.min(1, (MAX_TINTED_SHARE * (high - low)) / (covered || 1e-9)) };
}

// Behind the curves of a chart: episodes that concern it, and the moment that is looked at. `subjects`: names of its
// states and rows; an episode of a sensor concerns its rows ("scan", "scan.left"). An advisory has a strip of its own
// colour and no tint. The time bar has all episodes.
export function marks(plot, { episodes, view: { at } }, subjects) {
  const { ctx, bbox } = plot;
  const concerns = ({ subject }) => subjects.some((name) => name === subject || name.startsWith(`${subject}.`));
  const [low, high] = [plot.scales.x.min, plot.scales.x.max];
  const own = episodes.filter(concerns);
  const { found, strength } = stretches(own.filter(({ grade }) => grade !== "advisory"), [low, high]);
  const advised = stretches(own.filter(({ grade }) => grade === "advisory"), [low, high]).found;
  plot.marked = found.length > 0;
  plot.advised = advised.length > 0;
  ctx.save();
  ctx.fillStyle = colour("health-advisory");
  for (const [from, to] of advised) {
    const left = plot.valToPos(from, "x", true);
    ctx.fillRect(left, bbox.top, Math.max(2, plot.valToPos(to, "x", true) - left), STRIP * devicePixelRatio);
  }
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

// Notes at moments

const FLAG = 7; // px
const NOTE_ROW = 15; // px of the line of texts

// notes: [{from, text}] by time: those that are shown, with their places.
function flags(plot, notes) {
  const { min, max } = plot.scales.x;
  return notes.filter(({ from }) => min <= from && from <= max).map((note) => ({ ...note, left: Math.round(plot.valToPos(note.from, "x", true)) + devicePixelRatio / 2 }));
}

// A dotted line with a flag for each.
export function drawNotes(plot, notes) {
  const { ctx, bbox } = plot;
  const scale = devicePixelRatio;
  const size = FLAG * scale;
  ctx.save();
  for (const { left } of flags(plot, notes)) {
    stroke(ctx, [[left, bbox.top], [left, bbox.top + bbox.height]], "ink", scale, [scale, 3 * scale]);
    fill(ctx, [[left, bbox.top], [left + size, bbox.top + size / 2], [left, bbox.top + size]], "ink");
  }
  ctx.restore();
}

// Their texts as far as there is room to the next one; that at the moment which is looked at, `at`, in full. `lower`: the
// first line is taken. Returns the texts as they are written.
export function writeNotes(plot, notes, at, lower) {
  const { ctx, bbox } = plot;
  const scale = devicePixelRatio;
  const top = bbox.top + (lower ? NOTE_ROW * scale : 0);
  ctx.save();
  ctx.font = `${11 * scale}px system-ui, sans-serif`;
  ctx.textBaseline = "top";
  ctx.textAlign = "left";
  const found = placed(plot, flags(plot, notes), at);
  for (const { text, start, width } of found) {
    ctx.fillStyle = colour("panel");
    ctx.fillRect(start - 2 * scale, top, width + 4 * scale, (NOTE_ROW - 1) * scale);
    ctx.fillStyle = colour("ink");
    ctx.fillText(text, start, top + 2 * scale);
  }
  ctx.restore();
  return found.map(({ text }) => text);
}

// [{text, start, width}] of the notes whose text has a place: to the right of its flag, or the last one to the left.
function placed({ ctx, bbox, scales: { x } }, shown, at) {
  const scale = devicePixelRatio;
  const [gap, right] = [(FLAG + 4) * scale, bbox.left + bbox.width - 4 * scale];
  const near = (1.5 * (x.max - x.min)) / bbox.width; // s in one and a half px
  const found = [];
  let end = bbox.left; // of the text before
  shown.forEach(({ from, text, left }, k) => {
    const full = ctx.measureText(text).width;
    const looked = at !== null && Math.abs(from - at) <= near;
    const until = looked ? right : Math.min(right, (shown[k + 1]?.left ?? Infinity) - 6 * scale);
    const [after, before] = [until - left - gap, left - 6 * scale - (looked ? bbox.left : end)];
    const flipped = after < full && before > after && (looked || k === shown.length - 1);
    const cut = fitted(ctx, text, full, flipped ? before : after);
    if (!cut) return;
    const width = Math.min(full, ctx.measureText(cut).width);
    const start = flipped ? left - 6 * scale - width : left + gap;
    end = start + width;
    found.push({ text: cut, start, width, looked });
  });
  return found.sort((a, b) => a.looked - b.looked);
}

// A text cut to a width, with its end marked; "" where not even a few letters have room.
function fitted(ctx, text, full, room) {
  if (full <= room) return text;
  const letters = Math.floor((text.length * room) / full) - 2;
  return letters < 3 ? "" : `${text.slice(0, letters).trimEnd()}…`;
}

// Values beyond the axis. The axis does not follow every outlier (ranges.js); each is marked at the edge of the chart,
// and the furthest with its value.

const APART = 7; // px from one mark to the next
const UNMARKED = new Set(["bound"]); // tones of lines that may leave a chart

// [{x, value, tone, above, furthest}] of columns in the order of `series`; place(x) in px.
function outsiders(data, series, [since, until], [low, high], place) {
  const found = [];
  const x = data[0];
  for (const above of [true, false]) {
    const slots = new Map();
    series.forEach(({ mark, tone }, k) => {
      if (!mark || UNMARKED.has(tone)) return;
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

// says(value): text beside the furthest. Returns the marks.
export function drawOutsiders(plot, series, says) {
  const { ctx, bbox } = plot;
  const scale = devicePixelRatio;
  const { x: { min: since, max: until }, y: { min: low, max: high } } = plot.scales;
  const place = (time) => plot.valToPos(time, "x", true) / scale;
  const found = outsiders(plot.data, series, [since, until], [low, high], place);
  if (!found.length) return found;
  const size = 4.5 * scale;
  ctx.save();
  ctx.font = `${11 * scale}px system-ui, sans-serif`;
  for (const { x, tone, above } of found) {
    const at = plot.valToPos(x, "x", true);
    const [tip, base] = above ? [bbox.top + scale, bbox.top + 2 * size] : [bbox.top + bbox.height - scale, bbox.top + bbox.height - 2 * size];
    fill(ctx, [[at, tip], [at - size, base], [at + size, base]], tone);
  }
  for (const { x, value, above } of found.filter((mark) => mark.furthest)) {
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
  return found;
}
