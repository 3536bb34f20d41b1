"""The time loop of the engine: results of the version before it, and equations evaluated in JAX.

`stored.npz` has results of the time loop in JAX of commit 09df89b, which the engine has replaced: iterates,
numbers of corrections and estimates. Names are "case/field" for fields of rows, and "case/newest field" for
the newest part of each field of the state after a run. Of records and unknowns, only the last row is stored.
The residuals of all solved rows are evaluated in JAX (`StepProblem`).
"""

import dataclasses
import functools
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine import loops, pattern
from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.engine.program import EngineError
from knode_cosserat.rods.ends import Driven
from knode_cosserat.rods.system import unknown_count
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.history import (
    EXTRAPOLATIONS,
    StepCoefficients,
    TimeStep,
    history_of,
    repeated_record_history,
)
from knode_cosserat.schemes.problem import StepProblem, no_history, row_of
from knode_cosserat.schemes.settings import NewtonOptions, Settings, schemes
from knode_cosserat.schemes.space import Formula, SpaceScheme, Stage
from knode_cosserat.solvers.recovery import Budget, StaticRecovery, StepRecovery
from knode_cosserat.solvers.rest import resting_history, unloaded_shape
from tests.engine.networks import with_committee, with_network

SCHEMES = {name: scheme() for name, scheme in schemes(SpaceScheme).items()}
DT, STEPS = 0.05, 25
PAPER, ROUTED, LEGS = "delrin-tendon-robot", "delrin-routed-tendon-robot", "six-legged-robot"


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


def emitted(robot, settings, controls, span=(0, STEPS)):
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    return loops.solve_steps(robot, steps, controls, past, span)


@functools.cache
def stored_results():
    """Return all stored arrays by case and field."""
    with np.load(Path(__file__).with_name("stored.npz")) as file:
        found = {}
        for name in file.files:
            case, field = name.rsplit("/", 1)
            found.setdefault(case, {})[field] = file[name]
        return found


def assert_stored(case, rows, state=None, tolerance=1e-11, estimates=1e-5):
    """Compare rows and the newest part of the state after them with those stored."""
    for name, wanted in stored_results()[case].items():
        newest, field = name.startswith("newest "), name.removeprefix("newest ")
        if newest and state is None:
            continue
        found = np.asarray(getattr(state if newest else rows, field))
        if found.ndim > wanted.ndim:
            found = found[0] if newest else found[-1]
        assert found.shape == wanted.shape, name
        if field in ("corrections", "result"):
            np.testing.assert_array_equal(found, wanted, name)
            continue
        relative = 10.0 * tolerance if newest else tolerance
        if field in ("error", "position_error", "time_error"):
            relative = estimates
        # residuals are differences of numbers of size one
        least = 1e-14 if field == "error" else 1e-300
        atol = max(relative * np.max(np.abs(np.nan_to_num(wanted)), initial=0.0), least)
        np.testing.assert_allclose(found, wanted, atol=atol, err_msg=name)


@functools.partial(jax.jit, static_argnames="space")
def by_jax(system, space, c0, t, control, history, y, unknowns):
    """Return the state by the equations of a step, its base, and the residual of the tip in natural units."""
    problem = StepProblem(system, t, control, c0, history, space)
    found, scales = problem.evaluated(y), system.scales()
    return found, problem.base(unknowns) / scales.y, found.tip / scales.tip


