"""Checks of a part before a robot has it: units, derivatives, energy, rest, batch, engine.

The part is put into a robot, and the equations of that robot are evaluated at a few states and along closed
cycles of pose and stress. Nothing is simulated, and no machine code is compiled.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._units import UnitError, unit_of
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.assembly import Assembly
from knode_cosserat.rods.loads import Motion, PointLoad, SpreadLoad
from knode_cosserat.rods.parameters import parameters_of, slots_of
from knode_cosserat.rods.parts import Contribution, Part, RodPoint
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.system import System, unknown_count
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.tubes import ConcentricTubeRobot, Tube
from knode_cosserat.rotation import dot, quaternion_product, rotation_matrix
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.space import LOBATTO2

Verdict = Literal["passed", "failed", "not tested"]

#: largest relative difference of derivatives, and relative steps of central differences
DERIVATIVE, STEPS = 1e-4, (1e-3, 1e-5, 1e-7)
#: largest relative difference of a batch from single states: rounding of another order of operations
BATCH = 1e-9
#: largest stress of the material in the shape that it states as unloaded, in natural units
UNLOADED = 1e-6
#: states at which the equations are evaluated
STATES = 4
#: work of a closed cycle, as a part of the work that is exchanged in it, within which it is zero
CLOSED = 2e-3
#: steps of a cycle, cycles before the measured one, and periods in natural units of time
CYCLE, BEFORE, PERIODS = 400, 1, (3.0, 300.0)
#: fields of a rod's state that its own pose and stress decide
OWN = ("p", "h", "n", "m", "q", "w")
#: usual sizes of controls by unit
USUAL = {"N": 1.0, "Pa": 1e4, "rad": 0.3, "m": 5e-3, "T": 0.01, "1/m": 1.0, "m3": 1e-7}
_ROD: dict[str, Any] = {"length": 0.3, "density": 1200.0, "youngs_modulus": 5e7, "gravity": (0.0, 0.0, 0.0)}


class PartCheckError(KnodeCosseratError, ValueError):
    """A part that no known robot takes; the message is one line."""

    code = "part-check"


class CheckLine(NamedTuple):
    """One check of a part.

    Attributes:
        name: its name.
        verdict: "passed", "failed" or "not tested".
        value: the number that decided, or NaN.
        limit: what it is compared with, or NaN.
        detail: the number in words, or the reason.
    """

    name: str
    verdict: Verdict
    value: float
    limit: float
    detail: str


@dataclasses.dataclass(frozen=True, repr=False)
class PartReport:
    """Checks of a part; its print is a table.

    Attributes:
        part: the part.
        robot: the robot that had it.
        lines: the checks.
    """

    part: Part
    robot: System
    lines: tuple[CheckLine, ...]

    @property
    def passed(self) -> bool:
        """True if no check failed."""
        return all(line.verdict != "failed" for line in self.lines)

    def __getitem__(self, name: str) -> CheckLine:
        """Return a check by its name."""
        return next(line for line in self.lines if line.name == name)

    def to_dict(self) -> dict[str, Any]:
        """Return the checks as plain values by name."""
        return {line.name: line._asdict() for line in self.lines}

    def __repr__(self) -> str:
        rows = [
            ("check", "verdict", "result"),
            *((line.name, line.verdict, line.detail) for line in self.lines),
        ]
        wide = [max(len(row[k]) for row in rows) for k in (0, 1)]
        table = [f"{name:{wide[0]}}  {verdict:{wide[1]}}  {detail}" for name, verdict, detail in rows]
        return "\n".join([f"{type(self.part).__name__} in a {type(self.robot).__name__}", *table])


def check(part: Part, robot: System | None = None, *, active: bool = False) -> PartReport:
    """Check a part of one's own, or of the library: units, derivative, energy, rest, batch, engine.

    Units and shapes: parameters and controls have known units, wrenches are vectors. Derivative: JAX's, from
    which the engine makes its tangents, against central differences, by states, controls and the part's
    parameters. Energy: the work of the part along closed cycles of pose and stress, fast and slow, in both
    directions; it is zero for a conservative part, and never positive for a passive one. Rest: the stress in
    the shape that the robot states as unloaded is zero; the part's wrench there is stated. Batch: many states
    at once give the numbers of each. Engine: every operation has machine code; without it a simulation is
    refused.

    Args:
        part: a part of a rod, such as a load, an effect or a section.
        robot: a robot without the part, to which it is added; by default a rod, or the robot with its slot.
        active: True if the part may do work, such as a follower force or a motor.

    Raises:
        PartCheckError: no robot has a slot for the part.
    """
    if not isinstance(part, Part):
        raise PartCheckError(
            f"part is a {type(part).__name__}; allowed is a part, such as an object of a subclass of "
            "kc.robots.Effect or kc.robots.loads.SpreadLoad"
        )
    check_arguments(check, locals())
    bare, whole = _robots(part, robot)
    checks: tuple[tuple[str, Callable[[], CheckLine]], ...] = (
        ("units", lambda: _units(part, bare, whole)),
        ("derivative", lambda: _derivative(whole, part)),
        ("energy", lambda: _energy(part, active)),
        ("rest", lambda: _rest(bare, whole)),
        ("batch", lambda: _batch(whole)),
        ("engine", lambda: _engine(whole)),
    )
    return PartReport(part, whole, tuple(_attempted(name, run) for name, run in checks))


def _attempted(name: str, run: Callable[[], CheckLine]) -> CheckLine:
    """Return a check; what a part raises is a failure, in one line."""
    try:
        return run()
    except Exception as error:  # whatever a part of one's own raises
        words = (str(error).strip() or "no message").splitlines()[0]
        return CheckLine(name, "failed", np.nan, np.nan, f"{type(error).__name__}: {words}")


# robots with the part and without it


def _hosts() -> Iterator[tuple[type[System], dict[str, Any]]]:
    rod = _ROD | {"radius": 3e-3, "nodes": 11}
    tubes = tuple(
        Tube(radius=outer, inner_radius=inner, curvature=5.0, youngs_modulus=6e10, density=6450.0)
        for outer, inner in ((0.35e-3, 0.2e-3), (0.7e-3, 0.45e-3))
    )
    yield SlenderRod, rod
    yield RoutedTendonRobot, rod | {"tendon_offset": 0.01, "tendon_angles": [0.0, 1.6, 3.1, 4.7]}
    yield ConcentricTubeRobot, {"length": 0.2, "gravity": (0.0, 0.0, 0.0), "nodes": 11, "tubes": tubes}
    arms = tuple(SlenderRod(**rod, name=name) for name in ("left", "right"))
    yield Assembly, {"gravity": (0.0, 0.0, 0.0), "nodes": 11, "rods": arms}


def _robots(part: Part, robot: System | None) -> tuple[System, System]:
    """Return a robot without the part and with it."""
    if robot is not None:
        return robot, _with(part, robot)
    for cls, values in _hosts():
        if any(isinstance(part, slot.family) for slot in slots_of(cls).values()):
            bare = cls(**values)
            return bare, _with(part, bare)
    # a part of a part, such as the field of a magnet
    for outer in _parts_with_slots(Part):
        for name, slot in slots_of(outer).items():
            if isinstance(part, slot.family) and not slot.many:
                bare = SlenderRod(**_ROD, radius=3e-3, nodes=11)
                return bare, _with(outer(**{name: part, **_first_values(outer)}), bare)
    raise PartCheckError(
        f"no robot has a slot for a {type(part).__name__}; allowed is an object of a subclass of Effect, "
        "SpreadLoad or PointLoad, or give robot="
    )


def _parts_with_slots(family: Any) -> Iterator[Any]:
    for cls in family.__subclasses__():
        if getattr(cls, "kind", None) and slots_of(cls):
            yield cls
        yield from _parts_with_slots(cls)


def _first_values(cls: Any) -> dict[str, Any]:
    """Return vectors for the parameters of a part that are zero by default."""
    return {
        name: (0.0, 0.01, 0.02)
        for name, stated in parameters_of(cls).items()
        if stated.shape == "vector" and name != "at"
    }


def _with(part: Part, robot: System) -> System:
    """Return a robot with a further part in the slot of its family."""
    for name, slot in slots_of(type(robot)).items():
        elsewhere = name == "base_end" and not getattr(part, "anywhere", True)
        if elsewhere or not isinstance(part, slot.family):
            continue
        if not slot.many:
            changes: dict[str, Any] = {name: part}
            if name == "reels":
                changes["drive"] = "reel"
            if name == "cross_section":
                changes["radius"] = None
                if not getattr(part, "is_homogeneous", True):
                    changes |= {"density": None, "youngs_modulus": None}
        elif isinstance(robot, RoutedTendonRobot) and name == "routing":
            changes = {name: (part,) * 4}
        elif isinstance(part, Tube):
            changes = {name: (part,)}
        else:
            changes = {name: (*(getattr(robot, name) or ()), part)}
        return robot.replace(**changes)
    raise PartCheckError(f"a {type(robot).__name__} has no slot for a {type(part).__name__}")


# the equations at a few states


class _State(NamedTuple):
    """Arguments of the equations at a point: place, y, history terms, control, c0 and unknowns."""

    s: Any
    y: Any
    record: Any
    control: Any
    c0: Any
    unknowns: Any


def _equations(system: System, state: _State) -> Any:
    """Return y_s and z at a point, y at the base, the tip's residual and y beyond the discontinuities."""
    strand = strand_of(system)
    s, y, record, control, c0, unknowns = state
    problem = StepProblem(system, jnp.zeros(()), control, c0, record[None], LOBATTO2)
    ny, nz = strand.y_layout.size, strand.z_layout.size
    own = y[:ny], jnp.concatenate([record[:ny], record[system.y_layout.size :][:nz]])
    history = semi_discrete.unpacked_history(system, c0, record)
    found = [*problem.point_rates(s, *own), problem.base(unknowns)]
    found.append(semi_discrete.tip(system, problem.t, control, y, history))
    places, jump = system.discontinuities
    if jump is not None:
        found.append(problem.jump(jnp.ones(len(places)), y, record))
    return jnp.concatenate(found)


