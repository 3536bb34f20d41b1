"""Plan of a sweep: loaded robots, checked variations, and the division of cases into shards.

Case k of a sweep belongs to one robot. Within a robot, all controls and seeds of one sample follow each
other, so that a sweep that was stopped early has whole samples. A shard has cases of one robot only.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import re
import string
from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import jax
import numpy as np

from knode_cosserat import controls
from knode_cosserat._files.json_text import json_checksum
from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.io.container import kind_of
from knode_cosserat.rods.parameters import owner_at, parameter_at
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.solvers.simulate import checked_dt
from knode_cosserat.sweeps._description import Range, RobotEntry, Sweep, SweepError, value_count, values_at
from knode_cosserat.sweeps._sampling import case_seeds, unit_points

#: most cases of a shard, and most megabytes of numbers in one, if the description does not say
SHARD_CASES, SHARD_MEGABYTES = 4096, 16


class Cases(NamedTuple):
    """Cases of one shard."""

    #: numbers of the cases within the sweep
    case: np.ndarray
    #: varied numbers (cases, …), by name
    values: dict[str, np.ndarray]
    #: index of the word of controls
    word: np.ndarray
    seed: np.ndarray
    #: (cases, steps, c)
    controls: np.ndarray
    #: by case, the reasons of refused controls
    refused: dict[int, str]


@dataclasses.dataclass(frozen=True)
class Plan:
    """Sweep with its robots loaded and its shards counted; workers receive it whole."""

    sweep: Sweep = dataclasses.field(compare=False)
    systems: tuple[System, ...] = dataclasses.field(compare=False)
    settings: Settings = dataclasses.field(compare=False)
    #: checksum of everything that the results depend on, apart from versions
    identity: str
    #: by robot and word: controls that are the same in all cases, read once because a file may change
    fixed: Mapping[tuple[int, int], np.ndarray] = dataclasses.field(compare=False)

    @classmethod
    def of(cls, sweep: Sweep) -> Self:
        """Return the plan of a sweep.

        Raises:
            SweepError: a robot, a varied name, a value or a word of controls is not allowed.
        """
        systems = tuple(_loaded(robot) for robot in sweep.robots)
        used = {name for word in sweep.controls for name in placeholders(word)}
        for name in used - {"seed"}:
            if name not in sweep.vary:
                raise SweepError(
                    f"controls: {{{name}}} is not varied; allowed is seed, or a name under vary"
                    f"{did_you_mean(name, ['seed', *sweep.vary])}"
                )
        if "seed" in sweep.vary:
            raise SweepError("vary: seed is given by seed and seeds; allowed is another name")
        if sweep.seeds and "seed" not in used:
            raise SweepError("seeds are given, and no controls use {seed}; such as random:{seed}")
        for system in systems:
            for name, variation in sweep.vary.items():
                _check_variation(system, name, variation, name in used)
        try:
            checked_dt(sweep.dt)
            settings = Settings.of(sweep.time, sweep.space, "consistent", NewtonOptions())
        except ValueError as error:
            raise SweepError(str(error)) from None
        if "controls" in sweep.store and not all(system.control_layout.size for system in systems):
            raise SweepError("store: controls: a robot has none; allowed is a robot with controls")
        if settings.time is None:
            raise SweepError("time is None; allowed is a time scheme: equilibria have no time steps")
        fixed = _fixed_controls(sweep, systems)
        content = {key: value for key, value in sweep.described().items() if key != "robots"}
        controls = [hashlib.sha256(array.tobytes()).hexdigest() for array in fixed.values()]
        identity = json_checksum([content, controls, [_system_checksum(system) for system in systems]])
        return cls(sweep, systems, settings, identity, fixed)

    # division into shards

    @property
    def robot_cases(self) -> int:
        """Number of cases of each robot."""
        return self.sweep.case_count // len(self.systems)

    def stored_shapes(self, robot: int) -> dict[str, tuple[int, ...]]:
        """Return the shape of each stored quantity of one case of a robot."""
        system, rows = self.systems[robot], self.sweep.steps + 1
        shapes = {
            "tip_position": (rows, 3), "tip_quaternion": (rows, 4), "position": (rows, system.nodes, 3),
            "y": (rows, system.nodes, system.y_layout.size),
            "z": (rows, system.nodes, system.z_layout.size),
            "controls": (self.sweep.steps, system.control_layout.size),
        }  # fmt: skip
        return {name: shapes[name] for name in self.sweep.store}

    def case_bytes(self, robot: int) -> int:
        """Bytes of one case of a robot in memory: stored quantities, results and errors."""
        numbers = sum(int(np.prod(shape)) for shape in self.stored_shapes(robot).values())
        size = 8 if self.sweep.precision == "double" else 4
        return size * numbers + 9 * (self.sweep.steps + 1) + 8 * (3 + len(self.sweep.vary))

    @functools.cached_property
    def shard_cases(self) -> int:
        """Number of cases in a shard; the last shard of a robot has the rest."""
        if self.sweep.shard is not None:
            return self.sweep.shard
        largest = max(self.case_bytes(robot) for robot in range(len(self.systems)))
        return min(SHARD_CASES, 16 * max(1, SHARD_MEGABYTES * 10**6 // largest // 16))

    @property
    def robot_shards(self) -> int:
        """Number of shards of each robot."""
        return -(-self.robot_cases // self.shard_cases)

    @property
    def shard_count(self) -> int:
        """Number of shards."""
        return self.robot_shards * len(self.systems)

    @property
    def total_bytes(self) -> int:
        """Bytes of all cases in memory; files are smaller."""
        return sum(self.case_bytes(robot) * self.robot_cases for robot in range(len(self.systems)))

    def span(self, shard: int) -> tuple[int, int, int]:
        """Return the robot of a shard, and its first and last (exclusive) case within the robot's."""
        robot, part = divmod(shard, self.robot_shards)
        first = part * self.shard_cases
        return robot, first, min(first + self.shard_cases, self.robot_cases)

    def cases(self, shard: int) -> Cases:
        """Return the cases of a shard."""
        sweep, (robot, first, last) = self.sweep, self.span(shard)
        index, words, seeds = np.arange(first, last), len(sweep.controls), max(1, len(sweep.seeds))
        sample, rest = np.divmod(index, words * seeds)
        word, seed_index = np.divmod(rest, seeds)
        span = int(sample[0]), int(sample[-1]) + 1
        values = {name: array[sample - span[0]] for name, array in self._samples(span).items()}
        seed = (
            np.array(sweep.seeds, dtype=np.int64)[seed_index]
            if sweep.seeds
            else case_seeds(sweep.seed, span)[sample - span[0]]
        )
        numbers = {name: array for name, array in values.items() if array.ndim == 1} | {"seed": seed}
        controls = np.zeros((len(index), sweep.steps, self.systems[robot].control_layout.size))
        refused: dict[int, str] = {}
        for w, text in enumerate(sweep.controls):
            rows = np.flatnonzero(word == w)
            if (robot, w) in self.fixed:
                controls[rows] = self.fixed[robot, w]
            elif len(rows):
                picked = {name: array[rows] for name, array in numbers.items()}
                controls[rows], reasons = case_controls(
                    self.systems[robot], text, sweep.steps, sweep.dt, picked
                )
                refused |= {int(rows[k]): reason for k, reason in reasons.items()}
        return Cases(robot * self.robot_cases + index, values, word, seed, controls, refused)

    def _samples(self, span: tuple[int, int]) -> dict[str, np.ndarray]:
        """Return the varied numbers of samples first to last (exclusive)."""
        sweep, fractions = self.sweep, {}
        if sweep.sampler == "grid":
            rest = np.arange(*span)
            for name, variation in reversed(sweep.vary.items()):
                count = value_count(variation)
                rest, digit = np.divmod(rest, count)
                is_range = isinstance(variation, Range)
                fractions[name] = digit / (count - 1) if is_range else (digit + 0.5) / count
        else:
            points = unit_points(sweep.sampler, span, len(sweep.vary), sweep.sample_count, int(sweep.seed))
            fractions = dict(zip(sweep.vary, points.T, strict=True))
        return {name: values_at(variation, fractions[name]) for name, variation in sweep.vary.items()}


