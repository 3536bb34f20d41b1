"""Study of data efficiency: the cells of the paper's table from 5 to 30 rows, of one sine and of two.

Methods with a nominal model are the best training configuration and the paper's. Methods without one are
networks of the same size and linear prediction: they have the same result for each imperfection.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat import controls
from knode_cosserat.figures.comparison import legend_below
from knode_cosserat.figures.style import PALETTE, new_figure
from knode_cosserat.learning.config import FitConfig
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory
from studies import runner, simulation
from studies.comparisons import NoKnowledge, compared, linear_predictor
from studies.methods import METHODS, LearnedSystems, Method, fitted
from studies.report import (
    CASE,
    MEASURES,
    PAPER_MEASURES,
    Report,
    in_words,
    markdown_table,
    spreads,
    write_report,
)
from studies.runner import Job, Product

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: training rows of each sine, including the state at rest
ROWS = (5, 10, 20, 30)
#: the first sine alone, and both
SINES = (1, 2)


def paper_alone(imperfect: System, training: Sequence[Trajectory], seeds: Sequence[int]) -> LearnedSystems:
    """Return the paper's network, trained on a system without physics."""
    return fitted(NoKnowledge(imperfect), training, FitConfig.paper(seed=tuple(seeds)))


def network_alone(imperfect: System, training: Sequence[Trajectory], seeds: Sequence[int]) -> LearnedSystems:
    """Return a standardised, unconstrained network of the paper's size, on a system without physics."""
    return fitted(NoKnowledge(imperfect), training, FitConfig.network(seed=tuple(seeds), hidden=512))


INFORMED: dict[str, Method] = {name: METHODS[name] for name in ("baseline", "paper", "best")}
ALONE: dict[str, Method] = {"paper, no knowledge": paper_alone, "network, no knowledge": network_alone}
LINEAR = "linear (DMDc)"
#: all methods by name, in the order of the tables
ALL = (*INFORMED, *ALONE, LINEAR)
#: name for all imperfections, in cells of methods without a nominal model
ANY = "any"


def jobs(seeds: Sequence[int], rows: Sequence[int] = ROWS, methods: Sequence[str] | None = None) -> list[Job]:
    """Return one job for each method, amount of data and, with a nominal model, imperfection.

    Args:
        seeds: seeds of the fits; the baseline and the linear prediction need none.
        rows: training rows of each sine.
        methods: some of `ALL`; all by default.

    Raises:
        ValueError: a method is unknown.
    """
    made = []
    for method in methods or ALL:
        if method not in ALL:
            raise ValueError(f"method {method!r} is unknown; allowed is some of {', '.join(ALL)}")
        imperfections = simulation.IMPERFECTIONS if method in INFORMED else {ANY: {}}
        amounts = [(sines, count) for sines in SINES for count in rows] if method != "baseline" else [(0, 0)]
        made += [
            _job(method, imperfection, changes, amount, seeds)
            for imperfection, changes in imperfections.items()
            for amount in amounts
        ]
    return made


def _job(method: str, imperfection: str, changes: Any, amount: tuple[int, int], seeds: Sequence[int]) -> Job:
    sines, rows = amount
    words = "".join(letter if letter.isalnum() else " " for letter in f"{method} {imperfection}").split()
    settings = {
        "robot": simulation.ROBOT, "dt": simulation.DT, "steps": simulation.ROWS,
        "controls": simulation.CONTROLS, "training": list(simulation.TRAINING[:sines]), "rows": rows,
        "method": method, "imperfection": imperfection, "changes": changes, "seeds": list(seeds),
    }  # fmt: skip
    return Job("-".join([*words, f"{sines}x{rows}"]), predict, settings)


# the work


def predict(settings: Any) -> Product:
    """Return the cells of one method, imperfection and amount of data, under every control."""
    robot, dt, steps = load_robot(settings["robot"]), settings["dt"], settings["steps"]
    amount = {"sines": len(settings["training"]), "rows": settings["rows"]}
    training = [simulation.moved(robot, control, settings["rows"], dt) for control in settings["training"]]
    truths = {
        name: simulation.moved(robot, control, steps, dt) for name, control in settings["controls"].items()
    }
    cells = []
    for seed, predictor in _predictors(robot.replace(**settings["changes"]), training, settings).items():
        for name, truth in truths.items():
            of = {"imperfection": settings["imperfection"], "control": name, "method": settings["method"]}
            outcome = compared(predictor(settings["controls"][name]), truth)
            cells.append({**of, "seed": seed, **amount, **outcome})
    return Product({"cells": cells}, {})


Predictor = Callable[[str], Any]


def _predictors(imperfect: System, training: Sequence[Trajectory], settings: Any) -> dict[int, Predictor]:
    """Return for each seed a predictor under a control, or the reason why there is none."""
    dt, steps, method = settings["dt"], settings["steps"], settings["method"]
    if method == LINEAR:
        linear = linear_predictor(imperfect, training)
        return {0: lambda control: linear(controls.parse(control, steps, dt, sampled="end"))}
    learned = {**INFORMED, **ALONE}[method](imperfect, training, settings["seeds"])

    def predictor(system: System | str) -> Predictor:
        return lambda control: simulation.predicted(system, control, steps, dt)

    return {seed: predictor(system) for seed, system in learned.systems.items()}


#: index of each method's colour
COLOURS = {"best": 6, "paper": 0, "network, no knowledge": 3, "paper, no knowledge": 4, LINEAR: 2}
#: without data: the baseline
NONE = (0, 0)


