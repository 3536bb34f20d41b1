"""Calibration of load cells by weights: gain, offset, their errors, linearity and hysteresis."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy.stats
from jaxtyping import Float
from numpy.typing import ArrayLike

from knode_cosserat_hardware.driver import Driver, HardwareError
from knode_cosserat_hardware.lines import GRAM_FORCE

#: part of the range of forces from which a deviation is a warning
DEVIATION = 0.01
#: number of different weights below which there is a warning
FEW = 4
#: standard errors by which a curvature must differ from zero to count
SIGNIFICANT = 3.0
#: range of a gain on the wire (1/4096 gf per count)
LARGEST_GAIN = 32767


@dataclasses.dataclass(frozen=True)
class LoadCellFit:
    """Straight line through the readings of a load cell: force = gain (reading - offset).

    Attributes:
        weight: (n,) applied forces (N), in the order of their application.
        reading: (n,) readings, in any unit.
        gain: force per reading (N per unit).
        offset: reading without force.
        gain_error: standard error of the gain; NaN with two readings only.
        offset_error: standard error of the offset.
        residual: (n,) forces by the line, less the weights (N).
        r_squared: coefficient of determination.
        nonlinearity: greatest distance of a parabola through the readings from a line, as part of the range.
        hysteresis: greatest difference of unloading and loading at one weight, as part of the range; NaN
            without both.
        warnings: problems in words.
    """

    weight: Float[np.ndarray, " n"]
    reading: Float[np.ndarray, " n"]
    gain: float
    offset: float
    gain_error: float
    offset_error: float
    residual: Float[np.ndarray, " n"]
    r_squared: float
    nonlinearity: float
    hysteresis: float
    warnings: tuple[str, ...]

    @property
    def residual_rms(self) -> float:
        """Root mean square of the residuals (N)."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain numbers; None where there is none."""
        names = (
            "gain",
            "gain_error",
            "offset",
            "offset_error",
            "residual_rms",
            "r_squared",
            "nonlinearity",
            "hysteresis",
        )
        values = {name: float(getattr(self, name)) for name in names}
        found: dict[str, Any] = {
            name: value if np.isfinite(value) else None for name, value in values.items()
        }
        return found | {"warnings": list(self.warnings)}

    def __repr__(self) -> str:
        return (
            f"LoadCellFit: gain {self.gain:.6g} ± {self.gain_error:.2g} N per unit, "
            f"offset {self.offset:.6g}, residuals {1e3 * self.residual_rms:.3g} mN rms, "
            f"R² {self.r_squared:.6f}; {len(self.warnings)} warnings"
        )


def fit_load_cell(weights: ArrayLike, readings: ArrayLike) -> LoadCellFit:
    """Return the least-squares line of a load cell's readings under known weights.

    Load in steps up to the greatest weight and unload in steps: hysteresis is then measured too.

    Args:
        weights: (n,) applied forces (N), in the order of their application.
        readings: (n,) mean reading under each, in any unit: counts, volts or newtons.

    Raises:
        HardwareError: arrays of different lengths, values that are not finite, fewer than two different
            weights, or readings that do not change.
    """
    weight, reading = _checked(weights, readings)
    line = scipy.stats.linregress(weight, reading)
    slope, offset = float(line.slope), float(line.intercept)
    if abs(slope) * np.ptp(weight) < 1e-9 * max(1.0, float(np.max(np.abs(reading)))):
        raise HardwareError("the readings do not change with the weights; check the load cell's wiring")
    error = reading - offset - slope * weight
    # two readings leave nothing to judge the line by
    slope_error, offset_error = (
        (float(line.stderr), float(line.intercept_stderr)) if len(weight) > 2 else (np.nan, np.nan)
    )
    bend, bend_is_significant = _nonlinearity(weight, reading, slope)
    hysteresis = _hysteresis(weight, reading, slope)
    return LoadCellFit(
        weight,
        reading,
        1.0 / slope,
        offset,
        slope_error / slope**2,
        offset_error,
        error / slope,
        float(line.rvalue) ** 2,
        bend,
        hysteresis,
        _warnings(weight, bend if bend_is_significant else 0.0, hysteresis),
    )


