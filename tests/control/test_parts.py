"""Plans, limits, references and quadratic programs of controllers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

import knode_cosserat as kc
from knode_cosserat.control import ControlLimits, circle, figure_eight, steps, table
from knode_cosserat.control.planning import Knots
from knode_cosserat.control.qp import QuadraticProgram, solve
from knode_cosserat.control.references import ReferenceFormatError, parse_reference

ROBOT = kc.load_robot("delrin-tendon-robot")


@given(horizon=st.integers(2, 40), data=st.data())
def test_a_plan_between_knots_is_linear_and_its_changes_are_those_of_its_controls(horizon, data):
    count = data.draw(st.integers(2, horizon))
    knots = Knots.spaced(horizon, count)
    assert knots.samples[0] == 0 and knots.samples[-1] == horizon - 1
    assert np.all(np.diff(knots.samples) >= 1)
    assert np.allclose(knots.basis.sum(axis=1), 1.0)
    plan = np.random.default_rng(horizon + 100 * count).normal(size=(count, 3))
    controls = knots.controls(plan)
    assert np.allclose(controls[list(knots.samples)], plan)
    # every change between samples is one of the rows that the rate limit is imposed on
    changes = np.diff(controls, axis=0)
    rows = (knots.changes @ plan)[1:]
    segment = np.searchsorted(knots.samples, np.arange(1, horizon), side="left") - 1
    assert np.allclose(changes, rows[segment])


def test_a_shifted_plan_has_the_same_controls_one_sample_later():
    knots = Knots.spaced(12, 12)
    plan = np.random.default_rng(0).normal(size=(12, 2))
    assert np.allclose(knots.controls(knots.shifted(plan))[:-1], knots.controls(plan)[1:])


@given(seed=st.integers(0, 1000))
def test_controls_within_limits_stay_within_their_rate(seed):
    rng = np.random.default_rng(seed)
    limits = ControlLimits(0.0, rng.uniform(1.0, 9.0, 4), rng.uniform(1.0, 50.0)).of(ROBOT)
    before = rng.uniform(limits.low, limits.high)
    found = limits.applied(rng.normal(scale=20.0, size=4), before, 0.05)
    assert np.all(found >= limits.low) and np.all(found <= limits.high)
    assert np.all(np.abs(found - before) <= limits.rate * 0.05 + 1e-12)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (ControlLimits(5.0, 3.0), "low must be below high"),
        (ControlLimits(0.0, np.inf), "must be finite"),
        (ControlLimits(0.0, [1.0, 2.0]), "allowed is a number or 4 numbers"),
        (ControlLimits(0.0, 9.0, 0.0), "rate is 0.0; allowed is a positive number"),
        (ControlLimits(1.0, 9.0, 5.0, 0.0), "safe is 0.0; allowed is from low to high"),
    ],
)
def test_wrong_limits_are_told_in_one_line(limits, message):
    with pytest.raises(ValueError, match=message):
        limits.of(ROBOT)


def test_references_begin_at_their_centre_and_reach_their_radius():
    for reference in (
        circle(0.1, 4.0),
        figure_eight(0.1, 4.0),
        parse_reference("circle:radius=0.1,period=4"),
    ):
        rows = reference.at(np.linspace(0.0, 12.0, 500))
        assert np.allclose(rows[0, :2], 0.0) and np.all(np.isnan(rows[:, 2]))
        assert abs(np.max(np.linalg.norm(rows[:, :2], axis=1)) - 0.1) < 1e-4
        # no jump of velocity at the start
        assert np.max(np.abs(np.diff(rows[:, :2], 2, axis=0))) < 1e-3
    held = steps([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]], 2.0)
    assert held.at([1.99, 2.0, 99.0])[:, 0].tolist() == [0.0, 0.1, 0.1]
    line = table([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    assert np.allclose(line.at([0.5, 7.0]), [[0.5, 1.0, 1.5], [1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("reference", "across", "centre"),
    [
        (circle(0.1, 4.0, plane="yz", centre=[0.28, 0.0, 0.02]), 0, [0.28, 0.0, 0.02]),
        (parse_reference("circle:radius=0.1,period=4,plane=yz,x=0.28,z=0.02"), 0, [0.28, 0.0, 0.02]),
        (
            parse_reference("circle:radius=10cm,period=4000 ms,rise=2s,plane=xz,z=300mm"),
            1,
            [0.0, np.nan, 0.3],
        ),
        (parse_reference("circle:radius=0.1,period=4,plane=xz,z=0.3"), 1, [0.0, np.nan, 0.3]),
        (parse_reference("eight:radius=0.1,period=4,plane=zy,y=-0.1"), 0, [np.nan, -0.1, 0.0]),
        (parse_reference("circle:radius=0.1,period=4,x=0.05,z=0.5"), 2, [0.05, 0.0, 0.5]),
        (figure_eight(0.1, 4.0, centre=[0.0, 0.1, np.nan]), 2, [0.0, 0.1, np.nan]),
    ],
)
def test_references_have_a_centre_and_a_plane(reference, across, centre):
    rows = reference.at(np.linspace(0.0, 12.0, 500))
    np.testing.assert_allclose(rows[0], centre, atol=1e-12)
    away = rows - rows[0]
    assert np.all(np.isnan(away[:, across])) if np.isnan(centre[across]) else np.all(away[:, across] == 0.0)
    assert abs(np.max(np.linalg.norm(np.delete(away, across, axis=1), axis=1)) - 0.1) < 1e-4


@pytest.mark.parametrize("plane", ["x", "xx", "xw", "xyz", ""])
def test_a_plane_has_two_axes(plane):
    with pytest.raises(ReferenceFormatError, match=f"plane is '{plane}'; allowed is two different axes"):
        circle(0.1, 4.0, plane=plane)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("square", "there is no reference 'square'; there are circle, eight"),
        ("circle:radius=0.1", "circle needs period"),
        ("circle:radius=a,period=1", "radius is 'a'; allowed is a number"),
        ("circle:radius=60kPa,period=1", "radius is '60kPa': kPa is no unit of a number in m"),
        ("circle:radius=60mm,period=1 deg", "period is '1 deg': deg is no unit of a number in s"),
        ("circle:speed=1", "circle has no option 'speed'"),
        ("circle:radius=-1,period=1", "radius is -1.0; allowed is a positive number"),
    ],
)
def test_wrong_references_are_told_in_one_line(text, message):
    with pytest.raises(ReferenceFormatError, match=message):
        parse_reference(text)


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A program may take longer on a busy machine than a period allows."""
    monkeypatch.setattr("knode_cosserat.control.qp.TIME_LIMIT", 1.0)


