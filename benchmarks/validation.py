"""`python -m benchmarks.validation`: the tables and pictures of docs/validation.md, put in their places."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullLocator

import knode_cosserat as kc
from benchmarks import beams, closed_forms, motions, sorosim
from benchmarks.buckling import tip_response

DOCS = Path(__file__).parents[1] / "docs"
GRID = (10, 20, 40)
#: cases that are shown by Euler too: of one program
EULER = ("even load", "half circle", "circle", "helix", "elastica 1", "elastica 10")
#: below this what is left is rounding, and has no order
EXACT = 1e-8


def errors(case: beams.Case, space: str) -> list[float]:
    """On every grid."""
    return [case.error(nodes, space) for nodes in GRID]


def _order(found: list[float]) -> str:
    return "exact" if max(np.abs(found)) < EXACT else f"{beams.order(found, GRID):.2f}"


def table(found: dict[str, list[float]], names: dict[str, str]) -> str:
    """As Markdown; the last grid shows in the order only."""
    shown = GRID[:-1]
    head = "| case | " + " | ".join(f"{nodes} nodes" for nodes in shown) + " | order |"
    rows = [
        f"| {names[key]} | " + " | ".join(f"{abs(e):.1e}" for e in each[:-1]) + f" | {_order(each)} |"
        for key, each in found.items()
    ]
    return "\n".join([head, "|" + " --- |" * (len(shown) + 2), *rows])


def convergence(families: dict[str, dict[str, list[float]]], path: Path) -> None:
    """Errors against nodes."""
    figure, axes = plt.subplots(1, len(families), figsize=(4.2 * len(families), 4.0), layout="constrained")
    for ax, (title, family) in zip(axes, families.items(), strict=True):
        for name, found in family.items():
            if max(np.abs(found)) > EXACT:
                ax.loglog(GRID, np.abs(found), "o-", ms=4, lw=1.2, label=name)
        slope = 1 if "Euler" in title else 4
        largest = max(abs(each[0]) for each in family.values())
        line = 2 * largest * ((np.array(GRID) - 1) / (GRID[0] - 1)) ** -float(slope)
        ax.loglog(GRID, line, "k--", lw=0.8, label=f"order {slope}")
        # after the last line: each sets the axes' scale anew, and with it their ticks
        ax.set(title=title, xlabel="nodes", ylabel="relative error")
        ax.set_xticks(GRID, [str(nodes) for nodes in GRID])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.legend(fontsize=7, loc="lower left")
        ax.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def shapes(path: Path) -> None:
    """Closed forms as lines, the solver's nodes as dots."""
    figure, axes = plt.subplots(1, 3, figsize=(12.6, 4.0), layout="constrained")
    nodes = 20
    fine = np.linspace(0, 1, 400)
    for load in closed_forms.ELASTICA:
        found = beams.positions(beams.rod(nodes, force=(load, 0, 0)), "lobatto4")
        (dots,) = axes[0].plot(found[:, 0], found[:, 2], ".-", lw=0.8, label=f"F L²/EI = {load}")
        deflection, shortening = closed_forms.elastica(load)
        axes[0].plot(deflection, 1 - shortening, "o", mfc="none", ms=10, color=dots.get_color())
    axes[0].set(title="elastica; circles: exact tips", xlabel="x / L", ylabel="z / L")
    for name, moment in (
        ("half circle", (0, np.pi, 0)),
        ("circle", (0, 2 * np.pi, 0)),
        ("helix", (3, -1, 4)),
    ):
        exact = closed_forms.helix(np.multiply(moment, beams.MOMENT), fine, beams.EI)
        found = beams.positions(beams.rod(nodes, moment=moment), "lobatto4")
        (line,) = axes[1].plot(exact[:, 0], exact[:, 2], lw=1, label=name)
        axes[1].plot(found[:, 0], found[:, 2], ".", color=line.get_color())
    axes[1].set(title="moment at the tip", xlabel="x / L", ylabel="z / L")
    exact = beams.CATENARY.positions(fine)
    axes[2].plot(exact[:, 0], exact[:, 2], lw=1, label="catenary")
    for curved, mark, name in ((True, ".", "rod curved like it at rest"), (False, "x", "straight rod")):
        robot, start = beams.hanging(nodes, curved)
        found = beams.positions(robot, "lobatto4", initial=start)
        axes[2].plot(found[:, 0], found[:, 2], mark, ms=5, label=name)
    axes[2].set(title="between two pins, w L³/EI = 60", xlabel="x / L", ylabel="z / L")
    for ax in axes:
        ax.set_aspect("equal", adjustable="datalim")
        ax.legend(fontsize=7)
        ax.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def dynamics(path: Path) -> None:
    """How singular a column is under its weight, and a vibration that is let go."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.6), layout="constrained")
    weights = np.linspace(0, 12, 25)
    smallest = []
    for weight in weights:
        gravity = (0, 0, -weight * beams.FORCE / (beams.DENSITY * beams.AREA * beams.LENGTH))
        rest = kc.equilibrium(
            beams.rod(40, gravity=gravity), np.zeros(0), space="lobatto4", newton=beams.NEWTON
        )
        scales = np.array([beams.FORCE] * 3 + [beams.MOMENT] * 3)
        smallest.append(np.linalg.svd(tip_response(rest) * scales / scales[:, None], compute_uv=False)[-1])
    axes[0].plot(weights, smallest, ".-", lw=0.8)
    axes[0].axvline(closed_forms.COLUMN, color="k", ls="--", lw=0.8, label="Greenhill: 7.837")
    axes[0].set(title="upright column", xlabel="ρ A g L³ / EI", ylabel="smallest singular value of ∂tip/∂ξ")
    axes[0].legend(fontsize=8)
    for scheme, name in ((kc.solvers.BDF2(), "BDF2"), (kc.solvers.Trapezoidal(), "trapezoidal")):
        amplitude, _ = beams.swinging(1, 40, scheme=scheme)
        axes[1].plot(
            np.arange(len(amplitude)) / beams.PERIOD_STEPS, amplitude / amplitude[0], lw=1, label=name
        )
    axes[1].set(title="first mode, 16 steps a period", xlabel="periods", ylabel="amplitude")
    axes[1].legend(fontsize=8)
    for ax in axes:
        ax.grid(alpha=0.3)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def written(page: Path, tables: dict[str, str]) -> None:
    """Put each table between its marks in the page."""
    text = page.read_text()
    for name, each in tables.items():
        marks = rf"(<!-- {name} -->\n)(?:(?!<!-- end -->).)*"
        text, count = re.subn(marks, lambda found, each=each: f"{found[1]}{each}\n", text, flags=re.DOTALL)
        if count != 1:
            raise ValueError(f"{page} has {count} places for the table {name!r}; it must have one")
    page.write_text(text)


def _all(
    family: dict[str, beams.Case], space: str, keys: Iterable[str] | None = None
) -> dict[str, list[float]]:
    found = {}
    for key in keys or family:
        found[key] = errors(family[key], space)
        print(
            f"{key:14s} {space:6s}",
            " ".join(f"{abs(e):.1e}" for e in found[key]),
            _order(found[key]),
            flush=True,
        )
    return found


def main() -> None:
    """Measure, draw, write."""
    every: dict[str, Any] = {
        "statics": _all(beams.STATICS, "lobatto4"),
        "euler": _all(beams.STATICS, "euler", EULER),
        "buckling": _all(beams.BUCKLING, "lobatto4"),
        "vibration": _all(beams.VIBRATION, "lobatto4"),
        "motion": _all(motions.MOTIONS, "lobatto4"),
    }
    families = beams.STATICS, beams.BUCKLING, beams.VIBRATION, motions.MOTIONS
    names = {key: case.name for family in families for key, case in family.items()}
    # Euler's errors are in the picture only
    tables = {name: table(found, names) for name, found in every.items() if name != "euler"}
    compared = sorosim.statics(), sorosim.vibrations()
    written(DOCS / "validation.md", {**tables, "sorosim": sorosim.table(*compared)})
    sorosim.picture(*compared, DOCS / "images" / "validation-sorosim.png")
    convergence(
        {
            "statics, order 4": every["statics"],
            "statics, Euler": every["euler"],
            "buckling and vibration, order 4": {**every["buckling"], **every["vibration"]},
            "damped motion, order 4": every["motion"],
        },
        DOCS / "images" / "validation-convergence.png",
    )
    shapes(DOCS / "images" / "validation-shapes.png")
    dynamics(DOCS / "images" / "validation-dynamics.png")


if __name__ == "__main__":
    main()
