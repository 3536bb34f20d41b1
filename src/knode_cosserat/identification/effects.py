"""Effects of a robot: the library, which is selected by recordings, and plain parameters of any system.

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
from jaxtyping import Float

from knode_cosserat.estimation.parameters import Effect, Model, Number, Replace
from knode_cosserat.recordings.measurements import Measurements
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
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot, TendonRod
from knode_cosserat.rods.tendons import Markers
from knode_cosserat.rods.wrapped import nominal_model

#: tendon offset of a robot that states none, over its radius
OFFSET = 5.0


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


#: effects that a robot may have, for usual sizes
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


def library_model(
    nominal: TendonRod, tension: Float[np.ndarray, "T c"], bodies: Iterable[float] = (),
    more: Sequence[Effect] = (),
) -> Model:  # fmt: skip
    """Return the model with all registered effects of a robot whose tendons run beside it.

    Args:
        nominal: the robot of the data sheet.
        tension: tensions in the recordings (N), which set the widths of some priors.
        bodies: places of measured bodies, as parts of the length.
        more: further effects, such as plain parameters.
    """
    if not isinstance(nominal, RoutedTendonRobot):
        offset = float(nominal.tendon_offset) or OFFSET * float(nominal.section.radius)
        nominal = RoutedTendonRobot.like(nominal, tendon_offset=offset)
    usual = Usual(
        float(np.nanmean(tension)), float(np.nanmax(tension.sum(axis=1))),
        tuple(float(at) for at in bodies if at > 0.0),
    )  # fmt: skip
    return Model(nominal, [*effects_of(nominal, usual), *more])


def place_effects(measured: Iterable[Measurements], *, flat: bool) -> list[Effect]:
    """Return the places of bodies that are not well known, as an effect; `flat` ones have no priors."""
    places: dict[float, float] = {}
    for rows in measured:
        places |= zip(map(float, rows.fractions), rows.deviations, strict=False)
    stated = tuple(sorted(place for place, deviation in places.items() if deviation > 0.0))
    numbers = tuple(Number(f"place[{it:g}]", "", it, places[it], 0.0, 1.0, flat=flat) for it in stated)

    def placed(robot: Any, at: Any) -> Any:
        if not hasattr(robot, "effects"):
            raise ParameterError(
                f"places of bodies are not known, and a {type(robot).__name__} has no `effects`"
            )
        others = [part for part in robot.effects if not isinstance(part, Markers)]
        return robot.replace(effects=(*others, Markers(at=at, stated=stated)))

    effect = Effect(
        "marker places", "places of bodies as parts of the length", numbers,
        lambda robot, values: placed(robot, jnp.stack(values)), lambda robot: placed(robot, np.array(stated)),
        basic=True, of_recordings=True,
    )  # fmt: skip
    return [effect] if stated else []


def along_axes(label: str, unit: str, width: float, axes: str = "xyz", **bounds: Any) -> tuple[Number, ...]:
    """Return one number for each axis, nominally zero; `bounds` are further fields of each."""
    return tuple(Number(f"{label}.{axis}", unit, 0.0, width, **bounds) for axis in axes)


# plain parameters


def parameter_effects(robot: System, names: Sequence[str] | Literal["all"]) -> list[Effect]:
    """Return the named parameters of a robot as effects with flat priors.

    "all" are all of its own that have a value and can be searched. Parameters of parts have names with dots,
    such as `loads.0.mass`. Positive numbers are searched by their logarithm. A matrix is one number, if it is
    a multiple of the identity, or the three of its diagonal. A quaternion is the rotation vector (rad, global
    frame) that turns its nominal value, such as `base_end.orientation turned.x`.

    Raises:
        ParameterError: a name that does not exist or is repeated, a parameter without a value, or a
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
    effects = []
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
        effects.append(option)
    return effects


def _parameter_effect(owner: System, name: str, parameter: Parameter) -> Effect | str:
    """Return the effect of a parameter, or the reason why it cannot be searched."""
    part, last = owner_at(owner, name)
    if any(field.name == last and field.metadata.get("static") for field in dataclasses.fields(part)):
        return f"{name} is a place, which a search cannot move; leave it out, and compare several"
    stated = value_at(owner, name)
    if stated is None:
        return f"{name} has no value: it follows from other parameters; give it one, or search for those"
    value, kind = np.asarray(stated, dtype=float), "numbers"
    if value.ndim == 2:
        diagonal = np.diag(value)
        if np.any(value != np.diag(diagonal)):
            return (
                f"{name} is a matrix with more than a diagonal; allowed is one number or three, its diagonal"
            )
        kind = "diagonal"
        value = diagonal[0] if np.all(diagonal == diagonal[0]) else diagonal
    elif parameter.shape == "quaternion":
        turn = along_axes(f"{name} turned", "rad", 1.0, low=-np.pi, high=np.pi, flat=True)
        return Effect(name, parameter.meaning, turn, Replace((name,), "turn"))
    elif value.ndim == 1:
        kind = "vector"
    labels = [f"{name}[{k}]" for k in range(value.size)] if value.ndim else [name]
    log = parameter.low > 0.0
    numbers = [
        Number(label, parameter.unit, at, 1.0 if log else abs(at) or 1.0, parameter.low, parameter.high, log,
               flat=True)
        for label, at in zip(labels, np.atleast_1d(value).tolist(), strict=True)
    ]  # fmt: skip
    return Effect(name, parameter.meaning, tuple(numbers), Replace((name,), kind))  # type: ignore[arg-type]
