"""Measure the size of the code against its aims (docs/design.md).

python -m tools.budget
"""

from __future__ import annotations

import ast
import importlib
import inspect
import tokenize
import types
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
LIBRARY = ROOT / "src" / "knode_cosserat"
#: parameters of a function that a reader can keep apart
MOST_PARAMETERS = 5
#: tokens that are no code
NO_CODE = {
    tokenize.ENCODING,
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


class Budget(NamedTuple):
    """A figure and its aim."""

    name: str
    value: int
    aim: int


def lines_of(folder: Path) -> int:
    """Return the number of lines of code in a folder: no docstrings, comments and blank lines."""
    return sum(code_lines(file) for file in folder.rglob("*.py"))


def code_lines(file: Path) -> int:
    """Return the number of lines of a file that hold code."""
    with file.open("rb") as stream:
        tokens = [token for token in tokenize.tokenize(stream.readline) if token.type not in NO_CODE]
    held = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(file.read_bytes())):
        # a text that nothing takes is a docstring
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            held -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(held)


def syntax_trees(folder: Path) -> Iterator[ast.Module]:
    """Yield the syntax tree of each file of a folder."""
    for file in folder.rglob("*.py"):
        yield ast.parse(file.read_bytes())


def public_classes(folder: Path) -> int:
    """Return the number of classes at the top of modules, without those of private names."""
    return sum(
        isinstance(node, ast.ClassDef) and not node.name.startswith("_")
        for tree in syntax_trees(folder)
        for node in tree.body
    )


def long_signatures(folder: Path) -> int:
    """Return the number of functions with more than five parameters, `self` not counted."""
    count = 0
    for tree in syntax_trees(folder):
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                names = [arg.arg for arg in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
                count += len([name for name in names if name not in ("self", "cls")]) > MOST_PARAMETERS
    return count


def namespace_names() -> int:
    """Return the number of public names in the namespaces of the package."""
    package = importlib.import_module("knode_cosserat")
    spaces = [getattr(package, name) for name in package.__all__]
    names = 0
    for space in spaces:
        if isinstance(space, types.ModuleType):
            names += len(
                getattr(space, "__all__", None)
                or [
                    name
                    for name, value in vars(space).items()
                    if not name.startswith("_") and getattr(value, "__module__", None) == space.__name__
                ]
            )
    return names


def system_members() -> int:
    """Return the number of public members that the class `System` itself defines."""
    System = importlib.import_module("knode_cosserat").System
    names = {*vars(System), *inspect.get_annotations(System)}
    return sum(not name.startswith("_") for name in names)


def budgets() -> list[Budget]:
    """Return all figures."""
    return [
        Budget("lines of code of the library", lines_of(LIBRARY), 28_000),
        Budget("lines of code of hardware", lines_of(ROOT / "hardware"), 5_000),
        Budget("lines of code of studies", lines_of(ROOT / "studies"), 4_500),
        Budget("lines of code of tests", lines_of(ROOT / "tests"), 24_000),
        Budget("public classes of the library", public_classes(LIBRARY), 300),
        Budget("names in namespaces", namespace_names(), 150),
        Budget("members of System", system_members(), 14),
        Budget("functions with more than 5 parameters", long_signatures(LIBRARY), 60),
    ]


def main() -> None:
    """Print the table."""
    print(f"{'':40}{'now':>8}{'aim':>8}")
    for row in budgets():
        print(f"{row.name:40}{row.value:8,}{row.aim:8,}")


if __name__ == "__main__":
    main()
