"""The language of sources and documentation: first words of docstrings, and phrases that are not used."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = (ROOT / "src", ROOT / "hardware" / "src", ROOT / "studies")
SOURCES = sorted(file for folder in FOLDERS for file in folder.rglob("*.py") if "vendor" not in file.parts)
#: a first line is a verb phrase or a noun phrase
FORBIDDEN = ("What", "Whether", "That", "Those", "How", "Of")
#: sentences of earlier versions that readers found hard to understand; each has a plain replacement
PHRASES = (
    "What the user may choose",
    "Whether every check",
    "Whether there is none",
    "That of an equilibrium",
    "What is shown of a solved step",
    "looked back on",
    "does not depend on what is iterated",
    "Of which nodes",
    "Whether each step's strains",
    "goes on with that needs",
    "Of how many rods alike",
    "Where its tip is held, which",
    "What a memory is by its rate",
    "What is missing after a correction",
    "Derivatives go through every solved step",
    "is stable is told",
    "recordings of a (simulated) robot",
    "does all its own set-up",
    "tendons that bend the rod and rub",
    "which way they slid",
    "not alike all along",
    "measurements are no states",
)
TEXTS = [
    *(
        file
        for folder in FOLDERS
        for file in folder.rglob("*")
        if file.suffix in (".py", ".js", ".html", ".yaml") and "vendor" not in file.parts
    ),
    *(file for file in (ROOT / "docs").rglob("*") if file.suffix in (".md", ".py", ".ipynb")),
    ROOT / "README.md",
    ROOT / "hardware" / "README.md",
]


def docstrings(file):
    """Yield the line and the docstring of a module and of its classes and functions."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "lineno", 1), text


def test_docstrings_begin_with_a_verb_or_a_noun():
    wrong = [
        f"{file.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for file in SOURCES
        for line, text in docstrings(file)
        if re.match(rf"({'|'.join(FORBIDDEN)})\b", text)
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("phrase", PHRASES)
def test_a_phrase_is_not_used(phrase):
    # a phrase may be divided by a line break
    pattern = re.compile(r"\s+".join(map(re.escape, phrase.split())))
    found = [file.relative_to(ROOT) for file in TEXTS if pattern.search(file.read_text(encoding="utf-8"))]
    assert not found
