"""The page as one self-contained text: its files, the libraries and the scene."""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any

from knode_cosserat._files.writing import replacing
from knode_cosserat.viewer.scene import Given, Point, scene

_HERE = Path(__file__).parent
#: names under which modules import each other, and their files
MODULES = {
    "three": "vendor/three.module.min.js",
    "orbit-controls": "vendor/OrbitControls.js",
    **{
        f"viewer/{name}": f"page/{name}.js"
        for name in (
            "app", "capture", "colours", "data", "hover", "legend", "link", "live", "loop", "panels", "plots",
            "readouts", "robot", "stage", "target", "triad", "tube", "units", "views",
        )
    },
}  # fmt: skip
#: security policy of the page: no network access, except to its own server in the live mode
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'; connect-src "
)


def export_scene(
    trajectories: Given, path: str | Path, *, title: str | None = None, target: Point | None = None
) -> Path:
    """Write trajectories as one HTML file that any browser opens, without a server or a network.

    Args:
        trajectories: a `Trajectory`, several, or several by name; a batch is shown as separate trajectories.
        path: the file to write.
        title: heading of the page; by default the names.
        target: position (x, y, z) in m that is marked, with the distance of every tip to it.

    Raises:
        ValueError: no trajectory, more than 12, one that has nothing to be drawn, or an impossible target.
    """
    path = Path(path)
    text = document(scene(trajectories, title, target))
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def document(shown: dict[str, Any], connects: str = "'none'") -> str:
    """The page with a scene in it; `connects` says where its security policy lets it connect to."""
    imports = {name: _data_url(file) for name, file in MODULES.items()}
    parts = {
        "TITLE": html.escape(str(shown["title"])),
        "POLICY": _POLICY + connects,
        "STYLE": _text("vendor/uPlot.min.css") + _text("page/style.css"),
        "PLOTS": _text("vendor/uPlot.iife.min.js"),
        "IMPORTS": for_script({"imports": imports}),
        "SCENE": for_script(shown),
    }
    page = _text("page/index.html")
    # replaced one after the other between marks, so that text in a scene is never taken for a mark
    pieces = page.split("@@")
    return "".join(parts[piece] if k % 2 else piece for k, piece in enumerate(pieces))


def for_script(value: Any) -> str:
    """JSON that is safe within a script of a page: nothing in it ends the script or begins a comment."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _text(file: str) -> str:
    return (_HERE / file).read_text(encoding="utf-8")


def _data_url(file: str) -> str:
    # under its own name in the browser's console, instead of its whole text
    code = (_text(file) + f"\n//# sourceURL=knode-cosserat/{file}\n").encode("utf-8")
    return "data:text/javascript;base64," + base64.b64encode(code).decode("ascii")
