"""Internal force and moment of a known motion from a robot's balance, and strains from its constitutive law.

A system gives y_s for all of y. With p, h, q, ω and their rates known, n and m satisfy a linear differential
equation along the rod. It is integrated from the tip, where the system gives the boundary conditions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.rods.parts import Contribution
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.history import coefficient_table
from knode_cosserat.schemes.semi_discrete import History, Point
from knode_cosserat.schemes.settings import Settings

#: required fields of a rod's state: known from poses, known from the balance, and the strains
KNOWN, LOADS, STRAINS = ("p", "h", "q", "w"), ("n", "m"), ("v", "u")
#: Newton steps at the tip and in an implicit segment; both problems are linear or nearly so
_CORRECTIONS = 3
#: rows are padded to a multiple of this, so that few programs are compiled
BLOCK = 128


def require_rod(robot: System) -> None:
    """Raise `RecordingError` unless the robot has the state of a clamped rod, free or loaded at its tip."""
    has = (*robot.y_layout.names, *robot.z_layout.names)
    missing = [name for name in (*KNOWN, *LOADS, *STRAINS) if name not in has]
    if missing:
        raise RecordingError(
            f"{type(robot).__name__} has no {', '.join(missing)} in its states; estimation is for rods with "
            f"{', '.join((*KNOWN, *LOADS))} in y and {', '.join(STRAINS)} in z"
        )
    parts = getattr(nominal_model(robot), "parts", {}).values()
    if any(type(part).arclength_rate is not Contribution.arclength_rate for part in parts):
        raise RecordingError(
            f"{type(robot).__name__} has a length that controls change; estimation is for constant lengths"
        )
    if sorted(robot.base_unknowns) != sorted(LOADS):
        raise RecordingError(
            f"{type(robot).__name__} has {', '.join(robot.base_unknowns)} unknown at its base; "
            "estimation is for rods that are clamped there, with n and m unknown"
        )


class KnownRows(NamedTuple):
    """Known values at T rows and P points: y with n and m set to zero, its rate, z and its rate."""

    t: Float[Any, " T"]
    control: Float[Any, "T c"]
    y: Float[Any, "T P y"]
    y_t: Float[Any, "T P y"]
    z: Float[Any, "T P z"]
    z_t: Float[Any, "T P z"]


def loads_of(robot: System, s: Float[Any, " P"], rows: KnownRows) -> Float[np.ndarray, "T P y"]:
    """Return y with n and m. Points alternate between ends and middles of segments; the order is 4."""
    return np.asarray(_loads(robot, s, _padded(rows)))[: len(rows.t)]


@jax.jit
def _loads(robot: System, s: Float[Any, " P"], rows: KnownRows) -> Float[Any, "T P y"]:
    where = robot.y_layout.indices(LOADS)

    def one(row: KnownRows) -> Any:
        t, control, y, y_t, z, z_t = row

        def known_history(j: Any) -> History:
            # the rates are known, not computed from c0 and the history
            return History(jnp.zeros(()), y_t[j], z_t[j], jnp.zeros_like(y_t[j]))

        def slope(j: Any, loads: Any) -> Any:
            point = Point(s[j], t, y[j].at[where].set(loads), control, known_history(j))
            return semi_discrete.rates(robot, point, z[j])[where]

        def segment(after: Any, j: Any) -> Any:
            ds = s[j] - s[j + 2]
            k1 = slope(j + 2, after)
            k2 = slope(j + 1, after + ds / 2 * k1)
            k3 = slope(j + 1, after + ds / 2 * k2)
            k4 = slope(j, after + ds * k3)
            middle = after + ds / 24 * (5 * k1 + 4 * (k2 + k3) - k4)
            before = after + ds / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            return before, jnp.stack([before, middle])

        last = _at_tip(robot, t, control, y[-1], known_history(-1))
        starts = jnp.arange(s.shape[0] - 3, -1, -2)
        _, pairs = jax.lax.scan(segment, last, starts)
        loads = jnp.concatenate([pairs[::-1].reshape(-1, last.shape[0]), last[None]])
        return y.at[:, where].set(loads)

    return jax.vmap(one)(rows)


def _at_tip(robot: System, t: Any, control: Any, y: Any, history: History) -> Any:
    """Return n and m that satisfy the boundary conditions at the tip."""
    where = robot.y_layout.indices(LOADS)

    def residual(loads: Any) -> Any:
        return semi_discrete.tip(robot, t, control, y.at[where].set(loads), history)

    def corrected(_: Any, loads: Any) -> Any:
        return loads - jnp.linalg.solve(jax.jacfwd(residual)(loads), residual(loads))

    return jax.lax.fori_loop(0, _CORRECTIONS, corrected, jnp.zeros(len(where)))


def strains_of(robot: System, rows: KnownRows, settings: Settings, dt: float) -> Float[np.ndarray, "T N z"]:
    """Return z at the nodes from the robot's constitutive law; z_t comes from the time scheme.

    `rows.y` must be complete; `rows.z` is ignored. The first row is assumed to be at rest.
    """
    coefficients = coefficient_table(settings, dt)[-1]
    return np.asarray(_strains(robot, _padded(rows), coefficients))[: len(rows.t)]


@jax.jit
def _strains(robot: System, rows: KnownRows, coefficients: Float[Any, "4"]) -> Float[Any, "T N z"]:
    s = jnp.linspace(0.0, 1.0, robot.nodes) * robot.length
    c0, c1, c2, d1 = coefficients

    def at_nodes(c0: Any, row: KnownRows, hz: Any) -> Any:
        t, control = row.t, row.control

        def one(s: Any, y: Any, y_t: Any, hz: Any) -> Any:
            history = History(c0, y_t - c0 * y, hz, jnp.zeros_like(y))
            return semi_discrete.strains(robot, Point(s, t, y, control, history))

        return jax.vmap(one)(s, row.y, row.y_t, hz)

    nothing = jnp.zeros(rows.z.shape[1:])
    first = at_nodes(jnp.zeros(()), jax.tree.map(lambda values: values[0], rows), nothing)

    def step(history: Any, row: KnownRows) -> Any:
        last, earlier, rate = history
        hz = c1 * last + c2 * earlier + d1 * rate
        z = at_nodes(c0, row, hz)
        return (z, last, c0 * z + hz), z

    _, z = jax.lax.scan(step, (first, first, nothing), jax.tree.map(lambda values: values[1:], rows))
    return jnp.concatenate([first[None], z])


def semi_discretised(
    robot: System, rows: tuple[Any, Any, Float[Any, "T N y"]], settings: Settings, dt: float
) -> tuple[Float[np.ndarray, "T N y"], Float[np.ndarray, "T N z"]]:
    """Return y and z at the nodes (paper eq. 14, n and m integrated backwards from the tip).

    The equations are those of a simulation with Euler segments. Rates come from the time scheme and earlier
    rows. The history of the first row is constant (paper, section 3). `rows` are times, controls and y.
    """
    coefficients = coefficient_table(settings, dt)[-1]
    records = np.asarray(_semi_discretised(robot, *_padded(rows), coefficients))[: len(rows[0])]
    ny = robot.y_layout.size
    return records[..., :ny], records[..., ny:]


@jax.jit
def _semi_discretised(
    robot: System, t: Any, control: Any, known: Float[Any, "T N y"], coefficients: Float[Any, "4"]
) -> Float[Any, "T N x"]:
    where = robot.y_layout.indices(LOADS)
    s, ds = jnp.linspace(0.0, 1.0, robot.nodes) * robot.length, robot.length / (robot.nodes - 1)
    c0, c1, c2, d1 = coefficients
    ny = robot.y_layout.size

    def solved(t: Any, control: Any, y: Any, history: Any) -> Any:
        def of(j: Any) -> History:
            return History(c0, history[j, :ny], history[j, ny:], jnp.zeros(ny))

        last = _at_tip(robot, t, control, y[-1], of(-1))

        def segment(after: Any, j: Any) -> Any:
            def corrected(_: Any, loads: Any) -> Any:
                y_s, _ = semi_discrete.derivatives(
                    robot, Point(s[j], t, y[j].at[where].set(loads), control, of(j))
                )
                return after - ds * y_s[where]

            loads = jax.lax.fori_loop(0, _CORRECTIONS, corrected, after)
            return loads, loads

        _, loads = jax.lax.scan(segment, last, jnp.arange(robot.nodes - 2, -1, -1))
        y = y.at[:, where].set(jnp.concatenate([loads[::-1], last[None]]))
        z = jax.vmap(lambda s, y, j: semi_discrete.strains(robot, Point(s, t, y, control, of(j))))(
            s, y, jnp.arange(robot.nodes)
        )
        return jnp.concatenate([y, z], axis=1)

    def step(past: Any, row: Any) -> Any:
        last, before, rate = past
        history = c1 * last + c2 * before + d1 * rate
        t, control, y = row
        record = solved(t, control, y, history)
        return (record, last, c0 * record + history), record

    _, z_rest = jax.vmap(robot.rest)(s)
    begin = jnp.concatenate([known[0], z_rest], axis=1)
    # the first row is its own history: fixed-point iteration for its n, m and z
    begin = jax.lax.fori_loop(
        0, 2, lambda _, begin: solved(t[0], control[0], known[0], (c1 + c2) * begin), begin
    )
    _, records = jax.lax.scan(step, (begin, begin, jnp.zeros_like(begin)), (t[1:], control[1:], known[1:]))
    return jnp.concatenate([begin[None], records])


def _padded(rows: Any) -> Any:
    """Return rows padded with the last one to whole blocks: one compiled program serves many lengths."""
    count = -(-len(rows[0]) // BLOCK) * BLOCK

    def longer(values: Any) -> Any:
        return np.concatenate([values, np.repeat(np.asarray(values)[-1:], count - len(values), axis=0)])

    return jax.tree.map(longer, rows)


def packed_fields(
    robot: System, part: str, **fields: Float[np.ndarray, "... size"]
) -> Float[np.ndarray, "... y"]:
    """Return a vector y (or z, by `part`) with the given fields, zero elsewhere."""
    layout = robot.y_layout if part == "y" else robot.z_layout
    shape = next(iter(fields.values())).shape[:-1]
    values = np.zeros((*shape, layout.size))
    for name, field in fields.items():
        values[..., layout.slice(name)] = field
    return values
