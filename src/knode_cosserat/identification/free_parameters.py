"""Identification of free parameters of any system, without priors."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from knode_cosserat.estimation.parameters import Number, ParameterModel, PossibleEffect, Replace
from knode_cosserat.identification.effects import along_axes
from knode_cosserat.identification.journal import SearchError
from knode_cosserat.identification.posterior import Posterior
from knode_cosserat.identification.result import IdentificationError, Identified
from knode_cosserat.identification.search import ParameterSearch, SearchEnd
from knode_cosserat.rods.parameters import (
    Parameter,
    ParameterError,
    owner_at,
    parameters_of,
    unknown_parameter,
    value_at,
)
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.segments import DataError

#: numbers of first horizons that searches leave out, one after the other: with noise the first rows of a
#: motion may mislead a search, while another number of rows does not
SKIPPED = (0, 3, 9)
#: row 0 disagrees with the initial equilibrium if it is further away than this part of the length, and than
#: this part of the motion's root mean square
AWAY, OF_MOTION = 0.01, 0.25
#: a combination of numbers is undetermined if its relative effect is below this
FLAT = 3e-7
#: a positive number is undetermined if the standard error of its logarithm is above this, and any other one
#: if its standard error is above its size
VAGUE, POOR = 1.0, 1.0
#: a number belongs to a combination if its share is above this part of the largest share
PART = 0.1


def identify_parameters(search: ParameterSearch) -> Identified:
    """Return the robot with parameters that have flat priors; undetermined ones stay as they are."""
    model, journal = search.misfit.model, search.journal
    names, nominal = model.names, np.zeros(model.size)
    while True:
        if not names:
            raise IdentificationError(
                f"these data determine none of {', '.join(model.names)}: {journal.steps[-1]}"
            )
        try:
            gap, free = None, model.mask(names)
            with contextlib.suppress(SearchError):  # whole motions of a distant robot may have no solution
                gap = gap_of(search, search.run(nominal, free, effort=(0, 0.0)), False)
            if gap is None:
                searches = (functools.partial(search.from_far, free, skipped) for skipped in SKIPPED)
                point = search.first_explaining(*searches)
                gap = gap_of(search, point, True)
        except SearchError as error:
            _require_start(search, nominal)
            raise IdentificationError(str(error)) from None
        if gap is None:
            break
        missing, reason = gap
        journal.step(reason)
        names = tuple(name for name in names if name not in missing)
    _require_start(search, point.x)
    if not point.converged:
        raise IdentificationError("the search did not converge; begin closer to the data")
    _require_range(model, names, point)
    result = Identified.of(search, point.x, names, Posterior.of(model, point, names))
    undetermined = tuple(name for name in model.names if name not in names)
    return dataclasses.replace(result, undetermined=undetermined)


def gap_of(search: ParameterSearch, point: SearchEnd, at_end: bool) -> tuple[tuple[str, ...], str] | None:
    """Return parameters with flat priors that the data do not determine, and the reason in words; None: none.

    At the start these are only parameters without an effect, and combinations: there a symmetry that hides a
    parameter is exact, and noise breaks it later.
    """
    model, free = search.misfit.model, point.free & (search.prior == 0.0)
    if not free.any():
        return None
    names = np.array([effect.name for effect in model.effects for _ in effect.numbers])[free]
    matrix = point.problem.matrix.sum(axis=0)[np.ix_(free, free)]
    lengths = np.sqrt(np.diag(matrix))
    if np.any(lengths == 0.0):
        idle = tuple(dict.fromkeys(names[lengths == 0.0].tolist()))
        verb = "has" if len(idle) == 1 else "have"
        return idle, f"{', '.join(idle)} {verb} no effect on these data"
    scaled = matrix / np.outer(lengths, lengths)
    squares, directions = np.linalg.eigh(scaled)
    if squares[0] < FLAT**2 * squares[-1]:
        return _combination(names, np.abs(directions[:, 0]))
    if not at_end:
        return None
    covariance = np.linalg.inv(scaled) / np.outer(lengths, lengths)
    errors, largest = np.sqrt(np.diag(covariance)), []
    for effect in model.effects:
        # the largest accepted standard error of every coordinate
        values = [
            number.value(at)
            for number, at in zip(effect.numbers, point.x[model.slice(effect.name)], strict=True)
        ]
        size = max(abs(it) for it in [*values, *(number.nominal for number in effect.numbers)])
        size = size or effect.numbers[0].high - effect.numbers[0].low
        largest += [VAGUE if it.logarithmic else POOR * size / it.width for it in effect.numbers]
    beyond = errors / np.array(largest)[free]
    k = int(np.argmax(beyond))
    if beyond[k] <= 1.0:
        return None
    return _combination(names, np.abs(covariance[k] / errors / errors[k]) ** 20)


def _combination(names: np.ndarray, parts: np.ndarray) -> tuple[tuple[str, ...], str]:
    involved = tuple(dict.fromkeys(names[parts > PART * parts.max()].tolist()))
    if len(involved) == 1:
        return involved, f"these data do not determine {involved[0]}"
    listed = f"{', '.join(involved[:-1])} and {involved[-1]}"
    return involved[-1:], f"these data determine only a combination of {listed}"


def _require_start(search: ParameterSearch, x: np.ndarray) -> None:
    """Raise `DataError` if row 0 is not the equilibrium that an experiment starts from."""
    for data, rollout in zip(search.misfit.data, search.misfit.differences(x, 0), strict=True):
        if data.held is None or rollout is None:
            continue
        seen, off = data.positions(data.data), data.positions(rollout.values[:1] * data.noise)
        if seen is None or off is None:
            continue
        away = np.max(np.nan_to_num(np.linalg.norm(off, axis=-1)))
        moved = np.sum((seen - seen[:1]) ** 2, axis=-1)
        count = np.maximum(np.isfinite(moved).sum(axis=0), 1)
        usual = np.max(np.sqrt(np.nansum(moved, axis=0) / count))
        if away > max(AWAY * search.length, OF_MOTION * usual):
            raise DataError(
                f"{data.name}: row 0 is {1e3 * away:.3g} mm from the equilibrium under "
                f"{np.round(data.held, 4).tolist()}; allowed is data that start at rest. Use the rows "
                "after the robot has settled, state initial_control, give full states, or correct what is "
                "not identified, such as the length"
            )


def _require_range(model: ParameterModel, names: Sequence[str], point: SearchEnd) -> None:
    """Raise if a number ended at a limit of its allowed range; a limit of zero is accepted."""
    for number, value, free in zip(model.numbers, model.values(point.x), model.mask(names), strict=True):
        for end in (number.low, number.high):
            if free and end != 0.0 and abs(value - end) <= 1e-6 * abs(end):
                raise IdentificationError(
                    f"{number.label} ran to the end of its allowed range, {end:g}; leave it out"
                )


def parameter_effects(robot: System, names: Sequence[str] | Literal["all"]) -> list[PossibleEffect]:
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
        return [option for option in options if isinstance(option, PossibleEffect)]
    if isinstance(wanted, str) or not isinstance(wanted, Sequence) or not wanted:
        listed = ", ".join(known)
        raise ParameterError(f"parameters is {names!r}; allowed is a list of them, or 'all': {listed}")
    effects = []
    for name in names:
        part, last = owner_at(owner, name) if "." in str(name) else (owner, name)
        if not dataclasses.is_dataclass(part):
            value_at(owner, name)
            raise ParameterError(f"{name} is a part; allowed is one of its parameters, after a dot")
        stated = parameters_of(type(part))
        if last not in stated:
            raise ParameterError(unknown_parameter(type(part), last, stated))
        if list(names).count(name) > 1:
            raise ParameterError(f"parameters has {name} twice")
        option = _parameter_effect(owner, name, stated[last])
        if isinstance(option, str):
            raise ParameterError(option)
        effects.append(option)
    return effects


def _parameter_effect(owner: System, name: str, parameter: Parameter) -> PossibleEffect | str:
    """Return the effect of a parameter, or the reason why it cannot be searched."""
    part, last = owner_at(owner, name)
    if any(field.name == last and field.metadata.get("static") for field in dataclasses.fields(part)):
        return f"{name} is a place, which a search cannot move; leave it out, and compare several"
    stated = value_at(owner, name)
    if stated is None:
        return f"{name} has no value: it follows from other parameters; give it one, or search for those"
    if parameter.shape == "quaternion":
        turn = along_axes(f"{name} turned", "rad", 1.0, low=-np.pi, high=np.pi, flat=True)
        return PossibleEffect(name, turn, Replace((name,), "turn"))
    value = np.asarray(stated, dtype=float)
    if value.ndim == 2:
        diagonal = np.diag(value)
        if np.any(value != np.diag(diagonal)):
            return (
                f"{name} is a matrix with more than a diagonal; allowed is one number or three, its diagonal"
            )
        value = diagonal[0] if np.all(diagonal == diagonal[0]) else diagonal
    labels = [f"{name}[{k}]" for k in range(value.size)] if value.ndim else [name]
    log = parameter.low > 0.0
    numbers = [
        Number(
            label,
            parameter.unit,
            at,
            1.0 if log else abs(at) or 1.0,
            parameter.low,
            parameter.high,
            log,
            flat=True,
        )
        for label, at in zip(labels, np.atleast_1d(value).tolist(), strict=True)
    ]
    return PossibleEffect(name, tuple(numbers))
