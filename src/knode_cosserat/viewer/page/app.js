// The page: what is shown, where the clock stands, and who must know when either changes.
import * as THREE from "three";
import { Capture, save, videoFormat } from "viewer/capture";
import { onChange, robotColour } from "viewer/colours";
import { Track } from "viewer/data";
import { Hover } from "viewer/hover";
import { Legend, Tensions, labelCells, markTimes, warning } from "viewer/legend";
import { Live } from "viewer/live";
import { LoopLink, LoopRows, LoopView } from "viewer/loop";
import { Panels } from "viewer/panels";
import { RobotModel } from "viewer/robot";
import { Stage } from "viewer/stage";
import { length } from "viewer/units";
import { VIEWS } from "viewer/views";

const $ = (id) => document.getElementById(id);
/** Number of rows in the path of a live robot's tip. */
const TRAIL = 60;
/** Time (s) after which the hint goes away by itself. */
const HINT = 15;

export async function start(scene) {
  try {
    const tracks = await Promise.all(scene.tracks.map((each) => Track.of(each)));
    const rows = scene.loop && (await LoopRows.of(scene.loop, tracks[0].times));
    window.viewer = new Viewer(scene, tracks, rows);
  } catch (error) {
    say(`The page cannot draw this: ${error.message}`);
    throw error;
  }
}

function say(text) {
  if ($("message").textContent !== text) $("message").textContent = text;
  $("message").hidden = !text;
}

