// The scene's numbers: unpacking them, and trajectories that can be asked for any time.

const TYPES = { f4: Float32Array, f8: Float64Array };

/** An array as `scene.encoded_array` writes it: {shape, values}, values in the order of the shape. */
export async function unpack({ shape, type, bytes }) {
  const zipped = Uint8Array.from(atob(bytes), (c) => c.charCodeAt(0));
  const stream = new Blob([zipped]).stream().pipeThrough(new DecompressionStream("gzip"));
  const shuffled = new Uint8Array(await new Response(stream).arrayBuffer());
  const size = TYPES[type].BYTES_PER_ELEMENT;
  const count = shuffled.length / size;
  const plain = new Uint8Array(shuffled.length);
  for (let p = 0; p < size; p++) for (let k = 0; k < count; k++) plain[k * size + p] = shuffled[p * count + k];
  const byColumn = new TYPES[type](plain.buffer);
  const rows = shape[0];
  const width = count / Math.max(1, rows);
  const values = new TYPES[type](count);
  for (let w = 0; w < width; w++) for (let t = 0; t < rows; t++) values[t * width + w] = byColumn[w * rows + t];
  return { shape, width, values };
}

/** The result of a row that is solved, but on too coarse a grid: `Result.COARSE`. */
const COARSE = 1;

/** States over time of one robot. Rows that are not solved are never given: the last solved one stands for them. */
export class Track {
  static async of(packed) {
    const [time, result, error] = await Promise.all([packed.time, packed.result, packed.position_error].map(unpack));
    const names = Object.keys(packed.arrays);
    const arrays = await Promise.all(names.map((name) => unpack(packed.arrays[name])));
    const { measured } = packed;
    if (measured) for (const [name, array] of Object.entries(measured.arrays)) measured.arrays[name] = await unpack(array);
    return new Track(packed, [time.values, result.values, error.values], Object.fromEntries(names.map((n, k) => [n, arrays[k]])));
  }

  constructor(about, [time, result, error], arrays) {
    Object.assign(this, about); // name, drawing, fields, curves, position, orientation, failure …
    this.times = Array.from(time);
    this.results = Array.from(result);
    this.errors = Array.from(error);
    this.stale = false; // a live robot whose newest control is not solved
    this.arrays = arrays;
    this.nodes = arrays.y.shape[1];
    this.solved = this.results.map((r) => r >= 0);
  }

  get rows() {
    return this.times.length;
  }

  /** Number of numbers in a row of all arrays. */
  get width() {
    return Object.values(this.arrays).reduce((sum, { width }) => sum + width, 0);
  }

