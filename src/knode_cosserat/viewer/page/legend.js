// Names of what is drawn, with a button each to show or hide it, and words for what is not a good solution.
import { robotColour, TENSION, rampStyle } from "viewer/colours";
import { apart, distance, position, short } from "viewer/units";

/** A discretisation error above this part of the length makes a row too coarse: `COARSE_SHARE` of the solver. */
const COARSE_SHARE = 0.02;

function element(tag, className, text = "") {
  return Object.assign(document.createElement(tag), { className, textContent: text });
}

export class Legend {
  /** `toggle` is called with the number of a robot whose name is clicked. */
  constructor(place, tracks, target, toggle) {
    this.place = place;
    this.entries = tracks.map((track, k) => {
      const row = element("div", "entry");
      const button = element("button", "");
      const mark = element("i", "");
      mark.style.background = robotColour(k);
      button.append(mark, element("span", "", track.name));
      button.title = `${track.name}: ${track.drawing.kind}${track.drawing.model ? " with a learned model" : ""}; click to show or hide`;
      button.setAttribute("aria-pressed", "true");
      button.onclick = () => {
        toggle(k);
        button.setAttribute("aria-pressed", String(track.wanted));
      };
      const note = element("small", "");
      row.append(button, note);
      place.append(row);
      return { track, mark, note };
    });
    if (!target) return;
    const row = element("div", "entry target");
    this.where = element("span", "");
    row.append(element("i", "cross", "✛"), this.where);
    place.append(row);
    this.aim(target);
  }

  /** The target is at a position (m) now; null stands for a free coordinate. */
  aim(target) {
    this.target = target;
    const text = `target ${position(target)}`;
    if (this.where.textContent !== text) this.where.textContent = text;
  }

  /** One more entry, which is no button: a line of a colour. */
  add(colour, name) {
    const row = element("div", "entry target");
    const mark = element("i", "");
    mark.style.background = colour;
    row.append(mark, element("span", "", name));
    this.place.append(row);
    return mark;
  }

  /** Notes beside the names: the state of the drawn row, and the distance of the tip to the target. */
  note(robots) {
    robots.forEach(({ moment, tip }, k) => {
      const words = [];
      if (this.target && robots[k].track.wanted && !robots[k].overlay) {
        words.push(`tip to target ${distance(apart(tip, this.target))}`);
      }
      if (!moment.solved) words.push("not solved");
      else if (moment.coarse) words.push("grid too coarse");
      const text = words.join(", ");
      const { note } = this.entries[k];
      if (note.textContent !== text) note.textContent = text;
      note.classList.toggle("warn", !moment.solved || moment.coarse);
    });
  }

  paint() {
    this.entries.forEach(({ mark }, k) => (mark.style.background = robotColour(k)));
  }
}

/** Words for a drawn row that is no solution, or one on too coarse a grid; "" for a good one. */
export function warning(track, moment) {
  const { name, failure, drawing } = track;
  if (!moment.solved)
    return failure ? `${name}: not solved from ${failure.time.toFixed(3)} s on (${failure.message}); its last solution is drawn.` : "";
  if (!moment.coarse) return "";
  const error = moment.error;
  const share = error / drawing.length;
  if (share <= COARSE_SHARE)
    return `${name}: drawn faded, because the grid was too coarse in an earlier row, from which this one continues.`;
  const size = Number.isFinite(share) ? `by about ${distance(error)} (${short(100 * share)} % of the length), by estimate` : "by an unknown amount";
  return `${name}: drawn faded, because the grid is too coarse: positions are off ${size}. Use more nodes, or position_tolerance.`;
}

/** Names in the views side by side: one for each robot that is shown. */
export function labelCells(place, cells, tracks) {
  const shown = tracks.map((track, k) => [track, k]).filter(([track]) => track.wanted);
  place.replaceChildren(...cells.map(({ x, y, width, height }, k) => {
    const cell = element("div", "");
    const label = element("span", "");
    const mark = element("i", "swatch");
    mark.style.background = robotColour(shown[k][1]);
    Object.assign(cell.style, { left: `${x}px`, top: `${y}px`, width: `${width}px`, height: `${height}px` });
    cell.style.borderWidth = `${y > 0 ? 1 : 0}px 0 0 ${x > 0 ? 1 : 0}px`;
    label.append(mark, shown[k][0].name);
    cell.append(label);
    return cell;
  }));
}

/** Marks above the time slider: rows that are not solved, or on too coarse a grid. */
export function markTimes(place, tracks, [start, end]) {
  place.replaceChildren();
  if (!(end > start)) return;
  for (const track of tracks) {
    if (!track.wanted) continue;
    for (const { kind, from, to } of track.ranges()) {
      const span = element("span", kind);
      span.title = `${track.name}: ${kind === "coarse" ? "grid too coarse" : "not solved"}, ${from.toFixed(2)} s to ${to.toFixed(2)} s`;
      span.style.left = `${(100 * (from - start)) / (end - start)}%`;
      span.style.width = `${(100 * Math.max(to - from, 0.004 * (end - start))) / (end - start)}%`;
      place.append(span);
    }
  }
}

/** Tensions of all tendons at the base, in the picture: one line for each robot that is shown. */
export class Tensions {
  constructor(place, robots, [low, high]) {
    this.place = place;
    this.robots = robots;
    place.hidden = !robots.some((robot) => robot.tendons);
    place.querySelector(".ramp").style.background = rampStyle(TENSION);
    place.querySelector("b").textContent = `${[low, high].map((x) => +x.toPrecision(2)).join(" to ")} N`;
    this.lines = robots.map((robot) => {
      const line = element("div", "tensions");
      const mark = element("i", "swatch");
      const cells = (robot.tendons ?? []).map((_, k) => {
        const cell = element("span", "");
        cell.title = `tendon ${k + 1}: tension at the base (N)`;
        const value = element("b", "");
        cell.append(`${k + 1}: `, value);
        return { cell, value };
      });
      line.append(mark, ...cells.map(({ cell }) => cell), "N");
      place.prepend(line);
      return { line, mark, cells };
    });
    // in the order of the legend
    place.prepend(...this.lines.map(({ line }) => line));
  }

  /** Write the tensions of the drawn rows; robots with equal tensions share one line. */
  show() {
    const texts = this.robots.map((robot) =>
      robot.tendons && robot.track.wanted ? robot.baseTensions().map((tension) => tension.toFixed(2)) : null,
    );
    const shared = new Set(texts.filter(Boolean).map(String)).size === 1;
    const first = texts.findIndex(Boolean);
    texts.forEach((values, k) => {
      const { line, mark, cells } = this.lines[k];
      line.hidden = !values || (shared && k !== first);
      mark.hidden = shared;
      mark.style.background = robotColour(k);
      if (!line.hidden) values.forEach((text, j) => (cells[j].value.textContent = text));
    });
  }
}
