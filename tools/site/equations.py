"""Equations between `$$` as MathML, which browsers set without a script or a font of ours."""

from __future__ import annotations

import re

from latex2mathml.converter import convert

CODE = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)
EQUATION = re.compile(r"^\$\$\n?(.*?)\n?\$\$$", re.MULTILINE | re.DOTALL)


def rendered(markdown: str) -> str:
    """A page with its equations set; those in blocks of code stay."""
    parts, at = [], 0
    for block in CODE.finditer(markdown):
        parts += [_set(markdown[at : block.start()]), block[0]]
        at = block.end()
    return "".join([*parts, _set(markdown[at:])])


def _set(text: str) -> str:
    return EQUATION.sub(
        lambda found: f'\n<div class="equation">{convert(found[1], display="block")}</div>\n', text
    )
