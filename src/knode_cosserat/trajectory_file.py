"""Trajectories as labelled netCDF files.

Every field of y, z and the controls is a variable under its own name, with unit and meaning, over the
dimensions (batch,) time, node and component. The robot is an attribute, as the text of a robot file. The
settings are an attribute too, as JSON. `trajectory_system` handles other systems. Arrays are stored exactly.
Reading runs no code from the file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat._files.json_text import parse_json
from knode_cosserat._files.limits import LimitSettingError
from knode_cosserat._files.netcdf import netcdf_in_memory
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat._registry import provide
from knode_cosserat.errors import first_line
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import GUESS_STATES, SolverState, StateHistory
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.trajectory_integrity import (
    CHECKSUM,
    add_checksum,
    checksum,
    require_own_data,
    require_possible,
    require_readable,
    seal,
)  # fmt: skip
from knode_cosserat.trajectory_system import (
    BYTES,
    PARAMETER,
    SIZES,
    TrajectoryFileError,
    described,
    labels,
    system_of,
    values_of,
)

if TYPE_CHECKING:
    import xarray

FORMAT = "knode-cosserat trajectory"
#: the version that is written, and those that are read; from 2 on files have a checksum
VERSION, READ = 2, (1, 2)

#: variables with one number in each row: name, unit and meaning
_ROWS = (
    ("result", "1", "how the step ended; below zero: not solved"),
    ("residual", "1", "largest residual, in natural units"),
    ("iterations", "1", "Newton corrections"),
)
_ERROR = ("position_error", "m", "estimated discretisation error of positions, the largest over the nodes")
_TIME_ERROR = (
    "time_error",
    "m",
    "estimated error of positions by the time steps, the largest over the nodes",
)
_OUTSIDE = ("extrapolated", "1", "1 in rows outside the range that the model was trained in")
_STAGES = (
    "stages",
    ("stage", "node", "stage_number"),
    "states at the stages of the time scheme before each row",
)
#: solver states of a motion (`SolverState`): name in the file, attribute, and text
_STATES = (
    ("initial_history", "initial_state", "state of the solver in row 0"),
    ("final_history", "final_state", "state of the solver in the last row"),
)
#: further variables of a solver's state: suffix, dimensions, and text; the first has both states and the rate
_STATE_PARTS = (
    (
        "",
        ("history_state", "history_place", "history_number"),
        "newest state, the one before it, newest rate",
    ),
    ("_error", ("history_state", "history_used", "history_number"), "discretisation errors of these"),
    ("_time_error", ("history_record", "history_used", "history_number"), "errors in time of both states"),
    ("_guess", ("history_guess", "history_point", "history_y"), "y of earlier states, for the first guess"),
    ("_weights", ("history_guess",), "weights of these in the first guess"),
    (
        "_time",
        ("history_time",),
        "time (s), time step (s; NaN: all states alike), 1 if rate is known, number of different states",
    ),
)
#: comment on each control about its interval; attribute for omitted intermediate rows
_ACTED = "row i acted from row i - 1 to row i; row 0 before the motion"
_THINNED = "rows_left_out"

# writing


def save(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory as a labelled netCDF-4 file that `load_trajectory` reads back equal.

    The file is written completely or not at all. For a system that no file can describe, the states are
    still written, and `load_trajectory` needs the system as an argument.

    Raises:
        TrajectoryFileError: the arrays do not fit together, or the file cannot be written.
    """
    path = Path(path)
    data = _dataset(trajectory, str(path))
    # by default xarray declares NaN as "missing", but here `result` gives its meaning
    plain = {name: {"_FillValue": None} for name in data.variables}
    file = netcdf_in_memory(data, encoding=plain)
    with _opened(file) as written:
        add_checksum(file, checksum(written.load()))
    content = file.getvalue()
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(content + seal(content))
    except OSError as error:
        raise TrajectoryFileError(
            f"{path}: cannot be written: {error.strerror or first_line(error)}"
        ) from None


provide(Trajectory, "save", save)