def _time(system: System) -> float:
    """Return the natural time (s) of a robot: of a length over a velocity."""
    layout, size = system.y_layout, np.asarray(system.scales().y)
    places = [layout.ranges(name) for name in ("p", "q")]
    if not all(places):
        return 1.0
    return float(size[places[0][0].start] / size[places[1][0].start])


def _controls(system: System) -> np.ndarray:
    """Return usual controls: within their limits, and not zero."""
    values = []
    for field in system.control_layout.fields:
        usual = USUAL.get(field.unit, 0.5)
        inside = np.clip(usual, field.low, field.high)
        values.append(np.linspace(1.0, 0.7, field.size) * inside)
    return np.concatenate([np.zeros(0), *values])


def _states(system: System, count: int = STATES) -> _State:
    """Return states near rest, the same ones each time; the last is at rest in time (c0 = 0)."""
    random = np.random.default_rng(0)
    size, length = np.asarray(system.scales().y), float(system.length)
    rows = []
    for k in range(count):
        s = length * (0.31 + 0.09 * k)
        y, z = (np.asarray(each) for each in system.rest(s))
        step = 0.1 * size * random.uniform(-1.0, 1.0, len(y))
        y = y + step
        for place in system.y_layout.ranges("h"):
            y[place] /= np.linalg.norm(y[place])
        c0 = 10.0 / _time(system) if k < count - 1 else 0.0
        before = y - 0.03 * size * random.uniform(-1.0, 1.0, len(y))
        strains = z + 1e-3 * random.uniform(-1.0, 1.0, len(z))
        record = -c0 * np.concatenate([before, strains])
        unknowns = 0.1 * random.uniform(-1.0, 1.0, unknown_count(system))
        rows.append(_State(s, y, record, _controls(system), c0, unknowns))
    return _State(*map(np.stack, zip(*rows, strict=True)))


