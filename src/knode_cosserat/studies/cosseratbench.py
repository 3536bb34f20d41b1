"""This package as a solver of `cosseratbench`, an independent suite of rod scenarios.

A scenario says physics only; here it becomes a `SlenderRod` for each of its rods, and the rod's states become the
frames that are asked for. What is chosen of the numerics:

- Arclength: RK4, one segment for each element.
- A quasi-static scenario in which nothing is driven has one equilibrium, and that is what is solved for: the
  first frame is the shape given, every other the equilibrium.
- A quasi-static scenario with a driven end is a motion, under a drag that would damp its slowest vibration
  critically.
- Any other scenario is a motion without damping.

Motions are stepped by BDF-α close to the trapezoidal rule, in steps so short that the period of the slowest
vibration is off by a hundred-thousandth. The suite runs the beginning of every scenario before it measures, so its
wall times are without compilation.
"""

from __future__ import annotations

import math
from importlib import metadata
from typing import Any, ClassVar, NamedTuple

import numpy as np
from cosseratbench.scenario import End, EndCondition, Motion, Rod, Scenario, parallel_transport
from cosseratbench.solver import Capability, Diverged
from cosseratbench.trajectory import Trajectory
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

import knode_cosserat as kc

#: steps of one call, so that every run of a rod shares one program
CHUNK = 128
#: error of the period of the slowest vibration that the time step may make
PERIOD_ERROR = 1e-5
#: almost the trapezoidal rule: what it damps of a slow vibration is far below its error in time
SCHEME = kc.BDFAlpha(-0.45)
#: points for each element at which the tangent and the curvature of the given shape are taken
FINER = 10


class KnodeCosserat:
    """The solver that the suite finds; `time_step_scale` multiplies the time step it would choose."""

    name = "knode-cosserat"
    capabilities: ClassVar[frozenset[Capability]] = frozenset({Capability.STRETCH, Capability.SHEAR})
    backend_version = metadata.version("knode-cosserat")

    def __init__(self, time_step_scale: float = 1.0):
        self.time_step_scale = time_step_scale

    def settings(self, scenario: Scenario, *, n_elements: int, n_frames: int) -> dict[str, Any]:
        """The numerics chosen for a run, to be shown beside its result."""
        if _at_rest(scenario):
            return {"space": "rk4", "time": "equilibrium"}
        interval = scenario.duration / (n_frames - 1)
        return {
            "space": "rk4",
            "time": f"bdf-alpha({SCHEME.alpha})",
            "time_step": interval / self._steps(scenario, interval),
            "drag_rate": _drag_rate(scenario),
        }

    def run(self, scenario: Scenario, *, n_elements: int, n_frames: int) -> Trajectory:
        """Positions (n_frames, n_elements + 1, 3) and directors of every rod; see the module.

        Raises:
            Diverged: a step has no solution.
            NotImplementedError: of the scenario something is outside the model.
        """
        times = np.linspace(0.0, scenario.duration, n_frames)
        steps = self._steps(scenario, times[1])
        shapes = [_frames(rod, scenario, times, steps, n_elements) for rod in scenario.rods]
        return Trajectory(times, *(tuple(each) for each in zip(*shapes, strict=True)))

    def _steps(self, scenario: Scenario, interval: float) -> int:
        """Steps from frame to frame; the trapezoidal rule's period is off by (ω dt)² / 12."""
        dt = self.time_step_scale * math.sqrt(12.0 * PERIOD_ERROR) / scenario.slowest_frequency()
        return math.ceil(interval / dt)


