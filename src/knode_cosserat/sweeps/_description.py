"""Description of a sweep: robots, controls, seeds and varied parameters, as plain data."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.yaml_text import YAMLTextError, did_you_mean, excerpt, mapping_of, read_yaml
from knode_cosserat._reprs import quantity
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.system import System

#: stored quantities by name: meaning and unit
STORED = {
    "tip_position": ("position of the tip", "m"),
    "tip_quaternion": ("orientation of the tip, scalar first", "1"),
    "position": ("positions of all nodes", "m"),
    "y": ("states at all nodes, in the order of the robot's y_layout", "SI"),
    "z": ("strains at all nodes, in the order of the robot's z_layout", "SI"),
    "controls": ("controls, row i held from time i dt", "SI"),
}
#: samplers by name, and their largest numbers of samples: SciPy's Sobol points have 30 bits, and its Latin
#: hypercube is computed as a whole by every worker
SAMPLERS = {
    "grid": math.inf,
    "sobol": 2**30,
    "halton": math.inf,
    "latin-hypercube": 10**7,
    "random": math.inf,
}
#: most cases of a sweep
MOST_CASES = 10**12


class SweepError(KnodeCosseratError, ValueError):
    """A sweep is not possible, or its folder cannot be read or written; the message is one line."""

    code = "sweep"


#: least values of whole numbers
LEAST = {"steps": 1, "samples": 1, "seed": 0, "shard": 1, "count": 2}


def _require_least(settings: Any) -> None:
    """Raise `SweepError` if a whole number is too small."""
    for name, least in LEAST.items():
        value = getattr(settings, name, None)
        if value is not None and value < least:
            raise SweepError(f"{name} is {value}; allowed is a whole number from {least} on")


def _require_known(problem: str, name: Any, known: Collection[str]) -> None:
    if name not in known:
        raise SweepError(f"{problem}; allowed is {', '.join(known)}{did_you_mean(name, known)}")


def _require_keys(mapping: Mapping[Any, Any], cls: type) -> None:
    """Raise `SweepError` unless a mapping has keys of a dataclass, among them all without a default."""
    fields = dataclasses.fields(cls)
    for key in mapping:
        _require_known(f"the key {excerpt(key)} is unknown", key, [field.name for field in fields])
    missing = dataclasses.MISSING
    required = [it.name for it in fields if it.default is missing and it.default_factory is missing]
    for key in required:
        if key not in mapping:
            raise SweepError(f"the key {key!r} is missing; required is {', '.join(required)}")


@dataclasses.dataclass(frozen=True)
class Range:
    """Range of a varied number: from `low` to `high`, uniform, or uniform in the logarithm.

    `count` is the number of equidistant values on a grid.
    """

    low: float
    high: float
    scale: Literal["linear", "log"] = "linear"
    count: int | None = None

    def __post_init__(self) -> None:
        check_arguments(Range.__init__, vars(self), SweepError)
        _require_least(self)
        for name in ("low", "high"):
            object.__setattr__(self, name, float(getattr(self, name)))
        if not -math.inf < self.low < self.high < math.inf:
            raise SweepError(
                f"low is {self.low:g} and high {self.high:g}; allowed is low below high, both finite"
            )
        if self.scale == "log" and not self.low > 0.0:
            raise SweepError(f"low is {self.low:g}; allowed with the scale log is a number above 0")


@dataclasses.dataclass(frozen=True)
class RobotEntry:
    """One robot of a sweep: a catalog name, a robot or model file, or a system, and changed parameters."""

    robot: str | System
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name or file of the robot; of a system, its class."""
        return self.robot if isinstance(self.robot, str) else type(self.robot).__name__

    @property
    def label(self) -> str:
        """Name of the robot in tables, with its changes."""
        return self.name + "".join(f", {key}={excerpt(value)}" for key, value in self.changes.items())


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Description of a sweep. Every combination of robot, control, seed and sample is one case.

    Attributes:
        robots: a catalog name, a robot or model file, a system, or a list of these. An entry
            {"robot": NAME, "set": {PARAMETER: VALUE}} has changed parameters, also such as `nodes`.
        controls: words as for `controls.parse`, one or several: `sine:1.5`, `base_z=ramp:0.1`, a CSV
            file. A name in braces is a varied number, as in `sine:{period}`; `{seed}` is the case's seed.
        steps: number of time steps.
        dt: time step (s).
        vary: by name, a `Range` (or a mapping of its fields) or a list of values. A name is a
            parameter of the robots, such as `length` or `loads.0.mass`, or a name in braces of the controls.
        sampler: "grid" (all combinations; ranges need a count), "sobol", "halton", "latin-hypercube" or
            "random".
        samples: number of samples, except on a grid.
        seed: seed of the sampler and of the cases' seeds.
        seeds: list of seeds for `{seed}` in the controls, combined with all else. By default every sample
            has its own seed.
        store: stored quantities, from `STORED`. Results, position errors, parameters and reasons of failures
            are always stored.
        precision: "double", or "single" for half the size of the stored quantities.
        time: time scheme, as for `simulate`.
        space: space scheme, as for `simulate`.
        initial: "equilibrium" or "unstressed", as for `simulate`.
        recovery: try to recover failed steps, without a limit of time. It can take minutes a case.
        shard: cases in a file; by default up to 4096 and 16 MB.

    Raises:
        SweepError: a value is not allowed.
    """

    robots: Any
    controls: Any
    steps: int
    dt: float
    vary: dict[str, Any] = dataclasses.field(default_factory=dict)
    sampler: str = "grid"
    samples: int | None = None
    seed: int = 0
    seeds: Sequence[int] = ()
    store: Any = ("tip_position",)
    precision: Literal["double", "single"] = "double"
    time: str = "sdirk2"
    space: str = "lobatto2"
    initial: Literal["equilibrium", "unstressed"] = "equilibrium"
    recovery: bool = False
    shard: int | None = None

    def __post_init__(self) -> None:
        check_arguments(Sweep.__init__, vars(self), SweepError)
        _require_least(self)
        if min(self.seeds, default=0) < 0:
            raise SweepError(f"seeds is {excerpt(self.seeds)}; allowed is a list of whole numbers from 0 on")
        _require_known(f"sampler is {self.sampler!r}", self.sampler, SAMPLERS)
        store = _words("store", self.store) if self.store else ()
        for name in store:
            _require_known(f"store: {name!r} is unknown", name, STORED)
        if len(set(store)) < len(store):
            raise SweepError(f"store is {', '.join(store)}; allowed is each name once")
        robots = self.robots if isinstance(self.robots, list | tuple) else [self.robots]
        if not robots:
            raise SweepError("robots is empty; allowed is one robot or more")
        for name, value in {
            "dt": float(self.dt),
            "robots": tuple(map(_robot, robots)),
            "controls": _words("controls", self.controls),
            "vary": {name: _variation(name, values) for name, values in self.vary.items()},
            "seeds": tuple(map(int, self.seeds)),
            "store": store,
        }.items():
            object.__setattr__(self, name, value)
        if self.sampler == "grid":
            if self.samples is not None:
                raise SweepError(
                    f"samples is {excerpt(self.samples)}; a grid has all combinations, and no samples; leave "
                    "it out, or use the sampler sobol"
                )
            for name, values in self.vary.items():
                if isinstance(values, Range) and values.count is None:
                    raise SweepError(
                        f"vary: {name} has no count; required on a grid is the number of values, such as "
                        "count: 5; or use the sampler sobol"
                    )
        elif self.samples is None:
            raise SweepError(f"samples is missing; required is a number of samples for {self.sampler}")
        elif self.samples > (most := SAMPLERS[self.sampler]):
            raise SweepError(f"samples is {self.samples}; allowed with {self.sampler} is up to {most}")
        if self.case_count > MOST_CASES:
            raise SweepError(f"there are {self.case_count} cases; allowed is up to {MOST_CASES:.0e}")

    @classmethod
    def of(cls, mapping: Any, source: str = "sweep") -> Self:
        """Return the sweep of a mapping with its fields; `source` names it in errors.

        Raises:
            SweepError: a key is unknown or missing, or a value is not allowed.
        """
        if not isinstance(mapping, Mapping):
            raise SweepError(f"{source}: the sweep is {excerpt(mapping)}; allowed is a mapping of settings")
        try:
            _require_keys(mapping, cls)
            return cls(**mapping)
        except SweepError as error:
            raise SweepError(f"{source}: {error}") from None

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the sweep described in a YAML file. Raises `SweepError`."""
        return cls.of(read_mapping(path), str(path))

    @property
    def sample_count(self) -> int:
        """Number of samples."""
        if self.sampler != "grid":
            return int(self.samples or 0)
        return math.prod(value_count(values) for values in self.vary.values())

    @property
    def case_count(self) -> int:
        """Number of cases."""
        return len(self.robots) * len(self.controls) * max(1, len(self.seeds)) * self.sample_count

    def described(self) -> dict[str, Any]:
        """Return the sweep as plain data, as in a YAML file."""
        varied = {
            name: {key: value for key, value in dataclasses.asdict(values).items() if value is not None}
            if isinstance(values, Range)
            else list(values)
            for name, values in self.vary.items()
        }
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)} | {
            "robots": [
                {"robot": robot.name, "set": dict(robot.changes)} if robot.changes else robot.name
                for robot in self.robots
            ],
            "controls": list(self.controls),
            "vary": varied,
            "seeds": list(self.seeds),
            "store": list(self.store),
        }

    def __repr__(self) -> str:
        varied = ", ".join(
            f"{name} {quantity(np.array([values.low, values.high]))}" if isinstance(values, Range) else name
            for name, values in self.vary.items()
        )
        return (
            f"Sweep: {self.case_count:,} cases ({len(self.robots)} robots, {len(self.controls)} controls, "
            f"{max(1, len(self.seeds))} seeds, {self.sample_count:,} samples by {self.sampler}) of "
            f"{self.steps} steps of {self.dt:g} s; varied: {varied or 'nothing'}"
        )


