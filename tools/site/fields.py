"""What the source says of a class's fields, for the pages of the API: comments with `#:`, and parameters."""

from __future__ import annotations

import ast
from typing import Any

import griffe

from knode_cosserat.schemes.result import Result


class Fields(griffe.Extension):
    """Takes the comment above a field, or the unit and meaning of a parameter, for its docstring."""

    def on_attribute_instance(self, *, node: Any, attr: griffe.Attribute, **_: Any) -> None:
        """Called for every attribute as it is found in the source."""
        if attr.docstring is not None or not isinstance(node, ast.AnnAssign | ast.Assign):
            return
        said = _stated(node.value) or _commented(attr) or _result(attr)
        if said:
            attr.docstring = griffe.Docstring(said, lineno=node.lineno, parent=attr)


def _stated(value: Any) -> str:
    """Meaning, unit and range of `parameter(…)`; the meaning of `choice(…)`, `place(…)` and `part(…)`."""
    if not (isinstance(value, ast.Call) and isinstance(value.func, ast.Name)):
        return ""
    texts = [
        each.value for each in value.args if isinstance(each, ast.Constant) and isinstance(each.value, str)
    ]
    limits = {each.arg: ast.unparse(each.value) for each in value.keywords if each.arg in ("low", "high")}
    if value.func.id == "parameter" and len(texts) == 2:
        unit = f" ({texts[0]})" if texts[0] else ""
        return f"{_begun(texts[1])}{unit}, {limits['low']} to {limits['high']}."
    if value.func.id in ("choice", "part", "place") and texts:
        return f"{_begun(texts[0])}."
    return ""


def _result(attr: griffe.Attribute) -> str:
    """What a result means, in its own words."""
    is_one = attr.path == f"{Result.__module__}.Result.{attr.name}"
    return f"{_begun(Result[attr.name].message)}." if is_one else ""


def _begun(text: Any) -> str:
    return f"{text[0].upper()}{text[1:]}" if str(text).isascii() else str(text)


def _commented(attr: griffe.Attribute) -> str:
    """The lines above an attribute that begin with `#:`."""
    if attr.lineno is None:
        return ""
    lines, found = attr.lines_collection[attr.filepath], []
    at = attr.lineno - 2
    while at >= 0 and lines[at].strip().startswith("#:"):
        found.append(lines[at].strip().removeprefix("#:").strip())
        at -= 1
    text = " ".join(reversed(found))
    return f"{_begun(text)}." if text else ""
