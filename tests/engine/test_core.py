"""The emitted time loop against the one in JAX: the same equations and the same mathematics."""

import functools

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine import loops
from knode_cosserat.engine.program import EngineError
from knode_cosserat.solvers import static_loop, time_loop
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.history import resting_history
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.static_loop import unloaded_shape
from knode_cosserat.solvers.time_loop import StepCoefficients
from tests.engine.networks import with_committee, with_network

DT, STEPS = 0.05, 25
PAPER, ROUTED = "delrin-tendon-robot", "delrin-routed-tendon-robot"


NETWORK, COMMITTEE = "network of 512 units", "committee"


@functools.cache
def robot_of(name):
    if name in (NETWORK, COMMITTEE):
        return with_network(512, history=True) if name == NETWORK else with_committee()
    return kc.load_robot(name)


def tensions(count, low=4.0, high=8.0):
    return np.random.default_rng(3).uniform(low, high, (count, STEPS, 4))


def settings_of(scheme, space="lobatto2"):
    return Settings.of(scheme, space, "consistent" if scheme == "sdirk2" else "paper", NewtonOptions())


def in_jax(robot, settings, controls, span=(0, STEPS)):
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    return time_loop.loop_one(robot, settings, steps, controls, past, span)


def emitted(robot, settings, controls, span=(0, STEPS)):
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    return loops.loop_one(robot, settings, steps, controls, past, span)


def assert_same(wanted, found, tolerance, estimates):
    for name, one, other in zip(wanted._fields, wanted, found, strict=True):
        one, other = np.asarray(one), np.asarray(other)
        assert one.shape == other.shape, name
        if name in ("corrections", "result"):
            np.testing.assert_array_equal(one, other, name)
            continue
        relative = estimates if name in ("error", "position_error", "time_error") else tolerance
        # residuals are differences of numbers of size one
        least = 1e-14 if name == "error" else 1e-300
        atol = max(relative * np.nanmax(np.abs(one), initial=0.0), least)
        np.testing.assert_allclose(other, one, atol=atol, err_msg=name)


@pytest.mark.parametrize(
    ("name", "scheme"),
    [(PAPER, "sdirk2"), (ROUTED, "bdf-alpha"), (NETWORK, "bdf-alpha"), (COMMITTEE, "sdirk2")],
)
def test_a_robot_with_places_in_lanes(name, scheme):
    """The iterates are those of the loop in JAX; so are the estimates, and the state that follows."""
    robot, settings, control = robot_of(name), settings_of(scheme), tensions(1)[0]
    done, state, rows = in_jax(robot, settings, control)
    own_done, own_state, own_rows = emitted(robot, settings, control)
    assert int(done) == own_done == STEPS
    assert_same(rows, own_rows, 1e-11, 1e-5)
    for name, one, other in zip(state._fields, state, own_state, strict=True):
        atol = (1e-5 if "error" in name else 1e-10) * max(float(np.max(np.abs(one))), 1e-300)
        np.testing.assert_allclose(other, one, atol=atol, err_msg=name)


@pytest.mark.parametrize("name", [PAPER, ROUTED, "variable-curvature-robot"])
def test_equilibria(name):
    """Equilibria in turn, of one robot and of several in lanes, are those of the loop in JAX."""
    robot, settings = robot_of(name), Settings(None)
    rng = np.random.default_rng(1)
    controls = rng.uniform(0.0, 1.0, (3, 4, robot.control_size)) * (
        8.0 if "tension" in robot.control_layout.names else 1.0
    )
    y = unloaded_shape(robot, settings.space)
    for own in controls:
        done, last, rows = static_loop.static_one(robot, settings, own, y, (0, 4))
        own_done, own_last, own_rows = loops.static_one(robot, settings, own, y, (0, 4))
        assert own_done == int(done) == 4
        np.testing.assert_allclose(own_last, last, atol=1e-11 * np.max(np.abs(last)))
        assert_same(rows, own_rows, 1e-11, 1e-5)
    many = loops.static_many(robot, settings, controls, np.stack([y] * 3), 4)
    np.testing.assert_array_equal(many[0], [4, 4, 4])
    np.testing.assert_allclose(many[2].records[-1], rows.records, atol=1e-8)


