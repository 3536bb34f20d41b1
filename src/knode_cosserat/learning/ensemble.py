"""Ensembles: several models of the same robot, with mean prediction and spread."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, overload

import jax
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat._reprs import count_of, wrap_lines
from knode_cosserat.learning.knode import KNODE, ModelFileError, load_model
from knode_cosserat.rods.passport import Passport
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory


class Ensemble(Sequence[KNODE]):
    """Sequence of models that were fitted with several seeds, with a joint prediction.

    Raises:
        ValueError: there are no members, or one is not a model.
    """

    def __init__(self, members: Iterable[KNODE]):
        self.members = tuple(members)
        if not self.members or not all(isinstance(member, KNODE) for member in self.members):
            kinds = ", ".join(sorted({type(member).__name__ for member in self.members})) or "nothing"
            raise ValueError(f"members are {kinds}; allowed is one KNODE or more")

    def __repr__(self) -> str:
        first = " ".join(repr(self.members[0]).split())
        return wrap_lines(f"Ensemble of {count_of(len(self), 'model')}; the first: {first}")

    def __len__(self) -> int:
        return len(self.members)

    @overload
    def __getitem__(self, index: int) -> KNODE: ...

    @overload
    def __getitem__(self, index: slice) -> Ensemble: ...

    def __getitem__(self, index: int | slice) -> KNODE | Ensemble:
        return Ensemble(self.members[index]) if isinstance(index, slice) else self.members[index]

    def __iter__(self) -> Iterator[KNODE]:
        return iter(self.members)

    @property
    def passport(self) -> Passport | None:
        """Recordings that the members were learned from, and the range of controls and strains there."""
        return self.members[0].passport

    def noise_at(self, places: Any) -> Float[np.ndarray, " M"]:
        """Return the standard deviation of what no member can follow, at places (parts of the length; m).

        It is that of the recordings that the members were identified from (`About.facts["noise"]`), linear
        between their bodies and zero at the base. Models that were fitted state none.
        """
        stated = np.array([(0.0, 0.0), *self.members[0].about.facts.get("noise", [])])
        return np.interp(np.asarray(places, dtype=float), *stated.T)

    def predict(self, controls: Any, dt: float, **options: Any) -> Prediction:
        """Simulate every member under the controls (T, c).

        Args:
            controls: as for `simulate`, for one robot.
            dt: time step (s).
            options: further arguments of `simulate`.

        Raises:
            SimulationError: a member has no solution. With `on_failure="return"` it is instead left out from
                the failed row on.
        """
        if len({jax.tree.structure(member) for member in self.members}) == 1 and "initial" not in options:
            batch = simulate(list(self.members), controls, dt, **options)
            motions = [batch[k] for k in range(len(self))]
        else:
            motions = [simulate(member, controls, dt, **options) for member in self.members]
        return Prediction(motions, self.noise_at(np.linspace(0.0, 1.0, motions[0].position.shape[-2])))

    def save(self, folder: str | Path) -> None:
        """Write every member to its own file in a folder; `load_ensemble` reads them back."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("member-*.model"):
            old.unlink()
        for k, member in enumerate(self.members):
            member.save(folder / f"member-{k:03d}.model")


def load_ensemble(folder: str | Path, **options: Any) -> Ensemble:
    """Read the ensemble in a folder; `options` as for `load_model`. Raises `ModelFileError`."""
    check_arguments(load_ensemble, locals())
    files = sorted(Path(folder).glob("member-*.model"))
    if not files:
        raise ModelFileError(f"{folder}: there is no ensemble here (files member-000.model, …)")
    return Ensemble(load_model(file, **options) for file in files)


