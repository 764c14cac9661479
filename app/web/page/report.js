// The charts of an HTML report: the page's own, over data in the file (app/render/report_charts.py). On paper
// each is an SVG drawing.

import { Chart, declared, heading } from "./chart.js";
import { element } from "./dom.js";
import { setLabels } from "./format.js";
import { Smoothed } from "./layers.js";
import { Stream, unpack } from "./stream.js";

const HEIGHT = 190; // px of a chart of weight one
const PAPER = [960, 300]; // px of a drawing

const { model, kinds, streams, episodes, annotations, integrity, nis_dof: nisDof } = JSON.parse(document.getElementById("chart-data").textContent);

setLabels(model);
const context = { model, episodes, integrity, nisDof, view: { at: null }, live: streamOf(streams.live), layers: [] };
const whole = [context.live.x[0], context.live.x.at(-1)];
context.range = whole;
context.strong = { stream: context.live, choose() {}, edges: (name) => ["upper", "lower"].map((side) => context.live.column(`${side}:${name}`)) };
if (streams.smoothed) {
  const smoothed = new Smoothed(context, null);
  smoothed.stream = streamOf(streams.smoothed);
  context.layers.push(smoothed);
}

function streamOf(text) {
  const stream = new Stream();
  stream.take(...unpack(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer));
  return stream;
}

const modules = await Promise.all(kinds.map((name) => import(`nisus/charts/${name}`)));
const actions = { select: (...range) => show(range), home: () => show(whole) };
const charts = declared(modules, context).filter((what) => !what.further).map((what) => new Chart(what, actions));
document.getElementById("charts").replaceChildren(...charts.map((chart) => chart.node));
for (const chart of charts) {
  chart.node.style.flex = "none";
  chart.node.style.height = `${Math.round(HEIGHT * Math.min(1.5, chart.what.weight) + 20)}px`;
  chart.span = whole;
  chart.begin(true);
}
show(whole);
for (const chart of charts) {
  const drawing = chart.svg([heading(chart.what), chart.what.note ?? ""], PAPER);
  chart.node.append(element("img", { class: "paper", alt: `Chart of ${chart.what.title}`, src: `data:image/svg+xml,${encodeURIComponent(drawing)}` }));
}

function show(range) {
  context.range = range;
  charts.forEach((chart, k) => chart.show(chart.what.data(), range, null, annotations, k === 0));
}
