"""Sparsity of Jacobians: structurally zero columns, found in traced equations.

Every value carries, for each of its elements, the set of input elements that it may depend on. Elementwise
operations, and operations that move elements, keep these sets separate. All other operations merge the sets
of their inputs. The result is therefore never too small.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jaxtyping import Bool, Int

#: elementwise operations
ELEMENTWISE = frozenset((
    "abs", "acos", "acosh", "add", "and", "asin", "asinh", "atan", "atan2", "cbrt", "ceil", "clamp",
    "convert_element_type", "copy", "cos", "cosh", "div", "eq", "erf", "erfc", "exp", "exp2", "expm1",
    "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lgamma", "log", "log1p", "logistic", "lt",
    "max", "min", "mul", "ne", "neg", "nextafter", "not", "or", "pow", "rem", "round", "rsqrt",
    "select_n", "sign", "sin", "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor",
))  # fmt: skip

#: sets of input elements, for each element of a value
Sets = Bool[np.ndarray, "*shape inputs"]


def _slice(sets: Sets, start_indices: Any, limit_indices: Any, strides: Any) -> list[Sets]:
    strides = strides or (1,) * len(start_indices)
    return [sets[tuple(map(slice, start_indices, limit_indices, strides))]]


def _broadcast(sets: Sets, *_: Sets, shape: Any, broadcast_dimensions: Any, **__: Any) -> list[Sets]:
    own = [1] * len(shape)
    for size, axis in zip(sets.shape[:-1], broadcast_dimensions, strict=True):
        own[axis] = size
    return [np.broadcast_to(sets.reshape(*own, sets.shape[-1]), (*shape, sets.shape[-1]))]


def _squeeze(sets: Sets, dimensions: Any) -> list[Sets]:
    return [np.squeeze(sets, tuple(axis % (sets.ndim - 1) for axis in dimensions))]


def _split(sets: Sets, axis: Any, sizes: Any) -> list[Sets]:
    return np.split(sets, np.cumsum(sizes)[:-1], axis=axis)


#: operations that only move elements
MOVES: dict[str, Callable[..., list[Sets]]] = {
    "slice": _slice,
    "broadcast_in_dim": _broadcast,
    "squeeze": _squeeze,
    "split": _split,
    "reshape": lambda sets, new_sizes, **_: [sets.reshape(*new_sizes, sets.shape[-1])],
    "transpose": lambda sets, permutation: [np.transpose(sets, (*permutation, sets.ndim - 1))],
    "rev": lambda sets, dimensions: [np.flip(sets, dimensions)],
    "stack": lambda *sets, axis: [np.stack(sets, axis)],
    "concatenate": lambda *sets, dimension: [np.concatenate(sets, dimension)],
}
CALLS = frozenset(("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat"))


def nonzero_columns(closed: ClosedJaxpr, variable: int) -> Int[np.ndarray, " n"]:
    """Return the indices of those elements of an input vector that the outputs may depend on."""
    inputs = closed.jaxpr.invars
    count = inputs[variable].aval.shape[0]
    given = [np.zeros((*each.aval.shape, count), dtype=bool) for each in inputs]
    given[variable] = np.eye(count, dtype=bool)
    return np.flatnonzero(_any(_propagated(closed.jaxpr, given, count), count))


def _any(sets: Sequence[Sets], count: int) -> Sets:
    """Return the union of all sets."""
    return np.any(
        [np.zeros(count, dtype=bool), *(each.reshape(-1, count).any(axis=0) for each in sets)], axis=0
    )


def _propagated(jaxpr: Jaxpr, given: Sequence[Sets], count: int) -> list[Sets]:
    """Return the sets of the outputs from the sets of the inputs."""
    known = dict(zip(jaxpr.invars, given, strict=True))

    def of(each: Any) -> Sets:
        if isinstance(each, Literal) or each not in known:
            return np.zeros((*each.aval.shape, count), dtype=bool)
        return known[each]

    for step in jaxpr.eqns:
        sets = [of(each) for each in step.invars]
        known |= zip(step.outvars, _of_step(step, sets, count), strict=True)
    return [of(each) for each in jaxpr.outvars]


def _of_step(step: Any, sets: list[Sets], count: int) -> list[Sets]:
    """Return the sets of the outputs of one operation."""
    name, params = step.primitive.name, step.params
    inner = params.get("jaxpr", params.get("call_jaxpr"))
    if name in CALLS and inner is not None:
        return _propagated(inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner, sets, count)
    if name in MOVES:
        return MOVES[name](*sets, **params)
    if name in ELEMENTWISE:
        return [functools.reduce(np.logical_or, sets)]
    mixed = _any(sets, count)
    return [np.broadcast_to(mixed, (*each.aval.shape, count)) for each in step.outvars]
