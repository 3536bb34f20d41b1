// A closed loop: its target, its numbers over time, and what is drawn and written of them.
import * as THREE from "three";
import { save } from "viewer/capture";
import { onChange, robotColour } from "viewer/colours";
import { unpack } from "viewer/data";
import { Link } from "viewer/link";
import { Readouts } from "viewer/readouts";
import { TargetDrag } from "viewer/target";
import { Tube } from "viewer/tube";
import { apart } from "viewer/units";

/** Most rows of a live loop that are kept for the plots. */
const KEPT = 600;
/** A tip that moves less than this part of the length in a second rests; one farther away has not reached the target. */
const RESTS = 1e-3;
const AWAY = 5e-3;
/** How far an open side of the soft limits is drawn, in lengths beyond the room of the robot. */
const OPEN = 0.15;
/** Numbers that are drawn are medians of so many periods. */
const SMOOTHED = 15;

/** A page that moves a target: {target: [x, y, z]} goes out, with null for a free coordinate. */
export class LoopLink extends Link {
  constructor(start, hooks, heard) {
    super(hooks);
    Object.assign(this, { start, heard, target: [...start] });
    this.connect();
  }

  get wish() {
    return { target: this.target };
  }

  /** Move the target; `at` is the time (ms) of the event that did. */
  aim(target, at) {
    this.target = target;
    this.wished(at);
  }

  text(message) {
    const { file, reason } = message;
    if (file) save(new Blob([file.text], { type: file.type }), file.name);
    else if (reason !== undefined) this.heard(reason);
    else super.text(message);
  }

  /** A period cannot be cancelled: it ends by itself. */
  cancel() {}
}

/** Numbers of a loop at its periods, with the reason of each fallback. */
export class LoopRows {
  constructor({ columns }) {
    Object.assign(this, { columns, times: [], rows: [], reasons: [] });
  }

  /** Rows of an exported loop. */
  static async of(setup, times) {
    const found = new LoopRows(setup);
    if (!setup.rows) return found;
    const { values, width } = await unpack(setup.rows);
    found.times = times;
    found.rows = times.map((_, row) => values.subarray(row * width, (row + 1) * width));
    found.reasons = setup.reasons;
    return found;
  }

  put(time, numbers, reason) {
    if (this.times.length && time <= this.times.at(-1)) this.times = [], this.rows = [], this.reasons = [];
    this.times.push(time);
    this.rows.push(numbers.slice());
    this.reasons.push(reason);
    if (this.times.length > KEPT) for (const list of [this.times, this.rows, this.reasons]) list.shift();
  }

  /** The last row at or before a time; -1 if there is none. */
  at(time) {
    let [low, high] = [-1, this.times.length - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.times[middle] <= time + 1e-6) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  get(row, name) {
    const [first, size] = this.columns[name];
    return this.rows[row].subarray(first, first + size);
  }

  /** The target of a row, [x, y, z], with null for free coordinates. */
  target(row) {
    return Array.from(this.get(row, "target"), (x) => (Number.isFinite(x) ? x : null));
  }

  /** The median of a number in the periods up to a row. */
  median(row, name) {
    const values = [];
    for (let k = Math.max(0, row - SMOOTHED + 1); k <= row; k++) values.push(this.get(k, name)[0]);
    const known = values.filter(Number.isFinite).sort((a, b) => a - b);
    return known.length ? known[known.length >> 1] : NaN;
  }
}

export class LoopView {
  /** `moved` is called with a target of the page and the time (ms) of its event; null for a recorded loop. */
  constructor(setup, rows, { stage, robots, place, legend, moved }) {
    Object.assign(this, { setup, rows, stage, legend, moved, wish: null, reason: "" });
    [this.robot] = robots;
    this.length = this.robot.track.drawing.length;
    this.upright = Math.abs(Math.abs(stage.up.z) - 1) < 1e-6;
    this.readouts = new Readouts(setup, place, {
      live: Boolean(moved), upright: this.upright,
      typed: (k, value) => this.#typed(k, value), free: (free) => this.#free(free),
    });
    this.#lines();
    this.#soft();
    if (moved) {
      const horizontal = () => this.readouts.horizontal || this.free;
      this.drag = new TargetDrag(stage, { horizontal, reach: 1.5 * this.length, to: (point, at) => this.#to(point, at) });
    }
    onChange(() => this.#paint());
    this.#paint();
  }

  get free() {
    return this.wish?.[2] === null;
  }

  /** Take the target of a live loop from now on, also after it starts again. */
  linked(link) {
    this.wish = link.target;
    link.reset = () => {
      link.command("reset");
      this.wish = [...link.start];
      this.#wished(performance.now());
    };
    return link;
  }

  #to(point, at) {
    this.wish = this.free ? [point[0], point[1], null] : point;
    this.#wished(at);
  }

  #typed(k, value) {
    this.wish = this.wish.map((x, i) => (i === k ? value : x));
    this.#wished(performance.now());
  }

  #free(free) {
    this.wish = [this.wish[0], this.wish[1], free ? null : this.robot.tip[2]];
    this.#wished(performance.now());
  }

