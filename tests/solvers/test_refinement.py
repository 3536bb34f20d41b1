"""Grids that choose themselves: the nodes that parts need, refinement, and no verdicts on coarse grids."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat.rods.system import ChosenNodes
from knode_cosserat.schemes.result import Verdict
from knode_cosserat.schemes.space import LOBATTO2
from knode_cosserat.solvers import refinement

ROBOTS = kc.robots
LENGTH, MODULUS, RADIUS, ARM = 0.3, 5e10, 1e-3, 0.01
EI = MODULUS * np.pi * RADIUS**4 / 4.0
ROD = {
    "length": LENGTH,
    "radius": RADIUS,
    "density": 6000.0,
    "youngs_modulus": MODULUS,
    "gravity": np.zeros(3),
    "bending_damping": 1e-4,
}
coarse_is_said = pytest.mark.filterwarnings("ignore:the grid is too coarse")


def helical(turns, **options):
    """Return a rod with one tendon that winds around it."""
    path = ROBOTS.routing.Helical(radius=ARM, phase=0.0, turns=turns)
    return ROBOTS.RoutedTendonRobot(**ROD, routing=(path,), **options)


def coil(turns, **options):
    """Return a rod that is a circle of several turns at rest."""
    curled = ROBOTS.Stretch(curvature=(2.0 * np.pi * turns / LENGTH, 0.0, 0.0))
    return ROBOTS.SlenderRod(**ROD, sections=(curled,), **options)


def tip(motion):
    return np.asarray(motion.tip_position)[-1]


@given(st.floats(-60.0, 60.0), st.integers(3, 40))
@settings(deadline=None, max_examples=30)
def test_parts_that_turn_get_nodes_and_stated_nodes_stay(turns, nodes):
    angle = 2.0 * np.pi
    robots = (
        helical(turns), coil(turns),
        ROBOTS.SlenderRod(
            **ROD,
            effects=(ROBOTS.chambers.Chambers(angles=(0.0,), offset=ARM, area=1e-6, twist=angle * turns),),
        ),
        ROBOTS.RoutedTendonRobot(
            **ROD, routing=(ROBOTS.routing.FunctionRouting(
                function=lambda part: (ARM * jnp.cos(40.0 * part), ARM * jnp.sin(40.0 * part))),),
        ),
    )  # fmt: skip
    for robot, angle in zip(robots, (*[2.0 * np.pi * abs(turns)] * 3, 40.0), strict=True):
        assert isinstance(robot.nodes, ChosenNodes)
        assert robot.winding == pytest.approx(angle, rel=1e-4)
        # a segment turns by up to 60 degrees, and with one segment less by more, but for rounding
        segments = robot.winding / (np.pi / 3.0)
        assert robot.nodes == 10 or segments - 1e-9 <= robot.nodes - 1 < segments + 1.0 + 1e-9
        stated = robot.replace(nodes=nodes)
        assert stated.nodes == nodes and not isinstance(stated.replace(gravity=np.ones(3)).nodes, ChosenNodes)
    # other parts need more; no change of the robot takes nodes away
    more = robots[0].replace(**{"routing.0.turns": 70.0})
    assert more.nodes == 421 and more.replace(**{"routing.0.turns": 1.0}).nodes == 421


@given(turns=st.sampled_from([0.5, 9.0, 18.0]), tension=st.floats(0.02, 0.2))
@settings(deadline=None, max_examples=6)
def test_a_helical_tendon_bends_the_rod_as_its_closed_form(turns, tension):
    found = kc.equilibrium(helical(turns), [tension], with_stability=False)
    # the tendon, inclined to the rod, bends it by T r/EI cos α: x'' = κ cos kσ, y'' = κ sin kσ, in lengths
    k = 2.0 * np.pi * turns
    κ = tension * ARM / EI * LENGTH**2 / np.hypot(1.0, k * ARM / LENGTH)
    x, y = κ * (1.0 - np.cos(k)) / k**2, κ * (k - np.sin(k)) / k**2
    assert found.result[0] == kc.Result.CONVERGED
    # κ/2 is the displacement by a tendon that is not wound
    assert np.linalg.norm(tip(found)[:2] - [x, y]) < 0.01 * κ


@coarse_is_said
def test_a_grid_that_skips_whole_turns_is_coarse_whatever_its_estimate():
    # at 18 turns and nine segments all nodes, and all points half-way, see the same side of the rod
    with pytest.warns(UserWarning, match="parts turn by 13 rad from node to node"):
        found = kc.equilibrium(helical(18.0, nodes=10), [5.0])
    right = tip(kc.equilibrium(helical(18.0), [5.0], with_stability=False))
    assert np.linalg.norm(tip(found) - right) > 0.03 * LENGTH
    assert found.result[0] == kc.Result.COARSE and np.isnan(found.position_error[0])
    assert found.stability[0] == Verdict.UNTESTED_GRID
    motion = kc.simulate(helical(18.0, nodes=10), [[5.0]] * 3, 0.02)
    traced = jax.jit(lambda t: kc.simulate(helical(18.0, nodes=10), t, 0.02).result)(jnp.full((3, 1), 5.0))
    for results in (motion.result, traced):
        assert np.all(np.asarray(results)[1:] == kc.Result.COARSE)


@pytest.mark.parametrize("turns", [3.0, 5.0])
def test_equilibria_are_refined_until_the_rule_holds(turns):
    robot = helical(turns)
    found = kc.equilibrium(robot, [60.0])
    assert found.result[0] == kc.Result.CONVERGED
    assert found.position_error[0] <= 0.02 * LENGTH
    fine = kc.equilibrium(helical(turns, nodes=161), [60.0], space="lobatto4", with_stability=False)
    assert np.linalg.norm(tip(found) - tip(fine)) <= 0.02 * LENGTH
    assert isinstance(found.system.nodes, ChosenNodes) and found.system.nodes >= robot.nodes
    assert f"{found.system.nodes} nodes, chosen" in str(found)
    # the robot itself stays as it is, and the refined one goes on where it was
    assert robot.nodes == helical(turns).nodes
    assert kc.equilibrium(found.system, [60.0]).system.nodes == found.system.nodes


@coarse_is_said
def test_stated_nodes_are_kept_and_coarse_is_said():
    found = kc.equilibrium(helical(3.0, nodes=10), [60.0])
    assert found.system.nodes == 10 and found.result[0] == kc.Result.COARSE
    assert found.stability[0] == Verdict.UNTESTED_GRID
    assert "chosen" not in str(found)


def test_the_default_grid_of_a_robot_that_needs_no_more_stays():
    rod = ROBOTS.SlenderRod(**(ROD | {"gravity": (0.0, 0.0, -9.81)}))
    assert kc.equilibrium(rod).system.nodes == 10
    assert kc.simulate(rod, np.zeros((5, 0)), 0.02, initial="unstressed").system.nodes == 10


@pytest.mark.parametrize("turns", [1.0, 4.0])
def test_a_coil_at_rest_is_a_circle_by_its_own_grid(turns):
    found = kc.equilibrium(coil(turns))
    assert found.result[0] == kc.Result.CONVERGED
    assert np.linalg.norm(tip(found)) < 0.02 * LENGTH
    circle = LENGTH / (2.0 * np.pi * turns)
    centre = np.asarray(found.position)[0] - [0.0, -circle, 0.0]
    np.testing.assert_allclose(np.linalg.norm(centre[:, 1:], axis=1), circle, rtol=0.1)


def test_motions_are_refined_and_go_on_on_their_grid():
    robot = helical(3.0)
    rest = kc.equilibrium(robot, [0.0])
    assert rest.system.nodes == robot.nodes
    for initial in ("unstressed", "equilibrium", rest):
        motion = kc.simulate(robot, [[60.0]] * 10, 0.02, initial=initial)
        assert motion.system.nodes > robot.nodes
        assert np.all(motion.result == kc.Result.CONVERGED)
        assert np.max(motion.position_error) <= 0.02 * LENGTH
    # an equilibrium is solved again on the finer grid: nothing moves before the tension
    still = kc.simulate(
        robot.replace(nodes=ChosenNodes(motion.system.nodes)), [[0.0]] * 3, 0.02, initial=rest
    )
    assert np.ptp(np.asarray(still.tip_position), axis=0).max() < 1e-9
    later = kc.simulate(robot, [[60.0]] * 3, 0.02, initial=motion)
    assert later.system.nodes == motion.system.nodes
    np.testing.assert_array_equal(later.y[0], motion.y[-1])


def test_robots_of_a_batch_have_one_grid():
    robots = [helical(1.0), helical(9.0), helical(3.0)]
    found = kc.equilibrium(robots, [30.0])
    assert found.system.nodes >= 55 and np.all(found.result == kc.Result.CONVERGED)
    alone = kc.equilibrium(robots[1].replace(nodes=int(found.system.nodes)), [30.0])
    np.testing.assert_allclose(found.tip_position[1, 0], tip(alone), atol=1e-9)


@coarse_is_said
def test_no_pose_is_unreachable_on_a_coarse_grid():
    wanted, limits = [0.0, -0.1, 0.28], {"low": 0.0, "high": 80.0, "starts": 2}
    refined = kc.statics.inverse_kinematics(helical(3.0), wanted, **limits)
    assert refined.result == kc.statics.Reach.UNREACHABLE
    assert refined.equilibrium.result[0] == kc.Result.CONVERGED
    stated = kc.statics.inverse_kinematics(helical(9.0, nodes=10), wanted, **limits)
    assert stated.result == kc.statics.Reach.COARSE and not stated.converged
    assert "too coarse" in kc.statics.Reach(int(stated.result)).message


@coarse_is_said
def test_a_pose_of_a_coarse_grid_is_not_reached():
    stated = helical(3.0, nodes=10)
    wanted = tip(kc.equilibrium(stated, [60.0]))
    found = kc.statics.inverse_kinematics(stated, wanted, low=0.0, high=80.0)
    assert found.position_error < 1e-6 and found.result == kc.statics.Reach.COARSE


@coarse_is_said
def test_no_stability_on_a_coarse_grid():
    stated = helical(9.0, nodes=10)
    found = kc.statics.stability(kc.equilibrium(stated, [60.0]))
    assert found.kind == "undecided" and "10 nodes is too coarse" in found.reason
    with pytest.raises(ValueError, match="stability is not tested: the grid is too coarse"):
        _ = kc.statics.configuration(stated, [60.0]).unstable
    assert not kc.statics.configuration(helical(3.0), [60.0]).unstable
    assert kc.statics.workspace(stated, [[60.0]]).result[0] == kc.Result.COARSE


@coarse_is_said
def test_a_compressed_rod_has_no_verdict_on_a_coarse_grid():
    held = {"tip_end": ROBOTS.ends.Driven(axes=("z",))}
    for nodes, verdict in ((9, Verdict.UNTESTED_GRID), (None, Verdict.STABLE)):
        found = kc.equilibrium(coil(2.0, nodes=nodes, **held), [0.02], on_failure="return")
        assert found.result[0] != kc.Result.UNSTABLE
        assert found.stability[0] == verdict


def test_traced_calls_stay_on_the_needed_grid():
    robot = helical(9.0)
    slope = jax.grad(lambda t: kc.equilibrium(robot, t[None]).tip_position[0, 1])(20.0)
    ends = [tip(kc.equilibrium(robot, [20.0 + h], with_stability=False))[1] for h in (-0.01, 0.01)]
    assert slope == pytest.approx((ends[1] - ends[0]) / 0.02, rel=1e-4)


def test_a_file_keeps_the_choice(tmp_path):
    robot = helical(9.0)
    kc.save_robot(robot, tmp_path / "robot.yaml")
    assert "nodes" not in (tmp_path / "robot.yaml").read_text()
    again = kc.load_robot(tmp_path / "robot.yaml")
    assert isinstance(again.nodes, ChosenNodes) and again.nodes == robot.nodes
    found = kc.equilibrium(helical(3.0), [60.0])
    found.save(tmp_path / "rest.nc")
    assert kc.load_trajectory(tmp_path / "rest.nc").system.nodes == found.system.nodes
    # a grid that a shape needed is stated
    kc.save_robot(found.system, tmp_path / "fine.yaml")
    assert kc.load_robot(tmp_path / "fine.yaml").nodes == found.system.nodes


def test_an_equilibrium_that_a_coarse_grid_does_not_have_is_found():
    loads = [
        ROBOTS.loads.PointWrench(at=at, force=force)
        for at, force in ((0.37, (1.6e-5, 5.1e-5, -1.12e-4)), (1.0, (1.7e-5, 8.3e-5, -2.0e-5)))
    ]
    rod = ROBOTS.SlenderRod(
        length=0.5,
        radius=2e-3,
        density=1200.0,
        youngs_modulus=7.26e5,
        gravity=(3.76, 1.27, 4.48),
        bending_damping=1e-5,
        loads=tuple(loads),
    )
    with pytest.raises(kc.SimulationError):
        kc.equilibrium(rod.replace(nodes=10), with_stability=False)
    found = kc.equilibrium(rod, with_stability=False)
    fine = kc.equilibrium(rod.replace(nodes=201), space="lobatto4", with_stability=False)
    assert found.result[0] >= 0 and found.result[0] != kc.Result.COARSE
    assert np.linalg.norm(tip(found) - tip(fine)) < 0.02 * 0.5


def test_equilibria_fail_on_two_grids_before_they_fail():
    grids = []

    def solve(robot):
        grids.append(int(robot.nodes))
        raise kc.SimulationError(0, 0.0, 1.0, kc.Result.NO_CONVERGENCE, "")

    rod = ROBOTS.SlenderRod(**ROD)
    for robot, tried in ((rod, [10, 19]), (rod.replace(nodes=10), [10])):
        grids.clear()
        with pytest.raises(kc.SimulationError, match="no solution found"):
            refinement.refine(solve, robot, LOBATTO2)
        assert grids == tried


def test_errors_that_no_grid_mends_end_the_refinement():
    grids = []

    def solve(robot):
        grids.append(int(robot.nodes))
        return refinement.Solved(robot, np.array([int(kc.Result.COARSE)]), np.array([np.nan]))

    robot = ROBOTS.SlenderRod(**ROD)
    refinement.refine(solve, robot, LOBATTO2)
    assert grids[0] == 10 and len(grids) == 2
    grids.clear()
    refinement.refine(solve, robot.replace(nodes=10), LOBATTO2)
    assert grids == [10]
