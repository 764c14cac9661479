// The stretch of time that all charts show: the last seconds, followed, or a fixed one.

const NARROWEST = 1e-3; // s

export class View extends EventTarget {
  constructor(span) {
    super();
    this.configured = span;
    this.span = span; // null: everything
    this.since = null; // of a fixed stretch
    this.until = null;
    this.at = null; // the moment of it that is looked at, s; also in Rerun
  }

  get following() {
    return this.since === null;
  }

  // The stretch as a chart query.
  wanted() {
    if (this.following) return this.span === null ? {} : { span: this.span };
    return { since: this.since, until: this.until };
  }

  follow(span = this.span) {
    this.span = span;
    this.since = this.until = this.at = null;
    this.changed();
  }

  // The moment stays if it is still shown; else it is the end of the stretch.
  show(since, until, at = this.at) {
    const middle = (since + until) / 2;
    const half = Math.max(NARROWEST, until - since) / 2;
    this.since = middle - half;
    this.until = middle + half;
    this.at = at !== null && this.since <= at && at <= this.until ? at : this.until;
    this.changed();
  }

  // Hold the present stretch, or follow again.
  hold(range) {
    if (this.following) this.show(...range);
    else this.follow();
  }

  // Go to a moment: within the stretch if it is shown, else with the same width around it, up to the newest row.
  goTo(time, range, newest = Infinity) {
    if (range[0] <= time && time <= range[1]) return this.show(...range, time);
    const width = range[1] - range[0];
    const until = Math.max(time, Math.min(time + width / 2, newest));
    this.show(until - width, until, time);
  }

  zoom(factor, at, range) {
    const [since, until] = range;
    this.show(at - (at - since) * factor, at + (until - at) * factor);
  }

  pan(seconds, range) {
    this.show(range[0] + seconds, range[1] + seconds);
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }
}

// A link to a moment, in the fragment of the address: twin, time, span, the moment looked at, and charts. Whoever opens
// it sees the same.

const DIGITS = 9; // of a second

// The address of the present view.
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
  return `${new URL(".", document.baseURI).href}#${text.join("&")}`;
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
function written(time) {
  const part = ((time % 1_000_000_000n) + 1_000_000_000n) % 1_000_000_000n;
  const second = new Date(Number((time - part) / 1_000_000n)).toISOString().slice(0, 19);
  const fraction = String(part).padStart(DIGITS, "0").replace(/0+$/, "");
  return `${second}${fraction && "."}${fraction}Z`;
}

function read(text) {
  const [, second, fraction = ""] = /^(.{10}T.{8})(?:\.(\d{1,9}))?Z$/.exec(text ?? "") ?? [];
  const whole = Date.parse(`${second}Z`);
  return Number.isFinite(whole) ? BigInt(whole) * 1_000_000n + BigInt(fraction.padEnd(DIGITS, "0")) : null;
}

// One time for the windows of one twin: the page sends the moment it shows, and Rerun in its own window sends the moment
// it was scrubbed to. Windows of one browser hear each other; nothing goes over the network.

const name = (boot) => `nisus time ${boot}`;

// On the page.
export class SharedTime {
  constructor(boot, view, charts) {
    Object.assign(this, { view, charts });
    this.channel = new BroadcastChannel(name(boot));
    this.channel.onmessage = ({ data }) => {
      if (data.asks) this.say();
      if (data.follow) view.follow();
      if (Number.isFinite(data.goTo)) view.goTo(data.goTo, charts.range, charts.newest);
    };
    view.addEventListener("change", () => this.say());
    window.addEventListener("pagehide", () => this.channel.postMessage({ gone: true }));
    this.say();
  }

  say() {
    this.channel.postMessage({ at: this.view.following ? null : this.view.at });
  }
}

// In a window of its own, in place of the page's view: `paired` while there is a page.
export class RemoteView extends EventTarget {
  constructor(boot) {
    super();
    this.at = null;
    this.paired = false;
    this.channel = new BroadcastChannel(name(boot));
    this.channel.onmessage = ({ data }) => {
      if (data.asks || data.follow || "goTo" in data) return; // another window like this
      this.paired = !data.gone;
      if (!data.gone) this.at = data.at;
      this.changed();
    };
    this.channel.postMessage({ asks: true });
  }

  get following() {
    return this.at === null;
  }

  goTo(time) {
    this.at = time;
    this.channel.postMessage({ goTo: time });
    this.changed();
  }

  follow() {
    this.at = null;
    this.channel.postMessage({ follow: true });
    this.changed();
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }
}
