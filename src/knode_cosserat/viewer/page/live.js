// The live mode: sliders on one side, a simulation that follows them on the other end of a socket.

import { Link } from "viewer/link";

function element(tag, properties, ...children) {
  const found = Object.assign(document.createElement(tag), properties);
  found.append(...children);
  return found;
}

export class Live extends Link {
  /** Sliders in a list; the rest as for `Link`. */
  constructor(setup, list, hooks) {
    super(hooks);
    Object.assign(this, { setup, list });
    this.control = setup.sliders.map((slider) => slider.start);
    this.inputs = [];
    this.#groups();
    this.connect();
  }

  get wish() {
    return { control: this.control };
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
    this.wished(at);
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
