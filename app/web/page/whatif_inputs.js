// What an input does from now on: stay as it is, another value at once, a step, a ramp, or what it did before once more.

import { line } from "./chart.js";
import { element } from "./dom.js";
import { colour, fill, stroke } from "./drawing.js";
import { compact, span, words } from "./format.js";
import { Range, extent, shownExtent, until } from "./ranges.js";

const KINDS = { hold: "unchanged", constant: "constant", step: "step", ramp: "ramp", repeat: "repeat recording" };
const POINTS = 100; // of a ramp
const PART = 0.25; // of the horizon, after which a step comes and a ramp ends at first

// What the forecast is asked for: a value, [[seconds from now, value], …] or "repeat".
export function profile({ kind, value, after }, now, horizon) {
  if (kind === "repeat") return "repeat";
  const from = Number.isFinite(now) ? now : value;
  const at = Math.min(horizon, after ?? PART * horizon);
  if (kind === "step") return [[Number(at.toPrecision(4)), value]];
  if (kind !== "ramp") return value;
  return Array.from({ length: POINTS }, (_, k) => [(k + 1) / POINTS, k + 1]).map(([share]) => [Number((share * at).toPrecision(6)), Number((from + share * (value - from)).toPrecision(6))]);
}

// One input: a slider over what it has been and as much again to either side, a field, and how it gets there.
export function inputRow(whatif, input) {
  const name = words(input.name);
  const label = `${name}${input.unit ? ` [${input.unit}]` : ""}`;
  const slider = element("input", { type: "range", step: "any", "aria-label": `${label} from now on`, oninput: () => choose({ value: Number(slider.value) }) });
  const field = element("input", { type: "text", inputmode: "decimal", "aria-label": `${label} from now on, as a number`, onchange: () => choose({ value: number(field) }) });
  const back = element("button", { type: "button", class: "back", title: "Unchanged", "aria-label": `${name} as it is now`, onclick: () => choose({ kind: "hold" }) }, "↺");
  const kinds = element("select", { "aria-label": `How ${name} goes on`, onchange: () => choose({ kind: kinds.value }) }, ...Object.entries(KINDS).map(([kind, text]) => element("option", { value: kind }, text)));
  const after = element("input", { type: "text", inputmode: "decimal", "aria-label": `Seconds until ${name} is there`, onchange: () => choose({ after: number(after) }) });
  const later = element("label", { class: "later", hidden: true }, element("span", {}), after, " s");
  const node = element(
    "div", { class: "profile" },
    element("div", { class: "choice" }, element("span", { title: label }, name), field, element("span", { class: "unit" }, input.unit), back, slider),
    element("div", { class: "kind" }, kinds, later),
  );
  const row = { node, input, now: NaN, chart: null, show };

  function choose(change) {
    const before = whatif.inputs[input.name];
    const chosen = { kind: "constant", value: row.now, ...before, ...change };
    // Choosing a value ends a repetition.
    if ("value" in change && chosen.kind === "repeat") chosen.kind = "constant";
    if (!(chosen.after > 0)) delete chosen.after;
    if (chosen.kind === "hold" || !Number.isFinite(chosen.value)) delete whatif.inputs[input.name];
    else whatif.inputs[input.name] = { ...chosen, value: Number(chosen.value.toPrecision(4)) };
    place();
    whatif.changed();
  }

  function place() {
    const chosen = whatif.inputs[input.name];
    const kind = chosen?.kind ?? "hold";
    const value = chosen?.value ?? row.now;
    node.toggleAttribute("data-turned", Boolean(chosen));
    node.firstChild.toggleAttribute("data-turned", Boolean(chosen));
    kinds.value = kind;
    later.hidden = kind !== "step" && kind !== "ramp";
    later.firstChild.textContent = kind === "step" ? "in " : "within ";
    if (document.activeElement !== after) after.value = compact(chosen?.after ?? PART * whatif.horizon, 3);
    for (const control of [slider, field]) control.disabled = kind === "repeat";
    if (document.activeElement !== field) field.value = kind === "repeat" ? "" : compact(value, 4);
    if (document.activeElement !== slider) slider.value = value;
  }

  function show(value, history) {
    row.now = value;
    const chosen = whatif.inputs[input.name]?.value ?? value;
    const [low, high] = extent([[...history, value, chosen]], 0, history.length + 1);
    const width = high - low || Math.abs(high) || 1;
    if (!(Number(slider.min) <= low && high <= Number(slider.max) && slider.dataset.placed)) {
      slider.min = low - width;
      slider.max = high + width;
      slider.dataset.placed = "";
    }
    place();
  }

  return row;
}