def test_quadratic_programs_agree_with_scipy():
    """The oracle is SLSQP, an unrelated method."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        n, m = 6, 4
        root = rng.normal(size=(n, n))
        H, g, A = root @ root.T + 0.1 * np.eye(n), rng.normal(size=n), rng.normal(size=(m, n))
        low, high = -np.ones(n), np.ones(n)
        problem = QuadraticProgram(H, g, low, high, A, -0.5 * np.ones(m), 0.5 * np.ones(m))
        x = solve(problem)
        within = [{"type": "ineq", "fun": lambda x, s=s, A=A: 0.5 - s * (A @ x)} for s in (1.0, -1.0)]
        expected = minimize(
            lambda x, H=H, g=g: 0.5 * x @ H @ x + g @ x,
            np.zeros(n),
            jac=lambda x, H=H, g=g: H @ x + g,
            bounds=list(zip(low, high, strict=True)),
            constraints=within,
            method="SLSQP",
            options={"ftol": 1e-12, "maxiter": 500},
        )
        assert np.allclose(x, expected.x, atol=1e-5)


def test_an_infeasible_program_is_not_solved_and_a_soft_row_yields():
    one = np.eye(1)
    hard = QuadraticProgram(one, np.zeros(1), -one[0], one[0], one, np.array([2.0]), np.array([3.0]))
    assert solve(hard) is None
    assert solve(hard._replace(soft=1))[0] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_soft_rows_are_violated_as_little_as_the_hard_limits_allow(unit):
    """The oracle is SLSQP. The cost is badly conditioned, as that of a plan may be."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        n, rows = 6, 5
        H = np.diag(10.0 ** rng.uniform(-6.0, 6.0, n))
        A, low, high = unit * rng.normal(size=(rows, n)), -np.ones(n), np.ones(n)
        below = unit * rng.uniform(2.0, 6.0, rows)
        problem = QuadraticProgram(
            H, rng.normal(size=n), low, high, A, below, np.full(rows, np.inf), soft=rows
        )
        x = solve(problem)
        assert np.all(np.abs(x) <= 1.0 + 1e-6)

        def violation(x, A=A, below=below):
            return float(np.sum(np.maximum(0.0, (below - A @ x) / unit) ** 2))

        least = min(
            minimize(violation, start, bounds=list(zip(low, high, strict=True)), method="SLSQP").fun
            for start in rng.uniform(-1.0, 1.0, (5, n))
        )
        assert violation(x) <= least + 1e-3 * (1.0 + least)


def test_steps_are_not_expected_and_circles_are():
    held = steps([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]], 2.0)
    assert held.expected(1.0, [0.5, 1.5])[:, 0].tolist() == [0.0, 0.0]
    assert steps([[0.0], [0.1]], 2.0, announced=True).expected(1.0, [0.5, 1.5])[:, 0].tolist() == [0.0, 0.1]
    moving = circle(0.1, 4.0)
    assert np.array_equal(moving.expected(5.0, [0.1, 1.0]), moving.at([5.1, 6.0]), equal_nan=True)
