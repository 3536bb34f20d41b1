// Directions of the camera, and the distance at which everything is in the picture.
import * as THREE from "three";

/** Views by name: the direction from the middle to the camera, in parts of right, back and up. */
const DIRECTIONS = {
  front: [0, -1, 0],
  side: [1, 0, 0],
  top: [0, -1e-4, 1], // exactly above, right and left would not be known
  isometric: [1, -1, 1],
};
export const VIEWS = Object.keys(DIRECTIONS);
/** Free space around what is fitted, as a factor of the distance. */
const MARGIN = 1.12;

/** Axes of a page: up, right (x unless that is up), and back (away from the front view's camera). */
function axes(up) {
  const right = new THREE.Vector3(...(Math.abs(up.x) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  right.addScaledVector(up, -right.dot(up)).normalize();
  return [right, up.clone().cross(right), up];
}

/** The direction from the middle to the camera, for a view by name. */
export function direction(name, up) {
  const found = new THREE.Vector3();
  axes(up).forEach((axis, k) => found.addScaledVector(axis, DIRECTIONS[name][k]));
  return found.normalize();
}

/** The distance from the middle of a box at which a perspective camera sees all its corners. */
export function fitting(box, towards, up, fov, aspect) {
  const tangent = Math.tan((0.5 * fov * Math.PI) / 180);
  const right = up.clone().cross(towards).normalize();
  const above = towards.clone().cross(right);
  const middle = box.getCenter(new THREE.Vector3());
  let distance = 0;
  for (let k = 0; k < 8; k++) {
    const corner = new THREE.Vector3(...["x", "y", "z"].map((axis, i) => ((k >> i) & 1 ? box.max : box.min)[axis]));
    corner.sub(middle);
    const across = Math.abs(corner.dot(right)) / (tangent * aspect);
    distance = Math.max(distance, corner.dot(towards) + Math.max(across, Math.abs(corner.dot(above)) / tangent));
  }
  return MARGIN * distance;
}
