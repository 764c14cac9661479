// What an input does from now on: stay as it is, another value at once, a step, a ramp, or what it did before once more.

import { line } from "./chart.js";
import { element } from "./dom.js";
import { lines } from "./fan_marks.js";
import { bracketed, compact, span, words } from "./format.js";
import { Range, extent, shownExtent, within } from "./ranges.js";

const KINDS = { hold: "as it is now", constant: "constant", step: "step", ramp: "ramp", repeat: "as recorded, again" };
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
  const back = element("button", { type: "button", class: "back", title: "As it is now", "aria-label": `${name} as it is now`, onclick: () => choose({ kind: "hold" }) }, "↺");
  const kinds = element("select", { "aria-label": `How ${name} goes on`, onchange: () => choose({ kind: kinds.value }) }, ...Object.entries(KINDS).map(([kind, text]) => element("option", { value: kind }, text)));
  const after = element("input", { type: "text", inputmode: "decimal", "aria-label": `Seconds until ${name} is there`, onchange: () => choose({ after: number(after) }) });
  const later = element("label", { class: "later", hidden: true }, element("span", {}), after, " s");
  const node = element(
    "div", { class: "profile" },
    element("div", { class: "choice" }, element("span", { title: label }, name), slider, field, element("span", { class: "unit" }, input.unit), back),
    element("div", { class: "kind" }, kinds, later),
  );
  const row = { node, input, now: NaN, chart: null, show };

  function choose(change) {
    const before = whatif.inputs[input.name];
    const chosen = { kind: "constant", value: row.now, ...before, ...change };
    // Another value is a choice; of what is repeated there is none.
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

// A chart of one input that was chosen: what it was, and what it will be.
export function inputChart(whatif, input) {
  const range = new Range();
  const { lane } = whatif;
  return {
    key: `input:${input.name}`,
    title: words(input.name),
    unit: bracketed(input.unit),
    note: "chosen",
    names: { quiet: "recorded", ink: "chosen" },
    weight: 0.7,
    sync: "future",
    series: [line("quiet", { width: 1.5 }), line("ink", { width: 1.75, dash: [6, 3] })],
    over: (plot) => lines(plot, whatif.times?.[0]),
    data: () => {
      const { found, times } = whatif;
      const chosen = stairs(found.chosen[input.name], found.inputs[input.name], found.t.at(-1));
      const before = lane.x.length && lane.x[0] <= times[0] ? within(lane.x, [-Infinity, times[0]])[1] + 1 : 0;
      const was = held(lane.column(`input:${input.name}`).slice(0, before));
      const [t, values] = [chosen.map(([seconds]) => times[0] + seconds), chosen.map(([, value]) => value)];
      return [[...lane.x.slice(0, before), ...t], [...was, ...t.map(() => null)], [...was.map(() => null), ...values]];
    },
    range: (chart) => range.fit(...shownExtent({ dots: chart.data.slice(1) }, 0, chart.data[0].length - 1)),
    says: (value) => {
      const [x, chosen] = [value(0), value(2)];
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

// An input says nothing between its changes, in which it holds.
function held(values) {
  let last = null;
  return values.map((value) => (last = value ?? last));
}
