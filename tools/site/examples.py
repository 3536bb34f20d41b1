"""The page of examples: every program in `examples/`, with its first line, its picture and its code."""

from __future__ import annotations

import ast

from tools.site.source import ROOT

#: pictures of those that have a page of their own elsewhere
PICTURES = {"demo": "images/learning.png", "your_own_robot": "images/own-robot-after.png"}


def page() -> str:
    """One section an example, in the order of their names."""
    files = sorted(file for file in (ROOT / "examples").glob("*.py") if not file.stem.startswith("_"))
    return "\n\n".join(_section(file.stem, file.read_text(encoding="utf-8")) for file in files)


def _section(name: str, code: str) -> str:
    said = (ast.get_docstring(ast.parse(code)) or "").splitlines()
    if not said:
        raise LookupError(f"examples/{name}.py has no docstring")
    picture = PICTURES.get(name, f"images/examples/{name}.png")
    parts = [f"## {name.replace('_', ' ').capitalize()}", said[0], f"`examples/{name}.py`"]
    if (ROOT / "docs" / picture).is_file():
        parts.append(f"![{said[0].rstrip('.')}]({picture})")
    inside = "\n".join(f"    {line}".rstrip() for line in ["```python", *code.splitlines(), "```"])
    return "\n\n".join([*parts, f'??? example "Code"\n\n{inside}'])
