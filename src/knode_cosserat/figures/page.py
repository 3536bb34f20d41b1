"""Page of evaluations: one self-contained HTML file with a table of errors, figures and conditions.

Figures are embedded pictures (SVG). The page has no scripts, loads nothing, and can be printed.
"""

from __future__ import annotations

import base64
import datetime
import html
import io
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat._arguments import check_arguments, kind_text
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat._reprs import count_of
from knode_cosserat.figures.evaluation import (
    MOST_POINTS,
    along_rod,
    histogram,
    length_unit,
    over_time,
    worst_instants,
)
from knode_cosserat.figures.style import require_matplotlib

if TYPE_CHECKING:
    from knode_cosserat.identification import Comparison, Evaluation

STYLE = Path(__file__).with_name("page.css")
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"


def evaluation_page(
    evaluations: Evaluation | Mapping[str, Evaluation], path: str | Path, *, robot: str | None = None
) -> Path:
    """Write evaluations of one robot or model as one HTML page that any browser opens, without a network.

    It has a table of errors by recording, the error over time with the controls, errors along the rod, their
    distribution, the shapes in the worst instants, the band of an ensemble, and the conditions. Recordings
    without a prediction are in it with the reason.

    Args:
        evaluations: evaluations by the names of their recordings, or one.
        path: the file to write.
        robot: name or file of the robot or model.

    Returns:
        The path.

    Raises:
        ValueError: there is no evaluation, or one is another object.
    """
    check_arguments(evaluation_page, locals())
    require_matplotlib()
    by_name = dict(evaluations) if isinstance(evaluations, Mapping) else {"recording": evaluations}
    if not by_name:
        raise ValueError("there are no evaluations to show; at least one is needed")
    for name, it in by_name.items():
        if not hasattr(it, "comparison"):
            raise ValueError(
                f"evaluations: {name} is {kind_text(it)}; allowed is an Evaluation "
                "(from identification.evaluate)"
            )
    text = _document(by_name, robot)
    with replacing(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def _document(evaluations: Mapping[str, Evaluation], robot: str | None) -> str:
    compared = [it.comparison for it in evaluations.values() if it.comparison is not None]
    name = robot or (type(compared[0].robot).__name__ if compared else "robot")
    title = f"{name}: prediction of {count_of(len(evaluations), 'recording')}"
    body = [
        f"<h1>{_text(title)}</h1>",
        _headline(evaluations),
        "<h2>Errors by recording</h2>",
        _table(evaluations),
        "<h2>Conditions</h2>",
        _conditions(evaluations, name),
        *(_section(each, it) for each, it in evaluations.items()),
    ]
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{_text(title)} · KNODE-Cosserat</title>",
            f'<link rel="icon" href="data:,">\n<style>{STYLE.read_text(encoding="utf-8")}</style>',
            "</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )


def _text(value: Any) -> str:
    return html.escape(str(value))


# errors


class _Errors:
    """Errors of the tip (m), angles (rad) and length (m) of one comparison, or of several together."""

    def __init__(self, compared: Iterable[Comparison]):
        self.length, self.rows = 0.0, 0
        tips, angles = [np.zeros(0)], [np.zeros(0)]
        for it in compared:
            self.length = max(self.length, float(np.max(it.robot.length)))
            tips.append(it.distance[:, -1] if it.distance.shape[1] else np.zeros(0))
            angles.append(it.angle.reshape(-1))
        self.tip, self.angle = (
            each[np.isfinite(each)] for each in (np.concatenate(tips), np.concatenate(angles))
        )

    def tip_statistics(self) -> list[float]:
        """Return RMS, median, 95 % and maximum of the tip's distance (m); empty if it is not known."""
        if not self.tip.size:
            return []
        return [
            float(np.sqrt(np.mean(self.tip**2))),
            *(float(np.percentile(self.tip, level)) for level in (50, 95, 100)),
        ]

    @property
    def degrees(self) -> float | None:
        """Root mean square angle (degrees), or None."""
        return float(np.degrees(np.sqrt(np.mean(self.angle**2)))) if self.angle.size else None


def _errors(evaluations: Mapping[str, Evaluation]) -> _Errors:
    return _Errors(it.comparison for it in evaluations.values() if it.comparison is not None)


def _percent(part: float) -> str:
    return f"{100.0 * part:.0f} %"


def _number(value: float | None, unit: str = "") -> str:
    return "–" if value is None else f"{value:.3g}{unit}"


def _headline(evaluations: Mapping[str, Evaluation]) -> str:
    errors, count = _errors(evaluations), len(evaluations)
    failed = sum(it.failed is not None for it in evaluations.values())
    cards = [
        (
            "bad" if failed else "",
            f"{count - failed} of {count}",
            "predicted" + (f", {failed} failed" if failed else ""),
        )
    ]
    if errors.tip.size:
        factor, unit = length_unit(errors.tip_statistics()[0])
        rms = errors.tip_statistics()[0]
        share = f"tip RMSE, {100.0 * rms / errors.length:.2g} % of the length"
        cards.insert(0, ("", f"{_number(factor * rms)} {unit}", share))
    if errors.degrees is not None:
        cards.insert(1, ("", f"{errors.degrees:.3g}°", "orientations off, RMS"))
    words = "".join(
        f'<div class="{kind}"><b>{_text(value)}</b>{_text(what)}</div>' for kind, value, what in cards
    )
    return f'<div class="headline">{words}</div>'


def _table(evaluations: Mapping[str, Evaluation]) -> str:
    whole = _errors(evaluations)
    factor, unit = length_unit(whole.tip_statistics()[0] if whole.tip.size else 0.0)
    # a column for everything that one recording has at least
    has_tip, has_angle = bool(whole.tip.size), whole.degrees is not None
    has_range = any(it.extrapolated is not None for it in evaluations.values())
    has_band = any(it.band for it in evaluations.values())
    has_mse = any(it.pose_mse is not None for it in evaluations.values())

    def chosen(tip: list[str], angle: str, range_: str, band: str, mse: str) -> list[str]:
        return [
            *(tip if has_tip else []),
            *([angle] if has_angle else []),
            *([range_] if has_range else []),
            *([band] if has_band else []),
            *([mse] if has_mse else []),
        ]

    def tips(errors: _Errors) -> list[str]:
        statistics = [
            f"{_number(factor * value)}<small>{100.0 * value / errors.length:.2g} %</small>"
            for value in errors.tip_statistics()
        ]
        return statistics or ["–"] * 4

    names = [f"{name} [{unit}]" for name in ("tip RMSE", "median", "95 %", "maximum")]
    heads = chosen(names, "angle [°]", "extra&shy;polated", "inside the band", "the paper's pose MSE [10⁻³]")
    lines = []
    for name, it in evaluations.items():
        rows = "–" if it.comparison is None else str(len(it.comparison.rows))
        first = f"<tr><td>{_text(name)}</td><td>{rows}</td>"
        if it.failed is not None:
            words = f"<div>failed: {_text(it.failed)}</div>"
            lines.append(f'{first}<td class="bad" colspan="{max(1, len(heads))}">{words}</td></tr>')
            continue
        errors = _Errors([it.comparison] if it.comparison else [])
        share = "–" if it.extrapolated is None else _percent(it.extrapolated)
        cells = chosen(
            tips(errors),
            _number(errors.degrees),
            f"<b>{share}</b>" if it.extrapolated else share,
            _percent(it.band.coverage) if it.band else "–",
            _number(it.pose_mse),
        )
        lines.append(first + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    compared = [it.comparison for it in evaluations.values() if it.comparison and it.failed is None]
    if len(compared) > 1 and has_tip:
        cells = [str(sum(len(it.rows) for it in compared))]
        cells += chosen(tips(whole), _number(whole.degrees), "", "", "")
        cells = ["all predicted", *cells]
        lines.append('<tr class="all">' + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    top = "".join(f"<th>{head}</th>" for head in ("recording", "rows", *heads))
    notes = ["Small figures: parts of the length."] * has_tip
    if has_angle:
        notes.append(
            "Angle: root mean square between measured and predicted orientations of all bodies, relative to "
            "the first row."
        )
    if has_mse:
        notes.append("The paper's pose MSE has Euler angles, which jump at ±180°.")
    return (
        f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'
        f'<p class="quiet">{" ".join(notes)}</p>'
    )


# conditions


def _conditions(evaluations: Mapping[str, Evaluation], robot: str) -> str:
    compared = [it.comparison for it in evaluations.values() if it.comparison is not None]
    facts: dict[str, Any] = {"robot or model": robot}
    if compared:
        first = compared[0]
        settings = first.trajectory.settings if first.trajectory is not None else None
        facts["recordings"] = ", ".join(evaluations)
        facts["rows compared"] = sum(len(it.rows) for it in compared if it.position is not None)
        if not first.measured.static and len(first.rows) > 1:
            facts["time between rows"] = _distinct(f"{_step(it):.4g} s" for it in compared)
        facts["kind"] = type(first.robot).__name__
        facts["length"] = f"{_Errors([first]).length:.4g} m"
        facts["nodes"] = first.robot.nodes
        facts["scheme along the rod"] = _distinct(it.space for it in compared)
        if settings is not None and settings.time is not None:
            facts["scheme in time"] = type(settings.time).__name__
        facts["start"] = (
            "each row is an equilibrium"
            if first.measured.static
            else (
                "unstressed"
                if first.measured.unstressed
                else "equilibrium under the controls before the first row"
            )
        )
        facts["origin of the recordings"] = _distinct(
            {True: "a simulated robot", False: "a physical robot", None: "not stated"}[it.measured.simulated]
            for it in compared
        )
    bands = [it.band for it in evaluations.values() if it.band]
    if bands:
        facts["band"] = (
            f"{_percent(bands[0].level)}, of {_distinct(str(it.members) for it in bands)} models"
            + (
                f"; {sum(it.failed for it in bands)} without a solution"
                if any(it.failed for it in bands)
                else ""
            )
        )
    facts["knode-cosserat"] = package_version()
    facts["date"] = datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z")
    items = "".join(
        f"<div><dt>{_text(name)}</dt><dd>{_text(value)}</dd></div>" for name, value in facts.items()
    )
    return f"<dl>{items}</dl>"


def _step(it: Comparison) -> float:
    """Return the time between compared rows (s)."""
    return float(np.median(np.diff(it.time))) if len(it.time) > 1 else float("nan")


def _distinct(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))


# figures


def _section(name: str, it: Evaluation) -> str:
    parts = [f"<section><h2>{_text(name)}</h2>"]
    compared = it.comparison
    if compared is not None:
        parts.append(f'<p class="quiet">{_text(_rows_text(compared))}</p>')
    if it.failed is not None:
        parts.append(f'<p class="failed">Failed, there is no prediction: {_text(it.failed)}</p>')
    if it.band is not None:
        lost = f" {it.band.failed} more had no solution." if it.band.failed else ""
        parts.append(
            f"<p>{_percent(it.band.coverage)} of the measured coordinates are inside the "
            f"{_percent(it.band.level)} band of {it.band.members} models.{lost} A band is calibrated if the "
            "two are equal; if far fewer are inside, the models share an error.</p>"
        )
    if it.several is not None:
        parts.append(f"<p>Several equilibria: {_text(str(it.several))}.</p>")
    if it.sensors:
        rows = "".join(
            f"<tr><td>{_text(each)}</td><td>{error:.3g}</td></tr>" for each, error in it.sensors.items()
        )
        parts.append(
            '<div class="wide"><table><thead><tr><th>sensor</th><th>RMSE</th></tr></thead>'
            f"<tbody>{rows}</tbody></table></div>"
        )
    if compared is not None:
        parts.append(_cards(compared))
    return "\n".join([*parts, "</section>"])


def _rows_text(it: Comparison) -> str:
    measured, bodies = it.measured, len(it.measured.fractions)
    what = f"{measured.source}. " if measured.source else ""
    lost = len(it.rows) - int(measured.complete[it.rows].sum())
    if measured.static:
        rows = count_of(len(it.rows), "equilibrium", "equilibria")
    else:
        rows = count_of(len(it.rows), "row") + f" from {it.time[0]:g} to {it.time[-1]:g} s"
        if len(it.rows) > 1:
            rows += f", {_step(it):.4g} s apart"
            if it.rows[1] - it.rows[0] > 1:
                rows += f" (controls every {measured.dt:.4g} s)"
    places = ", ".join(f"{100.0 * at:.3g} %" for at in measured.fractions)
    seen = (
        f"; {count_of(bodies, 'body', 'bodies')} at {places} of the length" if bodies else "; no tracked body"
    )
    missing = f"; {count_of(lost, 'row')} without all bodies or controls, not counted" if lost else ""
    return f"{what}{rows}{seen}{missing}."


def _cards(it: Comparison) -> str:
    known = bool(np.isfinite(it.distance).any())
    thin = "; of neighbouring rows the smallest and the largest value are drawn" * (
        len(it.rows) > MOST_POINTS
    )
    several = it.seen.shape[1] > 1
    columns: list[list[str]] = [[], []]
    if it.seen.shape[1] or it.control.shape[1]:
        columns[0].append(_card(f"Tip, errors and controls{thin}", over_time, it))
    if known:
        columns[1].append(
            _card(
                "Worst instants: shapes from two sides, and the largest error of a body", worst_instants, it
            )
        )
        if several:
            columns[1].append(_card("Errors along the rod, by body", along_rod, it))
        # in the shorter column
        columns[0 if several else 1].append(_card("Distribution of the tip's error", histogram, it))
    stacks = "".join(f'<div class="stack">{"".join(cards)}</div>' for cards in columns)
    return f'<div class="cards">{stacks}</div>'


def _card(caption: str, draw: Callable[[Comparison], Any], it: Comparison) -> str:
    file = io.BytesIO()
    draw(it).savefig(file, format="svg")
    data = base64.b64encode(file.getvalue()).decode("ascii")
    picture = f'<img alt="{_text(caption)}" src="data:image/svg+xml;base64,{data}">'
    return f"<figure><figcaption>{_text(caption)}</figcaption>{picture}</figure>"
