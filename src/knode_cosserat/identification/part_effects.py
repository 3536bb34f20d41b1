"""Effects that parts state: parameters with a `Doubt`, of any system and of its parts.

Numbers of one kind of several parts, or of one list, are two effects: what they have in common, and what each
has of its own. So are the areas of three chambers, or the curvatures of three tubes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from knode_cosserat.estimation.parameters import Number, PossibleEffect
from knode_cosserat.identification.effects import Usual, register
from knode_cosserat.rods.camera import Camera
from knode_cosserat.rods.parameters import (
    Parameter,
    names_of,
    owner_at,
    parameter_at,
    parameters_of,
    slots_of,
    value_at,
)
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot

#: deviation of each of several numbers over that of what they have in common
OWN = 0.5
#: bounds of a factor
LEAST, MOST = 0.05, 20.0
#: where numbers of a robot with tendons are those of the library, with other names
OF_LIBRARY = ("", "loads", "camera")


class _Stated(NamedTuple):
    """A parameter with a doubt: its path, that with a star for each number of a part, statement and value."""

    path: str
    kind: str
    parameter: Parameter
    value: Any


@register(order=-1)
def part_effects(nominal: System, usual: Usual) -> list[PossibleEffect]:
    """Return the effects that a system and its parts state, and those of the camera that measures it."""
    seen, added = nominal, None
    if "camera" in slots_of(type(nominal)) and nominal.camera is None:  # type: ignore[attr-defined]
        added = _with_camera
        seen = added(nominal)
    kinds: dict[str, list[_Stated]] = {}
    for stated in _stated(seen, "", ""):
        first = stated.path.rpartition(".")[0].partition(".")[0]
        if not (isinstance(nominal, RoutedTendonRobot) and first in OF_LIBRARY):
            kinds.setdefault(stated.kind, []).append(stated)
    effects: dict[str, PossibleEffect] = {}
    for kind, alike in kinds.items():
        for effect in _effects(alike, added):
            # parts of several classes may have parameters of one name
            name = effect.name if effect.name not in effects else f"{effect.name} of {kind}"
            effects[name] = dataclasses.replace(effect, name=name)
    return [*effects.values()]


def _with_camera(robot: Any) -> Any:
    return robot.replace(camera=robot.camera or Camera())


def _stated(owner: Any, path: str, kind: str) -> Iterator[_Stated]:
    """Yield the parameters with a doubt of a system or part and its parts, in their order."""
    for name, parameter in parameters_of(type(owner)).items():
        value, doubt = getattr(owner, name), parameter.doubt
        if doubt is None:
            continue
        if value is None and doubt.of:
            value = getattr(owner, doubt.of)
        if value is not None:
            yield _Stated(path + name, kind + name, parameter, np.asarray(value, dtype=float))
    for name in slots_of(type(owner)):
        parts = getattr(owner, name)
        if isinstance(parts, tuple):
            for own, part in zip(names_of(parts), parts, strict=True):
                yield from _stated(part, f"{path}{name}.{own}.", f"{kind}{name}.*{type(part).__name__}.")
        elif dataclasses.is_dataclass(parts):
            yield from _stated(parts, f"{path}{name}.", f"{kind}{name}.")


def _effects(alike: list[_Stated], added: Any) -> list[PossibleEffect]:
    """Return the effects of a parameter of one part, or of several parts of one class."""
    doubt, first = alike[0].parameter.doubt, alike[0]
    assert doubt is not None
    several, effects = len(alike) > 1, list[PossibleEffect]()
    # without the numbers of parts, but for those of a single part
    name = ".".join(it for it in first.kind.split(".") if not it.startswith("*")) if several else first.path
    paths, part = tuple(it.path for it in alike), added if first.path.startswith("camera.") else None
    if doubt.relative and any(np.any(it.value) for it in alike):
        effects += _factors(name, alike, paths, part)
    if doubt.absolute:
        lists = first.parameter.shape == "list" and max(it.value.size for it in alike) > 1
        share = OWN if (several or lists) and doubt.common else 1.0
        numbers = tuple(number for it in alike for number in _numbers(it, share, several or lists))
        if (several or lists) and doubt.common:
            unit, width = first.parameter.unit, doubt.absolute
            common = (Number(name, unit, 0.0, width, begin=doubt.begin),)
            effects.append(PossibleEffect(name, common, Add(paths, doubt.of, True), part))
        if several or lists:
            change = Add(paths, doubt.of, False, tuple(it.value.size for it in alike))
            named = f"{name}, each" if doubt.common else name
            effects.append(PossibleEffect(named, numbers, change, part))
        else:
            effects.append(PossibleEffect(name, numbers, part=part, basic=doubt.basic))
    return effects


def _factors(name: str, alike: list[_Stated], paths: tuple[str, ...], part: Any) -> list[PossibleEffect]:
    """Return the effect of a common factor, and that of a factor of each part."""
    stated, first = alike[0].parameter, alike[0]
    doubt = stated.doubt
    assert doubt is not None
    if len(alike) == 1 and not first.value.ndim and first.value > 0.0 and not doubt.of:
        # the parameter itself, which has a unit
        one = Number(name, stated.unit, float(first.value), doubt.relative, stated.low, stated.high, True)
        if stated.low <= 0.0:
            one = one._replace(low=LEAST * one.nominal)
        return [PossibleEffect(name, (one,), part=part, basic=doubt.basic)]

    def factor(label: str, width: float) -> Number:
        return Number(label, "", 1.0, width, LEAST, MOST, True)

    common = (factor(name, doubt.relative),)
    found = [PossibleEffect(name, common, Scale(paths, doubt.of, True), part, basic=doubt.basic)]
    if len(alike) > 1:
        own = tuple(factor(f"{path} (own)", OWN * doubt.relative) for path in paths)
        found.append(PossibleEffect(f"{name}, each", own, Scale(paths, doubt.of, False), part))
    return found


def _numbers(stated: _Stated, share: float, added: bool) -> list[Number]:
    """Return a number for each component of a parameter: its value, or what is `added` to it."""
    parameter, value = stated.parameter, stated.value
    doubt = parameter.doubt
    assert doubt is not None
    labels = [f"{stated.path}[{k}]" for k in range(value.size)] if value.ndim else [stated.path]
    width, begin = share * doubt.absolute, doubt.begin
    found = []
    for label, at in zip(labels, value.ravel().tolist(), strict=True):
        low, high = parameter.low, parameter.high
        if added:
            label, at, low, high = f"{label} (own)", 0.0, low - at, high - at
        found.append(Number(label, parameter.unit, at, width, low, high, begin=begin))
    return found


def _present(robot: Any, path: str, of: str) -> Any:
    """Return the value of a parameter, or that which it has by default, of a property."""
    value = value_at(robot, path)
    if value is not None:
        return value
    return getattr(owner_at(robot, path)[0], of)


def _within(robot: Any, path: str, value: Any) -> Any:
    """Return a value within the range of its parameter, which several effects may leave together."""
    stated = parameter_at(robot, path)
    if stated is None or stated.shape == "matrix":
        return value
    # unlike a clip, with the whole derivative at an end of the range
    return jnp.where(value < stated.low, stated.low, jnp.where(value > stated.high, stated.high, value))


@dataclasses.dataclass(frozen=True)
class Scale:
    """Multiplies parameters by one factor, or by a factor each; `of` as in `Doubt`."""

    parameters: tuple[str, ...]
    of: str
    common: bool

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these factors."""
        factors = values * len(self.parameters) if self.common else values
        pairs = zip(self.parameters, factors, strict=True)
        changes = {
            path: _within(robot, path, _present(robot, path, self.of) * factor) for path, factor in pairs
        }
        return robot.replace(**changes)


@dataclasses.dataclass(frozen=True)
class Add:
    """Adds one number to all parameters, or a number to each of their components; `of` as in `Doubt`."""

    parameters: tuple[str, ...]
    of: str
    common: bool
    sizes: tuple[int, ...] = ()

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these numbers added."""
        changes, first = {}, 0
        for k, path in enumerate(self.parameters):
            present = _present(robot, path, self.of)
            if self.common:
                more: Any = values[0]
            elif np.ndim(present):
                more = jnp.stack(values[first : first + self.sizes[k]])
            else:
                more = values[first]
            first += 0 if self.common else self.sizes[k]
            changes[path] = _within(robot, path, jnp.asarray(present) + more)
        return robot.replace(**changes)