# checks


def _loaded(entry: RobotEntry) -> System:
    """Return a robot by name, file or model file, with changed parameters."""
    try:
        system = entry.robot
        if isinstance(system, str) and kind_of(system) in ("knode-cosserat model", "HDF5"):
            from knode_cosserat.learning.knode import load_model

            system = load_model(system)
        system = load_robot(system) if isinstance(system, str) else system
        system = system.replace(**entry.changes) if entry.changes else system
    except (KnodeCosseratError, ValueError) as error:
        raise SweepError(f"robots: {error}") from None
    if np.ndim(system.length):
        raise SweepError("robots: a batch of robots is no single robot; give a list of them")
    return system


def _check_variation(system: System, name: str, variation: Range | tuple[Any, ...], used: bool) -> None:
    """Raise `SweepError` unless a robot has a parameter and allows its values; or it is for controls only."""
    stated = parameter_at(nominal_model(system), name)
    if used and not isinstance(variation, Range) and any(np.ndim(value) for value in variation):
        raise SweepError(f"vary: {name} is used in controls; allowed is a list of numbers")
    if stated is None and used:
        return
    try:
        if stated is None:
            if name not in {field.name for field in dataclasses.fields(nominal_model(system))}:
                system.replace(**{name: 0.0})  # raises, with the names that there are
            static = True
        else:
            owner, last = owner_at(nominal_model(system), name)
            fields = {field.name: field for field in dataclasses.fields(owner)}
            static = bool(fields[last].metadata.get("static", False))
        if static:
            raise SweepError(
                f"{name} cannot vary within a robot, because it shapes its program; give a list of robots, "
                f"each with set: {{{name}: VALUE}}"
            )
        if isinstance(variation, Range) and stated and stated.shape != "scalar":
            raise SweepError(f"{name} is not one number; allowed is a list of its values")
        for value in (variation.low, variation.high) if isinstance(variation, Range) else variation:
            system.replace(**{name: value})
    except (KnodeCosseratError, ValueError) as error:
        raise SweepError(f"vary: {error}") from None