def assert_solved(robot, settings, controls, past, rows, state):
    """All rows solve the equations of their steps, evaluated in JAX, and the state after them is theirs."""
    steps, ny, scale = StepCoefficients.of(settings, DT), robot.y_layout.size, np.asarray(robot.scales().y)
    solved, records, rate = zip(*rows.every_stage, strict=True), past.records, past.rate
    evaluate = loops.evaluator(robot, settings)
    for i, control in enumerate(controls):
        table, times = (np.reshape(part, (settings.stages, -1)) for part in steps.at(past.t0, i))
        for coefficients, (t,) in zip(table, times, strict=True):
            row, unknowns = next(solved)
            history = history_of(records, rate, coefficients, settings)
            given = coefficients[0], t, control, history
            # y at all points, which JAX would compile for long
            y = evaluate(*given, row[:, :ny]).y
            found, base, tip = by_jax(robot, settings.space, *given, y, unknowns)
            assert found.error <= 1.1e-10 and np.max(np.abs(tip)) <= 1.1e-10
            np.testing.assert_allclose(row[0, :ny] / scale, base, atol=1e-12)
            wanted = np.asarray(row_of(robot, found.y, found.records))
            np.testing.assert_allclose(row, wanted, atol=1e-11 * np.max(np.abs(wanted)))
            records = np.stack([found.records, records[0]])
            rate = coefficients[0] * records[0] + history
    pairs = [(state.records, records), (state.y[0], found.y)]
    for found, wanted in [*pairs, (state.rate, rate)] if settings.uses_rate else pairs:
        np.testing.assert_allclose(found, wanted, atol=1e-10 * np.max(np.abs(wanted)))


@pytest.mark.parametrize(
    ("name", "scheme"),
    [(PAPER, "sdirk2"), (ROUTED, "bdf-alpha"), (NETWORK, "bdf-alpha"), (COMMITTEE, "sdirk2")],
)
def test_a_robot_with_places_in_lanes(name, scheme):
    """Iterates, estimates and the state that follows are stored; rows solve their equations."""
    robot, settings, control = robot_of(name), settings_of(scheme), tensions(1)[0]
    done, state, rows = emitted(robot, settings, control)
    assert done == STEPS
    assert_stored(f"{name}, {scheme}", rows, state)
    assert_solved(robot, settings, control, resting_history(robot, settings), rows, state)


@dataclasses.dataclass(frozen=True)
class Quadratic(SpaceScheme):
    """A user's own scheme: two stages, explicit, and checked by formulas with stages that end in y."""

    order = 2
    formula = Formula((Stage(0.3, 0.0, (0.3,)), Stage(2 / 3, 0.0, (0.0, 0.0, 2 / 3))), (0.25, 0.0, 0.0, 0.75))
    check = Formula((*formula.stages, Stage(0.5, 0.5, (0.125, -0.125))), (1 / 6, 1 / 6, 0.0, 0.0, 2 / 3))


class Stretching(kc.System):
    """A bar that stretches under a load along a wave: p_s = v, n_s = q_t - load, q_s = p_st."""

    y_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(
        ("p", 1, "m", "position"), ("n", 1, "N", "force"), ("q", 1, "m/s", "velocity")
    )
    z_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(("v", 1, "1", "stretch"))
    control_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(("load", 1, "N/m", "largest load"))
    base_unknowns: ClassVar[tuple[str, ...]] = ("n",)

    damping: float = 0.5
    length: float = 1.0

    def constitutive(self, s, t, y, y_t, control):
        return jnp.eye(1), self.damping * jnp.eye(1), y[1:2] + 1.0

    def balance(self, s, t, y, y_t, z, z_t, control):
        load = control[0] * jnp.sin(1.5 * jnp.pi * s)
        return jnp.eye(3), jnp.zeros((3, 3)).at[2, 0].set(-1.0), jnp.stack([z[0], y_t[2] - load, 0.0])

    def rest(self, s):
        return jnp.stack([s, jnp.zeros(()), jnp.zeros(())]), jnp.ones(1)

    def tip(self, t, control, y, y_t):
        return y[1:2]


#: a rod with a base whose pose, and so its velocities, are controls
DRIVEN = kc.robots.SlenderRod(
    length=0.5,
    radius=0.005,
    density=1200.0,
    youngs_modulus=1e7,
    bending_damping=2e-3,
    base_end=Driven(axes=("x", "ry", "z"), position=[0.1, 0.2, 0.3]),
)
TIMES = DT * np.arange(1, STEPS + 1)[:, None]


def displacements(count=1):
    """Displacements (count, T, 6) of six legs that begin at rest."""
    return 0.01 * (1.0 - np.cos(TIMES * np.random.default_rng(5).uniform(1.0, 5.0, (count, 1, 6))))


