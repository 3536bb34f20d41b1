"""Transformation to the robot's frame: the clamped end, the axes of bodies calibrated at rest, and checks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings.config import UP, RecordingConfig
from knode_cosserat.recordings.findings import Finding

if TYPE_CHECKING:
    from knode_cosserat.recordings.checks import Sensed
    from knode_cosserat.recordings.streams import Body

#: ratio of a normal distribution's standard deviation to its median absolute value
NORMAL = 1.4826
#: shortest rest for the calibration of a body's axes (s), and smallest number of frames
SHORTEST_REST, FEWEST_FRAMES = 0.2, 5
#: largest displacement of a resting body (m), beyond its noise
STILL = 2e-3
#: largest lean of a straight rod (rad); a rod with a larger lean sags or is bent at rest
LEANING = np.radians(3.0)
#: largest plausible lean of the tip's chord (rad): beyond it the arc points back at its end
BACK = np.radians(80.0)
#: a rod clamped along z leans less near its base: at most by this fraction of the tip's lean. Checked for
#: leans of the tip above the second number (rad), the largest misalignment of a mounted base
ALIKE, ASKEW = 0.8, np.radians(15.0)
#: largest lean of a body (rad) from which the rod's length is estimated: the arc is then within 0.5 % of
#: shapes that sag by their weight or by a load at the tip, and of straight ones that lean
BENT = np.radians(10.0)
#: pieces of the curve from body to body, in each of which a leaning rod's frame turns once
PIECES = 16
#: largest relative spread of the rod's lengths estimated from its bodies
UNEQUAL = 0.05
#: smallest bending (rad, root mean square) that shows how orientations are meant
SMALLEST_BEND = np.radians(3.0)
#: largest error of another reading, as a fraction of the error as read, and of the bending
BETTER, EXPLAINED = 0.5, 0.5
#: number of rows that stand for the rest, where none is known
_FIRST_ROWS = 5
#: other meanings of four numbers that were read as w, x, y, z
_READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "scalar last (x, y, z, w) under titles of w, x, y, z": lambda q: q[:, [3, 0, 1, 2]],
    "scalar first (w, x, y, z) under titles of x, y, z, w": lambda q: q[:, [1, 2, 3, 0]],
    "the inverse rotation (from the frame to the body)": lambda q: q * [1.0, -1.0, -1.0, -1.0],
}


def rest_of(bodies: Sequence[Body]) -> tuple[float, float] | None:
    """Return the initial interval in which no body moves; None if it is too short."""
    start, end = max(body.time[0] for body in bodies), min(body.time[-1] for body in bodies)
    for body in bodies:
        first = body.position[body.time <= start + SHORTEST_REST + 1e-6]
        where = np.median(first, axis=0)
        noise = 1.4826 * np.median(np.linalg.norm(first - where, axis=1))
        away = np.linalg.norm(body.position - where, axis=1) > STILL + 6.0 * min(noise, STILL)
        moves = body.time[away]
        if len(moves):
            end = min(end, float(moves[0]))
    rows = min(int(np.sum((body.time >= start) & (body.time < end))) for body in bodies)
    return (float(start), float(end)) if end - start >= SHORTEST_REST and rows >= FEWEST_FRAMES else None


def in_robot_frame(
    sensed: Sensed, config: RecordingConfig, findings: list[Finding]
) -> tuple[Sensed, tuple[float, float] | None]:
    """Return the streams in the robot's frame, with the rod's orientations, and the rest; add findings.

    The input bodies have their recorded positions and orientations.
    """
    rest = None if config.rest is None else (config.rest[0], config.rest[1])
    if not sensed.bodies:
        return sensed, rest
    upright = Rotation.from_rotvec(UP[config.up or "z"])
    turn = Rotation.from_quat(config.frame_rotation, scalar_first=True) * upright
    scale = config.position_factor
    bodies = [_turned(body, turn, scale) for body in sensed.bodies]
    base, origin = sensed.base, np.array(config.origin)
    if base is not None and config.base is not None:
        base = _turned(base, turn, scale)
        origin = base.position.mean(axis=0) - [0.0, 0.0, config.base.height]
        moved = np.linalg.norm(np.ptp(base.position, axis=0))
        if moved > 10e-3:
            what = f"the base moves by {1e3 * moved:.0f} mm; its mean position is taken for the clamped end"
            findings.append(Finding("warning", base.topic, what))
        base = dataclasses.replace(base, position=base.position - origin)
    bodies = [dataclasses.replace(body, position=body.position - origin) for body in bodies]
    rest = rest or rest_of(bodies)
    if rest is not None or (not config.static and any(body.quaternion is not None for body in bodies)):
        findings += _judged(bodies, rest)
    placed = []
    directions = _frames_at_rest(bodies, rest)
    for recorded, body, marker, at_rest in zip(
        sensed.bodies, bodies, config.markers, directions, strict=True
    ):
        if recorded.quaternion is not None and not config.static:
            _check_orientation(recorded.quaternion, turn, body, rest_mask(body.time, rest), findings)
        placed.append(_of_the_rod(body, marker.rotation, rest, at_rest, findings))
    return sensed._replace(bodies=placed, base=base), rest


def _turned(body: Body, turn: Rotation, scale: float) -> Body:
    quaternion = body.quaternion
    if quaternion is not None:
        quaternion = (turn * Rotation.from_quat(quaternion, scalar_first=True)).as_quat(scalar_first=True)
    return dataclasses.replace(body, position=turn.apply(body.position) * scale, quaternion=quaternion)


def _frames_at_rest(bodies: Sequence[Body], rest: tuple[float, float] | None) -> list[Rotation]:
    """Return the rod's frames at the bodies at rest: they point up unless the rod leans.

    A leaning rod is a smooth curve that leaves the clamped end along z, passes through the bodies and is not
    twisted. Its frames turn by the shortest rotation from body to body.
    """
    from scipy.interpolate import CubicSpline

    frames = [Rotation.identity() for _ in bodies]
    where = rest_positions(bodies, rest)
    if where is None or not np.max(leans_of(where), initial=0.0) > LEANING:
        return frames
    fractions, which = np.unique([body.fraction for body in bodies], return_index=True)
    away = fractions > 0.05
    places = np.concatenate([[0.0], fractions[away]])
    points = np.concatenate([np.zeros((1, 3)), where[which[away]]])
    chord = np.linalg.norm(points[1]) / places[1]
    curve = CubicSpline(places, points, bc_type=((1, [0.0, 0.0, chord]), (2, np.zeros(3))))
    frame, before, at = Rotation.identity(), np.array([0.0, 0.0, 1.0]), 0.0
    for k in np.argsort([body.fraction for body in bodies], kind="stable"):
        # in short pieces: the shortest rotations between them do not twist the rod
        for place in np.linspace(at, bodies[k].fraction, PIECES + 1)[1:]:
            tangent = curve(place, 1) / np.linalg.norm(curve(place, 1))
            axis = np.cross(before, tangent)
            sine = np.linalg.norm(axis)
            angle = np.arctan2(sine, before @ tangent)
            frame = Rotation.from_rotvec(axis * (angle / sine if sine > 0.0 else 0.0)) * frame
            before = tangent
        frames[k], at = frame, bodies[k].fraction
    return frames


def _of_the_rod(
    body: Body,
    rotation: Sequence[float] | None,
    rest: tuple[float, float] | None,
    at_rest: Rotation,
    findings: list[Finding],
) -> Body:
    """Return the body with the rod's local orientation in place of its own; a finding if it is unknown."""
    if body.quaternion is None:
        return body
    turned = Rotation.from_quat(body.quaternion, scalar_first=True)
    if rotation is not None:
        constant = Rotation.from_quat(rotation, scalar_first=True)
    else:
        still = rest_mask(body.time, rest)
        if still.sum() < FEWEST_FRAMES:
            what = (
                "how its axes are turned is not known, because it was not seen at rest; its orientations are "
                "left out (the configuration can state the rest or the marker's rotation)"
            )
            findings.append(Finding("problem", body.topic, what))
            return dataclasses.replace(body, quaternion=None)
        constant = at_rest.inv() * turned[np.flatnonzero(still)].mean()
    quaternion = (turned * constant.inv()).as_quat(scalar_first=True)
    return dataclasses.replace(body, quaternion=quaternion)


