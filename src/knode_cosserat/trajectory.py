"""Result of a simulation, states over time with the result of each step, and its file.

`Trajectory.save` writes a `container`, which any netCDF tool reads: every field of y, z and the controls is a
variable under its own name, with unit and meaning, over the dimensions (batch,) time, node and component. The
robot is an attribute, as the text of a robot file; settings and states of the solver are in the facts. Arrays
are stored exactly. Reading runs no code from the file.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat._reprs import count_of, quantity
from knode_cosserat.errors import KnodeCosseratError, first_line
from knode_cosserat.io import container
from knode_cosserat.io.container import ContainerError, Variable
from knode_cosserat.rods import robot_file
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import Parameter, ParameterError, names_of, parameters_of, slots_of
from knode_cosserat.rods.passport import compared_numbers, named
from knode_cosserat.rods.strands import strand_count
from knode_cosserat.rods.system import ChosenNodes, System, array_module, is_traced, nodes_text
from knode_cosserat.schemes.history import CONSTANT, GUESS_STATES, SolverState, StateHistory
from knode_cosserat.schemes.result import Result, ResultCodes, Verdict, VerdictCodes
from knode_cosserat.schemes.settings import Settings


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """A system's states at T times and N nodes; every array may have a leading batch axis.

    Row 0 is the initial state. Controls have one convention in this package: `held_control` and
    `held_tension` of row k act from row k to row k + 1, here, in `Measurements` and in files. `control` is
    the control in each row's own equations, which acted up to that row. Rows that were not solved are NaN;
    `result` says why. A pytree: it can be returned from a jitted function.

    The last three fields are states of the solver, from which a motion continues exactly. Defaults are no
    attributes of the class: fields may be deferred.
    """

    system: System
    #: numerical settings, or None for measured states
    settings: Settings | None = dataclasses.field(metadata=CONSTANT)
    time: Float[Any, " T"]
    y: Float[Any, "*batch T N y"]
    z: Float[Any, "*batch T N z"]
    #: control in the row's equations: row i's acted from row i - 1 to i, row 0's before; see `held_control`
    control: Float[Any, "*batch T c"]
    #: a `Result` for each row
    result: Int[Any, "*batch T"]
    #: largest residual in natural units
    residual: Float[Any, "*batch T"]
    iterations: Int[Any, "*batch T"]
    #: estimated discretisation error of positions along the rod (m), the largest over the nodes; NaN: unknown
    position_error: Any = dataclasses.field(default_factory=type(None))
    #: estimated error of positions (m) by the time steps, the largest over the nodes; NaN or None: unknown
    time_error: Any = dataclasses.field(default_factory=type(None))
    #: True in rows outside the training range of a learned or identified model; None if unknown
    extrapolated: Any = dataclasses.field(default_factory=type(None))
    #: a `Verdict` for each row of equilibria: stable, unstable or not tested; None for motions
    stability: Any = dataclasses.field(default_factory=type(None))
    #: True if intermediate rows were left out: the controls held there are not known
    thinned: bool = dataclasses.field(default_factory=bool, metadata=CONSTANT)

    # states of the solver

    #: state of the solver in row 0 of a motion; None for equilibria, and where it is unknown
    initial_state: SolverState | None = dataclasses.field(default_factory=type(None))
    #: state of the solver in the last row, from which a motion continues exactly; None as for `initial_state`
    final_state: SolverState | None = dataclasses.field(default_factory=type(None))
    #: states y, z (and y_s, where rows have it) at the stages of the time scheme before each row, which its
    #: history needs: (*batch, T, stages - 1, N, x); None for schemes of one stage, and where they are unknown
    stages: Any = dataclasses.field(default_factory=type(None))

    def __post_init__(self) -> None:
        object.__setattr__(self, "result", ResultCodes.of(self.result))
        object.__setattr__(self, "stability", VerdictCodes.of(self.stability))

    @classmethod
    def deferred(cls, fields: Callable[[], dict[str, Any]]) -> Self:
        """Return a trajectory whose fields are computed when one of them is first used."""
        found = object.__new__(cls)
        found.__dict__["_deferred"] = fields
        return found

    def __getattr__(self, name: str) -> Any:
        deferred = self.__dict__.get("_deferred")
        if deferred is not None:
            self.__dict__.update(deferred())
            self.__dict__.pop("_deferred", None)
        return object.__getattribute__(self, name)

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    # named parts

    @property
    def state(self) -> Any:
        """The packed states y (…, T, N, y)."""
        return self.y

    @property
    def position(self) -> Any:
        """Positions (…, T, N, 3) in m, global frame."""
        return Drawing.of(self.system).positions(self.y)

    @property
    def quaternion(self) -> Any:
        """Orientations (…, T, N, 4), scalar first."""
        return Drawing.of(self.system).quaternions(self.y)

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
        numeric = array_module(self.control)
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

        For several rods `n2` is the field of a platform's second leg, `thumb_n` that of a rod of an assembly,
        and `n` stacks all of them, bodies last, (…, T, N, rods, size).
        """
        count, known = strand_count(self.system), []
        for layout, packed in self._layouts():
            if name in layout.names:
                return layout.get(packed, name)
            known += layout.names
            rods = tuple(f"{name}{k + 1}" for k in range(count))
            # as many numbered fields as there are rods, or one after the name of each rod
            if not set(rods) <= set(layout.names) or f"{name}{count + 1}" in layout.names:
                rods = tuple(each for each in layout.names if each.endswith(f"_{name}"))
            if len(rods) > 1 and len({field.size for field in layout.fields if field.name in rods}) == 1:
                every = packed[..., layout.indices(rods)]
                return every.reshape(*every.shape[:-1], len(rods), -1)
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
    def base_wrench(self) -> Any:
        """Force (N) and moment (N·m) of the rod on its base, about the base point, global frame (…, T, 6).

        A sensor between the rod with its motors and the body that carries them measures it, plus the weight
        and inertia of the motors: the pull of routed tendons at the base is part of n and m. The force per
        length of a `TendonRobot` has no reaction there. With several rods it is (…, T, rods, 6).
        """
        return self._base_wrench(self.y)

    @property
    def mean_base_wrench(self) -> Any:
        """Mean of the wrench on the base over the step before each row, whose impulse is dt times it.

        It is of the order of the time scheme. In a row itself, a moving base has the acceleration of the
        step's middle. For schemes of one stage, and in a first row, it is `base_wrench`.
        """
        if self.stages is None or self.settings is None:
            return self.base_wrench
        numeric, ny = array_module(self.y), self.y.shape[-1]
        *first, last = getattr(self.settings.time, "tableau", ((1.0,),))[-1]
        wrench = self.base_wrench
        mean = last * wrench
        for k, weight in enumerate(first):
            mean = mean + weight * self._base_wrench(self.stages[..., k, :, :ny])
        return numeric.where(numeric.isnan(mean), wrench, mean)

    def _base_wrench(self, y: Any) -> Any:
        """Return n and m at the base of states y (…, N, y)."""
        layout = self.system.y_layout
        if {"n", "m"} <= set(layout.names):
            parts = [layout.get(y[..., 0, :], name) for name in "nm"]
        else:
            several = dataclasses.replace(self, y=y)
            parts = [several.part(name)[..., 0, :, :] for name in "nm"]
        return array_module(y).concatenate(parts, axis=-1)

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
        """Message on the rows in which the model extrapolates, and how far; empty if there are none."""
        if self.extrapolated is None or not np.any(self.extrapolated):
            return ""
        rows = np.asarray(self.extrapolated)
        first = float(np.asarray(self.time)[int(np.argmax(rows.reshape(-1, rows.shape[-1]).any(axis=0)))])
        words = f"{np.count_nonzero(rows)} of {rows.size} rows are outside what the model learned from"
        return f"{words}, first at {first:g} s" + f": {self.farthest}" * bool(self.farthest)

    @property
    def farthest(self) -> str:
        """Controls and strains that leave the range that the model learned from, in words; may be empty."""
        passport = self.system.passport
        return "" if passport is None else named(passport.excesses(self.system, **compared_numbers(self)))

    @property
    def verdict(self) -> str:
        """Line on the stability of equilibria, with the reason if it was not tested; empty for motions."""
        if self.stability is None:
            return ""
        codes, counts = np.unique(np.asarray(self.stability), return_counts=True)
        said = [Verdict(int(code)).message for code in codes]
        if len(said) == 1:
            return said[0]
        return "; ".join(f"{n} {words}" for n, words in zip(counts, said, strict=True))

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
        lines += [self.verdict] if self.verdict else []
        lines += self._tip_text()
        errors = [
            f"{where} {1e3 * np.nanmax(error):.2g} mm"
            for where, error in (("along the rod", self.position_error), ("in time", self.time_error))
            if error is not None and np.any(np.isfinite(error))
        ]
        if isinstance(self.system.nodes, ChosenNodes):
            lines.append(nodes_text(self.system))
        if self.settings is not None and not self.settings.errors:
            lines.append("errors not estimated")
        elif errors and self.position_error is not None:
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
            tip = np.asarray(Drawing.of(self.system).positions(np.asarray(self.y)[solved[-1], -1]))
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
        optional = ("position_error", "time_error", "extrapolated", "stability", "stages")
        fields += tuple(name for name in optional if getattr(self, name) is not None)
        picked: dict[str, Any] = {name: getattr(self, name)[index] for name in fields}
        time = self.time if self.y.ndim == 4 else self.time[index]
        system = self.system
        if np.ndim(system.length):
            system = _pick(system, index)
        initial, final, thinned = self.initial_state, self.final_state, self.thinned
        if self.y.ndim == 4:
            initial, final = _pick((initial, final), index)
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

    def save(self, path: str | Path) -> None:
        """Write a labelled netCDF-4 file that `load_trajectory` reads back equal.

        The file is written completely or not at all. For a system that no file can describe, the states are
        still written, and `load_trajectory` needs the system as an argument.

        Raises:
            TrajectoryFileError: the arrays do not fit together, or the file cannot be written.
        """
        with KIND.naming(path):
            content = _encode(self)
        container.write(path, content, KIND)