def standing_history(robot, settings):
    """History of six legs in equilibrium."""
    y, control = unloaded_shape(robot, settings.space), np.zeros(6)
    _, y, _ = loops.solve_steps(
        robot, StepCoefficients.of(Settings(None, settings.space)), control[None], y, (0, 1)
    )
    none = no_history(robot, settings.space)
    found = loops.evaluator(robot, settings)(0.0, 0.0, control, none, y)
    return repeated_record_history(robot, settings, found.records, found.y, 0.0)


#: robots, controls, schemes in time and along the rod, and the accuracy of estimates
CASES = {
    # errors of 1e-7 m are few digits of positions
    "lobatto4, jumps": (ROUTED, tensions(1)[0], "bdf2", "lobatto4", 1e-3),
    "a single piece": (robot_of(PAPER).replace(nodes=2), tensions(1)[0], "bdf2", "lobatto2", 1e-5),
    "euler": (PAPER, tensions(1)[0], "bdf-alpha", "euler", 1e-5),
    "a user's own": (Stretching(), np.sin(4.0 * TIMES), "bdf2", Quadratic(), 1e-5),
    "B is not zero": (Stretching(), np.sin(4.0 * TIMES), "sdirk2", "lobatto4", 1e-5),
    "B is not zero, one stage": (Stretching(), np.sin(4.0 * TIMES), "bdf-alpha", "lobatto2", 1e-5),
    "moving base": (DRIVEN, np.sin(TIMES * [3.0, 2.7, 4.0]) * [0.01, 0.1, 0.01], "sdirk2", "lobatto2", 1e-5),
    "strands": (LEGS, displacements()[0], "sdirk2", "lobatto2", 1e-5),
}


@pytest.mark.parametrize("case", CASES)
def test_schemes_and_systems(case):
    """Iterates, estimates and states are stored, for every scheme and system; rows solve their equations."""
    name, controls, time, space, estimates = CASES[case]
    robot, settings = robot_of(name) if isinstance(name, str) else name, settings_of(time, space)
    past = (standing_history if name == LEGS else resting_history)(robot, settings)
    steps = StepCoefficients.of(settings, DT)
    done, state, rows = loops.solve_steps(robot, steps, controls, past, (0, STEPS))
    assert done == STEPS
    assert_stored(case, rows, state, estimates=estimates)
    assert_solved(robot, settings, controls, past, rows, state)


def test_strands_in_lanes():
    robot, settings, control = robot_of(LEGS), settings_of("sdirk2"), displacements(3)
    past, steps = standing_history(robot, settings), StepCoefficients.of(settings, DT)
    pasts = jax.tree.map(lambda leaf: np.stack([leaf] * 3), past)
    done, states, rows = loops.solve_steps(robot, steps, control, pasts, (0, STEPS))
    assert np.all(done == STEPS)
    for k in (0, 2):
        _, state, wanted = loops.solve_steps(robot, steps, control[k], past, (0, STEPS))
        np.testing.assert_allclose(rows.records[k], wanted.records, atol=1e-8 * np.max(wanted.records))
        np.testing.assert_allclose(states.records[k], state.records, atol=1e-8 * np.max(state.records))


@pytest.mark.parametrize(
    ("name", "space"),
    [(PAPER, "lobatto2"), (ROUTED, "lobatto2"), ("variable-curvature-robot", "euler"), (LEGS, "lobatto2")],
)
def test_equilibria(name, space):
    """Equilibria in turn are stored, solve their equations in JAX, and are the same in lanes."""
    robot, settings = robot_of(name), Settings(None, SCHEMES[space])
    rng = np.random.default_rng(1)
    size = 8.0 if "tension" in robot.control_layout.names else 0.05 if name == LEGS else 1.0
    controls = rng.uniform(0.0, size, (3, 4, robot.control_layout.size))
    y, none = unloaded_shape(robot, settings.space), no_history(robot, settings.space)
    for k, own in enumerate(controls):
        done, last, rows = loops.solve_steps(robot, StepCoefficients.of(settings), own, y, (0, 4))
        assert done == 4
        assert_stored(f"equilibria {k}, {name}", rows)
        found, base, tip = by_jax(robot, settings.space, 0.0, 0.0, own[-1], none, last, rows.unknowns[-1])
        assert found.error <= 1.1e-10 and np.max(np.abs(tip)) <= 1.1e-10
        np.testing.assert_allclose(last[0] / robot.scales().y, base, atol=1e-12)
        wanted = np.asarray(row_of(robot, last, found.records))
        np.testing.assert_allclose(rows.records[-1], wanted, atol=1e-11 * np.max(np.abs(wanted)))
    many = loops.solve_steps(robot, StepCoefficients.of(settings), controls, np.stack([y] * 3), (0, 4))
    np.testing.assert_array_equal(many[0], [4, 4, 4])
    np.testing.assert_allclose(many[2].records[-1], rows.records, atol=1e-8)


