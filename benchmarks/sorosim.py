"""Shapes and vibrations of rods by SoRoSim, and by this package: `python -m benchmarks.sorosim [FOLDER]`.

The files are those of `tests/files/sorosim`, or all of the repository that is named there.
"""

from __future__ import annotations

import functools
import gzip
import sys
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

import knode_cosserat as kc
from knode_cosserat.robots import SlenderRod, ends, loads

FILES = Path(__file__).parents[1] / "tests" / "files" / "sorosim"
MATERIALS = {"SpringSteel": (200e9, 0.33, 7870.0), "TPU": (70e6, 0.4, 1200.0)}
#: length and radius (m)
SIZES = {"SpringSteel": (0.6, 0.8e-3), "TPU": (0.4, 5e-3)}
#: stations of each half of a rod
HALF = np.array([0.0, 0.0469, 0.2308, 0.5, 0.7692, 0.9531, 1.0])
STATIONS = 0.5 * np.concatenate([HALF, 1.0 + HALF])
NODES, SPACE = 31, "lobatto4"
#: vibrations: step (s) and time compared (s)
DT, SECONDS = 6e-4, 2.0
#: the rods lie along x: rotation of the base from z to x
BASE = ends.Clamped(orientation=(np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0))


class Compared(NamedTuple):
    """Places (n, 3) by SoRoSim and by this package (m), and the length (m)."""

    theirs: np.ndarray
    ours: np.ndarray
    length: float

    @property
    def distances(self) -> np.ndarray:
        """Distances (m) of places (n,)."""
        return np.linalg.norm(self.ours - self.theirs, axis=1)


def rod(name: str, gravity: Any, wrenches: np.ndarray, damping_time: float = 0.0) -> SlenderRod:
    """A rod with wrenches (2, 6) at its middle and its tip: moments, then forces."""
    (length, radius), (modulus, ratio, density) = SIZES[name], MATERIALS[name]
    acting = tuple(
        loads.PointWrench(moment=wrench[:3], force=wrench[3:], at=at)
        for wrench, at in zip(wrenches, (0.5, 1.0), strict=True)
    )
    return SlenderRod(
        length=length,
        radius=radius,
        density=density,
        youngs_modulus=modulus,
        shear_modulus=0.5 * modulus / (1.0 + ratio),
        gravity=gravity,
        loads=acting,
        base_end=BASE,
        nodes=NODES,
        bending_damping=max(damping_time, 1e-3) * modulus * np.pi * radius**4 / 4.0,
    )


def lines_of(path: Path) -> list[str]:
    """The lines of a compressed file."""
    return gzip.decompress(path.read_bytes()).decode().splitlines()


def files(folder: Path, kind: str) -> Iterator[tuple[str, Path]]:
    """Yield the rod's name and the path of each file of a kind."""
    for path in sorted(folder.glob(f"*{kind}_*.gz")):
        yield next(name for name in SIZES if name in path.name), path


def statics(folder: Path = FILES, rods: Collection[str] = tuple(SIZES)) -> dict[str, list[Compared]]:
    """Compare the stations of all static shapes, by rod."""
    found = {}
    for name, path in files(folder, "statics"):
        if name not in rods:
            continue
        lines = lines_of(path)[2:]
        shapes = np.array([[float(each) for each in line.split(",")[1:]] for line in lines]).reshape(
            -1, 6, 17
        )
        found[name] = [_shape(name, each) for each in shapes]
    return found


def _shape(name: str, numbers: np.ndarray) -> Compared:
    robot = rod(name, numbers[3:, 0], numbers[:, 1:3].T)
    rest = kc.equilibrium(robot, [], space=SPACE)
    ours = CubicSpline(np.linspace(0.0, 1.0, NODES), rest.position[0])(STATIONS)
    return Compared(numbers[3:, 3:].T, ours, SIZES[name][0])


@functools.cache
def vibrations(folder: Path = FILES) -> dict[str, Compared]:
    """Compare the tip's positions in each free vibration, by file."""
    return {path.name.split(".")[0]: _vibration(name, path) for name, path in files(folder, "dynamics")}


def _vibration(name: str, path: Path) -> Compared:
    first, second, *rows = ([float(each) for each in line.split()] for line in lines_of(path))
    numbers, gravity, wrenches = np.array(rows), first[-3:], np.array(second[1:]).reshape(2, 6)
    numbers = numbers[numbers[:, 0] <= SECONDS]
    begin = kc.equilibrium(rod(name, gravity, wrenches, first[0]), [], space=SPACE)
    controls = np.zeros((round(SECONDS / DT), 0))
    motion = kc.simulate(
        rod(name, gravity, 0.0 * wrenches, first[0]),
        controls,
        DT,
        initial=begin,
        time="bdf-alpha",
        space=SPACE,
    )
    ours = CubicSpline(motion.time, motion.tip_position)(numbers[:, 0])
    return Compared(numbers[:, 10:13], ours, SIZES[name][0])


def table(shapes: dict[str, list[Compared]], motions: dict[str, Compared]) -> str:
    """As Markdown."""
    rows = [
        "| compared | amplitude, m | mean distance | largest |",
        "| --- | --- | --- | --- |",
    ]
    for name, each in shapes.items():
        parts = [100.0 * np.max(one.distances) / one.length for one in each]
        rows.append(
            f"| {name}, {len(each)} static shapes | – | {np.mean(parts):.3f} % of the length | "
            f"{np.max(parts):.3f} % |"
        )
    for name, one in motions.items():
        rms, largest = 1e3 * np.sqrt(np.mean(one.distances**2)), 1e3 * np.max(one.distances)
        size = 0.5 * np.max(np.linalg.norm(one.theirs[:, None, :] - one.theirs[None, ::5], axis=-1))
        label = name.removeprefix("sorosim_").removeprefix("dynamics_").replace("RodMuJoCo_", " ")
        rows.append(f"| {label}, free vibration | {size:.2f} | {rms:.2f} mm | {largest:.2f} mm |")
    return "\n".join(rows)


def picture(shapes: dict[str, list[Compared]], motions: dict[str, Compared], path: Path) -> None:
    """Shapes and vibrations of SoRoSim as lines, those of this package as dots."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10.5, 4.0), layout="constrained")
    for k, one in enumerate(shapes["TPU"][:8]):
        (line,) = axes[0].plot(*(one.theirs[:, i] for i in (0, 2)), lw=1, label="SoRoSim" if k == 0 else None)
        axes[0].plot(
            *(one.ours[:, i] for i in (0, 2)),
            ".",
            color=line.get_color(),
            label="this package" if k == 0 else None,
        )
    axes[0].set(title="eight static shapes of the TPU rod", xlabel="x, m", ylabel="z, m", aspect="equal")
    for name, one in list(motions.items())[::3]:
        times = np.linspace(0.0, SECONDS, len(one.theirs))
        (line,) = axes[1].plot(
            times, one.theirs[:, 2], lw=1, label=f"SoRoSim, {name.split('_')[1].split('Rod')[0]}"
        )
        axes[1].plot(times[::6], one.ours[::6, 2], ".", ms=4, color=line.get_color())
    axes[1].set(title="free vibrations; dots: this package", xlabel="time, s", ylabel="z of the tip, m")
    for ax in axes:
        ax.legend(fontsize=7)
        ax.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    at = Path(sys.argv[1]) if len(sys.argv) > 1 else FILES
    print(table(statics(at), vibrations(at)))
