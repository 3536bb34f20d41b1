"""Plan of a sweep: loaded robots, checked variations, and the division of cases into shards.

Case k of a sweep belongs to one robot. Within a robot, all controls and seeds of one sample follow each
other, so that a sweep that was stopped early has whole samples. A shard has cases of one robot only.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import re
from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import jax
import numpy as np

from knode_cosserat import named_controls
from knode_cosserat._files.json_text import json_checksum
from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.io.container import kind_of
from knode_cosserat.rods.paths import owner_at, parameter_at
from knode_cosserat.rods.robot_file import format_robot, load_robot
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import checked_dt
from knode_cosserat.sweeps.description import SHARD_CASES, SHARD_MEGABYTES, Range, Sweep
from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.sampling import case_seeds, unit_points
from knode_cosserat.sweeps.signals import placeholders, signals


class Cases(NamedTuple):
    """Cases of one shard: numbers by name, seeds, controls, and the reasons of refused controls."""

    #: numbers of the cases within the sweep
    case: np.ndarray
    #: varied numbers (cases, …), by name
    values: dict[str, np.ndarray]
    #: index of the word of controls
    word: np.ndarray
    seed: np.ndarray
    #: (cases, steps, c)
    controls: np.ndarray
    refused: dict[int, str]


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """Sweep with its robots loaded and its shards counted; workers receive it whole."""

    sweep: Sweep
    systems: tuple[System, ...]
    #: checksum of everything that the results depend on, apart from versions
    identity: str
    #: by robot and word: controls that are the same in all cases, read once because a file may change
    fixed: Mapping[tuple[int, int], np.ndarray]

    @classmethod
    def of(cls, sweep: Sweep) -> Self:
        """Return the plan of a sweep.

        Raises:
            SweepError: a robot, a varied name, a value or a word of controls is not allowed.
        """
        checked_dt(sweep.dt)
        systems = tuple(_loaded(each.robot, each.changes) for each in sweep.robots)
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
        _settings(sweep)
        fixed = _fixed_controls(sweep, systems)
        return cls(sweep, systems, _identity(sweep, systems, fixed), fixed)

    @property
    def settings(self) -> Settings:
        """Numerical settings."""
        return _settings(self.sweep)

    # division into shards

    @property
    def robot_cases(self) -> int:
        """Number of cases of each robot."""
        return self.sweep.case_count // len(self.systems)

    def case_bytes(self, robot: int) -> int:
        """Bytes of one case of a robot in memory: stored quantities, results and errors."""
        from knode_cosserat.sweeps.columns import stored_shapes

        item = 8 if self.sweep.precision == "double" else 4
        sizes = [int(np.prod(each)) for each in stored_shapes(self.systems[robot], self.sweep).values()]
        return item * sum(sizes) + 9 * (self.sweep.steps + 1) + 8 * (3 + len(self.sweep.vary))

    @functools.cached_property
    def shard_cases(self) -> int:
        """Number of cases in a shard; the last shard of a robot has the rest."""
        if self.sweep.shard is not None:
            return self.sweep.shard
        largest = max(self.case_bytes(robot) for robot in range(len(self.systems)))
        fitting = max(1, SHARD_MEGABYTES * 10**6 // largest)
        return min(SHARD_CASES, 16 * max(1, fitting // 16))

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

    def rows(self, shard: int) -> int:
        """Return the number of cases in a shard."""
        _, first, last = self.span(shard)
        return last - first

    # cases

    def cases(self, shard: int) -> Cases:
        """Return the cases of a shard."""
        return self.cases_of(*self.span(shard))

    def cases_of(self, robot: int, first: int, last: int) -> Cases:
        """Return a range of a robot's cases."""
        sweep, system = self.sweep, self.systems[robot]
        index = np.arange(first, last)
        words, seeds = len(sweep.controls), max(1, len(sweep.seeds))
        sample, rest = np.divmod(index, words * seeds)
        word, seed_index = np.divmod(rest, seeds)
        values = self._values(int(sample[0]), int(sample[-1]) + 1, sample - sample[0])
        seed = np.array(sweep.seeds, dtype=np.int64)[seed_index] if sweep.seeds else (
            case_seeds(sweep.seed, sample)
        )  # fmt: skip
        numbers = {name: each for name, each in values.items() if each.ndim == 1} | {"seed": seed}
        controls = np.zeros((len(index), sweep.steps, system.control_size))
        refused: dict[int, str] = {}
        for w, text in enumerate(sweep.controls):
            own = np.flatnonzero(word == w)
            picked = {name: each[own] for name, each in numbers.items()}
            if (robot, w) in self.fixed:
                controls[own] = self.fixed[robot, w]
                continue
            if not len(own):
                continue
            found = signals(system, text, sweep.steps, sweep.dt, picked, len(own))
            controls[own] = found.controls
            refused |= {int(own[k]): reason for k, reason in found.refused.items()}
        return Cases(robot * self.robot_cases + index, values, word, seed, controls, refused)

    def _values(self, first: int, last: int, sample: np.ndarray) -> dict[str, np.ndarray]:
        """Return the varied numbers of samples first to last, picked by index."""
        sweep = self.sweep
        if sweep.sampler == "grid":
            found, rest = {}, np.arange(first, last)
            for name, each in reversed(sweep.vary.items()):
                count = int(each.count or 1) if isinstance(each, Range) else len(each)
                rest, digit = np.divmod(rest, count)
                found[name] = (
                    each.at(digit / (count - 1)) if isinstance(each, Range) else _listed(each, digit)
                )
            return {name: found[name][sample] for name in sweep.vary}
        points = unit_points(
            sweep.sampler, (first, last), len(sweep.vary), sweep.sample_count, int(sweep.seed)
        )
        found = {}
        for (name, each), part in zip(sweep.vary.items(), points.T, strict=True):
            if isinstance(each, Range):
                found[name] = each.at(part)[sample]
            else:
                found[name] = _listed(each, np.minimum((part * len(each)).astype(int), len(each) - 1))[sample]
        return found

    def robot_values(self, robot: int, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return those of the varied numbers that are parameters of a robot."""
        return {
            name: each for name, each in values.items() if parameter_at(self.systems[robot].nominal, name)
        }


def _listed(values: tuple[Any, ...], index: np.ndarray) -> np.ndarray:
    return np.asarray(values, dtype=float)[index]


def _settings(sweep: Sweep) -> Settings:
    try:
        settings = Settings.of(sweep.time, sweep.space, "consistent", NewtonOptions())
    except ValueError as error:
        raise SweepError(str(error)) from None
    if settings.time is None:
        raise SweepError("time is None; allowed is a time scheme: equilibria have no time steps")
    return settings


# robots


def _loaded(robot: str | System, changes: Mapping[str, Any]) -> System:
    """Return a robot by name, file or model file, with changed parameters."""
    try:
        system = robot if isinstance(robot, System) else _load(robot)
        system = system.replace(**changes) if changes else system
    except SweepError:
        raise
    except (KnodeCosseratError, ValueError) as error:
        raise SweepError(f"robots: {error}") from None
    if np.ndim(system.length):
        raise SweepError("robots: a batch of robots is no single robot; give a list of them")
    return system


def _load(name: str) -> System:
    if kind_of(name) in ("knode-cosserat model", "HDF5"):
        from knode_cosserat.learning.knode import load_model

        return load_model(name)
    return load_robot(name)


def _is_static(system: System, name: str) -> bool:
    """True if a parameter is part of a program, not of its data: a place or a choice."""
    owner, last = owner_at(system.nominal, name)
    fields = {field.name: field for field in dataclasses.fields(owner)}
    return bool(fields[last].metadata.get("static", False))


def _check_variation(system: System, name: str, variation: Range | tuple[Any, ...], used: bool) -> None:
    """Raise `SweepError` unless a robot has a parameter and allows its values."""
    stated = parameter_at(system.nominal, name)
    if stated is None:
        if used:
            _require_numbers_only(name, variation)
            return
        _require_field(system, name)
    if stated is None or _is_static(system, name):
        raise SweepError(
            f"vary: {name} cannot vary within a robot, because it shapes its program; give a list of robots, "
            f"each with set: {{{name}: VALUE}}"
        )
    if isinstance(variation, Range) and stated.shape != "scalar":
        raise SweepError(f"vary: {name} is not one number; allowed is a list of its values")
    if used:
        _require_numbers_only(name, variation)
    for value in (variation.low, variation.high) if isinstance(variation, Range) else variation:
        try:
            system.replace(**{name: value})
        except (KnodeCosseratError, ValueError) as error:
            raise SweepError(f"vary: {error}") from None


def _require_field(system: System, name: str) -> None:
    """Raise `SweepError` unless a robot has a field of this name, such as `nodes`."""
    if name in {field.name for field in dataclasses.fields(system.nominal)}:
        return
    try:
        system.replace(**{name: 0.0})
    except (KnodeCosseratError, ValueError) as error:
        raise SweepError(f"vary: {error}") from None


def _require_numbers_only(name: str, variation: Range | tuple[Any, ...]) -> None:
    if not isinstance(variation, Range) and any(np.ndim(each) for each in variation):
        raise SweepError(f"vary: {name} is used in controls; allowed is a list of numbers")


# controls


def _fixed_controls(sweep: Sweep, systems: tuple[System, ...]) -> dict[tuple[int, int], np.ndarray]:
    """Return controls without varied numbers, by robot and word; check the words with varied numbers.

    A word with varied numbers must be possible for one of the values at least: else the word is wrong.
    """
    found = {}
    for robot, system in enumerate(systems):
        for w, word in enumerate(sweep.controls):
            if not placeholders(word):
                found[robot, w] = named_controls.parse(system, word, sweep.steps, sweep.dt)
                continue
            ends = {name: _trial_values(each) for name, each in sweep.vary.items()} | {"seed": np.arange(3)}
            tried = signals(system, word, sweep.steps, sweep.dt, ends, 3)
            if len(tried.refused) == 3:
                raise SweepError(tried.refused[1])
    return found


def _trial_values(variation: Range | tuple[Any, ...]) -> np.ndarray:
    """Return three values of a variation: first, middle and last."""
    if isinstance(variation, Range):
        return variation.at(np.array([0.0, 0.5, 1.0]))
    return np.asarray([variation[0], variation[len(variation) // 2], variation[-1]], dtype=float)


# identity


def _identity(sweep: Sweep, systems: tuple[System, ...], fixed: Mapping[tuple[int, int], np.ndarray]) -> str:
    """Return a checksum of a sweep, of its robots and of its controls, which may be files."""
    described = {key: value for key, value in sweep.described().items() if key != "robots"}
    controls = [hashlib.sha256(each.tobytes()).hexdigest() for each in fixed.values()]
    robots = [system_checksum(each) for each in systems]
    return json_checksum([described, controls, robots])


def system_checksum(system: System) -> str:
    """Return a checksum of a system: class, fields and all numbers."""
    leaves, structure = jax.tree.flatten(system)
    digest = hashlib.sha256(re.sub(r"0x[0-9a-f]+", "", f"{type(system).__name__} {structure}").encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        digest.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def robot_text(system: System) -> str:
    """Return the text of a robot file, or the text of a system that has none."""
    try:
        return format_robot(system)
    except KnodeCosseratError:
        return repr(system)


def control_titles(system: System) -> list[str]:
    """Return the names of a robot's controls, with units."""
    return named_controls.titles(system.control_layout)
