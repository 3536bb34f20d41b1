// The space that robots stand in: camera, light, ground, obstacles; all in one view or side by side.
import * as THREE from "three";
import { OrbitControls } from "orbit-controls";
import { axisColours } from "viewer/colours";
import { Triad } from "viewer/triad";
import { direction, fitting } from "viewer/views";

const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** A round number near a value. */
export function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].find((step) => step * power >= 0.7 * value) * power;
}

/** Whether the processor draws, and not a graphics card: what is fine then has to wait for the motion to end. */
function software() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const drawnBy = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(drawnBy);
}

export class Stage {
  constructor(canvas, [low, high], up) {
    this.canvas = canvas;
    const soft = software();
    this.soft = soft;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !soft, preserveDrawingBuffer: false });
    this.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
    this.renderer.setScissorTest(true);
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.PCFSoftShadowMap;
    this.scene = new THREE.Scene();
    this.up = new THREE.Vector3(...up).normalize();
    this.low = new THREE.Vector3(...low);
    this.high = new THREE.Vector3(...high);
    this.centre = this.low.clone().add(this.high).multiplyScalar(0.5);
    this.camera = new THREE.PerspectiveCamera(35, 1, 0.001, 100);
    this.camera.up.copy(this.up);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.addEventListener("change", () => (this.dirty = true));
    this.groups = [];
    this.dirty = true;
    this.sideBySide = false;
    this.triad = new Triad(axisColours());
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  /** Set everything up for things of a size (m). */
  furnish(size, ground) {
    this.size = size;
    this.camera.near = size / 100;
    this.camera.far = size * 100;
    this.controls.minDistance = size / 20;
    this.controls.maxDistance = size * 12;
    const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 1, 0), this.up);
    const light = new THREE.DirectionalLight(0xffffff, 2.6);
    light.position.copy(this.centre).addScaledVector(this.up, 2.2 * size);
    light.position.add(new THREE.Vector3(-0.7 * size, 0, 1.1 * size).applyQuaternion(turn));
    light.target.position.copy(this.centre);
    light.castShadow = true;
    light.shadow.mapSize.set(2048, 2048);
    this.light = light;
    light.shadow.normalBias = 0.004 * size;
    light.shadow.radius = 5;
    Object.assign(light.shadow.camera, {
      left: -1.3 * size, right: 1.3 * size, top: 1.3 * size, bottom: -1.3 * size, near: 0.1 * size, far: 6 * size,
    });
    this.sky = new THREE.HemisphereLight(0xffffff, 0xd5d8de, 2);
    this.sky.position.copy(this.up);
    const fill = new THREE.DirectionalLight(0xffffff, 1.2);
    fill.position.copy(this.centre).add(new THREE.Vector3(size, 0.4 * size, -size).applyQuaternion(turn));
    fill.target.position.copy(this.centre);
    this.scene.add(light, light.target, this.sky, fill, fill.target);
    this.#ground(size, ground, turn);
    this.paint();
    this.home();
  }

  #ground(size, height, turn) {
    this.ground = new THREE.Group();
    this.spacing = nice(size / 6);
    const count = 2 * Math.ceil((1.6 * size) / this.spacing);
    this.grid = new THREE.GridHelper(count * this.spacing, count);
    this.grid.material.transparent = true;
    const reach = 0.5 * count * this.spacing;
    this.shade = new THREE.Mesh(
      new THREE.CircleGeometry(1.4 * reach, 64).rotateX(-Math.PI / 2), new THREE.ShadowMaterial({ opacity: 0.16 }),
    );
    this.shade.receiveShadow = true;
    this.shade.position.y = -0.0005 * size;
    this.ground.add(this.grid, this.shade);
    this.ground.quaternion.copy(turn);
    const flat = this.centre.clone().addScaledVector(this.up, -this.centre.dot(this.up));
    for (const axis of ["x", "y", "z"]) flat[axis] = Math.round(flat[axis] / this.spacing) * this.spacing;
    flat.addScaledVector(this.up, -flat.dot(this.up));
    this.ground.position.copy(flat).addScaledVector(this.up, height);
    this.scene.add(this.ground);
  }

  /** Planes, spheres and cylinders. */
  obstacle({ shape, point, normal, axis, radius, inside }, group) {
    const material = new THREE.MeshStandardMaterial({
      color: 0x8f9bb0, roughness: 0.8, transparent: true, opacity: inside ? 0.18 : 0.5,
      side: THREE.DoubleSide, depthWrite: !inside,
    });
    const reach = 1.3 * this.size;
    const y = new THREE.Vector3(0, 1, 0);
    let mesh;
    if (shape === "plane") {
      const along = new THREE.Vector3(...normal).normalize();
      mesh = new THREE.Mesh(new THREE.BoxGeometry(2 * reach, 0.004 * this.size, 2 * reach), material);
      material.opacity = 0.3;
      mesh.quaternion.setFromUnitVectors(y, along);
      // its point may be anywhere: the part near the robot is drawn
      const away = this.centre.clone().sub(new THREE.Vector3(...point)).dot(along);
      mesh.position.copy(this.centre).addScaledVector(along, -away - 0.002 * this.size);
    } else if (shape === "sphere") {
      mesh = new THREE.Mesh(new THREE.SphereGeometry(radius, 48, 32), material);
      mesh.position.set(...point);
    } else if (shape === "cylinder") {
      const along = new THREE.Vector3(...axis).normalize();
      mesh = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, 1.6 * reach, 72, 1, inside), material);
      mesh.quaternion.setFromUnitVectors(y, along);
      const from = this.centre.clone().sub(new THREE.Vector3(...point));
      mesh.position.set(...point).addScaledVector(along, from.dot(along));
    } else return false;
    mesh.receiveShadow = true;
    mesh.castShadow = !inside && shape !== "plane";
    group.add(mesh);
    return true;
  }

  /** The colours of the page, light or dark. */
  paint() {
    this.scene.background = new THREE.Color(style("--stage"));
    this.scene.fog = new THREE.Fog(this.scene.background, 4.2 * this.size, 9 * this.size);
    const line = new THREE.Color(style("--grid"));
    const colours = this.grid.geometry.attributes.color;
    for (let k = 0; k < colours.count; k++) colours.setXYZ(k, line.r, line.g, line.b);
    colours.needsUpdate = true;
    this.shade.material.opacity = Number(style("--shade"));
    this.sky.intensity = Number(style("--sky"));
    for (const part of this.target?.children ?? []) part.material.color.set(style("--target"));
    this.triad.paint(axisColours());
    this.dirty = true;
  }

  /** The camera where it was at first: obliquely from the front, with everything in the picture. */
  home() {
    this.view("isometric");
  }

  /** Look from the front, the side, the top, or obliquely ("isometric"), with everything in the picture. */
  view(name) {
    this.camera.position.copy(this.controls.target).add(direction(name, this.up));
    this.fit();
  }

  /** Everything that is shown in the picture, from where the camera looks now. */
  fit() {
    const towards = this.camera.position.clone().sub(this.controls.target).normalize();
    const { width, height } = this.#cells()[0];
    const box = this.bounds();
    const distance = fitting(box, towards, this.up, this.camera.fov, width / Math.max(1, height));
    box.getCenter(this.controls.target);
    this.camera.position.copy(this.controls.target).addScaledVector(towards, Math.max(distance, this.controls.minDistance));
    this.controls.update();
    this.dirty = true;
  }

  /** The box of what is shown. */
  bounds() {
    const shown = this.groups.filter((group) => group.userData.wanted && group.userData.box);
    const box = new THREE.Box3(this.low.clone(), this.high.clone());
    if (shown.length) {
      box.makeEmpty();
      for (const group of shown) box.union(group.userData.box);
    }
    if (this.target) box.expandByPoint(this.target.position);
    return box;
  }

  /** A cross at a position (m), which is seen through everything. */
  mark(position) {
    const size = 0.035 * this.size;
    const corners = ["x", "y", "z"].flatMap((axis) => [-size, size].map((x) => Object.assign(new THREE.Vector3(), { [axis]: x })));
    const cross = new THREE.LineSegments(
      new THREE.BufferGeometry().setFromPoints(corners), new THREE.LineBasicMaterial({ depthTest: false, transparent: true }),
    );
    const ball = new THREE.Mesh(
      new THREE.SphereGeometry(0.3 * size, 24, 16), new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.75 }),
    );
    this.target = new THREE.Group().add(cross, ball);
    this.target.position.set(...position);
    cross.renderOrder = 1;
    this.scene.add(this.target);
    this.paint();
    this.fit();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (width && height) this.renderer.setSize(width, height, false);
    this.dirty = true;
  }

  get shown() {
    return this.groups.filter((group) => group.userData.wanted);
  }

  #cells() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    const shown = this.shown.length;
    if (!this.sideBySide || shown < 2) return [{ x: 0, y: 0, width, height }];
    const columns = width > height ? Math.ceil(Math.sqrt(shown * Math.max(1, width / height / 1.3))) : Math.ceil(Math.sqrt(shown / 2));
    const across = Math.min(shown, Math.max(1, columns));
    const down = Math.ceil(shown / across);
    return this.shown.map((_, k) => ({
      x: ((k % across) * width) / across, y: (Math.floor(k / across) * height) / down,
      width: width / across, height: height / down,
    }));
  }

  /** Without a graphics card shadows and smooth edges wait until nothing moves. */
  #quality(fine) {
    if (!this.soft || fine === this.fine) return;
    this.fine = fine;
    this.light.castShadow = this.shade.visible = fine;
    this.renderer.setPixelRatio(fine ? 2 : 1);
    this.resize();
  }

  /** Draw; gives where each robot that is shown was drawn. */
  draw(fine = false) {
    this.#quality(fine);
    return this.#render();
  }

  #render() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    const cells = this.#cells();
    const apart = cells.length > 1;
    cells.forEach((cell, k) => {
      for (const group of this.groups) group.visible = group.userData.wanted && (!apart || group === this.shown[k]);
      const bottom = height - cell.y - cell.height;
      this.renderer.setViewport(cell.x, bottom, cell.width, cell.height);
      this.renderer.setScissor(cell.x, bottom, cell.width, cell.height);
      this.camera.aspect = cell.width / Math.max(1, cell.height);
      this.camera.updateProjectionMatrix();
      this.renderer.render(this.scene, this.camera);
    });
    this.triad.draw(this.renderer, this.camera, width);
    this.dirty = false;
    return apart ? cells : [];
  }

  /** Draw once with so many pixels of the picture to one of the screen, call `after`, and draw as before. */
  sharply(ratio, after) {
    const before = this.renderer.getPixelRatio();
    this.light.castShadow = this.shade.visible = true;
    this.renderer.setPixelRatio(ratio);
    this.resize();
    this.#render();
    after();
    if (this.soft) this.light.castShadow = this.shade.visible = Boolean(this.fine);
    this.renderer.setPixelRatio(before);
    this.resize();
    this.#render();
  }

  /** The part of the picture at a place (px), with the robots in it: {x, y, width, height, groups}. */
  cellAt(x, y) {
    const cells = this.#cells();
    const k = cells.findIndex((cell) => x >= cell.x && x < cell.x + cell.width && y >= cell.y && y < cell.y + cell.height);
    return k < 0 ? null : { ...cells[k], groups: cells.length > 1 ? [this.shown[k]] : this.shown };
  }

  /** The place of point n of points (n × 3) in a part of the picture (px), its depth, and the pixels of a metre there. */
  project(points, n, { x, y, width, height }) {
    const { camera } = this;
    const point = new THREE.Vector3(points[3 * n], points[3 * n + 1], points[3 * n + 2]);
    const away = point.distanceTo(camera.position);
    point.project(camera);
    const scale = height / (2 * Math.tan((0.5 * camera.fov * Math.PI) / 180) * away);
    return { x: x + 0.5 * (1 + point.x) * width, y: y + 0.5 * (1 - point.y) * height, depth: point.z, scale };
  }

  /** The ray from the camera through a place (px) in a part of the picture. */
  ray(px, py, { x, y, width, height }) {
    const towards = new THREE.Vector3((2 * (px - x)) / width - 1, 1 - (2 * (py - y)) / height, 0.5).unproject(this.camera);
    return new THREE.Ray(this.camera.position.clone(), towards.sub(this.camera.position).normalize());
  }

  /** When what was asked for is drawn: nothing waits for it in the meantime. */
  async finished() {
    const gl = this.renderer.getContext();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) await new Promise((again) => setTimeout(again, 1));
    gl.deleteSync(fence);
  }

  /** Wait until what was drawn is drawn, for measurements. */
  finish() {
    const gl = this.renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }
}
