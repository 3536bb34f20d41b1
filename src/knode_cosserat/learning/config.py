"""Settings of a fit: checked when they are made, and converted to JSON and back."""

from __future__ import annotations

import dataclasses
import difflib
import reprlib
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np

from knode_cosserat.errors import KnodeCosseratError


class ConfigError(KnodeCosseratError, ValueError):
    """Invalid setting. The message is one line: the setting, its value and the accepted values."""

    code = "fit-config"


class FitError(KnodeCosseratError, ValueError):
    """A fit that cannot start or continue. The message is one line: the reason, and the kept state."""

    code = "fit"


class _Allowed(NamedTuple):
    """Accepted values: in words, and a function that returns the value to keep, or None to refuse it."""

    words: str
    kept: Callable[[Any], Any]
    #: classes of options within options
    parts: tuple[Any, ...] = ()


def _whole(low: int, high: int = 10_000_000) -> _Allowed:
    words = f"a whole number from {low} to {high}"
    return _Allowed(words, lambda x: int(x) if _is_whole(x, low, high) else None)


def _is_whole(value: Any, low: int, high: float) -> bool:
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and low <= int(value) <= high


def _number(low: float, high: float, *, above: bool = False) -> _Allowed:
    def kept(value: Any) -> float | None:
        if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
            return None
        return float(value) if (low < value if above else low <= value) and value <= high else None

    return _Allowed(f"a number {'above' if above else 'from'} {low:g} up to {high:g}", kept)


def _choice(*names: str) -> _Allowed:
    words = ", ".join(f'"{name}"' for name in names)
    return _Allowed(words, lambda x: x if isinstance(x, str) and x in names else None)


def _several(words: str, test: Callable[[Any], bool]) -> _Allowed:
    def kept(value: Any) -> Any:
        parts = tuple(value) if isinstance(value, list | tuple) else ()
        good = parts and len(set(map(str, parts))) == len(parts) and all(test(part) for part in parts)
        return tuple(part if isinstance(part, str) else int(part) for part in parts) if good else None

    return _Allowed(words, kept)


def _seeds() -> _Allowed:
    words = "a whole number from 0 to 4294967295, or several different ones"
    one = _whole(0, 2**32 - 1).kept
    several = _several(words, lambda x: one(x) is not None).kept
    return _Allowed(words, lambda x: one(x) if several(x) is None else several(x))


def _part(*kinds: type) -> _Allowed:
    words = " or ".join(kind.__name__ for kind in kinds)
    return _Allowed(words, lambda x: x if isinstance(x, kinds) else None, kinds)


def _option(default: Any, allowed: _Allowed, *, none: str = "") -> Any:
    """Return a dataclass field with its accepted values; `none` is the meaning of None, if accepted."""
    return dataclasses.field(default=default, metadata={"allowed": allowed, "none": none})


def _flag(default: bool) -> Any:
    return _option(default, _Allowed("true or false", lambda x: x if isinstance(x, bool) else None))


@dataclasses.dataclass(frozen=True)
class _Options:
    """Settings of one kind. Raises `ConfigError` if a value is not accepted."""

    #: name in a mapping, where several kinds are accepted
    kind: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            (words, kept, _), none = field.metadata["allowed"], field.metadata["none"]
            value = getattr(self, field.name)
            if none and value is None:
                continue
            accepted = kept(value)
            if accepted is None:
                words = f"{words}, or None: {none}" if none else words
                name = f"{type(self).__name__}.{field.name}"
                raise ConfigError(f"{name} is {reprlib.repr(value)}; allowed is {words}")
            object.__setattr__(self, field.name, accepted)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as JSON values."""
        values: dict[str, Any] = {"kind": self.kind} if self.kind else {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            value = value.to_dict() if isinstance(value, _Options) else value
            values[field.name] = list(value) if isinstance(value, tuple) else value
        return values

    @classmethod
    def from_dict(cls, values: Any) -> Self:
        """Return settings from `to_dict`'s result; missing options have defaults. Raises `ConfigError`."""
        fields = {field.name: field for field in dataclasses.fields(cls)}
        names = ", ".join(fields)
        if not isinstance(values, dict):
            raise ConfigError(f"{cls.__name__} is {reprlib.repr(values)}; allowed is a mapping of {names}")
        options = {key: value for key, value in values.items() if key != "kind" or not cls.kind}
        for key, value in options.items():
            if key not in fields:
                close = difflib.get_close_matches(str(key), list(fields), n=1)
                hint = f"; did you mean {close[0]}?" if close else ""
                raise ConfigError(
                    f"{cls.__name__} has no option {reprlib.repr(key)}; there are {names}{hint}"
                )
            parts = fields[key].metadata["allowed"].parts
            if not parts or value is None:
                continue
            kinds = {part.kind: part for part in parts}
            kind = value.get("kind") if isinstance(value, dict) else None
            if len(kinds) > 1 and kind not in kinds:
                raise ConfigError(
                    f"{cls.__name__}.{key} has the kind {reprlib.repr(kind)}; allowed is {', '.join(kinds)}"
                )
            options[key] = (kinds[kind] if len(kinds) > 1 else parts[0]).from_dict(value)
        return cls(**options)


# residuals


@dataclasses.dataclass(frozen=True)
class StructuredOptions(_Options):
    """A structured residual, found by sparse regression (`learning.structured`)."""

    kind: ClassVar[str] = "structured"

    #: if true, nonlinear functions (powers, saturating) are tried where the linear ones leave a remainder
    curved: bool = _flag(True)
    #: if true, the seed draws random row weights (Bayesian bootstrap), so that seeds vary as new data would
    resample: bool = _flag(False)


