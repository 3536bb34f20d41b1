"""Parts are where they are stated to be, and energies are those of closed forms; nothing is solved."""

import itertools

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat import figures
from knode_cosserat.figures.summary import energies_of
from knode_cosserat.robots import Drawing
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.statics.workspace import Workspace
from knode_cosserat.viewer.scene import track

pytestmark = pytest.mark.filterwarnings("error")


def rows(robot, control, **fields):
    """Rows of a robot at rest under controls (T, c), with other values of some fields of y and z."""
    control = np.atleast_2d(control)
    at = float(robot.length) * np.linspace(0.0, 1.0, robot.nodes)
    y, z = (np.stack([np.asarray(robot.rest(s)[k]) for s in at]) for k in (0, 1))
    y, z = (np.repeat(each[None], len(control), axis=0) for each in (y, z))
    for name, values in fields.items():
        for layout, packed in ((robot.y_layout, y), (robot.z_layout, z)):
            if name in layout.names:
                packed[..., layout.slice(name)] = values
    code = np.zeros(len(control), dtype=int)
    return kc.Trajectory(robot, None, np.arange(1.0 * len(control)), y, z, control, code, 0.0 * code, code)


def parts(name, control):
    robot = kc.load_robot(name)
    return robot, Drawing.of(robot).parts(np.linspace(0.0, 1.0, robot.nodes), np.atleast_2d(control))


def test_tubes_end_where_their_insertion_puts_them():
    controls = np.zeros((2, 6))
    controls[1, 1::2] = -0.02, -0.01, 0.015
    robot, shapes = parts("three-tube-robot", controls)
    assert [shape.name for shape in shapes] == ["tube 1", "tube 2", "tube 3"]
    for k, (shape, tube) in enumerate(zip(shapes, robot.tubes, strict=True)):
        assert shape.radius == pytest.approx(float(tube.radius))
        for row, control in enumerate(controls):
            end = shape.at[row].max() * float(robot.length)
            arclength, _ = robot.cross_section.arclength(robot, end, control)
            assert arclength == pytest.approx(float(robot.length) * tube.end + control[2 * k + 1], abs=1e-9)


def test_chambers_are_at_their_angles_and_have_their_pressure():
    robot, (rod, *chambers) = parts("three-chamber-arm", [1e4, 2e4, 3e4])
    (part, _) = robot.effects
    assert rod.kind == "rod" and len(chambers) == 3
    for k, shape in enumerate(chambers):
        angle = np.asarray(part.angles)[k]
        wanted = float(part.offset) * np.array([np.cos(angle), np.sin(angle), 0.0])
        np.testing.assert_allclose(shape.offset, np.broadcast_to(wanted, shape.offset.shape), atol=1e-12)
        assert shape.value == pytest.approx([1e4 * (k + 1)]) and shape.unit == "Pa"


def test_a_field_keeps_its_direction_while_the_magnets_turn_with_the_rod():
    robot, (_, field, *magnets) = parts("magnetic-catheter", [0.0, 3e-3, 0.0])
    nodes = robot.nodes
    position = np.linspace(0.0, 1.0, nodes)[None, :, None] * np.array([float(robot.length), 0.0, 0.0])
    turned = np.asarray(rotation_matrix(np.array([1.0, 0.0, 1.0, 0.0])))  # z to x
    rotation = np.broadcast_to(turned, (1, nodes, 3, 3))

    def direction(shape):
        points = shape.placed(position, rotation).offset[0]
        return (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])

    np.testing.assert_allclose(direction(field), [0.0, 1.0, 0.0], atol=1e-12)
    # the live page begins without a field
    assert [shape.kind for shape in parts("magnetic-catheter", np.zeros(3))[1][1:]] == [
        "field",
        *3 * ["magnet"],
    ]
    for magnet in magnets:
        np.testing.assert_allclose(direction(magnet), [1.0, 0.0, 0.0], atol=1e-12)


