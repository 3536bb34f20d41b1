"""The source of an object, found by its path when the site is built, so that a page cannot be out of date."""

from __future__ import annotations

import ast
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[2]


def found(path: str) -> tuple[Path, int, str]:
    """File, first line and source of `package.module.Class.method`. Raises `LookupError`."""
    names = path.split(".")
    for count in range(len(names), 0, -1):
        for base in (ROOT / "src", ROOT / "hardware" / "src", ROOT):
            file = base.joinpath(*names[:count]).with_suffix(".py")
            if file.is_file():
                text = file.read_text(encoding="utf-8")
                first, last = _lines(ast.parse(text), names[count:], path)
                lines = text.splitlines()[first - 1 : last]
                return file.relative_to(ROOT), first, textwrap.dedent("\n".join(lines))
    raise LookupError(f"there is no module for {path}")


def _lines(tree: ast.AST, names: list[str], path: str) -> tuple[int, int]:
    """The first and last line of what has these names within each other."""
    if not names:
        raise LookupError(f"{path} is a module; name something in it")
    first = last = 0
    for name in names:
        inside = [each for each in ast.iter_child_nodes(tree) if name in _named(each)]
        if not inside:
            raise LookupError(f"there is no {name!r} in {path}")
        tree = inside[-1]
        decorators = getattr(tree, "decorator_list", [])
        first = min([tree.lineno, *(each.lineno for each in decorators)])  # type: ignore[attr-defined]
        last = tree.end_lineno  # type: ignore[attr-defined]
    return first, last


def _named(node: ast.AST) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [target.id for target in targets if isinstance(target, ast.Name)]


def blocks(paths: list[str]) -> str:
    """Highlighted blocks of source, each with its file and line as a title."""
    made = []
    for path in paths:
        file, line, code = found(path)
        made.append(f'```python title="{file.as_posix()}, line {line}"\n{code}\n```')
    return "\n\n".join(made)
