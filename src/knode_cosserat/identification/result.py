"""Result of an identification, with 95 % intervals."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat._reprs import robot_text, wrap_lines
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.identification.next_experiment import NextExperiment
from knode_cosserat.identification.posterior import SURE, UNLIKELY, Posterior
from knode_cosserat.identification.search import ParameterSearch, SearchEnd
from knode_cosserat.learning.ensemble import Ensemble
from knode_cosserat.rods.system import System

#: probability of an interval
LEVEL = 0.95
#: a number whose uncertainty is more than this part of its prior's is held by the prior
HELD = 0.8


class IdentificationError(KnodeCosseratError, ValueError):
    """A robot cannot be identified; one line says why."""

    code = "identification"


class Estimate(NamedTuple):
    """One identified number, of an effect or of the parameter with that name.

    `error` is its standard error, and `interval` contains it with a probability of 95 %, the doubt about the
    set of effects included. `held` is true if the data say little about it beyond its prior. `probability` is
    that of the effect; the value is the mean with and without it.
    """

    effect: str
    label: str
    unit: str
    nominal: float
    value: float
    interval: tuple[float, float]
    held: bool = False
    error: float = np.nan
    probability: float = 1.0


@dataclasses.dataclass(frozen=True)
class Identified:
    """A robot identified from data; `print` shows a table. `found["youngs_modulus"]` is an `Estimate`.

    Attributes:
        robot: the identified robot; from recordings a controls row is the measured tensions.
        effects: the effects that it has, with a probability of 95 % each, and the parameters that were
            searched for.
        undecided: effects that it may have, and their probabilities; the data do not decide. The robot has
            the mean of what they would change.
        next_experiment: controls that would tell most about these; None if all is decided.
        ensemble: random samples of the robots that agree with the recordings, spread as held-out ones are;
            `ensemble.predict(controls, dt).interval(0.95)` is a band of predictions. None for parameters.
        estimates: their numbers with 95 % intervals.
        correlation: correlation of the numbers' errors, in the order of `estimates` (n, n).
        nominal_error: by recording, root mean square error of the tip of the nominal robot (m).
        error: the same of the identified robot.
        held_out_error: the same of a robot identified without that recording; empty if nothing was selected.
        undetermined: parameters that were not changed, because the data do not determine them.
        unexplained: fields whose remaining differences are not noise, so that the intervals are too narrow.
        steps: selection and rejection of effects, in words.
        complete: false if the time was over, or it was interrupted; the steps say what was not done.
    """

    robot: System
    effects: tuple[str, ...] = ()
    estimates: tuple[Estimate, ...] = ()
    correlation: Float[np.ndarray, "n n"] = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    nominal_error: Mapping[str, float | None] = dataclasses.field(default_factory=dict)
    error: Mapping[str, float | None] = dataclasses.field(default_factory=dict)
    held_out_error: Mapping[str, float | None] = dataclasses.field(default_factory=dict)
    undetermined: tuple[str, ...] = ()
    unexplained: tuple[str, ...] = ()
    steps: tuple[str, ...] = ()
    undecided: Mapping[str, float] = dataclasses.field(default_factory=dict)
    next_experiment: NextExperiment | None = None
    ensemble: Ensemble | None = None
    complete: bool = True

    @classmethod
    def of(
        cls,
        search: ParameterSearch,
        x: Float[np.ndarray, " n"],
        names: Sequence[str],
        posterior: Posterior,
        **facts: Any,
    ) -> Self:
        """Return the result of a search.

        Args:
            search: the data, and the model with all effects.
            x: coordinates of the robot.
            names: its effects.
            posterior: probabilities about the end of a search.
            facts: further attributes.
        """
        misfit, estimates = search.misfit, estimates_of(posterior, x, names)
        shares = {name: it for name, it in posterior.probability.items() if name in names or it >= UNLIKELY}
        return cls(
            **{"robot": misfit.model.reduced(x, names)} | facts,
            effects=tuple(name for name, share in shares.items() if share >= SURE),
            undecided={name: share for name, share in shares.items() if share < SURE},
            estimates=estimates,
            correlation=posterior.correlation([it.label for it in estimates]),
            nominal_error=misfit.tip_errors(np.zeros(len(x))),
            error=misfit.tip_errors(x),
            unexplained=search.unexplained(x),
            steps=tuple(search.journal.steps),
        )

    def __getitem__(self, label: str) -> Estimate:
        """Return the estimate of a number by its label, such as "youngs_modulus" or "gravity[2]".

        Raises:
            KeyError: there is none; the message lists the labels.
        """
        for estimate in self.estimates:
            if estimate.label == label:
                return estimate
        labels = ", ".join(estimate.label for estimate in self.estimates) or "no estimates"
        raise KeyError(f"there is no estimate {label!r}; there are {labels}")

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the robots, as JSON has it."""
        return {
            "effects": list(self.effects),
            "undecided": dict(self.undecided),
            "next_experiment": self.next_experiment and str(self.next_experiment),
            "estimates": [it._asdict() | {"interval": list(it.interval)} for it in self.estimates],
            "correlation": self.correlation.tolist(),
            "nominal_error": dict(self.nominal_error),
            "error": dict(self.error),
            "held_out_error": dict(self.held_out_error),
            "undetermined": list(self.undetermined),
            "unexplained": list(self.unexplained),
            "steps": list(self.steps),
            "complete": self.complete,
        }

    def __repr__(self) -> str:
        numbers = [
            f"{it.label} = {it.value:.6g} {it.unit}".rstrip() + " ({:.6g} to {:.6g})".format(*it.interval)
            for it in self.estimates
        ]
        parts = [
            f"Identified {robot_text(self.robot)}",
            f"effects: {', '.join(self.effects) or 'none'}",
            "95 % intervals: " + ("; ".join(numbers) or "none"),
        ]
        for name, errors in (
            ("nominal", self.nominal_error),
            ("identified", self.error),
            ("held out", self.held_out_error),
        ):
            known = [error for error in errors.values() if error is not None]
            if known:
                parts.append(f"tip error, {name}: {1e3 * sum(known) / len(known):.3g} mm")
        return wrap_lines("; ".join(parts))

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [
            ("effect", "number", "unit", "nominal", "estimate", "95 % interval", "")
        ]
        # what is decided comes first
        for it in sorted(self.estimates, key=lambda it: it.probability < SURE):
            low, value, high = (_text(at, it.error) for at in (it.interval[0], it.value, it.interval[1]))
            # a plain parameter is its own cause
            effect = "" if it.effect in (it.label, it.label.partition("[")[0]) else it.effect
            rows.append(
                (
                    effect,
                    it.label,
                    it.unit,
                    f"{it.nominal:.6g}",
                    value,
                    f"{low} to {high}",
                    "held by its prior" if it.held else "" if it.probability >= SURE else "undecided",
                )
            )
        if not any(row[0] for row in rows[1:]):
            rows = [row[1:] for row in rows]
        lines = _table(rows)
        if self.undecided:
            words = ", ".join(f"{name} ({share:.0%})" for name, share in self.undecided.items())
            lines.append(f"not decided by these data, with probabilities: {words}")
        if self.next_experiment:
            lines.append(f"an experiment that would tell most: {self.next_experiment}")
        if self.undetermined:
            lines.append(f"not determined by these data, unchanged: {', '.join(self.undetermined)}")
        if self.unexplained:
            lines.append(
                f"not explained: the remaining differences in {', '.join(self.unexplained)} are not noise. "
                "The intervals are too narrow; another parameter is wrong, or the equations lack an effect"
            )
        errors: list[tuple[str, ...]] = [("tip error (mm)", "nominal", "identified", "held out")]
        for name in self.error:
            row = (self.nominal_error.get(name), self.error[name], self.held_out_error.get(name))
            errors.append((name, *("-" if error is None else f"{1e3 * error:.3g}" for error in row)))
        lines += ["", *_table(errors)] if self.error else []
        lines += [f"- {step}" for step in self.steps]
        return "\n".join(lines)


