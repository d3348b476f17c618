// The newest seconds of all channels, row by row. Rows that never came are NaN, and marked.

const HEAD = 32; // bytes before a frame's values, see viewers.py
const KEPT = 24; // s

export class Samples {
  constructor() { this.clear(0, 0); }

  // rate : rows/s. columns : channels.
  clear(rate, columns) {
    this.rate = rate;
    this.length = Math.ceil(KEPT * rate) || 1;
    this.columns = Array.from({ length: columns }, () => new Float32Array(this.length).fill(NaN));
    this.end = this.begin = null; // number of the row after the newest, and of the oldest
    this.gaps = []; // rows at which samples are missing before
    this.lost = 0;
  }

  // A frame of the service; what was in it, or null if it is none for these channels.
  take(buffer, columns) {
    const view = new DataView(buffer);
    if (view.getUint8(0) !== 1 || view.getUint16(2, true) !== columns) return null;
    const n = view.getUint32(4, true), step = view.getUint32(8, true), lost = view.getUint32(12, true);
    const rate = view.getFloat64(16, true), first = Number(view.getBigInt64(24, true));
    const values = new Float32Array(buffer, HEAD);
    // With a step above 1 each pair of rows is the smallest and the largest of so many samples.
    let row = step === 1 ? first : Math.round((2 * first) / step);
    if (rate !== this.rate || columns !== this.columns.length) this.clear(rate, columns);
    if (this.end !== null && Math.abs(row - this.end) <= (step === 1 ? 0 : 2)) row = this.end;
    if (this.end !== null && row < this.end) this.clear(rate, columns); // another run
    this.lost = lost;
    if (this.end === null) this.begin = row;
    else if (row > this.end) {
      this.gaps.push(row);
      for (let r = Math.max(this.end, row - this.length); r < row; r++) for (const c of this.columns) c[r % this.length] = NaN;
    }
    for (let i = 0; i < n; i++) {
      const at = (row + i) % this.length;
      for (let c = 0; c < columns; c++) this.columns[c][at] = values[i * columns + c];
    }
    this.end = row + n;
    this.begin = Math.max(this.begin, this.end - this.length);
    while (this.gaps.length && this.gaps[0] < this.begin) this.gaps.shift();
    return { t0: row / rate, dt: 1 / rate, n, step, values };
  }

  value(column, row) {
    return this.begin !== null && row >= this.begin && row < this.end ? this.columns[column][row % this.length] : NaN;
  }

  // A copy of the rows from first to last, which stays as it is.
  copy(first, last) {
    const kept = new Samples();
    kept.clear(this.rate, 0);
    kept.begin = Math.max(first, this.begin); kept.end = Math.min(last, this.end);
    kept.length = Math.max(1, kept.end - kept.begin);
    kept.columns = this.columns.map((c, k) => {
      const own = new Float32Array(kept.length);
      for (let r = kept.begin; r < kept.end; r++) own[r % kept.length] = this.value(k, r);
      return own;
    });
    kept.gaps = this.gaps.filter((r) => r > kept.begin && r < kept.end);
    return kept;
  }
}
