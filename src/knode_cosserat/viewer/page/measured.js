// Measured bodies of a recording beside their prediction: balls, the errors as bars, and the band of the prediction.
import * as THREE from "three";

const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Radius of a ball, and of a bar of an error, as parts of the size of the scene. */
const BALL = 0.009;
const BAR = 0.0022;
const UP = new THREE.Vector3(0, 1, 0);
/** Opacity of the band. */
const BAND = 0.22;

export class Measured {
  /** `objects` are to be added to the robot that predicts; they are drawn anew by `update`. */
  constructor(track, colour, size) {
    Object.assign(this, { track, size });
    const { seen, low } = track.measured.arrays;
    this.count = seen.width / 3;
    // seen through the robot, which may be thick
    const through = { depthTest: false, transparent: true };
    this.ball = new THREE.MeshStandardMaterial({ roughness: 0.6, ...through });
    this.balls = Array.from({ length: this.count }, () => new THREE.Mesh(new THREE.SphereGeometry(BALL * size, 24, 16), this.ball));
    this.bar = new THREE.MeshBasicMaterial(through);
    this.bars = this.balls.map(() => new THREE.Mesh(new THREE.CylinderGeometry(BAR * size, BAR * size, 1, 10), this.bar));
    this.band = new THREE.MeshStandardMaterial({ color: colour, transparent: true, opacity: BAND, depthWrite: false });
    this.bands = low ? this.balls.map(() => new THREE.Mesh(new THREE.SphereGeometry(1, 32, 24), this.band)) : [];
    this.objects = [...this.balls, ...this.bars, ...this.bands];
    for (const bar of this.bars) bar.renderOrder = 1;
    for (const ball of this.balls) ball.renderOrder = 2;
    this.recolour(colour);
  }

  recolour(colour) {
    this.ball.color.set(style("--target"));
    this.bar.color.set(style("--bad"));
    this.band.color.set(colour);
  }

  /** Draw a moment of the track, while `wanted`. */
  update(moment, wanted) {
    const [a, b] = [new Float32Array(3), new Float32Array(3)];
    for (let k = 0; k < this.count; k++) {
      const known = this.track.body("seen", k, moment, a) && this.track.body("predicted", k, moment, b);
      this.balls[k].visible = this.bars[k].visible = wanted && known;
      if (known) this.#place(k, new THREE.Vector3(...a), new THREE.Vector3(...b));
      if (!this.bands[k]) continue;
      const inside = this.track.body("low", k, moment, a) && this.track.body("high", k, moment, b);
      this.bands[k].visible = wanted && inside;
      for (let c = 0; inside && c < 3; c++) {
        this.bands[k].position.setComponent(c, 0.5 * (a[c] + b[c]));
        this.bands[k].scale.setComponent(c, Math.max(0.5 * (b[c] - a[c]), 1e-4 * this.size));
      }
    }
  }

  #place(k, seen, predicted) {
    const bar = this.bars[k];
    this.balls[k].position.copy(seen);
    bar.position.copy(seen).add(predicted).multiplyScalar(0.5);
    const error = predicted.sub(seen);
    bar.scale.y = Math.max(error.length(), 1e-6 * this.size);
    bar.quaternion.setFromUnitVectors(UP, error.normalize());
  }
}
