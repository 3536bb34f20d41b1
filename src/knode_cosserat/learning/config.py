"""Settings of a fit: checked when they are made, and converted to JSON and back."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np

from knode_cosserat._files.yaml_text import excerpt
from knode_cosserat._settings import FLAG, LINE, Rule, ValidatedSettings, choice, items, number, part
from knode_cosserat.errors import KnodeCosseratError


class ConfigError(KnodeCosseratError, ValueError):
    """Invalid setting. The message is one line: the setting, its value and the accepted values."""

    code = "fit-config"


class FitError(KnodeCosseratError, ValueError):
    """A fit that cannot start or continue. The message is one line: the reason, and the kept state."""

    code = "fit"


class _Options(ValidatedSettings):
    """Settings of one kind. Raises `ConfigError` if a value is not accepted."""

    error = ConfigError
    #: name of a residual in a mapping
    kind: ClassVar[str] = ""
    #: settings of `FitConfig` with gradient training; a residual needs one of them, if there are any
    trainers: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def refusal(cls, name: str, value: Any, words: str) -> Exception:
        """Return the error of a value that is not allowed."""
        return super().refusal(f"{cls.__name__}.{name}", value, words)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as JSON values, without those that are None."""
        return ({"kind": self.kind} if self.kind else {}) | super().to_dict()

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """Return settings from `to_dict`'s result; missing options have defaults. Raises `ConfigError`."""
        if not isinstance(values, dict):
            raise ConfigError(f"{cls.__name__} is {excerpt(values)}; allowed is a mapping")
        return super().from_dict({key: value for key, value in values.items() if key != "kind"})


# rules


def _whole(low: int, high: int = 10_000_000) -> Rule:
    def read(value: Any) -> int | None:
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        return int(value) if whole and low <= value <= high else None

    schema = {"type": "integer", "minimum": low, "maximum": high}
    return Rule(f"a whole number from {low} to {high}", read, schema)


#: steps without a better held-out rollout after which to stop
LIMIT = _whole(1)._replace(words="a whole number from 1 on, or None: never")


def _positive(high: float) -> Rule:
    rule = number(0.0, high)
    schema = {**rule.schema, "exclusiveMinimum": 0.0}
    return Rule(f"a number above 0 up to {high:g}", lambda value: rule.read(value) or None, schema)


def _several(words: str, one: Rule) -> Rule:
    def read(value: Any) -> tuple[Any, ...] | None:
        known = tuple(map(one.read, items(value)))
        return known if known and None not in known and len(set(known)) == len(known) else None

    return Rule(words, read, {"type": "array", "items": one.schema, "minItems": 1, "uniqueItems": True})


def _seeds() -> Rule:
    one = _whole(0, 2**32 - 1)
    several = _several(f"{one.words}, or several different ones", one)

    def read(value: Any) -> Any:
        seeds = several.read(value)
        return one.read(value) if seeds is None else seeds

    return Rule(several.words, read, {"anyOf": [one.schema, several.schema]})


def _kind_of(*kinds: type[_Options]) -> Rule:
    """Return the rule of settings of one of several kinds, also as a mapping with its kind."""
    named = {kind.kind: kind for kind in kinds}

    def read(value: Any) -> Any:
        if not isinstance(value, dict):
            return value if isinstance(value, kinds) else None
        if value.get("kind") not in named:
            raise ConfigError(f"the kind is {excerpt(value.get('kind'))}; allowed is {', '.join(named)}")
        return named[value["kind"]].from_dict(value)

    words = " or ".join(kind.__name__ for kind in kinds)
    return Rule(words, read, {"anyOf": [kind.json_schema() for kind in kinds]})


# residuals


@dataclasses.dataclass(frozen=True)
class StructuredOptions(_Options):
    """A structured residual, found by sparse regression (`learning.structured`)."""

    kind: ClassVar[str] = "structured"

    #: if true, nonlinear functions (powers, saturating) are tried where the linear ones leave a remainder
    curved: Annotated[bool, FLAG] = True
    #: if true, the seed draws random row weights (Bayesian bootstrap), so that seeds vary as new data would
    resample: Annotated[bool, FLAG] = False


@dataclasses.dataclass(frozen=True)
class NetworkOptions(_Options):
    """A network with one hidden layer, added to y_s and z (`learning.residual.Network`)."""

    kind: ClassVar[str] = "network"
    trainers: ClassVar[tuple[str, ...]] = ("segments", "rollouts")

    hidden: Annotated[int, _whole(1, 100_000)] = 512
    #: if true, ʰy and ʰz are inputs too
    history: Annotated[bool, FLAG] = False
    #: if true, the weights are kept nonnegative
    convex: Annotated[bool, FLAG] = True
    #: if true, inputs and outputs are standardised by the statistics of the data
    standardised: Annotated[bool, FLAG] = False
    #: if true, the correction of an orientation's quaternion turns it and leaves its length as it is
    unit_quaternions: Annotated[bool, FLAG] = False


# training