def rest_mask(time: Float[np.ndarray, " n"], rest: tuple[float, float] | None) -> np.ndarray:
    """Return a mask of the rows within the rest."""
    return np.zeros(len(time), dtype=bool) if rest is None else (time >= rest[0] - 1e-6) & (time < rest[1])


def rest_positions(
    bodies: Sequence[Body], rest: tuple[float, float] | None
) -> Float[np.ndarray, "M 3"] | None:
    """Return the mean positions of the bodies at rest (m), or None if one of them is not seen at rest."""
    means = [body.position[rest_mask(body.time, rest)] for body in bodies]
    if not means or any(len(positions) == 0 for positions in means):
        return None
    return np.array([positions.mean(axis=0) for positions in means])


def _judged(bodies: Sequence[Body], rest: tuple[float, float] | None) -> list[Finding]:
    """Return findings on the rod's direction at rest and on the bodies' places on it."""
    if rest is None:
        what = f"no rest of {SHORTEST_REST:g} s in the beginning: how bodies are turned is not known from it"
        return [Finding("warning", "", what)]
    where = rest_positions(bodies, rest)
    if where is None:
        return []
    findings = []
    lean = leans_of(where)
    leans = float(lean[-1])
    inner = [k for k, body in enumerate(bodies) if 0.05 < body.fraction < 0.7]
    straight = bool(inner) and lean[inner[0]] > ALIKE * leans
    angle = f"at rest the last body is {np.degrees(leans):.0f} degrees from the axis of the clamped end"
    if leans > BACK or (straight and leans > ASKEW):
        why = "and the others as well" if straight else "and so points back"
        what = f"{angle}, {why}: is `frame_rotation`, `origin` or the base in the configuration right?"
        findings.append(Finding("problem", bodies[-1].topic, what))
    elif leans > LEANING:
        what = (
            f"{angle}: the robot sags, is bent or is pulled there. Orientations of bodies are those of a "
            "smooth curve through them at rest, where the configuration does not state a marker's `rotation`"
        )
        if leans > BENT:
            chord = float(np.linalg.norm(where[-1])) / bodies[-1].fraction
            what += f". Such a shape does not tell the rod's length: it is above {chord:.3g} m"
        findings.append(Finding("note", bodies[-1].topic, what))
    lengths = rod_lengths(bodies, where)
    if len(lengths) > 1 and np.ptp(lengths) > UNEQUAL * abs(np.median(lengths)):
        shown = ", ".join(f"{1e3 * length:.0f}" for length in lengths)
        what = f"the bodies' fractions give the rod's length as {shown} mm: another order or another robot?"
        findings.append(Finding("problem", "", what))
    return findings


