"""Data of a sweep: columns from all shards, failed cases, and single cases."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._reprs import count_of, quantity, wrap_lines
from knode_cosserat.errors import first_line
from knode_cosserat.schemes.result import ResultCodes
from knode_cosserat.sweeps._description import SweepError
from knode_cosserat.sweeps._folder import read_manifest, shard_numbers, shard_path
from knode_cosserat.sweeps._shards import read_shard, require_pyarrow


class FailedCase(NamedTuple):
    """A case with unsolved rows: its number, its numbers by name, and the reason."""

    case: int
    values: dict[str, Any]
    reason: str


@dataclasses.dataclass(frozen=True, repr=False)
class SweepData:
    """Data of a sweep in a folder. Columns are read when they are asked for.

    `data["tip_position"]` is an array of all cases; `data.shards()` gives the shards one by one, and
    `data.dataset()` a dataset of pyarrow, for data larger than memory. A sweep that is not complete has the
    shards that are there.
    """

    folder: Path
    manifest: dict[str, Any]
    #: numbers of the shards that are there
    present: tuple[int, ...]

    @property
    def is_complete(self) -> bool:
        """True if all shards are there."""
        return len(self.present) == self.manifest["shards"]

    def __len__(self) -> int:
        cases, size = self.manifest["cases"] // len(self.manifest["robots"]), self.manifest["shard_cases"]
        return sum(min(size, cases - number % -(-cases // size) * size) for number in self.present)

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
        return np.arange(self.manifest["sweep"]["steps"] + 1) * float(self.manifest["sweep"]["dt"])

    @property
    def provenance(self) -> dict[str, Any]:
        """Versions of packages, the commit of a checkout, and the machine."""
        return {key: self.manifest[key] for key in ("made_by", "git", "machine")}

    # columns

    def __getitem__(self, name: str) -> Any:
        """Return a column of all cases that are there, by name, in their order."""
        parts = [np.zeros((0, *self._column(name)["shape"])), *(part[name] for part in self.shards([name]))]
        if len({np.shape(part)[1:] for part in parts[1:]}) > 1:
            raise SweepError(
                f"{name} has other shapes for other robots, which are no single array; read it by shards()"
            )
        column = np.concatenate(parts[1:] or parts)
        return ResultCodes.of(column) if name == "result" else column

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
            first = next(k for k, number in enumerate((*self.present, -1)) if k != number)
            raise SweepError(
                f"{self.folder}: {self.manifest['shards'] - len(self.present)} of {self.manifest['shards']} "
                f"shards are missing, first {first}; the command that began the sweep solves them"
            )
        return sum(1 for _ in self.shards(verify=True))

    def dataset(self) -> Any:
        """Return the shards as a `pyarrow.dataset.Dataset`, for filters and batches of rows."""
        require_pyarrow()
        import pyarrow.dataset  # type: ignore[import-not-found, import-untyped, unused-ignore]

        paths = [str(shard_path(self.folder, number)) for number in self.present]
        return pyarrow.dataset.dataset(paths, format="parquet")

    def _table(self, names: list[str], failed: bool = False) -> Any:
        """Return a table (pyarrow) of columns, of all cases or of failed ones. Raises `SweepError`."""
        pyarrow = require_pyarrow()
        if not self.present:
            return pyarrow.table({name: [] for name in names})
        try:
            dataset = self.dataset()
            condition = pyarrow.compute.field("reason") != "" if failed else None
            return dataset.to_table(columns=names, filter=condition)
        except (pyarrow.ArrowException, OSError) as error:
            raise SweepError(f"{self.folder}: damaged: {first_line(error)}") from None

    def to_pandas(self) -> Any:
        """Return a table (pandas) of all columns with one number or text a case."""
        return self._table([name for name in self.names if not self._column(name)["shape"]]).to_pandas()

    # failed cases

    @property
    def failed_count(self) -> int:
        """Number of failed cases."""
        return len(self._table(["case"], failed=True))

    def failed(self) -> Iterator[FailedCase]:
        """Yield the failed cases, with their reasons."""
        for row in self._table(["case", *self.varied, "reason"], failed=True).to_pylist():
            yield FailedCase(row.pop("case"), reason=row.pop("reason"), values=row)

    def __repr__(self) -> str:
        manifest, sweep = self.manifest, self.manifest["sweep"]
        state = "complete" if self.is_complete else f"{len(self.present)} of {manifest['shards']} shards"
        failed = self.failed_count
        lines = [
            f"Sweep of {', '.join(robot['label'] for robot in manifest['robots'][:3])}: {len(self):,} of "
            f"{manifest['cases']:,} cases ({state}), {failed} failed",
            f"{count_of(sweep['steps'], 'step')} of {quantity(sweep['dt'], 's')}; "
            f"sampler {sweep['sampler']}, seed {sweep['seed']}",
        ]
        varied = [
            f"{name} {values['low']:.4g} to {values['high']:.4g} {self.unit(name)}".strip()
            if isinstance(values, dict)
            else f"{name} {count_of(len(values), 'value')}"
            for name, values in sweep["vary"].items()
        ]
        lines += [f"varied: {', '.join(varied)}"] if varied else []
        columns = [
            " ".join(
                filter(None, [name, str(tuple(column["shape"])) * bool(column["shape"]), column["unit"]])
            )
            for name, column in manifest["robots"][0]["columns"].items()
        ]
        lines.append(f"columns: {', '.join(columns)}")
        if failed:
            first = next(self.failed())
            lines.append(f"failed case {first.case}: {first.reason}")
        return "\n".join(map(wrap_lines, lines))


def load_sweep(folder: str | Path) -> SweepData:
    """Return the data of a sweep in a folder; columns are read when they are asked for.

    Raises:
        SweepError: there is no sweep, or it has a version that this package does not read.
    """
    check_arguments(load_sweep, locals())
    folder = Path(folder)
    manifest = read_manifest(folder)
    return SweepData(folder, manifest, shard_numbers(folder, manifest["shards"]))
