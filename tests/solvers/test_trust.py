"""What solved equations are worth: rows that are taken back, and systems made gentler."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.surroundings import Plane
from knode_cosserat.solvers.task import Steps
from knode_cosserat.solvers.trust import agree, refuse

ROBOT = kc.load_robot("delrin-tendon-robot")


def steps(size, result=None, records=None):
    count = len(size)
    return Steps(
        np.zeros((count, 10, 25)) if records is None else records, None, np.zeros(count), np.ones(count, int),
        np.asarray(size, dtype=float), np.zeros(count, int) if result is None else np.array(result),
    )  # fmt: skip


def test_the_first_wrong_row_is_taken_back_and_all_after_it():
    found = steps([1.0, 2.0, 50.0, 3.0, 60.0])
    assert refuse(found, found.size > 30.0, kc.Result.UNSTABLE)
    wanted = [kc.Result.CONVERGED] * 2 + [kc.Result.UNSTABLE] + [kc.Result.NOT_REACHED] * 2
    assert found.result.tolist() == [int(each) for each in wanted]


def test_rows_that_failed_already_keep_their_reason():
    result = [0, int(kc.Result.NO_CONVERGENCE), int(kc.Result.NOT_REACHED)]
    found = steps([1.0, 50.0, 50.0], result)
    assert not refuse(found, found.size > 30.0, kc.Result.UNSTABLE)
    assert found.result.tolist() == result


def test_two_grids_have_to_be_solved_and_alike():
    scale = np.asarray(ROBOT.scales().y)
    records = np.zeros((3, 10, 25))
    records[..., :19] = 50.0 * scale
    near, far = records.copy(), records.copy()
    near[1, 4, 7] += 5.0 * scale[7]
    far[1, 4, 7] += 15.0 * scale[7]
    big = steps([50.0] * 3, records=records)
    assert agree(big, steps([50.0] * 3, records=near), ROBOT)
    assert not agree(big, steps([50.0] * 3, records=far), ROBOT)
    assert not agree(big, steps([50.0] * 3, [0, -1, -3], near), ROBOT)


def test_a_smooth_system_is_as_gentle_as_it_gets():
    assert ROBOT.eased(1e-3) is ROBOT


@pytest.mark.parametrize("part", [1.0, 0.1, 1e-3])
def test_easing_spreads_contact_and_friction_and_nothing_else(part):
    plane = Plane(smoothing=1e-4, slip=2e-3, friction=0.3)
    slender = kc.SlenderRod(length=0.4, radius=0.005, density=1e3, youngs_modulus=1e6, surroundings=(plane,))
    easier = slender.eased(part)
    assert float(easier.surroundings[0].smoothing) == pytest.approx(1e-4 / part)
    assert float(easier.surroundings[0].slip) == pytest.approx(2e-3 / part)
    assert float(easier.surroundings[0].friction) == 0.3 and float(easier.length) == 0.4
    rubbing = kc.RoutedTendonRobot.like(ROBOT, friction_curvature=0.2, friction_reach=0.05)
    assert float(rubbing.eased(part).friction_reach) == pytest.approx(0.05 / part)


def line(nodes, **changes):
    """A thin line that is pulled at its tip, far more than bends it."""
    pull = kc.loads.PointWrench(force=[0.1, 0.0, 1.0])
    return kc.SlenderRod(
        length=1.0, radius=5e-4, density=1150.0, youngs_modulus=2e9, bending_damping=1e-6,
        gravity=[0.0, 0.0, 0.0], nodes=nodes, loads=(pull,), **changes,
    )  # fmt: skip


@pytest.mark.campaign
def test_equilibria_on_too_long_segments_are_those_of_finer_ones():
    """Euler's segments make grow what decays along a stretched line: solved, and nowhere near its shape."""
    still = kc.equilibrium(line(41), np.zeros(0))
    assert still.result[0] == kc.Result.RECOVERED_FINER_SEGMENTS
    # along the force but for what bends where it is held: √(EI/T) of its length
    bending = np.sqrt(2e9 * np.pi / 4 * 5e-4**4 / np.hypot(0.1, 1.0))
    lag = bending * np.array([0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0)
    expected = np.array([0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0) - np.array([lag[0], 0.0, 0.0])
    np.testing.assert_allclose(still.tip_position[0], expected, atol=2e-3)


def test_a_motion_from_such_an_equilibrium_stays_there():
    robot = line(41)
    still = kc.equilibrium(robot, np.zeros(0))
    moved = kc.simulate(robot, np.zeros((5, 0)), 0.05, initial=still)
    assert np.max(np.abs(moved.tip_position - moved.tip_position[0])) < 1e-3
    assert np.max(np.abs(moved.velocity)) < 1e-2
