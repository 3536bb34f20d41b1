// The live mode: sliders on one side, a simulation that follows them on the other end of a socket.

/** Numbers in front of those of a row: see `session.frame`. */
const HEAD = 6;
/** Least time (ms) between two controls, while the first one is not answered. */
const INTERVAL = 100;

function element(tag, properties, ...children) {
  const found = Object.assign(document.createElement(tag), properties);
  found.append(...children);
  return found;
}

export class Live {
  /**
   * `moved` is called for every row; `told` with a text to be shown ("" for none) and true if the newest control
   * has no solution; `solving` with the seconds since a slow solve began, or null when it has ended.
   */
  constructor(setup, list, { moved, told, solving }) {
    Object.assign(this, { setup, list, moved, told, solving });
    this.control = setup.sliders.map((slider) => slider.start);
    this.sequence = 0;
    this.answered = 0;
    this.sent = new Map();
    this.latencies = [];
    this.inputs = [];
    this.#groups();
    this.#connect();
    setInterval(() => this.#watch(), 100);
  }

  #connect() {
    this.socket = new WebSocket(`ws://${location.host}/live`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.#send();
    this.socket.onmessage = ({ data }) => (typeof data === "string" ? this.#text(JSON.parse(data)) : this.#row(data));
    this.socket.onclose = () => {
      this.closed = true;
      this.#ended();
      this.told("The simulation has ended: the program that ran it is no longer there.", true);
    };
  }

  /** The components of a field in one group, all of them visible at once; other controls one by one. */
  #groups() {
    const groups = new Map();
    this.setup.sliders.forEach((slider, k) => {
      if (!groups.has(slider.group)) groups.set(slider.group, []);
      groups.get(slider.group).push([slider, k]);
    });
    let single = null;
    for (const members of groups.values()) {
      const rows = element("div", { className: members.length > 6 ? "rows two" : "rows" });
      const [{ meaning, unit }] = members[0];
      if (members.length > 1) {
        this.list.append(element("div", { className: "group" }, element("h3", { textContent: `${meaning} (${unit})` }), rows));
        single = null;
      } else if (!single) {
        single = rows;
        this.list.append(element("div", { className: "group" }, rows));
      }
      for (const [slider, k] of members) (members.length > 1 ? rows : single).append(this.#slider(slider, k, members.length > 1));
    }
  }

  #slider(slider, k, grouped) {
    const range = element("input", {
      type: "range", min: slider.low, max: slider.high, step: slider.step, value: slider.start,
    });
    range.setAttribute("aria-label", `${slider.name} (${slider.unit})`);
    const number = element("input", { type: "number", step: "any", value: slider.start });
    number.setAttribute("aria-label", `${slider.name}, as a number`);
    range.addEventListener("input", (event) => {
      number.value = +Number(range.value).toPrecision(4);
      this.#set(k, Number(range.value), event.timeStamp);
    });
    number.addEventListener("change", (event) => {
      const value = Number(number.value);
      if (!Number.isFinite(value)) return;
      range.min = Math.min(range.min, value);
      range.max = Math.max(range.max, value);
      range.value = value;
      this.#set(k, value, event.timeStamp);
    });
    this.inputs[k] = { range, number };
    const name = element("span", { textContent: grouped ? slider.label : slider.name });
    const unit = element("small", { textContent: slider.unit === "1" ? "" : slider.unit });
    return element("label", { className: grouped ? "slider grouped" : "slider", title: slider.meaning }, name, range, number, unit);
  }

  #set(k, value, at) {
    this.control[k] = value;
    this.since ??= at; // of several changes that go together, the first
    this.#send();
  }

  /** The newest control goes at once; while the last one is not answered, not more often than every `INTERVAL`. */
  #send() {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    const wait = this.sequence > this.answered ? this.asked + INTERVAL - performance.now() : 0;
    if (wait > 0) {
      this.later ??= setTimeout(() => {
        this.later = undefined;
        if (this.since !== undefined) this.#send();
      }, wait);
      return;
    }
    this.sequence++;
    this.asked = performance.now();
    this.sent.set(this.sequence, this.since);
    this.since = undefined;
    this.socket.send(JSON.stringify({ sequence: this.sequence, control: this.control }));
  }

  #text(message) {
    if (message.solving !== undefined) {
      this.began ??= performance.now() - 300; // told after `PATIENCE`
      return;
    }
    if (message.sequence) this.#answer(message.sequence);
    this.#ended();
    if (message.unsolved) this.told(message.unsolved, true);
    if (message.error) this.told(message.error, false);
  }

  #answer(sequence) {
    if (sequence <= this.answered) return;
    this.answered = sequence;
    if (this.since !== undefined) this.#send();
  }

  #row(data) {
    const numbers = new Float32Array(data);
    const [sequence, time, result, error, pace, step] = numbers;
    const since = this.sent.get(sequence);
    for (const key of this.sent.keys()) if (key <= sequence) this.sent.delete(key);
    this.#answer(sequence);
    this.#ended();
    this.told("", false);
    this.pace = pace;
    this.step = step;
    this.moved({ time, result, error, row: numbers.subarray(HEAD), since });
  }

  /** Called when what answers a slider has been drawn. */
  drawn(since) {
    if (since === undefined) return;
    this.latencies.push(performance.now() - since);
    if (this.latencies.length > 500) this.latencies.shift();
  }

  get latency() {
    const last = this.latencies.slice(-15).sort((a, b) => a - b);
    return last.length ? last[last.length >> 1] : null;
  }

  #watch() {
    if (this.began !== undefined) this.solving((performance.now() - this.began) / 1000);
  }

  #ended() {
    if (this.began === undefined) return;
    this.began = undefined;
    this.solving(null);
  }

  /** End a slow solve: the last solved shape stays. */
  cancel() {
    if (this.began !== undefined) this.command("cancel");
  }

  command(command) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ command }));
  }

  reset() {
    this.command("reset");
    this.setup.sliders.forEach(({ start }, k) => {
      this.inputs[k].range.value = this.inputs[k].number.value = start;
      this.control[k] = start;
    });
    this.#set(0, this.control[0]);
  }
}
