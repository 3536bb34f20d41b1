"""Estimate of the discretisation error along motions, and warnings of states outside rod theory."""

import warnings

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.solvers.run import carried_results

LENGTH, RADIUS, MODULUS, DENSITY = 1.0, 0.005, 70e9, 2700.0
ENDS = kc.robots.ends


def shaft(nodes, axes=("x", "rx", "rz"), **options):
    """Return a horizontal shaft on a driven base, which sags by 0.8 % of its length."""
    return kc.robots.SlenderRod(
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=MODULUS,
        gravity=(-9.81, 0.0, 0.0),
        nodes=nodes,
        bending_damping=0.02,
        linear_drag=0.5,
        base_end=ENDS.Driven(axes=axes),
        **options,
    )


def turned(t, speed):
    """Return the angle of a base that reaches a speed (turns/s) in one second."""
    return 2 * np.pi * speed * (np.clip(t, 0.0, 1.0) ** 2 / 2 + np.clip(t - 1.0, 0.0, None))


def driven(kind, t):
    """Return displacement along x, rotation about x, and rotation about the shaft."""
    none, ramp = np.zeros_like(t), np.clip(t, 0.0, 1.0) ** 2
    return np.stack(
        {
            "turned": [none, none, turned(t, 5.0)],
            "swung": [none, 0.3 * np.sin(2 * np.pi * t) * ramp, none],
            "shaken and turned": [0.05 * np.sin(4 * np.pi * t) * ramp, none, turned(t, 3.0)],
            "tumbling": [none, turned(t, 0.5), none],
        }[kind],
        axis=1,
    )


def moved(rod, controls, dt, **options):
    """Simulate from the equilibrium under zero control."""
    space = options.get("space", "lobatto2")
    rest = kc.equilibrium(rod, np.zeros(rod.control_layout.size), space=space)
    return kc.simulate(rod, controls, dt, initial=rest, **options)


