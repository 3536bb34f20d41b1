"""Checks of a public function's arguments against its annotations, before it does anything with them."""

from __future__ import annotations

import builtins
import collections.abc
import functools
import importlib
import numbers
import os
import reprlib
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from knode_cosserat._numbers import real_array, with_article
from knode_cosserat.errors import KnodeCosseratError

#: function or constructor that makes an object of a class, for the hint of a message
_MAKERS = {
    "System": "load_robot(NAME)",
    "Trajectory": "simulate or load_trajectory(PATH)",
    "Recording": "load_recording(PATH)",
    "Measurements": "load_recording(PATH).sampled(DT)",
    "RecordingConfig": "RecordingConfig.load(PATH)",
    "KNODE": "fit or load_model(PATH)",
    "Reference": "control.circle or control.table",
    "Controller": "control.controller_named",
    "Plant": "control.SimulatedPlant",
    "Sweep": "sweeps.Sweep.load(PATH)",
    "Environment": "envs.make(TASK)",
    "LoopLog": "control.run_loop",
    "Modes": "statics.modes",
    "Workspace": "workspace",
    "Evaluation": "identification.evaluate",
}
_WORDS = {
    float: "a number",
    int: "a whole number",
    bool: "True or False",
    str: "a text",
    Path: "a path",
    type(None): "None",
    tuple: "a list",
    list: "a list",
    type: "a class",
}
_SCALARS: dict[Any, Any] = {float: numbers.Real, int: numbers.Integral, bool: (bool, np.bool_)}


class ArgumentError(KnodeCosseratError, ValueError, TypeError):
    """An argument of a public function is of a wrong kind; the message is one line."""

    code = "argument"


def check_arguments(
    function: Callable[..., Any], values: Mapping[str, Any], error: type[Exception] = ArgumentError
) -> None:
    """Check arguments against a function's annotations: kinds only, neither shapes nor ranges.

    To be called first in the function, as `check_arguments(function, locals())`. Arguments whose annotation
    is Any or an array are not checked.

    Raises:
        ArgumentError: the first argument that is not what its annotation says; or another class, `error`.
    """
    for name, kind in _kinds(getattr(function, "__func__", function)).items():
        value = values[name]
        if not _matches(value, kind):
            makers = dict.fromkeys(it for it in map(_MAKERS.get, _names(kind)) if it)
            hint = f" (from {' or '.join(makers)})" if makers else ""
            if any(_is_list(one) and _matches([value], one) for one in _parts(kind)):
                hint += f"; did you mean [{name}]?"
            verb = "is"
            items = [typing.get_args(one)[0] for one in _parts(kind) if _is_list(one)]
            if items and isinstance(value, list | tuple) and value:
                verb, value = (
                    "holds",
                    next(one for one in value if not any(_matches(one, it) for it in items)),
                )
            raise error(f"{name} {verb} {kind_text(value, not makers)}; allowed is {_words(kind)}{hint}")


def kind_text(value: Any, plain: bool = False) -> str:
    """Return a value's kind in words, such as "a Recording"; a text without its kind if that is `plain`."""
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, str):
        return reprlib.repr(value) if plain else f"a str {reprlib.repr(value)}"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return with_article(type(value).__name__)


def numbers_of(name: str, values: Any, allowed: str) -> np.ndarray:
    """Return an argument as an array of real numbers; `allowed` are the words of the error.

    Raises:
        ArgumentError: it has other things than numbers.
    """
    try:
        return real_array(values)
    except ValueError as error:
        raise ArgumentError(f"{name} is not numbers ({error}); allowed is {allowed}") from None


#: namespaces that have classes of arguments
_SPACES = ("", "robots", "recordings", "control", "statics", "identification")


class _Names(dict[str, Any]):
    """Names that annotations use, but their module imports for type checking only: the package's own."""

    def __missing__(self, name: str) -> Any:
        package = importlib.import_module(__name__.partition(".")[0])
        # one after the other, because a namespace takes a while to import
        for space in () if hasattr(builtins, name) else _SPACES:
            names = getattr(package, space) if space else package
            if name in names.__all__:
                return getattr(names, name)
        raise KeyError(name)