#: machine code of a check runs a few times only: fast compilation matters
_compiled = functools.partial(
    jax.jit, compiler_options={"xla_llvm_disable_expensive_passes": True, "xla_backend_optimization_level": 0}
)


class _Turn(NamedTuple):
    """Directions of a derivative: changes of y, history terms, controls and the robot's parameters."""

    y: Any
    record: Any
    control: Any
    leaves: Any


def _moved(system: System, state: _State, turn: _Turn, step: Any) -> Any:
    """Return the equations at a distance along a direction."""
    leaves, tree = jax.tree.flatten(system)
    robot = jax.tree.unflatten(tree, [a + step * b for a, b in zip(leaves, turn.leaves, strict=True)])
    moved = state._replace(
        y=state.y + step * turn.y,
        record=state.record + step * turn.record,
        control=state.control + step * turn.control,
    )
    return _equations(robot, moved)


@_compiled
@functools.partial(jax.vmap, in_axes=(None, 0, 0, None))
def _values(system: System, state: _State, turn: _Turn, step: Any) -> Any:
    return _moved(system, state, turn, step)


@_compiled
@functools.partial(jax.vmap, in_axes=(None, 0, 0))
def _slopes(system: System, state: _State, turn: _Turn) -> Any:
    return jax.jvp(lambda step: _moved(system, state, turn, step), (0.0,), (1.0,))[1]


