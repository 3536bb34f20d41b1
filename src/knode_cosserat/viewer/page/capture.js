// The picture as a file: an image (PNG), or a video (WebM), with the names, the time and the scale in it.

const FORMATS = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm"];
/** Bits per second of a video. */
const RATE = 8e6;
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** The video format that this browser can record, or null. */
export function videoFormat() {
  if (typeof MediaRecorder === "undefined" || !HTMLCanvasElement.prototype.captureStream) return null;
  return FORMATS.find((format) => MediaRecorder.isTypeSupported(format)) ?? null;
}

/** A text in lines of a width (px). */
function lines(context, text, width) {
  const found = [];
  for (const word of text.split(" ").filter(Boolean)) {
    const longer = `${found.at(-1)} ${word}`;
    if (found.length && context.measureText(longer).width <= width) found[found.length - 1] = longer;
    else found.push(word);
  }
  return found;
}

/** Offer a blob as a download. */
export function save(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

export class Capture {
  /** `caption` returns {names: [[colour, text]], time, scale, warning} of what is drawn. */
  constructor(stage, caption) {
    Object.assign(this, { stage, caption });
    this.canvas = document.createElement("canvas");
    this.context = this.canvas.getContext("2d");
  }

  /** Copy the picture, which was drawn just now, and write its caption into it. */
  #compose() {
    const { canvas: source } = this.stage;
    const { width, height } = this.canvas;
    const unit = height / source.parentElement.clientHeight;
    const { context } = this;
    context.drawImage(source, 0, 0, width, height);
    context.font = `${13 * unit}px system-ui, sans-serif`;
    const text = (words, x, y, colour, align = "left") => {
      Object.assign(context, { fillStyle: colour, textAlign: align });
      context.fillText(words, x, y);
    };
    const { names, time, scale, warning } = this.caption();
    names.forEach(([colour, name], k) => {
      context.fillStyle = colour;
      context.fillRect(14 * unit, (20 + 20 * k) * unit, 18 * unit, 5 * unit);
      text(name, 40 * unit, (27 + 20 * k) * unit, style("--text"));
    });
    lines(context, warning, width - 28 * unit).forEach((line, k) =>
      text(line, 14 * unit, (27 + 20 * (names.length + k)) * unit, style("--warn")),
    );
    text(time, 14 * unit, height - 16 * unit, style("--text"));
    text(scale, width - 14 * unit, height - 16 * unit, style("--muted"), "right");
  }

  /** The picture as a PNG, with twice the pixels of the screen. */
  image() {
    const { clientWidth, clientHeight } = this.stage.canvas.parentElement;
    this.canvas.width = 2 * clientWidth;
    this.canvas.height = 2 * clientHeight;
    this.stage.sharply(2, () => this.#compose());
    return new Promise((done) => this.canvas.toBlob(done, "image/png"));
  }

  get recording() {
    return Boolean(this.recorder);
  }

  /** Begin a video; false if this browser cannot record one. */
  start() {
    const format = videoFormat();
    if (!format) return false;
    const { clientWidth, clientHeight } = this.stage.canvas.parentElement;
    const ratio = Math.min(2, window.devicePixelRatio);
    // encoders want even numbers
    this.canvas.width = 2 * Math.round((ratio * clientWidth) / 2);
    this.canvas.height = 2 * Math.round((ratio * clientHeight) / 2);
    this.parts = [];
    this.recorder = new MediaRecorder(this.canvas.captureStream(30), { mimeType: format, videoBitsPerSecond: RATE });
    this.recorder.ondataavailable = ({ data }) => data.size && this.parts.push(data);
    this.stage.dirty = true;
    this.recorder.start(500);
    return true;
  }

  /** Called after every frame that is drawn. */
  frame() {
    if (!this.recorder) return;
    this.#compose();
    this.stage.dirty = true; // also a picture that stands still lasts
  }

  /** End a video; the promise gives it. */
  stop() {
    const { recorder, parts } = this;
    this.recorder = null;
    return new Promise((done) => {
      recorder.onstop = () => done(new Blob(parts, { type: "video/webm" }));
      recorder.stop();
      for (const track of recorder.stream.getTracks()) track.stop();
    });
  }
}
