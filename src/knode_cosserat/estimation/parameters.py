"""Unknown numbers of a robot, for identification and for the observers.

An effect is a physical cause: some numbers, and the change that they make to a robot. At nominal values it
changes nothing, so one compiled program serves any selection of effects. A plain parameter is an effect too.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.rods.parameters import ParameterError, parameter_at, value_at
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import quaternion_of, quaternion_product

#: change of a robot by the values of an effect's numbers; equal for all robots of the same parts
Change = Callable[[Any, list[Any]], Any]
#: relative standard deviation of an adapted positive parameter by default
RELATIVE = 0.3
#: adapted coordinates stay within so many standard deviations
WIDEST = 4.0
#: largest number of adapted coordinates: each costs a tangent in every period
MOST = 40
#: beginning of the names of a residual's coefficients
RESIDUAL = "residual"


class Number(NamedTuple):
    """One unknown number: its nominal value, the width of its prior, and its bounds.

    Its coordinate is x = (value - nominal) / width, or log(value / nominal) / width if `logarithmic`. A
    search begins at the coordinate `begin`: for example, friction has no derivative at zero. The prior of x
    is normal with deviation 1; if `flat`, there is none, and the width is a usual step. A `shape` has no
    effect where the other numbers of its effect are nominal: the length of a sleeve that is not stiff.
    """

    label: str
    unit: str
    nominal: float
    width: float
    low: float = -np.inf
    high: float = np.inf
    logarithmic: bool = False
    begin: float = 0.0
    flat: bool = False
    shape: bool = False

    def value(self, x: float) -> float:
        """Return the value at a coordinate."""
        if self.logarithmic:
            return float(self.nominal * np.exp(self.width * x))
        return float(self.nominal + self.width * x)

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value: the inverse of `value`."""
        if self.logarithmic:
            with np.errstate(divide="ignore"):
                return float(np.log(max(value, 0.0) / self.nominal) / self.width)
        return float((value - self.nominal) / self.width)

    def slope(self, value: float) -> float:
        """Return the derivative of the value by the coordinate, at a value."""
        return self.width * (value if self.logarithmic else 1.0)

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest coordinate."""
        return self.coordinate(self.low), self.coordinate(self.high)


@dataclasses.dataclass(frozen=True)
class PossibleEffect:
    """A physical cause, its numbers, and the change that it makes to a robot.

    By default the numbers replace the parameters that their labels name (`numbers_at`). `part` adds the part
    that the effect changes to a robot without it. `needs` names effects that it requires. A `basic` effect is
    always identified. A search with few effects starts with the `usual` ones. An effect `of_recordings`
    belongs to the recordings, not to the robot; one `of_motion` changes no equilibrium.
    """

    name: str
    numbers: tuple[Number, ...]
    change: Change = None  # type: ignore[assignment]
    part: Callable[[Any], Any] | None = None
    needs: tuple[str, ...] = ()
    basic: bool = False
    usual: bool = False
    of_recordings: bool = False
    of_motion: bool = False

    def __post_init__(self) -> None:
        if self.change is None:
            paths = tuple(dict.fromkeys(number.label.partition("[")[0] for number in self.numbers))
            several = self.numbers[0].label.endswith("]")
            object.__setattr__(self, "change", Replace(paths, "vector" if several else "numbers"))


def numbers_at(robot: Any, path: str, width: float, **options: Any) -> tuple[Number, ...]:
    """Return the numbers of a part's parameter, one for each component, as the part states it.

    Unit, range and nominal value are those of the parameter; a symmetric matrix is one number, its first
    entry.

    Args:
        robot: robot that has the part.
        path: name of the parameter, such as `friction.wobble` or `loads.0.mass`.
        width: of the prior of each number.
        options: further fields of each `Number`, such as a narrower range.
    """
    stated, value = parameter_at(robot, path), np.asarray(value_at(robot, path), dtype=float)
    assert stated is not None
    one: dict[str, Any] = {"unit": stated.unit, "width": width, "low": stated.low, "high": stated.high}
    labels = [f"{path}[{k}]" for k in range(len(value))] if value.ndim == 1 else [path]
    values = value if value.ndim == 1 else value.ravel()[:1]
    return tuple(
        Number(**one | {"label": label, "nominal": float(at)} | options)
        for label, at in zip(labels, values, strict=True)
    )


@dataclasses.dataclass(frozen=True)
class Replace:
    """Replaces parameters by name, such as `youngs_modulus` or `loads.0.mass`; one number each.

    Numbers of one parameter are its components or diagonal ("vector"), the coefficients of a residual, the
    first entry of a matrix or list that is multiplied as a whole ("multiple"), or the rotation vector (rad,
    global frame) that turns a quaternion ("turn"): the size of a quaternion has no effect.
    """

    parameters: tuple[str, ...]
    kind: Literal["numbers", "vector", "coefficients", "multiple", "turn"] = "numbers"

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these values."""
        if self.kind == "numbers":
            return robot.replace(**dict(zip(self.parameters, values, strict=True)))
        name, numbers = self.parameters[0], jnp.stack(values)
        if self.kind == "coefficients":
            numbers = numbers.reshape(np.shape(_parameter_value(robot, name)))
        elif self.kind == "turn":
            numbers = quaternion_product(quaternion_of(numbers), _parameter_value(robot, name))
        elif self.kind == "multiple":
            whole = _parameter_value(robot, name)
            numbers = whole * (values[0] / whole.reshape(-1)[0])
        return robot.replace(**{name: numbers})


