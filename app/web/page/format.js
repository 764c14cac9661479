// Numbers, units and times as text.

// A value with its deviation: as many digits as the deviation justifies.
export function withDeviation(value, deviation, unit) {
  if (!Number.isFinite(value)) return "–";
  if (!Number.isFinite(deviation) || deviation <= 0) return `${compact(value)}${spaced(unit)}`;
  const digits = decimals(deviation);
  return `${fixed(value, digits)} ± ${deviation.toFixed(digits)}${spaced(unit)}`;
}

// Decimals that a deviation justifies: two digits of it.
export const decimals = (deviation) => Math.min(8, Math.max(0, 1 - Math.floor(Math.log10(deviation))));

// Without a zero below zero.
export const fixed = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]*$)/, "");

// Four digits, no exponent where it can be helped.
export function compact(value, digits = 4) {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  const rounded = Number(value.toPrecision(digits));
  if (size < 1e6 && size >= 1e-4) return String(rounded);
  return rounded.toExponential().replace("e+", "e");
}

export const size = (bytes) => (bytes < 1e6 ? `${Math.max(1, Math.round(bytes / 1e3))} kB` : bytes < 1e9 ? `${compact(bytes / 1e6, 3)} MB` : `${compact(bytes / 1e9, 3)} GB`);

// A number of things: 1 reading, 1,200 readings.
export const count = (number, word) => `${number.toLocaleString("en")} ${word}${number === 1 ? "" : "s"}`;

export const spaced = (unit) => (unit && unit !== "1" ? ` ${unit}` : "");

export const bracketed = (unit) => (unit && unit !== "1" ? `[${unit}]` : "");

const MAX_HOURS = 24; // from which on a clock counts days

// Seconds of the log as a clock: 0:07.3, 12:31, 3:05:00, 2 d 07:30.
export function clock(seconds, fraction = 0) {
  if (!Number.isFinite(seconds)) return "–";
  const sign = seconds < 0 ? "-" : "";
  const scale = 10 ** fraction;
  const all = Math.round(Math.abs(seconds) * scale) / scale;
  const hours = Math.floor(all / 3600);
  const minutes = Math.floor((all % 3600) / 60);
  const rest = (all % 60).toFixed(fraction).padStart(fraction ? 3 + fraction : 2, "0");
  if (hours >= MAX_HOURS) return `${sign}${Math.floor(hours / 24)} d ${String(hours % 24).padStart(2, "0")}:${String(minutes).padStart(2, "0")}`;
  return hours ? `${sign}${hours}:${String(minutes).padStart(2, "0")}:${rest}` : `${sign}${minutes}:${rest}`;
}

const NAMES = /(?<![\w.[])[A-Za-z]\w*(?:\.\w+)?(?:\[[\d,]+\])?(?![\w[]|\.\w)/g; // of states and rows; not after "R." or "Q."

// A sentence with the labels of its names, and its "since 2019-03-01 11:14:41 UTC" in the time of the charts, which count from `origin`, ns.
export function inChartTime(text, origin) {
  const start = Number(origin ?? NaN) * 1e-9;
  if (!Number.isFinite(start)) return text;
  return text
    .replace(NAMES, (name) => (Object.hasOwn(labels, name) ? words(name) : name))
    .replace(/since (\d{4}-\d\d-\d\d) (\d\d:\d\d:\d\d) UTC/g, (_, day, time) => `since ${clock(Math.max(0, Date.parse(`${day}T${time}Z`) / 1000 - Math.floor(start)))}`)
    .replace(/since ([\d.]+) s\b/g, (_, seconds) => `since ${clock(Math.max(0, seconds - start), 1)}`);
}

// A length of time: 3.2 s, 4 min, 2.5 h, 329 d.
export function span(seconds) {
  if (seconds > 0 && seconds < 0.1) return `${Number((1000 * seconds).toPrecision(2))} ms`;
  if (seconds < 10) return `${Number(seconds.toPrecision(2))} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${Number((seconds / 3600).toPrecision(2))} h`;
  return `${Number((seconds / 86400).toPrecision(3))} d`;
}

let labels = {}; // of the twin, by name

// Take the labels of a twin: {name: label} of states, sensors, rows and parameters. A name without one is its words.
export function setLabels({ labels: known, states, rows }) {
  const names = [...states, ...rows].map(({ name }) => name).filter((name) => name.includes("_"));
  labels = { ...Object.fromEntries(names.map((name) => [name, name.replaceAll("_", " ")])), ...known };
}

export const words = (name) => (Object.hasOwn(labels, name) ? labels[name] : name.replaceAll("_", " "));

