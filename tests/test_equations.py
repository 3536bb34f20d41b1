"""The paper's equations: each number has one function, which docs/how-it-works.md lists."""

import importlib
import re
from pathlib import Path

import pytest

from tools.site import source

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "how-it-works.md").read_text(encoding="utf-8")
#: number, name, function of each row of the table
ROWS = re.findall(r"^\| (\d+) \| ([^|]+) \| `(knode_cosserat[\w.]+)` \|$", PAGE, re.MULTILINE)
CODE = {file: file.read_text(encoding="utf-8") for file in (ROOT / "src").rglob("*.py")}


def resolved(path):
    """Return the object with a dotted path."""
    names = path.split(".")
    for count in range(len(names) - 1, 0, -1):
        try:
            found = importlib.import_module(".".join(names[:count]))
        except ModuleNotFoundError:
            continue
        for name in names[count:]:
            found = getattr(found, name)
        return found
    raise LookupError(path)


def test_the_table_has_all_numbers_of_the_paper_once():
    assert [int(number) for number, *_ in ROWS] == list(range(1, 15))
    assert len({path for *_, path in ROWS}) == len(ROWS)


@pytest.mark.parametrize(("number", "name", "path"), ROWS, ids=[f"eq. {number}" for number, *_ in ROWS])
def test_a_docstring_has_its_number_and_name(number, name, path):
    assert f"(paper eq. {number}, {name}" in resolved(path).__doc__
    assert source.found(path)[1] > 0


@pytest.mark.parametrize("number", [number for number, *_ in ROWS])
def test_a_number_is_claimed_once(number):
    """A search of the sources for a number finds its definition, and nothing else."""
    claims = [
        f"{file.name}: {claim}"
        for file, text in CODE.items()
        for claim in re.findall(rf"\beqs?\. *(?:{number})\b.*", text)
    ]
    assert len(claims) == 1, claims


def test_there_are_no_other_numbers():
    found = {int(number) for text in CODE.values() for number in re.findall(r"\beqs?\. *(\d+)", text)}
    assert found == {int(number) for number, *_ in ROWS}