def _dataset(trajectory: Trajectory, source: str) -> xarray.Dataset:
    import xarray

    system = trajectory.system
    _require_names(system, source)
    batch = ("batch",) if np.ndim(trajectory.y) == 4 else ()
    rows = (*batch, "time")
    arclength = np.asarray(trajectory.arclength)
    coordinates: dict[str, Any] = {
        "time": ("time", np.asarray(trajectory.time), labels("s", "time")),
        "arclength": ((*batch, "node")[-arclength.ndim :], arclength, labels("m", "arclength of the nodes")),
    }
    variables: dict[str, Any] = {}
    for layout, along, packed in zip(_layouts(system), _ALONG, _packed(trajectory), strict=True):
        for field in layout.fields:
            component, names = _component(field, layout is system.control_layout)
            coordinates[component] = (component, names)
            values = layout.get(packed, field.name)
            said = labels(field.unit, field.meaning)
            if layout is system.control_layout:
                said |= {"comment": _ACTED}
            variables[field.name] = ((*rows, *along, component), values, said)
    for name, unit, meaning in _ROWS:
        variables[name] = (rows, np.asarray(getattr(trajectory, name)), labels(unit, meaning))
    for name, unit, meaning in (_ERROR, _TIME_ERROR):
        if getattr(trajectory, name) is not None:
            variables[name] = (rows, np.asarray(getattr(trajectory, name)), labels(unit, meaning))
    if trajectory.extrapolated is not None:
        name, unit, meaning = _OUTSIDE
        marks = np.asarray(trajectory.extrapolated).astype(np.int8)
        variables[name] = (rows, marks, labels(unit, meaning))
    if trajectory.stages is not None:
        name, along, text = _STAGES
        variables[name] = (*rows, *along), np.asarray(trajectory.stages), {"long_name": text}
    variables["result"][2].update(_flags(variables["result"][1].dtype))
    for name, attribute, text in _STATES:
        state = getattr(trajectory, attribute)
        parts = () if state is None else _state_arrays(state)
        for (suffix, along, meaning), values in zip(_STATE_PARTS, parts, strict=False):
            variables[name + suffix] = (*batch, *along), values, {"long_name": f"{text}: {meaning}"}
    texts, more = described(system)
    try:
        return xarray.Dataset(variables | more, coordinates, _attributes(trajectory, source) | texts)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise TrajectoryFileError(
            f"{source}: the trajectory's arrays do not fit together: {reason}"
        ) from None


#: dimensions of y, z and the controls besides time
_ALONG: tuple[tuple[str, ...], ...] = (("node",), ("node",), ())


def _layouts(system: System) -> tuple[Layout, Layout, Layout]:
    return system.y_layout, system.z_layout, system.control_layout


