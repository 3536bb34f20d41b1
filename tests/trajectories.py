"""Trajectories of random numbers to be saved, and what tests of their files have in common."""

import dataclasses
import hashlib
import io
import re
from typing import Any, ClassVar

import h5py
import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat import TrajectoryFileError
from knode_cosserat.io.container import _LAST_LINE
from knode_cosserat.robots import parameter
from knode_cosserat.schemes.history import SolverState, StateHistory
from knode_cosserat.schemes.time import TimeScheme

ROBOT = kc.load_robot("delrin-tendon-robot")
PAPER = kc.solvers.Settings()
ARRAYS = ("time", "y", "z", "control", "result", "residual", "iterations")


@dataclasses.dataclass(frozen=True)
class Leapfrog(TimeScheme):
    """A user's scheme."""

    weight: float = 0.5
    order = 2

    def coefficients(self, dt, previous_dt):
        raise NotImplementedError


class Pendulum(kc.System):
    """A class that no robot file can name, with z and controls that hold nothing."""

    y_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(
        ("angle", 1, "rad", "angle"), ("force", 3, "N", "force")
    )
    z_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout()
    control_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout()
    base_unknowns: ClassVar[tuple[str, ...]] = ()
    length: Any = parameter("m", "length", low=0.0, high=1.0)

    def rest(self, s):
        return np.zeros(4), np.zeros(0)

    def tip(self, t, control, y, y_t):
        return np.zeros(0)


#: tensions (N) under which no step of the paper's robot is solved; 1 MN each is solved, on its grid
HOPELESS = [1e8, 0.0, 0.0, 1e8]


def fails(*parts):
    """A `TrajectoryFileError` of one line that has all the parts, in order."""
    return pytest.raises(TrajectoryFileError, match=r"^(?!.*\n).*" + ".*".join(map(re.escape, parts)))


def edited(path, edit=None, facts=None):
    """Change the content of a container, with a new checksum; `facts` changes their JSON text."""
    data = path.read_bytes()
    line = _LAST_LINE.search(data)
    file = io.BytesIO(data[: line.start()])
    with h5py.File(file, "r+") as opened:
        if edit is not None:
            edit(opened)
        if facts is not None:
            opened.attrs["facts"] = facts(opened.attrs["facts"])
    path.write_bytes(sealed(file.getvalue(), line))
    return path


def sealed(content, line):
    """The bytes of a container with this content; `line` is the match of another one's last line."""
    content += line[0][: line.start(4) - line.start()]
    return content + hashlib.sha256(content).hexdigest().encode() + b"\n"


def assert_same(a, b):
    """Equal to the last bit, the sign of zeros and the payload of NaN included."""
    for name in ARRAYS:
        one, other = np.asarray(getattr(a, name)), np.asarray(getattr(b, name))
        assert (one.dtype, one.shape) == (other.dtype, other.shape), name
        assert one.tobytes() == other.tobytes(), name
    assert (a.position_error is None) == (b.position_error is None)
    if a.position_error is not None:
        assert np.asarray(a.position_error).tobytes() == np.asarray(b.position_error).tobytes()
    states = [(each.initial_state, each.final_state) for each in (a, b)]
    assert jax.tree.structure(states[0]) == jax.tree.structure(states[1])
    for one, other in zip(*map(jax.tree.leaves, states), strict=True):
        assert np.shape(one) == np.shape(other) and np.asarray(one).tobytes() == np.asarray(other).tobytes()
    assert a.settings == b.settings
    assert jax.tree.structure(a.system) == jax.tree.structure(b.system)
    for one, other in zip(jax.tree.leaves(a.system), jax.tree.leaves(b.system), strict=True):
        assert np.array_equal(one, other)


def synthetic(batch=(), steps=4, nodes=5, robot=ROBOT, settings=PAPER, seed=0, places=0):
    """A trajectory of random numbers, and of what a file could spoil: -0, NaN, infinity, a subnormal.

    With `places` it has position errors and solver states at that number of places.
    """
    rng = np.random.default_rng(seed)

    def state(dt, known):
        if not places:
            return None
        shapes = (
            (2, places, 25),
            (places, 25),
            (3, nodes, 19),
            (3,),
            (),
            (3, places - 1, 25),
            (2, places - 1, 25),
        )
        history = StateHistory(*(rng.normal(size=(*batch, *shape)) for shape in shapes))
        return SolverState(history, dt, known)

    rows = (*batch, steps)
    y = rng.normal(size=(*rows, nodes, robot.y_layout.size))
    y.flat[:4] = [-0.0, np.nan, np.inf, 5e-324]
    result = rng.choice([int(result) for result in kc.Result], size=rows)
    # a solved row is finite
    result.flat[:1] = int(kc.Result.NO_CONVERGENCE)
    return kc.Trajectory(
        system=robot,
        settings=settings,
        time=0.3 + np.arange(steps) * 0.1,
        y=y,
        z=rng.normal(size=(*rows, nodes, robot.z_layout.size)),
        control=rng.uniform(size=(*rows, robot.control_layout.size)),
        result=result,
        residual=rng.normal(size=rows),
        iterations=rng.integers(0, 100, size=rows),
        position_error=rng.uniform(size=rows) if places else None,
        initial_state=state(None, True),
        final_state=state(0.1, False),
    )


def stacked(*robots):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *robots)


ROBOTS = stacked(
    ROBOT,
    ROBOT.replace(length=0.4, drag=[1.0, 2.0, 3.0], gravity=[0.0, 0.0, 0.0]),
    ROBOT.replace(youngs_modulus=1e9 / 3, tendon_angles=[0.1, 0.2, 0.3, 0.4]),
)
