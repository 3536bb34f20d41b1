"""What docs/robots.md shows is what there is."""

import re
from pathlib import Path

import knode_cosserat as kc
from knode_cosserat.rods import ends, loads, routing, section, surroundings
from knode_cosserat.rods.parameters import kinds_of
from knode_cosserat.rods.robot_file import KINDS, parse_robot

PAGE = (Path(__file__).parent.parent / "docs" / "robots.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_file_on_the_page_loads():
    robot = parse_robot(blocks("yaml")[0], "docs/robots.md")
    assert isinstance(robot, kc.robots.SlenderRod) and robot.control_layout.names == ("base_z", "base_ry")


def test_the_file_with_two_sections_is_that_of_its_page():
    root = Path(__file__).parent.parent
    page = (root / "docs" / "two-sections.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    assert shown == (root / "examples" / "two_sections.yaml").read_text(encoding="utf-8")
    robot = kc.load_robot(root / "examples" / "two_sections.yaml")
    assert isinstance(robot, kc.robots.RoutedTendonRobot) and robot.control_layout.size == 6
    assert robot.nodes == 17 and robot.discontinuities.places == (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)


def test_every_kind_is_on_the_page():
    families = ends.End, loads.Load, surroundings.Obstacle, section.SectionChange, routing.Routing
    kinds = {kind for family in families for kind in kinds_of(family)}
    assert not [kind for kind in {*kinds, *KINDS} - {"virtual-robot"} if f"`{kind}`" not in PAGE]
    assert not [name for name in kc.catalog() if f"`{name}`" not in PAGE]
