"""What a simulation gives: states over time, with what came of each step."""

from __future__ import annotations

from typing import Any, Self

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.result import Result


class Trajectory(eqx.Module):
    """A system's states at T times and N nodes; every array may have a batch axis in front.

    Row 0 is the initial state; row i is the state after control i, which acted from row i - 1 on. Rows that
    were not solved are NaN, and `result` says why. A pytree: it can be returned from a jitted function.
    """

    system: System
    #: what was chosen of the numerics (`solvers.settings.Settings`), or None for states that were measured
    settings: Any = eqx.field(static=True)
    time: Float[Any, " T"]
    y: Float[Any, "*batch T N y"]
    z: Float[Any, "*batch T N z"]
    control: Float[Any, "*batch T c"]
    result: Int[Any, "*batch T"]
    #: largest residual in natural units
    residual: Float[Any, "*batch T"]
    iterations: Int[Any, "*batch T"]
    #: estimated discretisation error of positions along the rod (m), the largest over the nodes; NaN: unknown
    position_error: Any = None
    #: initial history of a motion (`solvers.history.Begun`), if it is known
    begun: Any = None

    # named parts

    @property
    def state(self) -> Any:
        """The packed states y (…, T, N, y)."""
        return self.y

    @property
    def position(self) -> Any:
        """Positions (…, T, N, 3) in m, global frame."""
        return self.system.positions(self.y)

    @property
    def quaternion(self) -> Any:
        """Orientations (…, T, N, 4), scalar first."""
        return self.system.quaternions(self.y)

    @property
    def tip_position(self) -> Any:
        """Positions of the last node (…, T, 3) in m."""
        return self.position[..., -1, :]

    @property
    def tension(self) -> Any:
        """Tendon tensions (…, T, tendons) in N, at the base; zero in row 0 of a robot that starts at rest."""
        if "tension" in self.system.control_layout.names:
            return self.system.control_layout.get(self.control, "tension")
        tension = self.part("tension")
        return tension[..., 0, :] if "tension" in self.system.y_layout.names else tension

    @property
    def arclength(self) -> Any:
        """s of the nodes (N,) in m, or (B, N) in a batch of robots."""
        return np.linspace(0.0, 1.0, self.y.shape[-2]) * np.asarray(self.system.length)[..., None]

    @property
    def dt(self) -> float:
        """Time step (s); NaN for a single row."""
        if len(self.time) < 2:
            return float("nan")
        return float(self.time[1] - self.time[0])

    def part(self, name: str) -> Any:
        """A field of y, z or the controls by its name: `n`, `m`, `v`, `u`, `tension` … (…, T, N, size).

        Of a robot of several rods, such as the legs of a platform, `n2` is the second one's and `n` that of
        all of them, (…, T, N, rods, size).
        """
        count, known = self.system.strands, []
        for layout, packed in self._layouts():
            if name in layout.names:
                return layout.get(packed, name)
            known += layout.names
            rods = tuple(f"{name}{k + 1}" for k in range(count))
            # with no more of the name than there are rods, it is that of one field of each
            if set(rods) <= set(layout.names) and f"{name}{count + 1}" not in layout.names:
                every = packed[..., layout.indices(rods)]
                return every.reshape(*every.shape[:-1], count, -1)
        raise KeyError(f"no field {name!r}; there are {', '.join(known)}")

    def _layouts(self) -> tuple[tuple[Any, Any], ...]:
        system = self.system
        return (system.y_layout, self.y), (system.z_layout, self.z), (system.control_layout, self.control)

    @property
    def force(self) -> Any:
        """Internal force n (…, T, N, 3) in N, global frame; of several rods (…, T, N, rods, 3)."""
        return self.part("n")

    @property
    def moment(self) -> Any:
        """Internal moment m (…, T, N, 3) in N·m, global frame; of several rods (…, T, N, rods, 3)."""
        return self.part("m")

    @property
    def velocity(self) -> Any:
        """Velocity q (…, T, N, 3) in m/s, material frame; of several rods (…, T, N, rods, 3)."""
        return self.part("q")

    @property
    def angular_velocity(self) -> Any:
        """Angular velocity ω (…, T, N, 3) in rad/s, material frame; of several rods (…, T, N, rods, 3)."""
        return self.part("w")

    @property
    def strain(self) -> Any:
        """Strains z (…, T, N, z): for a rod v (no unit), then u (1/m), material frame."""
        return self.z

    # validity

    @property
    def valid(self) -> Any:
        """Which rows are solutions (…, T)."""
        return self.result >= 0

    @property
    def all_valid(self) -> bool:
        """Whether every row is a solution."""
        return bool(np.all(self.valid))

    def require_valid(self) -> None:
        """Raise `ValueError`, naming the first row that is not a solution, if there is one."""
        if not self.all_valid:
            first = np.argwhere(~np.asarray(self.valid))[0]
            result = Result(int(np.asarray(self.result)[tuple(first)]))
            where = f"row {first[-1]}" + (f" of robot {first[0]}" if len(first) == 2 else "")
            raise ValueError(f"the trajectory is not valid at {where}: {result.message}")

    def __getitem__(self, index: Any) -> Self:
        """Rows of a trajectory (a slice), or one robot (an integer) or several (a slice) of a batch."""
        if self.y.ndim == 3 and not isinstance(index, slice):
            raise TypeError(f"index a trajectory's rows by a slice, not by {index!r}")
        if self.y.ndim == 4 and not isinstance(index, slice | int | np.integer):
            raise TypeError(f"index a batch by a slice or a robot's number, not by {index!r}")
        fields: tuple[str, ...] = ("y", "z", "control", "result", "residual", "iterations")
        fields += () if self.position_error is None else ("position_error",)
        picked: dict[str, Any] = {name: getattr(self, name)[index] for name in fields}
        time = self.time if self.y.ndim == 4 else self.time[index]
        system = self.system
        if np.ndim(system.length):
            system = _picked(system, index)
        begun = self.begun
        if begun is not None and self.y.ndim == 4:
            begun = _picked(begun, index)
        elif isinstance(index, slice) and index.indices(len(self.time))[0::2] != (0, 1):
            begun = None  # of rows that were left out, or lie further apart, it tells nothing
        return type(self)(system, self.settings, time, **picked, begun=begun)

    def save(self, path: Any) -> None:
        """Write a labelled netCDF file (see `trajectory_file.save`)."""
        from knode_cosserat import trajectory_file

        trajectory_file.save(self, path)


def _picked(tree: Any, index: Any) -> Any:
    import jax

    return jax.tree.map(lambda leaf: leaf[index], tree)