class ParametrisedRobot(eqx.Module):
    """A robot with all effects as a function of coordinates: a pytree, so that programs serve any robot.

    Attributes:
        robot: the nominal robot with every part.
        nominal: nominal values (n,) of all numbers.
        width: widths (n,) of their priors.
        logarithmic: true for logarithmic numbers.
        changes: for each effect, its change of a robot, and the number of its parameters.
    """

    robot: System
    nominal: Float[Any, " n"]
    width: Float[Any, " n"]
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    changes: tuple[tuple[Change, int], ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.logarithmic)

    def values(self, x: Float[Any, " n"]) -> Float[Any, " n"]:
        """Return the values of all numbers."""
        away, logarithmic = self.width * x, np.array(self.logarithmic, dtype=bool)
        factors = jnp.exp(jnp.where(logarithmic, away, 0.0))
        return self.nominal * factors + jnp.where(logarithmic, 0.0, away)

    def __call__(self, x: Float[Any, " n"]) -> Any:
        """Return the robot at coordinates."""
        values = self.values(x)
        robot, first = self.robot, 0
        for change, count in self.changes:
            robot = change(robot, [values[k] for k in range(first, first + count)])
            first += count
        return robot


class ParameterModel:
    """Unknown numbers of one robot, and the robot with them for any coordinates.

    Attributes:
        nominal: the robot without any change.
        effects: causes of the changes, in the order of the coordinates.
        numbers: their numbers.
        robot: the robot with all effects, a function of coordinates.
    """

    def __init__(self, nominal: System, effects: Iterable[PossibleEffect]):
        self.nominal, self.effects = nominal, tuple(effects)
        self.numbers: tuple[Number, ...] = tuple(it for effect in self.effects for it in effect.numbers)
        self.robot = ParametrisedRobot(
            self._with_parts(self.names),
            np.array([number.nominal for number in self.numbers], dtype=float),
            np.array([number.width for number in self.numbers], dtype=float),
            tuple(number.logarithmic for number in self.numbers),
            tuple((effect.change, len(effect.numbers)) for effect in self.effects),
        )

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.numbers)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the numbers."""
        return tuple(number.label for number in self.numbers)

    @property
    def prior(self) -> Float[np.ndarray, " n"]:
        """Precision of each coordinate's prior: zero for a flat one."""
        return np.array([0.0 if number.flat else 1.0 for number in self.numbers])

    @property
    def shapes(self) -> Bool[np.ndarray, " n"]:
        """True for numbers that have no effect where the others of their effect are nominal."""
        return np.array([number.shape for number in self.numbers], dtype=bool)

    @property
    def begin(self) -> Float[np.ndarray, " n"]:
        """Coordinates where a search begins."""
        return np.array([number.begin for number in self.numbers])

    @functools.cached_property
    def bounds(self) -> Float[np.ndarray, "2 n"]:
        """Lowest and highest coordinates."""
        return np.array([number.bounds for number in self.numbers]).reshape(-1, 2).T

    def slice(self, name: str) -> slice:
        """Return the coordinates of an effect."""
        before = self.effects[: self.names.index(name)]
        first = sum(len(effect.numbers) for effect in before)
        return slice(first, first + len(self.effect(name).numbers))

    def effect(self, name: str) -> PossibleEffect:
        """Return the effect of that name."""
        return self.effects[self.names.index(name)]

    def mask(self, names: Iterable[str]) -> Bool[np.ndarray, " n"]:
        """Return true for the coordinates of these effects."""
        wanted = set(names)
        return np.array([it.name in wanted for it in self.effects for _ in it.numbers], dtype=bool)

    def values(self, x: Float[np.ndarray, " n"]) -> list[float]:
        """Return the numbers' values, within their bounds."""
        return [
            float(np.clip(number.value(at), number.low, number.high))
            for number, at in zip(self.numbers, x, strict=True)
        ]

    def reduced(self, x: Any, names: Sequence[str]) -> Any:
        """Return the robot with the named effects only, and without the parts of all others.

        It moves like `robot` with zero coordinates of the other effects. Coordinates may be traced.
        """
        robot = self._with_parts(names)
        values = self.robot.values(x) if isinstance(x, jax.core.Tracer) else self.values(x)
        for effect in self.effects:
            if effect.name in names:
                robot = effect.change(robot, list(values[self.slice(effect.name)]))
        return robot

    def _with_parts(self, names: Sequence[str]) -> Any:
        """Return the nominal robot with the parts that the named effects change; effects may share a part."""
        parts = [effect.part for effect in self.effects if effect.name in names and effect.part]
        robot: Any = self.nominal
        for part in dict.fromkeys(parts):
            robot = part(robot)
        return robot


