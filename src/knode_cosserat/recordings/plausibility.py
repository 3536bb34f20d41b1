"""Plausibility check of times, of the units of tensions and positions, and of single tensions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.recordings.findings import Finding
from knode_cosserat.recordings.frame import rest_positions
from knode_cosserat.recordings.quality import period

if TYPE_CHECKING:
    from knode_cosserat.recordings.recording import Body, Tensions

#: plausible range of a tendon robot's tensions (N)
SLACK, STRONG = 0.12, 120.0
#: plausible range of a rod's length (m)
SHORT, LONG = 0.02, 20.0
#: largest plausible ratio of measured to commanded tensions, or the inverse
FACTOR = 20.0
#: smallest implausible time between poses (s): motion capture at 1 to 1,000 Hz whose times are in ms
SLOW = 1.0
#: largest share of rows with implausible tensions; more of them are no accidents
RARE = 0.05


def implausible_units(
    bodies: Sequence[Body],
    tension: Tensions | None,
    command: Tensions | None,
    rest: tuple[float, float] | None,
) -> list[Finding]:
    """Return findings on implausible units, with the likely error."""
    findings = []
    sizes = []
    for stream in (tension, command):
        if stream is None:
            continue
        size = float(np.median(np.abs(stream.tension)))
        sizes.append(size)
        if 0.0 < size < SLACK:
            hint = "are newtons read as grams-force?"
        elif size > STRONG:
            hint = "are grams-force read as newtons?"
        else:
            if stream is tension and np.median(stream.tension.min(axis=1)) < -SLACK:
                findings.append(
                    Finding("warning", stream.topic, "tensions are below zero: is the sign right?")
                )
            continue
        findings.append(
            Finding("problem", stream.topic, f"tensions of {size:.3g} N are not plausible: {hint}")
        )
    if len(sizes) == 2 and min(sizes) > 0.0 and max(sizes) > FACTOR * min(sizes):
        what = (
            f"measured tensions are {sizes[0]:.3g} N and commanded ones {sizes[1]:.3g} N: not the same unit?"
        )
        findings.append(Finding("problem", "", what))
    where = rest_positions(bodies, rest)
    if where is None:
        where = np.array([np.median(body.position, axis=0) for body in bodies])
    far = float(np.linalg.norm(where, axis=1).max())
    if not SHORT < far < LONG:
        what = (
            f"the bodies are up to {far:.3g} m from the clamped end: are positions in the unit that is said?"
        )
        findings.append(Finding("problem", "", what))
    return findings


def implausible_times(bodies: Sequence[Body]) -> list[Finding]:
    """Return a finding on poses that are too far apart for a motion, with the likely error."""
    time = min((body.time for body in bodies), key=period)
    step = period(time)
    if not SLOW <= step < np.inf:
        return []
    hours = (time[-1] - time[0]) / 3600.0
    what = (
        f"poses are {step:.3g} s apart, and the recording takes {hours:.2g} h: are the times in ms? "
        "(Rows of shapes at rest need static: true.)"
    )
    return [Finding("problem", "", what)]


def implausible_tensions(newtons: Float[np.ndarray, "n tendons"]) -> Bool[np.ndarray, " n"]:
    """Return a mask of rows with a tension that no tendon has, among tensions that are plausible.

    It is below zero by more than the usual tension, because a tendon cannot push, or above `STRONG` and more
    than `FACTOR` times the usual one. The usual tension is the median of those that are not zero.
    """
    none = np.zeros(len(newtons), dtype=bool)
    size = np.abs(newtons)
    if not np.any(size > 0.0):
        return none
    usual = float(np.median(size[size > 0.0]))
    if not SLACK <= usual <= STRONG or np.median(newtons[size > 0.0]) < 0.0:
        return none
    wrong = (newtons < -usual) | (newtons > max(STRONG, FACTOR * usual))
    rows = np.any(wrong, axis=1)
    return rows if np.mean(rows) <= max(RARE, 1.0 / len(rows)) else none