def rod_lengths(bodies: Sequence[Body], where: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " some"]:
    """Return the rod's length (m) estimated from each body away from the clamped end, at rest.

    The length is measured along a circular arc that leaves the clamped end along z and passes through the
    body, because a robot may sag at rest. Bodies that lean more than `BENT` are left out: their chord and
    their direction belong to rods of many lengths.
    """
    leans = leans_of(where)
    along = np.linalg.norm(where, axis=1) / np.sinc(np.minimum(leans, BENT) / np.pi)
    fractions = np.array([body.fraction for body in bodies])
    used = (fractions > 0.05) & (leans <= BENT)
    return np.asarray(along[used] / fractions[used])


def leans_of(where: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
    """Return the angles (rad) between the z axis and the lines from the clamped end to the positions."""
    return np.asarray(np.arctan2(np.linalg.norm(where[:, :2], axis=1), where[:, 2]))


# orientations against positions


def _check_orientation(
    quaternion: Float[np.ndarray, "n 4"],
    turn: Rotation,
    placed: Body,
    still: Bool[np.ndarray, " n"],
    findings: list[Finding],
) -> None:
    """Add a finding if a body's quaternions agree with its positions in another reading only.

    An arc that leaves the clamped end along z determines the tangent at each position. The body's rotation
    since the rest has to turn the tangent at rest to it. `quaternion` is recorded, in the frame of motion
    capture, which `turn` rotates to the robot's; `placed` is the body there; `still` marks the rows at rest.
    """
    distance = np.linalg.norm(placed.position, axis=1)
    seen = distance > 1e-9
    if seen.sum() <= _FIRST_ROWS:
        return
    chord = placed.position[seen] / distance[seen, None]
    tangent = 2.0 * chord[:, 2:] * chord - [0.0, 0.0, 1.0]
    start = np.flatnonzero(still[seen])
    start = start if len(start) >= _FIRST_ROWS else np.arange(_FIRST_ROWS)
    first = tangent[start].mean(axis=0)
    first /= np.linalg.norm(first) or 1.0
    bend = _rms_angle(tangent, np.tile(first, (len(tangent), 1)))
    if bend < SMALLEST_BEND:
        return

    def error(numbers: np.ndarray) -> float:
        rotation = turn * Rotation.from_quat(numbers, scalar_first=True)
        return _rms_angle(tangent, (rotation * rotation[start].mean().inv()).apply(first))

    as_read = error(quaternion[seen])
    errors = {words: error(read(quaternion[seen])) for words, read in _READINGS.items()}
    words = min(errors, key=errors.__getitem__)
    if errors[words] > min(BETTER * as_read, EXPLAINED * bend):
        return
    what = (
        f"its rotation contradicts its positions by {np.degrees(as_read):.0f} degrees; read as {words} it "
        f"agrees to {np.degrees(errors[words]):.0f} degrees: are its quaternions in this order?"
    )
    findings.append(Finding("problem", placed.topic, what))


def _rms_angle(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> float:
    """Return the root mean square of the angles (rad) between unit vectors."""
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
    return float(np.sqrt(np.mean(angle**2)))


def rotation_steps(quaternion: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "m 3"]:
    """Return the rotation vectors from row to row (rad)."""
    rotation = Rotation.from_quat(quaternion, scalar_first=True)
    return (rotation[:-1].inv() * rotation[1:]).as_rotvec()


def steps_are_smooth(position: Float[np.ndarray, "n 3"]) -> bool:
    """True if positions follow each other smoothly, as those of a sampled motion, and not in any order.

    Second differences of independent rows are larger than the first by √3, those of a motion far smaller.
    """
    known = position[np.isfinite(position).all(axis=1)]
    steps = np.diff(known, axis=0)
    turns = np.diff(steps, axis=0)
    return len(turns) > 0 and float(np.mean(turns**2)) < float(np.mean(steps**2))
