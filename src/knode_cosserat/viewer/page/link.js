// A socket to the simulation of a live page: the newest wish goes out, rows come in.

/** Numbers in front of those of a row: see `session.frame`. */
const HEAD = 6;
/** Least time (ms) between two wishes, while the first one is not answered. */
const INTERVAL = 100;
/** Time (ms) for which an error is shown. */
const READ = 4000;

export class Link {
  /**
   * `moved` is called for every row; `told` with a text to be shown ("" for none) and true if there is no solution;
   * `solving` with the seconds since a slow solve began, or null when it has ended.
   */
  constructor({ moved, told, solving }) {
    Object.assign(this, { moved, told, solving });
    this.sequence = 0;
    this.answered = 0;
    this.sent = new Map();
    this.latencies = [];
  }

  /** What the simulation is to do: a subclass gives {control} or {target}. */
  get wish() {
    return {};
  }

  connect() {
    this.socket = new WebSocket(`ws://${location.host}/live`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.#send();
    this.socket.onmessage = ({ data }) => (typeof data === "string" ? this.text(JSON.parse(data)) : this.#row(data));
    this.socket.onclose = () => {
      this.closed = true;
      this.#ended();
      this.told(this.reason ?? "The simulation has ended: the program that ran it is no longer there.", true);
    };
    setInterval(() => this.#watch(), 100);
  }

  /** Send the newest wish, which was made at a time (ms). */
  wished(at) {
    this.since ??= at; // of several changes that go together, the first
    this.#send();
  }

  /** The newest wish goes at once; while the last one is not answered, not more often than every `INTERVAL`. */
  #send() {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
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
    this.socket.send(JSON.stringify({ sequence: this.sequence, ...this.wish }));
  }

  text(message) {
    if (message.solving !== undefined) {
      this.began ??= performance.now() - 300; // told after `PATIENCE`
      return;
    }
    if (message.sequence) this.#answer(message.sequence);
    this.#ended();
    if (message.ended) this.reason = message.ended;
    if (message.unsolved) this.told(message.unsolved, true);
    if (message.error) {
      this.told(message.error, false);
      this.until = performance.now() + READ; // rows that come meanwhile do not take it away
    }
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
    if (!(performance.now() < this.until)) this.told("", false);
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
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ command }));
  }
}
