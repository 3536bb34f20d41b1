"""Study of state estimation: both methods on recordings of the test robot, whose states are known."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat.figures.comparison import METHODS as LINES
from knode_cosserat.figures.comparison import REFERENCE, legend_below
from knode_cosserat.figures.style import TWO_COLUMNS, new_figure
from knode_cosserat.metrics import state_errors
from knode_cosserat.recordings.estimation.estimate import Method, estimate_states
from knode_cosserat.recordings.load import load_recording
from knode_cosserat.recordings.virtual import Sensors, record_virtual, virtual_robot
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory
from studies.report import Report, markdown_table, write_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: recorded signals, by the names of the files
SIGNALS = {"sine": "sine:1.0", "random": "random:0", "step": "step:4.4"}
SECONDS, NODES = 12.0, 10
METHODS: tuple[Method, ...] = ("paper", "best")
#: names of the robots whose balance and constitutive law give n, m and v
TRUE, CRUDE = "the robot's own", "the paper's nominal model"
#: title, factor and unit of each quantity in a table
QUANTITIES = {
    "p": ("position", 1e3, "mm"),
    "h": ("orientation", 1e3, "mrad"),
    "q": ("velocity q", 1e3, "mm/s"),
    "w": ("angular velocity ω", 1e3, "mrad/s"),
    "n": ("force n", 1e3, "mN"),
    "m": ("moment m", 1e3, "mN m"),
    "v": ("strain v", 1e6, "1e-6"),
    "u": ("curvature u", 1.0, "1/m"),
}
#: the part of the random recording that is drawn (s)
DRAWN = (1.0, 4.0)


def rerun(out: Path, signals: Mapping[str, str] = SIGNALS, seed: int = 0) -> Report:
    """Record the test robot, estimate its states by both methods, and write errors and a figure.

    Args:
        out: the folder; the bags are kept there.
        signals: signals of the recordings, by name.
        seed: of the sensors' noise.
    """
    out.mkdir(parents=True, exist_ok=True)
    robots: dict[str, System] = {TRUE: virtual_robot(NODES), CRUDE: load_robot("delrin-tendon-robot")}
    cells: list[dict[str, Any]] = []
    drawn: tuple[Trajectory, Mapping[str, Trajectory]] | None = None
    for k, (name, signal) in enumerate(signals.items()):
        path = out / f"{name}.bag"
        truth = record_virtual(path, signal, SECONDS, seed + k)
        recording = load_recording(path)
        for balance, robot in robots.items():
            found: dict[str, Trajectory] = {
                method: estimate_states(recording, robot, method) for method in METHODS
            }
            about = {"recording": name, "signal": signal, "balance": balance}
            for method, estimate in found.items():
                for quantity, error in state_errors(estimate, truth).items():
                    cells.append({**about, "method": method, "quantity": quantity, **error._asdict()})
            if balance == TRUE and (drawn is None or name == "random"):
                drawn = truth, found
    assert drawn is not None
    figures = {"estimation": estimated_states(*drawn, DRAWN)}
    return write_report(out, "estimation", cells, as_markdown(cells), figures)


def as_markdown(cells: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of errors for each recording with the true robot's balance, and the nominal model's."""
    noise = dataclasses.asdict(Sensors())
    known = {"p": np.sqrt(3) * noise["position_noise"], "h": np.sqrt(3) * noise["turn_noise"]}
    parts = [
        "# State estimation",
        "Root mean squares, over rows and nodes, of the lengths of error vectors. The robot is virtual\n"
        "(simulated), and so its states are known. n, m and v follow from the balance and law of the robot\n"
        "that is given.",
    ]
    names = list(dict.fromkeys(cell["recording"] for cell in cells))
    for name in names:
        own = _chosen(cells, name, TRUE)
        signal = next(cell["signal"] for cell in cells if cell["recording"] == name)
        rows = []
        for quantity, (title, factor, unit) in QUANTITIES.items():
            paper, best = (own[method, quantity] for method in METHODS)
            said = f"{factor * known[quantity]:.3g}" if quantity in known else ""
            rows.append(
                [
                    f"{title} [{unit}]",
                    f"{factor * paper['size']:.3g}",
                    said,
                    f"{factor * paper['rms']:.3g}",
                    f"{factor * best['rms']:.3g}",
                    f"{paper['rms'] / best['rms']:.1f}",
                ]
            )
        heads = ["quantity", "its size", "markers' noise", "paper", "best", "paper / best"]
        parts += [f"## {signal}, with {TRUE} balance", markdown_table(heads, rows)]
    rows = []
    for quantity in ("n", "m", "v", "u"):
        title, factor, unit = QUANTITIES[quantity]
        by_name = [_chosen(cells, name, CRUDE) for name in names]
        row = [f"{title} [{unit}]"]
        for each in by_name:
            row += [f"{factor * each[method, quantity]['rms']:.3g}" for method in METHODS]
        rows.append(row)
    heads = ["quantity", *(f"{name}: {method}" for name in names for method in METHODS)]
    parts += [f"## What follows from the robot that is given: with {CRUDE}", markdown_table(heads, rows)]
    parts.append("The other quantities do not depend on it.")
    return "\n\n".join(parts) + "\n"


def _chosen(
    cells: Sequence[Mapping[str, Any]], name: str, balance: str
) -> dict[tuple[str, str], Mapping[str, Any]]:
    return {
        (cell["method"], cell["quantity"]): cell
        for cell in cells
        if cell["recording"] == name and cell["balance"] == balance
    }


#: quantity, component, node and title of each panel
_SHOWN = (
    ("q", 0, -1, "tip: q along x [m/s]"),
    ("w", 1, -1, "tip: ω about y [rad/s]"),
    ("n", 0, 0, "base: n along x [N]"),
    ("m", 1, 0, "base: m about y [N m]"),
)


def estimated_states(
    truth: Trajectory, estimates: Mapping[str, Trajectory], span: tuple[float, float]
) -> Figure:
    """Return a figure of tip velocities, base force and base moment over a time span (s), with their errors.

    Raises:
        ImportError: matplotlib is not installed.
    """
    with new_figure(TWO_COLUMNS, 6.2) as figure:
        grid = figure.subplots(4, 2, sharex=True, height_ratios=(2, 1, 2, 1))
        for k, (name, component, node, title) in enumerate(_SHOWN):
            above, below = grid[2 * (k // 2), k % 2], grid[2 * (k // 2) + 1, k % 2]
            true = np.asarray(truth.part(name))[:, node, component]
            above.plot(truth.time, true, label="truth", **REFERENCE)
            for method, estimate in estimates.items():
                found = np.asarray(estimate.part(name))[:, node, component]
                above.plot(estimate.time, found, label=method, **LINES[method])
                at_rows = np.interp(np.asarray(estimate.time), np.asarray(truth.time), true)
                below.plot(estimate.time, found - at_rows, label=method, **LINES[method])
            inside = (np.asarray(truth.time) >= span[0]) & (np.asarray(truth.time) <= span[1])
            low, high = true[inside].min(), true[inside].max()
            room = 0.1 * (high - low)
            above.set(title=title, xlim=span, ylim=(low - room, high + room))
            below.set(ylabel="error", ylim=(-1.5 * room, 1.5 * room))
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        legend_below(figure, grid[:1, 0])
    return figure
