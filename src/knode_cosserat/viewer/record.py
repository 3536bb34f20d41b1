"""Record of a closed loop for the viewer: shapes of robot and estimate, and numbers of the loop."""

from __future__ import annotations

import dataclasses
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.writing import replacing
from knode_cosserat.control import Controller, Plant, Status
from knode_cosserat.control.loop import Period, estimated, joined
from knode_cosserat.estimation.outputs import BodyPositions
from knode_cosserat.rods.paths import parameter_at
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.viewer.document import document
from knode_cosserat.viewer.drawing import sliders
from knode_cosserat.viewer.scene import encoded_array, kept, scene

#: most periods of a record; earlier ones are forgotten
MOST_PERIODS = 12_000
#: statuses in the order of their numbers
STATUSES = tuple(status.value for status in Status)
#: names of the drawn shapes: the robot, its estimate beside it, and the estimate of an unknown shape
TRUE, ESTIMATED, ONLY_ESTIMATED = "robot", "estimate", "estimate (the true shape is unknown)"


class LoopFacts(NamedTuple):
    """Facts of a loop that do not change: what the page draws and lists.

    `columns` are the first place and the size of each part of a row's numbers.
    """

    columns: dict[str, tuple[int, int]]
    controls: list[dict[str, Any]]
    #: names and units of the adapted parameters
    parameters: list[dict[str, str]]
    #: box of soft limits of the tip, [low, high] with None where it is open; None without one
    soft: list[list[float | None]] | None
    dt: float

    @classmethod
    def of(cls, controller: Controller, robot: Any, start: Float[np.ndarray, " c"]) -> LoopFacts:
        """Return the facts of a controller; `robot` is the one that is drawn, at the control `start`."""
        limits = getattr(controller, "limits", None)
        controls = sliders(robot)
        for k, each in enumerate(controls):
            each["start"] = float(start[k])
            if limits is not None:
                each["low"], each["high"] = (float(np.asarray(end)[k]) for end in (limits.low, limits.high))
        observer = getattr(controller, "observer", None)
        parameters = [] if observer is None else _parameters_of(observer)
        knots = getattr(controller, "knots", None)
        sizes = {
            "status": 1, "feedback": 1, "preparation": 1, "violation": 1, "missed": 1, "target": 3,
            "control": len(controls), "parameters": len(parameters), "deviations": len(parameters),
            "path": 0 if knots is None else 3 * knots.horizon,
        }  # fmt: skip
        ends = np.cumsum([0, *sizes.values()])
        columns = {name: (int(ends[k]), size) for k, (name, size) in enumerate(sizes.items())}
        return cls(columns, controls, parameters, _soft_box(controller), controller.dt)

    @property
    def width(self) -> int:
        """Number of numbers in a row."""
        return sum(size for _, size in self.columns.values())

    def row(self, period: Period, missed: int, deviations: dict[str, float]) -> Float[np.ndarray, " w"]:
        """Return the numbers of a period; NaN where the controller gave none."""
        command = period.command
        path = np.full(self.columns["path"][1], np.nan)
        if np.size(command.path) == len(path):
            path = np.ravel(command.path)
        return np.concatenate([
            [STATUSES.index(command.status.value), period.feedback, period.preparation],
            [command.violation, missed], period.reference[:3], command.control,
            [period.parameters[each["name"]] for each in self.parameters],
            [deviations[each["name"]] for each in self.parameters], path,
        ])  # fmt: skip

    def for_page(self) -> dict[str, Any]:
        """Return the facts as plain values for JSON."""
        return self._asdict() | {"statuses": STATUSES}


def _parameters_of(observer: Any) -> list[dict[str, str]]:
    """Return names and units of an observer's parameters."""
    names = observer.estimate.parameters
    return [{"name": name, "unit": _unit_of(observer.robot, name)} for name in names]


def _unit_of(robot: Any, label: str) -> str:
    """Return the unit of an adapted parameter, such as "loads.0.mass" or "gravity[0]"; "" if unknown."""
    stated = parameter_at(robot.nominal, label.partition("[")[0])
    return "" if stated is None else stated.unit


def _soft_box(controller: Any) -> list[list[float | None]] | None:
    """Return the box of a controller's soft limits of the tip, or None."""
    for soft in getattr(controller, "soft", ()):
        output = soft.output
        if isinstance(output, BodyPositions) and output.fractions == (1.0,):
            ends = [np.broadcast_to(np.asarray(end, dtype=float), (3,)) for end in (soft.low, soft.high)]
            return [[float(x) if np.isfinite(x) else None for x in end] for end in ends]
    return None


@dataclasses.dataclass
class Moment:
    """Shapes of one period by name, as `shapes` returns them, with the numbers of the loop."""

    time: float
    shapes: dict[str, Trajectory]
    numbers: Float[np.ndarray, " w"]
    reason: str


class LoopRecord:
    """Last periods of a loop, which can be exported as one file."""

    def __init__(self, facts: LoopFacts, most: int = MOST_PERIODS):
        self.facts = facts
        self.moments: deque[Moment] = deque(maxlen=most)

    def scene(self, title: str) -> dict[str, Any]:
        """Return the page's scene of the record.

        Raises:
            ValueError: no period has passed.
        """
        moments = list(self.moments)
        if not moments:
            raise ValueError("no period has passed; there is nothing to export")
        motions = {
            name: joined([moment.shapes[name] for moment in moments], [moment.time for moment in moments])
            for name in moments[0].shapes
        }
        numbers = np.array([moment.numbers for moment in moments])
        place, size = self.facts.columns["target"]
        first = next(iter(motions.values()))
        shown = scene(motions, title, _filled(numbers[0, place : place + size], first))
        rows = kept(np.shape(first.y), first.system.z_layout.size)[1]
        shown["tracks"] = for_loop(shown["tracks"])
        shown["loop"] = self.facts.for_page() | {
            "rows": encoded_array(numbers[rows], "f4"), "reasons": [moments[k].reason for k in rows],
        }  # fmt: skip
        return shown

    def page(self, title: str) -> str:
        """Return the record as one self-contained HTML page."""
        return document(self.scene(title))

    def export(self, path: str | Path, title: str) -> Path:
        """Write the record as one HTML file that any browser opens."""
        path = Path(path)
        text = self.page(title)
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        return path


def shapes(plant: Plant, controller: Controller) -> dict[str, Trajectory]:
    """Return the shapes of a period by name, each a trajectory of one row: the robot and its estimate.

    Only a simulated plant knows its shape, and only a controller with an observer has an estimate.

    Raises:
        ValueError: there is neither of them.
    """
    true: Trajectory | None = getattr(plant, "state", None)
    estimate = estimated(controller)
    if true is not None:
        return {TRUE: true} if estimate is None else {TRUE: true, ESTIMATED: estimate}
    if estimate is not None:
        return {ONLY_ESTIMATED: estimate}
    raise ValueError(
        "there is no shape to draw: the plant does not know its own, and the controller has no observer. "
        "Use a controller such as predictive"
    )


def for_loop(tracks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mark the second track as an overlay of the first."""
    return [each | {"overlay": k > 0} for k, each in enumerate(tracks)]


def _filled(target: Float[np.ndarray, "3"], motion: Trajectory) -> Float[np.ndarray, "3"]:
    """Return a target of the first row with the tip's coordinates in the place of free ones."""
    return np.where(np.isfinite(target), target, np.asarray(motion.tip_position)[0])
