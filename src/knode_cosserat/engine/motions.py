"""Motions of robots, or their equilibria in turn, in the memory of the engine."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.engine.core import ANGLE, CORRECTIONS, ERROR, POSITION, TIME, Core
from knode_cosserat.engine.memory import Array
from knode_cosserat.schemes.history import COARSE_ANGLE, COARSE_SHARE, StepCoefficients, StepRows
from knode_cosserat.schemes.result import Result

#: largest number of results that are copied to rows at once
BLOCK = 1 << 17
CONVERGED, COARSE, NOT_SOLVED = int(Result.CONVERGED), int(Result.COARSE), int(Result.NO_CONVERGENCE)


class StaticState(NamedTuple):
    """The state from which an equilibrium is solved."""

    y: Float[np.ndarray, "points y"]


class Motions:
    """States of robots in the layout of the engine, from which steps are solved.

    Vectors of robots take turns in one memory.
    """

    #: true if the factors in memory are those of the last step of one robot, for the next step
    _continues = False

    def __init__(self, core: Core, parameters: np.ndarray, states: Any, steps: StepCoefficients):
        """Put robots into memory: parameters (n,) of all, or (robots, n), and states (robots, ...)."""
        self.core, self.steps, self.size, self._kind = core, steps, len(states[0]), type(states)
        #: size of a state, and the arrays of its parts in it
        self._packed_size, self._arrays = core.states[self._kind is StaticState]
        self._shapes = [np.shape(values)[1:] for values in states]
        self._memory = core._empty_memory()
        options = dataclasses.astuple(steps.settings.newton)
        for array, numbers in ((core.options, options), (core.tip_offset, steps.tip_offset)):
            self._view(self._memory[None], [array])[:] = numbers
        self.set_parameters(parameters)
        #: states of the vectors of robots
        self.motions = np.empty((len(self._parameters), self._packed_size))
        self.put(states, np.arange(len(self.motions) * core.P))

    @property
    def _estimates(self) -> int:
        """Number of estimated errors; an equilibrium has none in time."""
        estimates = self.steps.settings.estimates
        return min(estimates, 1) if self._kind is StaticState else estimates

    def set_parameters(self, values: np.ndarray) -> None:
        """Set the parameters (n,) of all robots, or (robots, n)."""
        own = self._in_lanes(np.broadcast_to(values, (self.size, self.core.params.size)))
        self._parameters = np.ascontiguousarray(np.swapaxes(own, 1, 2))

    def put(self, states: Any, places: np.ndarray) -> None:
        """Write the states (n, ...) of robots at places (n,); the last one is that of all places beyond."""
        core, self._continues = self.core, False
        vectors, lanes = np.divmod(places, core.P)
        for arrays, values in zip(self._arrays, states, strict=True):
            values = np.asarray(values, float)
            values = values.reshape(len(values), len(arrays), -1, core._width(arrays[0]))
            values = core._by_strand(arrays[0], values)[np.minimum(np.arange(len(places)), len(values) - 1)]
            target, count = self._view(self.motions, arrays), values.shape[-2]
            # the last place is repeated in the lanes beyond it
            for where, own in ((slice(count), values), (slice(count, None), values[..., -1:, :])):
                target[vectors, lanes, :, where] = own

    def restore(self, motions: np.ndarray) -> None:
        """Return to earlier states: a copy of `motions`."""
        self.motions, self._continues = motions, False

    def set_times(self, t0: Float[np.ndarray, " robots"]) -> None:
        """Set the times (s) of row 0."""
        # the parts are those of a `StateHistory`
        self._view(self.motions, self._arrays[4])[:, :, 0, 0, 0] = self._in_lanes(t0)

    def _in_lanes(self, values: np.ndarray) -> np.ndarray:
        """Return values (vectors, lanes, ...) of robots; the last robot is repeated in the last vector."""
        P = self.core.P
        vectors = -(-self.size // P)
        if vectors * P > self.size:
            values = values[np.minimum(np.arange(vectors * P), self.size - 1)]
        return values.reshape(vectors, P, *values.shape[1:])

    def _view(self, memory: np.ndarray, arrays: list[Array]) -> np.ndarray:
        """Return numbers (vectors, lanes, arrays, places, size) of arrays at even distances in memories."""
        shape, at, strides = self._place_of(arrays)
        return np.ndarray((len(memory), *shape), float, memory, at, (memory.strides[0], *strides))

    def _place_of(self, arrays: list[Array]) -> tuple[tuple[int, ...], int, tuple[int, ...]]:
        """Return the shape (lanes, arrays, places, size) of arrays, their first byte, and their strides."""
        core, one = self.core, arrays[0]
        places = one.count if core.batch else one.component * (one.count > 0)
        apart = arrays[1].offset - one.offset if len(arrays) > 1 else 0
        shape = core.P, len(arrays), max(places, 1), one.size
        return shape, 8 * one.offset, (8, 8 * apart, 8 * one.place, 8 * one.component)

    @functools.cached_property
    def _places(self) -> list[tuple[tuple[int, ...], int, tuple[int, ...]]]:
        """Shape, first place and strides of each part of the state of one robot of one strand."""
        found = []
        for arrays, shape in zip(self._arrays, self._shapes, strict=True):
            _, at, strides = self._place_of(arrays)
            found.append((shape, at, strides[len(strides) - len(shape) :]))
        return found

    def state_of(self, motions: np.ndarray) -> Any:
        """Return the state of one robot: views of its numbers, for a system of one strand."""
        if self.core.strands > 1:
            return self._kind(*(values[0] for values in self._states(motions)))
        return self._kind(
            *(np.ndarray(shape, float, motions, at, strides) for shape, at, strides in self._places)
        )

    @property
    def states(self) -> Any:
        """The states of all robots (robots, ...)."""
        motions = self.motions.copy()
        if self.core.batch:
            return self._states(motions)
        return self._kind(*(values[None] for values in self.state_of(motions)))

    def _states(self, motions: np.ndarray) -> Any:
        found = []
        for arrays, shape in zip(self._arrays, self._shapes, strict=True):
            count = math.prod(shape) // (len(arrays) * self.core._width(arrays[0]))
            view = self._view(motions, arrays)
            values = self.core._join(arrays[0], view, count)
            found.append(values.reshape(-1, *shape)[: self.size])
        return self._kind(*found)

    def solve(
        self, controls: np.ndarray, span: tuple[int, int], rows: StepRows | None = None
    ) -> tuple[Int[np.ndarray, " robots"], StepRows]:
        """Solve a span of steps of each robot until one fails: the number of steps done, and rows.

        Controls (robots, T, c) or (robots, T, stages * c). In a batch, a robot with a failed step waits for
        the others in its vector; its last state is not kept, except if the first step failed. Rows are
        written to `rows` if they are given.
        """
        core, P, stages, (start, stop) = self.core, self.core.P, np.size(self.steps.ends), span
        e, count, vectors = core.equations, int(stop - start), len(self.motions)
        held = 1 if controls.shape[2] == e.nc else stages
        acting = np.empty((vectors, count, stages, e.nc, P))
        acting[:] = np.moveaxis(
            self._in_lanes(controls[:, start:stop]).reshape(vectors, P, count, held, e.nc), 1, -1
        )
        table, shapes = coefficients_of(self.steps, span), self._shapes_of(count, stages)
        size, done = sum(map(math.prod, shapes)), np.zeros(self.size, dtype=int)
        # results of some vectors at a time, which are copied while they are in the cache
        block = min(vectors, max(1, BLOCK // size))
        results = np.zeros((block, size))
        for first in range(0, vectors, block):
            part, robots = results[: vectors - first], slice(first * P, (first + block) * P)
            part[:] = 0.0
            self._run(first, acting, table, part)
            found, done[robots] = self._rows(part, shapes, min(len(part) * P, self.size - first * P))
            if rows is None and vectors <= block:
                return start + done, found
            if rows is None:
                rows = StepRows(*(np.empty((self.size, *leaf.shape[1:]), leaf.dtype) for leaf in found))
            for every, leaf in zip(rows, found, strict=True):
                every[robots] = leaf
        assert rows is not None
        return start + done, rows

    def _shapes_of(self, count: int, stages: int) -> tuple[tuple[int, ...], ...]:
        """Return the shapes of a vector's results: rows, numbers of stages, steps done and length."""
        core, e = self.core, self.core.equations
        numbers = core.strands * e.numbers
        shapes = (count, stages, core.counts["nodes"], numbers), (count, stages, 8 + e.k), (2,)
        return tuple((*shape, core.P) for shape in shapes)

    def _run(self, first: int, acting: np.ndarray, table: np.ndarray, results: np.ndarray) -> None:
        """Solve steps of vectors of robots from the first one on."""
        core, (_, count, stages, *_) = self.core, acting.shape
        own = (each[first:] for each in (self.motions, self._parameters, acting))
        arrays = self._memory, *own, table, core._guesses, results
        counts = self._packed_size, len(results), count, stages, self._estimates
        core._functions.run("run", *arrays, *counts, int(self._continues))
        done = count if core.batch else int(results[0, -2])
        self._continues = done == count and not core.batch
        if 0 < done < count:
            # again, for the state before the step that failed
            again = np.zeros((1, sum(map(math.prod, self._shapes_of(done, stages)))))
            self._run(0, np.ascontiguousarray(acting[:, :done]), table, again)

    # one step of one robot

    @functools.cached_property
    def _step(self) -> tuple[Any, ...]:
        """Controls, coefficients of all steps and of one, and the times of its stages in steps.

        Then addresses of what steps have in common, shapes and size of results.
        """
        ends = np.reshape(self.steps.ends, -1)
        stages = len(ends)
        every = coefficients_of(self.steps, (0, len(self.steps.table)))
        acting, table = np.empty((stages, self.core.equations.nc)), every[0].copy()
        arrays, shapes = (self._parameters, acting, table, self.core._guesses), self._shapes_of(1, stages)
        addresses = [each.ctypes.data for each in arrays]
        return acting, every, table, ends, addresses, shapes, sum(map(math.prod, shapes))

    def step(
        self, before: np.ndarray, i: int, control: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None, int]:
        """Solve step i of one robot from a state (`motions`), under a control (c,) or (stages * c,).

        Return the state after it, its numbers for `row_of`, and its result; no numbers if it failed.
        """
        acting, every, table, ends, addresses, shapes, size = self._step
        acting[:] = control.reshape(1 if len(control) == acting.shape[1] else len(acting), acting.shape[1])
        table[:] = every[min(i, len(every) - 1)]
        table[:, -1] = (i + ends) * self.steps.dt
        after, results = before.copy(), np.zeros(size)
        self._continues = False
        self.core._functions["run"](
            self._memory.ctypes.data,
            after.ctypes.data,
            *addresses,
            results.ctypes.data,
            self._packed_size,
            1,
            1,
            len(acting),
            self._estimates,
            0,
        )
        if not results[-2]:
            return before, None, NOT_SOLVED
        last = size - 2 - shapes[1][2]
        off, angle, length = (results.item(k) for k in (last + POSITION, last + ANGLE, size - 1))
        fine = self._is_fine(off, angle, length)
        return after, results, CONVERGED if fine else COARSE

    def row_of(self, results: np.ndarray) -> StepRows:
        """Return the row of a step from its numbers."""
        rows, _ = self._rows(results[None], self._shapes_of(1, np.size(self.steps.ends)), 1)
        return StepRows(*(leaf[0, 0] for leaf in rows))

    def _rows(self, results: np.ndarray, shapes: Any, robots: int) -> tuple[StepRows, np.ndarray]:
        """Return rows (robots, steps, ...) and steps done of vectors of results.

        A step's row is that of its last stage.
        """
        core = self.core
        parts = np.split(results, np.cumsum([math.prod(shape) for shape in shapes[:-1]]), axis=1)
        rows, infos, ends = (
            np.moveaxis(part.reshape(len(results), *shape), -1, 1).reshape(-1, *shape[:-1])[:robots]
            for part, shape in zip(parts, shapes, strict=True)
        )
        done = ends[:, 0].astype(int)
        if core.strands > 1:
            rows = core.equations.join(rows.reshape(*rows.shape[:-1], core.strands, -1))
        numbers, unknowns = infos[..., :8], infos[..., 8:]
        error = np.max(numbers[..., ERROR], axis=-1)
        off, angle = numbers[..., -1, POSITION], numbers[..., -1, ANGLE]
        result = np.where(self._is_fine(off, angle, ends[:, 1:]), CONVERGED, COARSE)
        result = np.where(error <= self.steps.settings.newton.acceptable, result, NOT_SOLVED)
        result[np.arange(result.shape[1]) > done[:, None]] = int(Result.NOT_REACHED)
        is_whole = core.time_defect and numbers.shape[2] == core.settings.stages
        time_error = numbers[..., -1, TIME] if is_whole else np.full(off.shape, np.nan)
        corrections = np.sum(numbers[..., CORRECTIONS], axis=-1).astype(int)
        found = StepRows(
            rows[:, :, -1],
            unknowns[:, :, -1],
            error,
            corrections,
            off,
            result,
            time_error,
            rows[:, :, :-1],
            unknowns[:, :, :-1],
        )
        return found, done

    def _is_fine(self, off: Any, angle: Any, length: Any) -> Any:
        """True where no estimated error of positions (m) or orientations (rad) makes a row coarse."""
        return (off <= COARSE_SHARE * length) & (angle <= COARSE_ANGLE) | (not self.steps.settings.errors)


def coefficients_of(steps: StepCoefficients, span: tuple[int, int]) -> Float[np.ndarray, "T stages n"]:
    """Return coefficients and the time since row 0 (s) of all stages of a span of steps."""
    (start, stop), stages = span, np.size(steps.ends)
    coefficients = np.asarray(steps.table)
    coefficients = coefficients.reshape(len(coefficients), stages, -1)
    table = np.empty((stop - start, stages, coefficients.shape[-1] + 1))
    table[..., :-1] = coefficients[np.minimum(np.arange(start, stop), len(coefficients) - 1)]
    table[..., -1] = (np.arange(start, stop)[:, None] + np.asarray(steps.ends)) * steps.dt
    return table