def _checked(weights: ArrayLike, readings: ArrayLike) -> tuple[Any, Any]:
    try:
        weight, reading = np.asarray(weights, dtype=float), np.asarray(readings, dtype=float)
    except (TypeError, ValueError):
        raise HardwareError("weights and readings must be numbers") from None
    if weight.ndim != 1 or weight.shape != reading.shape:
        raise HardwareError(
            f"weights and readings must be two lists of one length (got shapes {weight.shape} and "
            f"{reading.shape})"
        )
    if not (np.isfinite(weight).all() and np.isfinite(reading).all()):
        raise HardwareError("weights and readings must be finite")
    if len(np.unique(weight)) < 2:
        raise HardwareError("a calibration needs two different weights or more, such as 0 and 5 N")
    return weight, reading


def _nonlinearity(weight: Any, reading: Any, slope: float) -> tuple[float, bool]:
    """Return the bend of a parabola through the readings, as part of the range; True if significant."""
    if len(np.unique(weight)) < 3 or len(weight) < 4:
        return 0.0, False
    span = float(np.ptp(weight))
    found, covariance = np.polyfit((weight - weight.mean()) / span, reading, 2, cov=True)
    curvature, deviation = abs(float(found[0])), float(np.sqrt(covariance[0, 0]))
    # a parabola's greatest distance from its best line over the range is an eighth of its second difference
    return curvature / 8.0 / (abs(slope) * span), curvature > SIGNIFICANT * deviation


def _hysteresis(weight: Any, reading: Any, slope: float) -> float:
    """Return the greatest difference of unloading and loading as part of the range; NaN without both."""
    top = int(np.argmax(weight))
    # readings at the top belong to both
    last = len(weight) - 1 - int(np.argmax(weight[::-1]))
    differences = []
    for each in np.unique(weight[weight < weight[top]]):
        loading = reading[:top][weight[:top] == each]
        unloading = reading[last + 1 :][weight[last + 1 :] == each]
        if len(loading) and len(unloading):
            differences.append(abs(unloading.mean() - loading.mean()))
    return float(max(differences) / abs(slope) / np.ptp(weight)) if differences else np.nan


def _warnings(weight: Any, bend: float, hysteresis: float) -> tuple[str, ...]:
    found = []
    count = len(np.unique(weight))
    if count < FEW:
        found.append(f"only {count} different weights; use {FEW} or more to see if the cell is linear")
    if bend > DEVIATION:
        found.append(
            f"not linear: {100 * bend:.2g} % of the range; check that the weight hangs freely and that the "
            "amplifier does not saturate"
        )
    if hysteresis > DEVIATION:
        found.append(
            f"hysteresis: loading and unloading differ by {100 * hysteresis:.2g} % of the range; check "
            "friction at the cell and its glue"
        )
    if np.isnan(hysteresis):
        found.append("hysteresis is unknown: unload in the same steps after loading")
    return tuple(found)


def wire_settings(fit: LoadCellFit, gain: int, zero: int) -> tuple[int, int]:
    """Return the settings `gainK` and `zeroK` of a board by a fit of its own readings in N.

    Args:
        fit: fit of tensions that the board measured with these settings (N).
        gain: setting during the measurement (1/4096 gf per count).
        zero: setting during the measurement (counts).
    """
    changed = round(gain * fit.gain)
    if not 0 < abs(changed) <= LARGEST_GAIN or fit.gain < 0.0:
        raise HardwareError(
            f"the calibrated gain would be {changed}/4096 gf per count; allowed is 1 to {LARGEST_GAIN}. "
            "Check weights (in newtons) and the polarity of the cell"
        )
    return changed, zero + round(fit.offset / GRAM_FORCE * 4096.0 / gain)


def write_calibration(driver: Driver, tendon: int, fit: LoadCellFit) -> dict[str, int]:
    """Write a load cell's calibration to its board, and return the changed settings by name.

    Args:
        driver: a board with settings, not armed.
        tendon: from 0 on.
        fit: fit of the tensions (N) that this driver read.

    Raises:
        HardwareError: the driver has no settings, or the board refused them.
    """
    board: Any = driver
    if not hasattr(driver, "set_setting"):
        raise HardwareError(
            f"{type(driver).__name__} has no settings for load cells; use gain and offset in your program"
        )
    names = f"gain{tendon + 1}", f"zero{tendon + 1}"
    values = wire_settings(fit, *(int(board.setting(name)) for name in names))
    for name, value in zip(names, values, strict=True):
        board.set_setting(name, value)
    return dict(zip(names, values, strict=True))
