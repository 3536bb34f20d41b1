// Axes x, y, z in a corner of the picture, turned as the camera is.
import * as THREE from "three";

/** Edge of its square (px), and its distance from the right and lower edge of the picture. */
const SIZE = 92;
const RIGHT = 6;
const BOTTOM = 60;

/** A letter that always faces the camera. */
function letter(text, colour) {
  const canvas = Object.assign(document.createElement("canvas"), { width: 64, height: 64 });
  const context = canvas.getContext("2d");
  context.font = "bold 48px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = colour;
  context.fillText(text, 32, 32);
  const map = new THREE.CanvasTexture(canvas);
  map.colorSpace = THREE.SRGBColorSpace;
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthTest: false }));
  sprite.scale.setScalar(0.62);
  return sprite;
}

export class Triad {
  constructor(colours) {
    this.camera = new THREE.OrthographicCamera(-1.6, 1.6, 1.6, -1.6, 0.1, 20);
    this.paint(colours);
  }

  /** Draw the axes in other colours. */
  paint(colours) {
    this.scene = new THREE.Scene();
    ["x", "y", "z"].forEach((name, k) => {
      const along = new THREE.Vector3().setComponent(k, 1);
      const material = new THREE.MeshBasicMaterial({ color: colours[k] });
      const shaft = new THREE.Mesh(new THREE.CylinderGeometry(0.045, 0.045, 0.8, 12).translate(0, 0.4, 0), material);
      const head = new THREE.Mesh(new THREE.ConeGeometry(0.13, 0.28, 16).translate(0, 0.92, 0), material);
      for (const mesh of [shaft, head]) {
        mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along);
        this.scene.add(mesh);
      }
      const label = letter(name, colours[k]);
      label.position.copy(along).multiplyScalar(1.32);
      this.scene.add(label);
    });
  }

  /** Draw the axes into a picture of a width (px), as the camera sees them. */
  draw(renderer, camera, width) {
    this.camera.quaternion.copy(camera.quaternion);
    this.camera.position.set(0, 0, 5).applyQuaternion(camera.quaternion);
    const left = width - RIGHT - SIZE;
    renderer.setViewport(left, BOTTOM, SIZE, SIZE);
    renderer.setScissor(left, BOTTOM, SIZE, SIZE);
    renderer.autoClear = false;
    renderer.clearDepth();
    renderer.render(this.scene, this.camera);
    renderer.autoClear = true;
  }
}