def _fixed_controls(sweep: Sweep, systems: tuple[System, ...]) -> dict[tuple[int, int], np.ndarray]:
    """Return controls without varied numbers, by robot and word; check the words with varied numbers.

    A word with varied numbers must be possible for its first, middle or last value: else the word is wrong.
    """
    fixed = {}
    trial = {name: values_at(variation, np.array([0.0, 0.5, 1.0])) for name, variation in sweep.vary.items()}
    for robot, system in enumerate(systems):
        for w, word in enumerate(sweep.controls):
            if not placeholders(word):
                fixed[robot, w] = controls.parse(word, sweep.steps, sweep.dt, system)
                continue
            numbers = trial | {"seed": np.arange(3)}
            _, refused = case_controls(system, word, sweep.steps, sweep.dt, numbers)
            if len(refused) == 3:
                raise SweepError(refused[1])
    return fixed


def placeholders(word: str) -> list[str]:
    """Return the names in braces in a word of controls. Raises `SweepError` for unmatched braces."""
    allowed = "allowed is a name in braces: sine:{period}"
    try:
        names = [name for _, name, _, _ in string.Formatter().parse(word) if name is not None]
    except ValueError as error:
        raise SweepError(f"controls {word!r}: {error}; {allowed}") from None
    for name in names:
        if not re.fullmatch(r"[A-Za-z_][\w-]*", name):
            raise SweepError(f"controls {word!r}: {{{name}}} is no name; {allowed}")
    return list(dict.fromkeys(names))


def case_controls(
    robot: System, word: str, steps: int, dt: float, numbers: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, dict[int, str]]:
    """Return the controls (cases, steps, c) of cases, and reasons of refused ones, which are zeros.

    `numbers` are the values of the names in braces, one a case.
    """
    # a Python number prints all its digits
    varied = {name: numbers[name].tolist() for name in placeholders(word)}
    cases = [dict(zip(varied, values, strict=True)) for values in zip(*varied.values(), strict=True)]
    values, refused = np.zeros((len(cases), steps, robot.control_layout.size)), {}
    for k, case in enumerate(cases):
        try:
            values[k] = controls.parse(word.format(**case), steps, dt, robot)
        except controls.ControlsError as error:
            refused[k] = str(error)
    return values, refused


def _system_checksum(system: System) -> str:
    """Return a checksum of a system: class, fields and all numbers."""
    leaves, structure = jax.tree.flatten(system)
    digest = hashlib.sha256(re.sub(r"0x[0-9a-f]+", "", f"{type(system).__name__} {structure}").encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        digest.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
