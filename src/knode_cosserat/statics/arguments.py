"""Checks of the arguments of static tasks; every error is one line."""

from __future__ import annotations

from typing import Any

import numpy as np

from knode_cosserat._numbers import real_array
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.schemes.space import SpaceScheme


def static_settings(space: str | SpaceScheme, newton: NewtonOptions) -> Settings:
    """Return the settings of `kc.equilibrium`."""
    return Settings.of(None, space, "paper", newton)


def checked_vectors(name: str, given: Any, size: int | Layout, allowed: str, most: int = 2) -> np.ndarray:
    """Return finite numbers (size,), or with `most` 2 also (B, size); tables by the names of a layout."""
    try:
        numbers = size.numbers_of(given) if isinstance(size, Layout) else real_array(given)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is not numbers ({error}); allowed is {allowed}") from None
    size = size.size if isinstance(size, Layout) else size
    # zero rows are refused; a row of size zero is the control of a robot without controls
    if not 1 <= numbers.ndim <= most or numbers.shape[-1] != size or 0 in numbers.shape[:-1]:
        raise ValueError(f"{name} has shape {numbers.shape}; allowed is {allowed}")
    if not np.all(np.isfinite(numbers)):
        bad = tuple(np.argwhere(~np.isfinite(numbers))[0].tolist())
        raise ValueError(f"{name} is {numbers[bad]} at index {bad}; it must be finite")
    return numbers


def checked_control(system: System, control: Any, name: str = "control") -> np.ndarray:
    """Return one control (c,)."""
    size = system.control_layout.size
    names = ", ".join(f"{field.name} ({field.unit})" for field in system.control_layout.fields)
    if control is None and not size:
        control = np.zeros(0)
    allowed = f"({size},): {names or 'there are no controls'}"
    numbers = checked_vectors(name, control, system.control_layout, allowed, 1)
    return within_limits(system, numbers, name)


def within_limits(system: System, controls: np.ndarray, name: str) -> np.ndarray:
    """Return controls (…, c), if they are within their fields' limits; `ValueError` otherwise."""
    beyond = system.control_layout.beyond(controls)
    if beyond:
        raise ValueError(f"{name}: {beyond}")
    return controls


def checked_limits(system: System, low: Any, high: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return limits (c,) of the controls, from numbers or (c,)."""
    if not system.control_layout.size:
        raise ValueError(f"a {type(system).__name__} without controls is given; allowed is one with controls")
    found = []
    for name, given in (("low", low), ("high", high)):
        number = isinstance(given, int | float | np.number)
        found.append(checked_control(system, [given] * system.control_layout.size if number else given, name))
    if np.any(found[0] > found[1]):
        i = int(np.argmax(found[0] > found[1]))
        raise ValueError(
            f"low is {found[0][i]:g} and high {found[1][i]:g} for control {i}; low must not be above high"
        )
    return found[0], found[1]
