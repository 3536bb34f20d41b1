"""What is evaluated before a step is iterated on: all that can be, and nothing comes out differently."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.system import unknowns_of
from knode_cosserat.rods.tendon_friction import TendonFriction
from knode_cosserat.solvers.grid import at_places
from knode_cosserat.solvers.history import rest_record
from knode_cosserat.solvers.hoisting import split_function
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.space import SCHEMES

HELIX = tuple(
    kc.robots.routing.Helical(0.02, phase, 0.5, end=end) for phase, end in ((0.3, 1.0), (2.4, 0.63))
)
BEAM = {"length": 0.5, "radius": 0.005, "density": 1200.0, "youngs_modulus": 5e6}
ROBOTS = {
    "crude": lambda: kc.load_robot("delrin-tendon-robot"),
    "ribs, a sleeve and masses": lambda: kc.load_robot("delrin-routed-tendon-robot"),
    "helical, one ends": lambda: kc.robots.RoutedTendonRobot.like(
        kc.load_robot("delrin-tendon-robot"), routing=HELIX
    ),
    "friction": lambda: kc.robots.RoutedTendonRobot.like(
        kc.load_robot("delrin-tendon-robot"), friction=TendonFriction(wobble=0.6)
    ),
    "friction, one ends": lambda: kc.robots.RoutedTendonRobot.like(
        kc.load_robot("delrin-tendon-robot"), routing=HELIX, friction=TendonFriction(curvature=0.1)
    ),
    "reel": lambda: kc.robots.RoutedTendonRobot.like(
        kc.load_robot("delrin-tendon-robot"), drive="reel", tendon_compliance=1e-4
    ),
    "sections that are controlled": lambda: kc.robots.SlenderRod(
        **BEAM,
        sections=(kc.robots.Stretch(end=0.37, stiffness=[2.0, -0.5], controlled=True, stiffness_gain=0.3),),
    ),
    "six legs": lambda: kc.load_robot("six-legged-robot"),
}


def a_step(robot, space):
    """Some step of it, away from rest, and a state that does not solve it."""
    generator = np.random.default_rng(1)
    record, ny = np.asarray(jax.jit(rest_record)(robot)), robot.y_layout.size
    scale = np.asarray(robot.scales().y)
    noise = 1e-2 * generator.normal(size=(robot.nodes, record.shape[1]))
    noise[:, :ny] *= scale
    y = record[:, :ny] + 1e-2 * generator.normal(size=(robot.nodes, ny)) * scale
    history = -20.0 * (record + noise)
    if robot.mixed:
        history = np.concatenate([history, np.zeros((robot.nodes, ny))], axis=1)
    control = 5.0 * generator.uniform(0.5, 1.0, robot.control_size)
    control *= 1e-3 if "reel" in robot.control_layout.names else 1.0
    past = jax.jit(at_places, static_argnums=1)(robot, SCHEMES[space], jnp.asarray(history))
    problem = StepProblem(robot, jnp.array(0.3), jnp.asarray(control), jnp.array(20.0), past, SCHEMES[space])
    return problem, problem.grid.spread(jnp.asarray(y))


#: the others take as long to compile, and are looked at in the long campaign
QUICK = {
    ("ribs, a sleeve and masses", "lobatto2"), ("six legs", "lobatto2"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "space"),
    [
        pytest.param(name, space, marks=() if (name, space) in QUICK else pytest.mark.campaign)
        for name in ROBOTS
        for space in ("lobatto2", "lobatto4")
    ],
)
def test_nothing_comes_out_differently(name, space):
    robot = ROBOTS[name]()
    problem, y = a_step(robot, space)

    def all_of(prepared):
        own = problem.ready() if prepared else problem
        return own.linearise(y, unknowns_of(robot, y[0])), own.reached(y), own.records(y)

    scale, own = (np.asarray(system.scales().y) for system in (robot, robot.strand))
    natural = own / own[:, None]
    found, expected = (jax.jit(all_of, static_argnums=0)(prepared) for prepared in (True, False))
    (slopes, ends, record), (true_slopes, true_ends, true_record) = found, expected
    assert np.all(np.isfinite(true_record)) and np.all(np.isfinite(true_slopes.F))
    np.testing.assert_allclose(ends / scale, true_ends / scale, rtol=1e-12, atol=1e-12)
    for one, other in ((slopes.F, true_slopes.F), (slopes.G, true_slopes.G)):
        np.testing.assert_allclose(one * natural, other * natural, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(record, true_record, rtol=1e-10, atol=1e-12)


def primitives(function, *given):
    return {step.primitive.name for step in jax.make_jaxpr(function)(*given).eqns}


def test_what_follows_from_the_place_is_not_evaluated_again():
    parameter = jnp.array(2.0)

    def function(s, y):
        return jnp.exp(parameter) * jnp.sin(s) * y + jnp.cos(y) * s, jnp.tanh(s)

    place, y = jnp.array(0.7), jnp.array([0.2, 0.4])
    parts = split_function(function, place, y)
    ahead = parts.first(place)
    assert "sin" in primitives(parts.first, place)
    assert not primitives(parts.remainder, ahead, place, y) & {"sin", "exp", "tanh"}
    assert "cos" in primitives(parts.remainder, ahead, place, y)
    for one, other in zip(parts.remainder(ahead, place, y), function(place, y), strict=True):
        np.testing.assert_array_equal(one, other)


def test_derivatives_are_those_that_the_function_states():
    @jax.custom_jvp
    def stated(s, y):
        return s * y

    stated.defjvp(lambda primals, tangents: (stated(*primals), 7.0 * tangents[1]))
    parts = split_function(lambda s, y: stated(jnp.sin(s), y), jnp.array(0.7), jnp.array(1.0))
    ahead = parts.first(jnp.array(0.3))
    slope = jax.grad(lambda y: parts.remainder(ahead, jnp.array(0.3), y))(1.0)
    assert slope == 7.0


def test_what_has_effects_happens_whenever_it_is_evaluated(capfd):
    def function(s, y):
        jax.debug.print("seen at {}", s)
        return s + y

    parts = split_function(function, jnp.array(0.0), jnp.array(0.0))
    ahead = parts.first(jnp.array(0.5))
    for _ in range(2):
        parts.remainder(ahead, jnp.array(0.5), jnp.array(1.0))
    jax.effects_barrier()
    assert capfd.readouterr().out.count("seen at 0.5") == 2


@pytest.mark.campaign
def test_slopes_by_the_control_go_through_what_was_evaluated_before():
    """Stiffness that a control changes is evaluated ahead, and is no constant for that."""
    problem, y = a_step(ROBOTS["sections that are controlled"](), "lobatto2")

    def ends(control, prepared):
        own = StepProblem(problem.system, problem.t, control, problem.c0, problem.history, problem.space)
        return (own.ready() if prepared else own).reached(y)

    found, expected = (jax.jacfwd(ends)(problem.control, prepared) for prepared in (True, False))
    assert np.max(np.abs(expected)) > 0.0
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
