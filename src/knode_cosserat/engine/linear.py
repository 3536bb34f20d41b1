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


@dataclasses.dataclass(frozen=True)
class Columns:
    """Numbers outside of the memory at an address, those of all vectors side by side."""

    base: Value
    width: Value

    @property
    def key(self) -> Any:
        """A key that is equal for the same numbers."""
        return self.base.name


class Entry(NamedTuple):
    """Component i of an array at place j; without an array, a number of one straight piece of a map."""

    array: Array | Columns | None
    i: int
    j: int | Index = 0

    @property
    def key(self) -> Any:
        """A key that is equal for the same number."""
        array, i, j = self
        own = (array.offset, array.memory) if isinstance(array, Array) else array and array.key
        return own, i, j if isinstance(j, int) else j.key


Coefficient = Entry | Value | float


@dataclasses.dataclass(frozen=True)
class Add:
    """Add a product to a number, or subtract it if it is negative."""

    target: Entry
    source: Entry
    coefficient: Coefficient = 1.0
    is_negative: bool = False

    def transpose(self) -> Add:
        """Return the transposed operation."""
        return dataclasses.replace(self, target=self.source, source=self.target)


@dataclasses.dataclass(frozen=True)
class Scale:
    """Multiply a number; without a coefficient, set it to zero."""

    target: Entry
    coefficient: Coefficient | None = None

    def transpose(self) -> Scale:
        """Return the transposed operation."""
        return self


@dataclasses.dataclass(frozen=True)
class Show:
    """Copy a number to one that no other operation reads or writes."""

    target: Entry
    source: Entry

    def transpose(self) -> Add:
        """Return the transposed operation."""
        return Add(self.source, self.target)


@dataclasses.dataclass(frozen=True)
class PlaceLoop:
    """Operations at each place from `start` to below `stop`, in this order or, if it descends, in reverse."""

    start: Any
    stop: Any
    body: Callable[[Index], Sequence[Operation]]
    descends: bool = False


Straight = Add | Scale | Show
Operation = Straight | PlaceLoop


def write(memory: Memory, operations: Sequence[Operation], lanes: int, transposed: bool) -> None:
    """Write the code of a map, with as many vectors side by side as there are lanes."""
    sums = _Sums(memory, lanes)
    for operation in reversed(operations) if transposed else operations:
        if not isinstance(operation, PlaceLoop):
            sums.add(operation.transpose() if transposed else operation)
            continue
        sums.write_all()
        start, stop, f = operation.start, operation.stop, memory._now
        down = operation.descends != transposed
        with f.loop(start, stop + (-1), -1) if down else f.loop(stop, start) as j:
            write(memory, operation.body(j), lanes, transposed)
    sums.write_all()


class _Sums:
    """Operations without loops that are still to be written, by the numbers that they change.

    A sum is written when its number is needed, or before a number changes that it needs: each number is read
    once and written once for all that is added to it, whatever the order of the operations.
    """

    def __init__(self, memory: Memory, lanes: int):
        # numbers may be those of `Columns`, which only the memory of a map knows
        self._memory: Any = memory
        self._lanes = lanes
        self._waiting: dict[Any, list[Straight]] = {}
        #: numbers that wait for the present value of a number, in order: code is the same in every process
        self._readers: dict[Any, dict[Any, None]] = {}
        #: values of numbers without an array; zero until they are set
        self._values: dict[Any, Value | None] = {}

    def add(self, operation: Straight) -> None:
        """Keep an operation until its result is needed."""
        target = operation.target.key
        if not isinstance(operation, Scale):
            self._write(operation.source.key)
            self._readers.setdefault(operation.source.key, {})[target] = None
        for reader in self._readers.pop(target, {}):
            self._write(reader)
        if isinstance(operation, Scale) and operation.coefficient is None:
            self._waiting.pop(target, None)
        self._waiting.setdefault(target, []).append(operation)

    def write_all(self) -> None:
        """Write all operations."""
        for target in list(self._waiting):
            self._write(target)

    def _write(self, key: Any) -> None:
        operations = self._waiting.pop(key, None)
        if operations is None:
            return
        target, value = operations[0].target, self._initial(operations[0])
        for operation in operations:
            value = self._after(value, operation)
        if target.array is None:
            self._values[key] = value
        else:
            self._memory._put(0.0 if value is None else value, *target, self._lanes)

    def _initial(self, operation: Straight) -> Value | None:
        is_cleared = isinstance(operation, Scale) and operation.coefficient is None
        return None if is_cleared or isinstance(operation, Show) else self._get(operation.target)

    def _after(self, value: Value | None, operation: Straight) -> Value | None:
        """Return the value of a number after an operation; None is zero."""
        if isinstance(operation, Show):
            return self._get(operation.source)
        if isinstance(operation, Scale):
            factor = operation.coefficient
            return None if value is None or factor is None else self._times(factor, value)
        source = self._get(operation.source)
        if source is None:
            return value
        product = self._times(operation.coefficient, source)
        if value is None:
            return -product if operation.is_negative else product
        return value - product if operation.is_negative else value + product

    def _get(self, number: Entry) -> Value | None:
        if number.array is None:
            return self._values.get(number.key)
        return self._memory._get(*number, self._lanes)

    def _times(self, coefficient: Coefficient, value: Value) -> Value:
        if isinstance(coefficient, Entry):
            coefficient = self._memory._get(*coefficient, 1)
        return value if coefficient == 1.0 else coefficient * value
