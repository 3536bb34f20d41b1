"""Plans of controls over a horizon by few numbers: values at knots, linear between them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int


@dataclasses.dataclass(frozen=True)
class Knots:
    """Knots of a plan: the samples at which controls are chosen; in between they change linearly.

    Attributes:
        samples: indices of the knots, from 0 to horizon - 1.
        horizon: number of samples of a plan.
    """

    samples: tuple[int, ...]
    horizon: int

    @classmethod
    def spaced(cls, horizon: int, count: int) -> Knots:
        """Return knots that are dense at the beginning and sparse at the end.

        Raises:
            ValueError: more knots than samples, or fewer than two.
        """
        if not 2 <= count <= horizon:
            raise ValueError(f"knots is {count}; allowed are 2 to the horizon, {horizon}")
        power = 1.0 if count == horizon else 1.6
        wanted = np.round((horizon - 1) * (np.arange(count) / (count - 1)) ** power).astype(int)
        for k in range(1, count):  # no two at one sample
            wanted[k] = max(wanted[k], wanted[k - 1] + 1)
        return cls(
            tuple(int(each) for each in np.minimum(wanted, horizon - count + np.arange(count))), horizon
        )

    @property
    def count(self) -> int:
        """Number of knots."""
        return len(self.samples)

    @property
    def basis(self) -> Float[np.ndarray, "T knots"]:
        """Weights of the knots' values in every sample's control."""
        every = np.arange(self.horizon)
        return np.stack([np.interp(every, self.samples, one) for one in np.eye(self.count)], axis=1)

    @property
    def changes(self) -> Float[np.ndarray, "knots knots"]:
        """Weights of the knots' values in the change of the control per sample.

        Row 0 is the first control itself: its change is from the one before the plan. Row k is the change in
        every sample from knot k - 1 to knot k.
        """
        spans = np.diff(self.samples)
        rows = np.diff(np.eye(self.count), axis=0) / spans[:, None]
        return np.concatenate([np.eye(self.count)[:1], rows])

    def shifted(self, plan: Float[np.ndarray, "knots c"]) -> Float[np.ndarray, "knots c"]:
        """Return the plan one sample later, with its last control held."""
        later: Int[np.ndarray, " knots"] = np.minimum(np.array(self.samples) + 1, self.horizon - 1)
        return self.controls(plan)[later]

    def controls(self, plan: Any) -> Float[np.ndarray, "T c"]:
        """Return the controls of all samples."""
        return self.basis @ np.asarray(plan)
