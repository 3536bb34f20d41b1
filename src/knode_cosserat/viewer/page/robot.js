// One robot as it is drawn: rods, tendons, ribs, frames, base, and the path of its tip.
import * as THREE from "three";
import { QUANTITY, TENSION, axisColours, rampColour } from "viewer/colours";
import { Measured } from "viewer/measured";
import { Tube } from "viewer/tube";
import { length, quantity } from "viewer/units";

const UP = new THREE.Vector3(0, 1, 0);
const ALONG = new THREE.Quaternion().setFromUnitVectors(UP, new THREE.Vector3(0, 0, 1));

/** Opacity of rigid plates. */
const PLATE = 0.45;
/** Opacity of a row that is not solved, or on too coarse a grid. */
const FADED = 0.35;
/** Opacity of an overlay, and its radius in radii of the robot that it surrounds. */
const OVERLAY = 0.45;
const AROUND = 2.6;
/** Opacity of a rod with chambers in it, and the colour of a part whose control is zero. */
const OPEN = 0.35;
const IDLE = new THREE.Color("#e4d9d2");

export class RobotModel {
  constructor(track, colour, index, size) {
    Object.assign(this, { track, size, index });
    // an overlay, such as an estimate, surrounds another robot and has only its rods
    this.overlay = Boolean(track.overlay);
    const { drawing, nodes } = track;
    this.group = new THREE.Group();
    this.colour = new THREE.Color(colour);
    this.material = new THREE.MeshStandardMaterial({
      color: this.colour, emissive: this.colour, emissiveIntensity: 0.22, roughness: 0.5, transparent: true,
      // trajectories that lie on each other do not flicker
      polygonOffset: true, polygonOffsetFactor: index, polygonOffsetUnits: index, depthWrite: !this.overlay,
    });
    this.points = new Float32Array(3 * nodes);
    this.turns = track.orientation ? new Float32Array(4 * nodes) : null;
    this.parts = { rods: [], tendons: [], ribs: [], parts: [], frames: [], path: [], base: [], measured: [] };
    this.shapes = [];
    this.#rods();
    if (drawing.shapes?.some(({ kind }) => kind === "chamber")) this.material.depthWrite = false;
    this.ribs = [];
    this.bases = [];
    this.baseHeight = 0;
    if (!this.overlay) {
      this.#shapes(drawing.shapes ?? []);
      if (this.turns && drawing.tendons) this.#tendons(drawing.tendons);
      this.#ribs(drawing.ribs);
      if (this.turns) this.#frames();
      this.#base();
    }
    this.#path();
    if (track.measured?.arrays.seen.width) {
      this.measured = new Measured(track, this.colour, size);
      for (const object of this.measured.objects) this.#add("measured", object, false);
    }
    this.lines = [...this.#rodLines(), ...this.#tendonLines(), ...this.#shapeLines()];
  }

  #add(part, object, shadow = true) {
    object.castShadow = shadow;
    this.parts[part].push(object);
    this.group.add(object);
    return object;
  }

  show(part, wanted) {
    if (part === "measured") this.seen = wanted;
    for (const object of this.parts[part]) object.visible = wanted;
  }