  #wished(at) {
    this.readouts.aim(this.wish, this.place);
    this.moved(this.wish, at);
    this.stage.dirty = true;
  }

  // what is drawn

  #lines() {
    const count = this.setup.columns.path[1] / 3;
    this.colour = new THREE.Color();
    this.pathMaterial = new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.95 });
    if (count > 1) {
      this.path = new Tube(count + 1, this.pathMaterial, { parts: 1, sides: 6 });
      this.end = new THREE.Mesh(new THREE.SphereGeometry(0.008 * this.stage.size, 16, 12), this.pathMaterial);
      this.stage.scene.add(this.path.mesh, this.end);
    }
    this.gap = new THREE.Line(
      new THREE.BufferGeometry().setFromPoints([new THREE.Vector3(), new THREE.Vector3()]),
      new THREE.LineDashedMaterial({ dashSize: 0.012 * this.stage.size, gapSize: 0.01 * this.stage.size, transparent: true, opacity: 0.7 }),
    );
    this.gap.frustumCulled = false;
    if (this.path) {
      const seconds = count * this.setup.dt;
      this.entry = this.legend.add("", `predicted path of the tip, ${+seconds.toPrecision(3)} s`);
    }
    this.stage.scene.add(this.gap);
  }

  /** The box in which the tip is to stay; open sides end where nothing is drawn any more. */
  #soft() {
    const { soft } = this.setup;
    if (!soft) return;
    const room = [this.stage.low, this.stage.high].map((corner) => corner.toArray());
    const open = (k, i) => room[k][i] + (k ? OPEN : -OPEN) * this.length;
    const [low, high] = soft.map((ends, k) => new THREE.Vector3(...ends.map((x, i) => x ?? open(k, i))));
    const sizes = high.clone().sub(low);
    const box = new THREE.BoxGeometry(...sizes.toArray());
    this.softFaces = new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.035, side: THREE.DoubleSide, depthWrite: false });
    this.softEdges = new THREE.LineBasicMaterial({ transparent: true, opacity: 0.6 });
    for (const part of [new THREE.Mesh(box, this.softFaces), new THREE.LineSegments(new THREE.EdgesGeometry(box), this.softEdges)]) {
      part.position.copy(low).addScaledVector(sizes, 0.5);
      this.stage.scene.add(part);
    }
  }

  #paint() {
    const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    this.pathMaterial.color.set(robotColour(2));
    this.gap.material.color.set(style("--target"));
    this.softFaces?.color.set(style("--warn"));
    this.softEdges?.color.set(style("--warn"));
    this.readouts.paint(robotColour(0));
    if (this.entry) this.entry.style.background = robotColour(2);
  }

  put(time, numbers) {
    this.rows.put(time, numbers, this.reason);
  }

  /** Where the marker is: the wish or the target of a row, with the tip's coordinate where it is free. */
  get place() {
    const { tip } = this.robot;
    return (this.wish ?? this.target ?? tip).map((x, k) => x ?? tip[k]);
  }

  /** Draw and write the loop at a time. */
  show(time) {
    const row = this.rows.at(time);
    this.target = row < 0 ? null : this.rows.target(row);
    const { place } = this;
    const { tip } = this.robot;
    this.stage.target.position.set(...place);
    this.gap.geometry.setFromPoints([new THREE.Vector3(...tip), new THREE.Vector3(...place)]);
    this.gap.computeLineDistances();
    const wanted = this.wish ?? this.target ?? place;
    this.legend.aim(wanted);
    this.readouts.aim(wanted, place);
    if (row < 0) return;
    const points = this.path ? this.rows.get(row, "path") : [NaN];
    const known = Number.isFinite(points[0]);
    if (this.path) {
      this.path.mesh.visible = this.end.visible = known;
      if (known) {
        this.path.update(new Float32Array([...tip, ...points]), 0.0028 * this.stage.size);
        this.end.position.fromArray(points, points.length - 3);
      }
    }
    this.readouts.show(this.rows, row, { error: apart(tip, this.wish ?? this.target), rests: this.#rests(time, tip) });
  }

  /** True if the target stood still for a second, and the tip too, but elsewhere. */
  #rests(time, tip) {
    const before = this.rows.at(time - 1);
    if (before < 0 || this.rows.times[before] > time - 0.99) return false;
    const [now, then] = [this.wish ?? this.target, this.rows.target(before)];
    const still = now.every((x, k) => x === null ? then[k] === null : Math.abs(x - then[k]) < 1e-4);
    const earlier = this.robot.track.tipAt(time - 1);
    return still && earlier && apart(tip, earlier) < RESTS * this.length && apart(tip, now) > AWAY * this.length;
  }

  /** Distance (m) of the tip from the target at a time; undefined without a row. */
  error(time) {
    const row = this.rows.at(time);
    return row < 0 ? undefined : apart(this.robot.tip, this.wish ?? this.rows.target(row));
  }

  /** Distances (mm) of the tip from the target, for a plot. */
  get errors() {
    const { track } = this.robot;
    const { times } = this.rows;
    const values = times.map((time, row) => {
      const tip = track.tipAt(time);
      return tip ? 1000 * apart(tip, this.rows.target(row)) : null;
    });
    return { label: "target", times, values };
  }
}
