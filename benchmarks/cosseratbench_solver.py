"""This package as a solver of `cosseratbench`, an independent suite of rod scenarios.

A scenario states physics only. Here each of its rods becomes a `SlenderRod`, whose states become the
requested frames. The numerical settings are:

- Arclength: Lobatto's formula of order 4. It is stable on any grid; for its accuracy each element has enough
  segments to keep exponentials along the rod (bending under tension, waves within a time step, twist) below
  e^0.3 in each.
- A quasi-static scenario without driven ends has one equilibrium. The first frame is the given shape, every
  other frame the equilibrium.
- A quasi-static scenario with a driven end is a motion, under a drag that would damp its slowest vibration
  critically.
- Any other scenario is a motion without damping.

Motions are stepped by BDF-α close to the trapezoidal rule, in steps so short that the period of the slowest
vibration is off by two hundred-thousandths. The suite runs the beginning of every scenario before it
measures, so its wall times are without compilation: of a motion too, as segments and steps of a call are
those of the whole one.

`python -m benchmarks.cosseratbench_solver` is the suite's program with this solver beside the installed ones.
"""

from __future__ import annotations

import math
import sys
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from cosseratbench import cli
from cosseratbench.scenario import End, EndCondition, Motion, Rod, Scenario, parallel_transport
from cosseratbench.solver import Capability, Diverged
from cosseratbench.trajectory import Trajectory
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from benchmarks.shapes import resting
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.ends import AXES

#: folder with the entry point by which the suite finds the solver
ENTRY_POINT = Path(__file__).parent / "entry_point"
#: steps of one call, so that every run of a rod shares one program
CHUNK = 128
#: error of the period of the slowest vibration that the time step may make
PERIOD_ERROR = 2e-5
#: almost the trapezoidal rule: its damping of a slow vibration is far below its error in time
SCHEME = kc.solvers.BDFAlpha(-0.45)
#: largest exponent of growth along the rod within one segment
STEEPEST = 0.3
#: points for each segment at which the tangent and the curvature of the given shape are taken
FINER = 10


class KnodeCosserat:
    """Solver for the suite; `time_step_scale` multiplies the time step that it chooses."""

    name = "knode-cosserat"
    capabilities: ClassVar[frozenset[Capability]] = frozenset({Capability.STRETCH, Capability.SHEAR})
    backend_version = metadata.version("knode-cosserat")

    def __init__(self, time_step_scale: float = 1.0):
        self.time_step_scale = time_step_scale

    def settings(self, scenario: Scenario, *, n_elements: int, n_frames: int) -> dict[str, Any]:
        """Return the numerical settings of a run, to be shown with its result."""
        dt = self._time_step(scenario, scenario.duration / (n_frames - 1))
        segments = max(_segments(rod, scenario, n_elements, dt) for rod in scenario.rods)
        chosen: dict[str, Any] = {"space": "lobatto4", "segments_per_element": segments}
        if dt is None:
            return chosen | {"time": "equilibrium"}
        drag = _drag_rate(scenario)
        return chosen | {"time": f"bdf-alpha({SCHEME.alpha})", "time_step": dt, "drag_rate": drag}

    def run(self, scenario: Scenario, *, n_elements: int, n_frames: int) -> Trajectory:
        """Return positions (n_frames, n_elements + 1, 3) and directors of every rod; see the module.

        Raises:
            Diverged: a step has no solution.
            NotImplementedError: the model does not support a part of the scenario.
        """
        times = np.linspace(0.0, scenario.duration, n_frames)
        dt = self._time_step(scenario, times[1])
        shapes = [_frames(rod, scenario, times, dt, n_elements) for rod in scenario.rods]
        return Trajectory(times, *(tuple(each) for each in zip(*shapes, strict=True)))

    def _time_step(self, scenario: Scenario, interval: float) -> float | None:
        """Return a fraction of the interval between frames, or None for an equilibrium.

        The relative error of the period is (ω dt)² / 12.
        """
        if scenario.quasi_static and not any(rod.motion(end) for rod in scenario.rods for end in End):
            return None
        dt = self.time_step_scale * _usual_time_step(scenario)
        return interval / math.ceil(interval / dt)


