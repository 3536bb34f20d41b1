"""Animations of motions: GIF by Pillow, which comes with matplotlib, or MP4 by ffmpeg if installed.

The background is drawn once; each frame adds the moving lines and the time to a copy of it.
"""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.writing import replacing
from knode_cosserat.figures.drawing import (
    View,
    by_label,
    checked_view,
    curves_of,
    flat_height,
    legend_above,
    valid_rows,
)
from knode_cosserat.figures.parts import draw_parts, move_parts, shapes_at
from knode_cosserat.figures.style import PALETTE, style, width_of
from knode_cosserat.rods.shapes import Shape
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from PIL.Image import Image

#: file suffixes of the supported formats
ENDINGS = (".gif", ".mp4")
#: range of frame rates (1/s), limited by perception and by the file formats
SLOWEST, FASTEST = 1.0, 50.0
#: largest number of frames: more would fill the memory
MOST_FRAMES = 5000


class _Moved(NamedTuple):
    """Lines of a robot (frames, points, d), its parts, its tip path, and the path's rows at each frame."""

    curves: list[NDArray[np.float64]]
    shapes: list[Shape]
    path: NDArray[np.float64]
    until: NDArray[np.intp]


def animate(
    trajectories: Trajectory | Mapping[str, Trajectory],
    path: str | Path,
    *,
    fps: float = 25.0,
    speed: float = 1.0,
    view: str | None = None,
    columns: int = 1,
    dpi: int = 150,
) -> Path:
    """Write an animation of one motion, or of several overlaid by label, as a GIF or MP4.

    Positions are interpolated linearly between solved rows; the robot is not drawn beside unsolved rows.

    Args:
        trajectories: one trajectory, or a dict of several; the first of several is drawn wide and pale.
        path: a name that ends in .gif or .mp4.
        fps: frames per second, 1 to 50. A GIF is limited to delays of whole hundredths of a second.
        speed: playback speed: 1 is real time, 0.5 half speed.
        view: "xyz" (in space), "xy", "xz" or "yz".
        columns: width in columns of a paper: 1 (3.5 in) or 2 (7.16 in).
        dpi: resolution (dots per inch).

    Returns:
        The path.

    Raises:
        ImportError: matplotlib is not installed.
        FileNotFoundError: an MP4 is requested and ffmpeg is not installed.
        ValueError: the path's suffix or a number is not allowed, the trajectory is a batch or has one row,
            or planar and spatial trajectories are mixed.
    """
    check_arguments(animate, locals())
    path = Path(path)
    motions = by_label(trajectories)
    seconds, delay = _timing(motions, path, fps, speed)
    with style():
        frames = _frames(motions, seconds, view, width_of(columns), dpi)
        return write_frames(frames, path, delay)


def write_frames(frames: Iterator[Image], path: Path, delay: float) -> Path:
    """Write pictures, each shown for `delay` (s), as the format of the path's suffix; return the path."""
    if path.suffix not in ENDINGS:
        raise ValueError(f"{path}: allowed for a motion is a name that ends in {', '.join(ENDINGS)}")
    with replacing(path) as temporary:
        (_write_gif if path.suffix == ".gif" else _write_mp4)(frames, temporary, delay)
    return path


def _timing(
    motions: Mapping[str, Trajectory], path: Path, fps: float, speed: float
) -> tuple[NDArray[np.float64], float]:
    """Return the times of the frames in the motion, and the display time of a frame (s)."""
    if path.suffix not in ENDINGS:
        raise ValueError(f"{path}: allowed for a motion is a name that ends in {', '.join(ENDINGS)}")
    for name, value, low, high in (("fps", fps, SLOWEST, FASTEST), ("speed", speed, 1e-3, 1e3)):
        if not low <= value <= high:
            raise ValueError(f"{name} is {value!r}; allowed is {low:g} to {high:g}")
    begin = min(float(one.time[0]) for one in motions.values())
    end = max(float(one.time[-1]) for one in motions.values())
    if not end > begin:
        raise ValueError("the trajectory has one row: nothing moves; figures.shape draws it")
    delay = max(2, round(100.0 / fps)) / 100.0 if path.suffix == ".gif" else 1.0 / fps
    count = int((end - begin) / (speed * delay) + 1e-9) + 1
    if count > MOST_FRAMES:
        raise ValueError(
            f"that is {count} pictures; allowed is up to {MOST_FRAMES}: lower fps, or raise speed"
        )
    return np.asarray(begin + speed * delay * np.arange(count), dtype=float), delay


def _moved(trajectory: Trajectory, seconds: NDArray[np.float64]) -> _Moved:
    curves, time = curves_of(trajectory), np.asarray(trajectory.time, dtype=float)
    valid_rows(curves)
    if len(time) == 1:
        time, curves = np.array([time[0], np.inf]), [np.repeat(curve, 2, axis=0) for curve in curves]
    at = np.clip(seconds, time[0], time[-1])
    row = np.clip(np.searchsorted(time, at + 1e-9, side="right") - 1, 0, len(time) - 2)
    part = ((at - time[row]) / (time[row + 1] - time[row]))[:, None, None]

    def at_frames(points: Any) -> Any:
        # exactly at a row the next row is not needed and may be unsolved
        return np.where(part < 1e-6, points[row], (1.0 - part) * points[row] + part * points[row + 1])

    path = np.asarray(trajectory.tip_position, dtype=float)
    shapes = [
        shape._replace(
            offset=at_frames(shape.offset),
            value=shape.value if np.ndim(shape.value) == 0 else np.asarray(shape.value)[row],
        )
        for shape in shapes_at(trajectory, np.arange(len(trajectory.time)))
        if len(trajectory.time) > 1
    ]
    between = [at_frames(curve) for curve in curves]
    return _Moved(
        between, shapes, path, np.searchsorted(np.asarray(trajectory.time), seconds + 1e-9, side="right")
    )


