"""The boundary-value problem of one time step, solved at all nodes at once.

Unknown are y at every node and the free numbers ξ at the base. Their equations:

    y_0 = base(ξ),     y_{j+1} = y_j + h Σ bᵢ f(Yᵢ)  (a piece of the space scheme),     tip(y_N) = 0

Newton's method linearises all pieces side by side, and one linear recursion along the rod gives the
correction (`engine.elimination`). A linearisation costs as much as several corrections. It is kept, also from
one time step to the next, while corrections converge fast. Corrections are damped by the natural monotonicity
test: the correction that the same linearisation proposes at the new point must be shorter than the last one
(Deuflhard, Newton Methods for Nonlinear Problems, 2004, ch. 3).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.strands import in_strands, strand_count, strand_of
from knode_cosserat.rods.system import System, array_module
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.grid import Grid, grid_of, take_rows
from knode_cosserat.schemes.semi_discrete import History, Point, records_in_strands, unpacked_history
from knode_cosserat.schemes.space import Formula, SpaceScheme

#: Newton corrections of y at discontinuities inside a segment, for each discontinuity of the segment
FILLING = 5


def no_history(system: System, space: SpaceScheme) -> Float[Any, "places x"]:
    """Zero history, for statics."""
    ny, nz = system.y_layout.size, system.z_layout.size
    return np.zeros((grid_of(system, space).count, ny + nz + (ny if system.mixed else 0)))


def row_of(
    system: System, y: Float[Any, "points y ..."], records: Float[Any, "places x ..."]
) -> Float[Any, "nodes x ..."]:
    """Return the row of a solved step: y on the near side of discontinuities, z and y_s on the far side."""
    nodes, ny = grid_of(system).nodes, system.y_layout.size
    numeric = array_module((y, records))
    return numeric.concatenate([take_rows(y, nodes), take_rows(records, nodes)[:, ny:]], axis=1)


def places_of(system: System, space: SpaceScheme) -> Float[Any, " places"]:
    """Return the arclength (m) of all places where a step evaluates the equations (`Grid`)."""
    return grid_of(system, space).along * system.length


class _Stages(NamedTuple):
    """Rates and strains of a state: at the ends of pieces, then at each stage between them."""

    y: list[Any]
    f: list[Any]
    z: list[Any]


class Evaluated(NamedTuple):
    """A state by the equations of a step."""

    y: Float[Any, "points y"]
    records: Float[Any, "places x"]
    #: largest residual of the pieces, natural units
    error: Float[Any, ""]
    #: residual of the tip's conditions
    tip: Float[Any, " k"]


class StepProblem(eqx.Module):
    """Boundary-value problem of one step: the system, its control, and the history."""

    system: System
    t: Float[Any, ""]
    control: Float[Any, " c"]
    c0: Float[Any, ""]
    #: history terms at every place where the equations are evaluated (`Grid`)
    history: Float[Any, "places x"]
    space: SpaceScheme = eqx.field(static=True)

    @classmethod
    def still(cls, system: System, space: SpaceScheme, control: Any, t: Any = 0.0) -> StepProblem:
        """Return the problem of an equilibrium: no rates, no history."""
        t, c0 = jnp.asarray(t, dtype=float), jnp.zeros(())
        return cls(system, t, jnp.asarray(control), c0, no_history(system, space), space)

    def point_rates(self, s: Any, y: Float[Any, " y"], history: Float[Any, " x"]) -> Any:
        """Return x = [y_s; z] at one point of a strand (paper eq. 5, compact form x = M⁻¹ f).

        The history terms are one packed record.
        """
        strand = strand_of(self.system)
        terms = unpacked_history(strand, self.c0, history)
        return semi_discrete.derivatives(strand, Point(s, self.t, y, self.control, terms))

    def _unpack(self, history: Float[Any, " x"]) -> History:
        return unpacked_history(self.system, self.c0, history)

    # the ends, and jumps

    def base(self, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at the first node, for these unknowns."""
        return semi_discrete.base(self.system, self.t, self.control, unknowns, self._unpack(self.history[0]))

    def tip_residual(self, y: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residual of the tip's boundary conditions, from y of the last node."""
        history = self._unpack(self.history[self.grid.tip])
        return semi_discrete.tip(self.system, self.t, self.control, y, history)

    def jump(self, acting: Any, y: Float[Any, " y"], history: Float[Any, " x"]) -> Float[Any, " y"]:
        """Return y on the far side of the active discontinuities."""
        point = Point(None, self.t, y, self.control, self._unpack(history))
        return semi_discrete.jump(self.system, acting, point)

    def far(self, y: Float[Any, "points y"]) -> Float[Any, "pieces y"]:
        """Return y where pieces start, on the far side of their discontinuities."""
        grid = self.grid
        if self.system.discontinuities.jump is None:
            return y[:-1]
        return jax.vmap(self.jump)(jnp.asarray(grid.acting), y[:-1], self.history[: grid.tip])

    # places

    @property
    def grid(self) -> Grid:
        """The points and places of the rod."""
        return grid_of(self.system, self.space)

    @property
    def places(self) -> Float[Any, " places"]:
        """Arclength (m) where the equations are evaluated."""
        return places_of(self.system, self.space)

    # along the rod

    def _evaluated(self, lanes: slice, y: Float[Any, "n y"]) -> tuple[Any, Any]:
        """Return f and z at places, from y there."""
        system, s = self.system, self.places[lanes]
        count = strand_count(system)
        s = jnp.repeat(s, count) if count > 1 else s
        # a lane for each strand
        parts = in_strands(system, y), records_in_strands(system, self.history[lanes])
        f, z = jax.vmap(self.point_rates)(s, *(part.reshape(-1, part.shape[-1]) for part in parts))
        return f.reshape(len(y), -1), z.reshape(len(y), -1)

    def lengths(self) -> Float[Any, "pieces 1"]:
        """Return the lengths of all pieces (m)."""
        return (self.grid.lengths * self.system.length)[:, None]

    def at_ends(self, values: Any) -> tuple[Any, Any]:
        """Return values at the starts and at the ends of pieces; 0 at the ends if they were not evaluated."""
        grid = self.grid
        end = take_rows(values, grid.end_of) if len(values) > grid.tip else jnp.zeros(())
        return values[: grid.tip], end

    def stages(self, y: Float[Any, "points y"], formula: Formula, known: _Stages | None = None) -> _Stages:
        """Evaluate the stages of a formula that are not known yet.

        Without known stages, only those ends of pieces are evaluated that the scheme uses (`ends` gives all).
        """
        found = self.ends(y, every=False) if known is None else _Stages(*map(list, known))
        rates = [*self.at_ends(found.f[0]), *found.f[1:]]
        for k in range(len(found.f) - 1, len(formula.stages)):
            between = self.between(formula.stages[k], found.y[0][: self.grid.tip], y[1:], rates)
            f, z = self._evaluated(self.grid.stage(k), between)
            rates.append(f)
            for values, new in zip(found, (between, f, z), strict=True):
                values.append(new)
        return found

    def ends(self, y: Float[Any, "points y"], every: bool = True) -> _Stages:
        """Evaluate the equations at the ends of pieces: at `every` end, or at those that the scheme uses."""
        grid, ends = self.grid, self.far(y)
        if every or self.space.implicit:
            ends = jnp.concatenate([ends, y[-1:], take_rows(y, grid.near)])
        f, z = self._evaluated(slice(0, len(ends)), ends)
        return _Stages([ends], [f], [z])

    def between(self, stage: Any, start: Any, end: Any, rates: list[Any]) -> Any:
        """Return y at a stage, from y at both ends of the pieces and earlier rates."""
        moved = sum(x * f for x, f in zip(stage.rates, rates, strict=False) if x)
        return (1.0 - stage.end) * start + stage.end * end + self.lengths() * moved

    def reached(self, y: Float[Any, "points y"]) -> Float[Any, "pieces y"]:
        """Return y at the ends of all pieces by the scheme."""
        formula = self.space.formula
        found = self.stages(y, formula)
        rates = [*self.at_ends(found.f[0]), *found.f[1:]]
        moved = sum(b * f for b, f in zip(formula.weights, rates, strict=False) if b)
        return found.y[0][: self.grid.tip] + self.lengths() * moved

    def residuals(self, y: Float[Any, "points y"]) -> tuple[Any, Any]:
        """Return the defects of all pieces (y at the end by the scheme, minus y), and the tip's residual."""
        return self.reached(y) - y[1:], self.tip_residual(y[-1])

    def records(self, y: Float[Any, "points y"]) -> Float[Any, "places x"]:
        """Return the records that later steps need, at every place: y, z and, if B is not zero, y_s."""
        found = self.stages(y, self.space.check, self.ends(y))
        parts = [found.y, found.z, found.f] if self.system.mixed else [found.y, found.z]
        return jnp.concatenate([jnp.concatenate(part) for part in parts], axis=-1)

    def evaluated(self, y: Float[Any, "n y"]) -> Evaluated:
        """Return the state of y at all points, or at the nodes."""
        y = self.filled(y) if len(y) == self.system.nodes else y
        defects, tip = self.residuals(y)
        return Evaluated(y, self.records(y), jnp.max(jnp.abs(defects) / self.system.scales().y), tip)

    def linearise(
        self, y: Float[Any, "points y"]
    ) -> tuple[Float[Any, "pieces y y"], Float[Any, "pieces y y"]]:
        """Return the derivatives of `reached` by y at the starts of the pieces, and by y at their ends."""
        # points of even number move together, and the others
        odd, pieces = np.arange(len(y)) % 2, np.arange(len(y) - 1)
        moves = np.eye(2)[:, odd][:, None, :, None] * np.eye(y.shape[1])[:, None]
        slopes = jax.vmap(jax.vmap(lambda move: jax.jvp(self.reached, (y,), (move,))[1]))(moves)
        slopes = jnp.moveaxis(slopes, 1, -1)
        return slopes[odd[:-1], pieces], slopes[odd[1:], pieces]

    def filled(self, y: Float[Any, "nodes y"]) -> Float[Any, "points y"]:
        """Return y at all points from y at the nodes; at other discontinuities by the scheme."""
        grid = self.grid
        found = grid.spread(y)
        if not len(grid.between):
            return found
        most = int(np.max(np.diff(grid.nodes))) - 1
        before = jnp.zeros(len(found), dtype=bool).at[grid.between].set(True)[1:, None]

        def corrected(_: Any, y: Any) -> Any:
            defects = self.reached(y) - y[1:]
            B = self.linearise(y)[1]
            change = jnp.linalg.solve(jnp.eye(y.shape[1]) - B, defects[..., None])[..., 0]
            return y.at[1:].add(jnp.where(before, change, 0.0))

        return jax.lax.fori_loop(0, FILLING * most, corrected, found)