def _usual_time_step(scenario: Scenario) -> float:
    """Return the time step (s) at which the period of the slowest vibration has the allowed error."""
    return math.sqrt(12.0 * PERIOD_ERROR) / scenario.slowest_frequency()


class InitialShape(NamedTuple):
    """Initial shape of a rod at its nodes: p, h, and the strains v and u."""

    p: np.ndarray
    h: np.ndarray
    v: np.ndarray
    u: np.ndarray

    @classmethod
    def of(cls, rod: Rod, segments: int) -> InitialShape:
        """Return the shape of the scenario's polyline, without shear and, as the suite requires, twist."""
        points = np.asarray(rod.centerline, dtype=float)
        along = rod.rest_arc_length
        if along is None:
            along = (0.0, *np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        curve = make_interp_spline(along, points, k=min(3, len(points) - 1))
        s = np.linspace(0.0, along[-1], FINER * segments + 1)
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


def _frames(rod: Rod, scenario: Scenario, times: np.ndarray, dt: float | None, n_elements: int) -> Any:
    """Return positions and directors of one rod at these times, in steps of dt or at rest."""
    segments, newton = _segments(rod, scenario, n_elements, dt), _newton(rod, scenario)
    shape = InitialShape.of(rod, segments * n_elements)
    system = _system(rod, scenario, shape)
    start = resting(system, *shape)
    try:
        if dt is None:
            still = kc.equilibrium(system, start.control[0], space="lobatto4", initial=start, newton=newton)
            states = np.repeat(np.asarray(still.y), len(times), axis=0)
        else:
            states = _motion(start, rod, times, dt, newton)
    except kc.SimulationError as error:
        raise Diverged(str(error), error.time) from error
    states = states[:, ::segments]
    position, directors = np.array(Drawing.of(system).positions(states)), _directors(system, states)
    position[0], directors[0] = rod.nodes(n_elements), rod.directors(n_elements)
    return position, directors


def _segments(rod: Rod, scenario: Scenario, n_elements: int, dt: float | None) -> int:
    """Return the number of segments in an element, from the steepest exponential along the rod."""
    EI = rod.material.youngs_modulus * rod.second_moment_of_area
    mass = rod.material.density * rod.area
    rate = math.sqrt(_pull(rod, scenario)) / rod.length
    if dt is not None:
        # so that frames a little denser need no other program
        usual = _usual_time_step(scenario)
        dt = usual * 2.0 ** math.ceil(math.log2(dt / usual))
        # waves from one time step to the next: EI w_ssss + ρA c0² w = 0
        rate = max(rate, (mass * SCHEME.coefficients(dt, dt)[0] ** 2 / EI) ** 0.25)
    for motion in filter(None, (rod.start_motion, rod.end_motion)):
        rate = max(rate, float(np.linalg.norm(motion.rotation, axis=1).max()) / rod.length)
    return max(1, math.ceil(rate * rod.length / n_elements / STEEPEST))


def _pull(rod: Rod, scenario: Scenario) -> float:
    """Return an upper bound of the tension in the rod by its loads, in EI / L²."""
    EI = rod.material.youngs_modulus * rod.second_moment_of_area
    weight = rod.material.density * rod.area * rod.length * np.linalg.norm(scenario.gravity)
    pull = weight + sum(np.linalg.norm(load.force) for load in rod.loads)
    return float(pull * rod.length**2 / EI)


def _newton(rod: Rod, scenario: Scenario) -> kc.solvers.NewtonOptions:
    """Return Newton's options with tolerances scaled by the loads if these exceed EI / L²."""
    usual, size = kc.solvers.NewtonOptions(), max(1.0, _pull(rod, scenario))
    return kc.solvers.NewtonOptions(tolerance=size * usual.tolerance, acceptable=size * usual.acceptable)


def _drag_rate(scenario: Scenario) -> float:
    """Return drag over mass (1/s) for critical damping of the slowest vibration; zero in dynamics."""
    return 2.0 * scenario.slowest_frequency() if scenario.quasi_static else 0.0


# from a scenario's rod to ours


def _system(rod: Rod, scenario: Scenario, shape: InitialShape) -> kc.robots.SlenderRod:
    """Return the rod; unloaded, it is straight along its first tangent."""
    if rod.start is EndCondition.FREE and any(load.at is End.START for load in rod.loads):
        raise NotImplementedError("a load at a free start")
    force = np.sum([load.force for load in rod.loads if load.at is End.END] or np.zeros((1, 3)), axis=0)
    drag = _drag_rate(scenario) * rod.material.density * rod.area
    return kc.robots.SlenderRod(
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
        loads=(kc.robots.loads.PointWrench(force=force),) if force.any() else (),
    )


def _end(rod: Rod, which: End, p: np.ndarray, h: np.ndarray) -> Any:
    """Return the boundary condition at an end of the rod."""
    condition, motion = rod.condition(which), rod.motion(which)
    if condition is EndCondition.FREE:
        return kc.robots.ends.Free()
    if condition is EndCondition.PINNED:
        return kc.robots.ends.Pinned(position=p)
    if motion is None:
        return kc.robots.ends.Clamped(position=p, orientation=h)
    if motion.slides_along is None:
        return kc.robots.ends.Driven(position=p, orientation=h, axes=AXES)
    if which is End.START:
        raise NotImplementedError("a start that slides")
    return kc.robots.ends.Sliding(position=p, orientation=h, axes=AXES, along=_axis(motion))


def _axis(motion: Motion) -> str:
    """Return the name of the global axis along which an end slides."""
    along = np.abs(motion.axis)
    if along.max() < 1.0 - 1e-12:
        raise NotImplementedError(f"an end that slides along {motion.slides_along}, no axis of the world")
    return AXES[int(np.argmax(along))]


def _motion(
    start: kc.Trajectory, rod: Rod, times: np.ndarray, dt: float, newton: kc.solvers.NewtonOptions
) -> np.ndarray:
    """Return the states at these times, in steps of dt."""
    steps = round(times[1] / dt)
    controls = _controls(rod, dt * (1.0 + np.arange(steps * (len(times) - 1))))
    states, going = [np.asarray(start.y)], start
    for first in range(0, len(controls), CHUNK):
        going = kc.simulate(
            start.system,
            controls[first : first + CHUNK],
            dt,
            time=SCHEME,
            space="lobatto4",
            start="consistent",
            initial=going,
            newton=newton,
        )
        states.append(np.asarray(going.y)[1:])
    return np.concatenate(states)[::steps]


def _controls(rod: Rod, times: np.ndarray) -> np.ndarray:
    """Return displacement and rotation vector of each driven end at these times."""
    found = [np.zeros((len(times), 0))]
    for end in End:
        motion = rod.motion(end)
        if motion is None:
            continue
        for path in (motion.displacement, motion.rotation):
            columns = np.asarray(path, dtype=float).T
            found.append(np.stack([np.interp(times, motion.times, each) for each in columns], axis=1))
    return np.concatenate(found, axis=1)


def _directors(system: kc.robots.SlenderRod, states: np.ndarray) -> np.ndarray:
    """Return the first director of each element: the mean of its two nodes', normal to the element."""
    chord = np.diff(np.asarray(Drawing.of(system).positions(states)), axis=1)
    chord /= np.linalg.norm(chord, axis=2, keepdims=True)
    h = np.asarray(Drawing.of(system).quaternions(states))
    d1 = Rotation.from_quat(h.reshape(-1, 4), scalar_first=True).as_matrix()[:, :, 0].reshape(*h.shape[:2], 3)
    across = d1[:, 1:] + d1[:, :-1]
    across -= np.sum(across * chord, axis=2, keepdims=True) * chord
    return across / np.linalg.norm(across, axis=2, keepdims=True)


if __name__ == "__main__":
    # of the path, as worker processes get it too
    sys.path.append(str(ENTRY_POINT))
    cli.main()