class Prediction:
    """Predictions of all members, with their mean and spread in every row.

    `time`, `position`, `quaternion` and `tip_position` are those of the mean, so that a prediction can be
    compared and plotted like a trajectory. `noise` is the standard deviation (N,) of what no member can
    follow (m), in the rows' nodes.
    """

    def __init__(self, members: Sequence[Trajectory], noise: Any = 0.0):
        self.members, self.noise = list(members), np.asarray(noise, dtype=float)

    def __repr__(self) -> str:
        return f"Prediction of {count_of(len(self.members), 'member')}; the first: {self.members[0]!r}"

    @property
    def time(self) -> Float[np.ndarray, " T"]:
        """Times (T,) in s."""
        return np.asarray(self.members[0].time)

    @property
    def extrapolated(self) -> Bool[np.ndarray, " T"] | None:
        """True in rows where a member is outside the range of its training data; None if unknown."""
        known = [member.extrapolated for member in self.members if member.extrapolated is not None]
        return np.any(known, axis=0) if known else None

    def _positions(self) -> Any:
        return np.stack([np.asarray(member.position) for member in self.members])

    @property
    def position(self) -> Float[np.ndarray, "T N 3"]:
        """Mean of the members' positions (T, N, 3) in m."""
        return _mean(self._positions())

    @property
    def quaternion(self) -> Float[np.ndarray, "T N 4"]:
        """Mean of the members' orientations (T, N, 4), scalar first, of length one."""
        h = np.stack([np.asarray(member.quaternion) for member in self.members])
        h = h / np.linalg.norm(h, axis=-1, keepdims=True)
        h = h * np.where(np.sum(h * h[:1], axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
        mean = _mean(h)
        return mean / np.linalg.norm(mean, axis=-1, keepdims=True)

    @property
    def tip_position(self) -> Float[np.ndarray, "T 3"]:
        """Mean position of the last node (T, 3) in m."""
        return self.position[:, -1]

    @property
    def spread(self) -> Float[np.ndarray, "T N 3"]:
        """Standard deviation of the members' positions (T, N, 3) in m; NaN with fewer than two members."""
        positions = self._positions()
        count = np.sum(np.isfinite(positions), axis=0)
        square = np.nansum((positions - self.position) ** 2, axis=0)
        return np.sqrt(np.where(count > 1, square / np.maximum(count - 1, 1), np.nan))

    def interval(self, level: float = 0.9) -> tuple[Float[np.ndarray, "T N 3"], Float[np.ndarray, "T N 3"]]:
        """Return the lower and upper prediction limits of one more member with its noise, at this level.

        Those of the members are Student's.
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"level is {level!r}; allowed is a number between 0 and 1")
        from scipy.stats import norm, t

        count, at = len(self.members), 0.5 + level / 2.0
        half = np.hypot(
            t.ppf(at, max(count - 1, 1)) * np.sqrt(1.0 + 1.0 / count) * self.spread,
            norm.ppf(at) * self.noise[..., None],
        )
        return self.position - half, self.position + half

    def coverage(self, reference: Any, level: float = 0.9, first: int = 1) -> float:
        """Return the fraction of the reference's positions inside `interval`, over all rows, nodes and axes.

        Nodes before the `first`, as the base, and row 0 are not counted, for they are not predicted.

        The spread is calibrated if the result is near `level`. If it is far below, the members share an
        error: the spread covers data and chance, but not effects that no member can express.

        Raises:
            ValueError: rows or nodes differ, or there is one member only.
        """
        if len(self.members) < 2:
            raise ValueError("one member has no spread; at least two are needed")
        true = np.asarray(reference.position)
        low, high = self.interval(level)
        if true.shape != low.shape:
            raise ValueError(f"the reference's positions are {true.shape} and the prediction's {low.shape}")
        inside = (low <= true) & (true <= high)
        return float(np.mean(inside[1:, first:][np.isfinite(true[1:, first:])]))


def _mean(values: Any) -> Any:
    count = np.sum(np.isfinite(values), axis=0)
    return np.where(count > 0, np.nansum(values, axis=0) / np.maximum(count, 1), np.nan)
