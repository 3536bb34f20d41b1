"""Draw the moving pictures of docs/gallery.md and of README from the code on the page: `make pictures`.

python -m tools.gallery [TITLE ...]

Each section of the page has code that computes a `motion`; its picture is `images/gallery/NAME.gif`.
"""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import knode_cosserat as kc
from knode_cosserat.figures.drawing import View
from knode_cosserat.figures.parts import draw_parts, move_parts, shapes_at
from knode_cosserat.robots import Drawing

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "gallery.md"
PICTURES = PAGE.parent / "images" / "gallery"
SECTION = re.compile(r"^### (.*?)\n(.*?)(?=^##|\Z)", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PICTURE = re.compile(r"images/gallery/([a-z0-9-]+)\.gif")
#: the four of README: picture and title
FOUR = {
    "delrin-routed-tendon-robot": "tendons",
    "three-chamber-arm": "pressure chambers",
    "three-tube-robot": "concentric tubes",
    "three-finger-gripper": "gripper",
}
INK = "#33415C"


class Pictured:
    """A motion in axes without frame: rods, parts, and bodies of assemblies."""

    def __init__(self, figure: Any, place: Any, motion: kc.Trajectory) -> None:
        self.motion, self.drawing = motion, Drawing.of(motion.system)
        self.view = View(figure, place, "xyz")
        self.rows = np.arange(len(motion.time))
        self.shapes = shapes_at(motion, self.rows)
        self.parts = draw_parts(self.view, self.shapes, INK)
        curves = [np.asarray(curve) for curve in self.drawing.curves(np.asarray(motion.y))]
        self.bodies = curves[len(curves) - self.drawing.outlines :]
        self.lines = [self.view.axes.plot([], [], [], color="#8A94A6", lw=3)[0] for _ in self.bodies]
        far = [shape.offset.reshape(-1, 3) for shape in self.shapes if shape.kind not in ("field", "force")]
        points = np.concatenate(far)
        radius = max(float(np.max(shape.radius)) for shape in self.shapes if shape.kind in ("rod", "tube"))
        low, high = points.min(axis=0) - radius, points.max(axis=0) + radius
        middle, half = 0.5 * (low + high), 0.53 * np.ptp(np.stack([low, high]), axis=0).max()
        hangs = float(np.asarray(motion.system.gravity)[2]) > 0.0
        limits = [(m - half, m + half) for m in middle]
        self.view.axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2][:: -1 if hangs else 1])
        self.view.axes.set_box_aspect((1, 1, 1), zoom=1.45)
        self.view.axes.set_axis_off()

    def draw(self, row: int) -> None:
        """Move the picture to a row."""
        move_parts(self.view, self.parts, self.shapes, row)
        for artist, body in zip(self.lines, self.bodies, strict=True):
            artist.set_data_3d(*body[row].T)
        turn = 20.0 * np.sin(2.0 * np.pi * row / len(self.rows))
        self.view.axes.view_init(12, -60 + turn)


def sections() -> dict[str, str]:
    """Return the code of each section of the page by its picture, with what comes first."""
    page = PAGE.read_text(encoding="utf-8")
    first = CODE.search(page)
    assert first is not None
    found = {}
    for section in SECTION.finditer(page):
        code, picture = CODE.search(section[2]), PICTURE.search(section[2])
        if code is None or picture is None:
            raise LookupError(f"{section[1]}: a section of the gallery has a picture and code")
        found[picture[1]] = first[1] + code[1]
    return found


def motion_of(code: str) -> kc.Trajectory:
    """Return the motion that a section computes."""
    names: dict[str, Any] = {"__name__": "gallery"}
    exec(compile(code, PAGE, "exec"), names)  # our own documentation
    return names["motion"]


def write(motions: dict[str, kc.Trajectory], out: Path, size: float = 2.5, dpi: int = 88) -> Path:
    """Write one moving picture of motions side by side, titled if there are several."""
    figure = plt.figure(figsize=(size * len(motions), size * (1.0 if len(motions) == 1 else 1.08)), dpi=dpi)
    grid = figure.add_gridspec(
        1, len(motions), left=0, right=1, bottom=0, top=1 if len(motions) == 1 else 0.9, wspace=0
    )
    robots = [Pictured(figure, grid[0, k], motion) for k, motion in enumerate(motions.values())]
    for k, title in enumerate(motions):
        if len(motions) > 1:
            figure.text((k + 0.5) / len(motions), 0.93, title, ha="center", fontsize=9, color=INK)
    pictures = []
    for row in range(min(len(robot.rows) for robot in robots)):
        for robot in robots:
            robot.draw(row)
        buffer = io.BytesIO()
        figure.savefig(buffer)
        pictures.append(Image.open(buffer).convert("RGB").quantize(48, dither=Image.Dither.NONE))
    plt.close(figure)
    out.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(out, save_all=True, append_images=pictures[1:], duration=90, loop=0, optimize=True)
    print(f"{out.relative_to(ROOT)}: {out.stat().st_size // 1000} kB", flush=True)
    return out


def main() -> None:
    """Draw the pictures that are named, or all of them and the one of README."""
    wanted, codes = sys.argv[1:], sections()
    motions = {}
    for name in [name for name in codes if not wanted or name in wanted]:
        motions[name] = motion_of(codes[name])
        write({name: motions[name]}, PICTURES / f"{name}.gif")
    if set(FOUR) <= set(motions):
        write(
            {title: motions[name] for name, title in FOUR.items()},
            PICTURES.parent / "four-robots.gif",
            2.1,
            84,
        )


if __name__ == "__main__":
    main()