# parameters that observers adapt


@dataclasses.dataclass(frozen=True)
class Adapted:
    """One parameter of a robot that is adapted: a number, the components of a vector, or a matrix as a whole.

    Coefficients of a model's learned residual are adapted one by one, all together ("residual") or those of
    one part ("residual.damping").

    Attributes:
        name: as in `System.replace`, such as "youngs_modulus", "loads.0.mass" or "residual.damping".
        deviation: standard deviation of its initial uncertainty, in its unit; None: 30 % of its value. That
            of a matrix is a part of its value, that of coefficients 30 % of their root mean square.
        drift: standard deviation of its change in one second, as a part of `deviation`.
    """

    name: str
    deviation: float | None = None
    drift: float = 0.02


@runtime_checkable
class _Adaptable(Protocol):
    """A model whose residual has coefficients, which `replace` changes as "residual.NAME"."""

    def coefficients(self) -> dict[str, Any]:
        """Return the coefficients by the names of their parts."""
        ...


def adapted_model(
    robot: System, adapted: Sequence[Adapted | str]
) -> tuple[ParameterModel, Float[np.ndarray, " n"]]:
    """Return a robot with adapted parameters, and the drift (n,) of the coordinates in one second.

    Coordinates are zero at the robot's values and have deviation one. Positive parameters are logarithmic.

    Raises:
        ParameterError: a parameter that does not exist, is zero and has no deviation, or has no value, or
            more than `MOST` numbers.
    """
    choices: list[Adapted] = []
    for it in adapted:
        choice = Adapted(it) if isinstance(it, str) else it
        choices += _parts_of_residual(robot, choice) if choice.name == RESIDUAL else [choice]
    model = ParameterModel(robot, [_adapted_effect(robot, choice) for choice in choices])
    if model.size > MOST:
        raise ParameterError(
            f"{model.size} numbers are to be adapted ({', '.join(model.names)}); allowed are at most {MOST}"
        )
    counts = [len(effect.numbers) for effect in model.effects]
    return model, np.repeat(np.array([choice.drift for choice in choices], dtype=float), counts)