@functools.cache
def _kinds(function: Any) -> dict[str, Any]:
    """Return the annotations of a function's parameters, without `Any`."""
    names = _Names(function.__globals__)
    hints = {
        name: eval(kind, {}, names) if isinstance(kind, str) else kind
        for name, kind in function.__annotations__.items()
        if name != "return"
    }
    code = function.__code__
    named = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return {name: kind for name, kind in hints.items() if name in named and kind is not Any}


def _parts(kind: Any) -> tuple[Any, ...]:
    """Return the alternatives of a union, or the kind alone."""
    is_union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return typing.get_args(kind) if is_union else (kind,)


def _matches(value: Any, kind: Any) -> bool:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return True
    if len(_parts(kind)) > 1:
        return any(_matches(value, one) for one in inner)
    if kind is None or kind is type(None):
        return value is None
    if origin is typing.Literal:
        return any(type(value) is type(one) and value == one for one in inner)
    if kind in _SCALARS:
        if isinstance(value, np.ndarray | jax.Array):
            value = value.dtype.type(0) if value.ndim == 0 else None
        is_number = isinstance(value, _SCALARS[kind])
        return is_number and (kind is bool or not isinstance(value, bool | np.bool_))
    if kind is Path:
        return isinstance(value, os.PathLike)
    if isinstance(origin, type) and issubclass(origin, collections.abc.Iterable):
        if issubclass(origin, collections.abc.Mapping):
            return isinstance(value, origin)
        if isinstance(value, str | bytes) or not isinstance(
            value, (origin, list, tuple, np.ndarray, jax.Array)
        ):
            return False
        is_list = isinstance(value, list | tuple)
        item = inner[0] if inner and is_list else Any
        return all(_matches(one, item) for one in value) if is_list else True
    if origin is not None:
        return callable(value) if origin is collections.abc.Callable else True
    if getattr(kind, "_is_protocol", False):
        members = {
            name for base in kind.__mro__ if getattr(base, "_is_protocol", False) for name in vars(base)
        }
        return all(hasattr(value, name) for name in members if name[0] != "_")
    # arrays are converted, and checked then
    if not isinstance(kind, type) or kind.__module__.partition(".")[0] == "jaxtyping":
        return True
    return isinstance(value, kind)


def _is_list(kind: Any) -> bool:
    """True for an annotation of several items, other than a mapping."""
    origin = typing.get_origin(kind)
    is_iterable = isinstance(origin, type) and issubclass(origin, collections.abc.Iterable)
    return is_iterable and not issubclass(origin, collections.abc.Mapping)


def _names(kind: Any) -> list[str]:
    """Return the names of the classes in an annotation."""
    inner = typing.get_args(kind)
    if inner and typing.get_origin(kind) is not typing.Literal:
        return [name for one in inner for name in _names(one)]
    return [kind.__name__] if isinstance(kind, type) else []


def _words(kind: Any) -> str:
    """Return an annotation in words."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is Any:
        return "values"
    if len(parts := _parts(kind)) > 1:
        if any("numpy._typing" in repr(one) for one in parts):  # anything that NumPy makes an array of
            own = [_words(one) for one in parts if f"{__name__.partition('.')[0]}." in repr(one)]
            return " or ".join([*own, "an array"])
        return " or ".join(dict.fromkeys(map(_words, parts)))
    if origin is typing.Literal:
        return " or ".join(f'"{one}"' if isinstance(one, str) else repr(one) for one in inner)
    if isinstance(origin, type) and issubclass(origin, collections.abc.Mapping):
        return f"a mapping of names to {_words(inner[1])}"
    if origin is collections.abc.Callable:
        return "a function"
    if _is_list(kind):
        return f"a list, each {_words(inner[0])}" if inner and inner[0] is not Any else "a list"
    if getattr(kind, "__name__", "") == "System":
        return "a robot"
    if kind in (None, *_WORDS):
        return _WORDS[kind or type(None)]
    return with_article(getattr(kind, "__name__", None) or "value")
