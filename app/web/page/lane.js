// The points of one lane, as they have come so far: times, and a column of values by name.

export class Lane {
  constructor() {
    this.x = [];
    this.columns = {};
    this.revision = null;
    this.first = 0;
    this.each = 1;
    this.version = 0;
  }

  // Take a frame: what it brings stands in place of everything from its start on.
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
    this.version += 1;
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
    const values = this.columns[name] ?? [];
    for (let k = values.length - 1; k >= 0; k--) if (values[k] !== null) return values[k];
    return NaN;
  }
}
