"""Schemes along the rod: stability and symmetry of their formulas, orders of convergence, error estimates."""

import functools
import itertools

import numpy as np
import pytest

import knode_cosserat as kc
from benchmarks.motions import soft_rod
from knode_cosserat.schemes.settings import schemes
from knode_cosserat.schemes.space import Formula, SpaceScheme, Stage

SCHEMES = {name: scheme() for name, scheme in schemes(SpaceScheme).items()}
LOBATTO = ("lobatto2", "lobatto4")
FORMULAS = {
    **{name: SCHEMES[name].formula for name in LOBATTO},
    **{f"check of {name}": SCHEMES[name].check for name in LOBATTO},
}


def amplification(formula, z):
    """R(z) by which a formula takes y' = λ y over a piece, z = h λ."""
    # every stage is a part of y at the start and a part of y at the end
    stages = [np.array([1.0, 0.0], dtype=complex), np.array([0.0, 1.0], dtype=complex)]
    for stage in formula.stages:
        rates = sum(x * z * own for x, own in zip(stage.rates, stages, strict=False))
        stages.append(np.array([1.0 - stage.end, stage.end]) + rates)
    start, end = sum(b * z * own for b, own in zip(formula.weights, stages, strict=True))
    return (1.0 + start) / (1.0 - end)


#: Radau's quadrature, of order 3, with the value at its place of the parabola through both ends and a rate
RADAU = Formula((Stage(2 / 3, 4 / 9, (2 / 9,)),), (0.25, 0.0, 0.75))
SIMPSON = Stage(0.5, 0.5, (0.125, -0.125))

TURNS = np.linspace(-1.57, 1.57, 41)
LEFT = [-size * np.exp(1j * turn) for size in np.logspace(-3, 4, 71) for turn in TURNS]


@pytest.mark.parametrize("formula", [FORMULAS[name] for name in LOBATTO], ids=LOBATTO)
def test_lobattos_formulas_are_a_stable_and_symmetric(formula):
    """Decay along a piece stays decay, and growth is its mirror image: neither becomes the other."""
    for z in LEFT:
        assert abs(amplification(formula, z)) <= 1.0 + 1e-12
        assert amplification(formula, z) * amplification(formula, -z) == pytest.approx(1.0, abs=1e-9)


def test_forward_euler_is_neither():
    formula = SCHEMES["euler"].formula
    assert max(abs(amplification(formula, z)) for z in LEFT) > 1e3
    assert abs(amplification(formula, -1.0) * amplification(formula, 1.0) - 1.0) > 0.5


@pytest.mark.parametrize(
    ("name", "order"), [("lobatto2", 2), ("check of lobatto2", 4), ("lobatto4", 4), ("check of lobatto4", 6)]
)
def test_formulas_have_their_orders(name, order):
    """R(z) agrees with exp(z) up to z^order, and the formula that checks another has a higher order."""
    z = np.array([0.4j, 0.2j])
    off = [abs(amplification(FORMULAS[name], each) - np.exp(each)) for each in z]
    assert np.log2(off[0] / off[1]) == pytest.approx(order + 1, abs=0.25)


@pytest.mark.parametrize("space", SCHEMES.values(), ids=SCHEMES)
def test_stages_of_the_check_begin_with_those_of_the_formula(space):
    """So that they are evaluated once."""
    assert space.check.stages[: len(space.formula.stages)] == space.formula.stages
    for formula in (space.formula, space.check):
        assert sum(formula.weights) == pytest.approx(1.0)
        for stage in formula.stages:  # exact for straight lines
            assert stage.end + sum(stage.rates) == pytest.approx(stage.place)


# orders of convergence, and error estimates

STEPS, DT = 40, 0.01
#: segments of the reference, by the scheme of order 4
FINEST = 48


@functools.cache
def falling():
    """A damped rod that falls from rest; its section changes between two nodes."""
    return soft_rod(0.317)


@functools.cache
def reeling():
    """A robot whose second tendon ends between two nodes."""
    routing = (kc.robots.routing.Straight(0.02, 0.0), kc.robots.routing.Straight(0.0, 0.02, end=0.63))
    return kc.robots.RoutedTendonRobot.like(kc.load_robot("delrin-tendon-robot"), routing=routing)


@functools.cache
def solved(case, space, segments):
    """Positions at the nodes, and the estimated error of each row."""
    if case in ("tendons at rest", "moving tendons"):
        robot, pull = reeling().replace(nodes=segments + 1), np.array([12.0, 9.0])
        if case == "tendons at rest":
            found = kc.equilibrium(robot, pull, space=space)
        else:
            controls = np.sin(0.1 * np.arange(1, STEPS + 1))[:, None] ** 2 * pull
            found = kc.simulate(robot, controls, 0.02, space=space, start="consistent")
    else:
        rod = falling().replace(nodes=segments + 1)
        if case == "undamped":
            rod = rod.replace(bending_damping=0.0, linear_drag=np.zeros(3))
        if case == "at rest":
            found = kc.equilibrium(rod, np.zeros(0), space=space)
        else:
            found = kc.simulate(
                rod, np.zeros((STEPS, 0)), DT, space=space, start="consistent", initial="unstressed"
            )
    assert found.all_valid
    rows = slice(0 if len(found.time) == 1 else 1, None)
    return np.asarray(found.position)[rows], np.asarray(found.position_error)[rows]


