"""Equilibria from measured positions, between held ends, and along paths through limit points."""

import numpy as np
import pytest

import knode_cosserat as kc

AXES = ("x", "y", "z", "rx", "ry", "rz")
LENGTH, WEIGHT = 1.0, 0.05 * 9.81


def cable(lengths, nodes=61):
    """A cable of so many gravity-bending lengths (EI/ρAg)^⅓ between two grippers."""
    stiffness = WEIGHT * (LENGTH / lengths) ** 3
    return kc.robots.SlenderRod(
        length=LENGTH,
        radius=0.003,
        density=0.05 / (np.pi * 0.003**2),
        youngs_modulus=1e7,
        nodes=nodes,
        bending_stiffness=np.diag([stiffness, stiffness, 0.8 * stiffness]),
        shear_stiffness=np.diag([1.0, 1.0, 1.0]) * max(1e3 * WEIGHT, 1e3 * stiffness),
        base_end=kc.robots.ends.Driven(axes=AXES),
        tip_end=kc.robots.ends.Driven(axes=AXES),
    )


def grips(distance):
    """Both ends horizontal, so far apart along x."""
    control = np.zeros(12)
    control[4] = control[10] = np.pi / 2
    control[6:9] = distance, 0.0, -LENGTH
    return control


def sagging(distance, points=9):
    """Positions that somebody might have measured: a parabola."""
    x = np.linspace(0.0, 1.0, points)
    sag = 0.45 * np.sqrt(max(1.0 - distance**2, 0.0))
    return np.stack([distance * x, 0.0 * x, -4.0 * sag * x * (1.0 - x)], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("lengths", [1, 10, 30, 50])
@pytest.mark.parametrize("distance", [0.2, 0.7, 0.999])
def test_cables_hang_between_grippers_at_any_distance(lengths, distance):
    """Measured positions and no guess at all lead to the same shape, symmetric and below the grippers."""
    robot, control = cable(lengths), grips(distance)
    seen = kc.equilibrium(robot, control, initial=sagging(distance))
    assert seen.result[0] >= 0 and seen.residual[0] < 1e-8
    np.testing.assert_allclose(seen.tip_position[0], [distance, 0.0, 0.0], atol=1e-6)
    p = seen.position[0]
    np.testing.assert_allclose(p[:, 2], p[::-1, 2], atol=1e-5)
    assert p[len(p) // 2, 2] < -0.002
    if lengths > 1:  # a stiff one has several shapes
        alone = kc.equilibrium(robot, control)
        np.testing.assert_allclose(alone.position[0], p, atol=1e-2)


def test_positions_that_are_none_are_refused_in_one_line():
    robot, control = cable(10), grips(0.7)
    for wrong, message in (
        (np.zeros((5, 2)), r"initial has shape \(5, 2\); allowed is \(M, 3\)"),
        (np.zeros((5, 3)), "that repeat"),
        (np.full((5, 3), np.nan), "not finite"),
        ("shape", "allowed is a Trajectory, or positions"),
    ):
        with pytest.raises(ValueError, match=message):
            kc.equilibrium(robot, control, initial=wrong)
    platform = kc.load_robot("six-legged-robot")
    with pytest.raises(ValueError, match="give a Trajectory"):
        kc.equilibrium(platform, np.zeros(6), initial=sagging(0.7))


@pytest.mark.slow
def test_position_tolerance_chooses_the_nodes():
    robot, pull = kc.load_robot("delrin-tendon-robot"), [30.0, 5.0, 5.0, 5.0]
    coarse, bent = (kc.equilibrium(robot, pull, position_tolerance=each) for each in (1e-2, 1e-3))
    assert coarse.system.nodes < bent.system.nodes and bent.system.nodes > robot.nodes
    assert bent.position_error[0] <= 1e-3
    fine = kc.equilibrium(robot.replace(nodes=61), pull, space="lobatto4")
    assert np.linalg.norm(bent.tip_position - fine.tip_position) < 1.5e-3
    with pytest.raises(ValueError, match="position_tolerance is -1"):
        kc.equilibrium(robot, [5.0] * 4, position_tolerance=-1)


@pytest.mark.campaign
def test_an_arch_snaps_where_the_theory_has_its_limit_point():
    """One clamp of a compressed strip is turned: a saddle-node at α = 1.7818 √(ΔL/L) (Gomez et al. 2017)."""
    shortened, turned = 0.005, 0.2
    strip = kc.robots.SlenderRod(
        length=1.0,
        radius=0.001,
        density=1e3,
        youngs_modulus=1e9,
        nodes=41,
        gravity=(0.0, 0.0, 0.0),
        shear_stiffness=np.diag([1e6] * 3),
        tip_end=kc.robots.ends.Driven(axes=("z", "rx")),
    )
    x = np.linspace(0.0, 1.0, 33)
    height = np.sqrt(shortened) / np.pi * (1.0 - np.cos(2.0 * np.pi * x))
    folds = []
    for side in (1.0, -1.0):
        shape = np.stack([0.0 * x, side * height, (1.0 - shortened) * x], axis=1)
        path = kc.statics.equilibrium_path(
            strip, [-shortened, 0.0], [-shortened, turned], initial=shape, points=60, with_stability=False
        )
        assert np.all(path.trajectory.residual < 1e-8)
        folds += [path.part[k] * turned for k in path.limit_points]
        assert path.complete or len(path.limit_points)
    assert len(folds) >= 1
    assert max(folds) == pytest.approx(1.7818 * np.sqrt(shortened), rel=0.02)
