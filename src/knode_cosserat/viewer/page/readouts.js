// Numbers of a closed loop in words and bars: status, error, target, controls between their limits, parameters, times.
import { quantity, rough, short, uncertain } from "viewer/units";

/** A control this near to its limit, as a part of the range, is at it. */
const AT_LIMIT = 5e-3;

function element(tag, properties, ...children) {
  const found = Object.assign(document.createElement(tag), properties);
  found.append(...children);
  return found;
}

const write = (place, text) => {
  if (place.textContent !== text) place.textContent = text;
};

export class Readouts {
  /** `typed` gets the number of a coordinate and its value, `free` is called when the height is freed or tracked. */
  constructor(setup, place, { live, upright, typed, free }) {
    Object.assign(this, { setup, live });
    this.badge = element("b", { className: "badge" });
    this.reason = element("span", { className: "quiet" });
    this.error = element("b", { className: "error" });
    this.rest = element("span", { className: "quiet" });
    this.horizontalButton = element("button", { textContent: "Drag horizontally", title: "Drag the target horizontally; the same as Shift" });
    this.freeButton = element("button", { textContent: "Free height", title: "The height of the tip is free; only x and y are tracked" });
    place.append(
      element("p", { className: "row status" }, this.badge, this.reason),
      element("p", { className: "row" }, this.error, this.rest),
      this.#target(upright, typed, free),
      ...this.#bars(),
      this.#times(),
      ...this.#parameters(),
    );
  }

  get horizontal() {
    return this.horizontalButton.getAttribute("aria-pressed") === "true";
  }

  #target(upright, typed, free) {
    this.inputs = ["x", "y", "z"].map((name, k) => {
      const input = element("input", { type: "number", step: 0.01, disabled: !this.live });
      input.setAttribute("aria-label", `target ${name} (m)`);
      input.addEventListener("change", () => input.value !== "" && Number.isFinite(Number(input.value)) && typed(k, Number(input.value)));
      return input;
    });
    const toggle = (button, call) => {
      button.setAttribute("aria-pressed", "false");
      button.onclick = () => {
        const pressed = button.getAttribute("aria-pressed") !== "true";
        button.setAttribute("aria-pressed", String(pressed));
        call(pressed);
      };
    };
    toggle(this.horizontalButton, () => {});
    toggle(this.freeButton, free);
    this.freeButton.hidden = !upright;
    const buttons = element("div", { className: "row", hidden: !this.live }, this.horizontalButton, this.freeButton);
    const cells = this.inputs.map((input, k) => element("label", {}, "xyz"[k], input));
    return element("div", { className: "group" }, element("h3", { textContent: "target (m)" }), element("div", { className: "coordinates" }, ...cells), buttons);
  }

  /** Bars of the controls, in groups of one field. */
  #bars() {
    const groups = new Map();
    this.bars = this.setup.controls.map((control) => {
      const { group, label, name, low, high, unit, meaning } = control;
      if (!groups.has(group)) groups.set(group, { rows: element("div", { className: "rows" }), meaning, unit, low, high });
      const fill = element("i", {});
      const value = element("b", {});
      const limits = `${short(low)} to ${quantity(high, unit)}`;
      groups.get(group).rows.append(
        element("div", { className: "limited", title: `${name}: limits ${limits}` }, element("span", { textContent: label || name }), element("div", { className: "range" }, fill), value),
      );
      return { ...control, fill, value };
    });
    return [...groups.values()].map(({ rows, meaning, unit, low, high }) =>
      element("div", { className: "group" }, element("h3", { textContent: `${meaning}, limits ${short(low)} to ${quantity(high, unit)}` }), rows),
    );
  }

  #parameters() {
    this.values = this.setup.parameters.map(() => element("td", {}));
    if (!this.values.length) return [];
    const rows = this.setup.parameters.map(({ name }, k) => element("tr", {}, element("th", { textContent: name }), this.values[k]));
    return [element("div", { className: "group" }, element("h3", { textContent: "adapted parameters (± standard deviation)" }), element("table", {}, ...rows))];
  }

  #times() {
    const names = { feedback: "feedback", cycle: `cycle of ${short(1000 * this.setup.dt)} ms`, missed: "missed deadlines", violation: "soft violation" };
    const titles = {
      feedback: "Time from the measurement to the command (median)", cycle: "All of the controller's work in a period (median)",
      missed: "Periods that began late since the start", violation: "Largest predicted violation of the soft limit",
    };
    this.times = {};
    const cells = Object.entries(names).map(([key, text]) => {
      this.times[key] = element("b", {});
      return element("div", { hidden: key === "violation" && !this.setup.soft, title: titles[key] }, this.times[key], element("small", { textContent: text }));
    });
    return element("div", { className: "facts" }, ...cells);
  }

  /** Write the target's coordinates, except one that is being typed. */
  aim(target, place) {
    this.inputs.forEach((input, k) => {
      input.disabled = !this.live || target[k] === null;
      if (input !== document.activeElement) input.value = place[k].toFixed(3);
    });
    if (this.live) this.freeButton.setAttribute("aria-pressed", String(target[2] === null));
  }

  paint(colour) {
    for (const { fill } of this.bars) fill.style.background = colour;
  }

  /** Write a row of the loop; `error` is the distance (m) of the tip from the target. */
  show(rows, row, { error, rests }) {
    const status = rows.get(row, "status")[0];
    write(this.badge, this.setup.statuses[status] ?? "");
    this.badge.className = `badge ${status === 0 ? "good" : "bad"}`;
    write(this.reason, rows.reasons[row] || (status === 0 ? "" : "no solution in this period"));
    write(this.error, rough(error));
    write(this.rest, rests ? "from the target: out of reach, at rest" : "from the target");
    this.rest.classList.toggle("warn", Boolean(rests));
    rows.get(row, "control").forEach((value, k) => {
      const { low, high, fill, value: place, unit } = this.bars[k];
      const part = Math.min(1, Math.max(0, (value - low) / (high - low)));
      fill.style.width = `${100 * part}%`;
      fill.parentElement.classList.toggle("least", part < AT_LIMIT);
      fill.parentElement.classList.toggle("most", part > 1 - AT_LIMIT);
      write(place, `${value.toFixed(2)}${unit === "1" ? "" : ` ${unit}`}`);
    });
    const deviations = rows.get(row, "deviations");
    rows.get(row, "parameters").forEach((value, k) => write(this.values[k], uncertain(value, deviations[k], this.setup.parameters[k].unit)));
    const [feedback, preparation] = ["feedback", "preparation"].map((name) => rows.median(row, name));
    const known = Number.isFinite(feedback);
    write(this.times.feedback, known ? `${(1000 * feedback).toFixed(1)} ms` : "–");
    write(this.times.cycle, known ? `${(1000 * (feedback + preparation)).toFixed(1)} ms` : "–");
    write(this.times.missed, String(rows.get(row, "missed")[0] || 0));
    const above = rows.get(row, "violation")[0] || 0;
    write(this.times.violation, rough(above));
  }
}
