"""Draw the moving picture of README: four robots of the catalog along a loop of their controls.

python -m tools.four_robots [FILE]
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import knode_cosserat as kc
from knode_cosserat.rotation import rotation_matrix

OUT = Path(__file__).parents[1] / "docs" / "images" / "four-robots.gif"
FRAMES = 48
PHASE = np.linspace(0.0, 2.0 * np.pi, FRAMES, endpoint=False)
BODY, DARK, DRIVE = "#9aa7c7", "#33415c", "#d1495b"


def shapes(name: str, controls: np.ndarray) -> kc.Trajectory:
    """Return the equilibria of a robot of the catalog."""
    return kc.solvers.equilibria(kc.load_robot(name), controls)


def frames(motion: kc.Trajectory, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3) of the nodes, in mm, and the rotation matrices (N, 3, 3) there."""
    rotation = np.stack([np.asarray(rotation_matrix(h)) for h in np.asarray(motion.quaternion[row])])
    return 1e3 * np.asarray(motion.position[row]), rotation


def line(axes: Any, points: np.ndarray, **style: Any) -> None:
    """Draw a line through points (N, 3); z points down the robot that hangs."""
    axes.plot(*points.T, solid_capstyle="round", **style)


def beside(p: np.ndarray, R: np.ndarray, angle: float, offset: float) -> np.ndarray:
    """Return the points of a line beside the rod, at an offset (mm) and an angle (rad) in the section."""
    return p + R @ (offset * np.array([np.cos(angle), np.sin(angle), 0.0]))


def tendon_arm(motion: Any, axes: Any, row: int) -> None:
    """Draw backbone, tendons coloured by tension, and ribs."""
    p, R = frames(motion, row)
    robot, tension = motion.system, np.asarray(motion.control[row])
    line(axes, p, color=DARK, lw=2.5)
    for angle, pull in zip(np.asarray(robot.tendon_angles), tension, strict=True):
        points = beside(p, R, angle, 1e3 * float(robot.tendon_offset))
        line(axes, points, color=DRIVE, lw=0.5 + 0.2 * pull, alpha=0.9)
    turn = np.linspace(0.0, 2.0 * np.pi, 25)
    for load in robot.loads:
        node = round(load.at * (len(p) - 1))
        ring = [beside(p[node], R[node], angle, 1.15e3 * float(robot.tendon_offset)) for angle in turn]
        line(axes, np.array(ring), color=BODY, lw=1.5)


def chamber_arm(motion: Any, axes: Any, row: int) -> None:
    """Draw the arm, and its chambers as wide as their pressure is high."""
    p, R = frames(motion, row)
    part = motion.system.effects[0]
    line(axes, p, color=BODY, lw=15, alpha=0.45)
    pressure = np.asarray(motion.control[row]) / 4e4
    for angle, high in zip(np.asarray(part.angles), pressure, strict=True):
        line(axes, beside(p, R, angle, 1e3 * float(part.offset)), color=DRIVE, lw=0.8 + 4.0 * high, alpha=0.8)


def tubes(motion: Any, axes: Any, row: int) -> None:
    """Draw each tube to its own end."""
    p, _ = frames(motion, row)
    robot, control = motion.system, np.asarray(motion.control[row])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    for k, (tube, colour) in enumerate(zip(robot.tubes, (DRIVE, "#edae49", DARK), strict=True)):
        end = 1e3 * (float(robot.length) * tube.end + control[2 * k + 1])
        at = np.linspace(0.0, min(end, s[-1]), 60)
        line(
            axes,
            np.stack([np.interp(at, s, p[:, i]) for i in range(3)], axis=1),
            color=colour,
            lw=1.5 + 1.6 * k,
        )


def gripper(motion: Any, axes: Any, row: int) -> None:
    """Draw the rods, and the palm between them."""
    curves = [1e3 * np.asarray(it) for it in kc.robots.Drawing.of(motion.system).curves(motion.y[row])]
    curves = [it for curve in curves for it in (curve if curve.ndim == 3 else [curve])]
    tip = curves[0][-1]
    line(axes, curves[0], color=DARK, lw=4)
    for curve in curves[1:]:
        line(axes, np.stack([tip, curve[0]]), color=BODY, lw=5)
        line(axes, curve, color=DRIVE, lw=2.2)


def motions() -> list[tuple[str, Any, kc.Trajectory, bool]]:
    """Return a title, what draws it, equilibria, and whether z points down, for each robot."""
    turning = np.stack([np.cos(PHASE), np.sin(PHASE), -np.cos(PHASE), -np.sin(PHASE)], axis=1)
    pressed = np.stack([np.clip(np.cos(PHASE - angle), 0.0, 1.0) for angle in (0.0, 2.094, 4.189)], axis=1)
    fed = 0.5 - 0.5 * np.cos(PHASE)
    moved = np.zeros((FRAMES, 6))
    moved[:, 0], moved[:, 1] = PHASE, -0.03 * fed
    moved[:, 2], moved[:, 3] = 0.8 * np.sin(PHASE), -0.02 * fed
    closing = np.zeros((FRAMES, 6))
    closing[:, 0] = 3.0 * np.clip(np.sin(PHASE), 0.0, 1.0)
    closing[:, 3:] = (4.0 * fed)[:, None]
    return [
        ("tendons", tendon_arm, shapes("delrin-routed-tendon-robot", 6.0 + 5.0 * turning), False),
        ("pressure chambers", chamber_arm, shapes("three-chamber-arm", 4e4 * pressed), True),
        ("concentric tubes", tubes, shapes("three-tube-robot", moved), False),
        ("gripper", gripper, shapes("three-finger-gripper", closing), True),
    ]


def main(out: Path = OUT) -> Path:
    """Draw all frames, with the same axes in each, and write the picture."""
    robots = motions()
    pictures = []
    for row in range(FRAMES):
        figure = plt.figure(figsize=(8.4, 2.6), dpi=84)
        for k, (title, draw, motion, hangs) in enumerate(robots):
            axes: Any = figure.add_axes((0.25 * k, 0.0, 0.25, 0.9), projection="3d")
            draw(motion, axes, row)
            p = 1e3 * np.asarray(motion.position).reshape(-1, 3)
            middle, half = 0.5 * (p.min(0) + p.max(0)), 0.62 * np.ptp(p, axis=0).max()
            axes.set(
                xlim=(middle[0] - half, middle[0] + half),
                ylim=(middle[1] - half, middle[1] + half),
                zlim=(middle[2] - half, middle[2] + half)[:: -1 if hangs else 1],
            )
            axes.view_init(12, -60 + 20 * np.sin(PHASE[row]))
            axes.set_box_aspect((1, 1, 1), zoom=1.18)
            axes.set_axis_off()
            figure.text(0.25 * k + 0.125, 0.93, title, ha="center", fontsize=9, color=DARK)
        buffer = io.BytesIO()
        figure.savefig(buffer)
        plt.close(figure)
        pictures.append(Image.open(buffer).convert("RGB").quantize(48, dither=Image.Dither.NONE))
    pictures[0].save(out, save_all=True, append_images=pictures[1:], duration=70, loop=0, optimize=True)
    print(f"{out}: {out.stat().st_size // 1000} kB")
    return out


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
