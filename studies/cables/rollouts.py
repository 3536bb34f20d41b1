"""Rollouts of a cable's model, their differences from the markers, and the derivatives of these."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.solvers.run import usable_cores
from knode_cosserat.solvers.simulate import simulate
from studies.cables.model import DT, CableModel, CableParameters, Prepared
from studies.cables.shapes import CableShape


class CableUnknown(NamedTuple):
    """A number to be identified: its field, place in it, and how far it may move in one correction.

    A `logarithmic` one is positive and moves by factors. Those of the grip change the initial state. `width`
    is that of a weak prior about the start; infinite: none.
    """

    field: str
    place: int | None
    move: float
    logarithmic: bool = False
    grip: bool = False
    width: float = np.inf


UNKNOWNS: dict[str, CableUnknown] = {
    "bending": CableUnknown("bending", None, 0.8, logarithmic=True),
    "torsion": CableUnknown("torsion", None, 0.8, logarithmic=True),
    "damping_time": CableUnknown("damping_time", None, 0.8, logarithmic=True),
    "drag": CableUnknown("drag", None, 0.8, logarithmic=True),
    "drag_ratio": CableUnknown("drag_ratio", None, 0.8, logarithmic=True, width=1.0),
    "square_drag": CableUnknown("square_drag", None, 0.8, logarithmic=True, width=1.0),
    **{f"curvature{k}": CableUnknown("curvature", k, 1.6) for k in range(2)},
    **{f"curvature_change{k}": CableUnknown("curvature_change", k, 3.2, width=10.0) for k in range(2)},
    "eccentric": CableUnknown("eccentric", None, 0.15, width=0.3),
    "twist": CableUnknown("twist", None, 0.6, grip=True),
    **{f"base_tangent{k}": CableUnknown("base_tangent", k, 0.3, grip=True, width=0.2) for k in range(2)},
    **{f"tip_tangent{k}": CableUnknown("tip_tangent", k, 0.3, grip=True, width=0.2) for k in range(2)},
    **{f"offset{k}": CableUnknown("offset", k, 3e-3, grip=True, width=3e-3) for k in range(2)},
    "stretch": CableUnknown("stretch", None, 3e-3, grip=True, width=3e-3),
}
#: frames of one compiled program with derivatives
CHUNK = 40
#: time steps of a frame: whole frames first, shorter steps where these have no solution
SUBSTEPS = (1, 4, 16, 64)
#: short steps that are solved at a time, before whole frames are tried again
SPAN = 128
#: step of differences in the initial state, as a part of `move`
STEP = 0.05


#: all of them, in the order of coordinates
NAMES = tuple(UNKNOWNS)


def cable_coordinates(p: CableParameters) -> Float[np.ndarray, " n"]:
    """Return all numbers of a cable without bounds: those that are logarithmic by their logarithms."""
    found = []
    for unknown in UNKNOWNS.values():
        value = getattr(p, unknown.field)
        value = value if unknown.place is None else value[unknown.place]
        found.append(np.log(max(value, 1e-12)) if unknown.logarithmic else value)
    return np.array(found, dtype=float)


def cable_parameters(x: Any) -> CableParameters:
    """Return the parameters with these coordinates; they may be traced by JAX."""
    traced = isinstance(x, jax.core.Tracer)
    changes: dict[str, Any] = {}
    for k, unknown in enumerate(UNKNOWNS.values()):
        value = x[k] if traced else float(x[k])
        if unknown.logarithmic:
            value = jnp.exp(value) if traced else float(np.exp(value))
        whole = changes.get(unknown.field, ())
        changes[unknown.field] = value if unknown.place is None else (*whole, value)
    return CableParameters(**changes)


class CablePrediction(NamedTuple):
    """Predicted positions of the free markers from frame 2 on, or the reason for there being none.

    `position_error` is the mean estimate of the discretisation error (m). `divided` is the number of frames
    that were solved in several steps, and `restarts` that of starts from a new shape.
    """

    markers: Float[np.ndarray, "T M 3"] | None
    position_error: float = np.nan
    divided: int = 0
    restarts: int = 0
    failure: str = ""


class Rollouts:
    """Simulates motions of one cable; the scheme along the rod is one argument.

    Derivatives are those of pieces of CHUNK frames, each of which begins where the one before ends: one
    compiled program serves motions of any length.
    """

    def __init__(self, model: CableModel, space: Any = "lobatto2"):
        self.model, self.space = model, space
        self._chunk = jax.jit(self._chunk_with_derivatives)
        self._starts: dict[Any, tuple[tuple[CableShape, CableShape], Prepared]] = {}

    def predict(self, p: CableParameters, markers: Float[np.ndarray, "T N 3"]) -> CablePrediction:
        """Return the free markers for the given motion of those that are held, from the first two frames.

        Where a rod has no solution even in the shortest steps (it has kinked between two nodes, for one), the
        prediction starts again from the smooth shape near the markers that it has predicted last.
        """
        known, begin, starts, divided = np.array(markers), 0, 0, 0
        errors: list[Any] = []
        try:
            while begin < len(known) - 2:
                prepared, _ = self.model.prepared(p, known[begin:])
                y, estimates, short = self._moved(p, prepared)
                starts, divided = starts + 1, divided + short
                following = begin + 2
                if len(y):
                    seen = self.model.free_markers(y, prepared.beside, p.stretch)
                    known[following : following + len(y), 2:-2] = seen
                    errors.append(estimates)
                else:
                    known[following, 2:-2] = known[following - 1, 2:-2] + _carried(known[following - 1 :])
                begin += max(1, len(y))
        except (ValueError, RuntimeError, ArithmeticError) as error:
            return CablePrediction(None, failure=f"frame {begin + 2}: {' '.join(str(error).split())}")
        free = known[2:, 2:-2]
        if not np.all(np.isfinite(free)):
            return CablePrediction(None, failure="positions are not finite")
        mean = float(np.mean(np.concatenate(errors))) if errors else np.nan
        return CablePrediction(free, mean, divided, starts - 1)

    def _moved(self, p: CableParameters, prepared: Prepared) -> tuple[Any, Any, int]:
        """Return y of the frames that have a solution, its estimated errors, and how many were divided.

        Frames without a solution are divided into shorter steps, between which the ends move on monotone
        cubics through the frames.
        """
        from scipy.interpolate import PchipInterpolator

        robot = self.model.robot(p, prepared.base, prepared.tip)
        ends = np.concatenate([prepared.first_controls, prepared.controls])
        between = PchipInterpolator(np.arange(-2.0, len(prepared.controls)), ends)
        at, done, level, divided = self.model.initial(robot, prepared), 0, 0, 0
        y, errors = [np.zeros((0, self.model.nodes, 19))], [np.zeros(0)]
        while done < len(prepared.controls):
            parts, frames = SUBSTEPS[level], len(prepared.controls) - done
            frames = frames if parts == 1 else min(frames, SPAN // parts)
            moved = simulate(
                robot,
                between(done - 1.0 + np.arange(1.0, frames * parts + 1.0) / parts),
                DT / parts,
                initial=at,
                time="bdf2",
                space=self.space,
                start="consistent",
                recovery_budget=0.0,
                on_failure="return",
            )
            result = np.asarray(moved.result)
            new = frames if result.min() >= 0 else (int(np.argmax(result < 0)) - 1) // parts
            if parts == 1 or new == frames:
                y.append(np.asarray(moved.y)[parts : new * parts + 1 : parts])
                errors.append(np.asarray(moved.position_error)[parts : new * parts + 1 : parts])
                done, divided = done + new, divided + new * (parts > 1)
            if new == frames:
                at, level = moved, 0
            elif level + 1 == len(SUBSTEPS):
                break
            else:
                if parts == 1 and new:
                    last = moved[new - 1 : new + 1]
                    at = dataclasses.replace(last, settings=None, initial_state=None, final_state=None)
                level += 1
        return np.concatenate(y), np.concatenate(errors), divided

    def predict_all(self, p: CableParameters, motions: Sequence[Any]) -> list[CablePrediction]:
        """Return the predictions of many motions, one thread a core."""
        with warnings.catch_warnings():
            # grids are too coarse for a few frames after jerks: the report gives the estimated errors
            warnings.filterwarnings("ignore", message="the grid is too coarse")
            return in_threads(lambda markers: self.predict(p, markers), motions)

    def columns(self, x: Float[np.ndarray, " n"], markers: Any, key: Any) -> tuple[Any, Any]:
        """Return predicted less measured markers (T, M, 3), and derivatives (n, T, M, 3) by all unknowns.

        T is a multiple of CHUNK, or less than that.
        Rows are not numbers where there is no solution. The initial state's
        derivatives are those of the first call with this `key` (see `forget`): they change little.
        """
        prepared, slopes = self._prepared(x, markers, key)
        count = max(1, (len(markers) - 2) // CHUNK) * CHUNK
        target = _padded(markers[2:, 2:-2], count)
        controls, d_controls = _padded(prepared.controls, count), _padded(slopes.controls, count, axis=1)
        moves, parts = np.eye(len(x)), []
        for k in range(0, count, CHUNK):
            rows = slice(k, k + CHUNK)
            now = prepared._replace(controls=controls[rows])
            d_now = slopes._replace(controls=d_controls[:, rows])
            (seen, y, z), (d_seen, d_y, d_z) = self._chunk(x, now, moves, d_now)
            parts.append((np.asarray(seen) - target[rows], np.asarray(d_seen)))
            if not np.all(np.isfinite(parts[-1][0])):
                break
            last = slice(k + CHUNK - 2, k + CHUNK)
            prepared = prepared._replace(y=y, z=z, first_controls=controls[last])
            slopes = slopes._replace(y=d_y, z=d_z, first_controls=d_controls[:, last])
        values, derivatives = (
            np.concatenate(part, axis=k) for k, part in enumerate(zip(*parts, strict=True))
        )
        known = min(count, len(markers) - 2)
        return values[:known], derivatives[:, :known]

    def forget(self) -> None:
        """Forget the initial states of earlier calls of `columns`."""
        self._starts = {}

    def _prepared(self, x: Any, markers: Any, key: Any) -> tuple[Prepared, Prepared]:
        """A motion ready to be simulated, and derivatives of that by all unknowns, as stacked arrays."""
        p = cable_parameters(x)
        if key in self._starts:
            shapes, slopes = self._starts[key]
            prepared, shapes = self.model.prepared(p, markers, shapes)
            self._starts[key] = shapes, slopes
            return prepared, slopes
        prepared, shapes = self.model.prepared(p, markers)
        # once more from there: differences are those of shapes found in the same way
        prepared, shapes = self.model.prepared(p, markers, shapes)
        each = []
        for k, unknown in enumerate(UNKNOWNS.values()):
            if not unknown.grip:
                each.append(jax.tree.map(np.zeros_like, prepared))
                continue
            step = STEP * unknown.move
            moved = cable_parameters(x + step * np.eye(len(x))[k])
            near = self.model.prepared(moved, markers, shapes)[0]
            each.append(jax.tree.map(lambda a, b, h=step: (a - b) / h, near, prepared))
        slopes = jax.tree.map(lambda *leaves: np.stack(leaves), *each)
        self._starts[key] = shapes, slopes
        return prepared, slopes

    def _chunk_with_derivatives(self, x: Any, prepared: Any, d_x: Any, d_prepared: Any) -> Any:
        def run(x: Any, prepared: Any) -> Any:
            p = cable_parameters(x)
            robot = self.model.robot(p, prepared.base, prepared.tip)
            initial = self.model.initial(robot, prepared)
            found = simulate(robot, prepared.controls, DT, time="bdf2", initial=initial, space=self.space)
            seen = self.model.free_markers(found.y[1:], prepared.beside, p.stretch)
            return seen, found.y[-2:], found.z[-2:]

        def along(direction: Any, d: Any) -> Any:
            return jax.jvp(run, (x, prepared), (direction, d))

        return jax.vmap(along, out_axes=(None, 0))(d_x, d_prepared)


def _carried(markers: Float[np.ndarray, "T N 3"]) -> Float[np.ndarray, "M 3"]:
    """Return displacements of the free markers to the next frame as the held ones' displacements say."""
    before, after = np.diff(markers[:2, [1, -2]], axis=0)[0]
    part = np.linspace(0.0, 1.0, markers.shape[1] - 2)[1:-1, None]
    return np.asarray((1.0 - part) * before + part * after)


def in_threads(work: Callable[[Any], Any], pieces: Sequence[Any]) -> list[Any]:
    """Return results for all pieces: the first one alone, for it may compile a program."""
    first = work(pieces[0])
    with concurrent.futures.ThreadPoolExecutor(usable_cores()) as pool:
        return [first, *pool.map(work, pieces[1:])]


def _padded(rows: Any, count: int, axis: int = 0) -> Any:
    """Exactly so many rows: the first ones, or the last one again and again."""
    return np.take(rows, np.minimum(np.arange(count), np.shape(rows)[axis] - 1), axis=axis)