def read_mapping(path: str | Path) -> dict[Any, Any]:
    """Return the mapping in a YAML file. Raises `SweepError`."""
    try:
        return mapping_of(read_yaml(path), "robots, controls, steps and dt")
    except YAMLTextError as error:
        raise SweepError(f"{path}: {error}") from None


def value_count(variation: Range | tuple[Any, ...]) -> int:
    """Return the number of values of a variation on a grid."""
    return int(variation.count or 1) if isinstance(variation, Range) else len(variation)


def values_at(variation: Range | tuple[Any, ...], fraction: np.ndarray) -> np.ndarray:
    """Return the values of a variation at fractions 0 to 1; they never leave its range."""
    if not isinstance(variation, Range):
        index = np.minimum((fraction * len(variation)).astype(int), len(variation) - 1)
        return np.asarray(variation, dtype=float)[index]
    low, high = variation.low, variation.high
    if variation.scale == "log":
        return np.clip(np.exp(np.log(low) + fraction * (np.log(high) - np.log(low))), low, high)
    return np.clip(low + fraction * (high - low), low, high)


def _words(name: str, value: Any) -> tuple[str, ...]:
    words = (value,) if isinstance(value, str) else tuple(value) if isinstance(value, list | tuple) else ()
    if not words or not all(isinstance(word, str) for word in words):
        raise SweepError(f"{name} is {excerpt(value)}; allowed is a word or a list of words")
    return words


