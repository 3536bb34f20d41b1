// The page: what is shown, where the clock stands, and who must know when either changes.
import * as THREE from "three";
import { Track } from "viewer/data";
import { Live } from "viewer/live";
import { Plot, dashStyle, errorLines, fieldLines, short } from "viewer/plots";
import { RobotModel, rampColours } from "viewer/robot";
import { Stage } from "viewer/stage";

//: Okabe and Ito's colours, which the colour-blind can tell apart
const LIGHT = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"];
const DARK = ["#56B4E9", "#E69F00", "#2CC295", "#CC79A7", "#F0E442", "#E0703A"];
const $ = (id) => document.getElementById(id);
const dark = matchMedia("(prefers-color-scheme: dark)");
/** How many rows the path of a live robot's tip has. */
const TRAIL = 60;

export async function start(scene) {
  try {
    const tracks = await Promise.all(scene.tracks.map((each) => Track.of(each)));
    window.viewer = new Viewer(scene, tracks);
  } catch (error) {
    say(`The page cannot draw this: ${error.message}`);
    throw error;
  }
}

function say(text) {
  $("message").textContent = text;
  $("message").hidden = !text;
}

class Viewer {
  constructor(scene, tracks) {
    Object.assign(this, { scene, tracks, time: 0, speed: 1, playing: false, frames: 0 });
    this.parts = { tendons: true, ribs: true, frames: false, path: true };
    $("title").textContent = scene.title;
    for (const track of tracks) track.wanted = true;
    const starts = tracks.map((track) => track.times[0]);
    const ends = tracks.map((track) => track.times[track.rows - 1]);
    this.span = [Math.min(...starts), Math.max(...ends)];
    this.time = this.span[0];
    this.#build();
    this.#bar();
    this.#panels();
    this.#notes();
    if (scene.live) this.#live();
    else if (this.span[1] === this.span[0]) document.querySelector("footer").hidden = true;
    dark.addEventListener("change", () => this.#repaint());
    this.#seen();
    requestAnimationFrame((now) => this.#frame(now));
  }

  colour(k) {
    const palette = dark.matches ? DARK : LIGHT;
    return palette[k % palette.length];
  }

  get colours() {
    return this.tracks.map((_, k) => this.colour(k));
  }

  // the space

  #build() {
    const [low, high] = [new THREE.Vector3(Infinity, Infinity, Infinity), new THREE.Vector3(-Infinity, -Infinity, -Infinity)];
    for (const track of this.tracks) {
      const box = track.box();
      low.min(new THREE.Vector3(...box[0]));
      high.max(new THREE.Vector3(...box[1]));
    }
    const longest = Math.max(...this.tracks.map((track) => track.drawing.length));
    const up = this.tracks[0].drawing.up;
    // a live robot has been nowhere yet: there is room for it to bend to every side
    if (this.scene.live) for (const k of [0, 1, 2]) {
      const room = 0.45 * longest * Math.sqrt(1 - up[k] ** 2);
      low.setComponent(k, low.getComponent(k) - room);
      high.setComponent(k, high.getComponent(k) + room);
    }
    const size = Math.max(high.distanceTo(low), 0.6 * longest, 1e-6);
    this.stage = new Stage($("canvas"), [low.toArray(), high.toArray()], up);
    this.robots = this.tracks.map((track, k) => new RobotModel(track, this.colour(k), k, size));
    // the ground is under everything, and under the foot of the base
    const heights = [low, high].map((corner) => corner.dot(this.stage.up));
    const foot = this.tracks.map((track) => new THREE.Vector3(...track.firstPoint()).dot(this.stage.up));
    const under = Math.max(...this.robots.map((robot) => robot.baseHeight));
    const ground = Math.min(...heights, ...foot.map((height) => height - under));
    this.stage.furnish(size, ground);
    this.unknown = [];
    this.robots.forEach((robot, k) => {
      robot.group.userData.wanted = true;
      this.stage.groups.push(robot.group);
      this.stage.scene.add(robot.group);
      const same = JSON.stringify(this.tracks[k].drawing.obstacles);
      const already = this.tracks.slice(0, k).some((track) => JSON.stringify(track.drawing.obstacles) === same);
      // what all of them touch is there once, whichever is shown
      const all = this.tracks.every((track) => JSON.stringify(track.drawing.obstacles) === same);
      if (all && already) return;
      for (const obstacle of this.tracks[k].drawing.obstacles)
        if (!this.stage.obstacle(obstacle, all ? this.stage.scene : robot.group)) this.unknown.push(obstacle.name);
    });
    $("scale").textContent = `grid ${length(this.stage.spacing)}`;
    this.#tension();
    for (const [part, wanted] of Object.entries(this.parts)) for (const robot of this.robots) robot.show(part, wanted);
  }

  #tension() {
    const sliders = this.scene.live?.sliders.filter((slider) => slider.name.startsWith("tension")) ?? [];
    const tensions = [...this.robots.flatMap((robot) => robot.tensions), ...sliders.flatMap(({ low, high }) => [low, high])];
    const high = Math.max(1e-3, ...tensions);
    const low = Math.min(high, ...tensions);
    // where they hardly differ the colours should not either
    this.range = [low > 0.9 * high ? 0 : low, high];
    $("tension").hidden = !this.robots.some((robot) => robot.tendons);
    $("tension").querySelector("i").style.background = `linear-gradient(90deg, ${rampColours().join(", ")})`;
    $("tension").querySelector("b").textContent = `${this.range.map((x) => +x.toPrecision(2)).join(" to ")} N`;
  }

