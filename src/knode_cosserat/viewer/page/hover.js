// Values of the node under the mouse: its position, its arclength, and the quantity that is plotted there.
import { robotColour } from "viewer/colours";
import { position, quantity, short } from "viewer/units";

/** Distance (px) at which a line is hovered, if it is thinner. */
const NEAR = 14;

export class Hover {
  /** `field` returns the quantity that is plotted, {name, meaning, unit, components …}. */
  constructor(stage, robots, { box, mark, field }) {
    Object.assign(this, { stage, robots, box, mark, field });
    const { canvas } = stage;
    canvas.addEventListener("pointermove", (event) => {
      const { left, top } = canvas.getBoundingClientRect();
      this.pointer = event.buttons ? null : { x: event.clientX - left, y: event.clientY - top };
      this.update();
    });
    for (const name of ["pointerleave", "pointerdown"])
      canvas.addEventListener(name, () => {
        this.pointer = null;
        this.update();
      });
  }

  /** Show the values under the mouse as they are now. */
  update() {
    const found = this.pointer && this.#nearest();
    this.box.hidden = this.mark.hidden = !found;
    if (!found) return;
    const robot = this.robots[found.robot];
    this.mark.style.transform = `translate(${found.x}px, ${found.y}px)`;
    this.mark.style.borderColor = robotColour(found.robot);
    const name = document.createElement("b");
    name.textContent = robot.track.name;
    const lines = this.words(robot, found).map((text) => Object.assign(document.createElement("div"), { textContent: text }));
    this.box.replaceChildren(name, ...lines);
    // beside the node, on the side that has more room
    const { clientWidth: width, clientHeight: height } = this.stage.canvas.parentElement;
    const style = this.box.style;
    style.left = found.x < width / 2 ? `${found.x + 16}px` : "auto";
    style.right = found.x < width / 2 ? "auto" : `${width - found.x + 16}px`;
    style.top = found.y < height / 2 ? `${found.y + 10}px` : "auto";
    style.bottom = found.y < height / 2 ? "auto" : `${height - found.y + 10}px`;
  }

  /** The node that is nearest to the mouse, of the line that is nearest: {robot, line, node, x, y}, or null. */
  #nearest() {
    const cell = this.stage.cellAt(this.pointer.x, this.pointer.y);
    if (!cell) return null;
    let best = null;
    this.robots.forEach((robot, k) => {
      if (!cell.groups.includes(robot.group)) return;
      for (const line of robot.lines) {
        let before = this.stage.project(line.points, 0, cell);
        for (let node = 1; node < line.count; node++) {
          const at = this.stage.project(line.points, node, cell);
          const { distance, end } = nearness(this.pointer, before, at);
          const reach = Math.max(NEAR, line.radius * at.scale);
          // of lines on each other, the one that is nearer to the eye
          const score = distance / reach + 0.2 * at.depth;
          if (at.depth < 1 && distance <= reach && !(score >= best?.score))
            best = { ...(end ? at : before), node: end ? node : node - 1, score, robot: k, line };
          before = at;
        }
      }
    });
    return best;
  }

  /** Lines of text on a node. */
  words(robot, { line, node }) {
    const { track, moment } = robot;
    const found = [line.place(node), `position ${position(Array.from(line.points.slice(3 * node, 3 * node + 3)))}`];
    if (line.kind === "tendon") {
      const { here, base } = robot.tensionAt(line.index, node);
      found.push(`tension ${quantity(here, "N")}, ${quantity(base, "N")} at the base`);
    } else if (line.kind === "rod") {
      const field = track.fields.find(({ name }) => name === this.field()?.name);
      if (field && field.name !== "p") found.push(fieldWords(track, field, node, moment));
      const body = robot.bodyAt(node);
      if (body) found.push(`attached mass ${quantity(body.mass, "kg")}`);
    }
    if (!moment.solved) found.push("last solution: this row is not solved");
    else if (moment.coarse) found.push("grid too coarse");
    if (moment.part > 0) found.push("interpolated between two rows");
    return found;
  }
}

/** A field's values at a node, by component, with its unit. */
export function fieldWords(track, field, node, moment) {
  const values = field.components.map((_, c) => track.value(field, c, node, moment));
  const named = values.map((value, c) => `${field.components[c]} ${short(value)}`.trim()).join(", ");
  const unit = field.unit && field.unit !== "1" ? ` ${field.unit}` : "";
  return `${field.name}: ${named}${unit}`;
}

/** The distance (px) from a point to a segment, and whether its second end is the nearer one. */
function nearness(point, a, b) {
  const [dx, dy] = [b.x - a.x, b.y - a.y];
  const square = dx * dx + dy * dy;
  const part = square ? Math.min(1, Math.max(0, ((point.x - a.x) * dx + (point.y - a.y) * dy) / square)) : 1;
  return { distance: Math.hypot(a.x + part * dx - point.x, a.y + part * dy - point.y), end: part >= 0.5 };
}
