// Points of one chart query, as they arrive: times, and values by column name.

export class Stream {
  // Without a link, frames are handed in: in a report.
  constructor(link = null, name = "") {
    Object.assign(this, { link, name, asked: "null" });
    this.clear();
  }

  clear() {
    this.x = [];
    this.columns = {};
    this.names = [];
    this.revision = null;
    this.first = 0;
    this.each = 1; // points of a group of rows
    this.ends = 1; // of these, those of a line: the first and the last
    this.size = 1; // rows in a group
  }

  // Ask for {columns, run, since, until, span, points}; null for nothing. The same query again is not sent.
  ask(query) {
    const asked = JSON.stringify(query);
    if (asked === this.asked) return;
    this.asked = asked;
    this.link.look(this.name, query, (...frame) => this.take(...frame));
  }

  // A frame replaces everything from its start on.
  take(header, seconds, values) {
    if (header.fresh) {
      this.x = [];
      this.names = header.columns;
      this.columns = Object.fromEntries(this.names.map((name) => [name, []]));
      this.first = header.start;
      this.each = header.each;
      this.ends = header.ends;
      this.size = header.size;
    }
    if (header.offsets) this.offsets = header.offsets;
    this.revision = header.revision;
    const keep = Math.max(0, Math.min(this.x.length, (header.start - this.first) * this.each));
    const gone = Math.max(0, Math.min(keep, (header.first - this.first) * this.each));
    this.x = this.x.slice(gone, keep).concat(Array.from(seconds));
    this.names.forEach((name, k) => {
      this.columns[name] = this.columns[name].slice(gone, keep).concat(this.filled(values[k], this.offsets[k], header.points));
    });
    this.first = Math.min(header.start, Math.max(this.first, header.first));
  }

  // Values of a frame's points. Where a dot is not, there is null; where a line has no point of its own, undefined, so
  // that it leads on.
  filled({ at, values }, offset, points) {
    const known = (k) => (Number.isNaN(values[k]) ? null : values[k] + offset);
    if (!at && this.each === 1) return Array.from(values, (_, k) => known(k));
    const column = new Array(points).fill(at ? null : undefined);
    if (at) at.forEach((place, k) => (column[place] = known(k)));
    else for (let k = 0; k < values.length; k++) column[this.each * (k >> 1) + (k & 1 ? this.each - 1 : 0)] = known(k);
    return column;
  }

  // Without the points of dots: the times of lines, and a line's values there.
  get lineTimes() {
    return this.atEnds(this.x);
  }

  lineColumn(name) {
    return this.atEnds(this.column(name));
  }

  atEnds(values) {
    return this.each === this.ends ? values : values.filter((_, k) => k % this.each === 0 || k % this.each === this.each - 1);
  }

  column(name) {
    return this.columns[name] ?? new Array(this.x.length).fill(null);
  }

  // The newest finite value of a column.
  last(name) {
    return this.columns[name]?.findLast((value) => typeof value === "number") ?? NaN;
  }
}

// A frame: the length of its header, the header, times in seconds; lines, each around its offset; and dots, the places of
// those that exist and their values.
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length;
  const take = (kind, count) => {
    const found = new kind(buffer, at, count);
    at += found.byteLength;
    return found;
  };
  const seconds = take(Float64Array, header.points);
  const lines = header.dots.map((dots) => (dots ? null : take(Float32Array, (header.points / header.each) * header.ends)));
  const counts = header.counts.values();
  const columns = lines.map((values) => {
    if (values) return { values };
    const count = counts.next().value;
    return { at: take(Uint32Array, count), values: take(Float32Array, count) };
  });
  return [header, seconds, columns];
}
