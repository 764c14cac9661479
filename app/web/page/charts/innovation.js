// Innovations of each sensor row, with the band in which 95 % of them are expected.

import { band, dots, line } from "../chart.js";
import { marks } from "../drawing.js";
import { bracketed, compact, decimals, fixed, spaced, words } from "../format.js";
import { Range, shownExtent, within } from "../ranges.js";

export const order = 4;

const MAX_CHARTS = 24;
const FEW_ROWS = 6; // shown at first

// To the digits that its expected size justifies.
const figure = (value, size) => (size > 0 ? fixed(value, decimals(size)) : compact(value, 3));

export default (charts) => charts.model.rows.slice(0, MAX_CHARTS).map((row, k, rows) => {
  const axisRange = new Range();
  const { live } = charts;
  const own = { upper: `innovation_upper:${row.name}`, lower: `innovation_lower:${row.name}`, value: `innovation:${row.name}` };
  return {
    key: `innovation:${row.name}`,
    further: rows.length > FEW_ROWS && k >= FEW_ROWS,
    title: words(row.name),
    unit: bracketed(row.unit),
    note: "innovation",
    help: "Innovation: measurement minus prediction, and ± 2σ of its predicted size",
    names: { reading: "innovation", bound: "", bounds: "± 2σ expected" },
    weight: 0.62,
    columns: Object.values(own),
    series: { upper: line("bound", { width: 1, spanGaps: true }), lower: line("bound", { width: 1, spanGaps: true }), value: dots("reading", 3) },
    bands: [band("bounds", "upper", "lower")],
    paint: (plot) => marks(plot, charts.episodes, charts.view.at),
    data: () => ({ x: live.x, ...Object.fromEntries(Object.entries(own).map(([kind, name]) => [kind, live.column(name)])) }),
    range: (data, span) => {
      const most = Math.max(...shownExtent({ bands: [[data.lower, data.upper]], dots: [data.value] }, ...within(data.x, span)).map(Math.abs));
      return axisRange.fit(-most, most);
    },
    says: (value) => (Number.isFinite(value("value")) ? `${figure(value("value"), value("upper"))}${spaced(row.unit)}  ± ${compact(value("upper"), 2)} expected` : "no measurement"),
  };
});
