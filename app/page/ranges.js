// The values that an axis spans: grow at once, shrink only when much of it is empty, so that charts do not twitch.

const MARGIN = 0.08;
const ROOMY = 0.5;
const WIDE = 8; // times the usual width of a band, beyond which it does not rule the axis: a prior of ± 2000 m
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

// First and last index of ascending times within a span.
export function within(x, [since, until]) {
  return [bisect(x, since), Math.max(0, bisect(x, until) - 1)];
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
