"""Plausibility check of the units of tensions and positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from knode_cosserat.recordings.findings import Finding
from knode_cosserat.recordings.frame import rest_positions
from knode_cosserat.recordings.recording import Body, Tensions

#: plausible range of a tendon robot's tensions (N)
SLACK, STRONG = 0.12, 120.0
#: plausible range of a rod's length (m)
SHORT, LONG = 0.02, 20.0
#: largest plausible ratio of measured to commanded tensions, or the inverse
FACTOR = 20.0


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
