"""Model files: the weights, the metadata of the fit, and the nominal model as the text of a robot file.

A file is a `container`: its header describes the nominal model, the residual and the metadata in `about`,
with the names of their classes. Arrays are restored bit for bit. Loading runs no code from a file: objects
are made only of known classes, and only their fields are set. The package's own residuals are known. A
user's residual class must be given at loading, or registered once:

    model = load_model("model", residuals=[MyResidual])
    register(MyResidual)        # also for trajectories of such models

The fields of a residual may hold arrays, numbers, text, None, other Equinox modules of known classes, and
lists, tuples and dictionaries of these; its constructor is not called. The checksum detects accidental
damage. It is no protection against deliberate changes, because it can be recomputed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from knode_cosserat import trajectory_system
from knode_cosserat._files.limits import MORE, allowed
from knode_cosserat._registry import provide
from knode_cosserat.errors import KnodeCosseratError, first_line
from knode_cosserat.learning.files import container
from knode_cosserat.learning.files.container import (
    Classes,
    ContainerError,
    Title,
    UnknownClassError,
    Writer,
)
from knode_cosserat.learning.files.unpacking import Reader
from knode_cosserat.learning.knode import KNODE, About
from knode_cosserat.learning.passive import Passive, Sizes
from knode_cosserat.learning.residual import Network, Nothing, Residual
from knode_cosserat.learning.structured.residual import Expansion, Load, Structured, Term
from knode_cosserat.rods import robot_file
from knode_cosserat.rods.system import System, is_traced, unknown_count
from knode_cosserat.rods.trained_range import TrainedRange
from knode_cosserat.solvers import semi_discrete, space, time
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.semi_discrete import History, Point
from knode_cosserat.solvers.settings import Settings

TITLE = Title("knode-cosserat model", 1)
#: characters of a robot file in a model: YAML is slow to read
MOST_TEXT = 100_000

_classes: dict[str, type] = {}

_Class = TypeVar("_Class", bound=type)


class ModelFileError(KnodeCosseratError, ValueError):
    """A model file that cannot be read or written. The message is one line with the reason."""

    code = "model-file"


def register(cls: _Class) -> _Class:
    """Register a class for files: a residual, a module inside one, or a dataclass or named tuple in `about`.

    Raises:
        ModelFileError: another class has this name already, or the class has no fields.
    """
    _add(_classes, cls)
    return cls


def _add(classes: dict[str, type], cls: Any) -> None:
    if not (isinstance(cls, type) and container.has_fields(cls)):
        raise ModelFileError(
            f"{cls!r} cannot be in a model file; allowed is an Equinox module or a dataclass"
        )
    if not container.same_class(classes.get(cls.__name__, cls), cls):
        raise ModelFileError(
            f"there is another class {cls.__name__} already, of {classes[cls.__name__].__module__}; "
            "call yours otherwise"
        )
    classes[cls.__name__] = cls


for _known in (
    Network, Nothing, Passive, Sizes, Structured, Load, Expansion, Term, Settings, NewtonOptions, space.Euler,
    space.Lobatto2, space.Lobatto4, time.BDF1, time.BDF2, time.BDFAlpha, time.Trapezoidal,
    TrainedRange,
):  # fmt: skip
    register(_known)


def save(model: KNODE, path: str | Path) -> None:
    """Write a model to a file at exactly this path; `load_model` reads an equal model.

    The file is written atomically. If no robot file can describe the nominal model, its class name, layouts
    and parameters are written, and `load_model` needs the nominal model as an argument.

    Raises:
        ModelFileError: the model contains something that cannot be stored, it is a batch, or the file cannot
            be written.
    """
    data = encoded(model, str(path))
    try:
        container.write_container(Path(path), data)
    except ContainerError as error:
        raise ModelFileError(f"{path}: {error}") from None


def load_model(path: str | Path, *, knowledge: System | None = None, residuals: Iterable[type] = ()) -> KNODE:
    """Read a model from a file of `save`.

    Args:
        path: the file.
        knowledge: the nominal model. Needed only if no robot file can describe it, such as for a user's
            class; it must equal the one that the model was saved with.
        residuals: classes of the model's residual that are not in the package.

    Raises:
        ModelFileError: the file cannot be read, is of another kind or version, truncated or damaged, or its
            parts do not fit together.
    """
    try:
        data = container.read(Path(path))
    except ContainerError as error:
        raise ModelFileError(f"{path}: {error}") from None
    return decoded_model(data, str(path), knowledge=knowledge, residuals=residuals)


# model to bytes


def encoded(model: KNODE, source: str) -> bytes:
    """Return the bytes of a model's file; `source` is its name in errors. Raises `ModelFileError`."""
    try:
        if type(model) is not KNODE:
            raise ContainerError(f"a {type(model).__name__} is not a model; allowed is a KNODE")
        if is_traced(model):
            raise ContainerError("a model cannot be written inside jit, grad or vmap")
        if np.ndim(model.knowledge.length):
            raise ContainerError("a batch of models cannot be written to one file; write them one by one")
        writer = Writer()
        header = _header(writer, model)
        _require_fit(model)
        return writer.file(TITLE, header)
    except ContainerError as error:
        raise ModelFileError(f"{source}: {error}") from None


