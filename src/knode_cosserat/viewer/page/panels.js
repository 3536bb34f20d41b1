// The panels beside the picture: the distance of the tips, and any quantity over time.
import { QUANTITY, rampStyle } from "viewer/colours";
import { Plot, dashStyle, errorLines, fieldLines } from "viewer/plots";
import { apart, distance, length, quantity, rough } from "viewer/units";

const $ = (id) => document.getElementById(id);

/** Differences below this part of a quantity's size are rounding errors of float32. */
const ROUNDING = 1e-5;

export class Panels {
  /**
   * `colours` returns the robots' colours, `seek` goes to a time, `coloured` is called when the rods' colours change,
   * and `target` returns the distances of a moving target, or null.
   */
  constructor(tracks, robots, { colours, seek, coloured, target = () => null }) {
    Object.assign(this, { tracks, robots, colours, coloured, target });
    this.errorPlot = new Plot($("error-plot"), seek);
    this.statePlot = new Plot($("state-plot"), seek);
    const names = new Map();
    for (const track of tracks)
      for (const field of track.fields) if (!names.has(field.name)) names.set(field.name, field);
    for (const [name, { meaning, unit }] of names) {
      const words = unit && unit !== "1" ? `${meaning} (${unit})` : meaning;
      $("field").append(new Option(`${name}: ${words}`, name));
    }
    if (names.has("p")) $("field").value = "p";
    const nodes = Math.max(...tracks.map((track) => track.nodes));
    $("node").max = nodes - 1;
    $("node").value = nodes - 1;
    $("field").onchange = () => {
      this.#components();
      this.plotState();
    };
    $("component").onchange = $("node").oninput = () => this.plotState();
    $("colour-rods").onchange = () => this.colourRods();
    this.#components();
  }

  /** The quantity that is plotted, or undefined. */
  get field() {
    const name = $("field").value;
    return this.tracks.map((track) => track.fields.find((field) => field.name === name)).find(Boolean);
  }