const number = (field) => (field.value.trim() === "" ? NaN : Number(field.value.replace(",", ".")));

// A chart of one chosen input: the past and the chosen future.
export function inputChart(whatif, input) {
  const range = new Range();
  const { stream } = whatif;
  return {
    key: `input:${input.name}`,
    title: words(input.name),
    unit: input.unit,
    note: "chosen",
    names: { quiet: "recorded", ink: "chosen" },
    weight: 0.7,
    sync: "future",
    series: { recorded: line("quiet"), chosen: line("ink", { width: 1.75, dash: [6, 3] }) },
    over: (plot) => levels(plot, whatif.times?.[0]),
    data: () => {
      const { found, times } = whatif;
      const steps = stairs(found.chosen[input.name], found.inputs[input.name], found.t.at(-1));
      const before = until(stream.x, times[0]);
      const was = held(stream.column(`input:${input.name}`).slice(0, before));
      return {
        x: [...stream.x.slice(0, before), ...steps.map(([seconds]) => times[0] + seconds)],
        recorded: [...was, ...steps.map(() => null)],
        chosen: [...was.map(() => null), ...steps.map(([, value]) => value)],
      };
    },
    range: (data) => range.fit(...shownExtent({ dots: [data.recorded, data.chosen] }, 0, data.x.length - 1)),
    says: (value) => {
      const [x, chosen] = [value("x"), value("chosen")];
      const now = whatif.times?.[0] ?? 0;
      return Number.isFinite(chosen) && x >= now ? `in ${span(x - now)} ${compact(chosen, 4)} ${input.unit}` : "";
    },
  };
}

// Held from one change to the next, as [seconds from now, value].
function stairs({ t, value }, now, end) {
  const found = [[0, now]];
  t.forEach((seconds, k) => {
    if (found.at(-1)[1] !== null && seconds > found.at(-1)[0]) found.push([seconds, found.at(-1)[1]]);
    found.push([seconds, value[k]]);
  });
  found.push([end, found.at(-1)[1]]);
  return found;
}

// An input holds between its changes.
function held(values) {
  let last = null;
  return values.map((value) => (last = value ?? last));
}

// On a chart of a forecast

const SURE = 0.25; // of a chart's height, of certainty

// At the foot of the chart, as high as a quarter of it: how likely the limit has been passed by each time.
export function probability(plot, times, found) {
  if (!found || !times || !(found.overall >= 0.005)) return;
  const { ctx, bbox } = plot;
  const foot = bbox.top + bbox.height;
  const place = (share, k) => [plot.valToPos(times[k], "x", true), foot - SURE * bbox.height * share];
  const curve = found.probability.map((share, k) => place(share ?? 0, k));
  const [x, y] = curve.at(-1);
  ctx.save();
  fill(ctx, [[curve[0][0], foot], ...curve, [x, foot]], "bounds");
  stroke(ctx, curve, "ink");
  ctx.fillStyle = colour("faint");
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  ctx.textAlign = "right";
  ctx.textBaseline = "bottom";
  ctx.fillText(`P ${Math.round(100 * found.probability.at(-1))} %`, x - 4 * devicePixelRatio, y - 2 * devicePixelRatio);
  ctx.restore();
}

// Now, upright; the limit, level.
export function levels(plot, now, limit) {
  const { ctx, bbox } = plot;
  ctx.save();
  if (now !== undefined) {
    const x = plot.valToPos(now, "x", true);
    stroke(ctx, [[x, bbox.top], [x, bbox.top + bbox.height]], "faint");
  }
  if (limit !== undefined) {
    const y = plot.valToPos(limit, "y", true);
    stroke(ctx, [[bbox.left, y], [bbox.left + bbox.width, y]], "ink", devicePixelRatio, [8 * devicePixelRatio, 4 * devicePixelRatio]);
  }
  ctx.restore();
}
