"""Ends that turn by more than half a turn in one time step: the torque at rest is GJ times the angle / L."""

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.envs import TaskError
from knode_cosserat.robots import Assembly, RigidBody
from knode_cosserat.solvers.guess import largest_turns
from knode_cosserat.solvers.run import refuse_far_turns

ends = kc.robots.ends
L, RADIUS, E = 1.0, 0.01, 1e7
GJ = E / 2.6 * np.pi * RADIUS**4 / 2.0
TIP, BASE = {"tip_end": ends.Driven(axes=("rz",))}, {"base_end": ends.Driven(axes=("rz",))}


def shaft(**changes):
    given = {
        "length": L,
        "radius": RADIUS,
        "density": 1000.0,
        "youngs_modulus": E,
        "gravity": (0.0, 0.0, 0.0),
        "nodes": 21,
        "bending_damping": 1e-3,
    }
    return kc.robots.SlenderRod(**given | changes)


def twist(moments):
    """Return the twist (rad) between the ends, from the moments at the tip."""
    return moments[..., 2] * L / GJ


def held(*control, rows=40):
    return np.tile(np.array(control), (rows, 1))


@pytest.mark.parametrize("angle", [-4.0, 6.0, 7.0, -10.0, 20.0])
@pytest.mark.parametrize("dt", [0.05, 0.5])
def test_a_shaft_keeps_all_turns_of_one_step(angle, dt):
    found = kc.simulate(shaft(**TIP), held(angle), dt)
    # 21 nodes: 2 % for a radian from node to node
    assert twist(found.moment[-1, -1]) == pytest.approx(angle, rel=0.025)
    assert np.all(found.result >= 0)


@pytest.mark.parametrize("scheme", ["bdf1", "bdf2", "bdf-alpha"])
def test_other_schemes_keep_them_too(scheme):
    found = kc.simulate(shaft(**TIP), held(7.0), 0.05, time=scheme)
    assert twist(found.moment[-1, -1]) == pytest.approx(7.0, rel=0.01)


@pytest.mark.parametrize(
    ("parts", "control", "expected"),
    [
        (BASE | {"tip_end": ends.Clamped()}, [7.0], -7.0),
        (BASE | {"tip_end": ends.Universal()}, [7.0], -7.0),
        (BASE | TIP, [9.0, 2.0], -7.0),
        ({"tip_end": ends.Sliding(axes=("rz",))}, [-7.0], -7.0),
    ],
)
def test_driven_bases_and_other_tips_keep_them(parts, control, expected):
    found = kc.simulate(shaft(**parts), held(*control), 0.05)
    assert twist(found.moment[-1, -1]) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("angles", "expected"),
    [
        ([10.0] * 5 + [-4.0] * 5 + [3.0] * 40, 3.0),
        ([*(2.5 * np.arange(1, 9)), *[20.0] * 40], 20.0),
        ([*(1.5 * np.arange(1, 14)), *[19.5] * 40], 19.5),
    ],
)
def test_turns_add_up_over_jumps_and_ramps(angles, expected):
    found = kc.simulate(shaft(**TIP), np.array(angles)[:, None], 0.05)
    assert twist(found.moment[-1, -1]) == pytest.approx(expected, rel=0.025)


def test_a_jump_of_a_bent_shaft_equal_equilibria():
    bent = shaft(tip_end=ends.Driven(axes=("x", "rx", "rz")), gravity=(0.0, 3.0, 0.0))
    control = [0.05, 0.3, 6.5]
    found, still = kc.simulate(bent, held(*control, rows=100), 1.0), kc.equilibrium(bent, control)
    np.testing.assert_allclose(found.moment[-1, -1], still.moment[0, -1], atol=1e-5)


def test_batches_steppers_and_runs_are_the_same():
    robot, angles = shaft(**TIP), (1.0, 7.0, -10.0)
    batch = kc.simulate(robot, np.stack([held(angle) for angle in angles]), 0.05)
    np.testing.assert_allclose(twist(batch.moment[:, -1, -1]), angles, rtol=0.01)
    stepper = kc.solvers.Stepper(robot, 0.05)
    for control in held(7.0):
        row = stepper.step(control)
    np.testing.assert_allclose(row.moment[-1], batch.moment[1, -1], rtol=1e-6, atol=1e-9)


def test_an_assembly_keeps_them_too():
    """Two halves of the shaft, joined by a body."""
    half = shaft(length=L / 2.0, nodes=10)
    driven = ends.Driven(axes=("rz",), position=(0.0, 0.0, L), orientation=(1.0, 0.0, 0.0, 0.0))
    robot = Assembly(
        rods=(
            half.replace(name="lower", tip_end=ends.Clamped(body="joint")),
            half.replace(name="upper", base_end=ends.Clamped(body="joint"), tip_end=driven),
        ),
        bodies=(RigidBody(name="joint", mass=0.01, inertia=1e-6 * np.eye(3)),),
        gravity=(0.0, 0.0, 0.0),
        nodes=11,
    )
    found = kc.simulate(robot, held(7.0), 0.05)
    assert twist(found.part("lower_m")[-1, -1]) == pytest.approx(7.0, rel=0.02)


def test_a_turn_beyond_any_part_is_one_clear_error():
    with pytest.raises(kc.SimulationError, match="turns an end too far in one step"):
        kc.simulate(shaft(**TIP, nodes=9), held(300.0), 0.05)


def test_traced_rows_after_a_far_turn_are_invalid():
    found = jax.jit(lambda controls: kc.simulate(shaft(**TIP), controls, 0.05))(
        np.array([[0.5], [1.0], [7.0], [7.0]])
    )
    assert list(found.result) == [0, 0, 0, kc.Result.NO_CONVERGENCE, kc.Result.NOT_REACHED]
    assert np.all(np.isnan(found.y[3:])) and np.all(np.isfinite(found.y[:3]))


def test_far_turns_are_refused_where_nothing_recovers_them():
    angles = np.array([[[1.0], [2.0], [3.0]], [[1.0], [7.0], [7.0]]])
    codes = refuse_far_turns(shaft(**TIP), np.zeros((2, 3), dtype=int), angles, np.zeros((2, 1)))
    assert codes.tolist() == [[0, 0, 0], [0, kc.Result.NO_CONVERGENCE, kc.Result.NOT_REACHED]]


def test_only_rods_between_ends_hold_turns():
    assert largest_turns(shaft(**BASE), np.array([7.0])) == 0.0
    assert (
        largest_turns(
            shaft(base_end=ends.Driven(axes=("x", "rx", "rz")), tip_end=ends.Clamped()),
            np.array([9.0, 3.0, 4.0]),
        )
        == 5.0
    )


def test_a_free_rod_follows_a_base_that_turns_at_once():
    found = kc.simulate(shaft(**BASE), held(7.0), 0.05)
    assert np.abs(twist(found.moment[-1, 0])) < 1e-3


def test_a_coarse_grid_names_the_turns_from_node_to_node():
    with pytest.warns(UserWarning, match=r"frames turn by up to [23]\.\d rad from node to node"):
        kc.simulate(shaft(**TIP), held(50.0), 0.05, time="bdf2")


def test_an_environment_refuses_limits_that_turn_an_end_too_far():
    limits = kc.control.ControlLimits(low=-6.0, high=6.0, rate=100.0)
    with pytest.raises(
        TaskError, match=r"turn an end by 5 rad in one period of 0.05 s; allowed is up to 1.57"
    ):
        kc.envs.make("reach", shaft(**TIP), limits=limits)
