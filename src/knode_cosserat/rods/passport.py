"""Passport of a model: what it was learned from, and the range of controls and strains there.

Outside of this range the model extrapolates: results mark such rows (`Trajectory.extrapolated`).
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import sys
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat._files.writing import package_version
from knode_cosserat._files.yaml_text import excerpt
from knode_cosserat._settings import FLAG, LINE, Rule, ValidatedSettings, number, numbers
from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.system import System, array_module

#: tolerance beyond a range, as a part of the largest range in its field. A mostly planar bend is then inside
#: in spite of a trace of bending in the other plane. A model's own motion under the controls of its training
#: data is inside too; its rates differ from the data by some percent
MARGIN = 0.1
#: relative tolerance for constant values, which have rounding errors only
ROUNDING = 1e-9
#: ranges of a passport, the word for one of their numbers, and the end of its unit
PARTS = {"controls": ("", ""), "strains": ("strain ", ""), "rates": ("rate of strain ", "/s")}

COUNT = Rule(
    "a whole number from 0 on",
    lambda value: value if type(value) is int and value >= 0 else None,
    {"type": "integer", "minimum": 0},
)

Model = TypeVar("Model", bound=System)


@dataclasses.dataclass(frozen=True)
class Origin(ValidatedSettings):
    """Recording or trajectory that a model was learned from, or that was held out.

    Attributes:
        name: file, or description.
        sha256: of the file, as `sha256sum` prints it (several files of one recording are joined by "+"), or
            of the rows if they were read from no file.
        rows: number of rows used.
        seconds: their duration (s); 0 for equilibria.
        learned: false if the model was only tested on it.
        held_out_error: root mean square error (m) of the tip in a prediction that was not learned from it.
    """

    error: ClassVar[type[Exception]] = ParameterError

    name: Annotated[str, LINE]
    sha256: Annotated[str, LINE]
    rows: Annotated[int, COUNT]
    seconds: Annotated[float, number(0.0, 1e12)] = 0.0
    learned: Annotated[bool, FLAG] = True
    held_out_error: Annotated[float | None, number(0.0, 1e12)] = None

    @property
    def dt(self) -> float:
        """Time from row to row (s); 0 for equilibria."""
        return self.seconds / (self.rows - 1) if self.rows > 1 else 0.0

    def __str__(self) -> str:
        rows = f"{self.rows} {'rows' if self.seconds else 'equilibria'}"
        motion = f", {self.seconds:.4g} s at {1.0 / self.dt:.4g} Hz" if self.dt else ""
        error = self.held_out_error
        end = "" if error is None else f"; tip error when held out {1e3 * error:.3g} mm"
        end = end if self.learned else f"; not learned from{end}"
        short = " + ".join(one[:12] for one in self.sha256.split("+"))
        return f"{self.name}: {rows}{motion}, sha256 {short}{end}"


@functools.partial(jax.tree_util.register_dataclass, data_fields=["low", "high"], meta_fields=["unit"])
@dataclasses.dataclass(frozen=True, eq=False)
class LearnedRange:
    """Smallest and largest numbers (n,) of a field of controls, strains or rates, over rows and nodes."""

    unit: str
    low: Float[Any, " n"]
    high: Float[Any, " n"]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON and YAML."""
        return {
            "unit": self.unit,
            "low": np.asarray(self.low).tolist(),
            "high": np.asarray(self.high).tolist(),
        }


class Excess(NamedTuple):
    """A number that leaves the learned range: its farthest value, the range, and the part of the passport."""

    name: str
    unit: str
    value: float
    low: float
    high: float
    part: str

    def __str__(self) -> str:
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        for digits in range(4, 13):  # as many as show the difference
            value, low, high = (f"{it:.{digits}g}" for it in (self.value, self.low, self.high))
            if value not in (low, high):
                break
        return f"{self.name} is {value}{unit} (learned {low} to {high})"


class _Facts:
    """Facts of a passport that are no numbers; all are equal, so that models can be stacked and compiled."""

    def __init__(self, **facts: Any):
        self.facts = facts

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Facts)

    def __hash__(self) -> int:
        return hash(_Facts)


