"""Export of a model as C code: a header, a source file, and an object file of the engine's machine code."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import hashlib
import importlib.metadata
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._reprs import robot_text
from knode_cosserat.engine.motions import Motions, coefficients_of
from knode_cosserat.engine.native import NativeCode
from knode_cosserat.engine.pattern import packed
from knode_cosserat.native.files import Exported, ExportError, filled
from knode_cosserat.native.fmu import Packer
from knode_cosserat.rods.aspects import Drawing, Ends
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.passport import Passport, without_passport
from knode_cosserat.rods.strands import in_strands
from knode_cosserat.rods.system import SEEN_TURN, System
from knode_cosserat.schemes.grid import turn_of_segments
from knode_cosserat.schemes.history import COARSE_ANGLE, COARSE_SHARE, StepCoefficients
from knode_cosserat.schemes.result import Result
from knode_cosserat.schemes.settings import Errors, NewtonOptions, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.schemes.time import TimeScheme
from knode_cosserat.solvers.guess import LARGEST_TURN, turning_ends
from knode_cosserat.solvers.initial import start_of
from knode_cosserat.solvers.run import InitialState
from knode_cosserat.solvers.simulate import checked_dt

#: files of an export, by their templates
FILES = {"robot.h": "{name}.h", "robot.c": "{name}.c", "CMakeLists.txt": "CMakeLists.txt"}
EXAMPLES = {"example.c": "example.c", "example.cpp": "example.cpp"}
#: names of other files, of targets of CMake, and of headers of C
TAKEN = {
    "example", "example_c", "example_cpp", "fmi2", "fmi3", "fmu", "m", "all", "clean", "edit_cache", "help",
    "install", "preinstall", "rebuild_cache", "alloca", "assert", "complex", "ctype", "endian", "errno",
    "features", "fenv", "float", "inttypes", "iso646", "limits", "locale", "math", "memory", "setjmp",
    "signal", "stdalign", "stdarg", "stdatomic", "stdbool", "stddef", "stdint", "stdio", "stdlib",
    "stdnoreturn", "string", "strings", "tgmath", "threads", "time", "uchar", "wchar", "wctype",
}  # fmt: skip
#: tangents side by side in the engine
COLUMNS = 8


def export(
    model: System,
    folder: str | Path,
    dt: float,
    *,
    name: str | None = None,
    target: str = "native",
    time: str | TimeScheme = "sdirk2",
    space: str | SpaceScheme = "lobatto2",
    newton: NewtonOptions = NewtonOptions(),
    errors: Errors = True,
    horizon: int = 20,
    fmi: str | None = None,
) -> Exported:
    """Write a model as C code that runs without Python: `NAME.h`, `NAME.c`, `NAME.o` and two examples.

    The steps are those of `simulate` with the same arguments. The header documents all functions. To a path
    that ends in `.fmu`, write a functional mock-up unit for co-simulation, which takes a C compiler.

    Args:
        model: one robot, or a learned model.
        folder: for the files, made if there is none; or the path of an FMU.
        dt: time step (s).
        name: prefix of all names of the code; that of the folder, or of the FMU, by default.
        target: the computer on which it runs: "native" (this one), "x86-64" (any), "x86-64-v3" (AVX2),
            "x86-64-v4" (AVX-512) or "aarch64" (ARM, 64 bit), all with Linux.
        time: scheme in time, as in `simulate`.
        space: scheme along the rod.
        newton: options of Newton's method.
        errors: which errors are estimated.
        horizon: most steps of one prediction with tangents.
        fmi: version of FMI of an FMU: "3.0", the default, or "2.0".

    Raises:
        ExportError: a batch, a model without positions, a name that C does not allow, a file; for an FMU, no
            C compiler.
        EngineError: the engine does not cover the model.
        SimulationError: the equilibrium in which it starts was not found.
        TargetError: an unknown target.
    """
    check_arguments(export, locals())
    if np.ndim(model.length):
        raise ExportError("export: the model is a batch; export one robot of it")
    if time in (None, "static"):
        raise ExportError(f"export: time is {time!r}; an exported robot moves, and has its equilibria too")
    if not 1 <= horizon <= 10_000:
        raise ExportError(f"export: horizon is {horizon}; allowed is 1 to 10000 steps")
    folder = Path(folder)
    if folder.suffix == ".fmu":
        packer = Packer.of(folder, "3.0" if fmi is None else fmi, target)
        name = _checked_name(name, folder.with_suffix(""))
        with tempfile.TemporaryDirectory() as scratch:
            exported = export(
                model, scratch, dt, name=name, target=target, time=time, space=space, newton=newton,
                errors=errors, horizon=horizon,
            )  # fmt: skip
            return packer.write(exported, model)
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"export: {folder} is a file; allowed is a folder, or a path that ends in .fmu")
    if fmi is not None:
        raise ExportError(f"export: fmi is for a path that ends in .fmu. Did you mean {folder}.fmu?")
    name = _checked_name(name, folder)
    settings = Settings.of(time, space, "consistent", newton, errors=errors)
    native = _NativeModel.of(model, settings, checked_dt(dt), name, target, horizon)
    values, content = native.values(), native.code.object_file(native.tables)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for source, pattern in (FILES | EXAMPLES).items():
        written.append(pattern.format(name=name))
        (folder / written[-1]).write_text(filled(source, values), encoding="utf-8")
    written.append(f"{name}.o")
    (folder / written[-1]).write_bytes(content)
    data = sum(each.nbytes for each in native.tables.values())
    return Exported(name, folder, tuple(written), len(content), data, values)


def _checked_name(name: str | None, folder: Path) -> str:
    given = name
    name = re.sub(r"\W", "_", folder.resolve().name) if name is None else name
    origin = "the last part of the path" if given is None else "name"
    if name in TAKEN:
        raise ExportError(
            f"export: {origin} is {name!r}, which another file or target has; give it another name, such as "
            f"{name}_robot"
        )
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ExportError(f"export: {origin} is {name!r}; allowed are letters, digits and _, a letter first")
    return name


@dataclasses.dataclass
class _NativeModel:
    """Code of a model, the state in which it starts, and the numbers that its C code needs."""

    code: NativeCode
    motions: Motions
    system: System
    start: InitialState
    dt: float
    target: str
    horizon: int
    passport: Passport | None

    @classmethod
    def of(
        cls, model: System, settings: Settings, dt: float, name: str, target: str, horizon: int
    ) -> _NativeModel:
        """Write the code, and find where the robot starts."""
        system = without_passport(model)
        code = NativeCode.of(system, settings, target, name)
        start = start_of(system, "equilibrium", settings, dt)
        steps = StepCoefficients.of(settings, dt, start.state.known(settings))
        history = jax.tree.map(lambda leaf: np.asarray(leaf)[None], start.state.history)
        motions = Motions(code.core, packed(system), history, steps)
        return cls(code, motions, system, start, dt, target, horizon, model.passport)

    @property
    def settings(self) -> Settings:
        """Schemes and options."""
        return self.motions.steps.settings

    @functools.cached_property
    def tables(self) -> dict[str, np.ndarray]:
        """Constants of the object file; memories before a run are numbers that are not zero, and where."""
        steps = self.motions.steps
        found: dict[str, np.ndarray] = {}
        memories = {"image": self.motions._memory, "tangent_image": self.code.tangents._empty_memory()}
        for name, memory in memories.items():
            words = memory.view(np.int64)
            found |= {f"{name}_at": np.flatnonzero(words), name: words[words != 0]}
        return found | {
            "parameters": np.asarray(packed(self.system), float),
            "motion": self.motions.motions[0],
            "table": coefficients_of(steps, (0, len(steps.table))),
            "guesses": np.asarray(self.code.core._guesses, float),
        }

    def values(self) -> dict[str, str]:
        """Return what the templates are filled with."""
        core, settings, system = self.code.core, self.settings, self.system
        name, described, today = self.code.name, robot_text(system), datetime.date.today()
        found = {
            "name": name, "NAME": name.upper(), "title": f"{name}: {described}", "description": described,
            "version": importlib.metadata.version("knode-cosserat"), "date": today.isoformat(),
            "dt": f"{self.dt:g}", "dt_exact": repr(self.dt), "space": settings.space.name,
            "scheme": settings.time.name if settings.time else "", "target": self.target,
            "rods": core.strands, "nodes": core.counts["nodes"], "controls": core.equations.nc,
            "horizon": self.horizon, "length": repr(float(system.length)),
        }  # fmt: skip
        found |= self._sizes() | self._places() | self._controls() | self._outcomes() | self._learned()
        digest = hashlib.sha256(repr(found).encode())
        for each in self.tables.values():
            digest.update(np.ascontiguousarray(each).tobytes())
        found["digest"] = f"0x{digest.hexdigest()[:16]}"
        return {key: str(value) for key, value in found.items()}

    def _sizes(self) -> dict[str, Any]:
        """Numbers of all arrays."""
        core, tangents, tables = self.code.core, self.code.tangents, self.tables
        e, nodes = core.equations, core.counts["nodes"]
        (motion, _), (shape, _) = core.states
        _, stages, width = tables["table"].shape
        numbers, blocks = core.strands * e.numbers, max(1, -(-e.nc // COLUMNS))
        columns, most = blocks * COLUMNS, self.horizon * stages
        of_solution = (e.nc + 1 + e.k + 1 + nodes * numbers) * (1 + columns) + width
        return {
            "stages": stages, "table_rows": len(tables["table"]), "table_width": width,
            "numbers": numbers, "unknowns": e.k, "motion": motion, "shape": shape,
            "results": stages * (nodes * numbers + 8 + e.k) + 2, "memory": core._size,
            "image": len(tables["image"]), "tangent_image": len(tables["tangent_image"]),
            "tangent_memory": tangents._size, "tangent_states": blocks * tangents.state_size,
            "tangent_numbers": most * of_solution, "columns": columns,
            "parameters": max(1, len(tables["parameters"])), "saved": 8 + e.nc + motion,
        }  # fmt: skip

    def _places(self) -> dict[str, Any]:
        """Places of numbers in a motion and in memories."""
        core, tangents = self.code.core, self.code.tangents
        e, counts = core.equations, core.counts
        records, _, past, _, time, *_ = core.states[0][1]
        (shape,) = core.states[1][1][0]
        assert (shape.component, core._size_of(shape)) == (past[0].component, core._size_of(past[0]))
        strand, (rod, at) = e.strand, self._tip()
        points = [counts[f"base {q}"] + int(node) for q in range(core.strands) for node in counts.grid.nodes]
        own, other = [*records], tangents.records[: len(records)]
        order = tangents.packed[:, : e.numbers].ravel()
        return {
            "y_at": past[0].offset, "y_apart": past[0].component, "y_size": e.ny,
            "record_at": records[0].offset, "record_apart": records[0].component,
            "records": len(records), "record_rows": e.numbers, "used": counts["used"],
            "history_at": core.H.offset, "history_size": core.H.size * core.H.component,
            "time_at": time[0].offset, "memory_time_at": core.t0.offset, "points": _listed(points),
            "order": _listed(order), "tip_rod": rod, "position": at, "length_at": _length_at(self.system),
            "orientation": _first(strand.y_layout, "h"), "force": _first(strand.y_layout, "n"),
            "moment": _first(strand.y_layout, "m"), "stretch": _stretch(strand),
            "records_at": _listed(each.offset for each in own),
            "records_apart": _listed(each.component for each in own),
            "tangent_records_at": _listed(each.offset for each in other),
            "tangent_records_apart": _listed(each.component for each in other),
            "tangent_parameters_at": tangents.params.offset,
            "between": "cubic interpolation" if _first(strand.y_layout, "h") >= 0 else "lines",
        }  # fmt: skip

    def _tip(self) -> tuple[int, int]:
        """Return the rod whose last node is the tip, and the first number of its position in y."""
        system, strand = self.system, self.code.core.equations.strand
        y = np.asarray(self.start.record)[:, : system.y_layout.size]
        y = y + 1e-3 * np.random.default_rng(0).normal(size=y.shape)
        drawn = np.asarray(Drawing.of(system).positions(y))
        for rod, own in enumerate(np.moveaxis(in_strands(system, y), 1, 0)):
            for places in strand.y_layout.ranges("p"):
                if drawn.shape == (len(y), 3) and np.array_equal(own[-1, places], drawn[-1]):
                    return rod, places.start
        raise ExportError(
            f"export: the tip of {robot_text(system)} is no node of a rod; models of rods with a position p "
            "can be exported"
        )

    def _controls(self) -> dict[str, Any]:
        """Names, limits and kinds of the controls."""
        layout = self.system.control_layout
        fields = [field for field in layout.fields for _ in range(field.size)]
        lines = [
            f" * {k}: {label} ({field.unit}){_range_text(field)}: {field.meaning}"
            for k, (label, field) in enumerate(zip(layout.labels, fields, strict=True))
        ]
        turning = turning_ends(self.system)
        return {
            "control_table": "\n".join(lines or [" * none"]),
            "largest_turn": LARGEST_TURN,
            "low": _listed([*(_limit(field.low) for field in fields), "0.0"]),
            "high": _listed([*(_limit(field.high) for field in fields), "0.0"]),
            "moves": _listed([*map(int, layout.moving), 0]),
            "turns": len(turning),
            "turning": _listed(
                "{" + _listed([*columns, -1, -1][:3]) + "}" for columns in [*turning, [-1, -1, -1]]
            ),
            "parameter_table": "\n".join(_parameter_lines(self.system)),
        }

    def _outcomes(self) -> dict[str, Any]:
        """Judgement of results, and the start."""
        settings, core = self.settings, self.code.core
        unseen = turn_of_segments(self.system) > SEEN_TURN
        start = max(int(self.start.result), int(Result.COARSE) * unseen)
        return {
            "start_result": int(start > 0), "unseen": int(unseen), "estimates": settings.estimates,
            "judges": int(bool(settings.errors)), "has_time_error": int(bool(core.time_defect)),
            "coarse_share": COARSE_SHARE, "coarse_angle": COARSE_ANGLE,
            "acceptable": settings.newton.acceptable,
            "ends": _listed(repr(float(end)) for end in np.reshape(self.motions.steps.ends, -1)),
            "start": "in equilibrium" if Ends.of(self.system).held else "unstressed: nothing holds it",
        }  # fmt: skip

    def _learned(self) -> dict[str, Any]:
        """Limits of controls and strains within which the model was learned, and from what."""
        system, passport, found = self.system, self.passport, dict[str, Any]()
        layouts = {"controls": system.control_layout, "strains": system.z_layout}
        for part, layout in layouts.items():
            low, high = np.full((2, layout.size), np.inf) * [[-1.0], [1.0]]
            if passport is not None:
                low, high = passport.limits(part, layout)
            for name, ends in (("low", low), ("high", high)):
                found[f"{part}_{name}"] = _listed([*map(_limit, ends), "0.0"])
        text = "The model states no recordings from which it was learned." if passport is None else passport
        return found | {
            "strains": system.z_layout.size // self.code.core.strands,
            "passport": "\n".join(f" * {line}".rstrip() for line in str(text).replace("*/", "").splitlines()),
        }


def _range_text(field: Field) -> str:
    """Return the limits of a control, those that are finite."""
    low, high = (f"{end:g}" if np.isfinite(end) else "" for end in (field.low, field.high))
    return f", {low or 'any'} to {high or 'any'}" if low or high else ""


def _listed(values: Iterable[Any]) -> str:
    return ", ".join(map(str, values))


def _limit(value: float) -> str:
    """Return a limit of a control; an infinite number is beyond it."""
    most = float(np.finfo(float).max)
    return repr(float(np.clip(value, -most, most)))


def _first(layout: Layout, name: str) -> int:
    """Return the first number of a field; -1 if there is none."""
    return layout.slice(name).start if name in layout.names else -1


def _stretch(strand: System) -> int:
    """Return the first number of the strains v in a record; -1 if there is none."""
    own = _first(strand.z_layout, "v")
    return -1 if own < 0 else strand.y_layout.size + own


def _length_at(system: System) -> int:
    """Return the place of the length in the parameters; -1 if none is that of the whole system."""
    at = 0
    for path, leaf in jax.tree_util.tree_flatten_with_path(system)[0]:
        name = jax.tree_util.keystr(path).rpartition(".")[2]
        if name == "length" and np.size(leaf) == 1 and float(leaf) == float(system.length):
            return at
        at += np.size(leaf)
    return -1


def _parameter_lines(system: System) -> Iterator[str]:
    """Yield a line for each parameter: its place, name and value."""
    at = 0
    for path, leaf in jax.tree_util.tree_flatten_with_path(system)[0]:
        size, name = np.size(leaf), jax.tree_util.keystr(path).lstrip(".")
        where = f"{at}" if size == 1 else f"{at} to {at + size - 1}"
        shown = f" = {float(np.reshape(leaf, -1)[0]):.6g}" if size == 1 else f" {np.shape(leaf)}"
        if size:
            yield f" *   {where}: {name}{shown}"
        at += size