def _text(value: float, error: float) -> str:
    """Format a number to two digits of its error, with at most twelve digits."""
    if not 0.0 < error < np.inf or value == 0.0:
        return f"{value:.4g}"
    digits = int(np.floor(np.log10(abs(value)))) - int(np.floor(np.log10(error))) + 2
    return f"{value:.{min(12, max(2, digits))}g}"


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths if width))
    return lines


def estimates_of(
    posterior: Posterior, x: Float[np.ndarray, " n"], names: Sequence[str]
) -> tuple[Estimate, ...]:
    """Return the numbers of a robot's effects, with their intervals.

    Args:
        posterior: probabilities about the end of a search.
        x: coordinates of the identified robot.
        names: its effects.
    """
    model, ends, spread = posterior.model, posterior.interval(LEVEL), posterior.deviation
    estimates = []
    for name in names:
        for k in range(*model.slice(name).indices(model.size)):
            number = model.numbers[k]
            first, last = map(number.value, ends[:, k])
            value = float(np.clip(number.value(x[k]), number.low, number.high))
            held = bool(not number.flat and spread[k] > HELD and abs(x[k]) < 1.0)
            error = float(abs(number.slope(value)) * spread[k])
            estimates.append(
                Estimate(
                    name,
                    number.label,
                    number.unit,
                    number.nominal,
                    value,
                    (first, last),
                    held,
                    error,
                    posterior.probability[name],
                )
            )
    return tuple(estimates)


def variance_ratio(point: SearchEnd, folds: Sequence[Float[np.ndarray, " n"]]) -> float:
    """Return how much more estimates without one recording scatter than expected, at least 1.

    Least squares assumes random differences; those of an incomplete model are systematic, and differ between
    recordings. It is the mean ratio of both variances (jackknife, Efron & Stein 1981) of the numbers that the
    data determine.
    """
    spread = np.sqrt(np.diag(point.covariance()))
    count = len(folds)
    free = point.free & (spread < HELD)
    if count < 2 or not free.any():
        return 1.0
    scatter = (count - 1) ** 2 / count * np.var(np.array(folds), axis=0, ddof=1)
    return float(max(1.0, np.mean(scatter[free] / spread[free] ** 2)))