def _header(writer: Writer, model: KNODE) -> dict[str, Any]:
    return {
        "knowledge": _described(writer, model.knowledge),
        "residual": writer.value(model.residual, "residual", _classes, others=True),
        "trained": writer.value(model.trained, "trained", _classes),
        "about": writer.value(model.about.facts, "about", _classes),
    }


def _described(writer: Writer, knowledge: System) -> dict[str, Any]:
    """Return a nominal model for the header: a nested model, the text of a robot file, or its traits."""
    name = {"class": type(knowledge).__name__}
    if type(knowledge) is KNODE:
        return {**name, "model": _header(writer, knowledge)}
    if type(knowledge) in robot_file.KINDS.values():
        try:
            return {**name, "robot": robot_file.format_robot(knowledge)}
        except robot_file.RobotFileError as error:
            raise ContainerError(str(error)) from None
    return {**name, "traits": writer.value(_traits(knowledge), "knowledge", _classes)}


def _traits(system: System) -> dict[str, Any]:
    """Return the traits that a given nominal model must share with the saved one."""
    layouts = {"y": system.y_layout, "z": system.z_layout, "controls": system.control_layout}
    parameters = {name: getattr(system, name) for name in system.parameters()}
    return {
        **{name: [list(field[:3]) for field in layout.fields] for name, layout in layouts.items()},
        "unknowns at the base": list(system.base_unknowns),
        "mixed": bool(system.mixed),
        "nodes": system.nodes,
        **{name: None if value is None else np.asarray(value) for name, value in parameters.items()},
    }


# bytes to model


def decoded_model(
    data: bytes, source: str, *, knowledge: System | None = None, residuals: Iterable[type] = ()
) -> KNODE:
    """Return the model in a file's bytes; see `load_model`."""
    classes = dict(_classes)
    for cls in residuals:
        _add(classes, cls)
    try:
        reader = Reader(data, TITLE)
        model = _model(reader, reader.header, classes, knowledge)
        _require_fit(model)
    except UnknownClassError as error:
        name = error.name[:60] if error.name.isidentifier() else "…"
        raise ModelFileError(
            f"{source}: {error}: give it, load_model(path, residuals=[{name}]), or register it"
        ) from None
    except (ContainerError, RecursionError) as error:
        raise ModelFileError(f"{source}: {error}") from None
    return model


