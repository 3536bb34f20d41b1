// Colours of robots, axes and quantities. All sets can be told apart with any colour vision; a test checks this.
import * as THREE from "three";

const dark = matchMedia("(prefers-color-scheme: dark)");

/** Robots: six colours after Okabe and Ito, then the same ones darker (lighter on a dark page). */
export const ROBOTS = {
  light: [
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9",
    "#003A5C", "#7A2E00", "#00543D", "#8A2F63", "#7D5A00", "#1F6F9E",
  ],
  dark: [
    "#56B4E9", "#E69F00", "#19A67B", "#CC79A7", "#F0E442", "#E0703A",
    "#B9E0F7", "#F7D58B", "#A5EBD3", "#F0C6DF", "#FFFBD0", "#F6C3A6",
  ],
};
/** Axes x, y, z: other colours than those of the first robots, after Tol. */
export const AXES = { light: ["#C8102E", "#C79A00", "#004488"], dark: ["#FF8095", "#EECC66", "#6699FF"] };

/** Tension of tendons, from the smallest to the largest. */
export const TENSION = ["#5b6c8f", "#a0617f", "#dd6a4b", "#f5b335"].map((c) => new THREE.Color(c));
/** A quantity along the rods, from the smallest to the largest: Viridis. */
export const QUANTITY = ["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"].map((c) => new THREE.Color(c));

const shade = () => (dark.matches ? "dark" : "light");

/** Call a function when the page changes between light and dark. */
export const onChange = (call) => dark.addEventListener("change", call);

/** The colour of robot k. */
export const robotColour = (k) => ROBOTS[shade()][k % ROBOTS.light.length];

/** The colours of x, y and z. */
export const axisColours = () => AXES[shade()];

/** The colour of a component by its name: x, y, z as the axes; w grey; numbers as robots. */
export function componentColour(name, index) {
  const axis = ["x", "y", "z"].indexOf(name);
  if (axis >= 0) return axisColours()[axis];
  return name === "w" ? "#808a99" : robotColour(index);
}

/** Write the colour of a part (0 to 1) of a ramp into an array. */
export function rampColour(ramp, part, into, at) {
  const place = Math.min(0.9999, Math.max(0, Number.isFinite(part) ? part : 0)) * (ramp.length - 1);
  const low = Math.floor(place);
  const [a, b] = [ramp[low], ramp[low + 1]];
  into[at] = a.r + (place - low) * (b.r - a.r);
  into[at + 1] = a.g + (place - low) * (b.g - a.g);
  into[at + 2] = a.b + (place - low) * (b.b - a.b);
}

/** A ramp as a CSS background. */
export const rampStyle = (ramp) => `linear-gradient(90deg, ${ramp.map((c) => `#${c.getHexString()}`).join(", ")})`;