def test_figures_and_viewer_draw_the_same_points():
    motion = rows(kc.load_robot("three-chamber-arm"), np.full((2, 3), 1e4))
    shown = track(motion, "arm")
    names = [shape["name"] for shape in shown["drawing"]["shapes"]]
    assert names == ["chamber 1", "chamber 2", "chamber 3"] and {"shape0", "values"} <= set(shown["arrays"])
    seen = figures.shape(motion, count=1).axes[0]
    drawn = [each for each in seen.collections if hasattr(each, "metres")]
    assert [float(each.metres) for each in drawn] == pytest.approx([0.0125, 0.004, 0.004, 0.004])


def test_energies_are_those_of_closed_forms():
    robot = kc.robots.SlenderRod(
        length=0.5, radius=0.01, density=1000.0, youngs_modulus=1e6, bending_damping=1e-4,
        gravity=(0.0, 0.0, -9.81), loads=(kc.robots.loads.AttachedMass(mass=0.2),), nodes=11,
    )  # fmt: skip
    plain = rows(robot, np.zeros((2, 0)))
    p = np.asarray(plain.position).copy()
    p[1, :, 2] += 0.1
    motion = rows(robot, np.zeros((2, 0)), q=[0.0, 3.0, 0.0], u=[2.0, 0.0, 0.0], p=p)
    found = energies_of(motion)
    mass, EI = 1000.0 * np.pi * 1e-4 * 0.5, 1e6 * np.pi / 4.0 * 1e-8
    np.testing.assert_allclose(found["kinetic"], 0.5 * (mass + 0.2) * 9.0, rtol=1e-9)
    np.testing.assert_allclose(found["elastic"], 0.5 * EI * 4.0 * 0.5, rtol=1e-9)
    np.testing.assert_allclose(found["gravity"], [0.0, (mass + 0.2) * 9.81 * 0.1], rtol=1e-9, atol=1e-12)
    axes = {each.get_ylabel() for each in figures.summary(motion, plain).axes}
    assert {"error [mm]", "energy [J]", "tip x [m]", "time [s]"} <= axes


def test_a_comparison_has_the_instant_of_the_largest_difference():
    robot = kc.load_robot("delrin-tendon-robot")
    truth = rows(robot, np.zeros((9, 4)))
    p = np.asarray(truth.position).copy()
    p[5, :, 0] += 0.1  # 5 is not among three rows that are evenly spaced
    lines = figures.compare(truth, {"model": rows(robot, np.zeros((9, 4)), p=p)}, count=3).axes[0].get_lines()
    assert any(
        np.allclose(line.get_data_3d()[0], p[5, :, 0])
        for line in lines
        if len(p[5]) == len(line.get_data_3d()[0])
    )


def overlapping_titles(figure):
    """Pairs of axes' titles that lie on each other."""
    figure.draw_without_rendering()
    shown = [(axes, name) for axes in figure.axes for name in "xyz" if hasattr(axes, f"{name}axis")]
    titles = [getattr(axes, f"{name}axis").label for axes, name in shown]
    boxes = [(title.get_text(), title.get_window_extent()) for title in titles if title.get_text()]
    return [(a, b) for (a, one), (b, other) in itertools.combinations(boxes, 2) if one.overlaps(other)]


def test_a_workspace_has_the_colours_that_are_chosen():
    robot = kc.load_robot("delrin-tendon-robot")
    rng = np.random.default_rng(0)
    position = rng.normal(0.0, 0.1, (40, 3))
    codes = np.zeros(40, dtype=int)
    codes[0] = -1
    strain = rng.uniform(0.0, 1.0, (40, len(robot.z_layout.names)))
    found = Workspace(robot, rng.uniform(0.0, 10.0, (40, 4)), position, None, codes, np.zeros(40), strain)
    values = np.arange(40.0)
    for colour, wanted in (
        ("controls", found.controls.sum(axis=1)),
        ("reach", np.linalg.norm(position, axis=1)),
        ("u", found.peak("u")),
        (values, values),
    ):
        space, *_ = figures.workspace(found, colour).axes
        np.testing.assert_allclose(np.sort(space.collections[0].get_array()), np.sort(wanted[1:]))
        assert "convex hull" in space.get_title()
    assert not overlapping_titles(figures.workspace(found))
    with pytest.raises(ValueError, match="allowed is controls, reach"):
        figures.workspace(found, "speed")
    with pytest.raises(ValueError, match="one a sample"):
        figures.workspace(found, values[1:])