_alone = _compiled(_equations)


def _still(system: System, states: _State) -> _Turn:
    """Return directions of length zero."""
    leaves = [np.zeros((len(states.s), *np.shape(leaf))) for leaf in jax.tree.leaves(system)]
    return _Turn(0.0 * states.y, 0.0 * states.record, 0.0 * states.control, leaves)


def _directions(system: System, part: Part, states: _State) -> dict[str, _Turn]:
    """Return directions by name."""
    random = np.random.default_rng(1)

    def around(values: Any) -> np.ndarray:
        return np.asarray(values * random.uniform(0.5, 1.0, np.shape(values)))

    still = _still(system, states)
    marked = jax.tree.map(
        lambda leaf: jax.tree.map(lambda _: True, leaf) if leaf is part else False,
        system,
        is_leaf=lambda leaf: leaf is part,
    )
    leaves = [
        np.broadcast_to(around(np.asarray(leaf, dtype=float)), rows.shape) if chosen else rows
        for leaf, rows, chosen in zip(
            jax.tree.leaves(system), still.leaves, jax.tree.leaves(marked), strict=True
        )
    ]
    size = np.broadcast_to(np.asarray(system.scales().y), states.y.shape)
    return {
        "state": still._replace(y=around(size)),
        "history": still._replace(record=around(np.abs(states.record) + 1e-2 * states.c0[:, None])),
        "controls": still._replace(control=around(states.control)),
        "parameters": still._replace(leaves=leaves),
    }


def _derivative(system: System, part: Part) -> CheckLine:
    system = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=float), system)
    states, worst, where = _states(system), 0.0, "state"
    for name, turn in _directions(system, part, states).items():
        values = np.asarray(_values(system, states, turn, 0.0))
        exact = np.asarray(_slopes(system, states, turn))
        if not np.isfinite(values).all():
            return CheckLine("derivative", "failed", np.nan, DERIVATIVE, "the equations are not finite")
        if not np.isfinite(exact).all():
            return CheckLine("derivative", "failed", np.nan, DERIVATIVE, f"by the {name}: not finite")
        off = np.full(values.shape, np.inf)
        # the best step depends on the curvature of each equation
        for step in STEPS:
            ahead, back = (np.asarray(_values(system, states, turn, sign * step)) for sign in (1.0, -1.0))
            differences = (ahead - back) / (2.0 * step)
            rounding = 1e-14 * np.max(np.abs(values), axis=0) / step
            size = np.maximum(np.max(np.abs(differences), axis=0), rounding / DERIVATIVE) + 1e-300
            off = np.minimum(off, np.abs(exact - differences) / size)
        if np.max(off) > worst:
            worst, where = float(np.max(off)), name
    verdict: Verdict = "passed" if worst <= DERIVATIVE else "failed"
    detail = f"{worst:.1e} from central differences (limit {DERIVATIVE:.0e}), by the {where}"
    return CheckLine("derivative", verdict, worst, DERIVATIVE, detail)


def _batch(system: System) -> CheckLine:
    system = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=float), system)
    states = _states(system)
    together = np.asarray(_values(system, states, _still(system, states), 0.0))
    alone = np.stack(
        [np.asarray(_alone(system, _State(*(leaf[k] for leaf in states)))) for k in range(len(states.s))]
    )
    size = np.maximum(np.max(np.abs(alone), axis=0), 1e-300)
    off = float(np.max(np.abs(together - alone) / size, initial=0.0))
    verdict: Verdict = "passed" if off <= BATCH else "failed"
    return CheckLine("batch", verdict, off, BATCH, f"{off:.1e} from single states (limit {BATCH:.0e})")


def _engine(system: System) -> CheckLine:
    # imported here: the engine is needed for this check only
    from knode_cosserat.engine.equations import Equations

    count = len(Equations(system).program.operations)
    return CheckLine("engine", "passed", float(count), np.nan, f"machine code for all of {count} operations")


# units and shapes