@dataclasses.dataclass(frozen=True)
class NetworkOptions(_Options):
    """A network with one hidden layer, added to y_s and z (`learning.residual.Network`)."""

    kind: ClassVar[str] = "network"

    hidden: int = _option(512, _whole(1, 100_000))
    #: if true, ʰy and ʰz are inputs too
    history: bool = _flag(False)
    #: if true, the weights are kept nonnegative
    convex: bool = _flag(True)
    #: if true, inputs and outputs are standardised by the statistics of the data
    standardised: bool = _flag(False)
    #: if true, the correction of an orientation's quaternion turns it and leaves its length as it is
    unit_quaternions: bool = _flag(False)


@dataclasses.dataclass(frozen=True)
class PassiveOptions(_Options):
    """A passive residual, with a linear path and a network (`learning.passive`).

    It is trained through rollouts, and only needs measured poses.
    """

    kind: ClassVar[str] = "passive"

    #: units of each of its two networks
    hidden: int = _option(8, _whole(1, 1000))


# training


@dataclasses.dataclass(frozen=True)
class Training(_Options):
    """Gradient training on one-segment samples: Adam, all samples in every epoch."""

    epochs: int = _option(1000, _whole(1))
    learning_rate: float = _option(0.01, _number(0.0, 10.0, above=True))
    #: "plateau": multiplied by `factor` after more than `patience` epochs in which the loss fell by less than
    #: a fraction of 1e-4; "cosine": down to zero over all epochs
    schedule: Literal["plateau", "cosine", "constant"] = _option(
        "plateau", _choice("plateau", "cosine", "constant")
    )
    patience: int = _option(80, _whole(0))
    factor: float = _option(0.5, _number(0.0, 1.0, above=True))
    #: "paper", or "standardised": each error over its own spread (also used if the paper's is not defined)
    loss: Literal["paper", "standardised"] = _option("paper", _choice("paper", "standardised"))
    #: decoupled weight decay (AdamW), for weights but not for biases
    weight_decay: float = _option(0.0, _number(0.0, 10.0))
    #: noise added once, before training, to all numbers of y and z in their own units, as in the paper's
    #: training on recordings
    data_noise: float = _option(0.0, _number(0.0, 10.0))
    #: nodes that are predicted
    nodes: tuple[int, ...] | None = _option(
        None,
        _several("different node numbers from 1 on", lambda x: _is_whole(x, 1, 10_000)),
        none="all nodes",
    )
    #: epochs without a better held-out rollout after which to stop; the best weights are kept
    stop_after: int | None = _option(None, _whole(1), none="never")
    #: epochs between two held-out rollouts
    check_every: int = _option(50, _whole(1))


@dataclasses.dataclass(frozen=True)
class RolloutTraining(_Options):
    """Fine-tuning through whole simulations: only the compared fields of the trajectories must be known."""

    updates: int = _option(100, _whole(1))
    learning_rate: float = _option(1e-3, _number(0.0, 10.0, above=True))
    schedule: Literal["cosine", "constant"] = _option("constant", _choice("cosine", "constant"))
    #: fields of y that are compared
    compared: tuple[str, ...] | None = _option(
        None,
        _several("different names of fields of y", lambda x: isinstance(x, str)),
        none="position p and orientation h",
    )
    #: number of simulated rows
    horizon: int | None = _option(None, _whole(1), none="all rows")
    #: gradient clipping: largest norm of the gradient
    clip: float = _option(1.0, _number(0.0, 1e12, above=True))
    #: largest number of consecutive halvings of a step after which the simulation fails
    rejections: int = _option(8, _whole(1, 1000))
    #: updates without a better held-out rollout after which to stop; the best weights are kept
    stop_after: int | None = _option(None, _whole(1), none="never")
    #: updates between two held-out rollouts
    check_every: int = _option(10, _whole(1))


@dataclasses.dataclass(frozen=True)
class FitConfig(_Options):
    """Settings of `fit`. `FitConfig()` is the best preset.

    Attributes:
        residual: kind of residual and its options.
        segments: gradient training on one-segment samples, or None.
        rollouts: subsequent fine-tuning through whole simulations, or None.
        seed: seed of the initial weights and of the noise; several seeds give several models.

    Raises:
        ConfigError: a value is not allowed.
    """

    residual: StructuredOptions | NetworkOptions | PassiveOptions = _option(  # noqa: RUF009
        StructuredOptions(), _part(StructuredOptions, NetworkOptions, PassiveOptions)
    )
    segments: Training | None = _option(None, _part(Training), none="no such training")  # noqa: RUF009
    rollouts: RolloutTraining | None = _option(  # noqa: RUF009
        None, _part(RolloutTraining), none="no such training"
    )
    seed: int | tuple[int, ...] = _option(0, _seeds())

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.residual, NetworkOptions) and self.segments is None and self.rollouts is None:
            raise ConfigError("FitConfig has a network but neither segments nor rollouts to train it by")
        if isinstance(self.residual, PassiveOptions) and self.rollouts is None:
            raise ConfigError("FitConfig has a passive residual but no rollouts to train it by")

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
                epochs=epochs, learning_rate=3e-3, schedule="cosine", loss="standardised",
                weight_decay=weight_decay,
            ),
            seed=seed,
        )  # fmt: skip

    @classmethod
    def network_recordings(cls, seed: int | tuple[int, ...] = 0, *, hidden: int = 8) -> Self:
        """Return settings of a passive network, whose rollouts do not diverge, trained on measured poses."""
        return cls(PassiveOptions(hidden), rollouts=RolloutTraining(learning_rate=0.02), seed=seed)

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds as a tuple, also for a single seed."""
        return self.seed if isinstance(self.seed, tuple) else (self.seed,)
