// Innovations of each sensor row, with the band in which 95 % of them are expected. Of a group of sensors, one member at a
// time: the one that was typed, or else the first in alarm.

import { band, dots, line } from "../chart.js";
import { element } from "../dom.js";
import { marks } from "../drawing.js";
import { compact, decimals, fixed, spaced, words } from "../format.js";
import { Range, shownExtent, within } from "../ranges.js";

export const order = 4;

const MAX_CHARTS = 24;
const FEW_ROWS = 6; // shown at first
const IN_ALARM = ["stale", "degraded", "suspect"];

export default (charts) => {
  // A report has no link: there each row has its own chart.
  const groups = charts.link ? charts.model.groups : [];
  const grouped = new Map(groups.flatMap((group) => group.sensors.map((name) => [name, group])));
  const members = (charts.members ??= new Map(groups.map((group) => [group, new Member(charts, group)])));
  const kinds = new Map(); // rows of one name of the members of a group
  for (const row of charts.model.rows) {
    const group = grouped.get(row.sensor);
    const part = row.name.slice(row.sensor.length); // ".range" of sensors with several rows
    const key = group ? `${group.name}${part}` : row.name;
    if (!kinds.has(key)) kinds.set(key, { key, unit: row.unit, member: members.get(group), rows: new Map() });
    kinds.get(key).rows.set(row.sensor, row.name);
  }
  return [...kinds.values()].slice(0, MAX_CHARTS).map((kind, k, all) => chartOf(charts, kind, all.length > FEW_ROWS && k >= FEW_ROWS));
};

// The member of a group that is charted.
class Member {
  constructor(charts, group) {
    Object.assign(this, { charts, group, name: group.sensors[0], chosen: false, fields: [] });
    charts.link.addEventListener("member", ({ detail }) => group.sensors.includes(detail) && this.choose(detail, true));
    charts.link.addEventListener("status", ({ detail }) => this.follow(detail));
  }

  // A chart must not jump: another member is shown only if the present one is not in alarm.
  follow({ sensors, groups }) {
    const bad = (name) => IN_ALARM.includes(sensors[name]?.state);
    if (this.chosen || !groups[this.group.name]?.alarms || bad(this.name)) return;
    const next = this.group.sensors.find(bad);
    if (next) this.choose(next, false);
  }

  choose(name, chosen) {
    this.chosen = chosen;
    for (const field of this.fields) if (field !== document.activeElement || chosen) field.value = words(name);
    if (name === this.name) return;
    this.name = name;
    this.charts.ask();
  }

  // A field for the name of a member: empty for the first in alarm.
  get field() {
    const field = element("input", {
      type: "text", class: "member", value: words(this.name), spellcheck: "false", autocomplete: "off", size: 12,
      "aria-label": `Sensor of ${words(this.group.name)}`, title: `Name of one of the ${this.group.sensors.length} sensors; empty: the first in alarm`,
      onchange: () => {
        const wanted = field.value.trim().toLowerCase();
        const named = (fits) => this.group.sensors.find((name) => wanted && [name, words(name)].some((text) => fits(text.toLowerCase())));
        const found = named((text) => text === wanted) ?? named((text) => text.includes(wanted));
        this.choose(found ?? this.name, Boolean(found));
        field.value = words(this.name);
      },
    });
    this.fields.push(field);
    return field;
  }
}

// To the digits that its expected size justifies.
const figure = (value, size) => (size > 0 ? fixed(value, decimals(size)) : compact(value, 3));

function chartOf(charts, { key, unit, member, rows }, further) {
  const axisRange = new Range();
  const { live } = charts;
  const own = () => {
    const name = member ? rows.get(member.name) : key;
    return { upper: `innovation_upper:${name}`, lower: `innovation_lower:${name}`, value: `innovation:${name}` };
  };
  return {
    key: `innovation:${key}`,
    further,
    title: words(key),
    unit,
    note: "innovation",
    control: member?.field,
    help: "Innovation: measurement minus prediction, and ± 2σ of its predicted size",
    names: { reading: "innovation", bound: "", bounds: "± 2σ expected" },
    weight: 0.62,
    get columns() {
      return Object.values(own());
    },
    series: { value: dots("reading", 3), upper: line("bound", { width: 1, spanGaps: true }), lower: line("bound", { width: 1, spanGaps: true }) },
    bands: [band("bounds", "upper", "lower")],
    paint: (plot) => marks(plot, charts, [member ? rows.get(member.name) : key]),
    data: () => ({ x: live.x, ...Object.fromEntries(Object.entries(own()).map(([kind, name]) => [kind, live.column(name)])) }),
    range: (data, span) => {
      const most = Math.max(...shownExtent({ bands: [[data.lower, data.upper]], dots: [data.value] }, ...within(data.x, span)).map(Math.abs));
      return axisRange.fit(-most, most);
    },
    says: (value) => (Number.isFinite(value("value")) ? `${figure(value("value"), value("upper"))}${spaced(unit)}  ± ${compact(value("upper"), 2)} expected` : "no measurement"),
  };
}