def _units(part: Part, bare: System, whole: System) -> CheckLine:
    stated = [(name, each.unit) for name, each in parameters_of(type(part)).items()]
    stated += [(f"control {field.name}", field.unit) for field in part.control_fields]
    known = 0
    for layout, other in ((whole.y_layout, bare.y_layout), (whole.z_layout, bare.z_layout)):
        stated += [(it.name, it.unit) for it in layout.fields if it.name not in other.names]
    for name, unit in stated:
        try:
            known += bool(unit_of(unit or "1"))
        except UnitError as error:
            return CheckLine("units", "failed", np.nan, np.nan, f"{name}: {error}")
    for name, shape in _shapes(part, whole):
        if shape != (3,):
            return CheckLine("units", "failed", np.nan, np.nan, f"{name} has shape {shape}; allowed is (3,)")
    return CheckLine("units", "passed", float(known), np.nan, f"{known} units known, wrenches of shape (3,)")


def _shapes(part: Part, whole: System) -> list[tuple[str, tuple[int, ...]]]:
    """Return the shapes of the force and moment that a part states at a point."""
    if not isinstance(whole, SlenderRod):
        return []
    own = next((input for each, input in whole.inputs(_controls(whole)) if each is part), None)
    if own is None:
        return []

    def stated(state: _State) -> Any:
        s, y, record, control, c0, _ = state
        point = semi_discrete.Point(s, 0.0, y, control, semi_discrete.unpacked_history(whole, c0, record))
        z = semi_discrete.strains(whole, point)
        at = RodPoint(whole, s, 0.0, y, point.y_t, control, None, whole.material(s, control), z, point.z_t(z))
        at = whole.absolute(at, Motion.of(whole.y_layout, y, point.y_t))._replace(input=own)
        if isinstance(part, PointLoad | SpreadLoad):
            return part.wrench(at.motion, own)
        return part.load(at)

    wrench = jax.eval_shape(stated, _State(*(leaf[0] for leaf in _states(whole))))
    if wrench is None:
        return []
    return [(f"the {name}", np.shape(each)) for name, each in zip(("force", "moment"), wrench, strict=True)]


# rest


def _rest(bare: System, whole: System) -> CheckLine:
    if not isinstance(whole, SlenderRod):
        reason = f"a {type(whole).__name__} has several rods or bodies"
        return CheckLine("rest", "not tested", np.nan, np.nan, reason)
    s = 0.43 * float(whole.length)
    worst, force, moment = 0.0, np.zeros(3), np.zeros(3)
    control = np.zeros(whole.control_layout.size)
    y, z = (jnp.asarray(each) for each in whole.rest(s))
    history = semi_discrete.History(jnp.zeros(()), 0.0 * y, 0.0 * z, 0.0 * y)
    point = semi_discrete.Point(s, 0.0, y, jnp.asarray(control), history)
    size, layout = whole.scales().y, whole.y_layout
    free = semi_discrete.strains(whole, point)
    for name, scale in (("v", 1.0), ("u", 1.0 / whole.length)):
        off = whole.z_layout.get(free, name) - whole.z_layout.get(z, name)
        worst = max(worst, float(np.max(np.abs(off))) / float(np.asarray(scale)))
    force, moment = (np.asarray(each) for each in _wrench(bare, whole, point, free))
    at_tip = [np.asarray(each) for each in _point_load(bare, whole, y, 0.0 * y, control)]
    natural = float(layout.get(size, "n")[0]) / float(whole.length)
    sizes = [float(np.linalg.norm(each)) for each in (force, moment, *at_tip)]
    units = ("N/m", "N", "N at the tip", "N m at the tip")
    loads = [
        f"{value:.3g} {unit}" for value, unit in zip(sizes, units, strict=True) if value > 1e-9 * natural
    ]
    words = f"its load there is {', '.join(loads)}" if loads else "no load there"
    verdict: Verdict = "passed" if worst <= UNLOADED else "failed"
    if verdict == "failed":
        words = f"the stated unloaded shape has stress: without load the strain is {worst:.2g} from it"
    return CheckLine("rest", verdict, worst if verdict == "failed" else max(sizes), UNLOADED, words)


def _wrench(bare: System, whole: System, point: semi_discrete.Point, z: Any) -> tuple[Any, Any]:
    """Return the force and moment per length that the part adds at a point, for the same strains."""
    small = _narrowed(bare, whole, point)
    common = jnp.concatenate([whole.z_layout.get(z, name) for name in bare.z_layout.names])
    rates = semi_discrete.rates(whole, point, z), semi_discrete.rates(bare, small, common)
    force, moment = (
        bare.y_layout.get(rates[1], name) - whole.y_layout.get(rates[0], name) for name in ("n", "m")
    )
    return force, moment