@jax.tree_util.register_pytree_node_class
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Passport:
    """Recordings that a model was learned from, and the range of its controls and strains there.

    Files of robots and models hold it. `print` shows it in a few lines.

    Attributes:
        command: function that made the model: identify or fit.
        origins: recordings or trajectories.
        controls: ranges of controls, by field (SI units).
        strains: ranges of strains and internal variables over all nodes, by field of z.
        rates: ranges of their rates (per second); empty if it learned from equilibria only.
        date: of the end of learning (UTC).
        versions: of packages.
    """

    command: str
    origins: tuple[Origin, ...] = ()
    controls: Mapping[str, LearnedRange] = dataclasses.field(default_factory=dict)
    strains: Mapping[str, LearnedRange] = dataclasses.field(default_factory=dict)
    rates: Mapping[str, LearnedRange] = dataclasses.field(default_factory=dict)
    date: str = ""
    versions: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, command: str, origins: Iterable[Origin], system: System, motions: Iterable[Any]) -> Self:
        """Return the passport of a model that was learned now.

        Args:
            command: function that made it.
            origins: what it learned from.
            system: the model, for the layouts of controls and strains.
            motions: trajectories with the states of what it learned from; rows without a solution are left
                out, and the control of a motion's first row, which acted before.
        """
        rows: dict[str, list[np.ndarray]] = {part: [] for part in PARTS}
        for motion in motions:
            solved = np.asarray(motion.result) >= 0
            numbers = compared_numbers(motion)
            numbers["z"] = np.where(solved[:, None, None], numbers["z"], np.nan)
            for part, _, values in _values(system, **numbers):
                known = np.where(solved[:, None, None], values, np.nan)
                rows[part].append(known[np.all(np.isfinite(known), axis=2)])
        versions = {
            "knode-cosserat": package_version(),
            "jax": jax.__version__,
            "numpy": np.__version__,
            "python": ".".join(map(str, sys.version_info[:3])),
        }
        date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        ranges = {part: _ranges(part, _layout(system, part), known) for part, known in rows.items()}
        return cls(command, tuple(origins), **ranges, date=date, versions=versions)

    # a pytree: ranges are arrays, of a batch of models too

    def tree_flatten(self) -> tuple[tuple[Any, ...], _Facts]:
        """Return the ranges, and the facts."""
        ranges = tuple(dict(getattr(self, part)) for part in PARTS)
        return ranges, _Facts(
            command=self.command, origins=self.origins, date=self.date, versions=self.versions
        )

    @classmethod
    def tree_unflatten(cls, facts: _Facts, ranges: Iterable[Any]) -> Self:
        """Return the passport of ranges and facts."""
        return cls(**facts.facts, **dict(zip(PARTS, ranges, strict=True)))

    # files

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON and YAML, which `from_dict` reads."""
        return {
            "command": self.command,
            "date": self.date,
            "versions": dict(self.versions),
            "origins": [origin.to_dict() for origin in self.origins],
            **{
                part: {name: one.to_dict() for name, one in sorted(getattr(self, part).items())}
                for part in PARTS
            },
        }

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """Return the passport of plain values. Raises `ParameterError`."""
        known = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(values, dict) or any(name not in known for name in values):
            raise ParameterError(f"passport is {excerpt(values)}; allowed is a mapping of {', '.join(known)}")
        texts = {name: values.get(name, "") for name in ("command", "date")}
        versions, origins = values.get("versions", {}), values.get("origins", [])
        for name, value in texts.items():
            _require(f"passport.{name}", value, str, "text")
        _require("passport.versions", versions, dict, "a mapping of texts")
        for name, value in versions.items():
            _require(f"passport.versions.{name}", value, str, "text")
        _require("passport.origins", origins, list, "a list")
        for k, one in enumerate(origins):
            _require(f"passport.origins.{k}", one, dict, "a mapping")
        ranges: dict[str, Any] = {
            part: _read_ranges(f"passport.{part}", values.get(part, {})) for part in PARTS
        }
        return cls(**texts, versions=versions, origins=tuple(map(Origin.from_dict, origins)), **ranges)

    def __str__(self) -> str:
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        lines = [f"learned by {self.command}, {self.date}, with {versions}; from"]
        lines += [f"  {origin}" for origin in self.origins]
        for part in PARTS:
            lines.append(f"range of {part}" if getattr(self, part) else f"range of {part}: none")
            for name, one in getattr(self, part).items():
                unit = "" if one.unit in ("", "1") else f" {one.unit}"
                ends = zip(np.atleast_1d(one.low).tolist(), np.atleast_1d(one.high).tolist(), strict=True)
                lines.append(f"  {name}: {', '.join(f'{low:.4g} to {high:.4g}' for low, high in ends)}{unit}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"Passport: {self}"

    # use

    def bounds(
        self, part: Literal["controls", "strains", "rates"], layout: Layout
    ) -> tuple[Float[Any, "*batch n"], Float[Any, "*batch n"]]:
        """Return the lowest and highest numbers of a part, in the order of a layout; infinite if unknown.

        Args:
            part: "controls", "strains" or "rates".
            layout: the model's `control_layout`, or `z_layout` for the others.
        """
        known: Mapping[str, LearnedRange] = getattr(self, part)
        axes = max((np.shape(one.low)[:-1] for one in known.values()), key=len, default=())
        numeric, low, high = array_module(known), list[Any](), list[Any]()
        for field in layout.fields:
            one = known.get(field.name)
            if one is None or np.shape(one.low)[-1] != field.size:  # a part that was changed since
                one = LearnedRange("", *(np.full((*axes, field.size), end) for end in (-np.inf, np.inf)))
            low, high = [*low, one.low], [*high, one.high]
        if not low:
            return np.zeros((*axes, 0)), np.zeros((*axes, 0))
        return numeric.concatenate(low, axis=-1), numeric.concatenate(high, axis=-1)

    def limits(self, part: str, layout: Layout) -> tuple[Float[Any, " n"], Float[Any, " n"]]:
        """Return the numbers below and above which a model extrapolates: `bounds` with a tolerance."""
        low, high, slack = (it[..., 0, 0, :] for it in self._limits(part, layout))
        return low - slack, high + slack

    def outside(self, system: System, **numbers: Any) -> Bool[Any, "*batch T"]:
        """Return True for rows outside the range, by more than a tenth of the largest range in its field.

        Args:
            system: the model.
            numbers: `control` (…, T, c), `z` (…, T, N, z) or None, and `time` (T,) or None for no rates; NaN
                does not count.
        """
        return functools.reduce(
            lambda one, other: one | other,
            [
                array_module(over).any(over > slack, axis=(-2, -1))
                for _, _, over, slack, *_ in self._over(system, **numbers)
            ],
        )

    def excesses(self, system: System, **numbers: Any) -> tuple[Excess, ...]:
        """Return the numbers that leave the range, the farthest first; arguments as for `outside`."""
        found: list[tuple[float, Excess]] = []
        for part, layout, over, slack, values, low, high in self._over(system, **numbers):
            word, per = PARTS[part]
            units = [field.unit for field in layout.fields for _ in range(field.size)]
            part_over = np.where(over > slack, over, -np.inf)
            for k, (label, unit) in enumerate(zip(layout.labels, units, strict=True)):
                own = part_over[..., k]
                if not own.size or np.max(own) == -np.inf:
                    continue
                at: Any = (*np.unravel_index(int(np.argmax(own)), own.shape), k)
                value, least, most = (
                    float(np.broadcast_to(it, over.shape)[at]) for it in (values, low, high)
                )
                relative = float(over[at]) / max(float(np.broadcast_to(slack, over.shape)[at]), 1e-300)
                found.append((relative, Excess(word + label, f"{unit}{per}", value, least, most, part)))
        return tuple(excess for _, excess in sorted(found, key=lambda pair: -pair[0]))

    def _over(self, system: System, **numbers: Any) -> Iterator[tuple[Any, ...]]:
        """Yield for each part its layout, the distance beyond the range, its tolerance, values and range."""
        for part, layout, values in _values(system, **numbers):
            low, high, slack = self._limits(part, layout)
            over = array_module((values, low)).maximum(values - high, low - values)
            yield part, layout, over, slack, values, low, high

    def _limits(self, part: Any, layout: Layout) -> tuple[Any, Any, Any]:
        """Return the range of a part and its tolerance (…, 1, 1, n), kept unless they are traced."""
        known = vars(self).setdefault("_kept", {})
        if (part, layout) in known:
            limits: tuple[Any, Any, Any] = known[part, layout]
            return limits
        # batches of robots have leading axes in the bounds: the axes of rows and nodes are inserted
        low, high = (it[..., None, None, :] for it in self.bounds(part, layout))
        numeric = array_module((low, high))
        width = [
            numeric.repeat(layout.get(high - low, it.name).max(axis=-1, keepdims=True), it.size, axis=-1)
            for it in layout.fields
        ]
        slack = MARGIN * numeric.concatenate([low[..., :0], *width], axis=-1)
        slack = slack + ROUNDING * numeric.maximum(numeric.abs(low), numeric.abs(high))
        if numeric is np:
            known[part, layout] = low, high, slack
        return low, high, slack


def named(excesses: Iterable[Excess]) -> str:
    """Return the farthest control, strain and rate out of their ranges in words; empty if there are none."""
    every = list(excesses)
    farthest = {excess.part: str(excess) for excess in reversed(every)}
    more = f" and {len(every) - len(farthest)} more" if len(every) > len(farthest) else ""
    return ", ".join(farthest[part] for part in PARTS if part in farthest) + more


def compared_numbers(trajectory: Any) -> dict[str, Any]:
    """Return the arguments `control`, `z` and `time` of `Passport.outside` for a trajectory.

    Equilibria have no rates. The first control of several rows of a motion acted before, and does not count.
    """
    control, z, time = trajectory.control, trajectory.z, trajectory.time
    if trajectory.settings is not None and trajectory.settings.time is None:
        return {"control": control, "z": z, "time": None}
    if len(time) > 1:
        numeric = array_module(control)
        first = (numeric.arange(np.shape(control)[-2]) == 0)[:, None]
        control = numeric.where(first, numeric.nan, control)
    return {"control": control, "z": z, "time": time if len(time) > 1 else None}


def with_passport(model: Model, passport: Passport | None) -> Model:
    """Return a model with a passport."""
    changed: Model = eqx.tree_at(
        lambda it: it.passport,
        model,
        passport,
        is_leaf=lambda it: it is None or isinstance(it, Passport),
    )
    return changed


def without_passport(tree: Any) -> Any:
    """Return a system, or any tree of systems, without passports, as the solvers' programs expect.

    For the same system it is the same one, with arrays of its own.
    """
    return _bare_system(tree) if isinstance(tree, System) else _bare(tree)


@kept
def _bare_system(system: System) -> System:
    bare: System = jax.tree.map(
        lambda leaf: leaf.copy() if isinstance(leaf, np.ndarray) else leaf, _bare(system)
    )
    return bare


def _bare(tree: Any) -> Any:
    def is_passport(node: Any) -> bool:
        return isinstance(node, Passport)

    return jax.tree.map(lambda node: None if is_passport(node) else node, tree, is_leaf=is_passport)


# parts of a passport


def _layout(system: System, part: str) -> Layout:
    return system.control_layout if part == "controls" else system.z_layout


def _values(
    system: System, control: Any, z: Any = None, time: Any = None
) -> Iterator[tuple[str, Layout, Any]]:
    """Yield the numbers of each part, (…, T, nodes, n); controls have one node."""
    yield "controls", _layout(system, "controls"), control[..., None, :]
    if z is None:
        return
    yield "strains", _layout(system, "strains"), z
    if time is None:
        return
    numeric = array_module((time, z))
    steps = numeric.diff(numeric.asarray(time, dtype=float))[:, None, None]
    first = numeric.full_like(z[..., :1, :, :], numeric.nan)
    rates = numeric.concatenate([first, numeric.diff(z, axis=-3) / steps], axis=-3)
    yield "rates", _layout(system, "rates"), rates


def _ranges(part: str, layout: Layout, rows: list[np.ndarray]) -> dict[str, LearnedRange]:
    """Return the ranges of a part's fields over rows (k, n); none without rows."""
    values = np.concatenate(rows) if rows else np.zeros((0, layout.size))
    if not len(values):
        return {}
    return {
        field.name: LearnedRange(field.unit + PARTS[part][1], known.min(axis=0), known.max(axis=0))
        for field in layout.fields
        for known in [layout.get(values, field.name)]
    }


def _read_ranges(name: str, values: Any) -> dict[str, LearnedRange]:
    _require(name, values, dict, "a mapping from fields to ranges")
    found = {}
    for field, one in values.items():
        _require(f"{name}.{field}", one, dict, "a mapping with unit, low and high")
        unit, low, high = (one.get(key) for key in ("unit", "low", "high"))
        ends = [numbers(None, "").read(end) for end in (low, high)]
        if not isinstance(unit, str) or None in ends or len(ends[0]) != len(ends[1]):
            raise ParameterError(
                f"{name}.{field} is {excerpt(one)}; allowed is a unit, and as many numbers in low as in high"
            )
        found[str(field)] = LearnedRange(unit, *(np.array(end) for end in ends))
        if np.any(found[str(field)].low > found[str(field)].high):
            raise ParameterError(f"{name}.{field} has low above high: {excerpt(low)}, {excerpt(high)}")
    return found


def _require(name: str, value: Any, kind: type, words: str) -> None:
    if not isinstance(value, kind):
        raise ParameterError(f"{name} is {excerpt(value)}; allowed is {words}")
