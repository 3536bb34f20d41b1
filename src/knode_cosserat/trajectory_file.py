"""Trajectories as labelled netCDF files.

Every field of y, z and the controls is a variable under its own name, with unit and meaning, over the
dimensions (batch,) time, node and component. The robot is an attribute, as the text of a robot file. The
settings are an attribute too, as JSON. `trajectory_system` handles other systems. Arrays are stored exactly.
Reading runs no code from the file.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat._files import package_version, replacing
from knode_cosserat._registry import provide
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import InitialHistory
from knode_cosserat.solvers.result import EARLIER_RESULTS, Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.trajectory_system import (
    BYTES,
    PARAMETER,
    SIZES,
    TrajectoryFileError,
    described,
    first_line,
    labels,
    system_of,
    values_of,
)

if TYPE_CHECKING:
    import xarray

FORMAT = "knode-cosserat trajectory"
VERSION = 1

#: variables with one number in each row: name, unit and meaning
_ROWS = (
    ("result", "1", "how the step ended; below zero: not solved"),
    ("residual", "1", "largest residual, in natural units"),
    ("iterations", "1", "Newton corrections"),
)
_ERROR = ("position_error", "m", "estimated discretisation error of positions, the largest over the nodes")
_OUTSIDE = ("extrapolated", "1", "1 in rows outside the range that the model was trained in")
#: initial history of a motion: two states, newest first, and the newest one's rate, at the evaluation points
#: along the rod; and c0, c1, c2, d1 and dt of the first step
_BEGUN, _BEGUN_STEP = "initial_history", "initial_history_step"
_BEGUN_ALONG = ("history_state", "history_place", "history_number")
#: comment on each control about its interval; attribute for omitted intermediate rows
_ACTED = "row i acted from row i - 1 to row i; row 0 before the motion"
_THINNED = "rows_left_out"
#: names in files of earlier versions, whose initial histories are ignored: they belong to other schemes
_EARLIER = ("begun", "begun_step")

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
    try:
        with replacing(path) as temporary:
            data.to_netcdf(temporary, engine="h5netcdf", encoding=plain)
    except (OSError, RuntimeError) as error:  # HDF5 raises either for a full disk
        number = error.errno if isinstance(error, OSError) else None
        reason = os.strerror(number) if number else first_line(error)
        raise TrajectoryFileError(f"{path}: cannot be written: {reason}") from None


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
    if trajectory.position_error is not None:
        name, unit, meaning = _ERROR
        variables[name] = (rows, np.asarray(trajectory.position_error), labels(unit, meaning))
    if trajectory.extrapolated is not None:
        name, unit, meaning = _OUTSIDE
        marks = np.asarray(trajectory.extrapolated).astype(np.int8)
        variables[name] = (rows, marks, labels(unit, meaning))
    variables["result"][2].update(_flags(variables["result"][1].dtype))
    if trajectory.begun is not None:
        begun = InitialHistory(*map(np.asarray, trajectory.begun))
        states = np.concatenate([begun.records, np.expand_dims(begun.rate, -3)], axis=-3)
        step = np.concatenate([begun.coefficients, begun.dt[..., None]], axis=-1)
        variables[_BEGUN] = (
            (*batch, *_BEGUN_ALONG),
            states,
            {"long_name": "initial history: newest state, the one before it, and the newest one's rate"},
        )
        variables[_BEGUN_STEP] = (
            (*batch, "history_coefficient"),
            step,
            {"long_name": "c0, c1, c2, d1 and dt of the first step"},
        )
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
    taken |= {_BEGUN, _BEGUN_STEP, *_EARLIER, *(name for name, *_ in (*_ROWS, _ERROR, _OUTSIDE))}
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
    numbers["result"] = _current_codes(numbers["result"], data["result"].attrs)
    if _ERROR[0] in data.variables:
        numbers[_ERROR[0]] = values_of(path, data, _ERROR[0], rows)
    if _OUTSIDE[0] in data.variables:
        numbers[_OUTSIDE[0]] = values_of(path, data, _OUTSIDE[0], rows).astype(bool)
    settings, begun = _settings(path, data), _begun(path, data)
    thinned = bool(data.attrs.get(_THINNED, 0))
    return Trajectory(system, settings, time, y, z, control, **numbers, begun=begun, thinned=thinned)


def _current_codes(codes: np.ndarray, attributes: dict[Any, Any]) -> np.ndarray:
    """Return this version's result codes: a file names its codes, and earlier versions had others."""
    values = np.ravel(attributes.get("flag_values", ()))
    names = str(attributes.get("flag_meanings", "")).split()
    current = codes.copy()
    for value, name in zip(values, names, strict=False):
        if name in EARLIER_RESULTS and isinstance(value, np.integer):
            current[codes == value] = int(EARLIER_RESULTS[name])
    return current


def _begun(path: Path, data: xarray.Dataset) -> InitialHistory | None:
    """Return the initial history, if the file has it."""
    if _BEGUN not in data.variables:
        return None
    batch = tuple(data.sizes[name] for name in ("batch",) if name in data.sizes)
    sizes = tuple(data.sizes.get(name, 0) for name in _BEGUN_ALONG[1:])
    states = values_of(path, data, _BEGUN, (*batch, 3, *sizes))
    step = values_of(path, data, _BEGUN_STEP, (*batch, 5))
    newest, before, rate = np.moveaxis(states, -3, 0)
    return InitialHistory(np.stack([newest, before], axis=-3), rate, step[..., :4], step[..., 4])


def _read(path: Path) -> xarray.Dataset:
    import xarray

    _require_hdf5(path)
    try:
        with xarray.open_dataset(path, engine="h5netcdf", decode_cf=False, phony_dims="access") as data:
            _require_format(path, data.attrs)
            return data.load()
    except TrajectoryFileError:
        raise
    except Exception as error:  # each of three libraries has its own exceptions for a damaged file
        raise TrajectoryFileError(f"{path}: truncated or damaged: {first_line(error)}") from error


def _require_hdf5(path: Path) -> None:
    try:
        with path.open("rb") as file:
            start = file.read(8)
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        reason = "no such file" if missing else f"cannot be read: {error.strerror}"
        raise TrajectoryFileError(f"{path}: {reason}") from None
    if start != b"\x89HDF\r\n\x1a\n":
        raise TrajectoryFileError(f"{path}: not a netCDF-4 file")


def _require_format(path: Path, attributes: dict[Any, Any]) -> None:
    if attributes.get("format") != FORMAT:
        raise TrajectoryFileError(f"{path}: not a trajectory of this package: its format is not {FORMAT!r}")
    version = attributes.get("format_version")
    if version != VERSION:
        raise TrajectoryFileError(
            f"{path}: format_version is {version}; allowed is {VERSION}, which this knode-cosserat reads "
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
        description = json.loads(data.attrs["settings"])
        return None if description is None else Settings.from_description(description)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise TrajectoryFileError(
            f"{path}: attribute 'settings' is not understood: {first_line(error)}"
        ) from None
