"""Linear maps of numbers in memory, as lists of operations: written forward or transposed.

The transpose of a map is the list of the transposed operations in reverse order, in which each number stands
for its cotangent. All numbers start as zeros; a map clears each number before it adds to it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from knode_cosserat.engine.codegen import Index, Value
from knode_cosserat.engine.memory import Array, Memory


class Number(NamedTuple):
    """Component i of an array at place j; without an array, a number of one straight piece of a map."""

    array: Array | None
    i: int
    j: int | Index = 0

    @property
    def key(self) -> Any:
        """A key that is equal for the same number."""
        own = None if self.array is None else (self.array.offset, self.array.memory)
        j = self.j
        return own, self.i, j if isinstance(j, int) else j.key


Coefficient = Number | Value | float


@dataclasses.dataclass(frozen=True)
class Add:
    """Add a product to a number, or subtract it if it is negative."""

    target: Number
    source: Number
    coefficient: Coefficient = 1.0
    is_negative: bool = False

    def transposed(self) -> Add:
        """Return the transposed operation."""
        return dataclasses.replace(self, target=self.source, source=self.target)


@dataclasses.dataclass(frozen=True)
class Scale:
    """Multiply a number; without a coefficient, set it to zero."""

    target: Number
    coefficient: Coefficient | None = None

    def transposed(self) -> Scale:
        """Return the transposed operation."""
        return self


@dataclasses.dataclass(frozen=True)
class Loop:
    """Operations at each place from `start` to below `stop`, in this order or, if it descends, in reverse."""

    start: Any
    stop: Any
    body: Callable[[Index], Sequence[Operation]]
    descends: bool = False


Operation = Add | Scale | Loop


def write(memory: Memory, operations: Sequence[Operation], lanes: int, transposed: bool) -> None:
    """Write the code of a map, with as many vectors side by side as there are lanes."""
    straight: list[Add | Scale] = []
    for operation in reversed(operations) if transposed else operations:
        if not isinstance(operation, Loop):
            straight.append(operation.transposed() if transposed else operation)
            continue
        _write_straight(memory, straight, lanes)
        straight = []
        start, stop, f = operation.start, operation.stop, memory._now
        down = operation.descends != transposed
        with f.loop(start, stop + (-1), -1) if down else f.loop(stop, start) as j:
            write(memory, operation.body(j), lanes, transposed)
    _write_straight(memory, straight, lanes)


def _write_straight(memory: Memory, operations: Sequence[Add | Scale], lanes: int) -> None:
    """Write operations without loops: each number is read once and written once."""
    values: dict[Any, Value | None] = {}
    changed: dict[Any, tuple[Array, int, int | Index]] = {}

    def get(number: Number) -> Value | None:
        """Return the value of a number; None is zero."""
        if number.key not in values:
            array, i, j = number
            values[number.key] = None if array is None else memory._get(array, i, j, lanes)
        return values[number.key]

    def times(coefficient: Coefficient, value: Value) -> Value:
        if isinstance(coefficient, Number):
            assert coefficient.array is not None
            coefficient = memory._get(coefficient.array, coefficient.i, coefficient.j, 1)
        return value if coefficient == 1.0 else coefficient * value

    for operation in operations:
        target = operation.target
        if target.array is not None:
            changed[target.key] = target.array, target.i, target.j
        coefficient = operation.coefficient
        value = None if coefficient is None else get(target)
        if isinstance(operation, Scale):
            values[target.key] = None if coefficient is None or value is None else times(coefficient, value)
            continue
        source = get(operation.source)
        if source is None:
            continue
        product = times(operation.coefficient, source)
        if value is None:
            values[target.key] = -product if operation.is_negative else product
        else:
            values[target.key] = value - product if operation.is_negative else value + product
    for key, place in changed.items():
        value = values[key]
        memory._put(0.0 if value is None else value, *place, lanes)
