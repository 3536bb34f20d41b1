"""Effects of a robot: the library, which is selected by recordings, and plain parameters of any system.

A library effect registers itself: a module `*_effects.py` in this package with a function under `register`.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.parameters import Number, ParameterModel, PossibleEffect
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.parameters import (
    ParameterError,
)
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot, TendonRod
from knode_cosserat.rods.tendons import Markers

#: bound of a recording's clock (s)
LATEST = 0.2
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
Library = Callable[[Any, Usual], list[PossibleEffect]]
_libraries: dict[Library, tuple[int, type]] = {}


def register(order: int = 9, of: type = System) -> Callable[[Library], Library]:
    """Register a function that returns effects of systems of a class; `order` sorts the functions."""

    def added(function: Library) -> Library:
        _libraries[function] = order, of
        return function

    return added


def effects_of(nominal: System, usual: Usual) -> list[PossibleEffect]:
    """Return all registered effects that a robot may have, and those that its parts state."""
    package = importlib.import_module(__name__.rpartition(".")[0])
    for module in pkgutil.iter_modules(package.__path__):
        if module.name.endswith("_effects"):
            importlib.import_module(f"{package.__name__}.{module.name}")
    functions = sorted(_libraries, key=lambda function: _libraries[function][0])
    return [
        effect
        for function in functions
        if isinstance(nominal, _libraries[function][1])
        for effect in function(nominal, usual)
    ]


def library_model(
    nominal: System,
    tension: Float[np.ndarray, "T c"],
    bodies: Iterable[float] = (),
    more: Sequence[PossibleEffect] = (),
    static: bool = False,
) -> ParameterModel:
    """Return the model with all registered effects of a robot; tendons then run beside it.

    Args:
        nominal: the robot of the data sheet.
        tension: controls in the recordings; tensions (N) set the widths of some priors.
        bodies: places of measured bodies, as parts of the length.
        more: further effects, such as plain parameters.
        static: leave out effects that change no equilibrium.
    """
    if isinstance(nominal, TendonRod) and not isinstance(nominal, RoutedTendonRobot):
        offset = float(nominal.tendon_offset) or OFFSET * float(nominal.section.radius)
        nominal = RoutedTendonRobot.like(nominal, tendon_offset=offset)
    usual = Usual(
        float(np.nanmean(tension)) if tension.size else 0.0,
        float(np.nanmax(tension.sum(axis=1), initial=0.0)),
        tuple(float(at) for at in bodies if at > 0.0),
    )
    named = {it.name for it in more}
    effects = [
        it for it in effects_of(nominal, usual) if not (static and it.of_motion) and it.name not in named
    ]
    return ParameterModel(nominal, [*effects, *more])


def place_effects(measured: Iterable[Measurements], *, flat: bool) -> list[PossibleEffect]:
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

    effect = PossibleEffect(
        "marker places",
        numbers,
        lambda robot, values: placed(robot, jnp.stack(values)),
        lambda robot: placed(robot, np.array(stated)),
        basic=True,
        of_recordings=True,
    )
    return [effect] if stated else []


def clock_of(recording: str) -> str:
    """Return the name of the effect of a recording's clocks, by the recording's name."""
    return f"clock of {recording}"


def clock_effects(deviations: Mapping[str, float]) -> list[PossibleEffect]:
    """Return, by recording, how much later than stated its controls acted (s), where this is not known.

    They belong to a recording in several files: `Misfit` moves its controls, and no robot changes.
    """
    return [
        PossibleEffect(
            clock_of(name),
            (Number(clock_of(name), "s", 0.0, deviation, -LATEST, LATEST),),
            _unchanged,
            basic=True,
            of_recordings=True,
            of_motion=True,
        )
        for name, deviation in deviations.items()
        if deviation > 0.0
    ]


def _unchanged(robot: Any, values: list[Any]) -> Any:
    return robot


def along_axes(label: str, unit: str, width: float, axes: str = "xyz", **bounds: Any) -> tuple[Number, ...]:
    """Return one number for each axis, nominally zero; `bounds` are further fields of each."""
    return tuple(Number(f"{label}.{axis}", unit, 0.0, width, **bounds) for axis in axes)
