"""Report of the study of further imperfections: tables, JSON and a figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from studies import runner
from studies.imperfections import CONTROLS, FAR, IMPERFECTIONS, LEFT, NAMED, jobs
from studies.report import Report, as_json, write_figures, write_texts
from studies.tables import MEASURES, markdown_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: a ratio below this is drawn as this: no more than rounding is left
LEAST = 1e-12


def rerun(
    out: Path,
    *,
    seeds: Sequence[int],
    names: Sequence[str] | None = None,
    workers: int | None = None,
    dask: str | None = None,
    progress: bool = False,
) -> Report:
    """Run the study's pending jobs and write its tables and figure into the folder.

    Args:
        out: the folder; an earlier run in it is continued.
        seeds: whole numbers.
        names: some of `IMPERFECTIONS`; all by default.
        workers: see `runner.run`.
        dask: see `runner.run`.
        progress: show a progress bar.

    Raises:
        StudyError: see `runner.run`.
    """
    made = jobs(names or list(IMPERFECTIONS), seeds)
    facts = runner.run(made, out, workers=workers, dask=dask, progress=progress)
    cells = [cell for each in facts.values() for cell in each["cells"]]
    texts = {"imperfections.md": as_markdown(cells), "imperfections.json": as_json(cells)}
    return Report(cells, write_texts(out, texts), write_figures(out, {"imperfections": figure(cells)}))


def ratios(cells: Sequence[Mapping[str, Any]], measure: str) -> dict[tuple[str, str], float | None]:
    """Return the worst seed's error relative to the baseline's, by imperfection and control.

    The ratio is None if a seed could not be simulated. It is zero if only the baseline could not be
    simulated. Cases whose true robot could not be simulated are left out.
    """
    of: dict[tuple[str, str], dict[bool, list[Any]]] = {}
    for cell in cells:
        both = of.setdefault((cell["imperfection"], cell["control"]), {True: [], False: []})
        both[cell["method"] == "baseline"].append(cell[measure])
    found: dict[tuple[str, str], float | None] = {}
    for case, both in of.items():
        baseline, learned = both[True][0], both[False]
        if None in learned:
            if baseline is not None or any(each is not None for each in learned):
                found[case] = None
        else:
            found[case] = 0.0 if baseline is None else max(learned) / baseline
    return found


def missed(cells: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return the imperfections and controls in which the learned model misses its target.

    The target is an error of at most `LEFT` times the baseline's in both metrics; at twice the tension it is
    at most the baseline's error.
    """
    found = {measure: ratios(cells, measure) for measure in MEASURES}
    wrong = []
    for case in next(iter(found.values())):
        allowed = 1.0 if case[1] in FAR else LEFT
        left = [each[case] for each in found.values()]
        if any(ratio is None or ratio > allowed for ratio in left):
            wrong.append(case)
    return wrong


def as_markdown(cells: Sequence[Mapping[str, Any]]) -> str:
    """Return one table per metric with a line per imperfection, and the missed targets."""
    names = list(dict.fromkeys(cell["imperfection"] for cell in cells))
    controls = list(dict.fromkeys(cell["control"] for cell in cells))
    wrong = missed(cells)
    parts = [
        "What is left of the baseline's error, by the worst seed (in brackets: the baseline's error itself). "
        f"Allowed is {LEFT:g}, and 1 at twice the tension; what is more than that is in bold."
    ]
    for measure, title in MEASURES.items():
        left = ratios(cells, measure)
        rows = []
        for name in names:
            row = [name if name in NAMED else f"*{name}*"]
            for control in controls:
                row.append(_words(left.get((name, control), "?"), _baseline(cells, name, control, measure)))
                allowed = 1.0 if control in FAR else LEFT
                ratio = left.get((name, control), 0.0)
                if ratio is None or ratio > allowed:
                    row[-1] = f"**{row[-1]}**"
            rows.append(row)
        parts += [f"## {title}", markdown_table(["imperfection", *controls], rows)]
    failures = [
        "- {imperfection}, {control}, {method}, seed {seed}: {failed}".format(**cell)
        for cell in cells
        if "failed" in cell
    ]
    if failures:
        parts += ["What failed:", "\n".join(failures)]
    count = len(names) - len({name for name, _ in wrong})
    parts.append(
        f"{count} of {len(names)} imperfections are learned as well as asked for, under every control."
    )
    return "\n\n".join(parts) + "\n"


def _baseline(cells: Sequence[Mapping[str, Any]], name: str, control: str, measure: str) -> float | None:
    for cell in cells:
        if (cell["imperfection"], cell["control"], cell["method"]) == (name, control, "baseline"):
            return cell[measure]
    return None


def _words(ratio: float | str | None, baseline: float | None) -> str:
    left = "failed" if ratio is None else ratio if isinstance(ratio, str) else f"{ratio:.1g}"
    return left + (" (failed)" if baseline is None else f" ({baseline:.2g})")


def figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Return a figure of errors relative to the baseline's: a line per imperfection, a point per control.

    A cross at the right edge is a failure; the dotted line is the target.

    Raises:
        ImportError: matplotlib is not installed.
    """
    from knode_cosserat.evaluation.drawing import new_figure
    from knode_cosserat.evaluation.style import PALETTE, TWO_COLUMNS, style

    names = list(dict.fromkeys(cell["imperfection"] for cell in cells))
    with style():
        whole = new_figure(TWO_COLUMNS, 0.19 * len(names) + 1.4)
        panels = whole.subplots(1, len(MEASURES), sharey=True)
        for axes, (measure, title) in zip(panels, MEASURES.items(), strict=True):
            left = ratios(cells, measure)
            for k, control in enumerate([*CONTROLS, *FAR]):
                at = {names.index(name): ratio for (name, of), ratio in left.items() if of == control}
                known = {line: max(ratio, LEAST) for line, ratio in at.items() if ratio is not None}
                far = control in FAR
                axes.plot(
                    list(known.values()), list(known), "^" if far else "o", label=control, markersize=4.5,
                    color=PALETTE[k % len(PALETTE)], markerfacecolor="white" if far else None,
                )  # fmt: skip
                broken = [line for line in at if line not in known]
                edge = axes.get_yaxis_transform()
                axes.plot([0.985] * len(broken), broken, "x", color=PALETTE[k % len(PALETTE)], transform=edge)
            axes.axvline(LEFT, color="#777777", linestyle=":", linewidth=1.2)
            axes.set(xscale="log", xlabel="left of the baseline's error", title=title)
            axes.set_xlim(LEAST / 3.0, 10.0 * max([1.0, *(r for r in left.values() if r is not None)]))
        panels[0].set_yticks(np.arange(len(names)), names)
        panels[0].invert_yaxis()
        handles, labels = panels[0].get_legend_handles_labels()
        whole.legend(handles, labels, loc="outside lower center", ncols=7, columnspacing=1.2)
    return whole