def _model(reader: Reader, header: Any, classes: Classes, given: System | None) -> KNODE:
    knowledge = _knowledge(reader, reader.entry("knowledge", dict, header), classes, given)
    residual = reader.value(reader.entry("residual", dict, header), "residual", classes)
    if not isinstance(residual, Residual):
        raise ContainerError(f"its residual is a {type(residual).__name__}; allowed is a Residual")
    facts = reader.value(reader.entry("about", dict, header), "about", classes)
    if type(facts) is not dict:
        raise ContainerError(f"its 'about' is a {type(facts).__name__}; allowed is a mapping")
    # files of earlier versions have no range
    trained = reader.value(header.get("trained"), "trained", classes)
    if not isinstance(trained, TrainedRange | None):
        raise ContainerError(
            f"its range is a {type(trained).__name__}; allowed is a TrainedRange, or nothing"
        )
    return KNODE(knowledge, residual, About(facts), trained)


def _knowledge(reader: Reader, described: dict[str, Any], classes: Classes, given: System | None) -> System:
    name = reader.entry("class", str, described)
    if "model" in described:
        return _model(reader, reader.entry("model", dict, described), classes, given)
    if "robot" in described:
        text = reader.entry("robot", str, described)
        most = allowed(MOST_TEXT)
        if len(text) > most:
            raise ContainerError(f"its robot file has {len(text)} characters; allowed is {most}; {MORE}")
        try:
            robot = robot_file.parse_robot(text, "its robot file")
        except robot_file.RobotFileError as error:
            raise ContainerError(str(error)) from None
        if given is not None:
            _require_same(given, name, _traits(robot))
        return robot
    traits = reader.value(reader.entry("traits", dict, described), "traits", classes)
    if type(traits) is not dict:
        raise ContainerError("what it says of its knowledge is not understood")
    if given is None:
        raise ContainerError(
            f"its knowledge is a {name[:60]}, which no robot file describes: "
            "give it, load_model(path, knowledge=…)"
        )
    _require_same(given, name, traits)
    return given


def _require_same(given: System, name: str, traits: dict[str, Any]) -> None:
    if type(given).__name__ != name:
        raise ContainerError(
            f"the knowledge given is a {type(given).__name__}; the model was saved with a {name[:60]}"
        )
    own = _traits(given)
    for trait in {**own, **traits}:
        if not _same(own.get(trait), traits.get(trait)):
            raise ContainerError(
                f"the knowledge given has other {trait[:60]} than the one that the model was saved with: "
                f"{_short(own.get(trait))}, not {_short(traits.get(trait))}"
            )


def _same(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    return np.array_equal(one, other) if isinstance(one, np.ndarray) else repr(one) == repr(other)


def _short(value: Any) -> str:
    text = " ".join(str(value.tolist() if isinstance(value, np.ndarray) else value).split())
    return text if len(text) <= 100 else text[:100] + "…"


# consistency of nominal model and residual


def _require_fit(model: KNODE) -> None:
    """Raise `ContainerError` unless the equations can be traced, with results as in the layouts."""
    ny, nz = model.y_layout.size, model.z_layout.size
    history = History(np.zeros(()), np.zeros(ny), np.zeros(nz), np.zeros(ny))
    try:
        length = np.asarray(model.length)
        found = jax.eval_shape(_equations, model, np.zeros(ny), np.zeros(model.control_size), history)
        shapes = [part.shape for part in found]
    except Exception as error:  # a residual may raise any error if arrays do not fit
        reason = re.sub(r"<function \w+ at 0x[0-9a-f]+>", "the equations", first_line(error))
        raise ContainerError(f"residual and knowledge do not fit together: {reason}") from None
    expected = [(ny,), (nz,), (unknown_count(model),)]
    if shapes != expected or length.shape != () or length.dtype.kind not in "fiu" or not np.isfinite(length):
        raise ContainerError(
            f"residual and knowledge do not fit together: y_s, z, tip have shapes {shapes}; allowed is "
            f"{expected}, and a length that is a number, not {_short(length)}"
        )


def _equations(model: KNODE, y: Any, control: Any, history: History) -> tuple[Any, Any, Any]:
    y_s, z = semi_discrete.derivatives(model, Point(np.zeros(()), np.zeros(()), y, control, history))
    return y_s, z, semi_discrete.tip(model, np.zeros(()), control, y, history)


provide(KNODE, "save", save)
trajectory_system.register_codec(KNODE, encoded, decoded_model)
