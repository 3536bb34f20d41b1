"""Physical parameters as unknowns of a search: names, initial values and bounds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parameters import Parameter, ParameterError, parameters_of, unknown_parameter
from knode_cosserat.rods.paths import owner_at, parameter_at, value_at
from knode_cosserat.rods.system import System


class Unknown(NamedTuple):
    """One unknown parameter, and the composition of its value from the searched numbers.

    "number": a scalar. "multiple": one number times the identity matrix. "diagonal": the three diagonal
    numbers of a matrix. "components": the components of a vector or a list. Positive parameters are searched
    by their logarithm.
    """

    name: str
    kind: Literal["number", "multiple", "diagonal", "components"]
    size: int
    logarithmic: bool

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the numbers."""
        if self.kind in ("number", "multiple"):
            return (self.name,)
        return tuple(f"{self.name}[{i}]" for i in range(self.size))

    def value(self, numbers: Any) -> Any:
        """Return the parameter's value from its numbers."""
        if self.kind == "number":
            return numbers[0]
        if self.kind == "multiple":
            return numbers[0] * np.eye(3)
        return jnp.diag(numbers) if self.kind == "diagonal" else numbers


Unknowns = tuple[Unknown, ...]


def unknowns_of(robot: System, names: Sequence[str] | None) -> Unknowns:
    """Return the named parameters of a robot, or all of its own that have a value and can be searched.

    Parameters of parts have names with dots, such as `loads.0.mass`.

    Raises:
        ParameterError: a name that does not exist or is given twice, a parameter without a value, or a
            matrix that is not diagonal.
    """
    owner = robot.nominal
    known = owner.parameters()
    if names is None:
        return tuple(
            unknown for name, parameter in known.items() for unknown in [_unknown(owner, name, parameter)]
            if isinstance(unknown, Unknown)
        )  # fmt: skip
    given: Any = names
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise ParameterError(f"names is {given!r}; allowed is a list of parameters: {', '.join(known)}")
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
            raise ParameterError(f"names has {name} twice")
        unknown = _unknown(owner, name, parameter)
        if isinstance(unknown, str):
            raise ParameterError(unknown)
        found.append(unknown)
    return tuple(found)


def _unknown(owner: System, name: str, parameter: Parameter) -> Unknown | str:
    """Return the unknown of a parameter, or the reason why it cannot be searched."""
    part, last = owner_at(owner, name)
    if any(field.name == last and field.metadata.get("static") for field in dataclasses.fields(part)):
        return f"{name} is a place, which a search cannot move; leave it out of names, and compare several"
    given = value_at(owner, name)
    if given is None:
        return f"{name} has no value: it follows from other parameters; give it one first, or calibrate those"
    value = np.asarray(given)
    logarithmic = parameter.low > 0.0
    if parameter.shape == "scalar":
        return Unknown(name, "number", 1, logarithmic)
    if parameter.shape != "matrix":
        return Unknown(name, "components", value.size, logarithmic)
    diagonal = np.diag(value)
    if np.any(value != np.diag(diagonal)):
        return f"{name} is a matrix with more than a diagonal; allowed is one number or three, its diagonal"
    alike = bool(np.all(diagonal == diagonal[0]))
    return Unknown(name, "multiple" if alike else "diagonal", 1 if alike else 3, logarithmic)


def number_names(unknowns: Unknowns) -> tuple[str, ...]:
    """Return a name for each searched number."""
    return tuple(label for unknown in unknowns for label in unknown.labels)


def values(robot: System, unknowns: Unknowns) -> Float[np.ndarray, " n"]:
    """Return the robot's values of the numbers."""
    owner = robot.nominal
    parts = []
    for unknown in unknowns:
        value = np.asarray(value_at(owner, unknown.name), dtype=float)
        parts.append(np.diag(value) if value.ndim == 2 else np.atleast_1d(value))
    return np.concatenate([part[: unknown.size] for part, unknown in zip(parts, unknowns, strict=True)])


def limits(robot: System, unknowns: Unknowns) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the lowest and the highest allowed value of each number."""
    known = _stated(robot, unknowns)
    low, high = (
        [getattr(each, end) for each, u in zip(known, unknowns, strict=True) for _ in range(u.size)]
        for end in ("low", "high")
    )
    return np.array(low, dtype=float), np.array(high, dtype=float)


def number_units(robot: System, unknowns: Unknowns) -> tuple[str, ...]:
    """Return the unit of each number."""
    known = _stated(robot, unknowns)
    return tuple(each.unit for each, u in zip(known, unknowns, strict=True) for _ in range(u.size))


def _stated(robot: System, unknowns: Unknowns) -> list[Parameter]:
    """Return the statements of the unknown parameters."""
    return [each for u in unknowns if (each := parameter_at(robot.nominal, u.name)) is not None]


def logarithmic(unknowns: Unknowns) -> np.ndarray:
    """Return true for numbers that are searched by their logarithm."""
    return np.array([unknown.logarithmic for unknown in unknowns for _ in range(unknown.size)])


def searched(unknowns: Unknowns, numbers: np.ndarray) -> np.ndarray:
    """Return coordinates of the search from the numbers."""
    which = logarithmic(unknowns)
    return np.where(which, np.log(np.where(which, numbers, 1.0)), numbers)


def searched_numbers(unknowns: Unknowns, coordinates: np.ndarray) -> np.ndarray:
    """Return the numbers from the coordinates of the search."""
    which = logarithmic(unknowns)
    return np.where(which, np.exp(np.where(which, coordinates, 0.0)), coordinates)


def with_coordinates(robot: System, unknowns: Unknowns, coordinates: Any) -> System:
    """Return the robot with the parameters at these coordinates, which may be JAX tracers."""
    changes, first = {}, 0
    for unknown in unknowns:
        numbers = coordinates[first : first + unknown.size]
        changes[unknown.name] = unknown.value(jnp.exp(numbers) if unknown.logarithmic else numbers)
        first += unknown.size
    return robot.replace(**changes)


def with_numbers(robot: System, unknowns: Unknowns, numbers: np.ndarray) -> System:
    """Return the robot with these numbers, each clipped to its allowed range."""
    within = np.clip(numbers, *limits(robot, unknowns))
    changes, first = {}, 0
    for unknown in unknowns:
        own = within[first : first + unknown.size]
        changes[unknown.name] = own[0] if unknown.kind in ("number", "multiple") else own
        first += unknown.size
    return robot.replace(**changes)