  #rods() {
    const { track } = this;
    const parts = Math.max(1, Math.min(6, Math.ceil(60 / track.nodes)));
    this.rods = [];
    this.outlines = [];
    // a segment should be seen even of a rod that is very thin
    const seen = (r) => (this.overlay ? AROUND : 1) * Math.max(r, 0.0025 * this.size);
    this.radii = track.drawing.radii.map(seen);
    if (track.curves.length === 0) {
      const tube = new Tube(track.nodes, this.material, { parts, coloured: true });
      this.rods.push({ tube, radii: this.radii, points: this.points });
      this.#add("rods", tube.mesh, !this.overlay);
      // drawn first, so that the robot within shines in its own colour
      if (this.overlay) tube.mesh.renderOrder = -1;
    }
    for (const { shape, array } of track.curves) {
      const count = track.arrays[array].width / 3;
      const points = new Float32Array(3 * count);
      const rod = shape === "rod";
      const tube = new Tube(count, this.material, { parts: rod ? parts : 1 });
      const own = rod && this.radii.length === count ? this.radii : Math.max(...this.radii);
      this.rods.push({ tube, array, points, radii: rod ? own : 1.3 * own });
      this.#add("rods", tube.mesh);
      if (!rod) this.#plate(count, points);
    }
  }

  #plate(count, points) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * (count + 1)), 3));
    geometry.setIndex(Array.from({ length: count - 1 }, (_, k) => [k, k + 1, count]).flat());
    const material = new THREE.MeshStandardMaterial({
      color: this.colour, side: THREE.DoubleSide, transparent: true, opacity: PLATE, roughness: 0.6,
    });
    this.plateMaterial = material;
    const mesh = this.#add("rods", new THREE.Mesh(geometry, material));
    mesh.frustumCulled = false;
    this.outlines.push({ geometry, points, count });
  }

  /** Parts that have positions of their own: tubes, chambers, magnets, fields, joints … */
  #shapes(shapes) {
    const { track, size } = this;
    // thin tubes are all magnified until the thinnest one is seen
    const tubes = shapes.filter(({ kind }) => kind === "tube").map(({ radii }) => Math.max(...radii));
    const magnified = Math.max(1, (0.0035 * size) / Math.min(...tubes, Infinity));
    this.open = shapes.some(({ kind }) => kind === "chamber"); // seen through the rod
    this.shapes = shapes.map((about, index) => {
      const count = track.arrays[about.array].width / 3;
      const material = new THREE.MeshStandardMaterial({
        roughness: 0.6, transparent: true, opacity: about.opacity, vertexColors: about.ramp,
        depthWrite: about.opacity > 0.5, polygonOffset: true, polygonOffsetFactor: this.index, polygonOffsetUnits: this.index,
      });
      const curved = about.kind === "tube" ? 3 : 1;
      const tube = new Tube(count, material, { parts: curved, sides: 16, coloured: about.ramp });
      const radii = about.radii.map((r) => Math.max(about.kind === "tube" ? magnified * r : r, 0.0012 * size));
      if (about.radii.length === 4) radii[3] = 0; // the point of an arrow
      this.#add(about.group || "rods", tube.mesh, about.opacity > 0.5);
      return { ...about, index, tube, material, radii, count, points: new Float32Array(3 * count), colours: new Float32Array(3 * count) };
    });
    const { values, width } = track.arrays.values ?? { values: [], width: 1 };
    for (const shape of this.shapes) {
      shape.most = 0;
      for (let at = shape.index; at < values.length; at += width) shape.most = Math.max(shape.most, Math.abs(values[at]));
    }
    this.#recolourShapes();
  }

  #recolourShapes() {
    for (const { material, colour, shade, ramp } of this.shapes)
      material.color.set(ramp ? "#ffffff" : (colour ?? this.colour)).lerp(new THREE.Color("#ffffff"), ramp ? 0 : shade);
  }

  #moveShapes(moment) {
    const { track } = this;
    if (!this.shapes.length) return;
    this.values = track.whole("values", moment, (this.values ??= new Float32Array(this.shapes.length)));
    for (const shape of this.shapes) {
      track.whole(shape.array, moment, shape.points);
      if (shape.ramp) {
        const value = Math.abs(this.values[shape.index]);
        shape.most = Math.max(shape.most, value); // live: the range grows
        const colour = IDLE.clone().lerp(new THREE.Color(shape.colour), shape.most ? value / shape.most : 0);
        for (let n = 0; n < shape.count; n++) colour.toArray(shape.colours, 3 * n);
      }
      shape.tube.update(shape.points, shape.radii, shape.ramp ? shape.colours : null);
      // an arrow without length
      if (shape.kind === "field" || shape.kind === "force") shape.tube.mesh.scale.setScalar(this.values[shape.index] ? 1 : 1e-9);
      shape.material.opacity = shape.opacity * (moment.solved && !moment.coarse ? 1 : FADED);
    }
  }

  #shapeLines() {
    return this.shapes.map(({ points, count, radii, name, unit, index }) => ({
      kind: "part", points, count, radius: Math.max(...radii),
      place: () => (unit ? `${name}: ${quantity(this.values[index], unit)}` : name),
    }));
  }

  #tendons({ routes, ends }) {
    const { nodes, drawing } = this.track;
    const material = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.6, transparent: true });
    this.tendonMaterial = material;
    const radius = Math.max(Math.min(0.22 * Math.max(...drawing.radii), 0.004 * drawing.length), 0.0014 * this.size);
    this.tendons = routes.map((route, k) => {
      const count = Math.max(2, Math.round(ends[k] * (nodes - 1)) + 1);
      const tube = new Tube(count, material, { parts: 3, sides: 8, coloured: true });
      this.#add("tendons", tube.mesh);
      return { tube, route, count, radius, points: new Float32Array(3 * count), colours: new Float32Array(3 * count) };
    });
  }

  #ribs(ribs) {
    this.ribs = ribs.map(({ at, shape, radius, mass }) => {
      const thick = shape === "rib" ? 0.16 * radius : 0.06 * radius;
      const ball = shape === "ball" || !this.turns;
      const geometry = ball
        ? new THREE.SphereGeometry(Math.min(radius, 0.03 * this.size), 24, 16)
        : new THREE.CylinderGeometry(radius, radius, thick, 40);
      const material = new THREE.MeshStandardMaterial({
        color: shape === "guide" ? this.colour : 0x8a94a6, transparent: true, depthWrite: shape !== "guide",
        opacity: { ball: 0.95, rib: 0.8, guide: 0.28 }[shape], roughness: 0.55,
      });
      return { at, mass, mesh: this.#add("ribs", new THREE.Mesh(geometry, material), shape !== "guide") };
    });
  }

  #frames() {
    const { nodes } = this.track;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(18 * nodes), 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(18 * nodes), 3));
    this.axes = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ vertexColors: true }));
    this.axes.frustumCulled = false;
    this.#add("frames", this.axes, false);
    this.#axisColours();
  }

  #axisColours() {
    if (!this.axes) return;
    const axes = axisColours().map((colour) => new THREE.Color(colour));
    const { color } = this.axes.geometry.attributes;
    for (let v = 0; v < color.count; v++) axes[Math.floor((v % 6) / 2)].toArray(color.array, 3 * v);
    color.needsUpdate = true;
  }

  /** The lines whose nodes can be hovered: {kind, points, count, radius, place}. */
  #rodLines() {
    const { track } = this;
    const last = track.nodes - 1;
    const whole = track.nodes === track.all_nodes; // else nodes were left out, and their numbers are others
    const place = (n) => {
      const name = n === 0 ? "base, " : n === last ? "tip, " : "";
      return `${whole ? `node ${n}, ` : ""}${name}s = ${length(track.arclength[n])}`;
    };
    const radius = Math.max(...this.radii);
    if (!track.curves.length) return [{ kind: "rod", points: this.points, count: track.nodes, radius, place }];
    return this.rods.map(({ points }, k) => {
      const count = points.length / 3;
      const outline = track.curves[k].shape !== "rod";
      const s = (n) => length((track.drawing.length * n) / (count - 1));
      return {
        kind: outline ? "outline" : "curve", points, count, radius,
        place: outline ? () => "rigid plate, its edge" : (n) => `rod ${k + 1}, s = ${s(n)}`,
      };
    });
  }

  #tendonLines() {
    return (this.tendons ?? []).map(({ points, count, radius }, index) => ({
      kind: "tendon", index, points, count, radius,
      place: (n) => `tendon ${index + 1}, s = ${length(this.track.arclength[n])}`,
    }));
  }

  #base() {
    const legs = this.track.curves.filter(({ shape }) => shape === "rod");
    const sole = legs.length < 2;
    const rim = sole ? Math.max(0, ...this.track.drawing.ribs.map((rib) => rib.radius)) : 0;
    const radius = Math.max(1.15 * rim, 3.2 * Math.max(...this.radii), 0.012 * this.size);
    const height = Math.min(0.5 * radius, 0.02 * this.size);
    this.baseHeight = height;
    const geometry = new THREE.CylinderGeometry(radius, 1.08 * radius, height, 48);
    geometry.translate(0, -0.5 * height, 0);
    const material = new THREE.MeshStandardMaterial({ color: 0x5d6675, roughness: 0.7, metalness: 0.1 });
    this.bases = this.rods
      .filter((_, k) => sole ? k === 0 : k < legs.length)
      .map((rod) => ({ rod, mesh: this.#add("base", new THREE.Mesh(geometry, material)) }));
  }

  #path() {
    this.pathMaterial = new THREE.MeshBasicMaterial({ color: this.colour, transparent: true, opacity: 0.55 });
    this.ghostMaterial = new THREE.LineBasicMaterial({ color: this.colour, transparent: true, opacity: 0.3 });
    this.rebuildPath();
  }

  /** The tip's path of all rows: drawn once, and then shown as far as it has come. */
  rebuildPath(last = Infinity) {
    for (const object of this.parts.path) {
      this.group.remove(object);
      object.geometry.dispose();
    }
    const visible = this.parts.path[0]?.visible ?? true;
    this.parts.path = [];
    const { track } = this;
    this.pathRows = [];
    for (let row = Math.max(0, track.rows - last); row < track.rows; row++)
      if (track.solved[row]) this.pathRows.push(row);
    const points = new Float32Array(this.pathRows.flatMap((row) => track.tip(row)));
    if (this.pathRows.length < 2 || this.overlay) return;
    this.path = new Tube(this.pathRows.length, this.pathMaterial, { parts: 1, sides: 5 });
    this.path.update(points, 0.0016 * this.size);
    this.#add("path", this.path.mesh, false);
    if (last === Infinity) {
      const ghost = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(points, 3));
      this.#add("path", new THREE.Line(ghost, this.ghostMaterial), false);
    }
    this.show("path", visible);
  }

  /** Colour the rod by a quantity: {values: (node, moment) => number, range: [low, high]}, or null for none. */
  colourBy(quantity) {
    if (this.track.curves.length) return;
    this.quantity = quantity;
    this.material.vertexColors = Boolean(quantity);
    const colour = quantity ? new THREE.Color("#ffffff") : this.colour;
    this.material.color.copy(colour);
    this.material.emissiveIntensity = quantity ? 0 : 0.22;
    this.material.needsUpdate = true;
    // the quantity is that of the line within the tubes
    for (const { kind, tube } of this.shapes) if (kind === "tube") tube.mesh.visible = !quantity;
  }

  #quantityColours(moment) {
    const { values, range: [low, high] } = this.quantity;
    this.colours ??= new Float32Array(3 * this.track.nodes);
    for (let n = 0; n < this.track.nodes; n++) rampColour(QUANTITY, (values(n, moment) - low) / (high - low), this.colours, 3 * n);
    return this.colours;
  }

  /** The state at a time, tensions (N) coloured within a range. Gives the moment that is drawn. */
  update(time, range) {
    const { track, points } = this;
    const moment = track.at(time);
    this.moment = moment;
    track.perNode(track.position, 3, moment, points);
    if (this.turns) track.perNode(track.orientation, 4, moment, this.turns);
    for (const rod of this.rods) {
      if (rod.array) track.whole(rod.array, moment, rod.points);
      rod.tube.update(rod.points, rod.radii, this.quantity ? this.#quantityColours(moment) : null);
    }
    for (const { geometry, points: edge, count } of this.outlines) {
      const array = geometry.attributes.position.array;
      array.set(edge.subarray(0, 3 * count));
      for (let k = 0; k < 3; k++) {
        let sum = 0;
        for (let i = 0; i < count - 1; i++) sum += edge[3 * i + k];
        array[3 * count + k] = sum / (count - 1);
      }
      geometry.attributes.position.needsUpdate = true;
      geometry.computeVertexNormals();
    }
    this.#moveShapes(moment);
    if (this.tendons) this.#pull(moment, range);
    for (const { at, mesh } of this.ribs) this.#place(mesh, at);
    for (const { mesh, rod } of this.bases) {
      mesh.position.fromArray(rod.points, 0);
      if (this.turns && !rod.array) mesh.quaternion.copy(this.#turn(0)).multiply(ALONG);
      else mesh.quaternion.setFromUnitVectors(UP, this.#heading(rod.points));
    }
    if (this.axes) this.#orient();
    this.measured?.update(moment, this.seen);
    this.path?.until(Math.max(0, this.pathRows.filter((row) => row <= moment.drawn).length - 1));
    const opacity = (moment.solved && !moment.coarse ? 1 : FADED) * (this.overlay ? OVERLAY : 1);
    this.material.opacity = opacity * (this.open ? OPEN : 1);
    if (this.tendonMaterial) this.tendonMaterial.opacity = opacity;
    if (this.plateMaterial) this.plateMaterial.opacity = PLATE * opacity;
    return moment;
  }

  /** How far (m) parts reach beyond the rods' lines. */
  get margin() {
    return Math.max(...this.radii, ...this.track.drawing.ribs.map((rib) => rib.radius), this.baseHeight);
  }

  /** Where the tip is drawn. */
  get tip() {
    return Array.from(this.points.slice(-3));
  }

  #heading(points) {
    return new THREE.Vector3(points[3] - points[0], points[4] - points[1], points[5] - points[2]).normalize();
  }

  #turn(node) {
    const [w, x, y, z] = this.turns.subarray(4 * node, 4 * node + 4);
    return new THREE.Quaternion(x, y, z, w).normalize();
  }

  #place(mesh, at) {
    const last = this.track.nodes - 1;
    const low = Math.min(last - 1, Math.floor(at * last + 1e-9));
    const part = at * last - low;
    for (let k = 0; k < 3; k++) {
      const a = this.points[3 * low + k];
      mesh.position.setComponent(k, a + part * (this.points[3 * low + 3 + k] - a));
    }
    if (!this.turns) return;
    mesh.quaternion.copy(this.#turn(low).slerp(this.#turn(low + 1), part)).multiply(ALONG);
  }

  #pull(moment, [low, high]) {
    const { track } = this;
    const { loss } = track.drawing.tendons;
    const base = this.baseTensions();
    const losses = loss && track.perNode(loss, this.tendons.length, moment, (this.losses ??= new Float32Array(track.nodes * this.tendons.length)));
    const r = new THREE.Vector3();
    this.tendons.forEach(({ tube, route, count, radius, points, colours }, k) => {
      for (let n = 0; n < count; n++) {
        r.fromArray(route[n]).applyQuaternion(this.#turn(n));
        points[3 * n] = this.points[3 * n] + r.x;
        points[3 * n + 1] = this.points[3 * n + 1] + r.y;
        points[3 * n + 2] = this.points[3 * n + 2] + r.z;
        const left = losses ? Math.exp(-losses[n * this.tendons.length + k]) : 1;
        rampColour(TENSION, (base[k] * left - low) / (high - low), colours, 3 * n);
      }
      tube.update(points, radius, colours);
    });
  }

  /** Tensions (N) of all tendons at the base. */
  baseTensions() {
    const { array, offset } = this.track.drawing.tendons.tension;
    const { values, width } = this.track.arrays[array];
    const from = this.moment.drawn * width + offset;
    return Array.from(values.subarray(from, from + this.tendons.length));
  }

  /** The tension (N) of a tendon at a node, and at the base. */
  tensionAt(tendon, node) {
    const base = this.baseTensions()[tendon];
    const lost = this.track.drawing.tendons.loss ? this.losses[node * this.tendons.length + tendon] : 0;
    return { here: base * Math.exp(-lost), base };
  }

  /** The body that is attached nearest to a node, {mass} in kg, if there is one. */
  bodyAt(node) {
    const last = this.track.nodes - 1;
    return this.ribs.find(({ at, mass }) => mass !== undefined && Math.abs(at * last - node) < 0.5);
  }

  #orient() {
    const array = this.axes.geometry.attributes.position.array;
    const length = 0.055 * this.size;
    const axis = new THREE.Vector3();
    for (let n = 0; n < this.track.nodes; n++)
      for (let k = 0; k < 3; k++) {
        const at = 18 * n + 6 * k;
        axis.set(0, 0, 0).setComponent(k, length).applyQuaternion(this.#turn(n));
        for (let c = 0; c < 3; c++) {
          array[at + c] = this.points[3 * n + c];
          array[at + 3 + c] = this.points[3 * n + c] + axis.getComponent(c);
        }
      }
    this.axes.geometry.attributes.position.needsUpdate = true;
  }

  /** The smallest and largest base tension (N); of row 0, where a robot may be at rest, only if there is no other. */
  get tensions() {
    const { tendons } = this.track.drawing;
    if (!this.tendons) return [];
    const { values, width } = this.track.arrays[tendons.tension.array];
    const found = [];
    for (let row = Math.min(1, this.track.rows - 1); row < this.track.rows; row++)
      for (let k = 0; k < this.tendons.length; k++) {
        const value = values[row * width + tendons.tension.offset + k];
        if (this.track.solved[row]) found.push(value);
      }
    return found.length ? [Math.min(...found), Math.max(...found)] : [];
  }

  recolour(colour) {
    this.colour.set(colour);
    if (!this.quantity) this.material.color.set(colour);
    this.material.emissive.set(colour);
    this.#axisColours();
    this.#recolourShapes();
    this.measured?.recolour(colour);
    this.pathMaterial.color.set(colour);
    this.ghostMaterial.color.set(colour);
  }
}
