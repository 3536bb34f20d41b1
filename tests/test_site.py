"""What the site is made of: sources by path, the reference of robot files, pages of the API, equations."""

import inspect
import re
import textwrap
from pathlib import Path

import pytest
import yaml

from knode_cosserat.robots import ends, loads, routing, section, surroundings
from knode_cosserat.rods.parameters import kinds_of
from knode_cosserat.rods.robot_file import KINDS
from knode_cosserat.solvers import BDFAlpha
from tools.site import api, changelog, examples, source, tables

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def test_a_source_is_that_of_the_object():
    file, line, code = source.found("knode_cosserat.schemes.time.BDFAlpha.coefficients")
    lines, first = inspect.getsourcelines(BDFAlpha.coefficients)
    assert (file.name, line) == ("time.py", first)
    assert code == textwrap.dedent("".join(lines)).rstrip()
    decorated = source.found("knode_cosserat.rods.rod.SlenderRod.section")[2]
    assert decorated.startswith("@property\ndef section") and decorated.endswith("(0.0)")


@pytest.mark.parametrize(
    "path",
    [
        "knode_cosserat.schemes.time",
        "knode_cosserat.schemes.time.BDF7",
        "knode_cosserat.schemes.time.BDFAlpha.cofficients",
        "knode_cosserat.nowhere.at_all",
    ],
)
def test_a_source_that_is_not_there_is_an_error(path):
    with pytest.raises(LookupError, match=re.escape(path)):
        source.found(path)


def test_every_source_on_a_page_is_there():
    pages = [page.read_text(encoding="utf-8") for page in DOCS.rglob("*.md")]
    found = [block for page in pages for block in re.findall(r"^```source\n(.*?)^```$", page, re.M | re.S)]
    paths = " ".join(found).split()
    assert len(paths) > 15
    for path in paths:
        assert source.found(path)[2]


def test_the_reference_has_every_name_with_its_meaning():
    page = "\n".join(made() for name, made in tables.TABLES.items() if name.startswith("robot"))
    families = ends.End, loads.Load, surroundings.Obstacle, section.SectionChange, routing.Routing
    classes = [*KINDS.values(), *(cls for family in families for cls in kinds_of(family).values())]
    # tests have parts of their own
    classes = [cls for cls in classes if cls.__module__.startswith("knode_cosserat")]
    for cls in classes:
        for name, parameter in cls.parameters().items():
            assert f"| `{name}` | {parameter.meaning} | " in page
    for kind in {cls.kind for cls in classes}:
        assert re.search(rf"^###? `{kind}`$", page, re.MULTILINE)
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    assert {line.replace("\\|", "").count("|") for line in rows} == {7}


def test_the_tables_on_the_pages_are_those_of_the_code():
    pages = [page for page in DOCS.rglob("*.md") if tables.TABLE.search(page.read_text(encoding="utf-8"))]
    assert len(pages) == len(tables.TABLES)
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert tables.filled(text) == text, f"{page.name}: python -m tools.site.tables writes it"


@pytest.mark.parametrize(
    "word", ["hysteresis", "OptiTrack", "Young's modulus", "MPC", "Vicon", "ROS 2", "friction", "workspace"]
)
def test_words_that_users_search_for_are_on_a_page(word):
    assert any(word in page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))


def test_every_public_name_is_on_one_page_of_the_api():
    shown = api.shown(DOCS / "api")
    assert sorted(shown) == sorted(api.rooms())
    assert set(api.pages(DOCS / "api")) == {f"{path}.md" for path in api.public()}
    assert all("](knode_cosserat" in api.page(room) for room in shown)


def test_main_functions_come_first_on_their_pages():
    first = api.ordered("solvers", "trajectory")[:2]
    assert [path.rsplit(".", 1)[1] for path in first] == ["simulate", "equilibrium"]
    assert api.page("identification").split("\n")[2].startswith("| [`fit`](knode_cosserat.")


def test_the_changelog_is_a_page_with_released_versions():
    page = changelog.page()
    assert page.startswith(("| version | released |", "No version has been released yet."))
    assert "## Unreleased" in page and "](docs/" not in page
    text = "## [Unreleased]\n\n- a\n\n## [0.2.0] - 2026-12-01\n\n- b\n"
    assert changelog.versions(text) == [("Unreleased", ""), ("0.2.0", "2026-12-01")]


def test_every_example_has_its_section():
    page = examples.page()
    for file in (ROOT / "examples").glob("*.py"):
        assert f"`examples/{file.name}`" in page
    assert "    ```python\n" in page


def test_the_navigation_names_every_page():
    class Loader(yaml.SafeLoader):
        pass

    nav = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), Loader)["nav"]
    named = set(re.findall(r"[\w/-]+\.md", str(nav)))
    assert {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")} <= named


def test_equations_become_mathml_but_not_in_code():
    equations = pytest.importorskip("tools.site.equations")
    page = equations.rendered("$$\ny_s = R\\,v\n$$\n\n```sh\n$$\nx\n$$\n```\n")
    assert page.count("<math") == 1 and "$$\nx\n$$" in page
