// Measured bodies of a recording beside their prediction: balls, the errors as lines, and the band of the prediction.
import * as THREE from "three";

const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Radius of a ball, as a part of the size of the scene. */
const BALL = 0.009;
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
    const lines = new THREE.BufferGeometry();
    lines.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6 * this.count), 3));
    this.line = new THREE.LineBasicMaterial(through);
    this.errors = new THREE.LineSegments(lines, this.line);
    this.errors.frustumCulled = false;
    this.band = new THREE.MeshStandardMaterial({ color: colour, transparent: true, opacity: BAND, depthWrite: false });
    this.bands = low ? this.balls.map(() => new THREE.Mesh(new THREE.SphereGeometry(1, 32, 24), this.band)) : [];
    this.objects = [...this.balls, this.errors, ...this.bands];
    this.errors.renderOrder = 1;
    for (const ball of this.balls) ball.renderOrder = 2;
    this.point = [new Float32Array(3), new Float32Array(3)];
    this.recolour(colour);
  }

  recolour(colour) {
    this.ball.color.set(style("--target"));
    this.line.color.set(style("--bad"));
    this.band.color.set(colour);
  }

  /** Draw a moment of the track, while `wanted`. */
  update(moment, wanted) {
    const { position } = this.errors.geometry.attributes;
    const [a, b] = this.point;
    for (let k = 0; k < this.count; k++) {
      const known = this.track.body("seen", k, moment, a);
      this.balls[k].visible = wanted && known;
      if (known) this.balls[k].position.fromArray(a);
      this.track.body("predicted", k, moment, b);
      position.array.set(b, 6 * k);
      position.array.set(known ? a : b, 6 * k + 3);
      if (!this.bands[k]) continue;
      const [low, high] = this.point;
      const inside = this.track.body("low", k, moment, low) && this.track.body("high", k, moment, high);
      this.bands[k].visible = wanted && inside;
      if (!inside) continue;
      for (let c = 0; c < 3; c++) {
        this.bands[k].position.setComponent(c, 0.5 * (low[c] + high[c]));
        this.bands[k].scale.setComponent(c, Math.max(0.5 * (high[c] - low[c]), 1e-4 * this.size));
      }
    }
    this.errors.visible = wanted;
    position.needsUpdate = true;
  }
}
