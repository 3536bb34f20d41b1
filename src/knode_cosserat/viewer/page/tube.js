// Smooth tubes along points that move: one geometry each, written anew whenever they move.
import * as THREE from "three";

/** Points on a Catmull-Rom curve through (n × 3) points, `parts` to each segment. */
export function smooth(points, count, parts, into) {
  const at = (i, k) => points[3 * Math.min(count - 1, Math.max(0, i)) + k];
  for (let i = 0; i < count - 1; i++)
    for (let p = 0; p < parts; p++) {
      const t = p / parts;
      for (let k = 0; k < 3; k++) {
        const b = at(i, k);
        const c = at(i + 1, k);
        // beyond the ends the curve goes on as it ended
        const a = i > 0 ? at(i - 1, k) : 2 * b - c;
        const d = i + 2 < count ? at(i + 2, k) : 2 * c - b;
        const s = 3 * (i * parts + p) + k;
        into[s] = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)));
      }
    }
  for (let k = 0; k < 3; k++) into[3 * (count - 1) * parts + k] = at(count - 1, k);
  return into;
}

export class Tube {
  /** A tube through `count` points with `parts` pieces between two of them. */
  constructor(count, material, { parts = 4, sides = 14, coloured = false } = {}) {
    Object.assign(this, { count, parts, sides, coloured });
    this.samples = (count - 1) * parts + 1;
    this.rings = this.samples + 2; // the ends are closed by rings of no radius
    const vertices = this.rings * sides;
    this.line = new Float32Array(3 * this.samples);
    this.geometry = new THREE.BufferGeometry();
    const attribute = (name) => {
      const found = new THREE.BufferAttribute(new Float32Array(3 * vertices), 3);
      found.setUsage(THREE.DynamicDrawUsage);
      this.geometry.setAttribute(name, found);
      return found.array;
    };
    this.position = attribute("position");
    this.normal = attribute("normal");
    if (coloured) this.colour = attribute("color");
    const index = [];
    for (let r = 0; r + 1 < this.rings; r++)
      for (let j = 0; j < sides; j++) {
        const a = r * sides + j;
        const b = r * sides + ((j + 1) % sides);
        index.push(a, b, a + sides, b, b + sides, a + sides);
      }
    this.geometry.setIndex(index);
    this.mesh = new THREE.Mesh(this.geometry, material);
    this.mesh.frustumCulled = false;
  }

  /** Along points (count × 3), with a radius for each, or one; and [r, g, b] of each, if it is to be coloured. */
  update(points, radii, colours = null) {
    const { samples, sides, parts, line } = this;
    if (parts === 1) line.set(points.subarray ? points.subarray(0, 3 * samples) : points);
    else smooth(points, this.count, parts, line);
    // a normal that is carried along, so that the tube does not twist
    let [nx, ny, nz] = [0, 0, 0];
    const tangent = (i, k) => line[3 * Math.min(samples - 1, i + 1) + k] - line[3 * Math.max(0, i - 1) + k];
    for (let i = 0; i < samples; i++) {
      let [tx, ty, tz] = [tangent(i, 0), tangent(i, 1), tangent(i, 2)];
      const length = Math.hypot(tx, ty, tz) || 1;
      [tx, ty, tz] = [tx / length, ty / length, tz / length];
      if (i === 0) [nx, ny, nz] = Math.abs(tx) < 0.8 ? [1, 0, 0] : [0, 1, 0];
      const along = nx * tx + ny * ty + nz * tz;
      [nx, ny, nz] = [nx - along * tx, ny - along * ty, nz - along * tz];
      const size = Math.hypot(nx, ny, nz) || 1;
      [nx, ny, nz] = [nx / size, ny / size, nz / size];
      const [bx, by, bz] = [ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx];
      const at = i / parts;
      const low = Math.floor(at);
      const high = Math.min(this.count - 1, low + 1);
      const of = (values, k = 0, width = 1) =>
        values[width * low + k] + (at - low) * (values[width * high + k] - values[width * low + k]);
      const radius = typeof radii === "number" ? radii : of(radii);
      for (let j = 0; j < sides; j++) {
        const angle = (2 * Math.PI * j) / sides;
        const [c, s] = [Math.cos(angle), Math.sin(angle)];
        const n = [c * nx + s * bx, c * ny + s * by, c * nz + s * bz];
        const v = 3 * ((i + 1) * sides + j);
        for (let k = 0; k < 3; k++) {
          this.normal[v + k] = n[k];
          this.position[v + k] = line[3 * i + k] + radius * n[k];
          if (colours) this.colour[v + k] = of(colours, k, 3);
        }
      }
      if (i === 0) this.#close(0, 0, [-tx, -ty, -tz]);
      if (i === samples - 1) this.#close(this.rings - 1, i, [tx, ty, tz]);
    }
    for (const name of ["position", "normal", ...(this.coloured ? ["color"] : [])])
      this.geometry.attributes[name].needsUpdate = true;
  }

  #close(ring, i, normal) {
    const from = 3 * (ring === 0 ? 1 : this.rings - 2) * this.sides;
    for (let j = 0; j < this.sides; j++)
      for (let k = 0; k < 3; k++) {
        const v = 3 * (ring * this.sides + j) + k;
        this.position[v] = this.line[3 * i + k];
        this.normal[v] = normal[k];
        if (this.coloured) this.colour[v] = this.colour[from + 3 * j + k];
      }
  }

  /** Draw only the first pieces, up to a point. */
  until(point) {
    this.geometry.setDrawRange(0, Math.max(0, point * this.parts + 1) * this.sides * 6);
  }

  dispose() {
    this.geometry.dispose();
  }
}