def off(one, fine):
    """Return the largest distance (m) of each row's nodes from those of a four times finer grid."""
    return np.linalg.norm(one.position - fine.position[:, ::4], axis=-1).max(axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("speed", "dt"),
    [
        (5.0, 0.002),
        *(
            pytest.param(*it, marks=pytest.mark.campaign)
            for it in ((1.0, 0.002), (5.0, 0.0005), (10.0, 0.005))
        ),
    ],
)
def test_the_estimate_of_a_turning_shaft_does_not_grow(speed, dt):
    t = np.arange(1, int(4.0 / dt) + 1) * dt
    motion = moved(shaft(11, axes=("rz",)), turned(t, speed)[:, None], dt, space="lobatto4")
    assert np.all(motion.position_error < 1e-5)
    assert np.all(motion.result == kc.Result.CONVERGED)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "dt"),
    [
        ("swung", 0.005),
        *(
            pytest.param(*it, marks=pytest.mark.campaign)
            for it in (("turned", 0.002), ("swung", 0.001), ("shaken and turned", 0.002), ("tumbling", 0.002))
        ),
    ],
)
def test_the_estimate_is_the_error_of_a_driven_motion(kind, dt):
    controls = driven(kind, np.arange(1, int(3.0 / dt) + 1) * dt)
    one, fine = (moved(shaft(nodes), controls, dt) for nodes in (11, 41))
    true = off(one, fine)
    # the finer grid has an error of a sixteenth of it
    late = slice(len(true) // 10, None)
    ratio = one.position_error[late] / true[late]
    assert 0.7 < np.median(ratio) < 1.5
    assert np.max(one.position_error) < 2.0 * np.max(true)
    assert np.all(one.result == kc.Result.CONVERGED)


@pytest.mark.campaign
def test_the_estimate_of_a_shaft_between_two_driven_chucks():
    t = np.arange(1, 1501) * 0.002
    angle = turned(t, 3.0)[:, None] * np.ones(2)
    chuck = ENDS.Driven(axes=("rz",))
    rods = (shaft(nodes, axes=("rz",), tip_end=chuck) for nodes in (11, 41))
    one, fine = (moved(rod, angle, 0.002) for rod in rods)
    true = off(one, fine)
    late = slice(len(true) // 10, None)
    assert 0.7 < np.median(one.position_error[late] / true[late]) < 1.5
    assert np.max(one.position_error) < 3.0 * np.max(true)
    assert np.all(one.result == kc.Result.CONVERGED)


@pytest.mark.campaign
@pytest.mark.parametrize("time", ["bdf1", "bdf-alpha", "trapezoidal"])
def test_the_estimate_of_a_turning_shaft_in_other_time_schemes(time):
    controls = driven("turned", np.arange(1, 1001) * 0.002)
    motion = moved(shaft(11), controls, 0.002, time=time)
    assert np.max(motion.position_error) < 1e-3
    assert np.all(motion.result == kc.Result.CONVERGED)


@pytest.mark.campaign
def test_the_estimate_of_a_bending_plane_that_turns():
    robot = kc.load_robot("delrin-tendon-robot")
    t = np.arange(1, 2001) * 0.005
    tensions = 5.0 + 3.0 * np.sin(2 * np.pi * t[:, None] + np.arange(4) * np.pi / 2)
    one, fine = (kc.simulate(robot.replace(nodes=nodes), tensions, 0.005) for nodes in (10, 37))
    ratio = one.position_error[200:] / off(one, fine)[200:]
    assert np.min(ratio) > 0.6 and np.max(ratio) < 1.6


@pytest.mark.slow
def test_position_tolerance_of_a_turning_shaft():
    controls = turned(np.arange(1, 401) * 0.005, 5.0)[:, None]
    rest = {"position_tolerance": 1e-3}
    motion = kc.simulate(shaft(5, axes=("rz",)), controls, 0.005, **rest)
    assert motion.system.nodes <= 25
    assert np.max(motion.position_error) <= 1e-3


def coil(nodes, turns=10.0, radius=1e-3, **options):
    """Return a rod that is coiled at rest."""
    curled = kc.robots.Stretch(curvature=(2 * np.pi * turns, 0.0, 0.0))
    return kc.robots.SlenderRod(
        length=LENGTH,
        radius=radius,
        density=DENSITY,
        youngs_modulus=MODULUS,
        gravity=(0.0, 0.0, 0.0),
        nodes=nodes,
        bending_damping=0.02,
        sections=(curled,),
        **options,
    )


def test_a_coil_that_is_off_by_its_own_radius_is_coarse():
    with pytest.warns(UserWarning, match="too coarse"):
        rough = kc.equilibrium(coil(81), np.zeros(0))
    radius = LENGTH / (20 * np.pi)
    # the tip is less than 2 % of the length off, and most of the coil's radius
    tip = np.linalg.norm(rough.tip_position[0])
    assert 0.5 * radius < tip < 0.02 * LENGTH
    assert rough.position_error[0] < 0.02 * LENGTH
    assert rough.result[0] == kc.Result.COARSE
    fine = kc.equilibrium(coil(321), np.zeros(0))
    assert fine.result[0] == kc.Result.CONVERGED
    assert np.linalg.norm(fine.tip_position[0]) < 0.1 * radius


def test_a_bend_tighter_than_the_radius_allows_is_warned_of_once():
    rod = coil(41, turns=1.0, radius=0.1)
    with pytest.warns(UserWarning, match="radius × curvature reaches 0.63") as caught:
        kc.simulate(rod, np.zeros((3, 0)), 0.01, initial="unstressed")
    assert sum("outside rod theory" in str(each.message) for each in caught) == 1
    with pytest.warns(UserWarning, match="outside rod theory"):
        kc.equilibrium(rod, np.zeros(0))


@pytest.mark.parametrize("stretch", [1.1, 2.5])
def test_a_stretch_beyond_rod_theory_is_warned_of(stretch):
    E, area = 1e5, np.pi * RADIUS**2
    pull = kc.robots.loads.PointWrench(at=1.0, force=(0.0, 0.0, (stretch - 1.0) * E * area))
    rod = kc.robots.SlenderRod(
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=E,
        gravity=(0.0, 0.0, 0.0),
        nodes=11,
        loads=(pull,),
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rest = kc.equilibrium(rod, np.zeros(0))
    said = ["outside rod theory: the stretch is 2.5" in str(each.message) for each in caught]
    assert np.sum(said) == (stretch > 2.0)
    assert rest.tip_position[0, 2] == pytest.approx(stretch * LENGTH, rel=1e-6)


def test_results_that_hold_for_all_later_rows():
    codes = kc.Result
    converged, coarse, continued, halved, failed = (
        codes.CONVERGED,
        codes.COARSE,
        codes.RECOVERED_LOAD_CONTINUATION,
        codes.RECOVERED_STEP_HALVING,
        codes.NO_CONVERGENCE,
    )
    rows = np.array([
        [converged, continued, converged, halved, converged, coarse, converged, continued],
        [converged, coarse, converged, converged, failed, failed, failed, failed],
        [converged] * 8,
    ])  # fmt: skip
    carried = carried_results(rows, np.array([converged, converged, halved]))
    assert carried.tolist() == [
        [converged, continued, continued, halved, halved, coarse, coarse, coarse],
        [converged, coarse, coarse, coarse, failed, failed, failed, failed],
        [halved] * 8,
    ]
    traced = jax.jit(carried_results)(rows, np.array([converged, converged, halved]))
    assert np.array_equal(traced, carried)