  /**
   * The last row at or before a time. `drawn` is the row to be drawn, `solved` is true if it is the row's solution,
   * `coarse` if the grid is too coarse for it, `error` is its estimated position error (m).
   */
  at(t) {
    let low = 0;
    let high = this.rows - 1;
    const slack = 1e-9 * Math.max(1, Math.abs(t));
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.times[middle] <= t + slack) low = middle;
      else high = middle - 1;
    }
    let drawn = low;
    while (drawn > 0 && !this.solved[drawn]) drawn--;
    // a start that is not solved: the first that is
    while (!this.solved[drawn] && drawn < this.rows - 1) drawn++;
    let part = 0;
    if (low === drawn && low + 1 < this.rows && this.solved[low + 1]) {
      part = Math.min(1, Math.max(0, (t - this.times[low]) / (this.times[low + 1] - this.times[low])));
      if (part < 1e-6) part = 0;
    }
    const rows = part > 0 ? [drawn, drawn + 1] : [drawn];
    const coarse = rows.some((row) => this.results[row] === COARSE);
    const error = Math.max(...rows.map((row) => this.errors[row]));
    return { row: low, drawn, part, solved: this.solved[low] && !this.stale, coarse, error };
  }

  /** Numbers of every node (nodes × size) at a moment from `at`; between two rows, what lies between them. */
  perNode({ array, offset = 0 }, size, { drawn, part }, into) {
    const { values, width } = this.arrays[array];
    const stride = width / this.nodes;
    const a = drawn * width;
    const b = part > 0 ? a + width : a;
    for (let n = 0; n < this.nodes; n++)
      for (let k = 0; k < size; k++) {
        const i = n * stride + offset + k;
        into[n * size + k] = values[a + i] + part * (values[b + i] - values[a + i]);
      }
    return into;
  }

  /** One component of a field at a node (of a control: of the robot), at a moment. */
  value(field, component, node, { drawn, part }) {
    const { values, width } = this.arrays[field.array];
    const at = drawn * width + (field.array === "control" ? 0 : node * (width / this.nodes)) + field.offset + component;
    return part > 0 ? values[at] + part * (values[at + width] - values[at]) : values[at];
  }

  /** The largest magnitude of a field's components, over all nodes and rows; 0 without such a field. */
  size(name) {
    const field = this.fields.find((each) => each.name === name);
    if (!field) return 0;
    const { values, width } = this.arrays[field.array];
    const stride = field.array === "control" ? width : width / this.nodes;
    let largest = 0;
    for (let at = field.offset; at < values.length; at += stride)
      for (let c = 0; c < field.components.length; c++)
        if (Math.abs(values[at + c]) > largest) largest = Math.abs(values[at + c]);
    return largest;
  }

  /** Spans of time of rows that are no good solutions: {kind: "coarse" or "unsolved", from, to} in s. */
  ranges() {
    const found = [];
    this.results.forEach((result, row) => {
      const kind = result < 0 ? "unsolved" : result === COARSE ? "coarse" : null;
      const last = found.at(-1);
      const to = this.times[Math.min(row + 1, this.rows - 1)];
      if (kind && last?.kind === kind && last.row === row - 1) Object.assign(last, { to, row });
      else if (kind) found.push({ kind, from: this.times[row], to, row });
    });
    return found;
  }

  /** One array's whole row at a moment. */
  whole(array, { drawn, part }, into) {
    const { values, width } = this.arrays[array];
    const a = drawn * width;
    const b = part > 0 ? a + width : a;
    for (let i = 0; i < width; i++) into[i] = values[a + i] + part * (values[b + i] - values[a + i]);
    return into;
  }

  /** Every row of one component of a field, at one node (of a control: of the robot); NaN where not solved. */
  series(field, component, node) {
    const { values, width } = this.arrays[field.array];
    const at = field.array === "control" ? 0 : node * (width / this.nodes);
    return this.times.map((_, row) =>
      this.solved[row] ? values[row * width + at + field.offset + component] : null,
    );
  }

  /** The tip at a row, [x, y, z]. */
  tip(row) {
    const { array, offset } = this.position;
    const { values, width } = this.arrays[array];
    const at = row * width + (this.nodes - 1) * (width / this.nodes) + offset;
    return [values[at], values[at + 1], values[at + 2]];
  }

  /** The tip at any time between two rows that are solved, or null. */
  tipAt(t) {
    if (t < this.times[0] - 1e-9 || t > this.times[this.rows - 1] + 1e-9) return null;
    const { drawn, part, solved } = this.at(t);
    if (!solved) return null;
    const a = this.tip(drawn);
    if (!part) return a;
    const b = this.tip(drawn + 1);
    return a.map((x, k) => x + part * (b[k] - x));
  }

  /** A measured body, or its prediction or band, at a moment; false if it is not known there. */
  body(name, k, { drawn, part }, into) {
    const { values, width } = this.measured.arrays[name];
    for (let c = 0; c < 3; c++) {
      const a = values[drawn * width + 3 * k + c];
      into[c] = part > 0 ? a + part * (values[(drawn + 1) * width + 3 * k + c] - a) : a;
    }
    return Number.isFinite(into[0] + into[1] + into[2]);
  }

  /** Distances (m) of the last measured body from its prediction in all rows; null where it was not seen. */
  tipErrors() {
    const { seen, predicted } = this.measured.arrays;
    return this.times.map((_, row) => {
      const at = (row + 1) * seen.width - 3;
      const away = Math.hypot(...[0, 1, 2].map((c) => seen.values[at + c] - predicted.values[at + c]));
      return this.solved[row] && Number.isFinite(away) ? away : null;
    });
  }

  /** Put a row in the place of the last one if it is of the same time, or else after it. */
  put({ time, result, error, row }) {
    if (time < this.times[this.rows - 1]) this.forget();
    else if (time > this.times[this.rows - 1]) return this.append({ time, result, error, row });
    let from = 0;
    for (const { values, width } of Object.values(this.arrays)) {
      values.set(row.subarray(from, from + width), (this.rows - 1) * width);
      from += width;
    }
    this.times[this.rows - 1] = time;
    this.results[this.rows - 1] = result;
    this.errors[this.rows - 1] = error;
    this.solved[this.rows - 1] = result >= 0;
  }

  /** Add a row to a trajectory that grows; the oldest are forgotten. */
  append({ time, result, error, row }, most = 600) {
    const full = this.rows >= most;
    let from = 0;
    for (const array of Object.values(this.arrays)) {
      const { width } = array;
      if (!array.grown) {
        const grown = new Float32Array(2 * most * width);
        grown.set(array.values);
        Object.assign(array, { buffer: grown, grown: true, first: 0 });
      }
      if (full) array.first++;
      if (array.first >= most) {
        array.buffer.copyWithin(0, array.first * width, (array.first + most) * width);
        array.first = 0;
      }
      const kept = full ? most - 1 : this.rows;
      array.values = array.buffer.subarray(array.first * width, (array.first + kept + 1) * width);
      array.values.set(row.subarray(from, from + width), kept * width);
      from += width;
    }
    if (full) for (const list of [this.times, this.results, this.errors, this.solved]) list.shift();
    this.times.push(time);
    this.results.push(result);
    this.errors.push(error);
    this.solved.push(result >= 0);
  }

  /** Begin anew: only the last row is left, to be written over. */
  forget() {
    for (const array of Object.values(this.arrays)) {
      array.values = array.values.slice(-array.width);
      array.grown = false;
    }
    for (const name of ["results", "errors", "solved"]) this[name] = this[name].slice(-1);
    this.times = [-Infinity];
  }

  /** Where the rod begins, [x, y, z], in the first row that is solved. */
  firstPoint() {
    const { array, offset } = this.position;
    const { values, width } = this.arrays[array];
    const at = Math.max(0, this.solved.indexOf(true)) * width + offset;
    return [values[at], values[at + 1], values[at + 2]];
  }

  /** The smallest and largest coordinates of all solved rows, [[x, y, z], [x, y, z]]. */
  box() {
    const low = [Infinity, Infinity, Infinity];
    const high = [-Infinity, -Infinity, -Infinity];
    const places = [this.position, ...this.curves.map(({ array }) => ({ array, offset: 0, flat: true }))];
    const arrays = places.map(({ array, ...place }) => ({ ...this.arrays[array], ...place }));
    if (this.measured?.arrays.seen.width) arrays.push({ ...this.measured.arrays.seen, offset: 0, flat: true });
    for (const { values, width, offset, flat } of arrays) {
      const stride = flat ? 3 : width / this.nodes;
      for (let i = offset; i + 2 < values.length; i += stride)
        for (let k = 0; k < 3; k++) {
          const x = values[i + k];
          if (Number.isFinite(x)) {
            low[k] = Math.min(low[k], x);
            high[k] = Math.max(high[k], x);
          }
        }
    }
    return [low, high];
  }
}