  // the bars above and below

  #bar() {
    this.tracks.forEach((track, k) => {
      const chip = document.createElement("button");
      const mark = document.createElement("i");
      const name = document.createElement("span");
      mark.style.background = this.colour(k);
      name.textContent = track.name;
      chip.title = `${track.name}: ${track.drawing.kind}${track.drawing.model ? " with what was learned" : ""}; show or hide`;
      chip.setAttribute("aria-pressed", "true");
      chip.append(mark, name);
      chip.onclick = () => {
        track.wanted = !track.wanted;
        this.robots[k].group.userData.wanted = track.wanted;
        chip.setAttribute("aria-pressed", String(track.wanted));
        this.#seen();
      };
      $("legend").append(chip);
    });
    $("legend").hidden = this.tracks.length < 2;
    $("apart").hidden = this.tracks.length < 2;
    $("apart").onclick = () => {
      this.stage.sideBySide = !this.stage.sideBySide;
      $("apart").setAttribute("aria-pressed", String(this.stage.sideBySide));
      this.stage.home();
    };
    for (const button of document.querySelectorAll("[data-part]")) {
      const { part } = button.dataset;
      button.hidden = !this.robots.some((robot) => robot.parts[part].length) && !(part === "path" && this.scene.live);
      button.onclick = () => {
        this.parts[part] = !this.parts[part];
        button.setAttribute("aria-pressed", String(this.parts[part]));
        for (const robot of this.robots) robot.show(part, this.parts[part]);
        this.stage.dirty = true;
      };
    }
    $("home").onclick = () => this.stage.home();
    // the slider stops at the rows of the trajectory that has most of them
    this.clockwork = this.tracks.reduce((a, b) => (b.rows > a.rows ? b : a));
    $("time").max = this.clockwork.rows - 1;
    $("time").oninput = () => {
      this.pause();
      this.seek(this.clockwork.times[Number($("time").value)]);
    };
    $("play").onclick = () => (this.playing ? this.pause() : this.play());
    $("speed").onchange = () => (this.speed = Number($("speed").value));
    document.addEventListener("keydown", (event) => {
      if (event.code !== "Space" || /^(INPUT|SELECT|BUTTON)$/.test(event.target.tagName)) return;
      event.preventDefault();
      $("play").click();
    });
  }

  play() {
    if (!this.live && this.time >= this.span[1] - 1e-9) this.seek(this.span[0]);
    this.playing = true;
    this.last = null;
    this.live?.command("resume");
    $("play").textContent = "❚❚";
    $("play").setAttribute("aria-label", "Pause");
  }

  pause() {
    this.playing = false;
    this.live?.command("pause");
    $("play").textContent = "▶";
    $("play").setAttribute("aria-label", "Play");
  }

  /** Go to a time (s). */
  seek(time) {
    this.time = Math.min(this.span[1], Math.max(this.span[0], time));
    $("time").value = this.clockwork.at(this.time).row;
    this.stage.dirty = true;
    this.moved = true;
  }

  // the panels

  #panels() {
    this.errorPlot = new Plot($("error-plot"), (t) => this.seek(t));
    this.statePlot = new Plot($("state-plot"), (t) => this.seek(t));
    const names = new Map();
    for (const track of this.tracks)
      for (const field of track.fields) if (!names.has(field.name)) names.set(field.name, field);
    for (const [name, { meaning, unit }] of names) {
      const words = unit && unit !== "1" ? `${meaning} (${unit})` : meaning;
      $("field").append(new Option(`${name}: ${words}`, name));
    }
    if (names.has("p")) $("field").value = "p";
    const nodes = Math.max(...this.tracks.map((track) => track.nodes));
    $("node").max = nodes - 1;
    $("node").value = nodes - 1;
    $("field").onchange = () => {
      this.#components();
      this.#plotState();
    };
    $("component").onchange = $("node").oninput = () => this.#plotState();
    this.#components();
  }

  #field() {
    const name = $("field").value;
    return this.tracks.map((track) => track.fields.find((field) => field.name === name)).find(Boolean);
  }

  #components() {
    const field = this.#field();
    if (!field) return;
    const many = field.components.length > 1;
    $("component").hidden = !many;
    const options = many ? [new Option("all", "all"), ...field.components.map((c, k) => new Option(c, k))] : [new Option("", "0")];
    $("component").replaceChildren(...options);
    // lines of several trajectories and several components are hard to tell apart
    if (many && this.tracks.length > 1) $("component").value = "0";
    $("node-box").hidden = field.array === "control";
  }

  #plotState() {
    const field = this.#field();
    if (!field) return;
    const node = Number($("node").value);
    const place = this.tracks[0].arclength[Math.min(node, this.tracks[0].nodes - 1)];
    const last = node === Number($("node").max);
    $("node-name").textContent = node === 0 ? "base" : last ? "tip" : `s = ${length(place)}`;
    this.stateLines = () => fieldLines(this.tracks, this.colours, field.name, $("component").value, node);
    const lines = this.stateLines();
    this.statePlot.show(lines, field.unit);
    const legend = $("component").value === "all" ? field.components : [];
    $("state-legend").replaceChildren(...legend.map((name, c) => {
      const entry = document.createElement("span");
      const mark = document.createElement("i");
      mark.style.borderTopStyle = dashStyle(c) === "dash-dot" ? "dashed" : dashStyle(c);
      entry.append(mark, name);
      return entry;
    }));
  }

  #seen() {
    this.errors = errorLines(this.tracks, this.colours);
    $("error-panel").hidden = this.tracks.length < 2;
    this.errorPlot.show(this.errors, "mm");
    this.#plotState();
    this.stage.dirty = true;
    this.moved = true;
  }

  #notes() {
    const notes = [];
    for (const track of this.tracks) {
      if (track.rows < track.all_rows) notes.push(`${track.name}: ${track.rows} of ${track.all_rows} rows are shown.`);
      if (track.nodes < track.all_nodes) notes.push(`${track.name}: ${track.nodes} of ${track.all_nodes} nodes are shown.`);
    }
    if (this.unknown.length) notes.push(`Not drawn: ${[...new Set(this.unknown)].join(", ")}.`);
    $("notes").textContent = notes.join(" ");
  }

  #repaint() {
    this.robots.forEach((robot, k) => robot.recolour(this.colour(k)));
    document.querySelectorAll("#legend i").forEach((mark, k) => (mark.style.background = this.colour(k)));
    this.labelled = null;
    this.stage.paint();
    this.#seen();
  }

  // the live mode

  #live() {
    document.body.classList.add("live");
    $("controls").hidden = false;
    this.live = new Live(this.scene.live, { list: $("sliders") }, {
      moved: (row) => this.#arrived(row),
      told: (text) => say(text),
    });
    $("reset").onclick = () => this.live.reset();
    this.playing = true;
    $("play").textContent = "❚❚";
    setInterval(() => this.#plotLive(), 200);
  }

  #arrived({ time, result, row, since }) {
    const [track] = this.tracks;
    track.put(time, result, row);
    this.span = [track.times[0], time];
    this.time = time;
    this.answers ??= since;
    this.robots[0].rebuildPath(TRAIL);
    this.stage.dirty = true;
    // what a slider asked for is drawn at once, but once a frame
    if (since !== undefined && !this.early) {
      this.early = true;
      this.#draw(false);
      this.moving = performance.now();
    }
  }

  #plotLive() {
    if (!this.playing) return;
    this.statePlot.renew(this.stateLines());
    this.statePlot.time = this.time;
    const { pace, step, latency } = this.live;
    const words = latency === null ? "" : `, ${Math.round(latency)} ms from slider to shape`;
    if (pace !== undefined) $("pace").textContent = `${pace.toFixed(2)}× real time, ${step.toFixed(1)} ms a step${words}`;
  }

  // the clock

  #frame(now) {
    this.early = false;
    if (this.playing && !this.live) {
      if (this.last) {
        const next = this.time + (this.speed * Math.min(200, now - this.last)) / 1000;
        this.seek(next);
        if (next >= this.span[1]) this.pause();
      }
      this.last = now;
    }
    if (this.stage.dirty) {
      this.#draw(false);
      this.moving = now;
    } else if (this.stage.soft && !this.stage.fine && now - this.moving > 250) this.#draw(true);
    requestAnimationFrame((again) => this.#frame(again));
  }

  #draw(fine) {
    const unsolved = [];
    this.robots.forEach((robot, k) => {
      const moment = robot.update(this.time, this.range);
      if (!moment.solved && this.tracks[k].wanted) unsolved.push(this.tracks[k]);
    });
    const cells = this.stage.draw(fine);
    if (this.live) {
      const since = this.answers;
      this.answers = undefined;
      if (since !== undefined) this.stage.finished().then(() => this.live.drawn(since));
      $("clock").textContent = `${this.time.toFixed(2)} s`;
    } else {
      $("clock").textContent = `${this.time.toFixed(2)} / ${this.span[1].toFixed(2)} s`;
      say(unsolved.map(({ name, failure }) => `${name}: not solved from ${failure.time.toFixed(3)} s on (${failure.message}); its last solution is drawn.`).join(" "));
    }
    this.#label(cells);
    if (this.moved) {
      this.moved = false;
      this.errorPlot.at(this.time);
      this.statePlot.at(this.time);
      this.#errorNow();
    }
    this.frames++;
    document.body.dataset.time = this.time;
  }

  #errorNow() {
    const [first, ...others] = this.tracks;
    const a = first.tipAt(this.time);
    const words = others.flatMap((track) => {
      const b = a && track.wanted && track.tipAt(this.time);
      return b ? [distance(Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]))] : [];
    });
    $("error-now").textContent = `to ${first.name}${words.length ? `: ${words.join(", ")}` : ""}`;
  }

  #label(cells) {
    const key = JSON.stringify(cells);
    if (key === this.labelled) return;
    this.labelled = key;
    const shown = this.tracks.map((track, k) => [track, k]).filter(([track]) => track.wanted);
    $("labels").replaceChildren(...cells.map(({ x, y, width, height }, k) => {
      const cell = document.createElement("div");
      const label = document.createElement("span");
      const mark = document.createElement("i");
      mark.className = "swatch";
      mark.style.background = this.colour(shown[k][1]);
      Object.assign(cell.style, { left: `${x}px`, top: `${y}px`, width: `${width}px`, height: `${height}px` });
      cell.style.borderWidth = `${y > 0 ? 1 : 0}px 0 0 ${x > 0 ? 1 : 0}px`;
      label.append(mark, shown[k][0].name);
      cell.append(label);
      return cell;
    }));
  }

  /** Where the tip of a trajectory is drawn (m). */
  tip(k = 0) {
    return this.robots[k].tip;
  }
}

/** Positions are float32: what is below a micrometre is not known. */
function distance(metres) {
  return metres < 1e-6 ? "< 0.001 mm" : `${short(1000 * metres)} mm`;
}

function length(metres) {
  return metres >= 0.9995 ? `${short(metres)} m` : metres >= 0.01 ? `${short(100 * metres)} cm` : `${short(1000 * metres)} mm`;
}