class Shape(NamedTuple):
    """The shape that a rod starts in, at the nodes: p, h, and the strains v and u that belong to it."""

    p: np.ndarray
    h: np.ndarray
    v: np.ndarray
    u: np.ndarray

    @classmethod
    def of(cls, rod: Rod, n_elements: int) -> Shape:
        """From the scenario's polyline; the rod starts without shear and, as the suite has it, without twist."""
        points = np.asarray(rod.centerline, dtype=float)
        along = rod.rest_arc_length
        if along is None:
            along = (0.0, *np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        curve = make_interp_spline(along, points, k=min(3, len(points) - 1))
        s = np.linspace(0.0, along[-1], FINER * n_elements + 1)
        tangent = curve(s, 1)
        stretch = np.linalg.norm(tangent, axis=1, keepdims=True)
        tangent /= stretch
        chain = np.cumsum(np.vstack([np.zeros(3), tangent]), axis=0)
        first = parallel_transport(chain, np.asarray(rod.normal, dtype=float))
        frames = Rotation.from_matrix(np.stack([first, np.cross(tangent, first), tangent], axis=2))
        h = frames.as_quat(scalar_first=True)
        turned_over = np.sum(h[1:] * h[:-1], axis=1) < 0.0
        h[1:] *= np.cumprod(np.where(turned_over, -1.0, 1.0))[:, None]
        # d_i' = R (u × e_i)
        d1_s, d2_s, d3_s = (make_interp_spline(s, frames.as_matrix()[:, :, i], k=3)(s, 1) for i in range(3))
        d1, d2, d3 = (frames.as_matrix()[:, :, i] for i in range(3))
        u = np.stack([np.sum(a * b, axis=1) for a, b in ((d2_s, d3), (d3_s, d1), (d1_s, d2))], axis=1)
        v = stretch * [0.0, 0.0, 1.0]
        return cls(*(each[::FINER] for each in (curve(s), h, v, u)))


def _frames(rod: Rod, scenario: Scenario, times: np.ndarray, steps: int, n_elements: int) -> Any:
    """Positions and directors of one rod at these times."""
    shape = Shape.of(rod, n_elements)
    system = _system(rod, scenario, shape)
    start = _start(system, shape)
    try:
        if _at_rest(scenario):
            still = kc.equilibrium(system, start.control[0], space="rk4", initial=start)
            states = np.repeat(np.asarray(still.y), len(times), axis=0)
        else:
            states = _motion(system, start, rod, times, steps)
    except kc.SimulationError as error:
        raise Diverged(str(error), error.time) from error
    position, directors = np.array(system.positions(states)), _directors(system, states)
    position[0], directors[0] = rod.nodes(n_elements), rod.directors(n_elements)
    return position, directors


def _at_rest(scenario: Scenario) -> bool:
    """Whether the result is one equilibrium."""
    return scenario.quasi_static and not any(rod.motion(end) for rod in scenario.rods for end in End)


def _drag_rate(scenario: Scenario) -> float:
    """Drag over mass (1/s): that which damps the slowest vibration critically, or none."""
    return 2.0 * scenario.slowest_frequency() if scenario.quasi_static else 0.0


# from a scenario's rod to ours


def _system(rod: Rod, scenario: Scenario, shape: Shape) -> kc.SlenderRod:
    """The rod, unloaded straight along its first tangent."""
    if rod.start is EndCondition.FREE and any(load.at is End.START for load in rod.loads):
        raise NotImplementedError("a load at a free start")
    force = np.sum([load.force for load in rod.loads if load.at is End.END] or np.zeros((1, 3)), axis=0)
    drag = _drag_rate(scenario) * rod.material.density * rod.area
    return kc.SlenderRod(
        length=rod.length,
        radius=rod.radius,
        density=rod.material.density,
        youngs_modulus=rod.material.youngs_modulus,
        shear_modulus=rod.material.shear_modulus,
        linear_drag=drag or None,
        gravity=scenario.gravity,
        nodes=len(shape.p),
        base_end=_end(rod, End.START, shape.p[0], shape.h[0]),
        tip_end=_end(rod, End.END, shape.p[-1], shape.h[-1]),
        loads=(kc.loads.PointWrench(force=force),) if force.any() else (),
    )


def _end(rod: Rod, which: End, p: np.ndarray, h: np.ndarray) -> Any:
    """What holds the rod there."""
    condition, motion = rod.condition(which), rod.motion(which)
    if condition is EndCondition.FREE:
        return kc.ends.Free()
    if condition is EndCondition.PINNED:
        return kc.ends.Pinned(position=p)
    if motion is None:
        return kc.ends.Clamped(position=p, orientation=h)
    if motion.slides_along is None:
        return kc.ends.Driven(position=p, orientation=h, axes=AXES)
    if which is End.START:
        raise NotImplementedError("a start that slides")
    return kc.ends.Driven(position=p, orientation=h, axes=AXES, slides=_axis(motion))


AXES = ("x", "y", "z", "rx", "ry", "rz")


def _axis(motion: Motion) -> str:
    """The global axis that an end slides along."""
    along = np.abs(motion.axis)
    if along.max() < 1.0 - 1e-12:
        raise NotImplementedError(f"an end that slides along {motion.slides_along}, no axis of the world")
    return AXES[int(np.argmax(along))]


def _start(system: kc.SlenderRod, shape: Shape) -> kc.Trajectory:
    """The rod at rest in its given shape, with the loads that this takes of its material."""
    frames = Rotation.from_quat(shape.h, scalar_first=True)
    n = frames.apply((shape.v - [0.0, 0.0, 1.0]) @ np.asarray(system.Kse).T)
    m = frames.apply(shape.u @ np.asarray(system.Kbt).T)
    still = np.zeros((len(shape.p), 6))
    y = np.concatenate([shape.p, shape.h, n, m, still], axis=1)
    z = np.concatenate([shape.v, shape.u], axis=1)
    row = np.zeros(1)
    return kc.Trajectory(
        system, None, row, y[None], z[None], np.zeros((1, system.control_size)), row.astype(int), row, row.astype(int)
    )


def _motion(
    system: kc.SlenderRod, start: kc.Trajectory, rod: Rod, times: np.ndarray, steps: int
) -> np.ndarray:
    """States at these times, `steps` steps apart."""
    total = steps * (len(times) - 1)
    dt = (times[-1] - times[0]) / total
    controls = _controls(rod, dt * (1.0 + np.arange(total)))
    states, going = [np.asarray(start.y)], start
    for first in range(0, total, CHUNK):
        going = kc.simulate(
            system, controls[first : first + CHUNK], dt, time=SCHEME, space="rk4", start="consistent", initial=going
        )
        states.append(np.asarray(going.y)[1:])
    return np.concatenate(states)[::steps]


def _controls(rod: Rod, times: np.ndarray) -> np.ndarray:
    """Displacement and rotation vector of each driven end at these times."""
    found = [np.zeros((len(times), 0))]
    for end in End:
        motion = rod.motion(end)
        if motion is None:
            continue
        for path in (motion.displacement, motion.rotation):
            path = np.asarray(path, dtype=float)
            found.append(np.stack([np.interp(times, motion.times, each) for each in path.T], axis=1))
    return np.concatenate(found, axis=1)


def _directors(system: kc.SlenderRod, states: np.ndarray) -> np.ndarray:
    """The material's first direction of each element: of its two nodes', what is across the element."""
    chord = np.diff(np.asarray(system.positions(states)), axis=1)
    chord /= np.linalg.norm(chord, axis=2, keepdims=True)
    h = np.asarray(system.quaternions(states))
    d1 = Rotation.from_quat(h.reshape(-1, 4), scalar_first=True).as_matrix()[:, :, 0].reshape(*h.shape[:2], 3)
    across = d1[:, 1:] + d1[:, :-1]
    across -= np.sum(across * chord, axis=2, keepdims=True) * chord
    return across / np.linalg.norm(across, axis=2, keepdims=True)