def _narrowed(bare: System, whole: System, point: semi_discrete.Point) -> semi_discrete.Point:
    """Return a point of the robot without the part: its fields of y and z, and its controls."""
    c0, y, z, _ = point.history

    def chosen(values: Any, layouts: tuple[Any, Any]) -> Any:
        return jnp.concatenate([layouts[1].get(values, name) for name in layouts[0].names])

    ys, zs = (bare.y_layout, whole.y_layout), (bare.z_layout, whole.z_layout)
    known = chosen(point.y, ys)
    history = semi_discrete.History(c0, chosen(y, ys), chosen(z, zs), 0.0 * known)
    return point._replace(y=known, control=_bare_control(bare), history=history)


def _bare_control(bare: System) -> Any:
    return jnp.zeros(bare.control_layout.size)


def _point_load(bare: Any, whole: Any, y: Any, y_t: Any, control: Any) -> tuple[Any, Any]:
    """Return the force (N) and moment (N m) at the tip that the part adds there."""
    own = jnp.concatenate([whole.y_layout.get(y, name) for name in bare.y_layout.names])
    own_t = jnp.concatenate([whole.y_layout.get(y_t, name) for name in bare.y_layout.names])
    with_it = whole.tip_wrench(0.0, control, y, y_t)
    without = bare.tip_wrench(0.0, _bare_control(bare), own, own_t)
    return without.force - with_it.force, without.moment - with_it.moment


# energy


def _energy(part: Part, active: bool) -> CheckLine:
    # a plain rod, whose own energy is known
    bare, whole = _robots(part, None)
    reason = _no_energy(part, bare, whole)
    if reason:
        return CheckLine("energy", "not tested", np.nan, CLOSED, reason)
    if isinstance(part, PointLoad) and part.at < 1.0:
        whole = _with(dataclasses.replace(part, at=1.0), bare)
    control = _controls(whole)
    works, exchanged = [], 0.0
    for period in PERIODS:
        for way in (1.0, -1.0):
            for seed in (0, 1):
                power = np.asarray(_cycle(bare, whole, control, period * _time(bare), way, _waves(seed)))
                if not np.isfinite(power).all():
                    return CheckLine("energy", "failed", np.nan, CLOSED, "not finite along a cycle")
                total = float(np.sum(np.abs(power)))
                if total > 0.0:
                    works.append(float(np.sum(power)) / total)
                    exchanged = max(exchanged, total)
    if not works or exchanged < 1e-14:
        return CheckLine("energy", "not tested", np.nan, CLOSED, "it does no work along a cycle")
    most, least = max(works), min(works)
    kind = "active" if most > CLOSED else "passive" if least < -CLOSED else "conservative"
    verdict: Verdict = "failed" if kind == "active" and not active else "passed"
    value = most if kind != "passive" else least
    words = f"{kind}: work of a closed cycle {least:+.1e} to {most:+.1e} of the exchanged"
    if verdict == "failed":
        words += "; active=True allows that"
    return CheckLine("energy", verdict, value, CLOSED, words)


def _no_energy(part: Part, bare: System, whole: System) -> str:
    """Return why the energy of a part is not tested; empty if it is."""
    if not isinstance(whole, SlenderRod) or type(whole) is not SlenderRod:
        return f"a {type(whole).__name__} is more than a rod with parts"
    if set(whole.y_layout.names) != set(bare.y_layout.names):
        return "it has states along the rod: its work at one point is not all"
    if part.tip_rows.__func__ is not Contribution.tip_rows:  # type: ignore[attr-defined]
        return "it has conditions at the tip"
    if type(part).absolute is not Contribution.absolute:
        return "it changes the frame of the states"
    if type(part).arclength_rate is not Contribution.arclength_rate:
        return "it feeds the rod"
    return ""


