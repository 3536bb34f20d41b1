// Plots beside the robots: any state over time, and how far tips are from that of the first trajectory.
/* global uPlot */
import { componentColour } from "viewer/colours";
import { quantity, short } from "viewer/units";

const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export class Plot {
  /** In an element; `seek` is called with the time that is clicked. */
  constructor(element, seek) {
    Object.assign(this, { element, seek, time: 0 });
    this.readout = Object.assign(document.createElement("div"), { className: "readout" });
    new ResizeObserver(() => this.#size()).observe(element);
  }

  /** Lines {label, times, values, colour, dash}, with the unit of all of them, on an axis of at least a span. */
  show(lines, unit, least = 0) {
    this.lines = lines;
    this.unit = unit;
    this.plot?.destroy();
    this.plot = null;
    this.element.replaceChildren();
    if (lines.length === 0) return;
    const axis = {
      stroke: style("--muted"), grid: { stroke: style("--line"), width: 1 }, ticks: { show: false },
      font: "11px system-ui, sans-serif", labelFont: "11px system-ui, sans-serif",
    };
    const options = {
      width: Math.max(160, this.element.clientWidth), height: this.element.clientHeight || 180,
      padding: [10, 10, 0, 0], legend: { show: false }, scales: { x: { time: false }, y: { range: (_, low, high) => span(low, high, least) } },
      cursor: { drag: { x: false, y: false }, points: { size: 6 } },
      axes: [
        { ...axis, size: 24, label: "time (s)", labelSize: 18, labelGap: -2 },
        { ...axis, size: 46, values: (_, ticks) => ticks.map(short), label: unit || "1", labelSize: 16, labelGap: 0 },
      ],
      series: [{}, ...lines.map(({ label, colour, dash }) => ({
        label, stroke: colour, width: 1.8, dash: DASHES[dash % DASHES.length], points: { show: false }, spanGaps: false,
      }))],
      hooks: { draw: [(u) => this.#now(u)], ready: [(u) => this.#seekable(u)], setCursor: [(u) => this.#values(u)] },
    };
    this.plot = new uPlot(options, this.#data(), this.element);
    this.readout.hidden = true;
    this.element.append(this.readout);
  }

  /** The same lines with other numbers. */
  renew(lines) {
    this.lines = lines;
    this.plot?.setData(this.#data());
  }

  #data() {
    const tables = this.lines.map(({ times, values }) => [times, values]);
    return tables.length === 1 ? tables[0] : uPlot.join(tables, tables.map(() => [2]));
  }

  at(time) {
    this.time = time;
    this.plot?.redraw(false, false);
  }

  #size() {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (this.plot && width > 0 && height > 0) this.plot.setSize({ width, height });
  }

  #now(u) {
    const x = u.valToPos(this.time, "x", true);
    if (x < u.bbox.left - 1 || x > u.bbox.left + u.bbox.width + 1) return;
    u.ctx.save();
    u.ctx.strokeStyle = style("--text");
    u.ctx.globalAlpha = 0.65;
    u.ctx.lineWidth = devicePixelRatio;
    u.ctx.setLineDash([]);
    u.ctx.beginPath();
    u.ctx.moveTo(x, u.bbox.top);
    u.ctx.lineTo(x, u.bbox.top + u.bbox.height);
    u.ctx.stroke();
    u.ctx.restore();
  }

  /** Values under the mouse, with the unit. */
  #values(u) {
    const { idx } = u.cursor;
    this.readout.hidden = idx === null || idx === undefined;
    if (this.readout.hidden) return;
    const values = this.lines.map(({ label }, k) => [label, u.data[k + 1][idx]]).filter(([, value]) => value !== null && value !== undefined);
    const words = values.map(([label, value]) => `${label} ${quantity(value, this.unit)}`.trim());
    this.readout.textContent = `${u.data[0][idx].toFixed(3)} s: ${words.join(", ") || "not solved"}`;
  }

  #seekable(u) {
    const to = (event) => this.seek(u.posToVal(event.clientX - u.over.getBoundingClientRect().left, "x"));
    u.over.addEventListener("pointerdown", (event) => {
      u.over.setPointerCapture(event.pointerId);
      to(event);
    });
    u.over.addEventListener("pointermove", (event) => event.buttons && to(event));
  }
}

/** The range of an axis: rounding errors do not fill it. */
function span(low, high, least) {
  if (low === null || high === null) return [0, 1];
  if (high - low < least) return [0.5 * (low + high) - 0.5 * least, 0.5 * (low + high) + 0.5 * least];
  return uPlot.rangeNum(low, high, 0.1, true);
}

/**
 * The lines of a field at a node, for every trajectory that has it. Components of one trajectory have colours of
 * their own; with several trajectories the colour is the trajectory's, and components differ by their dashes.
 */
export function fieldLines(tracks, colours, name, component, node) {
  const lines = [];
  const fieldOf = (track) => track.wanted && track.fields.find((each) => each.name === name);
  const single = tracks.filter(fieldOf).length === 1;
  tracks.forEach((track, k) => {
    const field = fieldOf(track);
    if (!field) return;
    const place = Math.min(node, track.nodes - 1);
    field.components.forEach((label, c) => {
      if (component !== "all" && Number(component) !== c) return;
      const own = single && field.components.length > 1;
      lines.push({
        label: (single ? label : `${track.name} ${label}`).trim(), times: track.times, values: track.series(field, c, place),
        colour: own ? componentColour(label, c) : colours[k],
        // what may lie on what was drawn before lets it shine through; colours repeat after six components
        dash: own ? Math.floor(c / 6) : component === "all" ? c : k, component: label,
      });
    });
  });
  return lines;
}

/** Distances (mm) of the other tips from that of the first trajectory, at their own times, and of a moving target. */
export function errorLines(tracks, colours, target = null) {
  const [first, ...others] = tracks;
  if (tracks.some(({ measured }) => measured)) return measuredLines(tracks, colours);
  const moving = target ? [{ ...target, colour: style("--target"), dash: 2 }] : [];
  return moving.concat(others.flatMap((track, k) => {
    if (!track.wanted) return [];
    const values = track.times.map((t, row) => {
      const a = track.solved[row] ? track.tip(row) : null;
      const b = a && first.tipAt(t);
      return b ? 1000 * Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]) : null;
    });
    return [{ label: track.name, times: track.times, values, colour: colours[k + 1], dash: 0 }];
  }));
}

/** Distances (mm) of the last measured bodies from their predictions. */
function measuredLines(tracks, colours) {
  return tracks.flatMap((track, k) => {
    if (!track.wanted || !track.measured?.arrays.seen.width) return [];
    const values = track.tipErrors().map((away) => (away === null ? null : 1000 * away));
    return [{ label: track.name, times: track.times, values, colour: colours[k], dash: 0 }];
  });
}

export const dashStyle = (c) => ["solid", "dashed", "dotted", "dash-dot"][c % 4];