def test_equilibria_end_at_the_first_without_a_solution():
    robot, settings = robot_of(PAPER), Settings(None)
    controls = np.array([[5.0, 4.0, 4.0, 5.0], [1e7, 0.0, 0.0, 1e7], [5.0, 4.0, 4.0, 5.0]])
    y = unloaded_shape(robot, settings.space)
    done, last, rows = loops.static_one(robot, settings, controls, y, (0, 3))
    assert done == 1 and rows.result.tolist()[1:] == [kc.Result.NO_CONVERGENCE, kc.Result.NOT_REACHED]
    np.testing.assert_array_equal(last, loops.static_one(robot, settings, controls[:1], y, (0, 1))[1])


def test_a_refusal_keeps_no_frames():
    """It is raised at every step of a robot that the engine does not cover."""
    robot = robot_of(PAPER)
    for _ in range(3):
        with pytest.raises(EngineError) as caught:
            loops.core_of(robot, settings_of("sdirk2", "lobatto4"), robots=False)
        assert len(caught.traceback) == 3


def test_a_span_continues_another():
    robot, settings, control = robot_of(PAPER), settings_of("sdirk2"), tensions(1)[0]
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    _, _, whole = loops.loop_one(robot, settings, steps, control, past, (0, STEPS))
    done, state, first = loops.loop_one(robot, settings, steps, control, past, (0, 10))
    assert done == 10
    _, _, second = loops.loop_one(robot, settings, steps, control, state, (10, STEPS))
    # factors are not kept from one span to the next: equal within the tolerance of a step
    np.testing.assert_allclose(first.records, whole.records[:10], atol=1e-13)
    np.testing.assert_allclose(second.records, whole.records[10:], atol=1e-8)


def test_hard_steps_are_damped():
    """Tensions between 0 and 30 N in steps of 50 ms need several linearisations and shorter corrections."""
    robot, settings, control = robot_of(PAPER), settings_of("bdf2"), tensions(1, 0.0, 30.0)[0]
    _, _, rows = in_jax(robot, settings, control)
    _, _, own = emitted(robot, settings, control)
    assert np.max(own.corrections) > 8
    assert_same(rows, own, 1e-9, 1e-3)


def test_a_failed_step_ends_the_loop_with_the_state_before_it():
    robot, settings = robot_of(PAPER), settings_of("sdirk2")
    control = np.concatenate([tensions(1)[0][:4], np.full((STEPS - 4, 4), [1e7, 0.0, 0.0, 1e7])])
    done, state, rows = in_jax(robot, settings, control)
    own_done, own_state, own_rows = emitted(robot, settings, control)
    assert own_done == int(done) < STEPS
    assert own_rows.result[own_done] == kc.Result.NO_CONVERGENCE
    np.testing.assert_allclose(own_state.records, state.records, atol=1e-9)
    np.testing.assert_allclose(own_rows.records[:own_done], rows.records[:own_done], atol=1e-9)


@pytest.mark.parametrize("name", [PAPER, ROUTED, NETWORK])
def test_robots_in_lanes_have_their_own_parameters_and_controls(name):
    """Ten robots in lanes of eight. Estimates of a vector stop together: they differ by their tolerance."""
    robot, settings, control = robot_of(name), settings_of("sdirk2"), tensions(10)
    moduli = np.linspace(2e9, 4e9, 10)
    systems = [robot.replace(youngs_modulus=modulus) for modulus in moduli]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *systems)
    pasts = jax.tree.map(
        lambda *leaves: np.stack(leaves), *(resting_history(each, settings) for each in systems)
    )
    steps = StepCoefficients.of(settings, DT)
    done, states, rows = loops.loop_many(batch, settings, steps, control, pasts, STEPS)
    assert np.all(done == STEPS) and states.y.shape == pasts.y.shape
    for k in (0, 3, 9):
        past = resting_history(systems[k], settings)
        _, _, wanted = loops.loop_one(systems[k], settings, steps, control[k], past, (0, STEPS))
        scale = np.max(np.abs(wanted.records))
        np.testing.assert_allclose(rows.records[k], wanted.records, atol=1e-8 * scale)
        for field in ("position_error", "time_error"):
            estimate = getattr(wanted, field)
            np.testing.assert_allclose(getattr(rows, field)[k], estimate, atol=0.1 * estimate.max())


def test_what_is_not_covered_is_refused_in_one_line():
    settings = settings_of("sdirk2", "lobatto4")
    with pytest.raises(EngineError, match="lobatto2"):
        emitted(robot_of(PAPER), settings, tensions(1)[0])