def _pick(tree: Any, index: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


# files


class TrajectoryFileError(KnodeCosseratError, ValueError):
    """A trajectory's file cannot be read or written; the message is one line with the reason."""

    code = "trajectory-file"


KIND = container.Kind("knode-cosserat trajectory", 1, TrajectoryFileError)
#: prefix of a parameter's name if each robot of a batch has its own value
PARAMETER = "robot_"
_STATES: dict[str, type] = {"SolverState": SolverState, "StateHistory": StateHistory}
#: variables with one number in each row: name, unit, meaning; the first three are always there
_ROWS = {
    "result": ("1", "how the step ended; below zero: not solved"),
    "residual": ("1", "largest residual, in natural units"),
    "iterations": ("1", "Newton corrections"),
    "position_error": ("m", "estimated discretisation error of positions, the largest over the nodes"),
    "time_error": ("m", "estimated error of positions by the time steps, the largest over the nodes"),
    "extrapolated": ("1", "1 in rows outside the range that the model learned from"),
    "stability": ("1", "stability of an equilibrium; below zero: not tested"),
}
_CODES = {"result": Result, "stability": Verdict}
_HINT = "give it, load_trajectory(path, system=…)"


def _encode(trajectory: Trajectory) -> bytes:
    """Return the bytes of a trajectory's file."""
    system = trajectory.system
    _require_names(system)
    batch = ("batch",) if np.ndim(trajectory.y) == 4 else ()
    rows = (*batch, "time")
    arclength = np.asarray(trajectory.arclength)
    nodes = (*batch, "node")[-arclength.ndim :]
    variables = {
        "time": Variable(trajectory.time, ("time",), _label("s", "time")),
        "arclength": Variable(arclength, nodes, _label("m", "arclength of the nodes")),
    }
    for k, (layout, packed) in enumerate(trajectory._layouts()):
        control = k == 2
        for field in layout.fields:
            component, names = f"{field.name}_index", np.arange(1, field.size + 1)
            if field.name == "h" and field.size == 4:
                component, names = "quaternion", np.array(["w", "x", "y", "z"])
            elif field.size == 3 and not control:
                component, names = "axis", np.array(["x", "y", "z"])
            variables[component] = Variable(names, (component,))
            label = _label(field.unit, field.meaning)
            label |= {"comment": _ACTED} if control else {"coordinates": "arclength"}
            dimensions = (*rows, component) if control else (*rows, "node", component)
            variables[field.name] = Variable(layout.get(np.asarray(packed), field.name), dimensions, label)
    for name, (unit, meaning) in _ROWS.items():
        if getattr(trajectory, name) is not None:
            values = np.asarray(getattr(trajectory, name))
            label = _label(unit, meaning)
            if name in _CODES:  # by the CF conventions
                label["flag_values"] = np.array([int(code) for code in _CODES[name]], values.dtype)
                label["flag_meanings"] = " ".join(code.name.lower() for code in _CODES[name])
            values = values.astype(np.int8) if values.dtype.kind == "b" else values
            variables[name] = Variable(values, rows, label)
    facts: dict[str, Any] = {
        "settings": None if trajectory.settings is None else trajectory.settings.described(),
        "thinned": trajectory.thinned,
        **{name: getattr(trajectory, name) for name in ("initial_state", "final_state", "stages")},
    }
    attributes = {
        "title": f"Trajectory of a {type(system).__name__}",
        "comment": "Row 0 is the initial state, row i the state after control i; NaN if not solved.",
        "system": type(system).__name__,
    }
    many = np.ndim(system.length) > 0
    robots: list[Any] = [_pick(system, i) for i in range(len(system.length))] if many else [system]
    try:
        if type(system) in robot_file.KINDS.values():
            attributes["robot"] = robot_file.format_robot(robots[0])
            variables |= _parameters(system) if many else {}
        elif hasattr(system, "to_bytes"):
            parts = [np.frombuffer(robot.to_bytes(), np.uint8) for robot in robots]
            facts["model"] = parts if many else parts[0]
    except ValueError as error:  # a part is a Python function, for example
        facts["system_missing"] = first_line(error)
    return container.encode(KIND, facts, variables=variables, attributes=attributes, classes=_STATES)


#: comment on each control about its interval
_ACTED = "row i acted from row i - 1 to row i; row 0 before the motion"


def _label(unit: str, meaning: str) -> dict[str, Any]:
    return {"units": unit, "long_name": meaning}


def _require_names(system: System) -> None:
    """Raise `ContainerError` unless every field's name can be a variable's name."""
    used = {"time", "node", "batch", "arclength", "axis", "quaternion", "arrays", *_ROWS}
    for layout in (system.y_layout, system.z_layout, system.control_layout):
        for name in layout.names:
            if name in used or "/" in name or name.startswith(PARAMETER) or name.endswith("_index"):
                raise ContainerError(
                    f"a {type(system).__name__} has a field {name!r}; in a file that name is taken, by "
                    "another field or otherwise, or impossible"
                )
            used.add(name)


def _parameters(system: System) -> dict[str, Variable]:
    """Return the parameters of a batch of robots, and of their parts, as variables."""
    variables = {}
    for name, parameter, values in _numbers(system):
        dimensions = ("batch", *(f"{PARAMETER}{name}_{k}" for k in range(1, np.ndim(values))))
        variables[PARAMETER + name] = Variable(values, dimensions, _label(parameter.unit, parameter.meaning))
    return variables


def _numbers(owner: Any, before: str = "") -> Iterator[tuple[str, Parameter, Any]]:
    """Yield every parameter that is set, of a robot and its parts: name for `System.replace`, and value.

    Places are left out: they are equal for all robots of a batch.
    """
    fixed = {field.name for field in dataclasses.fields(owner) if field.metadata.get("static")}
    for name, parameter in parameters_of(type(owner)).items():
        value = getattr(owner, name)
        if value is not None and name not in fixed:
            yield before + name, parameter, value
    for name in slots_of(type(owner)):
        parts = getattr(owner, name)
        several = isinstance(parts, tuple)
        for own, part in zip(names_of(parts), parts, strict=True) if several else [("", parts)]:
            if part is not None:
                yield from _numbers(part, f"{before}{name}.{own}." if several else f"{before}{name}.")


def load_trajectory(
    path: str | Path,
    *,
    system: System | None = None,
    readers: Mapping[str, Callable[[bytes], System]] | None = None,
) -> Trajectory:
    """Read a trajectory that `Trajectory.save` wrote.

    Args:
        path: the file.
        system: the trajectory's system. Only needed for a system that no file can describe, such as one of a
            user's class.
        readers: for names of classes without a robot file, the function that makes a system from the bytes
            of its method `to_bytes`.

    Raises:
        TrajectoryFileError: the file cannot be read, is not a trajectory, or has invalid contents.
    """
    content = container.read(path, KIND, _STATES)
    with KIND.naming(path):
        return _trajectory(content, _system(content, readers or {}) if system is None else system)


def _trajectory(content: container.Content, system: System) -> Trajectory:
    time, rows = content.values("time"), content.values("result").shape
    nodes = content.values("arclength").shape[-1:]

    def packed(layout: Layout, along: tuple[int, ...]) -> np.ndarray:
        fields = [content.values(field.name, (*rows, *along, field.size)) for field in layout.fields]
        return np.concatenate(fields, axis=-1) if fields else np.zeros((*rows, *along, 0))

    y, z = packed(system.y_layout, nodes), packed(system.z_layout, nodes)
    numbers: dict[str, Any] = {
        name: content.values(name, rows) for k, name in enumerate(_ROWS) if k < 3 or name in content.variables
    }
    if "extrapolated" in numbers:
        numbers["extrapolated"] = numbers["extrapolated"].astype(bool)
    _require_possible(time, numbers, y)
    described = content.fact("settings", dict | None)
    try:
        settings = None if described is None else Settings.from_description(described)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ContainerError(f"'settings' is not understood: {first_line(error)}") from None
    states = {name: content.fact(name, SolverState | None) for name in ("initial_state", "final_state")}
    memory = 2 if settings is None else settings.memory
    for name, state in states.items():
        history = state.history if state is not None else None
        if history is not None and not (
            isinstance(history, StateHistory)
            and np.shape(history.t0) == rows[:-1]
            and np.shape(history.records)[:-2] == (*rows[:-1], memory)
            and np.shape(history.y)[:-2] == (*rows[:-1], GUESS_STATES)
        ):
            raise ContainerError(f"{name!r} is no state of the solver of these rows")
    stages = content.fact("stages", np.ndarray | None)
    thinned, control = content.fact("thinned", bool), packed(system.control_layout, ())
    return Trajectory(
        system, settings, time, y, z, control, **numbers, **states, stages=stages, thinned=thinned
    )


def _require_possible(time: np.ndarray, numbers: Mapping[str, np.ndarray], y: np.ndarray) -> None:
    """Raise `ContainerError` if rows contradict each other, as those of no simulation do."""
    result, residual = numbers["result"], numbers["residual"]
    solved, unknown = result >= 0, np.setdiff1d(result, [int(code) for code in Result])
    for wrong, reason in (
        (time.shape != result.shape[-1:], "it has another number of times than of rows"),
        (not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0.0), "its times do not increase"),
        (unknown.size, f"it has the result code {', '.join(map(str, unknown[:1]))}"),
        (not np.all(np.isfinite(y[solved])), "a solved row has a state that is not finite"),
        (not np.all(np.isfinite(residual[solved])), "a solved row has a residual that is not finite"),
        (
            not set(numbers.get("stability", np.zeros(0)).ravel().tolist()) <= set(map(int, Verdict)),
            "it has an unknown code of stability",
        ),
        (np.any(numbers["iterations"] < 0), "a number of iterations is negative"),
    ):
        if wrong:
            raise ContainerError(f"not a trajectory that a simulation wrote: {reason}")


