// Time, below the stack of charts wherever it is scrolled to.

import { GAP, axis } from "./chart.js";
import { clock } from "./format.js";

const HEIGHT = 24;

export class TimeAxis {
  constructor(node) {
    this.node = node;
    this.span = [0, 1];
    this.plot = new uPlot(
      {
        width: Math.max(50, node.clientWidth), height: HEIGHT, padding: [0, 10, 0, 0],
        legend: { show: false }, cursor: { show: false },
        scales: { x: { time: false, range: () => this.span }, y: { range: () => [0, 1] } },
        axes: [{ ...axis(), size: HEIGHT - 2, values: ticks, space: 60 }, { ...axis(), size: GAP, values: () => [], splits: () => [] }],
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
  return splits.map((value) => clock(value, fraction));
}
