// A link to a moment, in the fragment of the address: twin, time, span, the moment looked at, and charts. Whoever opens
// it sees the same.

const DIGITS = 9; // of a second

// The address of what is shown now.
export function link({ model, link, view, charts }) {
  const [since, until] = charts.range;
  const parts = {
    twin: model.twin,
    from: written(BigInt(link.status.origin ?? 0) + nanoseconds(since)),
    span: String(Number((until - since).toPrecision(9))),
    ...(view.at === null ? {} : { at: written(BigInt(link.status.origin ?? 0) + nanoseconds(view.at)) }),
    charts: charts.layout.shown().map(([key, height]) => (height ? `${key}/${height}` : key)).join(","),
  };
  const text = Object.entries(parts).map(([name, value]) => `${name}=${encodeURIComponent(value).replace(/%3A|%2C|%2F/g, decodeURIComponent)}`);
  return `${location.origin}/#${text.join("&")}`;
}

// The twin that an address is of, or null.
export const twinOf = (hash) => new URLSearchParams(hash.replace(/^#/, "")).get("twin");

// Go to the moment of the address, if it has one. Resolves to a reason why not, or null.
export function goTo(hash, { model, link, view, charts }) {
  const asked = new URLSearchParams(hash.replace(/^#/, ""));
  if (!asked.has("from")) return null;
  if (asked.get("twin") !== model.twin) return `the link is of ${asked.get("twin")}; ${model.twin} runs here`; // see `twinOf`
  const [from, span, at] = [read(asked.get("from")), Number(asked.get("span")), read(asked.get("at"))];
  if (from === null || !(span > 0)) return "the link is damaged: it has no time or no span";
  const seconds = (time) => Number(time - BigInt(link.status.origin)) / 1e9;
  const since = seconds(from);
  const layout = (asked.get("charts") ?? "").split(",").filter(Boolean).map((item) => item.split("/"));
  if (layout.length) charts.layout.use(layout.map(([key, height]) => [key, height ? Number(height) : null]));
  view.show(since, since + span, at === null ? null : seconds(at));
  return null;
}

const nanoseconds = (seconds) => BigInt(Math.floor(seconds)) * 1_000_000_000n + BigInt(Math.round((seconds - Math.floor(seconds)) * 1e9));

// Nanoseconds since 1970 as 2026-11-22T07:12:31.4Z, and back; null if it is no such time.
export function written(time) {
  const part = ((time % 1_000_000_000n) + 1_000_000_000n) % 1_000_000_000n;
  const second = new Date(Number((time - part) / 1_000_000n)).toISOString().slice(0, 19);
  const fraction = String(part).padStart(DIGITS, "0").replace(/0+$/, "");
  return `${second}${fraction && "."}${fraction}Z`;
}

export function read(text) {
  const [, second, fraction = ""] = /^(.{10}T.{8})(?:\.(\d{1,9}))?Z$/.exec(text ?? "") ?? [];
  const whole = Date.parse(`${second}Z`);
  return Number.isFinite(whole) ? BigInt(whole) * 1_000_000n + BigInt(fraction.padEnd(DIGITS, "0")) : null;
}
