"""Controls that are held and that are continuous: orders in time, and the estimate of the error in time.

Faults are tried in five variations that were written down before they were mended: rows that are held, a step
within a motion, a sudden start from rest, a signal that is sampled, and a base that moves.
"""

import warnings

import numpy as np
import pytest
from scipy.linalg import expm

import knode_cosserat as kc
from knode_cosserat.schemes.history import StepCoefficients, history_of
from knode_cosserat.solvers import Settings
from knode_cosserat.solvers.damping import LongStepWarning

# an oscillator, whose motion under held and under linear controls is known

MATRIX = np.array([[0.0, 1.0], [-36.0, -1.2]])
INPUT = np.array([0.0, 36.0])
SPAN = 2.0


def stepped(controls, dt, scheme, between="held", start="consistent"):
    """Return the states of the oscillator (T + 1, 2) from rest, by the coefficients of a scheme."""
    settings = Settings.of(scheme, "lobatto2", start, kc.solvers.NewtonOptions(), between)
    steps, stages = StepCoefficients.of(settings, dt), settings.stages
    states, rate = [np.zeros(2), np.zeros(2)], np.zeros(2)
    before = controls[0]
    for i, control in enumerate(controls):
        table, times = (np.asarray(part) for part in steps.at(0.0, i))
        for coefficients, t in zip(table.reshape(stages, 4), times.reshape(stages), strict=True):
            part = t / dt - i if between == "linear" else 1.0
            history = history_of(states[:-3:-1], rate, coefficients, settings)
            acting = before + part * (control - before)
            states.append(np.linalg.solve(coefficients[0] * np.eye(2) - MATRIX, INPUT * acting - history))
            rate = coefficients[0] * states[-1] + history
        before = control
    return np.array(states[1::stages])


def exact(controls, dt, between="held"):
    """Return its states under held or linear controls, by the exponential of a matrix."""
    whole = np.zeros((4, 4))
    whole[:2, :2], whole[:2, 2], whole[2, 3] = MATRIX, INPUT, 1.0
    moved, state, before, states = expm(whole * dt), np.zeros(2), controls[0], [np.zeros(2)]
    for control in controls:
        first, slope = (control, 0.0) if between == "held" else (before, (control - before) / dt)
        state = (moved @ [*state, first, slope])[:2]
        states.append(state)
        before = control
    return np.array(states)


def order_of(errors):
    return np.log2(errors[-2] / errors[-1])


RANDOM = np.random.default_rng(0).normal(size=20)
#: controls of steps of dt: the held rows of 0.1 s of all runs, a step at 1 s, a sudden start
HELD = {
    "rows": lambda dt: np.repeat(RANDOM, round(0.1 / dt)),
    "step": lambda dt: (dt * (0.5 + np.arange(round(SPAN / dt))) > 1.0).astype(float),
    "sudden": lambda dt: np.ones(round(SPAN / dt)),
}


