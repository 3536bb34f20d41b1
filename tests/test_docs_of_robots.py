"""What docs/robots.md shows is what there is."""

import re
from pathlib import Path

import knode_cosserat as kc
from knode_cosserat.robots import ends, loads, routing, section, surroundings
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
    known = [(kind, cls) for family in families for kind, cls in kinds_of(family).items()]
    # tests have parts of their own
    kinds = {kind for kind, cls in known if cls.__module__.startswith("knode_cosserat")}
    assert not [kind for kind in {*kinds, *KINDS} - {"virtual-robot"} if f"`{kind}`" not in PAGE]
    assert not [name for name in kc.catalog() if f"`{name}`" not in PAGE]


# claims of absence

#: words by which a page says that something is not there
ABSENCE = re.compile(
    r"\b(?:is|are) (?:not (?:yet )?(?:available|supported|possible|implemented|modelled)|refused)\b"
    r"|\bno support for\b|\bunsupported\b"
)
#: claims that name a part of the package and are right: what they say is not there is another thing
RIGHT = (
    "inertia by the speed of insertion are not modelled",
    "The fluid's own mass and its flow resistance",
    "parts with states, or at places within it, are refused",
    "Friction has no linearisation",
)
#: words of users for what a control or a kind is called
SYNONYMS = {
    "insertion": ("fed", "feed", "feeding"),
    "reel": ("reels", "wound"),
    "pressure": ("chambers", "pneumatic"),
}


def there() -> set[str]:
    """Return the words for what is there: kinds of robots and parts, controls, public names."""
    families = ends.End, loads.Load, surroundings.Obstacle, section.SectionChange, routing.Routing
    names = (
        {kind for family in families for kind in kinds_of(family)} | set(KINDS) | {*kc.catalog(), *kc.__all__}
    )
    names |= {name for robot in kc.catalog() for name in kc.load_robot(robot).control_layout.names}
    words = {word for name in names for word in name.replace("_", "-").lower().split("-")} | {"reel"}
    words -= {
        "end",
        "load",
        "free",
        "robot",
        "system",
        "result",
        "save",
        "section",
        "point",
        "force",
        "field",
    }
    return words | {one for word in words for one in SYNONYMS.get(word, ())}


def wrong_claims(page: str) -> list[str]:
    """Return the sentences of a page that deny what is there."""
    sentences = (" ".join(it.split()) for it in re.split(r"(?<=[.;|])\s+", page))
    words = there()
    return [
        it
        for it in sentences
        if ABSENCE.search(it)
        and words & set(re.findall(r"[a-z]+", it.lower()))
        and not any(right in it for right in RIGHT)
    ]


def test_no_page_on_robots_denies_what_is_there():
    for name in (
        "robots",
        "kinematics",
        "how-it-works",
        "robot-file",
        "two-sections",
        "your-own-robot",
        "solver",
    ):
        page = (Path(__file__).parent.parent / "docs" / f"{name}.md").read_text(encoding="utf-8")
        assert not wrong_claims(page), name


def test_claims_of_absence_are_found():
    for claim in (
        "A rod whose length is a control (a rod fed through a hole) is not available; it is pushed.",
        "Robots on reels are refused.",
        "There is no support for a magnetic field.",
        "Concentric tubes are not yet supported.",
        "Pneumatic drives are not implemented.",
    ):
        assert wrong_claims(claim), claim
    assert not wrong_claims(
        "Robots on reels are decided by their motion. A wall that is too thin is refused."
    )


def test_figures_that_pages_cite_from_the_readme_are_there():
    root = Path(__file__).parent.parent
    readme = (root / "README.md").read_text(encoding="utf-8")
    for page in (root / "docs").glob("*.md"):
        for sentence in re.split(r"(?<=\.)\s+", page.read_text(encoding="utf-8")):
            if re.search(r"\(README\)|in the README|the README's", sentence):
                figures = re.findall(r"\d[\d,]*\.?\d*", sentence.partition("README")[0])
                assert not [it for it in figures if it not in readme], f"{page.name}: {sentence}"
