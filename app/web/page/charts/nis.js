// NIS per degree of freedom on a logarithmic axis: from a stuck sensor's 0.02 to an outlier's 200.

import { apart, band, dots, line } from "../chart.js";
import { marks } from "../drawing.js";
import { compact } from "../format.js";
import { shownExtent, within } from "../ranges.js";

export const order = 3;

const TICKS = [1, 0.1, 10, 0.01, 100, 1000, 0.3, 3, 0.03, 30, 300]; // the most useful first

export default (charts) => {
  const { live } = charts;
  const log = (value) => (typeof value === "number" ? Math.log10(Math.max(value / charts.nisDof, 1e-9)) : value);
  return [{
    key: "nis",
    title: "NIS / dof",
    unit: "",
    note: `running mean and its 95 % bounds${charts.model.commissioned ? " of the baseline" : ""}`,
    help: "Normalised innovation squared per degree of freedom: 1 where innovations are as large as predicted",
    names: { estimate: "mean", bound: "" },
    weight: 1,
    columns: ["nis", "nis_mean", "nis_low", "nis_high"],
    series: { nis: dots("quiet", 2.5), high: line("bound", { width: 1 }), low: line("bound", { width: 1 }), mean: line("estimate", { width: 1.75 }) },
    bands: [band("bounds", "high", "low")],
    axis: {
      // One first, then as many of the others as have room.
      splits: (self, axis, low, high) => apart(TICKS.map(Math.log10).filter((v) => low <= v && v <= high), self, "y"),
      values: (self, splits) => splits.map((v) => compact(10 ** v, 1)),
    },
    paint: (plot) => marks(plot, charts, ["twin"]),
    data: () => {
      const [low] = rangeOf(live, charts.range, log);
      // Measurements that fit are of no interest.
      const nis = live.column("nis").map((value) => (typeof value !== "number" || log(value) < low ? null : log(value)));
      return { x: live.x, nis, ...Object.fromEntries(["high", "low", "mean"].map((kind) => [kind, live.column(`nis_${kind}`).map(log)])) };
    },
    range: (data, span) => rangeOf(live, span, log),
    amount: (value) => compact(10 ** value, 2),
    says: (value) => `${compact(10 ** value("mean"), 3)}  bounds ${compact(10 ** value("low"), 3)} – ${compact(10 ** value("high"), 3)}`,
  }];
};

// A decade to either side of the bounds, and more where the mean, once settled, or more than a few values leave them.
function rangeOf(live, span, log) {
  const middle = (log(live.last("nis_low")) + log(live.last("nis_high"))) / 2 || 0;
  const decades = (name) => live.column(name).map((value) => (value > 0 ? log(value) : null));
  const place = within(live.x, span);
  const [low, high] = shownExtent({ lines: [decades("nis_mean")] }, ...place);
  if (!Number.isFinite(low)) return [middle - 1, middle + 1];
  const [, most] = shownExtent({ dots: [decades("nis")] }, ...place);
  return [Math.min(middle - 1, low - 0.15), Math.max(middle + 1, high + 0.15, Math.min(most + 0.1, high + 1.5))];
}