class Viewer {
  constructor(scene, tracks, rows) {
    Object.assign(this, { scene, tracks, time: 0, speed: 1, playing: false, frames: 0, told: (scene.notes ?? []).join(" ") });
    this.parts = { tendons: true, ribs: true, parts: true, frames: false, path: true, measured: true };
    $("title").textContent = scene.title;
    for (const track of tracks) track.wanted = true;
    const starts = tracks.map((track) => track.times[0]);
    const ends = tracks.map((track) => track.times[track.rows - 1]);
    this.span = [Math.min(...starts), Math.max(...ends)];
    this.time = this.span[0];
    this.#build();
    this.#overlays();
    if (rows) this.#loop(rows);
    this.#bar();
    this.#keys();
    this.panels = new Panels(tracks, this.robots, {
      colours: () => this.colours, seek: (time) => this.seek(this.rowTime(time)), coloured: () => (this.stage.dirty = true),
      target: (time) => (!this.loop ? null : time === undefined ? this.loop.errors : { now: this.loop.error(time) }),
    });
    this.#notes();
    if (scene.live) this.#live();
    else if (this.span[1] === this.span[0]) document.querySelector("footer").hidden = true;
    onChange(() => this.#repaint());
    this.#seen();
    if (!scene.live && !rows) this.seek(this.rowTime(this.#farthest()));
    requestAnimationFrame((now) => this.#frame(now));
  }

  /** The time at which tips, or predicted and measured bodies, are farthest from each other; else the beginning. */
  #farthest() {
    const [first, ...others] = this.tracks;
    let [time, most] = [this.span[0], 0];
    const consider = (t, distance) => {
      if (distance > most) [time, most] = [t, distance];
    };
    for (const track of this.tracks)
      if (track.measured) track.tipErrors().forEach((away, row) => consider(track.times[row], away ?? 0));
    if (most > 0) return time;
    for (const t of first.times) {
      const tip = first.tipAt(t);
      for (const track of others) {
        const other = track.tipAt(t);
        if (tip && other) consider(t, Math.hypot(...tip.map((x, k) => x - other[k])));
      }
    }
    return time;
  }

  get colours() {
    return this.tracks.map((_, k) => robotColour(k));
  }

  // the space

  #build() {
    const boxes = this.tracks.map((track) => {
      const [low, high] = track.box().map((corner) => new THREE.Vector3(...corner));
      return new THREE.Box3(low, high);
    });
    const longest = Math.max(...this.tracks.map((track) => track.drawing.length));
    const up = this.tracks[0].drawing.up;
    // a live robot has been nowhere yet: there is room for it to bend to every side
    if (this.scene.live) boxes[0].expandByVector(new THREE.Vector3(...up.map((x) => 0.45 * longest * Math.sqrt(1 - x ** 2))));
    const all = boxes.reduce((a, b) => a.clone().union(b));
    const size = Math.max(all.max.distanceTo(all.min), 0.6 * longest, 1e-6);
    this.stage = new Stage($("canvas"), [all.min.toArray(), all.max.toArray()], up);
    this.robots = this.tracks.map((track, k) => new RobotModel(track, robotColour(k), k, size));
    // the ground is under everything, and under the foot of the base
    const heights = [all.min, all.max].map((corner) => corner.dot(this.stage.up));
    const foot = this.tracks.map((track) => new THREE.Vector3(...track.firstPoint()).dot(this.stage.up));
    const under = Math.max(...this.robots.map((robot) => robot.baseHeight));
    const ground = Math.min(...heights, ...foot.map((height) => height - under));
    this.robots.forEach((robot, k) => {
      Object.assign(robot.group.userData, { wanted: true, box: boxes[k].expandByScalar(robot.margin) });
      this.stage.groups.push(robot.group);
      this.stage.scene.add(robot.group);
    });
    this.stage.furnish(size, ground);
    if (this.scene.target) this.stage.mark(this.scene.target);
    this.unknown = this.tracks.flatMap((_, k) => this.#obstacles(k));
    for (const [part, wanted] of Object.entries(this.parts)) for (const robot of this.robots) robot.show(part, wanted);
  }

  /** Draw the obstacles of a robot; gives the names of those that cannot be drawn. */
  #obstacles(k) {
    const texts = this.tracks.map((track) => JSON.stringify(track.drawing.obstacles));
    // what all of them touch is there once, whichever is shown
    const all = texts.every((text) => text === texts[k]);
    if (all && k > 0) return [];
    const place = all ? this.stage.scene : this.robots[k].group;
    return this.tracks[k].drawing.obstacles.filter((obstacle) => !this.stage.obstacle(obstacle, place)).map(({ name }) => name);
  }

  /** The range of tensions (N) that has colours. */
  #tensions() {
    const controls = this.scene.loop?.controls ?? this.scene.live?.sliders ?? [];
    const sliders = controls.filter(({ name }) => name.startsWith("tension"));
    const tensions = [...this.robots.flatMap((robot) => robot.tensions), ...sliders.flatMap(({ low, high }) => [low, high])];
    const high = Math.max(1e-3, ...tensions);
    const low = Math.min(high, ...tensions);
    // where they hardly differ the colours should not either
    return [low > 0.9 * high ? 0 : low, high];
  }

  // what lies over the picture

  #overlays() {
    this.range = this.#tensions();
    this.legend = new Legend($("legend"), this.tracks, this.scene.target, (k) => {
      const track = this.tracks[k];
      track.wanted = this.robots[k].group.userData.wanted = !track.wanted;
      this.#seen();
    });
    const measured = this.tracks.map((track) => track.measured).filter(Boolean);
    if (measured.length) {
      $("error-panel").querySelector("h2").firstChild.textContent = "Tip error, predicted and measured ";
      this.legend.add("var(--target)", "measured");
      const levels = new Set(measured.map(({ level }) => level).filter(Boolean));
      for (const level of levels) this.legend.add("color-mix(in srgb, var(--accent) 30%, transparent)", `${Math.round(100 * level)} % band`);
    }
    this.tensions = new Tensions($("tension"), this.robots, this.range);
    $("scale").textContent = this.#scale();
    this.hover = new Hover(this.stage, this.robots, { box: $("hover"), mark: $("hover-mark"), field: () => this.panels.field });
    this.capture = new Capture(this.stage, () => this.#caption());
    const gone = () => ($("hint").hidden = true);
    $("hint-close").onclick = gone;
    for (const name of ["pointerdown", "wheel"]) $("canvas").addEventListener(name, gone, { once: true, passive: true });
    setTimeout(gone, 1000 * HINT);
  }

  #scale() {
    return `grid ${length(this.stage.spacing)}`;
  }

  /** Words for an image or a video. */
  #caption() {
    const shown = this.tracks.map((track, k) => [robotColour(k), track.name]).filter((_, k) => this.tracks[k].wanted);
    return { names: shown, time: `t = ${this.time.toFixed(2)} s`, scale: this.#scale(), warning: $("message").textContent };
  }