def _packed(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.asarray(trajectory.y), np.asarray(trajectory.z), np.asarray(trajectory.control)


def _component(field: Field, control: bool) -> tuple[str, list[Any]]:
    """Return the last dimension of a field's variable: its name, and the labels of its components."""
    if field.name == "h" and field.size == 4:
        return "quaternion", ["w", "x", "y", "z"]
    if field.size == 3 and not control:
        return "axis", ["x", "y", "z"]
    return f"{field.name}_index", list(range(1, field.size + 1))


def _flags(dtype: np.dtype) -> dict[str, Any]:
    """Return the attributes of the result codes, by the CF conventions."""
    return {
        "flag_values": np.array([int(result) for result in Result], dtype=dtype),
        "flag_meanings": " ".join(result.name.lower() for result in Result),
    }


def _require_names(system: System, source: str) -> None:
    """Raise `TrajectoryFileError` unless every field's name can be a variable's name."""
    names = [field.name for layout in _layouts(system) for field in layout.fields]
    taken = {"time", "node", "batch", "arclength", "axis", "quaternion", BYTES, SIZES}
    taken |= {name + suffix for name, *_ in _STATES for suffix, *_ in _STATE_PARTS}
    taken |= {*(name for name, *_ in (*_ROWS, _ERROR, _TIME_ERROR, _OUTSIDE, _STAGES))}
    for name in names:
        if name in taken or "/" in name or name.startswith(PARAMETER) or name.endswith("_index"):
            raise TrajectoryFileError(
                f"{source}: a {type(system).__name__} has a field {name!r}; "
                "in a file that name is taken, by another field or otherwise, or impossible"
            )
        taken.add(name)


def _attributes(trajectory: Trajectory, source: str) -> dict[str, Any]:
    system = trajectory.system
    return {
        "title": f"Trajectory of a {type(system).__name__}",
        "comment": "Row 0 is the initial state, row i the state after control i; NaN if not solved.",
        _THINNED: int(trajectory.thinned),
        "format": FORMAT,
        "format_version": VERSION,
        "knode_cosserat_version": package_version(),
        "system": type(system).__name__,
        "settings": _settings_text(trajectory.settings, source),
    }


# reading


def load_trajectory(path: str | Path, *, system: System | None = None) -> Trajectory:
    """Read a trajectory that `save` wrote.

    Args:
        path: the file.
        system: the trajectory's system. Only needed for a system that no file can describe, such as one of a
            user's class.

    Raises:
        TrajectoryFileError: the file cannot be read, is not a trajectory, or has invalid contents.
    """
    path = Path(path)
    data = _read(path)
    if system is None:
        system = system_of(path, data)
    time = values_of(path, data, "time", None)
    rows = tuple(data.sizes[name] for name in ("batch", "time") if name in data.sizes)
    packed: list[Any] = []
    for layout, along in zip(_layouts(system), _ALONG, strict=True):
        shape = (*rows, *(data.sizes.get(name, 0) for name in along))
        fields = [values_of(path, data, field.name, (*shape, field.size)) for field in layout.fields]
        packed.append(np.concatenate(fields, axis=-1) if fields else np.zeros((*shape, 0)))
    y, z, control = packed
    numbers = {name: values_of(path, data, name, rows) for name, *_ in _ROWS}
    for name, *_ in (_ERROR, _TIME_ERROR):
        if name in data.variables:
            numbers[name] = values_of(path, data, name, rows)
    if _OUTSIDE[0] in data.variables:
        numbers[_OUTSIDE[0]] = values_of(path, data, _OUTSIDE[0], rows).astype(bool)
    if _STAGES[0] in data.variables:
        shape = (*rows, *(data.sizes.get(name, 0) for name in _STAGES[1]))
        numbers[_STAGES[0]] = values_of(path, data, _STAGES[0], shape)
    settings, thinned = _settings(path, data), bool(data.attrs.get(_THINNED, 0))
    memory = 2 if settings is None else settings.memory
    states = {attribute: _state(path, data, name, memory) for name, attribute, _ in _STATES}
    require_possible(path, time, numbers, y)
    return Trajectory(system, settings, time, y, z, control, **numbers, **states, thinned=thinned)


def _state_arrays(state: SolverState) -> tuple[np.ndarray, ...]:
    """Return the arrays of a solver's state, in the order of `_STATE_PARTS`."""
    records, rate, y, weights, t0, error, time_error = map(np.asarray, state.history)
    distinct = records.shape[-3] if state.distinct is None else state.distinct
    numbers = [np.nan if state.dt is None else state.dt, float(state.rate_known), float(distinct)]
    time = np.stack([t0, *(np.full(t0.shape, number) for number in numbers)], axis=-1)
    states = np.concatenate([records, np.expand_dims(rate, -3)], axis=-3)
    return states, error, time_error, y, weights, time


def _state(path: Path, data: xarray.Dataset, name: str, memory: int) -> SolverState | None:
    """Return a solver's state, if the file has it."""
    if name + _STATE_PARTS[-1][0] not in data.variables:
        return None
    batch = tuple(data.sizes[name] for name in ("batch",) if name in data.sizes)
    fixed = {
        "history_state": memory + 1,
        "history_record": memory,
        "history_guess": GUESS_STATES,
        "history_time": 4,
    }
    parts = {
        suffix: values_of(
            path, data, name + suffix, (*batch, *(fixed.get(x, data.sizes.get(x, 0)) for x in along))
        )
        for suffix, along, _ in _STATE_PARTS
    }
    states, error, time_error, y, weights, time = parts.values()
    t0, dt, known, distinct = np.moveaxis(time, -1, 0)
    history = StateHistory(states[..., :-1, :, :], states[..., -1, :, :], y, weights, t0, error, time_error)
    first, count = (float(np.ravel(x)[0]) if x.size else np.nan for x in (dt, distinct))
    partly = None if np.isnan(count) or count == memory else int(count)
    return SolverState(history, None if np.isnan(first) else first, bool(np.all(known)), partly)


def _opened(file: Any) -> xarray.Dataset:
    """Return the dataset of a file, with attributes and numbers as they are in the file."""
    import xarray

    return xarray.open_dataset(file, engine="h5netcdf", decode_cf=False, phony_dims="access")


def _read(path: Path) -> xarray.Dataset:
    try:
        require_readable(path)
        require_own_data(path)
        with _opened(path) as data:
            _require_format(path, data.attrs)
            found = data.load()
            _require_checksum(path, found)
            return found
    except (TrajectoryFileError, LimitSettingError):
        raise
    except Exception as error:  # each of three libraries has its own exceptions for a damaged file
        raise TrajectoryFileError(f"{path}: truncated or damaged: {first_line(error)}") from error


def _require_checksum(path: Path, data: xarray.Dataset) -> None:
    """Raise `TrajectoryFileError` if anything in the file was changed after it was written."""
    if data.attrs["format_version"] >= 2 and data.attrs.get(CHECKSUM) != checksum(data):
        raise TrajectoryFileError(f"{path}: damaged or changed: its contents do not have its checksum")


def _require_format(path: Path, attributes: dict[Any, Any]) -> None:
    if attributes.get("format") != FORMAT:
        raise TrajectoryFileError(f"{path}: not a trajectory of this package: its format is not {FORMAT!r}")
    version = attributes.get("format_version")
    if version not in READ:
        raise TrajectoryFileError(
            f"{path}: format_version is {version}; this knode-cosserat reads {READ[0]} to {READ[-1]} "
            f"(the file is from knode-cosserat {attributes.get('knode_cosserat_version', 'unknown')})"
        )


# settings


def _settings_text(settings: Settings | None, source: str) -> str:
    try:
        return json.dumps(None if settings is None else settings.described())
    except (TypeError, ValueError) as error:
        raise TrajectoryFileError(f"{source}: the settings cannot be written: {error}") from None


def _settings(path: Path, data: xarray.Dataset) -> Settings | None:
    try:
        description = parse_json(data.attrs["settings"])
        return None if description is None else Settings.from_description(description)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise TrajectoryFileError(
            f"{path}: attribute 'settings' is not understood: {first_line(error)}"
        ) from None