@dataclasses.dataclass(frozen=True)
class Training(_Options):
    """Gradient training on one-segment samples: Adam, all samples in every epoch."""

    epochs: Annotated[int, _whole(1)] = 1000
    learning_rate: Annotated[float, _positive(10.0)] = 0.01
    #: "plateau": multiplied by `factor` after more than `patience` epochs in which the loss fell by less than
    #: a fraction of 1e-4; "cosine": down to zero over all epochs
    schedule: Annotated[
        Literal["plateau", "cosine", "constant"], choice(("plateau", "cosine", "constant"))
    ] = "plateau"
    patience: Annotated[int, _whole(0)] = 80
    factor: Annotated[float, _positive(1.0)] = 0.5
    #: "paper", or "standardised": each error over its own spread (also used if the paper's is not defined)
    loss: Annotated[Literal["paper", "standardised"], choice(("paper", "standardised"))] = "paper"
    #: decoupled weight decay (AdamW), for weights but not for biases
    weight_decay: Annotated[float, number(0.0, 10.0)] = 0.0
    #: noise added once, before training, to all numbers of y and z in their own units, as in the paper's
    #: training on recordings
    data_noise: Annotated[float, number(0.0, 10.0)] = 0.0
    #: nodes that are predicted; None: all nodes
    nodes: Annotated[
        tuple[int, ...] | None, _several("different node numbers from 1 on, or None: all", _whole(1, 10_000))
    ] = None
    #: epochs without a better held-out rollout after which to stop; the best weights are kept
    stop_after: Annotated[int | None, LIMIT] = None
    #: epochs between two held-out rollouts
    check_every: Annotated[int, _whole(1)] = 50


@dataclasses.dataclass(frozen=True)
class RolloutTraining(_Options):
    """Fine-tuning through whole simulations: only the compared fields of the trajectories must be known."""

    updates: Annotated[int, _whole(1)] = 100
    learning_rate: Annotated[float, _positive(10.0)] = 1e-3
    schedule: Annotated[Literal["cosine", "constant"], choice(("cosine", "constant"))] = "constant"
    #: fields of y that are compared; None: position p and orientation h
    compared: Annotated[
        tuple[str, ...] | None, _several("different names of fields of y, or None: p and h", LINE)
    ] = None
    #: number of simulated rows; None: all rows
    horizon: Annotated[int | None, _whole(1)] = None
    #: gradient clipping: largest norm of the gradient
    clip: Annotated[float, _positive(1e12)] = 1.0
    #: largest number of consecutive halvings of a step after which the simulation fails
    rejections: Annotated[int, _whole(1, 1000)] = 8
    #: updates without a better held-out rollout after which to stop; the best weights are kept
    stop_after: Annotated[int | None, LIMIT] = None
    #: updates between two held-out rollouts
    check_every: Annotated[int, _whole(1)] = 10


@dataclasses.dataclass(frozen=True)
class FitConfig(_Options):
    """Settings of `fit`. `FitConfig()` is the best training configuration.

    Attributes:
        residual: kind of residual and its options.
        segments: gradient training on one-segment samples, or None.
        rollouts: subsequent fine-tuning through whole simulations, or None.
        seed: seed of the initial weights and of the noise; several seeds give several models.

    Raises:
        ConfigError: a value is not allowed.
    """

    residual: Annotated[
        StructuredOptions | NetworkOptions,
        _kind_of(StructuredOptions, NetworkOptions),
    ] = StructuredOptions()
    segments: Annotated[Training | None, part(Training)] = None
    rollouts: Annotated[RolloutTraining | None, part(RolloutTraining)] = None
    seed: Annotated[int | tuple[int, ...], _seeds()] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        trainers = self.residual.trainers
        if trainers and not any(getattr(self, name) for name in trainers):
            kind = self.residual.kind
            raise ConfigError(
                f"FitConfig has a {kind} residual but no {' or '.join(trainers)} to train it by"
            )

    @classmethod
    def paper(cls, seed: int | tuple[int, ...] = 0, history: bool = False) -> Self:
        """Return the paper's exact training settings, optionally with `history` inputs."""
        return cls(
            NetworkOptions(hidden=512, history=history, convex=True, standardised=False),
            Training(epochs=1000, learning_rate=0.01, schedule="plateau", patience=80, nodes=(3, 5, 7, 9)),
            seed=seed,
        )

    @classmethod
    def paper_recordings(cls, seed: int | tuple[int, ...] = 0) -> Self:
        """Return the paper's settings for recordings: history inputs, weight decay 0.1, data noise 0.01.

        In addition the corrections leave the length of quaternions as it is, which no data determine.
        """
        same = cls.paper(seed, history=True)
        assert same.segments is not None and isinstance(same.residual, NetworkOptions)
        return dataclasses.replace(
            same,
            residual=dataclasses.replace(same.residual, unit_quaternions=True),
            segments=dataclasses.replace(same.segments, weight_decay=0.1, data_noise=0.01),
        )

    @classmethod
    def network(
        cls,
        seed: int | tuple[int, ...] = 0,
        *,
        hidden: int = 128,
        epochs: int = 2000,
        history: bool = False,
        weight_decay: float = 0.3,
    ) -> Self:
        """Return settings of an unconstrained network with standardised inputs and outputs, all nodes."""
        return cls(
            NetworkOptions(hidden=hidden, history=history, convex=False, standardised=True),
            Training(
                epochs=epochs,
                learning_rate=3e-3,
                schedule="cosine",
                loss="standardised",
                weight_decay=weight_decay,
            ),
            seed=seed,
        )

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds as a tuple, also for a single seed."""
        return self.seed if isinstance(self.seed, tuple) else (self.seed,)