@pytest.mark.parametrize("kind", HELD)
def test_held_controls_have_order_2(kind):
    errors = []
    for dt in (0.0125, 0.00625, 0.003125):
        controls = HELD[kind](dt)
        errors.append(np.abs(stepped(controls, dt, "sdirk2") - exact(controls, dt)).max())
    assert order_of(errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("kind", ["rows", "step"])
@pytest.mark.parametrize("scheme", ["bdf2", "bdf-alpha", "trapezoidal"])
def test_multistep_schemes_answer_a_jump_half_a_step_late(scheme, kind):
    """As documented: order 1, and the exact motion half a step before."""
    dt, finer = 0.003125, 8
    controls = HELD[kind](dt)
    found, true = stepped(controls, dt, scheme), exact(np.repeat(controls, finer), dt / finer)
    late = np.concatenate([np.zeros((finer // 2, 2)), true])[: len(true) : finer]
    assert np.abs(found - late)[:, 0].max() < 0.2 * np.abs(found - true[::finer])[:, 0].max()


@pytest.mark.parametrize("scheme", ["bdf2", "bdf-alpha", "trapezoidal"])
def test_a_sudden_start_has_order_2_unless_it_is_the_papers(scheme):
    errors = {
        start: [
            np.abs(stepped(HELD["sudden"](dt), dt, scheme, start=start) - exact(HELD["sudden"](dt), dt)).max()
            for dt in (0.003125, 0.0015625)
        ]
        for start in ("consistent", "paper")
    }
    assert order_of(errors["consistent"]) == pytest.approx(2.0, abs=0.15)
    assert order_of(errors["paper"]) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("scheme", ["sdirk2", "bdf2", "bdf-alpha", "trapezoidal"])
def test_continuous_controls_have_order_2(scheme):
    finer, errors = 64, []
    for dt in (0.00625, 0.003125):
        t = np.arange(round(SPAN / dt * finer)) * dt / finer
        true = exact(np.sin(3.0 * (t + dt / finer)), dt / finer, "linear")[::finer]
        sampled = np.sin(3.0 * dt * np.arange(1, len(true)))
        errors.append(np.abs(stepped(sampled, dt, scheme, "linear") - true).max())
    assert order_of(errors) == pytest.approx(2.0, abs=0.15)


def test_the_default_is_of_order_2_and_starts_consistently():
    assert Settings().time == kc.solvers.SDIRK2() and Settings().start == "consistent"
    with pytest.raises(ValueError, match=r'between is \'cubic\'; allowed is "held" or "linear"'):
        kc.simulate(kc.load_robot("delrin-tendon-robot"), np.ones((2, 4)), 0.05, between="cubic")


# robots

DT, ROWS = 0.04, 16


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


def moved(robot, controls, dt, **options):
    """Return tips and estimates of a motion, in parts of 128 steps: one program serves all time steps."""
    state, tips, errors = "unstressed", [], [[0.0]]
    for k in range(0, len(controls), 128):
        state = kc.simulate(robot, controls[k : k + 128], dt, initial=state, **options)
        tips.append(state.tip_position[min(k, 1) :])
        errors.append(state.time_error[1:])
    return np.concatenate(tips), np.concatenate(errors)


def tensions(kind, dt):
    steps = round(DT * ROWS / dt)
    if kind == "rows":
        return np.repeat(kc.controls.random(ROWS, seed=3), round(DT / dt), axis=0)
    return kc.controls.sine(0.5, steps, dt) if kind == "sine" else kc.controls.step(2.0, steps, dt, at=4 * DT)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rows", "step", "sine"])
def test_tips_have_order_2_and_the_estimate_is_their_error(robot, kind):
    """Against 16 times finer steps than the finest, for what a user types."""
    finest = DT / 64.0
    true, _ = moved(robot, tensions(kind, finest), finest)
    errors = []
    for count in (1, 2, 4):
        tip, estimate = moved(robot, tensions(kind, DT / count), DT / count)
        off = np.linalg.norm(tip - true[:: round(64 / count)], axis=1)
        errors.append(np.sqrt(np.mean(off**2)))
        assert 1.0 / 3.0 < np.sqrt(np.mean(estimate**2)) / errors[-1] < 3.0
        assert 1.0 / 3.0 < estimate.max() / off.max() < 3.0
    assert order_of(errors) == pytest.approx(2.0, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "dt"),
    [({"youngs_modulus": 2e9}, 0.05), ({"bending_damping": 0.5}, 0.05), ({"length": 0.3}, 0.01)],
    ids=["soft", "damped", "short"],
)
def test_the_estimate_of_other_robots(robot, change, dt):
    other = robot.replace(**change)
    rows = kc.controls.random(24, seed=5, hold=3)
    true, _ = moved(other, np.repeat(rows, 16, axis=0), dt / 16)
    tip, estimate = moved(other, rows, dt)
    off = np.linalg.norm(tip - true[::16], axis=1)
    assert 1.0 / 3.0 < np.sqrt(np.mean(estimate**2) / np.mean(off**2)) < 3.0


@pytest.mark.slow
def test_a_motion_goes_on_with_its_estimate_also_from_a_file_and_step_by_step(robot, tmp_path):
    rows = kc.controls.random(12, seed=1)
    whole = kc.simulate(robot, rows, DT)
    first = kc.simulate(robot, rows[:6], DT)
    first.save(tmp_path / "first.nc")
    for begun in (first, kc.load_trajectory(tmp_path / "first.nc"), whole[:7]):
        again = kc.simulate(robot, rows[6:], DT, initial=begun)
        np.testing.assert_allclose(again.y[1:], whole.y[7:], rtol=0, atol=1e-7)
        # linearisations that are kept from step to step differ; a replay evaluates no errors in time
        known = whole.time_error[7:] if begun.final_state is not None else np.full(6, np.nan)
        np.testing.assert_allclose(again.time_error[1:], known, rtol=0.0, atol=0.02 * whole.time_error.max())
    stepper = kc.solvers.Stepper(robot, DT)
    steps = [stepper.step(row) for row in rows]
    np.testing.assert_allclose([step.y[0] for step in steps], whole.y[1:], rtol=0, atol=1e-7)
    estimates = [step.time_error[0] for step in steps]
    np.testing.assert_allclose(estimates, whole.time_error[1:], rtol=0.0, atol=0.02 * whole.time_error.max())
    assert f"in time {1e3 * whole.time_error.max():.2g} mm" in str(whole)


@pytest.mark.slow
def test_a_base_moves_without_jumps():
    """Its displacement is linear from row to row, in one run and step by step: order 2."""
    rod = kc.load_robot("soft-slender-robot")
    layout = rod.control_layout
    size, at = layout.size, layout.slice("base_z").start

    def lifted(dt):
        controls = np.zeros((round(0.64 / dt), size))
        controls[:, at] = 0.05 * np.sin(np.pi / 2 * dt * np.arange(1, len(controls) + 1) / 0.64) ** 2
        return controls

    finest = 0.64 / 512
    true, _ = moved(rod, lifted(finest), finest)
    errors = []
    for steps in (32, 64, 128):
        tip, _ = moved(rod, lifted(0.64 / steps), 0.64 / steps)
        errors.append(np.abs(tip - true[:: 512 // steps]).max())
    assert order_of(errors) == pytest.approx(2.0, abs=0.4)
    stepper = kc.solvers.Stepper(rod, 0.02, initial="unstressed")
    steps = np.array([stepper.step(row).tip_position[0] for row in lifted(0.02)[:5]])
    np.testing.assert_allclose(steps, moved(rod, lifted(0.02), 0.02)[0][1:6], rtol=0, atol=1e-8)


# steps that are longer than the motion


@pytest.mark.parametrize(
    ("name", "change", "dt"),
    [
        ("delrin-tendon-robot", {}, 2.0),
        ("delrin-tendon-robot", {"youngs_modulus": 2e10}, 0.5),
        ("delrin-tendon-robot", {"length": 0.2}, 0.1),
        ("soft-slender-robot", {}, 60.0),
        ("delrin-tendon-robot", {}, 50.0),
    ],
)
def test_steps_longer_than_the_motion_are_warned_of(name, change, dt):
    robot = kc.load_robot(name).replace(**change)
    controls = np.zeros((1, robot.control_layout.size))
    with pytest.warns(LongStepWarning, match=f"dt is {dt:g} s, longer than .* Use dt = .* or less"):
        kc.simulate(robot, controls, dt, on_failure="return", recovery_budget=0.0)


def test_steps_that_resolve_the_motion_are_not_warned_of(robot):
    with warnings.catch_warnings():
        warnings.simplefilter("error", LongStepWarning)
        kc.simulate(robot, kc.controls.sine(1.5, 8, 0.05), 0.05)
