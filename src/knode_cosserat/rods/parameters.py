"""Physical parameters: units, meaning and allowed range, stated once beside each parameter.

The same statement serves `System.replace`, robot files and `knode-cosserat info`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import numpy as np


class ParameterError(ValueError):
    """A parameter's name or value is not allowed; the message says what was given and what is."""


Shape = Literal["scalar", "vector", "matrix", "list"]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """What is known of one parameter. `low` and `high` bound each number (eigenvalue, of a matrix)."""

    unit: str
    meaning: str
    shape: Shape
    low: float
    high: float
    optional: bool

    @property
    def allowed(self) -> str:
        """The allowed values, in words."""
        bounds = f"{self.low:g} to {self.high:g}" + (f" {self.unit}" if self.unit else "")
        kind = {
            "scalar": "a number",
            "vector": "three numbers, each",
            "matrix": "one number, three (a diagonal) or a symmetric 3x3 matrix, with eigenvalues",
            "list": "a list of numbers, each",
        }[self.shape]
        return f"{kind} {bounds}"


def parameter(
    unit: str,
    meaning: str,
    *,
    shape: Shape = "scalar",
    low: float,
    high: float,
    default: Any = dataclasses.MISSING,
) -> Any:
    """A dataclass field that holds a physical parameter (see `Parameter`); a default of None: optional."""
    stated = Parameter(unit, meaning, shape, low, high, optional=default is None)
    extra = {} if default is dataclasses.MISSING else {"default": default}
    return eqx.field(converter=_converter(stated), metadata={"parameter": stated}, **extra)


def parameters_of(cls: type) -> dict[str, Parameter]:
    """The parameters of a class, by name."""
    stated = {field.name: field.metadata.get("parameter") for field in dataclasses.fields(cls)}
    return {name: parameter for name, parameter in stated.items() if parameter is not None}


def checked(name: str, value: Any, parameter: Parameter) -> None:
    """Raise `ParameterError` unless the value is allowed. Tracers cannot be looked at, and pass."""
    if value is None and parameter.optional:
        return
    if isinstance(value, jax.core.Tracer):
        return
    expected = {"scalar": (), "vector": (3,), "matrix": (3, 3)}.get(parameter.shape)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        array = np.array("ragged")
    if array.dtype.kind not in "fiu":
        raise ParameterError(f"{name} is {value!r}; allowed is {parameter.allowed}")
    if (array.ndim != 1 or array.size == 0) if expected is None else array.shape != expected:
        raise ParameterError(f"{name} has shape {array.shape}; allowed is {parameter.allowed}")
    if not np.all(np.isfinite(array)):
        raise ParameterError(f"{name} is {array.tolist()}; allowed is {parameter.allowed}")
    if parameter.shape == "matrix":
        if not np.allclose(array, array.T, rtol=1e-9, atol=0.0):
            raise ParameterError(f"{name} is not symmetric: {array.tolist()}; allowed is {parameter.allowed}")
        array = np.linalg.eigvalsh(array)
    if np.any(array < parameter.low) or np.any(array > parameter.high):
        shown = np.asarray(value).tolist()
        raise ParameterError(f"{name} is {shown}; allowed is {parameter.allowed}")


def _converter(parameter: Parameter) -> Callable[[Any], Any]:
    def convert(value: Any) -> Any:
        if value is None or isinstance(value, jax.core.Tracer):
            return _as_matrix(value) if parameter.shape == "matrix" and value is not None else value
        try:
            array = np.asarray(value)
        except (TypeError, ValueError):  # a ragged list
            return value  # `checked` names it: a converter does not know the parameter's name
        if array.dtype.kind not in "fiu":
            return value
        array = array.astype(float)
        return _as_matrix(array) if parameter.shape == "matrix" else array

    return convert


def _as_matrix(value: Any) -> Any:
    """One number or three become a diagonal matrix; anything else stays, for `checked` to judge."""
    numeric = np if isinstance(value, np.ndarray) else jax.numpy
    if value.shape == ():
        return value * np.eye(3)
    return numeric.diag(value) if value.shape == (3,) else value
