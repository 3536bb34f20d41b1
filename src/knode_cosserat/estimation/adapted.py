"""Physical parameters, and coefficients of a learned residual, that are adapted while a robot runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parameters import ParameterError, parameters_of, value_at
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model

#: relative standard deviation of a positive parameter by default
RELATIVE = 0.3
#: coordinates stay within so many standard deviations
WIDEST = 4.0
#: largest number of coordinates: each costs a tangent in every period
MOST = 40


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


class AdaptedParameters(eqx.Module):
    """Parameters of a robot as functions of coordinates that are zero at its values, with deviation one.

    Positive parameters are searched by their logarithm. A pytree: programs are compiled for names and sizes.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    #: True for each that is searched by its logarithm, and for each whose numbers are searched one by one
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    vector: tuple[bool, ...] = eqx.field(static=True)
    values: tuple[Any, ...]
    deviations: tuple[Any, ...]
    #: standard deviation of each coordinate's change in one second
    drift: Float[Any, " n"]
    #: least and greatest coordinates (2, n)
    bounds: Float[Any, "2 n"]

    def __init__(self, robot: System, adapted: Sequence[Adapted | str]):
        """Look up the parameters.

        Raises:
            ParameterError: a parameter that does not exist, is zero and has no deviation, or has no value,
                or more than `MOST` numbers.
        """
        given = [part for each in adapted for part in _parts_of_residual(robot, each)]
        self.names = tuple(each.name for each in given)
        parts = [_part(robot, each) for each in given]
        self.values = tuple(value for value, _, _ in parts)
        self.deviations = tuple(np.asarray(deviation) for _, deviation, _ in parts)
        self.logarithmic = tuple(log for _, _, log in parts)
        self.vector = tuple(
            value.ndim == 1 or name.startswith(RESIDUAL)
            for value, name in zip(self.values, self.names, strict=True)
        )
        if self.size > MOST:
            raise ParameterError(
                f"{self.size} numbers are to be adapted ({', '.join(self.names)}); allowed are at most {MOST}"
            )
        self.drift = np.repeat(np.array([each.drift for each in given], dtype=float), self.sizes)
        ends = [self._ends(robot, k) for k in range(len(given))]
        self.bounds = np.repeat(np.array(ends, dtype=float).reshape(-1, 2), self.sizes, axis=0).T

    def _ends(self, robot: System, k: int) -> tuple[float, float]:
        """Return the bounds of a parameter's coordinates: those of its values, and `WIDEST`."""
        if self.logarithmic[k] or self.vector[k]:
            return -WIDEST, WIDEST
        owner, _, name = self.names[k].rpartition(".")
        known = parameters_of(type(_looked_up(robot, owner) if owner else nominal_model(robot)))
        value, deviation = float(self.values[k]), float(self.deviations[k])
        low, high = ((end - value) / deviation for end in (known[name].low, known[name].high))
        return max(-WIDEST, low), min(WIDEST, high)

    @property
    def sizes(self) -> list[int]:
        """Number of coordinates of each parameter."""
        return [value.size if vector else 1 for value, vector in zip(self.values, self.vector, strict=True)]

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return sum(self.sizes)

    @property
    def labels(self) -> tuple[str, ...]:
        """Name of every coordinate's number."""
        return tuple(
            f"{name}[{k}]" if vector else name
            for name, size, vector in zip(self.names, self.sizes, self.vector, strict=True)
            for k in range(size)
        )

    def numbers(self, x: Any) -> list[Any]:
        """Return the values of all parameters at these coordinates."""
        found, first = [], 0
        numeric: Any = np if isinstance(x, np.ndarray) else jnp
        for k, size in enumerate(self.sizes):
            value, deviation = self.values[k], self.deviations[k]
            moved = x[first : first + size].reshape(value.shape) if self.vector[k] else x[first]
            # a logarithm's deviation is relative
            log = self.logarithmic[k]
            found.append(value * numeric.exp(deviation * moved) if log else value + deviation * moved)
            first += size
        return found

    def of(self, robot: System, x: Any) -> System:
        """Return the robot at these coordinates, which may be JAX tracers."""
        if not self.names:
            return robot
        return robot.replace(**dict(zip(self.names, self.numbers(x), strict=True)))


#: beginning of the names of a residual's coefficients
RESIDUAL = "residual"


def _parts_of_residual(robot: System, adapted: Adapted | str) -> list[Adapted]:
    """Return the parameter, or one for each part of the residual's coefficients if all are wanted.

    Parts that are all zero, and have no deviation, are left out.
    """
    given = Adapted(adapted) if isinstance(adapted, str) else adapted
    if given.name != RESIDUAL:
        return [given]
    parts = robot.coefficients() if isinstance(robot, Adaptable) else {}
    kept = [name for name, value in parts.items() if given.deviation is not None or np.any(value)]
    if not kept:
        raise ParameterError("there is no learned residual with coefficients that are not zero")
    return [dataclasses.replace(given, name=f"{RESIDUAL}.{name}") for name in kept]


@runtime_checkable
class Adaptable(Protocol):
    """A model whose residual has coefficients, which `replace` changes as "residual.NAME"."""

    def coefficients(self) -> dict[str, Any]:
        """Return the coefficients by the names of their parts."""
        ...


def _looked_up(robot: System, name: str) -> Any:
    if name.startswith(f"{RESIDUAL}."):
        parts = robot.coefficients() if isinstance(robot, Adaptable) else {}
        part = name.removeprefix(f"{RESIDUAL}.")
        if part not in parts:
            raise ParameterError(
                f"there are no coefficients {name!r}; there are "
                f"{', '.join(f'{RESIDUAL}.{known}' for known in parts) or 'none: the model has no residual'}"
            )
        return parts[part]
    return value_at(nominal_model(robot), name)


def _part(robot: System, adapted: Adapted) -> tuple[np.ndarray, float, bool]:
    """Return a parameter's value, its deviation, and True if it is searched by its logarithm.

    The deviation of a logarithm is relative to the value.
    """
    name, deviation = adapted.name, adapted.deviation
    given = _looked_up(robot, name)
    try:
        value = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(f"{name} is {given!r}; allowed is a parameter with numbers") from None
    if given is None or not np.all(np.isfinite(value)):
        raise ParameterError(f"{name} is {given!r}; allowed is a parameter with a value")
    if deviation is not None and not deviation > 0.0:
        raise ParameterError(f"the deviation of {name} is {deviation}; allowed is above zero")
    if name.startswith(RESIDUAL):
        usual = RELATIVE * float(np.sqrt(np.mean(value**2)))
        deviation = usual if deviation is None and usual > 0.0 else deviation
    elif value.ndim == 2:
        return value, RELATIVE if deviation is None else float(deviation), True
    elif value.ndim == 0 and value > 0.0:
        return value, RELATIVE if deviation is None else float(deviation / value), True
    if deviation is None:
        raise ParameterError(f"{name} is {value.tolist()}: give its deviation, in its unit")
    return value, float(deviation), False
