// Numbers as texts with units.

/** A number in at most four digits; "–" for none. */
export function short(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-3 ? value.toExponential(1) : String(+value.toPrecision(4));
}

/** A number with its unit; none is written for numbers without a unit. */
export function quantity(value, unit) {
  return quantityText(short(value), unit);
}

/** A number with its standard deviation and its unit, such as "(2.200 ± 0.009)·10⁹ Pa". */
export function uncertain(value, deviation, unit) {
  const size = Math.abs(value) || deviation;
  const power = size >= 1e4 || size < 1e-2 ? 3 * Math.floor(Math.log10(size) / 3 + 1e-9) : 0;
  if (!Number.isFinite(power) || !(deviation > 0)) return quantity(value, unit);
  const [x, s] = [value, deviation].map((each) => each / 10 ** power);
  const digits = Math.min(6, Math.max(0, -Math.floor(Math.log10(s))));
  const words = `${x.toFixed(digits)} ± ${s.toFixed(digits)}`;
  const exponent = String(power).replace("-", "⁻").replace(/\d/g, (d) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[d]);
  return quantityText(power ? `(${words})·10${exponent}` : words, unit);
}

const quantityText = (text, unit) => (unit && unit !== "1" ? `${text} ${unit}` : text);

/** A distance in mm. Positions are float32: below a micrometre nothing is known. */
export function distance(metres) {
  return metres < 1e-6 ? "< 0.001 mm" : `${short(1000 * metres)} mm`;
}

/** The distance (m) of two points; coordinates that are null in the second one are free. */
export function apart(a, b) {
  return Math.hypot(...a.map((x, k) => (b[k] === null ? 0 : x - b[k])));
}

/** A distance in mm with few digits, for one that changes all the time. */
export function rough(metres) {
  const size = 1000 * metres;
  return `${size.toFixed(size >= 100 ? 0 : size >= 10 ? 1 : 2)} mm`;
}

/** A length in the unit that suits it. */
export function length(metres) {
  return metres >= 0.9995 ? `${short(metres)} m` : metres >= 0.01 ? `${short(100 * metres)} cm` : `${short(1000 * metres)} mm`;
}

/** A position in m, to a tenth of a millimetre. */
export function position(point) {
  return `(${point.map((x) => (x === null ? "free" : String(+x.toFixed(4)))).join(", ")}) m`;
}
