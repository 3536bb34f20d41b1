"""Description of a sweep: robots, controls, seeds and varied parameters, as plain data."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from knode_cosserat._files.yaml_text import YAMLTextError, did_you_mean, mapping_of, read_yaml, shown
from knode_cosserat._reprs import quantity
from knode_cosserat.rods.system import System
from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.sampling import MOST_SOBOL, SAMPLERS

#: stored quantities by name: meaning and unit
STORED = {
    "tip_position": ("position of the tip", "m"),
    "tip_quaternion": ("orientation of the tip, scalar first", "1"),
    "position": ("positions of all nodes", "m"),
    "y": ("states at all nodes, in the order of the robot's y_layout", "SI"),
    "z": ("strains at all nodes, in the order of the robot's z_layout", "SI"),
    "controls": ("controls, row i held from time i dt", "SI"),
}
#: most cases of a shard, and most megabytes of numbers in one, if the description does not say
SHARD_CASES, SHARD_MEGABYTES = 4096, 16
#: most cases of a sweep
MOST_CASES = 10**12


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
        for name in ("low", "high"):
            value = getattr(self, name)
            if not _is_number(value):
                raise SweepError(f"{name} is {shown(value)}; allowed is a finite number")
            object.__setattr__(self, name, float(value))
        if self.scale not in ("linear", "log"):
            raise SweepError(f"scale is {shown(self.scale)}; allowed is linear or log")
        if not self.low < self.high:
            raise SweepError(f"low is {self.low:g} and high {self.high:g}; allowed is low below high")
        if self.scale == "log" and not self.low > 0.0:
            raise SweepError(f"low is {self.low:g}; allowed with the scale log is a number above 0")
        if self.count is not None:
            _require_count("count", self.count, least=2)

    def at(self, part: np.ndarray) -> np.ndarray:
        """Return the values at fractions 0 to 1 of the range; they never leave it."""
        if self.scale == "log":
            low, high = np.log(self.low), np.log(self.high)
            return np.clip(np.exp(low + part * (high - low)), self.low, self.high)
        return np.clip(self.low + part * (self.high - self.low), self.low, self.high)

    def described(self) -> dict[str, Any]:
        """Return the range as plain data."""
        return {name: each for name, each in dataclasses.asdict(self).items() if each is not None}


@dataclasses.dataclass(frozen=True)
class Robot:
    """One robot of a sweep: a catalog name, a robot or model file, or a system, and changed parameters."""

    robot: str | System
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def label(self) -> str:
        """Name of the robot in tables, with its changes."""
        name = self.robot if isinstance(self.robot, str) else type(self.robot).__name__
        return name + "".join(f", {key}={shown(value)}" for key, value in self.changes.items())

    def described(self) -> Any:
        """Return the entry as plain data."""
        name = self.robot if isinstance(self.robot, str) else type(self.robot).__name__
        return {"robot": name, "set": dict(self.changes)} if self.changes else name


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Description of a sweep. Every combination of robot, control, seed and sample is one case.

    Attributes:
        robots: a catalog name, a robot or model file, a system, or a list of these. An entry
            {"robot": NAME, "set": {PARAMETER: VALUE}} has changed parameters, also such as `nodes`.
        controls: words as for `named_controls.parse`, one or several: `sine:1.5`, `base_z=ramp:0.1`, a CSV
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
        recovery: try to recover failed steps, without a limit of time. It can take minutes a case.
        shard: cases in a file; by default up to 4096 and 16 MB.
    """

    robots: Any
    controls: Any
    steps: int
    dt: float
    vary: Any = dataclasses.field(default_factory=dict)
    sampler: str = "grid"
    samples: int | None = None
    seed: int = 0
    seeds: Any = ()
    store: Any = ("tip_position",)
    precision: Literal["double", "single"] = "double"
    time: str = "sdirk2"
    space: str = "lobatto2"
    recovery: bool = False
    shard: int | None = None

    def __post_init__(self) -> None:
        for name, value in {
            "robots": _robots(self.robots),
            "controls": _words("controls", self.controls),
            "vary": _variations(self.vary),
            "seeds": tuple(self.seeds) if isinstance(self.seeds, Sequence | np.ndarray) else self.seeds,
            "store": _words("store", self.store) if self.store else (),
        }.items():
            object.__setattr__(self, name, value)
        _require_count("steps", self.steps)
        if not _is_number(self.dt) or not self.dt > 0.0:
            raise SweepError(f"dt is {shown(self.dt)}; allowed is a number of seconds above 0")
        object.__setattr__(self, "dt", float(self.dt))
        _require_count("seed", self.seed, least=0)
        if self.shard is not None:
            _require_count("shard", self.shard)
        self._check_words()
        self._check_sampler()

    def _check_words(self) -> None:
        for name in self.store:
            if name not in STORED:
                raise SweepError(
                    f"store: {name!r} is unknown; allowed is {', '.join(STORED)}{did_you_mean(name, STORED)}"
                )
        if len(set(self.store)) < len(self.store):
            raise SweepError(f"store is {', '.join(self.store)}; allowed is each name once")
        for name, allowed in (("precision", ("double", "single")), ("recovery", (False, True))):
            if getattr(self, name) not in allowed:
                words = " or ".join(str(each).lower() for each in allowed)
                raise SweepError(f"{name} is {shown(getattr(self, name))}; allowed is {words}")
        if not isinstance(self.seeds, tuple):
            raise SweepError(f"seeds is {shown(self.seeds)}; allowed is a list of whole numbers")
        for seed in self.seeds:
            _require_count("seeds", seed, least=0)

    def _check_sampler(self) -> None:
        if self.sampler not in SAMPLERS:
            raise SweepError(
                f"sampler is {shown(self.sampler)}; allowed is {', '.join(SAMPLERS)}"
                f"{did_you_mean(self.sampler, SAMPLERS)}"
            )
        ranges = {name: each for name, each in self.vary.items() if isinstance(each, Range)}
        if self.sampler == "grid":
            if self.samples is not None:
                raise SweepError(
                    f"samples is {shown(self.samples)}; a grid has all combinations, and no "
                    "samples; leave it out, or use the sampler sobol"
                )
            for name, each in ranges.items():
                if each.count is None:
                    raise SweepError(
                        f"vary: {name} has no count; required on a grid is the number of values, such as "
                        "count: 5; or use the sampler sobol"
                    )
        else:
            if self.samples is None:
                raise SweepError(f"samples is missing; required is a number of samples for {self.sampler}")
            _require_count("samples", self.samples)
            if self.sampler == "sobol" and self.samples > MOST_SOBOL:
                raise SweepError(f"samples is {self.samples}; allowed with sobol is up to {MOST_SOBOL}")
        if self.case_count > MOST_CASES:
            raise SweepError(f"there are {self.case_count} cases; allowed is up to {MOST_CASES:.0e}")

    @classmethod
    def of(cls, mapping: Any, source: str = "sweep") -> Self:
        """Return the sweep of a mapping with its fields; `source` names it in errors.

        Raises:
            SweepError: a key is unknown or missing, or a value is not allowed.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        if not isinstance(mapping, Mapping):
            raise SweepError(f"{source}: the sweep is {shown(mapping)}; allowed is a mapping of settings")
        for key in mapping:
            if key not in known:
                raise SweepError(
                    f"{source}: the key {shown(key)} is unknown; allowed is {', '.join(known)}"
                    f"{did_you_mean(key, known)}"
                )
        for key in ("robots", "controls", "steps", "dt"):
            if key not in mapping:
                raise SweepError(
                    f"{source}: the key {key!r} is missing; required is robots, controls, steps, dt"
                )
        try:
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
        count = 1
        for each in self.vary.values():
            count *= int(each.count or 1) if isinstance(each, Range) else len(each)
        return count

    @property
    def case_count(self) -> int:
        """Number of cases."""
        return len(self.robots) * len(self.controls) * max(1, len(self.seeds)) * self.sample_count

    def described(self) -> dict[str, Any]:
        """Return the sweep as plain data, as in a YAML file."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return values | {
            "robots": [each.described() for each in self.robots],
            "controls": list(self.controls),
            "vary": {
                name: each.described() if isinstance(each, Range) else list(each)
                for name, each in self.vary.items()
            },
            "seeds": [int(each) for each in self.seeds],
            "store": list(self.store),
        }

    def __repr__(self) -> str:
        varied = ", ".join(
            f"{name} {quantity(np.array([each.low, each.high]))}" if isinstance(each, Range) else name
            for name, each in self.vary.items()
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


# checks


def _is_number(value: Any) -> bool:
    whole = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return whole and bool(np.isfinite(value))


def _require_count(name: str, value: Any, least: int = 1) -> None:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise SweepError(f"{name} is {shown(value)}; allowed is a whole number from {least} on")


def _words(name: str, given: Any) -> tuple[str, ...]:
    words = (given,) if isinstance(given, str) else tuple(given) if isinstance(given, list | tuple) else ()
    if not words or not all(isinstance(each, str) for each in words):
        raise SweepError(f"{name} is {shown(given)}; allowed is a word or a list of words")
    return words


def _robots(given: Any) -> tuple[Robot, ...]:
    entries = list(given) if isinstance(given, list | tuple) else [given]
    if not entries:
        raise SweepError("robots is empty; allowed is one robot or more")
    found = []
    for entry in entries:
        if isinstance(entry, Robot):
            found.append(entry)
        elif isinstance(entry, str | System):
            found.append(Robot(entry))
        elif isinstance(entry, Mapping) and {"robot"} <= entry.keys() <= {"robot", "set"}:
            changes = entry.get("set") or {}
            if not isinstance(entry["robot"], str | System) or not isinstance(changes, Mapping):
                raise SweepError(f"robots: {shown(entry)} is not understood; allowed is a name and a mapping")
            found.append(Robot(entry["robot"], dict(changes)))
        else:
            raise SweepError(
                f"robots: {shown(entry)} is not understood; allowed is a name, a file, or robot: NAME with "
                "set: {PARAMETER: VALUE}"
            )
    return tuple(found)


def _variations(given: Any) -> dict[str, Range | tuple[Any, ...]]:
    if not isinstance(given, Mapping):
        raise SweepError(f"vary is {shown(given)}; allowed is a mapping from names to ranges or lists")
    return {name: _variation(name, each) for name, each in given.items()}


def _variation(name: Any, given: Any) -> Range | tuple[Any, ...]:
    if not isinstance(name, str):
        raise SweepError(f"vary: the name {shown(name)} is not text")
    fields = [field.name for field in dataclasses.fields(Range)]
    if isinstance(given, Range):
        return given
    try:
        if isinstance(given, Mapping):
            for key in given:
                if key not in fields:
                    raise SweepError(
                        f"the key {shown(key)} is unknown; allowed is {', '.join(fields)}"
                        f"{did_you_mean(key, fields)}"
                    )
            if not {"low", "high"} <= given.keys():
                raise SweepError("low and high are required")
            return Range(**given)
        values = given.tolist() if isinstance(given, np.ndarray) else given
        if not isinstance(values, list | tuple) or not values:
            raise SweepError(
                f"{shown(given)} is not understood; allowed is low and high, or a list of values"
            )
        try:
            array = np.asarray(values, dtype=float)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if not np.all(np.isfinite(array)):
            raise SweepError(f"{shown(given)} is not a list of finite numbers, or of vectors of one size")
        return tuple(array.tolist())
    except SweepError as error:
        raise SweepError(f"vary: {name}: {error}") from None
