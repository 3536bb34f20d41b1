"""Data of a sweep: columns from all shards, failed cases, and single cases."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from knode_cosserat._reprs import count_of, quantity, wrapped
from knode_cosserat.solvers.result import ResultCodes
from knode_cosserat.sweeps.errors import SweepError
from knode_cosserat.sweeps.folder import shard_numbers, shard_path
from knode_cosserat.sweeps.manifest import read_manifest
from knode_cosserat.sweeps.shard_file import read_about, read_shard

#: most failed cases that a text lists
MOST_LISTED = 3


class FailedCase(NamedTuple):
    """A case with unsolved rows: its number, its numbers by name, and the reason."""

    case: int
    values: dict[str, Any]
    reason: str


@dataclasses.dataclass(frozen=True, repr=False)
class SweepData:
    """Data of a sweep in a folder. Columns are read when they are asked for.

    `data["tip_position"]` is an array of all cases; `data.shards()` gives the shards one by one, for data
    larger than memory. A sweep that is not complete has the shards that are there.
    """

    folder: Path
    manifest: dict[str, Any]
    #: numbers of the shards that are there
    present: tuple[int, ...]

    @classmethod
    def open(cls, folder: str | Path) -> Self:
        """Return the data in a folder. Raises `SweepError`."""
        folder = Path(folder)
        manifest = read_manifest(folder)
        return cls(folder, manifest, shard_numbers(folder, manifest["shards"]))

    # extent

    @property
    def is_complete(self) -> bool:
        """True if all shards are there."""
        return len(self.present) == self.manifest["shards"]

    def __len__(self) -> int:
        return sum(self._rows(number) for number in self.present)

    def _rows(self, number: int) -> int:
        """Return the number of cases in a shard."""
        each = self.manifest["cases"] // len(self.manifest["robots"])
        size = self.manifest["shard_cases"]
        part = number % -(-each // size)
        return int(min(size, each - part * size))

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return list(self.manifest["robots"][0]["columns"])

    @property
    def varied(self) -> list[str]:
        """Names of the varied numbers."""
        return list(self.manifest["sweep"]["vary"])

    def unit(self, name: str) -> str:
        """Return the unit of a column."""
        return str(self._column(name)["unit"])

    def _column(self, name: str) -> dict[str, Any]:
        columns = self.manifest["robots"][0]["columns"]
        if name not in columns:
            raise KeyError(f"no column {name!r}; there are {', '.join(columns)}")
        return dict(columns[name])

    @property
    def time(self) -> np.ndarray:
        """Times (rows,) in s."""
        sweep = self.manifest["sweep"]
        return np.arange(sweep["steps"] + 1) * float(sweep["dt"])

    @property
    def provenance(self) -> dict[str, Any]:
        """Versions of packages, the commit of a checkout, and the machine."""
        return {key: self.manifest[key] for key in ("made_by", "git", "machine")}

    # columns

    def __getitem__(self, name: str) -> Any:
        """Return a column of all cases that are there, by name, in their order."""
        column = self._column(name)
        parts = [part[name] for part in self.shards([name])]
        if not parts:
            return np.zeros((0, *column["shape"]))
        if len({np.shape(part)[1:] for part in parts}) > 1:
            raise SweepError(
                f"{name} has other shapes for other robots, which are no single array; read it by shards()"
            )
        found = np.concatenate(parts)
        return ResultCodes.of(found) if name == "result" else found

    def shards(self, names: Sequence[str] | None = None, *, verify: bool = False) -> Iterator[dict[str, Any]]:
        """Yield the columns of each shard, by name.

        Args:
            names: columns to read; None: all.
            verify: compare checksums, which reads all columns.

        Raises:
            SweepError: a shard cannot be read, has another version, or was changed.
        """
        for name in names or ():
            self._column(name)
        for number in self.present:
            path = shard_path(self.folder, number)
            shard = read_shard(path, names, verify=verify)
            if shard.about.get("sweep") != self.manifest["identity"] or shard.about.get("shard") != number:
                raise SweepError(f"{path}: the shard belongs to another sweep")
            yield shard.columns

    def verify(self) -> int:
        """Compare the checksums of all shards, and return their number.

        Raises:
            SweepError: a shard is missing, damaged, of another version, or of another sweep.
        """
        if not self.is_complete:
            missing = sorted(set(range(self.manifest["shards"])) - set(self.present))
            raise SweepError(
                f"{self.folder}: {len(missing)} of {self.manifest['shards']} shards are missing, first "
                f"{missing[0]}; the command that began the sweep solves them"
            )
        return sum(1 for _ in self.shards(verify=True))

    def to_pandas(self) -> Any:
        """Return a table (pandas) of all columns with one number or text a case."""
        import pandas as pd  # type: ignore[import-untyped]

        names = [name for name in self.names if not self._column(name)["shape"]]
        parts = [pd.DataFrame({name: part[name] for name in names}) for part in self.shards(names)]
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=names)

    # failed cases

    @property
    def failed_count(self) -> int:
        """Number of failed cases, from the metadata of the shards."""
        return sum(read_about(shard_path(self.folder, number))["failed"] for number in self.present)

    def failed(self) -> Iterator[FailedCase]:
        """Yield the failed cases, with their reasons."""
        names = ["case", *self.varied, "reason"]
        for part in self.shards(names):
            for k in np.flatnonzero(part["reason"] != ""):
                values = {name: part[name][k].tolist() for name in self.varied}
                yield FailedCase(int(part["case"][k]), values, str(part["reason"][k]))

    def __repr__(self) -> str:
        manifest = self.manifest
        sweep, robots = manifest["sweep"], manifest["robots"]
        state = "complete" if self.is_complete else f"{len(self.present)} of {manifest['shards']} shards"
        failed = self.failed_count
        lines = [
            f"Sweep of {', '.join(each['label'] for each in robots[:MOST_LISTED])}: {len(self):,} of "
            f"{manifest['cases']:,} cases ({state}), {failed} failed",
            f"{count_of(sweep['steps'], 'step')} of {quantity(sweep['dt'], 's')}; "
            f"sampler {sweep['sampler']}, seed {sweep['seed']}",
        ]
        lines += [f"varied: {', '.join(map(self._varied_text, self.varied))}"] if self.varied else []
        lines.append(f"columns: {', '.join(map(self._column_text, self.names))}")
        first = next(self.failed(), None) if failed else None
        lines += [f"failed case {first.case}: {first.reason}"] if first else []
        return "\n".join(map(wrapped, lines))

    def _varied_text(self, name: str) -> str:
        each, unit = self.manifest["sweep"]["vary"][name], self.unit(name)
        if isinstance(each, dict):
            return f"{name} {each['low']:.4g} to {each['high']:.4g} {unit}".strip()
        return f"{name} {count_of(len(each), 'value')}"

    def _column_text(self, name: str) -> str:
        column = self._column(name)
        shape = f" {tuple(column['shape'])}" if column["shape"] else ""
        return f"{name}{shape}" + (f" {column['unit']}" if column["unit"] else "")


def load_sweep(folder: str | Path) -> SweepData:
    """Return the data of a sweep in a folder; columns are read when they are asked for.

    Raises:
        SweepError: there is no sweep, or it has a version that this package does not read.
    """
    return SweepData.open(folder)
