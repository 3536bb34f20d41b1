"""Result of a simulation: states over time, with the result of each step."""

from __future__ import annotations

import contextlib
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat._registry import provided
from knode_cosserat._reprs import count_of, quantity
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.solvers.history import SolverState
from knode_cosserat.solvers.result import Result, ResultCodes
from knode_cosserat.solvers.settings import Settings


class Trajectory(eqx.Module):
    """A system's states at T times and N nodes; every array may have a leading batch axis.

    Row 0 is the initial state. Controls have one convention in this package: `held_control` and
    `held_tension` of row k act from row k to row k + 1, here, in `Measurements` and in files. `control` is
    the control in each row's own equations, which acted up to that row. Rows that were not solved are NaN;
    `result` says why. A pytree: it can be returned from a jitted function.
    """

    system: System
    #: numerical settings, or None for measured states
    settings: Settings | None = eqx.field(static=True)
    time: Float[Any, " T"]
    y: Float[Any, "*batch T N y"]
    z: Float[Any, "*batch T N z"]
    #: control in the row's equations: row i's acted from row i - 1 to i, row 0's before; see `held_control`
    control: Float[Any, "*batch T c"]
    #: a `Result` for each row
    result: Int[Any, "*batch T"] = eqx.field(converter=ResultCodes.of)
    #: largest residual in natural units
    residual: Float[Any, "*batch T"]
    iterations: Int[Any, "*batch T"]
    #: estimated discretisation error of positions along the rod (m), the largest over the nodes; NaN: unknown
    position_error: Any = None
    #: estimated error of positions (m) by the time steps, the largest over the nodes; NaN or None: unknown
    time_error: Any = None
    #: state of the solver in row 0 of a motion; None for equilibria, and where it is unknown
    initial_state: SolverState | None = None
    #: state of the solver in the last row, from which a motion continues exactly; None as for `initial_state`
    final_state: SolverState | None = None
    #: True in rows outside the training range of a learned or identified model; None if unknown
    extrapolated: Any = None
    #: states y, z (and y_s, where rows have it) at the stages of the time scheme before each row, which its
    #: history needs: (*batch, T, stages - 1, N, x); None for schemes of one stage, and where they are unknown
    stages: Any = None
    #: True if intermediate rows were left out: the controls held there are not known
    thinned: bool = eqx.field(static=True, default=False)

    # named parts

    @property
    def state(self) -> Any:
        """The packed states y (…, T, N, y)."""
        return self.y

    @property
    def position(self) -> Any:
        """Positions (…, T, N, 3) in m, global frame."""
        return self.system.drawing.positions(self.y)

    @property
    def quaternion(self) -> Any:
        """Orientations (…, T, N, 4), scalar first."""
        return self.system.drawing.quaternions(self.y)

    @property
    def tip_position(self) -> Any:
        """Positions of the last node (…, T, 3) in m."""
        return self.position[..., -1, :]

    @property
    def held_control(self) -> Any:
        """Controls (…, T, c), row k's held from row k to row k + 1, as for `simulate`.

        The last row is NaN: the control after it is not known. Raises `ValueError` if intermediate rows were
        left out.
        """
        if self.thinned:
            raise ValueError(
                "rows between were left out, and controls may have changed there; take held_control of the "
                "whole trajectory"
            )
        numeric: Any = jnp if is_traced(self.control) else np
        after = self.control[..., 1:, :]
        return numeric.concatenate([after, numeric.full_like(self.control[..., :1, :], numeric.nan)], axis=-2)

    @property
    def held_tension(self) -> Any:
        """Tensions (…, T, tendons) in N, row k's held from row k to row k + 1; NaN in the last row."""
        layout = self.system.control_layout
        if "tension" not in layout.names:
            raise KeyError(
                f"no field 'tension' among the controls; there are {', '.join(layout.names) or 'none'}; "
                "tensions that are states are part('tension')"
            )
        return layout.get(self.held_control, "tension")

    @property
    def tension(self) -> Any:
        """Not an attribute: a row has a tension that acted before it, and one that acts after it."""
        raise AttributeError(
            "a trajectory has no `tension`: held_tension[k] acts from row k to row k + 1, as in Measurements "
            "and CSV files; part('tension')[k] is in row k's equations, and acted until row k"
        )

    @property
    def arclength(self) -> Any:
        """Arclength s of the nodes (N,) in m, or (B, N) in a batch of robots."""
        return np.linspace(0.0, 1.0, self.y.shape[-2]) * np.asarray(self.system.length)[..., None]

    @property
    def dt(self) -> float:
        """Time step (s); NaN for a single row."""
        if len(self.time) < 2:
            return float("nan")
        return float(self.time[1] - self.time[0])

    def part(self, name: str) -> Any:
        """Return a field of y, z or the controls by name: `n`, `m`, `v`, `u`, `tension` … (…, T, N, size).

        For a robot of several rods, such as the legs of a platform, `n2` is the second rod's field and `n`
        stacks all of them, (…, T, N, rods, size).
        """
        count, known = self.system.strands, []
        for layout, packed in self._layouts():
            if name in layout.names:
                return layout.get(packed, name)
            known += layout.names
            rods = tuple(f"{name}{k + 1}" for k in range(count))
            # as many numbered fields as there are rods: one field of each rod
            if set(rods) <= set(layout.names) and f"{name}{count + 1}" not in layout.names:
                every = packed[..., layout.indices(rods)]
                return every.reshape(*every.shape[:-1], count, -1)
        raise KeyError(f"no field {name!r}; there are {', '.join(known)}")

    def _layouts(self) -> tuple[tuple[Any, Any], ...]:
        system = self.system
        return (system.y_layout, self.y), (system.z_layout, self.z), (system.control_layout, self.control)

    @property
    def force(self) -> Any:
        """Internal force n (…, T, N, 3) in N, global frame; with several rods (…, T, N, rods, 3)."""
        return self.part("n")

    @property
    def moment(self) -> Any:
        """Internal moment m (…, T, N, 3) in N·m, global frame; with several rods (…, T, N, rods, 3)."""
        return self.part("m")

    @property
    def velocity(self) -> Any:
        """Velocity q (…, T, N, 3) in m/s, material frame; with several rods (…, T, N, rods, 3)."""
        return self.part("q")

    @property
    def angular_velocity(self) -> Any:
        """Angular velocity ω (…, T, N, 3) in rad/s, material frame; with several rods (…, T, N, rods, 3)."""
        return self.part("w")

    @property
    def strain(self) -> Any:
        """Strains z (…, T, N, z): for a rod v (no unit), then u (1/m), material frame."""
        return self.z

    # validity

    @property
    def valid(self) -> Any:
        """True in rows that were solved (…, T)."""
        return self.result >= 0

    @property
    def extrapolation(self) -> str:
        """Message on the rows in which the model extrapolates; empty if there are none, or no known range."""
        if self.extrapolated is None or not np.any(self.extrapolated):
            return ""
        rows = np.asarray(self.extrapolated)
        first = float(np.asarray(self.time)[int(np.argmax(rows.reshape(-1, rows.shape[-1]).any(axis=0)))])
        return (
            f"{np.count_nonzero(rows)} of {rows.size} rows are outside the range that the model was trained "
            f"in (controls, strains or strain rates), first at {first:g} s"
        )

    def __str__(self) -> str:
        """Return rows, times, results, tip, estimated error and extrapolation, in a few lines."""
        if is_traced(self) or not isinstance(self.result, np.ndarray | jax.Array):
            return f"Trajectory of a {type(self.system).__name__} (traced)"
        codes, counts = np.unique(np.asarray(self.result), return_counts=True)
        results = ", ".join(f"{n} {Result(int(code)).name}" for code, n in zip(codes, counts, strict=True))
        batch = f"{len(self.y)} robots, " if np.ndim(self.y) == 4 else ""
        rows = count_of(len(self.time), "row")
        if len(self.time) == 1:
            rows += f" at {float(self.time[0]):g} s"
        elif len(self.time):
            rows += f" from {float(self.time[0]):g} to {float(self.time[-1]):g} s"
        lines = [f"Trajectory of a {type(self.system).__name__}: {batch}{rows}: {results}"]
        lines += self._tip_text()
        errors = [
            f"{where} {1e3 * np.nanmax(error):.2g} mm"
            for where, error in (("along the rod", self.position_error), ("in time", self.time_error))
            if error is not None and np.any(np.isfinite(error))
        ]
        if errors and self.position_error is not None:
            lost = int(np.sum(np.isnan(self.position_error) & (np.asarray(self.result) >= 0)))
            lines.append(
                f"largest position error, by estimate: {', '.join(errors)}"
                + (f"; no estimate along the rod in {count_of(lost, 'row')}" if lost else "")
            )
        if self.extrapolation:
            lines.append(f"EXTRAPOLATION: {self.extrapolation}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return str(self)

    def _tip_text(self) -> list[str]:
        """Return a line on the tip of one robot in the last solved row, if it has positions."""
        solved = np.flatnonzero(self.valid)
        if np.ndim(self.y) != 3 or not len(solved):
            return []
        # a user's own system may have no positions, or fail: a text must not
        with contextlib.suppress(Exception):
            tip = np.asarray(self.system.drawing.positions(np.asarray(self.y)[solved[-1], -1]))
            return [f"tip at {float(self.time[solved[-1]]):g} s: {quantity(tip, 'm')}"]
        return []

    @property
    def all_valid(self) -> bool:
        """True if every row was solved."""
        return bool(np.all(self.valid))

    def require_valid(self) -> None:
        """Raise `ValueError`, naming the first row that was not solved, if there is one."""
        if not self.all_valid:
            first = np.argwhere(~np.asarray(self.valid))[0]
            result = Result(int(np.asarray(self.result)[tuple(first)]))
            where = f"row {first[-1]}" + (f" of robot {first[0]}" if len(first) == 2 else "")
            raise ValueError(f"the trajectory is not valid at {where}: {result.message}")

    def __getitem__(self, index: Any) -> Self:
        """Return rows (a slice) of a trajectory, or one robot (an integer) or several (slice) of a batch."""
        if self.y.ndim == 3 and not isinstance(index, slice):
            raise TypeError(f"index a trajectory's rows by a slice, not by {index!r}")
        if self.y.ndim == 4 and not isinstance(index, slice | int | np.integer):
            raise TypeError(f"index a batch by a slice or a robot's number, not by {index!r}")
        fields: tuple[str, ...] = ("y", "z", "control", "result", "residual", "iterations")
        fields += tuple(
            name
            for name in ("position_error", "time_error", "extrapolated", "stages")
            if getattr(self, name) is not None
        )
        picked: dict[str, Any] = {name: getattr(self, name)[index] for name in fields}
        time = self.time if self.y.ndim == 4 else self.time[index]
        system = self.system
        if np.ndim(system.length):
            system = _picked(system, index)
        initial, final, thinned = self.initial_state, self.final_state, self.thinned
        if self.y.ndim == 4:
            initial, final = _picked((initial, final), index)
        else:
            rows = range(len(self.time))[index]
            thinned = thinned or rows.step != 1
            # a state belongs to its row; rows after the first are replayed at the original step only
            first, last = (bool(rows) and rows[k] == range(len(self.time))[k] for k in (0, -1))
            final = final if last else initial if first and len(rows) == 1 else None
            initial = initial if first and not thinned else None
        return type(self)(
            system, self.settings, time, **picked, initial_state=initial, final_state=final, thinned=thinned
        )

    def save(self, path: Any) -> None:
        """Write a labelled netCDF file (see `trajectory_file.save`)."""
        provided(type(self), "save")(self, path)


def _picked(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)