def test_equilibria_end_at_the_first_without_a_solution():
    robot, settings = robot_of(PAPER), Settings(None)
    controls = np.array([[5.0, 4.0, 4.0, 5.0], [1e7, 0.0, 0.0, 1e7], [5.0, 4.0, 4.0, 5.0]])
    y = unloaded_shape(robot, settings.space)
    done, last, rows = loops.solve_steps(robot, StepCoefficients.of(settings), controls, y, (0, 3))
    assert done == 1 and rows.result.tolist()[1:] == [kc.Result.NO_CONVERGENCE, kc.Result.NOT_REACHED]
    np.testing.assert_array_equal(
        last, loops.solve_steps(robot, StepCoefficients.of(settings), controls[:1], y, (0, 1))[1]
    )


class Joined(kc.robots.ParallelRobot):
    """Legs of which one begins where the force in another moves it."""

    def base(self, t, control, unknowns):
        return super().base(t, control, unknowns).at[0].add(1e-3 * unknowns[-1])


def test_options_of_newtons_method_are_numbers_of_a_run():
    """The machine code is the same, and the iterates of loose tolerances are stored."""
    robot, control = robot_of(PAPER), tensions(1)[0][:5]
    usual, loose = settings_of("bdf2"), settings_of("bdf2")
    loose = dataclasses.replace(loose, newton=NewtonOptions(1e-3, 1e-2, max_linearisations=2, patience=1))
    own = Pattern.of(robot)
    codes = (loops.core_of(own, settings, False)._functions for settings in (usual, loose))
    assert next(codes) is next(codes)
    rows = emitted(robot, loose, control, (0, 5))[2]
    # estimates take other corrections: the last ones of the loose solutions are not computed
    assert_stored("options", rows, estimates=1e-2)
    assert np.sum(rows.corrections) < np.sum(emitted(robot, usual, control, (0, 5))[2].corrections)


@pytest.mark.parametrize("kind", ["equilibrium", "bdf-alpha", "sdirk2"])
def test_one_problem_from_a_guess_with_an_offset_at_the_tip(kind):
    """An equilibrium, a step, or the second stage of a step, as in recovery."""
    robot, control = robot_of(PAPER), np.array([8.0, 5.0, 5.0, 7.0])
    settings = Settings(None) if kind == "equilibrium" else settings_of(kind)
    offset = np.random.default_rng(5).uniform(-0.02, 0.02, unknown_count(robot))
    guess, step = unloaded_shape(robot, settings.space), None
    c0, t, history = 0.0, 0.0, no_history(robot, settings.space)
    if kind != "equilibrium":
        past = emitted(robot, settings, tensions(1)[0], (0, 4))[1]
        coefficients, t = StepCoefficients.of(settings, DT).at(past.t0, 4)
        if kind == "sdirk2":
            coefficients, t = coefficients[1], t[1]
        guess, step = past.y[1], TimeStep(past, coefficients, t)
        c0, history = coefficients[0], history_of(past.records, past.rate, coefficients, settings)
    budget = Budget(60.0)
    recovery = StaticRecovery(robot, settings, guess, budget)
    if step is not None:
        recovery = StepRecovery(robot, settings, step, DT, budget)
    found = recovery.solve(control, guess, offset)
    assert found.row.error <= 1e-10
    assert_stored(f"attempt, {kind}", found.row, found.state)
    y = found.state if step is None else found.state.y[0]
    solved, *_ = by_jax(robot, settings.space, c0, t, control, history, y, found.row.unknowns)
    assert solved.error <= 1.1e-10
    np.testing.assert_allclose(solved.tip, offset, atol=1e-10)
    if step is not None:
        np.testing.assert_array_equal(found.state.y[1:], past.y[:-1])
        np.testing.assert_array_equal(found.state.records[1], past.records[0])
        assert found.state.t0 == past.t0