def rerun(
    out: Path,
    *,
    seeds: Sequence[int],
    rows: Sequence[int] = ROWS,
    methods: Sequence[str] | None = None,
    **how: Any,
) -> Report:
    """Run the study's pending jobs and write `data.md`, `data.json` and figures into the folder.

    Args:
        out: the folder; an earlier run in it is continued.
        seeds: whole numbers.
        rows: of each sine.
        methods: some of `data_efficiency.ALL`; all by default.
        how: as `runner.run` has it.

    Raises:
        StudyError: see `runner.run`.
        ImportError: matplotlib is not installed, or PyDMD for the linear prediction.
    """
    made = jobs(seeds, rows, methods)
    facts = runner.run(made, out, **how)
    cells = [cell for each in facts.values() for cell in each["cells"]]
    drawn = {f"data-{measure.replace('_', '-')}": figure(cells, measure) for measure in PAPER_MEASURES}
    return write_report(out, "data", cells, as_markdown(cells), drawn)


def as_markdown(cells: Sequence[Any]) -> str:
    """Return one table per metric: a line per case and method, a column per amount of data."""
    amounts = sorted({(cell["sines"], cell["rows"]) for cell in cells} - {NONE})
    lines = dict.fromkeys((cell["imperfection"], cell["control"], cell["method"]) for cell in cells)
    parts = []
    for measure, (title, factor) in MEASURES.items():
        heads = ["imperfection", "control", "method", *(f"{sines} x {rows} rows" for sines, rows in amounts)]
        found = spreads(cells, measure, factor, by=(*CASE, "sines", "rows"))
        rows = []
        for *case, method in lines:
            # without data the figures are the same for every amount
            constant = found.get((*case, *NONE), {})
            spread = [(constant | found.get((*case, *amount), {})).get(method) for amount in amounts]
            rows.append([*case, method, *("" if each is None else in_words(each) for each in spread)])
        parts += [f"## {title}", markdown_table(heads, rows)]
    return "\n\n".join(parts) + "\n"


def figure(cells: Sequence[Any], measure: str = "tip_dtw") -> Figure:
    """Return a figure of error over rows, a panel per imperfection and control: one sine dashed, two solid.

    The line is the median over seeds, the band their range. A cross at the upper edge marks cases in which no
    seed could be simulated. The baseline, which needs no data, is the grey line.

    Raises:
        ImportError: matplotlib is not installed.
    """
    imperfections = [name for name in dict.fromkeys(cell["imperfection"] for cell in cells) if name != ANY]
    controls = list(dict.fromkeys(cell["control"] for cell in cells))
    with new_figure(2.9 * len(imperfections) + 0.6, 3.8 * len(controls) + 1.0) as whole:
        grid = whole.subplots(len(controls), len(imperfections), sharex=True, sharey=True, squeeze=False)
        for line, control in zip(grid, controls, strict=True):
            for axes, imperfection in zip(line, imperfections, strict=True):
                here = [
                    cell
                    for cell in cells
                    if cell["control"] == control and cell["imperfection"] in (imperfection, ANY)
                ]
                _draw_panel(axes, here, measure)
                axes.set_title(f"{imperfection}, {control}")
        for axes in grid[-1]:
            axes.set_xlabel("rows of each sine")
        for axes in grid[:, 0]:
            axes.set_ylabel(MEASURES[measure][0])
        legend_below(whole, grid.ravel(), columns=4)
    return whole


def _draw_panel(axes: Any, cells: Sequence[Any], measure: str) -> None:
    axes.set_yscale("log")
    axes.set_xticks(sorted({cell["rows"] for cell in cells} - {0}))
    known = [cell[measure] for cell in cells if cell["method"] == "baseline" and cell[measure] is not None]
    if known:
        axes.axhline(np.median(known), color="#BBBBBB", linewidth=3.0, zorder=0, label="baseline")
    for method in COLOURS:
        for sines in sorted({cell["sines"] for cell in cells} - {0}):
            own = [c for c in cells if (c["method"], c["sines"]) == (method, sines)]
            _draw_curve(axes, own, measure, method, sines)


def _draw_curve(axes: Any, cells: Sequence[Any], measure: str, method: str, sines: int) -> None:
    rows = sorted({cell["rows"] for cell in cells})
    values = {row: [c[measure] for c in cells if c["rows"] == row and c[measure] is not None] for row in rows}
    known = {row: some for row, some in values.items() if some}
    colour = PALETTE[COLOURS[method]]
    look: dict[str, Any] = {"color": colour, "marker": "o", "markersize": 4.0, "linestyle": "-"}
    if sines == 1:
        look |= {"linestyle": (0, (3, 2)), "markerfacecolor": "white"}
    if known:
        label = f"{method}, {sines} sine" + "s" * (sines > 1)
        axes.plot(list(known), [np.median(some) for some in known.values()], label=label, **look)
        least, most = [min(some) for some in known.values()], [max(some) for some in known.values()]
        axes.fill_between(list(known), least, most, color=colour, alpha=0.2, linewidth=0)
    # a little apart: one sine and two may fail at the same place
    failed = [row + 0.8 * (sines - 1.5) for row in rows if row not in known]
    above = axes.get_xaxis_transform()
    axes.plot(failed, [0.96] * len(failed), "x", color=colour, transform=above, markersize=5.0)