def _robot(entry: Any) -> RobotEntry:
    if isinstance(entry, RobotEntry):
        return entry
    if isinstance(entry, str | System):
        return RobotEntry(entry)
    if not isinstance(entry, Mapping) or not {"robot"} <= entry.keys() <= {"robot", "set"}:
        raise SweepError(
            f"robots: {excerpt(entry)} is not understood; allowed is a name, a file, or robot: NAME with "
            "set: {PARAMETER: VALUE}"
        )
    changes = entry.get("set") or {}
    if not isinstance(entry["robot"], str | System) or not isinstance(changes, Mapping):
        raise SweepError(f"robots: {excerpt(entry)} is not understood; allowed is a name and a mapping")
    return RobotEntry(entry["robot"], dict(changes))


def _variation(name: Any, values: Any) -> Range | tuple[Any, ...]:
    if not isinstance(name, str):
        raise SweepError(f"vary: the name {excerpt(name)} is not text")
    if isinstance(values, Range):
        return values
    try:
        if isinstance(values, Mapping):
            _require_keys(values, Range)
            return Range(**values)
        values = values.tolist() if isinstance(values, np.ndarray) else values
        if not isinstance(values, list | tuple) or not values:
            raise SweepError(
                f"{excerpt(values)} is not understood; allowed is low and high, or a list of values"
            )
        try:
            array = np.asarray(values, dtype=float)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if not np.all(np.isfinite(array)):
            raise SweepError(f"{excerpt(values)} is not a list of finite numbers, or of vectors of one size")
        return tuple(array.tolist())
    except SweepError as error:
        raise SweepError(f"vary: {name}: {error}") from None
