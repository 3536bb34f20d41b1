"""A correction of Newton's method in the engine, against a dense solve of the equations in JAX."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine import loops
from knode_cosserat.rods.system import unknowns_of
from knode_cosserat.rods.tendons import TendonFriction
from knode_cosserat.schemes.history import StepCoefficients, history_of
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.solvers.rest import resting_history
from tests.engine.test_core import Stretching, standing_history

DT = 0.05
PAPER, ROUTED, LEGS = "delrin-tendon-robot", "delrin-routed-tendon-robot", "six-legged-robot"
#: a single linearisation, and a single correction by it
ONCE = NewtonOptions(1e-200, 1e200, max_linearisations=1, patience=1)
BEAM = {"length": 0.5, "radius": 0.005, "density": 1200.0, "youngs_modulus": 5e6, "bending_damping": 1e-2}
HELIX = tuple(
    kc.robots.routing.Helical(0.02, phase, 0.5, end=end) for phase, end in ((0.3, 1.0), (2.4, 0.63))
)


class Tethered(kc.robots.SlenderRod):
    """A rod that a spring pulls back to its axis: its position enters the equations."""

    def balance(self, s, t, y, y_t, z, z_t, control):
        y_s = super().balance(s, t, y, y_t, z, z_t, control)
        n_s = self.y_layout.get(y_s, "n") + self.y_layout.get(y, "p")
        return self.y_layout.replaced(y_s, ("n",), n_s)


def routed(**changes):
    return kc.robots.RoutedTendonRobot.like(kc.load_robot(PAPER), **changes)


def controlled_sections():
    section = kc.robots.Stretch(end=0.37, stiffness=[2.0, -0.5], controlled=True, stiffness_gain=0.3)
    return kc.robots.SlenderRod(**BEAM, gravity=(0.0, 0.0, -9.81), sections=(section,))


ROBOTS = {
    "paper": lambda: kc.load_robot(PAPER),
    "ribs, a sleeve and masses": lambda: kc.load_robot(ROUTED),
    "six legs": lambda: kc.load_robot(LEGS),
    "position enters": lambda: Tethered(**BEAM, gravity=(0.0, 0.0, -9.81)),
    "B is not zero": Stretching,
    "helical, one ends": lambda: routed(routing=HELIX),
    "friction": lambda: routed(friction=TendonFriction(wobble=0.6)),
    "friction, one ends": lambda: routed(routing=HELIX, friction=TendonFriction(curvature=0.1)),
    "reel": lambda: routed(drive="reel", tendon_compliance=1e-4),
    "controlled sections": controlled_sections,
}
#: they show all kinds of blocks; compiling the others takes as long
QUICK = {
    ("paper", "lobatto2"),
    ("ribs, a sleeve and masses", "lobatto4"),
    ("six legs", "lobatto2"),
    ("position enters", "euler"),
    ("B is not zero", "lobatto4"),
}


@functools.partial(jax.jit, static_argnames="space")
def linearised(system, space, c0, t, control, history, y, unknowns):
    """Return the residuals of base, pieces and tip in natural units, and their dense Jacobian."""
    problem, scales = StepProblem(system, t, control, c0, history, space), system.scales()
    # a base that moves is met first
    y = jnp.concatenate([problem.base(unknowns)[None], y[1:]])

    def residuals(x):
        own, unknowns = x[: y.size].reshape(y.shape), x[y.size :]
        defects, tip = problem.residuals(own * scales.y)
        base = problem.base(unknowns) - own[0] * scales.y
        return jnp.concatenate([base / scales.y, jnp.ravel(defects / scales.y), tip / scales.tip])

    at = jnp.concatenate([jnp.ravel(y / scales.y), unknowns])
    return residuals(at), jax.jacfwd(residuals)(at)


def dense_correction(system, settings, dt, past, control, y):
    """Return the corrections of y at all points, in natural units, and of the unknowns, in the first step."""
    coefficients, t = StepCoefficients.of(settings, dt).at(past.t0, 0)
    history = history_of(past.records, past.rate, coefficients, settings)
    unknowns = unknowns_of(system, y[0])
    given = coefficients[0], t, control, history, y, unknowns
    right, matrix = map(np.asarray, linearised(system, settings.space, *given))
    units = np.concatenate([np.ones(y.size), np.maximum(np.abs(unknowns), 1.0)])
    found = -units * np.linalg.solve(matrix * units, right)
    return found[: y.size].reshape(y.shape), found[y.size :]


@pytest.mark.parametrize(
    ("name", "space"),
    [
        pytest.param(name, space, marks=[] if (name, space) in QUICK else [pytest.mark.campaign])
        for name in ROBOTS
        for space in ("lobatto2", "lobatto4", "euler")
    ],
)
def test_a_correction_is_that_of_a_dense_solve(name, space):
    robot, settings = ROBOTS[name](), Settings.of("bdf2", space, "paper", ONCE)
    past = standing_history(robot, settings) if name == "six legs" else resting_history(robot, settings)
    control = np.random.default_rng(1).uniform(0.2, 0.4, robot.control_layout.size)
    control *= {"reel": 1e-3, "six legs": 1e-3}.get(name, 1.0)
    steps, y = StepCoefficients.of(settings, DT), np.asarray(past.y[0])
    _, state, rows = loops.solve_steps(robot, steps, control[None], past, (0, 1))
    assert rows.corrections[0] == 1
    dy, dxi = dense_correction(robot, settings, DT, past, control, y)
    found = (state.y[0] - y) / np.asarray(robot.scales().y)
    # base conditions are met exactly, not only in linear approximation
    np.testing.assert_allclose(found[1:], dy[1:], atol=1e-9 * np.max(np.abs(dy)))
    before = unknowns_of(robot, y[0])
    np.testing.assert_allclose(rows.unknowns[0] - before, dxi, atol=1e-9 * np.max(np.abs(dxi)))
    assert np.max(np.abs(dy)) > 1e-4


@pytest.mark.parametrize("space", ["lobatto2", "lobatto4"])
def test_growth_along_the_rod_does_no_harm(space):
    """Waves of a stiff bar grow by more than 1e60 from base to tip; the problem is as well posed as ever.

    Solutions from base to tip, which the elimination replaces, lose all digits.
    """
    bar, dt = Stretching(nodes=101), 1e-4
    settings = Settings.of("bdf2", space, "paper", NewtonOptions())
    past, control = resting_history(bar, settings), np.array([1e4])
    steps, y = StepCoefficients.of(settings, dt), np.asarray(past.y[0])
    done, state, rows = loops.solve_steps(bar, steps, control[None], past, (0, 1))
    assert done == 1 and rows.error[0] <= 1e-10
    dy, dxi = dense_correction(bar, settings, dt, past, control, y)
    found = (state.y[0] - y) / np.asarray(bar.scales().y)
    np.testing.assert_allclose(found, dy, atol=1e-9 * np.max(np.abs(dy)))
    np.testing.assert_allclose(
        rows.unknowns[0] - unknowns_of(bar, y[0]), dxi, atol=1e-9 * np.max(np.abs(dxi))
    )
    rate = 1.5 / dt / np.sqrt(1.0 + 1.5 * bar.damping / dt)
    assert np.exp(rate * bar.length) > 1e60