  #components() {
    const { field } = this;
    if (!field) return;
    const many = field.components.length > 1;
    $("component").hidden = !many;
    const options = many ? [new Option("all", "all"), ...field.components.map((c, k) => new Option(c, k))] : [new Option("", "0")];
    $("component").replaceChildren(...options);
    // lines of several trajectories and several components are hard to tell apart
    if (many && this.tracks.length > 1) $("component").value = "0";
    $("node-box").hidden = field.array === "control";
    $("colour-box").hidden = field.array === "control" || this.tracks.some((track) => track.curves.length);
    if ($("colour-box").hidden) $("colour-rods").checked = false;
  }

  plotState() {
    const { field } = this;
    if (!field) return;
    const node = Number($("node").value);
    const place = this.tracks[0].arclength[Math.min(node, this.tracks[0].nodes - 1)];
    const last = node === Number($("node").max);
    $("node-name").textContent = node === 0 ? "base" : last ? "tip" : `s = ${length(place)}`;
    const component = $("component").value;
    this.stateLines = () => fieldLines(this.tracks, this.colours(), field.name, component, node);
    const lines = this.stateLines();
    const sizes = this.tracks.map((track) => track.size(field.name));
    this.statePlot.show(lines, field.unit, ROUNDING * Math.max(...sizes));
    const named = component === "all" ? field.components : [];
    $("state-legend").replaceChildren(...named.map((name) => {
      const line = lines.find((each) => each.component === name);
      const entry = document.createElement("span");
      const mark = document.createElement("i");
      mark.style.borderTopStyle = dashStyle(line?.dash ?? 0);
      if (new Set(lines.map(({ colour }) => colour)).size >= field.components.length) mark.style.borderTopColor = line.colour;
      entry.append(mark, name);
      return entry;
    }));
    this.colourRods();
  }

  /** Colour the rods by what is plotted, or each in its own colour. */
  colourRods() {
    const { field, robots } = this;
    const wanted = $("colour-rods").checked && field;
    $("quantity").hidden = !wanted;
    if (wanted) {
      const component = $("component").value;
      const chosen = component === "all" ? field.components.map((_, c) => c) : [Number(component)];
      const shown = robots.filter(({ track }) => track.wanted && track.fields.some(({ name }) => name === field.name));
      const found = shown.map((robot) => this.#along(robot, field.name, chosen));
      let [low, high] = [Math.min(...found.map((each) => each.low)), Math.max(...found.map((each) => each.high))];
      if (!(high - low > 1e-12)) high = low + 1e-12;
      shown.forEach((robot, k) => robot.colourBy({ values: found[k].values, range: [low, high] }));
      $("quantity").querySelector(".ramp").style.background = rampStyle(QUANTITY);
      const name = chosen.length > 1 ? `|${field.name}|` : `${field.name} ${field.components[chosen[0]]}`.trim();
      $("quantity").querySelector("span").textContent = name;
      $("quantity").querySelector("b").textContent = `${quantity(low, "")} to ${quantity(high, field.unit)}`;
    } else for (const robot of robots) if (robot.quantity) robot.colourBy(null);
    this.coloured();
  }

  /** A component along a rod, or the magnitude of several, and its range over all rows that are solved. */
  #along({ track }, name, chosen) {
    const field = track.fields.find((each) => each.name === name);
    const values = (node, moment) =>
      chosen.length > 1 ? Math.hypot(...chosen.map((c) => track.value(field, c, node, moment))) : track.value(field, chosen[0], node, moment);
    let [low, high] = [Infinity, -Infinity];
    for (let row = 0; row < track.rows; row++)
      for (let node = 0; track.solved[row] && node < track.nodes; node++) {
        const value = values(node, { drawn: row, part: 0 });
        [low, high] = [Math.min(low, value), Math.max(high, value)];
      }
    return { values, low, high };
  }

  /** Lines anew, after a robot was shown or hidden or the colours changed. */
  renew() {
    this.errors = errorLines(this.tracks, this.colours(), this.target());
    $("error-panel").hidden = this.tracks.length < 2 && !this.target() && !this.errors.length;
    this.errorPlot.show(this.errors, "mm");
    this.plotState();
  }

  /** Put the time into the plots, and the distances of the tips at it into words. */
  at(time) {
    this.errorPlot.at(time);
    this.statePlot.at(time);
    this.#distances(time);
  }

  #distances(time) {
    if (this.tracks.some(({ measured }) => measured)) {
      this.#measured(time);
      return;
    }
    const [first, ...others] = this.tracks;
    const a = first.tipAt(time);
    const target = a && this.target(time);
    const words = others.flatMap((track) => {
      const b = a && track.wanted && track.tipAt(time);
      const between = b && apart(a, b);
      return b ? [target ? `${track.name} ${rough(between)}` : distance(between)] : [];
    });
    if (target?.now !== undefined) words.unshift(`target ${rough(target.now)}`);
    const text = `to ${first.name}${words.length ? `: ${words.join(", ")}` : ""}`;
    if ($("error-now").textContent !== text) $("error-now").textContent = text;
  }

  /** Distances of the last measured bodies from their predictions, in words. */
  #measured(time) {
    const [a, b] = [new Float32Array(3), new Float32Array(3)];
    const shown = this.tracks.filter(({ wanted, measured }) => wanted && measured?.arrays.seen.width);
    const words = shown.flatMap((track) => {
      const moment = track.at(time);
      const last = track.measured.arrays.seen.width / 3 - 1;
      if (!moment.solved || !track.body("seen", last, moment, a)) return [];
      track.body("predicted", last, moment, b);
      return [`${shown.length > 1 ? `${track.name} ` : ""}${distance(apart([...a], [...b]))}`];
    });
    const text = words.join(", ");
    if ($("error-now").textContent !== text) $("error-now").textContent = text;
  }

  /** New numbers of a live robot. */
  live(time) {
    this.errorPlot.renew(errorLines(this.tracks, this.colours(), this.target()));
    this.errorPlot.time = time;
    this.#distances(time);
    this.statePlot.renew(this.stateLines());
    this.statePlot.time = time;
    if ($("colour-rods").checked) this.colourRods();
  }
}
