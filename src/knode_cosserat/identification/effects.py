"""Unknown numbers of a robot, and effects: physical causes that change parameters of its parts.

An effect names a part and its parameters, and adds the part to robots that lack it. At nominal values it
changes nothing, so one compiled program serves any selection of effects: unselected ones stay nominal. A
plain parameter of any system is an effect too, without a prior.

A library effect registers itself: a module `*_effects.py` in this package with a function under `register`.
"""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.parameters import (
    Parameter,
    ParameterError,
    owner_at,
    parameter_at,
    parameters_of,
    unknown_parameter,
    value_at,
)
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.wrapped import nominal_model

#: change of a robot by the values of an effect's parameters; equal for all robots of the same parts
Change = Callable[[Any, list[Any]], Any]


class Number(NamedTuple):
    """One unknown number: its nominal value, the width of its prior, and its bounds.

    The search moves x = (value - nominal) / width, or log(value / nominal) / width if `logarithmic`. It
    starts at `begin`, in these coordinates: for example, friction has no derivative at zero. The prior of x
    is normal with deviation 1; if `flat`, there is none, and the width is a usual step.
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

    def value(self, x: Any) -> Any:
        """Return the value at a coordinate; it may be traced."""
        if self.logarithmic:
            return self.nominal * jnp.exp(self.width * x)
        return self.nominal + self.width * x

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value: the inverse of `value`."""
        if self.logarithmic:
            with np.errstate(divide="ignore"):
                return float(np.log(max(value, 0.0) / self.nominal) / self.width)
        return float((value - self.nominal) / self.width)

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest coordinate."""
        return self.coordinate(self.low), self.coordinate(self.high)


@dataclasses.dataclass(frozen=True)
class Effect:
    """A physical cause, its numbers, and the change that it makes to a robot.

    `part` adds the part that the effect changes to a robot without it. `needs` names effects that it
    requires. A `basic` effect is always identified. A search with few effects starts with the `usual` ones.
    An effect `of_recordings` belongs to the recordings, not to the robot.
    """

    name: str
    meaning: str
    numbers: tuple[Number, ...]
    apply: Change
    part: Callable[[Any], Any] | None = None
    needs: tuple[str, ...] = ()
    basic: bool = False
    usual: bool = False
    of_recordings: bool = False


class Usual(NamedTuple):
    """Usual sizes in the recordings of a robot, for the widths of priors.

    Attributes:
        tension: a usual tension of one tendon (N).
        highest: the highest tension of all tendons together (N).
        bodies: places of measured bodies, which may be on ribs, as parts of the length.
    """

    tension: float
    highest: float
    bodies: tuple[float, ...] = ()


#: effects that a robot may have, for given sizes
Library = Callable[[RoutedTendonRobot, Usual], list[Effect]]
_libraries: dict[Library, int] = {}


def register(order: int = 9) -> Callable[[Library], Library]:
    """Register a function that returns effects of a robot; `order` sorts the functions."""

    def added(function: Library) -> Library:
        _libraries[function] = order
        return function

    return added


def effects_of(nominal: RoutedTendonRobot, usual: Usual) -> list[Effect]:
    """Return all registered effects that a robot may have."""
    package = importlib.import_module(__name__.rpartition(".")[0])
    for module in pkgutil.iter_modules(package.__path__):
        if module.name.endswith("_effects"):
            importlib.import_module(f"{package.__name__}.{module.name}")
    return [effect for function in sorted(_libraries, key=_libraries.__getitem__)
            for effect in function(nominal, usual)]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Replace:
    """Replaces parameters by name; equal to another by their names, so that programs are shared."""

    parameters: tuple[str, ...]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these values."""
        return robot.replace(**dict(zip(self.parameters, values, strict=True)))


@dataclasses.dataclass(frozen=True)
class ReplaceInPart:
    """Replaces numbers of one of the robot's parts, or one vector by all numbers."""

    part: str
    parameters: tuple[str, ...]
    as_vector: bool = False

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these values."""
        numbers = [jnp.stack(values)] if self.as_vector else values
        changes = dict(zip(self.parameters, numbers, strict=True))
        return robot.replace(**{self.part: dataclasses.replace(getattr(robot, self.part), **changes)})


@dataclasses.dataclass(frozen=True)
class ReplaceWhole:
    """Replaces a parameter with several numbers, or a matrix with one."""

    parameter: str
    kind: Literal["multiple", "diagonal", "components"]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with a multiple of the identity, a diagonal matrix, or a vector."""
        numbers = values[0] * jnp.eye(3) if self.kind == "multiple" else jnp.stack(values)
        value = jnp.diag(numbers) if self.kind == "diagonal" else numbers
        return robot.replace(**{self.parameter: value})