  // the bars above and below

  #bar() {
    $("apart").hidden = this.tracks.length < 2 || Boolean(this.loop);
    $("apart").onclick = () => {
      this.stage.sideBySide = !this.stage.sideBySide;
      $("apart").setAttribute("aria-pressed", String(this.stage.sideBySide));
      this.stage.fit();
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
    for (const button of document.querySelectorAll("[data-view]")) button.onclick = () => this.stage.view(button.dataset.view);
    $("fit").onclick = () => this.stage.fit();
    $("image").onclick = async () => save(await this.picture(), `${this.#fileName()}-${this.time.toFixed(2)}s.png`);
    $("video").onclick = () => (this.capture.recording ? this.#endVideo() : this.#beginVideo());
    // the slider stops at the rows of the trajectory that has most of them
    this.clockwork = this.tracks.reduce((a, b) => (b.rows > a.rows ? b : a));
    $("time").max = this.clockwork.rows - 1;
    $("time").oninput = () => {
      this.pause();
      this.seek(this.clockwork.times[Number($("time").value)]);
    };
    $("play").onclick = () => (this.playing ? this.pause() : this.play());
    $("speed").onchange = () => (this.speed = Number($("speed").value));
  }

  #keys() {
    document.addEventListener("keydown", (event) => {
      const { tagName, type } = event.target;
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "Escape") this.live?.cancel();
      if (tagName === "SELECT" || type === "number") return;
      if (event.code === "Space" && !/^(INPUT|BUTTON)$/.test(tagName)) {
        event.preventDefault();
        $("play").click();
      } else if (event.key === "f") this.stage.fit();
      else if (event.key === "?") $("hint").hidden = !$("hint").hidden;
      else if (VIEWS[event.key - 1]) this.stage.view(VIEWS[event.key - 1]);
    });
  }

  #fileName() {
    return this.scene.title.replace(/[^\p{L}\p{N}]+/gu, "-").slice(0, 60) || "scene";
  }

  /** The picture as it is now, as a PNG. */
  picture() {
    if (this.stage.dirty) this.#draw(false);
    return this.capture.image();
  }

  #beginVideo() {
    if (!videoFormat() || !this.capture.start()) {
      this.told = "This browser cannot record video (it lacks MediaRecorder with WebM). Use Image, or a screen recorder.";
      this.stage.dirty = true;
      return;
    }
    $("video").textContent = "Stop recording";
    $("video").setAttribute("aria-pressed", "true");
    // a trajectory is recorded up to its end
    if (!this.live && this.span[1] > this.span[0]) this.play();
  }

  async #endVideo() {
    const video = await this.capture.stop();
    $("video").textContent = "Record video";
    $("video").setAttribute("aria-pressed", "false");
    if (video.size) return save(video, `${this.#fileName()}.webm`);
    this.told = "Nothing was recorded: the recording was too short.";
    this.stage.dirty = true;
  }

  play() {
    if (!this.live && this.time >= this.span[1] - 1e-9) this.seek(this.span[0]);
    this.playing = true;
    this.last = null;
    this.live?.command("resume");
    $("play").textContent = "❚❚";
    $("play").setAttribute("aria-label", "Pause");
  }

  /** Stop at a row: every shape that stands still is a solution. */
  pause() {
    if (this.playing && !this.live) this.seek(this.rowTime(this.time));
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

  /** The time (s) of the row at or before a time; in the live mode the time itself. */
  rowTime(time) {
    return this.live ? time : this.clockwork.times[this.clockwork.at(time).row];
  }

  // what changes with what is shown

  #seen() {
    this.panels.renew();
    if (!this.live) markTimes($("marks"), this.tracks, this.span);
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
    this.robots.forEach((robot, k) => robot.recolour(robotColour(k)));
    this.legend.paint();
    this.labelled = null;
    this.stage.paint();
    this.#seen();
  }

  // a closed loop, live or recorded

  #loop(rows) {
    document.body.classList.add("loop");
    $("controls").hidden = false;
    $("controls").querySelector("h2").textContent = "Closed loop";
    $("error-panel").querySelector("h2").firstChild.textContent = "Distance ";
    const moved = this.scene.live && ((target, at) => this.live.aim(target, at));
    this.loop = new LoopView(this.scene.loop, rows, { stage: this.stage, robots: this.robots, place: $("sliders"), legend: this.legend, moved });
    if (!moved) return;
    $("hint").querySelector("span").textContent = "Drag the cross: the robot follows. With Shift: horizontally. Elsewhere, left button: turn. Right button: shift. Wheel: zoom. Space: pause.";
    for (const name of ["export", "log"]) {
      $(name).hidden = false;
      $(name).onclick = () => this.live.command(name);
    }
  }

  // the live mode

  #live() {
    document.body.classList.add("live");
    $("controls").hidden = false;
    const hooks = {
      moved: (row) => this.#arrived(row),
      told: (text, unsolved) => {
        this.told = text;
        this.tracks[0].stale = unsolved;
        this.stage.dirty = true;
      },
      solving: (seconds) => {
        $("cancel").disabled = seconds === null;
        $("solving").textContent = seconds === null ? "" : `solving… ${seconds.toFixed(1)} s`;
      },
    };
    if (this.loop) this.live = this.loop.linked(new LoopLink(this.scene.target, hooks, (reason) => (this.loop.reason = reason)));
    else this.live = new Live(this.scene.live, $("sliders"), hooks);
    $("reset").onclick = () => this.live.reset();
    $("cancel").onclick = () => this.live.cancel();
    this.playing = true;
    $("play").textContent = "❚❚";
    setInterval(() => this.#plotLive(), 200);
  }

  #arrived({ since, ...row }) {
    const [track] = this.tracks;
    let rest = row.row;
    for (const each of this.tracks) {
      each.put({ ...row, row: rest.subarray(0, each.width) });
      rest = rest.subarray(each.width);
    }
    this.loop?.put(row.time, rest);
    this.span = [track.times[0], row.time];
    this.time = row.time;
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
    if (!this.playing && this.plotted === this.time) return;
    this.plotted = this.time;
    this.panels.live(this.time);
    const { pace, step, latency } = this.live;
    const words = latency === null ? "" : `, ${Math.round(latency)} ms from ${this.loop ? "mouse" : "slider"} to shape`;
    if (pace === undefined) return;
    const work = this.loop ? "" : `, ${step.toFixed(1)} ms a step`; // a loop has its own words for it
    $("pace").textContent = `${pace.toFixed(2)}× real time${work}${words}`;
  }

  // the clock

  #frame(now) {
    this.early = false;
    if (this.playing && !this.live) {
      if (this.last) {
        const next = this.time + (this.speed * Math.min(200, now - this.last)) / 1000;
        this.seek(next);
        if (next >= this.span[1]) {
          this.pause();
          if (this.capture.recording) this.#endVideo();
        }
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
    const warnings = this.robots.map((robot, k) => {
      const moment = robot.update(this.time, this.range);
      return this.tracks[k].wanted ? warning(this.tracks[k], moment) : "";
    });
    this.loop?.show(this.time);
    const cells = this.stage.draw(fine);
    say([this.told, ...warnings].filter(Boolean).join(" "));
    if (this.live) {
      const since = this.answers;
      this.answers = undefined;
      if (since !== undefined) this.stage.finished().then(() => this.live.drawn(since));
      $("clock").textContent = `${this.time.toFixed(2)} s`;
    } else $("clock").textContent = `${this.time.toFixed(2)} / ${this.span[1].toFixed(2)} s`;
    this.legend.note(this.robots);
    this.tensions.show();
    this.#label(cells);
    this.hover.update();
    if (this.moved) {
      this.moved = false;
      this.panels.at(this.time);
    }
    this.capture.frame();
    this.frames++;
    document.body.dataset.time = this.time;
  }

  #label(cells) {
    const key = JSON.stringify(cells);
    if (key === this.labelled) return;
    this.labelled = key;
    labelCells($("labels"), cells, this.tracks);
  }

  /** Where the tip of a trajectory is drawn (m). */
  tip(k = 0) {
    return this.robots[k].tip;
  }
}
