// The values that an axis spans: grow at once, shrink only when much of it is empty, so that charts do not twitch.

const MARGIN = 0.08;
const ROOMY = 0.5;
const WIDE = 8; // times the usual width of a band, beyond which it does not rule the axis: a prior of ± 2000 m
const SETTLING = 0.1; // share of the rows, the first ones, in which a line may settle
const WILD_SHARE = 0.05; // share of the dots, at either end, that may be wild
const FAR = 1; // times the span of all others, beyond which a value does not rule the axis
const USUAL = 0.2; // share of the rows whose band is narrower than the usual one

export class Range {
  constructor() {
    this.low = this.high = NaN;
  }

  fit(low, high) {
    if (!Number.isFinite(low) || !Number.isFinite(high)) return Number.isFinite(this.low) ? [this.low, this.high] : [0, 1];
    const roomy = high - low < ROOMY * (this.high - this.low);
    if (!(this.low <= low && high <= this.high) || roomy) {
      const margin = MARGIN * (high - low) || Math.max(1e-9, 1e-3 * Math.abs(high));
      this.low = low - margin;
      this.high = high + margin;
    }
    return [this.low, this.high];
  }
}

// The span of two spans.
export const union = ([low, high], [under, over]) => [Math.min(low, under), Math.max(high, over)];

// Lowest and highest of some columns between two indices.
export function extent(columns, from, to) {
  let low = Infinity;
  let high = -Infinity;
  for (const values of columns)
    for (let k = from; k <= to; k++) {
      const value = values[k];
      if (typeof value !== "number") continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  return [low, high];
}

// The same of a band, without what is far wider than it mostly is.
export function bandExtent(lower, upper, from, to) {
  const widths = [];
  for (let k = from; k <= to; k++) if (typeof upper[k] === "number" && typeof lower[k] === "number") widths.push(upper[k] - lower[k]);
  if (!widths.length) return [Infinity, -Infinity];
  const most = WIDE * widths.sort((a, b) => a - b)[Math.floor(USUAL * widths.length)];
  let low = Infinity;
  let high = -Infinity;
  for (let k = from; k <= to; k++) {
    if (typeof upper[k] !== "number" || typeof lower[k] !== "number" || upper[k] - lower[k] > most) continue;
    if (lower[k] < low) low = lower[k];
    if (upper[k] > high) high = upper[k];
  }
  return [low, high];
}

// What an axis spans: lines once they have settled, bands, and nearly all of the dots; of the rest what is not far from
// these. What is left lies outside, where drawing.js marks it: one wild value does not flatten all others.
export function shownExtent({ lines = [], bands = [], dots = [] }, from, to) {
  const settled = from + Math.ceil(SETTLING * (to - from));
  let [low, high] = extent(lines, settled, to);
  const take = (other) => ([low, high] = union([low, high], other));
  for (const [lower, upper] of bands) take(bandExtent(lower, upper, from, to));
  take(middle(dots, from, to));
  const reach = FAR * (high - low);
  const near = reach > 0 ? [low - reach, high + reach] : [-Infinity, Infinity];
  for (const values of [...lines, ...dots])
    for (let k = from; k <= to; k++) {
      const value = values[k];
      if (typeof value === "number" && near[0] <= value && value <= near[1]) take([value, value]);
    }
  return [low, high];
}

// Of all these together: from the value below which few are to that above which few are; of a handful of them all.
function middle(columns, from, to) {
  const known = [];
  for (const values of columns) for (let k = from; k <= to; k++) if (typeof values[k] === "number") known.push(values[k]);
  if (!known.length) return [Infinity, -Infinity];
  known.sort((a, b) => a - b);
  const last = known.length - 1;
  return [known[Math.floor(WILD_SHARE * last)], known[Math.ceil((1 - WILD_SHARE) * last)]];
}

// First and last index of ascending times within a span.
export function within(x, [since, until]) {
  return [bisect(x, since), Math.max(0, bisect(x, until) - 1)];
}

// How many ascending times are before a moment.
export const until = (x, moment) => (x.length && x[0] <= moment ? within(x, [-Infinity, moment])[1] + 1 : 0);

// Index of the one of ascending values that is nearest.
export function nearest(x, value) {
  const above = bisect(x, value);
  return above > 0 && value - x[above - 1] < x[above] - value ? above - 1 : above;
}

function bisect(x, value) {
  let low = 0;
  let high = x.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (x[middle] < value) low = middle + 1;
    else high = middle;
  }
  return Math.min(low, Math.max(0, x.length - 1));
}
