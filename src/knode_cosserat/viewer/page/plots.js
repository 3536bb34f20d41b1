// Plots beside the robots: any state over time, and how far tips are from that of the first trajectory.
/* global uPlot */

const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function short(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-3 ? value.toExponential(1) : String(+value.toPrecision(4));
}

export class Plot {
  /** In an element; `seek` is called with the time that is clicked. */
  constructor(element, seek) {
    Object.assign(this, { element, seek, time: 0 });
    new ResizeObserver(() => this.#size()).observe(element);
  }

  /** Lines {label, times, values, colour, dash}, with the unit of all of them. */
  show(lines, unit) {
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
      padding: [10, 10, 0, 0], legend: { show: false }, scales: { x: { time: false } },
      cursor: { drag: { x: false, y: false }, points: { size: 6 } },
      axes: [
        { ...axis, size: 24, label: "time (s)", labelSize: 18, labelGap: -2 },
        { ...axis, size: 46, values: (_, ticks) => ticks.map(short), label: unit || "1", labelSize: 16, labelGap: 0 },
      ],
      series: [{}, ...lines.map(({ label, colour, dash }) => ({
        label, stroke: colour, width: 1.8, dash: DASHES[dash % DASHES.length], points: { show: false }, spanGaps: false,
      }))],
      hooks: { draw: [(u) => this.#now(u)], ready: [(u) => this.#seekable(u)] },
    };
    this.plot = new uPlot(options, this.#data(), this.element);
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

  #seekable(u) {
    const to = (event) => this.seek(u.posToVal(event.clientX - u.over.getBoundingClientRect().left, "x"));
    u.over.addEventListener("pointerdown", (event) => {
      u.over.setPointerCapture(event.pointerId);
      to(event);
    });
    u.over.addEventListener("pointermove", (event) => event.buttons && to(event));
  }
}

/** The lines of a field at a node, for every trajectory that has it. */
export function fieldLines(tracks, colours, name, component, node) {
  const lines = [];
  tracks.forEach((track, k) => {
    const field = track.fields.find((each) => each.name === name);
    if (!field || !track.wanted) return;
    const place = Math.min(node, track.nodes - 1);
    field.components.forEach((label, c) => {
      if (component !== "all" && Number(component) !== c) return;
      lines.push({
        label: `${track.name} ${label}`.trim(), times: track.times, values: track.series(field, c, place),
        // what may lie on what was drawn before lets it shine through
        colour: colours[k], dash: component === "all" ? c : k, component: label,
      });
    });
  });
  return lines;
}

/** Distances (mm) of the other tips from that of the first trajectory, at their own times. */
export function errorLines(tracks, colours) {
  const [first, ...others] = tracks;
  return others.flatMap((track, k) => {
    if (!track.wanted) return [];
    const values = track.times.map((t, row) => {
      const a = track.solved[row] ? track.tip(row) : null;
      const b = a && first.tipAt(t);
      return b ? 1000 * Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]) : null;
    });
    return [{ label: track.name, times: track.times, values, colour: colours[k + 1], dash: 0 }];
  });
}

export const dashStyle = (c) => ["solid", "dashed", "dotted", "dash-dot"][c % 4];
export { short };
