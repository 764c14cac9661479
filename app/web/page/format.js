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

export const spaced = (unit) => (unit && unit !== "1" ? ` ${unit}` : "");

export const bracketed = (unit) => (unit && unit !== "1" ? `[${unit}]` : "");

const MAX_HOURS = 48; // from which on a clock counts days

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

const DAY = 86400; // s

// A sentence with its "since 11:14:41 UTC" in the time of the charts, which count from `origin`, ns. Over more than a day
// the time of day does not tell the moment, and stays.
export function inChartTime(text, origin, newest) {
  const start = Number(origin ?? NaN) * 1e-9;
  if (!Number.isFinite(start) || newest * 1e-9 - start > DAY) return text;
  const of = (hours, minutes, seconds) => (((3600 * hours + 60 * minutes + 1 * seconds - Math.floor(start)) % DAY) + DAY) % DAY;
  return text
    .replace(/since (\d\d):(\d\d):(\d\d) UTC/g, (_, ...parts) => `since ${clock(of(...parts))}`)
    .replace(/since ([\d.]+) s\b/g, (_, seconds) => `since ${clock(Math.max(0, seconds - start), 1)}`);
}

// A length of time: 3.2 s, 4 min, 2.5 h.
export function span(seconds) {
  if (seconds > 0 && seconds < 0.1) return `${Number((1000 * seconds).toPrecision(2))} ms`;
  if (seconds < 10) return `${Number(seconds.toPrecision(2))} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  return `${Number((seconds / 3600).toPrecision(2))} h`;
}

export const words = (name) => name.replaceAll("_", " ");

