// Which stretch of time all charts show: the last seconds, followed; or a fixed one.

const NARROWEST = 1e-3; // s

export class View extends EventTarget {
  constructor(span) {
    super();
    this.configured = span;
    this.span = span; // null: everything
    this.since = null; // of a fixed stretch
    this.until = null;
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
    this.since = this.until = null;
    this.changed();
  }

  show(since, until) {
    const middle = (since + until) / 2;
    const half = Math.max(NARROWEST, until - since) / 2;
    this.since = middle - half;
    this.until = middle + half;
    this.changed();
  }

  // Hold what is shown now, or follow again.
  hold(range) {
    if (this.following) this.show(...range);
    else this.follow();
  }

  // The same width around another time.
  goTo(time, range) {
    const half = (range[1] - range[0]) / 2;
    this.show(time - half, time + half);
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