def _parts_of_residual(robot: System, choice: Adapted) -> list[Adapted]:
    """Return each part of the residual's coefficients, without those that are zero and have no deviation."""
    parts = robot.coefficients() if isinstance(robot, _Adaptable) else {}
    kept = [name for name, value in parts.items() if choice.deviation is not None or np.any(value)]
    if not kept:
        raise ParameterError("there is no learned residual with coefficients that are not zero")
    return [dataclasses.replace(choice, name=f"{RESIDUAL}.{name}") for name in kept]


def _parameter_value(robot: System, name: str) -> Any:
    """Return the value of a parameter, or of coefficients of a residual."""
    part = name.removeprefix(f"{RESIDUAL}.")
    if part == name:
        return value_at(nominal_model(robot), name)
    parts = robot.coefficients() if isinstance(robot, _Adaptable) else {}
    if part not in parts:
        known = ", ".join(f"{RESIDUAL}.{it}" for it in parts) or "none: the model has no residual"
        raise ParameterError(f"there are no coefficients {name!r}; there are {known}")
    return parts[part]


def _adapted_effect(robot: System, adapted: Adapted) -> PossibleEffect:
    name, deviation = adapted.name, adapted.deviation
    stated = _parameter_value(robot, name)
    try:
        value = np.asarray(stated, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(f"{name} is {stated!r}; allowed is a parameter with numbers") from None
    if stated is None or not np.all(np.isfinite(value)):
        raise ParameterError(f"{name} is {stated!r}; allowed is a parameter with a value")
    if deviation is not None and not deviation > 0.0:
        raise ParameterError(f"the deviation of {name} is {deviation}; allowed is above zero")
    learned = name.startswith(RESIDUAL)
    logarithmic = not learned and (value.ndim == 2 or (value.ndim == 0 and value > 0.0))
    if logarithmic:
        first = float(value.ravel()[0])
        if not first > 0.0:
            raise ParameterError(
                f"{name} is {value.tolist()}; allowed is a matrix with a positive first entry"
            )
        width = RELATIVE if deviation is None else float(deviation) / (1.0 if value.ndim else first)
        low, high = (first * float(np.exp(end * width)) for end in (-WIDEST, WIDEST))
        numbers = [Number(name, "", first, width, low, high, True)]
        return PossibleEffect(name, tuple(numbers), Replace((name,), "multiple" if value.ndim else "numbers"))
    if deviation is None and learned:
        deviation = RELATIVE * float(np.sqrt(np.mean(value**2))) or None
    if deviation is None:
        raise ParameterError(f"{name} is {value.tolist()}: give its deviation, in its unit")
    reach, low, high = WIDEST * deviation, -np.inf, np.inf
    if not value.ndim and not learned:
        known = parameter_at(nominal_model(robot), name)
        assert known is not None
        low, high = known.low, known.high
    several = value.ndim == 1 or learned
    numbers = []
    for k, at in enumerate(value.ravel().tolist()):
        ends = max(low, at - reach), min(high, at + reach)
        numbers.append(Number(f"{name}[{k}]" if several else name, "", at, deviation, *ends))
    effect = PossibleEffect(name, tuple(numbers))
    return dataclasses.replace(effect, change=Replace((name,), "coefficients")) if learned else effect
