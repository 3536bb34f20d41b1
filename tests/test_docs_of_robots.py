"""What docs/robots.md shows is what there is."""

import re
from pathlib import Path

import knode_cosserat as kc
from knode_cosserat.rods import ends, loads, routing, section, surroundings
from knode_cosserat.rods.parts import kinds_of
from knode_cosserat.rods.robot_file import KINDS, parse_robot

PAGE = (Path(__file__).parent.parent / "docs" / "robots.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def test_the_file_on_the_page_loads():
    robot = parse_robot(blocks("yaml")[0], "docs/robots.md")
    assert isinstance(robot, kc.robots.SlenderRod) and robot.control_layout.names == ("base_z", "base_ry")


def test_every_kind_is_on_the_page():
    families = ends.End, loads.Load, surroundings.Obstacle, section.SectionChange, routing.Routing
    kinds = {kind for family in families for kind in kinds_of(family)}
    assert not [kind for kind in {*kinds, *KINDS} - {"virtual-robot"} if f"`{kind}`" not in PAGE]
    assert not [name for name in kc.catalog() if f"`{name}`" not in PAGE]
