"""Make docs/notebooks/*.ipynb from the *.py beside them: `make notebooks`.

python -m tools.notebooks [NAME ...]

The text files are what is edited: cells begin with `# %%`, or `# %% [markdown]` where every line is a
comment. Cells are run here and not by Jupyter, so that no kernel is needed. Text and pictures are kept.
"""

import ast
import contextlib
import io
import json
import os
import sys
import tempfile
from base64 import b64encode
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

NOTEBOOKS = Path(__file__).parents[1] / "docs" / "notebooks"


class Cell(NamedTuple):
    kind: str  # "markdown" or "code"
    source: str
    tags: tuple[str, ...] = ()


def cells_of(text: str) -> list[Cell]:
    """The cells of a text in the percent format."""
    found: list[Cell] = []
    for part in ("\n" + text).split("\n# %%")[1:]:
        head, _, body = part.partition("\n")
        body = body.strip("\n")
        if "[markdown]" in head:
            lines = [line.removeprefix("#").removeprefix(" ") for line in body.splitlines()]
            found.append(Cell("markdown", "\n".join(lines)))
        else:
            found.append(Cell("code", body, ("parameters",) if "parameters" in head else ()))
    return found


def run(
    cells: list[Cell], folder: Path, **parameters: Any
) -> tuple[list[list[dict[str, Any]]], dict[str, Any]]:
    """Run the cells in a folder; outputs of each as Jupyter has them, and all names in the end.

    Parameters take the place of those in the cell with that tag; one that is not there is an error.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    outputs = []
    with contextlib.chdir(folder):
        for cell in cells:
            outputs.append([] if cell.kind == "markdown" else _run(cell.source, names))
            if cell.tags:
                unknown = parameters.keys() - names.keys()
                if unknown:
                    raise ValueError(f"no such parameters: {', '.join(sorted(unknown))}")
                names.update(parameters)
    return outputs, names


def _run(source: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    said, value = io.StringIO(), None
    with contextlib.redirect_stdout(said):
        exec(compile(tree, "<cell>", "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)
    found: list[dict[str, Any]] = []
    if said.getvalue():
        text = said.getvalue().splitlines(keepends=True)
        found.append({"name": "stdout", "output_type": "stream", "text": text})
    picture = getattr(value, "_repr_png_", None)
    if picture is not None:
        data = {"image/png": b64encode(_small(picture())).decode(), "text/plain": ["a figure"]}
        found.append({"data": data, "metadata": {}, "output_type": "display_data"})
    return found


def _small(png: bytes) -> bytes:
    file = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        image.convert("RGB").quantize(128, dither=Image.Dither.NONE).save(file, "png", optimize=True)
    return file.getvalue()


def notebook(cells: list[Cell], outputs: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """The notebook as it is stored."""
    stored = []
    for i, (cell, output) in enumerate(zip(cells, outputs, strict=True)):
        one: dict[str, Any] = {"cell_type": cell.kind, "id": f"cell-{i}", "metadata": {}}
        if cell.tags:
            one["metadata"]["tags"] = list(cell.tags)
        one["source"] = cell.source.splitlines(keepends=True)
        if cell.kind == "code":
            count = sum(each.kind == "code" for each in cells[: i + 1])
            one |= {"execution_count": count, "outputs": output}
        stored.append(one)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": stored, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def main() -> None:
    for source in sorted(NOTEBOOKS.glob("*.py")):
        if sys.argv[1:] and source.stem not in sys.argv[1:]:
            continue
        cells = cells_of(source.read_text(encoding="utf-8"))
        with tempfile.TemporaryDirectory() as folder:
            outputs, _ = run(cells, Path(folder))
        path = source.with_suffix(".ipynb")
        text = json.dumps(notebook(cells, outputs), indent=1, ensure_ascii=False) + "\n"
        path.write_text(text, encoding="utf-8")
        print(f"{os.path.relpath(path)}: {len(text) // 1000} kB", flush=True)


if __name__ == "__main__":
    main()
