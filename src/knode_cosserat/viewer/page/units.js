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
  return unit && unit !== "1" ? `${short(value)} ${unit}` : short(value);
}

/** A distance in mm. Positions are float32: below a micrometre nothing is known. */
export function distance(metres) {
  return metres < 1e-6 ? "< 0.001 mm" : `${short(1000 * metres)} mm`;
}

/** A length in the unit that suits it. */
export function length(metres) {
  return metres >= 0.9995 ? `${short(metres)} m` : metres >= 0.01 ? `${short(100 * metres)} cm` : `${short(1000 * metres)} mm`;
}

/** A position in m, to a tenth of a millimetre. */
export function position(point) {
  return `(${point.map((x) => String(+x.toFixed(4))).join(", ")}) m`;
}
