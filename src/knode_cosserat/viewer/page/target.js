// A target that is dragged with the mouse or a finger: in the plane that faces the camera, or horizontally.
import * as THREE from "three";

/** Distance (px) at which the target is caught, by a mouse and by a finger. */
const NEAR = 22;
const FINGER = 40;
/** Size of a target that is caught. */
const LARGER = 1.4;

export class TargetDrag {
  /** `horizontal` is true if drags are horizontal without Shift; `to` gets each position and the time of its event. */
  constructor(stage, { horizontal, reach, to }) {
    Object.assign(this, { stage, horizontal, reach, to, pointer: null });
    const { canvas } = stage;
    // before the camera's controls, which listen on the canvas itself
    const place = canvas.parentElement;
    const listen = (name, call) => place.addEventListener(name, (event) => call.call(this, event), { capture: true });
    listen("pointerdown", this.#down);
    listen("pointermove", this.#move);
    for (const name of ["pointerup", "pointercancel"]) listen(name, this.#up);
  }

  #at(event) {
    const { left, top } = this.stage.canvas.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  }

  /** The part of the picture in which the target is under the pointer, or null. */
  #caught(event) {
    const [x, y] = this.#at(event);
    const cell = this.stage.cellAt(x, y);
    if (!cell || event.target !== this.stage.canvas) return null;
    const seen = this.stage.project(this.stage.target.position.toArray(), 0, cell);
    const near = event.pointerType === "touch" ? FINGER : NEAR;
    return seen.depth < 1 && Math.hypot(seen.x - x, seen.y - y) <= near ? cell : null;
  }

  #down(event) {
    const cell = event.button === 0 && this.#caught(event);
    if (!cell) return;
    event.stopPropagation();
    event.preventDefault();
    Object.assign(this, { pointer: event.pointerId, cell });
    this.#anchor(event);
    this.stage.canvas.setPointerCapture(event.pointerId);
    this.#invite("grabbing");
  }

  /** A larger target and another cursor show that it can be dragged. */
  #invite(cursor) {
    const scale = cursor ? LARGER : 1;
    this.stage.canvas.style.cursor = cursor;
    if (this.stage.target.scale.x === scale) return;
    this.stage.target.scale.setScalar(scale);
    this.stage.dirty = true;
  }

  #move(event) {
    if (this.pointer === null) {
      if (!event.buttons) this.#invite(this.#caught(event) ? "move" : "");
      return;
    }
    if (event.pointerId !== this.pointer) return;
    event.stopPropagation();
    if (this.flat !== this.#isFlat(event)) this.#anchor(event);
    const ray = this.stage.ray(...this.#at(event), this.cell);
    const hit = ray.intersectPlane(this.plane, new THREE.Vector3());
    if (!hit) return; // the plane is seen from its edge
    const place = hit.add(this.offset);
    const away = place.clone().sub(this.stage.centre);
    // near the horizon a horizontal plane has no end
    if (away.length() > this.reach) place.copy(this.stage.centre).addScaledVector(away.normalize(), this.reach);
    this.to(place.toArray(), event.timeStamp);
  }

  #isFlat(event) {
    return Boolean(event.shiftKey || this.horizontal());
  }

  /** A plane through the target, and the way from where the pointer has caught it to its middle. */
  #anchor(event) {
    const { target, camera, up } = this.stage;
    const ray = this.stage.ray(...this.#at(event), this.cell);
    this.flat = this.#isFlat(event);
    const normal = this.flat ? up.clone() : camera.getWorldDirection(new THREE.Vector3());
    this.plane = new THREE.Plane().setFromNormalAndCoplanarPoint(normal, target.position);
    const hit = ray.intersectPlane(this.plane, new THREE.Vector3());
    this.offset = hit ? target.position.clone().sub(hit) : new THREE.Vector3();
  }

  #up(event) {
    if (event.pointerId !== this.pointer) return;
    event.stopPropagation();
    this.pointer = null;
    this.#invite("");
  }
}
