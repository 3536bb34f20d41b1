// The live mode: sliders on one side, a simulation that follows them on the other end of a socket.

/** What is in front of the numbers of a row: see `live.frame`. */
const HEAD = 5;

export class Live {
  /** `moved` is called for every row, `told` with texts to be shown ("" for none). */
  constructor(setup, elements, { moved, told }) {
    Object.assign(this, { setup, elements, moved, told });
    this.control = setup.sliders.map((slider) => slider.start);
    this.sequence = 0;
    this.answered = 0;
    this.sent = new Map();
    this.latencies = [];
    this.#sliders();
    this.#connect();
    // a step that takes long is being looked for: the page says so instead of standing still silently
    setInterval(() => this.#watch(), 200);
  }

  #connect() {
    this.socket = new WebSocket(`ws://${location.host}/live`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.#send();
    this.socket.onmessage = ({ data }) => (typeof data === "string" ? this.#text(JSON.parse(data)) : this.#row(data));
    this.socket.onclose = () => {
      this.closed = true;
      this.told("The simulation has ended: the program that ran it is no longer there.");
    };
  }

  #sliders() {
    const { list } = this.elements;
    this.inputs = this.setup.sliders.map((slider, k) => {
      const row = document.createElement("label");
      row.className = "slider";
      row.title = slider.meaning;
      const name = document.createElement("span");
      name.textContent = slider.name;
      const range = Object.assign(document.createElement("input"), {
        type: "range", min: slider.low, max: slider.high, step: slider.step, value: slider.start,
      });
      range.setAttribute("aria-label", `${slider.name} (${slider.unit})`);
      const number = Object.assign(document.createElement("input"), { type: "number", step: "any", value: slider.start });
      number.setAttribute("aria-label", `${slider.name}, as a number`);
      const unit = document.createElement("small");
      unit.textContent = slider.unit;
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
      row.append(name, range, number, unit);
      list.append(row);
      return { range, number };
    });
  }

  #set(k, value, at) {
    this.control[k] = value;
    this.since ??= at; // of several changes that go together, the first
    this.#send();
  }

  /** One message at a time: the newest control goes when the last one is answered. */
  #send() {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    if (this.sequence > this.answered && performance.now() - this.asked < 1000) return;
    this.sequence++;
    this.asked = performance.now();
    this.sent.set(this.sequence, this.since);
    this.since = undefined;
    this.socket.send(JSON.stringify({ sequence: this.sequence, control: this.control }));
  }

  #text(message) {
    if (message.sequence) this.#answer(message.sequence);
    if (message.unsolved) this.told(message.unsolved, true);
    if (message.error) this.told(message.error);
  }

  #answer(sequence) {
    this.heard = performance.now();
    if (sequence <= this.answered) return;
    this.answered = sequence;
    if (this.since !== undefined) this.#send();
  }

  #row(data) {
    const numbers = new Float32Array(data);
    const [sequence, time, result, pace, step] = numbers;
    const since = this.sent.get(sequence);
    for (const key of this.sent.keys()) if (key <= sequence) this.sent.delete(key);
    this.#answer(sequence);
    this.told("");
    this.pace = pace;
    this.step = step;
    this.moved({ time, result, row: numbers.subarray(HEAD), since });
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
    if (this.closed || !this.asked) return;
    if (this.sequence > this.answered && performance.now() - this.asked > 400) this.told("Looking for a solution …");
  }

  command(command) {
    this.socket.send(JSON.stringify({ command }));
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
