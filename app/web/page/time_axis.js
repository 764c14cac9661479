// Time, below the stack of charts wherever it is scrolled to.

import { GAP, axis } from "./chart.js";
import { clock } from "./format.js";

const HEIGHT = 24;
const HALF = 24; // px that a label at the right end may take from the axis to its left

// Steps of a clock, s: nobody counts time in quarters of ten seconds.
const STEPS = [
  0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800,
  21600, 43200, 86400, 172800, 345600, 864000, 2592000, 8640000, 31536000,
];

export class TimeAxis {
  constructor(node) {
    this.node = node;
    this.span = [0, 1];
    this.plot = new uPlot(
      {
        width: Math.max(50, node.clientWidth), height: HEIGHT, padding: [0, 10, 0, 0],
        legend: { show: false }, cursor: { show: false },
        scales: { x: { time: false, range: () => this.span }, y: { range: () => [0, 1] } },
        axes: [{ ...axis(), size: HEIGHT - 2, values: ticks, incrs: STEPS, space: 60 }, { ...axis(), size: GAP, values: () => [], splits: () => [] }],
        series: [{}, { show: false }],
      },
      [[], []],
      node,
    );
    new ResizeObserver(() => this.plot.setSize({ width: node.clientWidth, height: HEIGHT })).observe(node);
  }

  show(span) {
    this.span = span;
    this.plot.setData([span, [0, 0]], false);
    this.plot.setScale("x", { min: span[0], max: span[1] });
  }
}

function ticks(self, splits) {
  const step = splits.length > 1 ? splits[1] - splits[0] : 1;
  const fraction = step >= 1 ? 0 : Math.min(3, Math.ceil(-Math.log10(step)));
  // One at the very end would be cut off.
  const last = self.posToVal(self.over.clientWidth + 10 - HALF, "x");
  return splits.map((value) => (value > last ? "" : clock(value, fraction)));
}