def _frames(
    motions: Mapping[str, Trajectory], seconds: NDArray[np.float64], view: str | None, width: float, dpi: int
) -> Iterator[Image]:
    """Return an iterator of the frames; invalid input raises before the first frame."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    moved = [_moved(one, seconds) for one in motions.values()]
    if len({robot.path.shape[1] for robot in moved}) > 1:
        raise ValueError("some trajectories are in a plane and some in space; allowed is one kind")
    view = checked_view(view, moved[0].path.shape[1])
    points = [each.reshape(-1, each.shape[-1]) for robot in moved for each in (*robot.curves, robot.path)]
    everything = np.concatenate(points)
    height = flat_height(everything, view, width, 0.6) + 0.3
    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    seen = View(figure, 111, view)
    seen.frame(everything, zoom=0.82)
    seen.obstacles(next(iter(motions.values())), everything)
    lines = [
        _lines(seen, label, robot, i, len(moved))
        for i, (label, robot) in enumerate(zip(motions, moved, strict=True))
    ]
    if any(motions):
        legend_above(seen.axes)
    clock = figure.text(0.01, 0.01, "", ha="left", va="bottom", animated=True)
    canvas.draw()
    # draw again after the layout has fixed the axes
    figure.set_layout_engine("none")
    canvas.draw()
    return _drawn(canvas, seen, list(zip(lines, moved, strict=True)), clock, seconds)


def _lines(seen: View, label: str, robot: _Moved, i: int, count: int) -> tuple[list[Any], list[Any], Any]:
    """Return the artists of a robot's lines, of its parts, and of its tip path."""
    under = i == 0 and count > 1
    colour = "#AAAAAA" if under else PALETTE[max(0, i - 1) % len(PALETTE)]
    width = 4.0 if under else 1.8
    nothing: list[list[float]] = [[]] * len(seen.index)
    rods = [
        seen.axes.plot(
            *nothing,
            color=colour,
            linewidth=width,
            solid_capstyle="round",
            animated=True,
            label=label if label and k == 0 else None,
        )[0]
        for k in range(len(robot.curves))
    ]
    parts = draw_parts(seen, robot.shapes, colour)
    for artist in parts:
        artist.set_animated(True)
    path = seen.axes.plot(*nothing, color=colour, linewidth=0.45 * width, alpha=0.7, animated=True)[0]
    return rods, parts, path


def _drawn(
    canvas: Any,
    seen: View,
    robots: list[tuple[tuple[list[Any], list[Any], Any], _Moved]],
    clock: Any,
    seconds: Any,
) -> Iterator[Image]:
    from PIL import Image

    background = canvas.copy_from_bbox(canvas.figure.bbox)

    def put(artist: Any, points: NDArray[np.float64]) -> None:
        (artist.set_data if seen.flat else artist.set_data_3d)(*seen.of(points))
        seen.axes.draw_artist(artist)

    for k, second in enumerate(seconds):
        canvas.restore_region(background)
        for (rods, parts, path), robot in robots:
            put(path, robot.path[: robot.until[k]])
            for rod, curve in zip(rods, robot.curves, strict=True):
                put(rod, curve[k])
            if parts and np.isfinite(robot.curves[0][k]).all():
                move_parts(seen, parts, robot.shapes, k)
                for artist in sorted(parts, key=lambda one: one.zorder):
                    if not seen.flat:
                        artist.do_3d_projection()
                    seen.axes.draw_artist(artist)
        clock.set_text(f"{second:.2f} s")
        canvas.figure.draw_artist(clock)
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def _write_gif(frames: Iterator[Image], path: Path, delay: float) -> None:
    from PIL.Image import Dither

    first = next(frames)
    second = next(frames, None)
    # one palette for all frames, so that nothing flickers
    palette = first.quantize(128)
    palette.putpalette([255 if value > 249 else value for value in palette.getpalette() or ()])
    rest = (each.quantize(palette=palette, dither=Dither.NONE) for each in frames)
    others = [] if second is None else [second.quantize(palette=palette, dither=Dither.NONE), *rest]
    palette.save(
        path, format="GIF", save_all=True, append_images=others, duration=round(1000 * delay), loop=0
    )


def _write_mp4(frames: Iterator[Image], path: Path, delay: float) -> None:
    program = shutil.which("ffmpeg")
    if program is None:
        raise FileNotFoundError(
            "an MP4 needs the program ffmpeg, which is not on the PATH; a .gif needs nothing"
        )
    first = next(frames)
    command = [
        program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24",
        "-s", f"{first.width}x{first.height}", "-r", f"{1.0 / delay:.6g}", "-i", "-",
        # the encoder requires even numbers of pixels
        "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-f", "mp4", str(path),
    ]  # fmt: skip
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said)
        assert process.stdin is not None
        try:
            process.stdin.write(first.tobytes())
            for frame in frames:
                process.stdin.write(frame.tobytes())
        except BrokenPipeError:
            pass  # its error output is more specific
        finally:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        if process.wait() != 0:
            said.seek(0)
            words = said.read().decode(errors="replace").strip().splitlines() or ["no reason given"]
            raise ValueError(f"ffmpeg could not write {path.name}: {words[-1]}")