def errors(case, space, segments):
    """Largest error of a node's position in each row, and its estimate."""
    positions, estimate = solved(case, space, segments)
    exact = solved(case, "lobatto4", FINEST)[0][:, :: FINEST // segments]
    return np.linalg.norm(positions - exact, axis=-1).max(axis=1), estimate


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


QUICK = ("damped", "undamped")
CASES = [
    pytest.param(case, marks=() if case in QUICK else pytest.mark.campaign)
    for case in (*QUICK, "at rest", "tendons at rest", "moving tendons")
]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_default_has_order_2_along_the_rod(case):
    """With a discontinuity between two nodes, at rest and in motion, damped or not."""
    coarse, fine = (rms(errors(case, "lobatto2", segments)[0]) for segments in (6, 12))
    assert 1.7 < np.log2(coarse / fine) < 2.6


@pytest.mark.campaign
@pytest.mark.parametrize("case", ["damped", "undamped", "at rest", "tendons at rest", "moving tendons"])
def test_orders_along_the_rod(case):
    for space, order in (("lobatto2", 2), ("lobatto4", 4)):
        sizes = [rms(errors(case, space, segments)[0]) for segments in (6, 12, 24)]
        found = [np.log2(coarse / fine) for coarse, fine in itertools.pairwise(sizes)]
        assert found[-1] > order - 0.4, (space, found)


def assert_effective(case, space, segments):
    """The estimate is within a factor of 3 of the true error, in the rows whose error is not near zero."""
    true, estimate = errors(case, space, segments)
    large = true > 0.1 * true.max()
    ratio = estimate[large] / true[large]
    print(case, space, segments, ratio.min(), np.median(ratio), ratio.max())
    assert np.all((ratio > 0.3) & (ratio < 3.0)), ratio


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_estimated_error_of_positions(case):
    for segments in (6, 12):
        assert_effective(case, "lobatto2", segments)


@pytest.mark.campaign
@pytest.mark.parametrize("case", ["damped", "undamped", "at rest", "tendons at rest", "moving tendons"])
def test_the_estimated_error_of_the_accurate_scheme(case):
    assert_effective(case, "lobatto4", 6)


@pytest.mark.campaign
def test_no_shape_of_a_coarse_grid_is_called_converged():
    """Forward Euler's shapes under strong tension were zig-zags, and called converged."""
    robot = kc.load_robot("delrin-tendon-robot")
    tensions = np.tile(6.0, (60, 4))
    tensions[:, 0] = np.linspace(6.0, 500.0, 60)
    found = kc.simulate(robot, tensions, 0.05, on_failure="return")
    fine = kc.simulate(robot.replace(nodes=4 * (robot.nodes - 1) + 1), tensions, 0.05, on_failure="return")
    both = (found.result >= 0) & (fine.result >= 0)
    off = np.linalg.norm(found.tip_position - fine.tip_position, axis=-1)
    wrong = both & (off > 0.05 * robot.length)
    print(
        "solved", both.sum(), "off", np.nanmax(off), "estimate", np.nanmax(found.position_error), found.result
    )
    assert np.any(both) and not np.any(found.result[wrong] == kc.Result.CONVERGED)


@pytest.mark.parametrize(
    ("order", "formula", "check", "message"),
    [
        (3, RADAU, Formula((SIMPSON,), (1 / 6, 1 / 6, 2 / 3)), "stages of check do not begin with those of"),
        (4, RADAU, Formula((*RADAU.stages, SIMPSON), (1 / 6, 1 / 6, 0.0, 2 / 3)), "formula has order 3; "),
        (3, RADAU, RADAU, "check has order 3; allowed is 4 or more"),
        (
            1,
            Formula((Stage(0.5, 0.0, (0.4,)),), (0.0, 0.0, 1.0)),
            RADAU,
            "Stage.* is not consistent;",
        ),
        (1, Formula((), (1.0,)), RADAU, "a formula has 1 weights; allowed are 2: of the start, the end"),
    ],
)
def test_formulas_that_do_not_fit_are_refused(order, formula, check, message):
    """A check with other stages gave estimates of another order without a word."""
    if "not consistent" in message:
        check = Formula((*formula.stages, SIMPSON), (1 / 6, 1 / 6, 0.0, 2 / 3))
    with pytest.raises(ValueError, match=message):
        type("Wrong", (SpaceScheme,), {"order": order, "formula": formula, "check": check})