def past_of(robot):
    """Return records of a motion at all places."""
    return emitted(robot, settings_of("bdf2"), tensions(1)[0], (0, 3))[1].records[0]


@pytest.mark.parametrize("name", [PAPER, ROUTED])
def test_states_evaluated(name):
    """Of y at the nodes, which is completed at discontinuities, and of y at all points."""
    robot, settings = robot_of(name), settings_of("bdf2")
    grid, records = grid_of(robot), past_of(robot)
    control, points = tensions(1)[0, 0], records[: grid.tip + 1, : robot.y_layout.size]
    unknowns = np.zeros(unknown_count(robot))
    evaluate = loops.evaluator(robot, settings)
    for y in (points[grid.nodes], points):
        given = 30.0, 0.1, control, -28.0 * records, y
        wanted, found = by_jax(robot, settings.space, *given, unknowns)[0], evaluate(*given)
        for one, other in zip(wanted, found, strict=True):
            np.testing.assert_allclose(other, one, atol=1e-11 * np.max(np.abs(one)))
    assert len(grid.between) > 0 or name == PAPER


def test_a_refusal_keeps_no_frames():
    """It is raised at every step of a robot that the engine does not cover."""
    legs = robot_of(LEGS)
    robot = Joined(**{name: getattr(legs, name) for name in legs.parameters()}, nodes=legs.nodes)
    for _ in range(3):
        with pytest.raises(EngineError, match="unknowns of another") as caught:
            loops.core_of(Pattern.of(robot), settings_of("sdirk2"), robots=False)
        assert len(caught.traceback) == 3


def test_a_process_keeps_a_bounded_number_of_codes(monkeypatch):
    monkeypatch.setattr(pattern, "MOST_CODES", 3)
    monkeypatch.setattr(pattern, "_CODES", {})
    # not on disk, where objects have no names
    built, keys = [], [(object(),) for _ in range(4)]
    for k in (0, 1, 2, 0, 3, 0, 1):
        found = pattern.compiled(
            keys[k], SimpleNamespace, lambda k=k: built.append(k) or SimpleNamespace(k=k)
        )
        assert found.k == k
    # the code used least recently goes
    assert built == [0, 1, 2, 3, 1] and set(pattern._CODES) == {keys[0], keys[1], keys[3]}


def test_a_span_continues_another():
    robot, settings, control = robot_of(PAPER), settings_of("sdirk2"), tensions(1)[0]
    steps, past = StepCoefficients.of(settings, DT), resting_history(robot, settings)
    _, _, whole = loops.solve_steps(robot, steps, control, past, (0, STEPS))
    done, state, first = loops.solve_steps(robot, steps, control, past, (0, 10))
    assert done == 10
    _, _, second = loops.solve_steps(robot, steps, control, state, (10, STEPS))
    # factors are not kept from one span to the next: equal within the tolerance of a step
    np.testing.assert_allclose(first.records, whole.records[:10], atol=1e-13)
    np.testing.assert_allclose(second.records, whole.records[10:], atol=1e-8)


@pytest.mark.parametrize("scheme", ["sdirk2", "bdf2"])
def test_motions_without_estimates(scheme):
    """The solved rows are the same; errors are NaN, which is not coarse, and stay unknown."""
    robot, settings, control = robot_of(PAPER), settings_of(scheme), tensions(1)[0]
    past = resting_history(robot, settings)
    steps, unestimated = (
        StepCoefficients.of(dataclasses.replace(settings, errors=errors), DT) for errors in (True, False)
    )
    _, wanted, with_estimates = loops.solve_steps(robot, steps, control, past, (0, STEPS))
    _, state, rows = loops.solve_steps(robot, unestimated, control, past, (0, STEPS))
    for field in ("records", "unknowns", "corrections", "result", "error"):
        np.testing.assert_array_equal(getattr(rows, field), getattr(with_estimates, field), field)
    np.testing.assert_array_equal(state.y, wanted.y)
    assert np.all(np.isnan(rows.position_error)) and np.all(np.isnan(rows.time_error))
    assert np.all(np.isnan(state.error)) and not np.any(np.isnan(state.records))
    _, _, later = loops.solve_steps(robot, steps, control, state, (0, 2))
    assert np.all(np.isnan(later.position_error)) and np.max(later.error) <= 1e-10