def _waves(seed: int) -> np.ndarray:
    """Return amplitudes (12, 2, 2) of position, rotation, force and moment: two harmonics."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (12, 2, 2)) * np.array([1.0, 0.5])[:, None]


@functools.partial(jax.jit, compiler_options={"xla_llvm_disable_expensive_passes": True})
def _cycle(bare: Any, whole: Any, control: Any, period: Any, way: Any, waves: Any) -> Any:
    """Return the power of the part, times the step, over the last of several cycles.

    Along a cycle the pose and the stress of a point are given. The strains follow from the law, and the
    velocities from the pose. The part does the work of its load, less the work that the material takes.
    """
    bare_scale, layout = bare.scales().y, bare.y_layout
    length = bare.length
    middle = bare.rest(0.43 * length)[0]
    n_size, m_size = (bare.y_layout.get(bare_scale, name)[0] for name in ("n", "m"))
    amplitudes = jnp.concatenate(
        [jnp.full(3, 0.05 * length), jnp.full(3, 0.3), jnp.full(3, 0.5 * n_size), jnp.full(3, 0.3 * m_size)]
    )

    def given(t: Any) -> Any:
        phase = 2.0 * jnp.pi * way * t / period * jnp.arange(1, 3)
        wave = jnp.stack([jnp.cos(phase), jnp.sin(phase)], axis=1)
        return jnp.split(amplitudes * jnp.sum(waves * wave, axis=(1, 2)), 4)

    def pose(t: Any) -> Any:
        moved, turn, _, _ = given(t)
        half = 0.5 * jnp.sqrt(jnp.sum(turn * turn) + 1e-20)
        h = jnp.concatenate([jnp.cos(half)[None], 0.5 * jnp.sin(half) / half * turn])
        return layout.get(middle, "p") + moved, quaternion_product(layout.get(middle, "h"), h)

    def state(t: Any) -> Any:
        (p, h), (p_t, h_t) = jax.jvp(pose, (t,), (1.0,))
        _, _, force, moment = given(t)
        R = rotation_matrix(h)
        spin = 2.0 * quaternion_product(h * np.array([1.0, -1.0, -1.0, -1.0]), h_t)[1:]
        values = dict(zip(OWN, (p, h, dot(R, force), dot(R, moment), dot(R.T, p_t), spin), strict=True))
        y = whole.rest(0.43 * length)[0]
        for name, value in values.items():
            y = whole.y_layout.replaced(y, (name,), value)
        return y

    dt = period / CYCLE

    def strains(t: Any, before: Any) -> Any:
        y, y_t = jax.jvp(state, (t,), (1.0,))
        c0 = 1.0 / dt
        history = semi_discrete.History(c0, y_t - c0 * y, -c0 * before, 0.0 * y)
        point = semi_discrete.Point(0.43 * length, 0.0, y, control, history)
        return point, y_t, semi_discrete.strains(whole, point)

    def step(before: Any, k: Any) -> Any:
        point, y_t, z = strains(k * dt, before)
        y = point.y
        R = rotation_matrix(whole.y_layout.get(y, "h"))
        force, moment = _wrench(bare, whole, point, z)
        tip_force, tip_moment = _point_load(bare, whole, y, y_t, control)
        q, w = (whole.y_layout.get(y, name) for name in ("q", "w"))
        load = jnp.sum(force * dot(R, q)) + jnp.sum(moment * dot(R, w))
        load_tip = jnp.sum(tip_force * dot(R, q)) + jnp.sum(tip_moment * dot(R, w))
        n, m = (dot(R.T, whole.y_layout.get(y, name)) for name in ("n", "m"))
        return z, (
            (load + load_tip / length) * dt,
            n,
            m,
            whole.z_layout.get(z, "v"),
            whole.z_layout.get(z, "u"),
        )

    start = whole.rest(0.43 * length)[1]
    _, (loads, n, m, v, u) = jax.lax.scan(step, start, jnp.arange(CYCLE * (BEFORE + 1) + 1))
    last = slice(-CYCLE - 1, None)
    taken = sum(
        jnp.sum(0.5 * (stress[last][1:] + stress[last][:-1]) * jnp.diff(strain[last], axis=0), axis=1)
        for stress, strain in ((n, v), (m, u))
    )
    elastic = _elastic(bare, n[last], m[last])
    return loads[last][1:] - (taken - elastic)


def _elastic(bare: Any, n: Any, m: Any) -> Any:
    """Return the work that the undamped rod without the part takes along the same stress."""
    total: Any = 0.0
    for stress, K in ((n, bare.Kse), (m, bare.Kbt)):
        strain = jax.vmap(lambda each, K=K: jnp.linalg.solve(K, each))(stress)
        total = total + jnp.sum(0.5 * (stress[1:] + stress[:-1]) * jnp.diff(strain, axis=0), axis=1)
    return total
