"""Motions of robots, or their equilibria in turn, in the memory of the engine."""

from __future__ import annotations

import dataclasses
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.engine.core import ANGLE, CORRECTIONS, ERROR, POSITION, TIME, USABLE, Core
from knode_cosserat.engine.memory import Array
from knode_cosserat.solvers.history import (
    COARSE_ANGLE,
    COARSE_SHARE,
    StateHistory,
    StepCoefficients,
    StepRows,
)
from knode_cosserat.solvers.result import Result


class Shape(NamedTuple):
    """The state from which an equilibrium is solved."""

    y: Float[np.ndarray, "points y"]


States = TypeVar("States", StateHistory, Shape)


class Motions(Generic[States]):
    """States of robots in the layout of the engine, from which steps are solved.

    Vectors of robots take turns in one memory. A single vector stays there between calls, with the factors of
    its last linearisation.
    """

    def __init__(self, core: Core, parameters: np.ndarray, states: States, steps: StepCoefficients):
        """Put robots into memory: parameters (n,) of all, or (robots, n), and states (robots, ...)."""
        self.core, self.steps, self.size, self._kind = core, steps, len(states[0]), type(states)
        self._shapes = [np.shape(values)[1:] for values in states]
        self._memory, self._inside = core._empty_memory(), -1
        options = dataclasses.astuple(steps.settings.newton)
        for array, numbers in ((core.options, options), (core.tip_offset, steps.tip_offset)):
            self._view(self._memory[None], [array])[:] = numbers
        self._parameters = self._in_lanes(np.broadcast_to(parameters, (self.size, core.params.size)))
        #: lengths of the robots (m), and states of their vectors
        self._lengths = np.zeros(self._parameters.shape[:2])
        self.motions = np.empty((len(self._parameters), core._motion.stop - core._motion.start))
        for arrays, values in zip(core._parts.values(), states, strict=True):
            values = np.asarray(values, float)
            values = values.reshape(self.size, len(arrays), -1, core._width(arrays[0]))
            values = self._in_lanes(core._by_strand(arrays[0], values))
            target, count = self._view(self.motions, arrays, core._motion.start), values.shape[-2]
            # the last place is repeated in the lanes beyond it
            target[..., :count, :], target[..., count:, :] = values, values[..., -1:, :]

    def _in_lanes(self, values: np.ndarray) -> np.ndarray:
        """Return values (vectors, lanes, ...) of robots; the last robot is repeated in the last vector."""
        P = self.core.P
        vectors = -(-self.size // P)
        if vectors * P > self.size:
            values = values[np.minimum(np.arange(vectors * P), self.size - 1)]
        return values.reshape(vectors, P, *values.shape[1:])

    def _view(self, memory: np.ndarray, arrays: list[Array], first: int = 0) -> np.ndarray:
        """Return numbers (vectors, lanes, arrays, places, size) of arrays at even distances in memories.

        The memories (vectors, n) begin with the number `first`.
        """
        core, one = self.core, arrays[0]
        places = one.count if core.batch else core.stride * (one.count > 0)
        apart = arrays[1].offset - one.offset if len(arrays) > 1 else 0
        return np.ndarray(
            (len(memory), core.P, len(arrays), max(places, 1), one.size), float, memory,
            8 * (one.offset - first),
            (memory.strides[0], 8, 8 * apart, 8 * one.place, 8 * one.component),
        )  # fmt: skip

    @property
    def states(self) -> States:
        """The states of all robots (robots, ...)."""
        found = []
        for arrays, shape in zip(self.core._parts.values(), self._shapes, strict=True):
            count = int(np.prod(shape)) // (len(arrays) * self.core._width(arrays[0]))
            values = self.core._joined(
                arrays[0], self._view(self.motions, arrays, self.core._motion.start), count
            )
            found.append(values.reshape(-1, *shape)[: self.size])
        return self._kind(*found)

    def solve(
        self, controls: np.ndarray, span: tuple[int, int]
    ) -> tuple[Int[np.ndarray, " robots"], StepRows]:
        """Solve a span of steps of each robot until one fails: the number of steps done, and rows.

        Controls (robots, T, c) or (robots, T, stages * c). In a batch, a robot with a failed step waits for
        the others in its vector; its last state is not kept, except if the first step failed.
        """
        core, P, stages, (start, stop) = self.core, self.core.P, np.size(self.steps.ends), span
        e, count, vectors = core.equations, stop - start, len(self.motions)
        own = self._in_lanes(controls[:, start:stop]).reshape(vectors, P, count, -1, e.nc)
        acting = np.empty((vectors, count, stages, e.nc, P))
        acting[:] = np.moveaxis(own, 1, -1)
        table = coefficients_of(self.steps, span)
        shapes = (
            (count, stages, len(core.grid.nodes), core.strands * e.numbers, P),
            (count, stages, 8 + e.k, P),
        )
        ends = np.cumsum([np.prod(shape) for shape in shapes])
        results = np.zeros((vectors, ends[-1] + P))
        for k in range(vectors):
            self._solve(k, acting[k], table, results[k], ends)
        rows, infos = (
            np.moveaxis(part.reshape(vectors, *shape), -1, 1).reshape(-1, *shape[:-1])[: self.size]
            for part, shape in zip(np.split(results, ends, axis=1), shapes, strict=False)
        )
        done = results[:, ends[-1] :].reshape(-1)[: self.size].astype(int)
        return start + done, self._rows(rows, infos, done)

    def _solve(
        self, k: int, acting: np.ndarray, table: np.ndarray, results: np.ndarray, ends: np.ndarray
    ) -> None:
        """Solve steps of a vector of robots."""
        core, memory, motion = self.core, self._memory, self.core._motion
        if self._inside != k:
            self._inside = k
            memory[motion] = self.motions[k]
            self._view(memory[None], [core.params])[0, :, 0, 0] = self._parameters[k]
            self._view(memory[None], [core.numbers])[..., USABLE] = 0.0
            core._functions["start"](memory.ctypes.data)
            self._lengths[k] = self._view(memory[None], [core.length])[0, :, 0, 0, 0]
        first = results.ctypes.data
        core._functions["run"](
            memory.ctypes.data, acting.ctypes.data, table.ctypes.data, core._guesses.ctypes.data, first,
            first + 8 * int(ends[0]), first + 8 * int(ends[1]), len(acting), acting.shape[1], 1,
        )  # fmt: skip
        done = results[ends[1] :]
        if np.all(done == len(acting)):
            if len(self.motions) == 1:
                # views of the states before remain as they are
                self.motions = memory[None, motion].copy()
            else:
                self.motions[k] = memory[motion]
            return
        self._inside = -1
        if core.batch:
            before, after = (each.reshape(-1, core.P) for each in (self.motions[k], memory[motion]))
            before[:, done > 0] = after[:, done > 0]
        elif done > 0:
            # again, for the state before the step that failed
            self._solve(k, acting[: int(done[0])], table, np.zeros_like(results), ends)

    def _rows(self, rows: np.ndarray, infos: np.ndarray, done: np.ndarray) -> StepRows:
        """Return rows (robots, steps, ...); a step's row is that of its last stage."""
        core = self.core
        if core.strands > 1:
            rows = core.equations.joined(rows.reshape(*rows.shape[:-1], core.strands, -1))
        numbers, unknowns = infos[..., :8], infos[..., 8:]
        error = np.max(numbers[..., ERROR], axis=-1)
        off, angle = numbers[..., -1, POSITION], numbers[..., -1, ANGLE]
        lengths = self._lengths.reshape(-1)[: self.size]
        fine = (off <= COARSE_SHARE * lengths[:, None]) & (angle <= COARSE_ANGLE)
        result = np.where(fine, int(Result.CONVERGED), int(Result.COARSE))
        result = np.where(error <= self.steps.settings.newton.acceptable, result, int(Result.NO_CONVERGENCE))
        result[np.arange(result.shape[1]) > done[:, None]] = int(Result.NOT_REACHED)
        time_error = numbers[..., -1, TIME] if numbers.shape[2] > 1 else np.full(off.shape, np.nan)
        corrections = np.sum(numbers[..., CORRECTIONS], axis=-1).astype(int)
        return StepRows(
            rows[:, :, -1], unknowns[:, :, -1], error, corrections, off, result, time_error,
            rows[:, :, :-1], unknowns[:, :, :-1],
        )  # fmt: skip


def coefficients_of(steps: StepCoefficients, span: tuple[int, int]) -> Float[np.ndarray, "T stages n"]:
    """Return coefficients and the time since row 0 (s) of all stages of a span of steps."""
    (start, stop), stages = span, np.size(steps.ends)
    coefficients = np.asarray(steps.table)
    coefficients = coefficients.reshape(len(coefficients), stages, -1)
    table = np.empty((stop - start, stages, coefficients.shape[-1] + 1))
    table[..., :-1] = coefficients[np.minimum(np.arange(start, stop), len(coefficients) - 1)]
    table[..., -1] = (np.arange(start, stop)[:, None] + np.asarray(steps.ends)) * steps.dt
    return table
