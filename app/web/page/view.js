// Which stretch of time all charts show: the last seconds, followed; or a fixed one.

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

  // What a lane is asked for.
  wanted() {
    if (this.following) return this.span === null ? {} : { span: this.span };
    return { since: this.since, until: this.until };
  }

  follow(span = this.span) {
    this.span = span;
    this.since = this.until = this.at = null;
    this.changed();
  }

  // The moment stays, if it is still in sight; else it is the last of what is shown.
  show(since, until, at = this.at) {
    const middle = (since + until) / 2;
    const half = Math.max(NARROWEST, until - since) / 2;
    this.since = middle - half;
    this.until = middle + half;
    this.at = at !== null && this.since <= at && at <= this.until ? at : this.until;
    this.changed();
  }

  // Hold what is shown now, or follow again.
  hold(range) {
    if (this.following) this.show(...range);
    else this.follow();
  }

  // To a moment: what is shown stays where it holds it; else the same width around it, but not beyond the newest row.
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