@pytest.mark.parametrize("motion", ["smooth", "random", "still"])
def test_the_first_guess_trusts_what_was_right_before(motion):
    """Extrapolations are weighted by the third power of their errors in the newest step."""
    robot, settings = robot_of(PAPER), settings_of("bdf2")
    control = tensions(1)[0] if motion == "random" else np.full((STEPS, 4), 6.0)
    if motion == "smooth":
        control = 6.0 + 2.0 * np.sin(2.0 * TIMES) * [1.0, 0.0, 0.0, 1.0]
    before, after = (emitted(robot, settings, control, (0, steps))[1] for steps in (14, 15))
    assert np.sum(after.weights) == pytest.approx(1.0, abs=1e-12)
    extrapolated = np.tensordot(EXTRAPOLATIONS, before.y, 1)
    errors = np.max(np.abs(extrapolated - after.y[0]) / robot.scales().y, axis=(1, 2))
    trust = np.maximum(errors, 1e-12) ** -3.0
    np.testing.assert_allclose(after.weights, trust / np.sum(trust) @ EXTRAPOLATIONS, atol=1e-6)
    assert motion != "smooth" or np.argmin(errors) == 2
    assert motion != "still" or np.max(errors) < 1e-3


def test_hard_steps_are_damped():
    """Tensions between 0 and 30 N in steps of 50 ms need several linearisations and shorter corrections."""
    robot, settings, control = robot_of(PAPER), settings_of("bdf2"), tensions(1, 0.0, 30.0)[0]
    _, state, rows = emitted(robot, settings, control)
    assert np.max(rows.corrections) > 8
    assert_stored("hard", rows, tolerance=1e-9, estimates=1e-3)
    assert_solved(robot, settings, control, resting_history(robot, settings), rows, state)


def test_a_failed_step_ends_the_loop_with_the_state_before_it():
    robot, settings = robot_of(PAPER), settings_of("sdirk2")
    control = np.concatenate([tensions(1)[0][:4], np.full((STEPS - 4, 4), [1e7, 0.0, 0.0, 1e7])])
    done, state, rows = emitted(robot, settings, control)
    wanted = stored_results()["failed"]
    assert done == int(wanted["done"]) < STEPS
    assert rows.result[done] == kc.Result.NO_CONVERGENCE
    np.testing.assert_allclose(state.records[0], wanted["newest records"], atol=1e-9)
    np.testing.assert_allclose(rows.records[done - 1], wanted["records"], atol=1e-9)


@pytest.mark.parametrize("name", [PAPER, ROUTED, NETWORK])
def test_robots_in_lanes_have_their_own_parameters_and_controls(name):
    """Ten robots in lanes. Estimates of a vector stop together: they differ by their tolerance."""
    robot, settings, control = robot_of(name), settings_of("sdirk2"), tensions(10)
    moduli = np.linspace(2e9, 4e9, 10)
    systems = [robot.replace(youngs_modulus=modulus) for modulus in moduli]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *systems)
    pasts = jax.tree.map(
        lambda *leaves: np.stack(leaves), *(resting_history(each, settings) for each in systems)
    )
    steps = StepCoefficients.of(settings, DT)
    done, states, rows = loops.solve_steps(batch, steps, control, pasts, (0, STEPS))
    assert np.all(done == STEPS) and states.y.shape == pasts.y.shape
    for k in (0, 3, 9):
        past = resting_history(systems[k], settings)
        _, _, wanted = loops.solve_steps(systems[k], steps, control[k], past, (0, STEPS))
        scale = np.max(np.abs(wanted.records))
        np.testing.assert_allclose(rows.records[k], wanted.records, atol=1e-8 * scale)
        for field in ("position_error", "time_error"):
            estimate = getattr(wanted, field)
            np.testing.assert_allclose(getattr(rows, field)[k], estimate, atol=0.1 * estimate.max())
