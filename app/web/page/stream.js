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
    }
    if (header.offsets) this.offsets = header.offsets;
    this.revision = header.revision;
    const keep = Math.max(0, Math.min(this.x.length, (header.start - this.first) * this.each));
    const gone = Math.max(0, Math.min(keep, (header.first - this.first) * this.each));
    this.x = [...this.x.slice(gone, keep), ...seconds];
    this.names.forEach((name, k) => {
      const offset = this.offsets[k];
      const fresh = Array.from(values[k] ?? [], (value) => (Number.isNaN(value) ? null : value + offset));
      this.columns[name] = [...this.columns[name].slice(gone, keep), ...fresh];
    });
    this.first = Math.min(header.start, Math.max(this.first, header.first));
  }

  column(name) {
    return this.columns[name] ?? new Array(this.x.length).fill(null);
  }

  // The newest finite value of a column.
  last(name) {
    return this.columns[name]?.findLast((value) => value !== null) ?? NaN;
  }
}

// A frame: the length of its header, the header, times in seconds, and each column around its offset.
export function unpack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const n = header.points;
  let at = 4 + length;
  const seconds = new Float64Array(buffer, at, n);
  at += 8 * n;
  const columns = [];
  for (let left = buffer.byteLength - at; left > 0 && n; left -= 4 * n, at += 4 * n)
    columns.push(new Float32Array(buffer, at, n));
  return [header, seconds, columns];
}
