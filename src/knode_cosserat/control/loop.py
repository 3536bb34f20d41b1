"""Closed loops: a controller, a plant and a reference, period after period."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import time as clock
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat._files import replacing
from knode_cosserat.control.commands import Command, Controller
from knode_cosserat.control.plants import Plant
from knode_cosserat.control.references import Reference


@dataclasses.dataclass(frozen=True)
class LoopLog:
    """Log of a closed loop, one row a period.

    Row k holds the measurement at time k, and the control from time k to k + 1.

    Attributes:
        time: (T,) s.
        reference: (T, p), wanted at each time.
        measured: (T, m).
        tip: (T, 3) true or measured positions of the tip (m).
        control: (T, c).
        status: origin of each control.
        reason: reason of each fallback, else empty.
        violation: (T,) predicted violation of soft limits.
        feedback: (T,) time from measurement to command (s).
        preparation: (T,) time of the rest of the controller's work (s).
        parameters: adapted parameters by name, each (T,).
        missed: number of periods whose deadline was missed.
        compiled: number of programs that were compiled during the loop; each may have delayed a period.
    """

    time: Float[np.ndarray, " T"]
    reference: Float[np.ndarray, "T p"]
    measured: Float[np.ndarray, "T m"]
    tip: Float[np.ndarray, "T 3"]
    control: Float[np.ndarray, "T c"]
    status: tuple[str, ...]
    reason: tuple[str, ...]
    violation: Float[np.ndarray, " T"]
    feedback: Float[np.ndarray, " T"]
    preparation: Float[np.ndarray, " T"]
    parameters: dict[str, Float[np.ndarray, " T"]]
    missed: int
    compiled: int = 0

    @property
    def tip_distance(self) -> Float[np.ndarray, " T"]:
        """Distance (m) of the tip from a reference of positions; free coordinates (NaN) do not count."""
        apart = self.tip - self.reference[:, :3]
        return np.sqrt(np.nansum(apart**2, axis=1))

    def tip_rmse(self, after: float = 0.0) -> float:
        """Return the root mean square of `tip_distance` (m) from a time (s) on."""
        return float(np.sqrt(np.mean(self.tip_distance[self.time >= after] ** 2)))

    @property
    def fallbacks(self) -> int:
        """Number of periods with a command that is not the controller's solution."""
        return sum(status != "optimal" for status in self.status)

    def summary(self) -> dict[str, Any]:
        """Return the figures of a loop as plain numbers; errors are those of its second half."""
        half = 0.5 * float(self.time[-1])
        return {
            "periods": len(self.time),
            "tip_rmse": self.tip_rmse(half),
            "fallbacks": self.fallbacks,
            "missed": self.missed,
            "compiled": self.compiled,
            "violation": float(np.max(self.violation, initial=0.0)),
            "feedback_ms": 1e3 * float(np.median(self.feedback)),
            "feedback_p99_ms": 1e3 * float(np.percentile(self.feedback, 99)),
            "preparation_ms": 1e3 * float(np.median(self.preparation)),
            "cycle_p99_ms": 1e3 * float(np.percentile(self.feedback + self.preparation, 99)),
            "parameters": {name: float(values[-1]) for name, values in self.parameters.items()},
        }

    def to_csv(self, path: str | Path) -> None:
        """Write one row a period: time, reference, tip, controls, status and times of the computation."""
        import pandas as pd  # type: ignore[import-untyped]

        columns: dict[str, Any] = {"t (s)": self.time}
        columns |= {f"reference {k}": column for k, column in enumerate(self.reference.T)}
        columns |= {f"tip {axis} (m)": column for axis, column in zip("xyz", self.tip.T, strict=True)}
        columns |= {f"control {k + 1}": column for k, column in enumerate(self.control.T)}
        columns |= self.parameters
        columns |= {
            "status": self.status, "feedback (s)": self.feedback, "preparation (s)": self.preparation,
        }  # fmt: skip
        with replacing(Path(path)) as part:
            pd.DataFrame(columns).to_csv(part, index=False)

    def __repr__(self) -> str:
        return (
            f"LoopLog: {len(self.time)} periods, tip RMSE {1e3 * self.tip_rmse():.2f} mm, "
            f"{self.fallbacks} fallbacks, {self.missed} missed deadlines, feedback "
            f"{1e3 * float(np.median(self.feedback)):.2f} ms (median)"
        )