def along_axes(label: str, unit: str, width: float, axes: str = "xyz", **more: Any) -> tuple[Number, ...]:
    """Return one number for each axis, nominally zero."""
    return tuple(Number(f"{label}.{axis}", unit, 0.0, width, **more) for axis in axes)


# plain parameters


def parameter_effects(robot: System, names: Sequence[str] | Literal["all"]) -> list[Effect]:
    """Return the named parameters of a robot as effects with flat priors.

    "all" are all of its own that have a value and can be searched. Parameters of parts have names with dots,
    such as `loads.0.mass`. Positive numbers are searched by their logarithm. A matrix is one number, if it is
    a multiple of the identity, or the three of its diagonal.

    Raises:
        ParameterError: a name that does not exist or is given twice, a parameter without a value, or a
            matrix that is not diagonal.
    """
    owner = nominal_model(robot)
    known = owner.parameters()
    wanted: Any = names
    if isinstance(wanted, str) and wanted == "all":
        options = [_parameter_effect(owner, name, parameter) for name, parameter in known.items()]
        return [option for option in options if isinstance(option, Effect)]
    if isinstance(wanted, str) or not isinstance(wanted, Sequence) or not wanted:
        listed = ", ".join(known)
        raise ParameterError(f"parameters is {names!r}; allowed is a list of them, or 'all': {listed}")
    found = []
    for name in names:
        parameter = known.get(name) if "." not in str(name) else parameter_at(owner, name)
        if parameter is None and "." in str(name):
            part, last = owner_at(owner, name)
            if not dataclasses.is_dataclass(part):
                value_at(owner, name)
                raise ParameterError(f"{name} is a part; allowed is one of its parameters, after a dot")
            raise ParameterError(unknown_parameter(type(part), last, parameters_of(type(part))))
        if parameter is None:
            raise ParameterError(unknown_parameter(type(owner), name, known))
        if list(names).count(name) > 1:
            raise ParameterError(f"parameters has {name} twice")
        option = _parameter_effect(owner, name, parameter)
        if isinstance(option, str):
            raise ParameterError(option)
        found.append(option)
    return found


def _parameter_effect(owner: System, name: str, parameter: Parameter) -> Effect | str:
    """Return the effect of a parameter, or the reason why it cannot be searched."""
    part, last = owner_at(owner, name)
    if any(field.name == last and field.metadata.get("static") for field in dataclasses.fields(part)):
        return f"{name} is a place, which a search cannot move; leave it out, and compare several"
    stated = value_at(owner, name)
    if stated is None:
        return f"{name} has no value: it follows from other parameters; give it one, or search for those"
    value, change = np.asarray(stated, dtype=float), None
    if value.ndim == 2:
        if np.any(value != np.diag(np.diag(value))):
            return (
                f"{name} is a matrix with more than a diagonal; allowed is one number or three, its diagonal"
            )
        alike = bool(np.all(np.diag(value) == value[0, 0]))
        value, change = np.diag(value), ReplaceWhole(name, "multiple" if alike else "diagonal")
        value = value[:1] if alike else value
    elif value.ndim == 1:
        change = ReplaceWhole(name, "components")
    numbers = np.atleast_1d(value)
    single = value.ndim == 0 or (change is not None and change.kind == "multiple")
    labels = [name] if single else [f"{name}[{k}]" for k in range(len(numbers))]
    return Effect(
        name,
        parameter.meaning,
        tuple(_flat(label, parameter, float(it)) for label, it in zip(labels, numbers, strict=True)),
        change or Replace((name,)),
    )


def _flat(label: str, parameter: Parameter, value: float) -> Number:
    log = parameter.low > 0.0
    width = 1.0 if log else abs(value) or 1.0
    return Number(label, parameter.unit, value, width, parameter.low, parameter.high, log, flat=True)


def labels_of(effects: Iterable[Effect]) -> tuple[str, ...]:
    """Return the label of every number."""
    return tuple(number.label for effect in effects for number in effect.numbers)