def _system(content: container.Content, readers: Mapping[str, Callable[[bytes], System]]) -> System:
    """Return the robot, or the batch of robots, that a file describes."""
    name, text = str(content.attributes.get("system", "class unknown")), content.attributes.get("robot")
    if text is not None:
        return _robots(content, str(text))
    if "model" not in content.facts:
        missing = content.facts.get("system_missing")
        reason = f" ({missing})" if missing else ""
        raise ContainerError(f"the file does not describe its system, a {name}{reason}: {_HINT}")
    if name not in readers:
        raise ContainerError(f"there is no reader of its system, a {name}: {_HINT}")
    parts = content.fact("model", np.ndarray | list)
    try:
        if isinstance(parts, np.ndarray):
            return readers[name](parts.tobytes())
        systems = [readers[name](np.asarray(part).tobytes()) for part in parts]
        return jax.tree.map(lambda *leaves: np.stack(leaves), *systems)
    except (TypeError, ValueError) as error:
        raise ContainerError(f"its system, a {name}: {first_line(error)}; or {_HINT}") from None


def _robots(content: container.Content, text: str) -> System:
    try:
        robot = robot_file.parse_robot(text, "attribute 'robot'")
        if not any(name.startswith(PARAMETER) for name in content.variables):
            return robot
        count = len(content.values("result"))
        values = {
            name: content.values(PARAMETER + name, (count, *np.shape(value)))
            for name, _, value in _numbers(robot)
        }
        robots = [robot.replace(**{name: many[i] for name, many in values.items()}) for i in range(count)]
    except robot_file.RobotFileError as error:
        raise ContainerError(str(error)) from None
    except ParameterError as error:
        raise ContainerError(f"a robot of the batch is not possible: {error}") from None
    return jax.tree.map(lambda *leaves: np.stack(leaves), *robots)