class _Compilations:
    """Counts the programs that JAX compiles or loads in this process."""

    def __init__(self) -> None:
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, duration_secs: float, **_: Any) -> None:
        self.count += event == COMPILED


#: JAX's event of a compilation, also of one that is read from the cache on disk
COMPILED = "/jax/core/compile/backend_compile_duration"
_COMPILATIONS = _Compilations()


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Suspend Python's garbage collector, which interrupts a period for some milliseconds."""
    gc.collect()
    gc.freeze()
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
        gc.unfreeze()


def run_loop(
    controller: Controller, plant: Plant, reference: Reference, seconds: float, *, paced: bool = False
) -> LoopLog:
    """Close the loop for some seconds, and return its log.

    Everything is compiled before the first period, by a copy of the controller. The controller computes the
    next period's prediction after it has sent its command.

    Args:
        controller: the controller.
        plant: the robot.
        reference: the wanted output.
        seconds: duration (s).
        paced: keep real time: each period begins dt after the one before, or late if the work took longer.
            A period that begins late counts as missed.

    Raises:
        ValueError: plant and controller have different periods, or a duration below one period.
    """
    if not np.isclose(controller.dt, plant.dt):
        raise ValueError(f"the controller's period is {controller.dt:g} s and the plant's {plant.dt:g} s")
    steps = round(seconds / controller.dt)
    if steps < 1:
        raise ValueError(f"seconds is {seconds:g}; allowed is at least one period, {controller.dt:g} s")
    warm_up(controller, plant, reference)
    controller.reset(plant.start())
    controller.prepare(0.0, reference)
    rows: list[tuple[Any, ...]] = []
    parameters: list[dict[str, float]] = []
    missed, before = 0, _COMPILATIONS.count
    with _no_garbage_collection():
        due = clock.perf_counter()
        for k in range(steps):
            time = k * controller.dt
            if paced:
                missed += k > 0 and clock.perf_counter() > due
                while (rest := due - clock.perf_counter()) > 0.0:
                    clock.sleep(max(0.0, rest - 5e-4))
                due = max(due, clock.perf_counter() - controller.dt) + controller.dt
            measured, tip = plant.measure(), plant.tip()
            began = clock.perf_counter()
            command: Command = controller.command(time, measured, reference)
            sent = clock.perf_counter()
            plant.apply(command.control)
            moved = clock.perf_counter()
            controller.advance(command.control)
            controller.prepare(time + controller.dt, reference)
            done = clock.perf_counter()
            parameters.append(_parameters_of(controller))
            rows.append((time, measured, tip, command, sent - began, done - moved))
    return _log_of(rows, parameters, reference, missed, _COMPILATIONS.count - before)


def _log_of(
    rows: list[tuple[Any, ...]], parameters: list[dict[str, float]], reference: Reference, missed: int,
    compiled: int,
) -> LoopLog:  # fmt: skip
    times, measurements, tips, commands, feedback, preparation = zip(*rows, strict=True)
    return LoopLog(
        time=np.array(times),
        reference=reference.at(times),
        measured=np.array(measurements),
        tip=np.array(tips),
        control=np.array([each.control for each in commands]),
        status=tuple(each.status.value for each in commands),
        reason=tuple(each.reason for each in commands),
        violation=np.array([each.violation for each in commands]),
        feedback=np.array(feedback),
        preparation=np.array(preparation),
        parameters={name: np.array([row[name] for row in parameters]) for name in parameters[0]},
        missed=missed,
        compiled=compiled,
    )


def warm_up(controller: Controller, plant: Plant, reference: Reference, periods: int = 2) -> None:
    """Compile all programs of a loop by some periods with a copy of the controller; the plant moves."""
    controller = controller.copied()
    controller.reset(plant.start())
    controller.prepare(0.0, reference)
    for k in range(periods):
        command = controller.command(k * controller.dt, plant.measure(), reference)
        plant.apply(command.control)
        controller.advance(command.control)
        controller.prepare((k + 1) * controller.dt, reference)


def _parameters_of(controller: Controller) -> dict[str, float]:
    observer = getattr(controller, "observer", None)
    return {} if observer is None else dict(observer.estimate.parameters)
