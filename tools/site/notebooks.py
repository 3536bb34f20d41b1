"""Notebooks as they are stored, with what they printed and drew; nothing is run when the site is built."""

from __future__ import annotations

import html
import json
import re
from typing import Any

from tools.site.source import ROOT


def page(name: str) -> str:
    """One notebook, its headings one level down, and where to get it."""
    file = ROOT / "docs" / "notebooks" / f"{name}.ipynb"
    cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
    shown = [_cell(cell, name) for cell in cells]
    return "\n\n".join([*shown[:1], f"[`{file.name}`](notebooks/{file.name})", *shown[1:]])


def _cell(cell: Any, name: str) -> str:
    text = "".join(cell["source"])
    if cell["cell_type"] == "markdown":
        text = re.sub(r"^#", "##", text, flags=re.MULTILINE)
        # from beside the notebook to beside the page
        text = re.sub(r"\]\((?!https?:|\.\./|#)", "](notebooks/", text)
        return text.replace("](../", "](")
    parts = [f"```python\n{text}\n```"]
    for output in cell.get("outputs", ()):
        if "text" in output:
            parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
        data = output.get("data", {})
        if "image/png" in data:
            picture = "".join(data["image/png"]).replace("\n", "")
            alt = html.escape(f"figure of the notebook {name.replace('_', ' ')}")
            parts.append(f'<img alt="{alt}" src="data:image/png;base64,{picture}">')
        elif "text/plain" in data:
            parts.append(f"```text\n{''.join(data['text/plain']).rstrip()}\n```")
    return "\n\n".join(parts)
