"""KNODE: a nominal model with a learned residual, which is itself a system; and its file.

`KNODE.save` writes a `container`: its facts describe the nominal model (the text of a robot file), the
residual and the metadata of the fit, with the names of their classes. Arrays are restored bit for bit.
Loading runs no code from a file: objects are made only of known classes, and only their fields are set; the
constructor of a residual is not called. The package's own residuals are known. A user's class is given at
loading, `load_model("model", residuals=[MyResidual])`. The fields of a residual may hold arrays, numbers,
text, None, other modules and dataclasses, and lists, tuples and dictionaries of these.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.limits import MORE, scaled_limit
from knode_cosserat._reprs import count_of, quantity, robot_text, wrap_lines
from knode_cosserat.errors import KnodeCosseratError, first_line
from knode_cosserat.io import container
from knode_cosserat.io.container import ContainerError
from knode_cosserat.learning.residual import Network, Nothing, Residual
from knode_cosserat.learning.structured.residual import Expansion, Load, Structured, Term
from knode_cosserat.learning.terms import Smooth, Terms, Units
from knode_cosserat.rods import robot_file
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.passport import Passport
from knode_cosserat.rods.system import System, is_traced, unknown_count
from knode_cosserat.rods.wrapped import Wrapped
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.semi_discrete import History, Point


class About:
    """Metadata of a model: settings and data of its fit.

    All instances compare equal, so that models of one structure share compiled programs and can be stacked.
    """

    def __init__(self, facts: dict[str, Any] | None = None):
        self.facts = dict(facts or {})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, About)

    def __hash__(self) -> int:
        return hash(About)


class KNODE(Wrapped):
    """Nominal model with a residual; layouts and base conditions are the nominal model's.

    The nominal model may itself be a KNODE.
    """

    knowledge: System
    residual: Residual
    about: About = eqx.field(static=True)

    def __init__(
        self,
        knowledge: System,
        residual: Residual,
        about: About | None = None,
        passport: Passport | None = None,
    ):
        self.knowledge = knowledge
        self.residual = residual
        self.about = about or About()
        #: by default that of the nominal model
        self.passport = knowledge.passport if passport is None else passport
        self.nodes = knowledge.nodes

    def around(self, knowledge: System) -> Self:
        """Return a model with the same residual and another nominal model."""
        return type(self)(knowledge, self.residual, self.about, self.passport)

    def __repr__(self) -> str:
        facts = self.about.facts
        parts = [f"KNODE of a {robot_text(self.knowledge)}", f"residual {self.residual!r}"]
        if self.passport is not None:
            learned = sum(origin.learned for origin in self.passport.origins)
            parts.append(f"learned from {count_of(learned, 'recording')}")
        if isinstance(facts.get("held_out_error"), float):
            parts.append(f"held-out tip error {quantity(1e3 * facts['held_out_error'], 'mm')}")
        return wrap_lines("; ".join(parts))

    @property
    def adapted(self) -> System:
        """Nominal model with the residual's parameter changes."""
        return self.residual.adapted(self.knowledge)

    def constitutive(self, s: Any, t: Any, y: Float[Any, " y"], y_t: Any, control: Any) -> Any:
        """Return the nominal model's law of z with the residual's terms."""
        return self.residual.constitutive(self.adapted, s, t, y, y_t, control)

    def balance(self, s: Any, t: Any, y: Float[Any, " y"], y_t: Any, z: Any, z_t: Any, control: Any) -> Any:
        """Return the nominal model's balance along the rod with the residual's loads."""
        return self.residual.balance(self.adapted, s, t, y, y_t, z, z_t, control)

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at s = 0, with the learned residual."""
        return self.residual.base(self.adapted, t, control, unknowns)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residual of the tip's boundary conditions, with the learned residual."""
        return self.residual.tip(self.adapted, t, control, y, y_t)

    @property
    def corrections(self) -> tuple[Any, ...]:
        """Corrections of [y_s; z]: the nominal model's, then the residual's (paper eq. 7, KNODE model)."""
        correction = self.residual.correction
        learned = () if correction is None else (functools.partial(correction, self.adapted),)
        return (*super().corrections, *learned)

    def coefficients(self) -> dict[str, Any]:
        """Return the numbers in which the residual is linear; `replace` knows them as "residual.NAME"."""
        return self.residual.coefficients()

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other parameters of the nominal model, or other coefficients of the residual.

        The latter are named as in `coefficients`, such as `residual.damping`.

        Raises:
            ParameterError: a name that does not exist, a value that is not allowed.
        """
        names = [name for name in changes if name.startswith("residual.")]
        numbers = {name.removeprefix("residual."): changes.pop(name) for name in names}
        model = super().replace(**changes) if changes else self
        if not numbers:
            return model
        return type(self)(
            model.knowledge, self.residual.with_coefficients(numbers), self.about, self.passport
        )

    def to_bytes(self) -> bytes:
        """Return the bytes of the model's file. Raises `ModelFileError`."""
        with KIND.naming("a KNODE"):
            return _encoded(self)

    def save(self, path: str | Path) -> None:
        """Write the model to a file at exactly this path; `load_model` reads an equal model.

        The file is written atomically. If no robot file can describe the nominal model, its class name,
        layouts and parameters are written, and `load_model` needs the nominal model as an argument.

        Raises:
            ModelFileError: the model contains something that cannot be stored, it is a batch, or the file
                cannot be written.
        """
        with KIND.naming(path):
            content = _encoded(self)
        container.write(path, content, KIND)


# files


class ModelFileError(KnodeCosseratError, ValueError):
    """A model file that cannot be read or written. The message is one line with the reason."""

    code = "model-file"


KIND = container.Kind("knode-cosserat model", 1, ModelFileError)
#: characters of a robot file in a model: YAML is slow to read
MOST_TEXT = 100_000
#: classes of the objects in a model's file
CLASSES: dict[str, type] = {
    cls.__name__: cls
    for cls in (
        Network,
        Nothing,
        Structured,
        Load,
        Expansion,
        Term,
        Terms,
        Smooth,
        Units,
    )
}


def load_model(path: str | Path, *, knowledge: System | None = None, residuals: Iterable[type] = ()) -> KNODE:
    """Read a model from a file of `KNODE.save`.

    Args:
        path: the file.
        knowledge: the nominal model. Needed only if no robot file can describe it, such as for a user's
            class; it must equal the one that the model was saved with.
        residuals: classes of the model's residual that are not in the package.

    Raises:
        ModelFileError: the file cannot be read, is of another kind or version, truncated or damaged, or its
            parts do not fit together.
    """
    check_arguments(load_model, locals())
    return _model(container.read(path, KIND, _classes(residuals)), str(path), knowledge)


def decoded_model(
    data: bytes, source: str, *, knowledge: System | None = None, residuals: Iterable[type] = ()
) -> KNODE:
    """Return the model in a file's bytes; see `load_model`."""
    return _model(container.decode(data, KIND, source, _classes(residuals)), source, knowledge)


def _classes(residuals: Iterable[Any]) -> dict[str, type]:
    classes = dict(CLASSES)
    for cls in residuals:
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
    return classes


def _encoded(model: KNODE) -> bytes:
    if type(model) is not KNODE:
        raise ContainerError(f"a {type(model).__name__} is not a model; allowed is a KNODE")
    if is_traced(model):
        raise ContainerError("a model cannot be written inside jit, grad or vmap")
    if np.ndim(model.knowledge.length):
        raise ContainerError("a batch of models cannot be written to one file; write them one by one")
    facts = _facts(model)
    _require_fit(model)
    return container.encode(KIND, facts, classes=CLASSES, others=True)


def _facts(model: KNODE) -> dict[str, Any]:
    knowledge: dict[str, Any] = {"class": type(model.knowledge).__name__}
    if type(model.knowledge) is KNODE:
        knowledge["model"] = _facts(model.knowledge)
    elif type(model.knowledge) in robot_file.KINDS.values():
        try:
            knowledge["robot"] = robot_file.format_robot(model.knowledge)
        except robot_file.RobotFileError as error:
            raise ContainerError(str(error)) from None
    else:
        knowledge["traits"] = _traits(model.knowledge)
    passport = None if model.passport is None else model.passport.to_dict()
    own = {"residual": model.residual, "passport": passport, "about": model.about.facts}
    return {"knowledge": knowledge, **own}


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


def _model(content: container.Content, source: str, knowledge: System | None) -> KNODE:
    with KIND.naming(source):
        model = _model_of(content.facts, knowledge)
        _require_fit(model)
        return model


def _model_of(facts: Any, nominal: System | None) -> KNODE:
    if not isinstance(facts, dict):
        raise ContainerError(f"its model is a {type(facts).__name__}; allowed is a mapping")
    kinds = {"knowledge": dict, "residual": Residual, "about": dict}
    for name, kind in kinds.items():
        if not isinstance(facts.get(name), kind):
            raise ContainerError(
                f"its {name} is a {type(facts.get(name)).__name__}; allowed is a {kind.__name__}"
            )
    passport = facts.get("passport")
    try:
        passport = None if passport is None else Passport.from_dict(passport)
    except ParameterError as error:
        raise ContainerError(f"its {error}") from None
    return KNODE(_knowledge(facts["knowledge"], nominal), facts["residual"], About(facts["about"]), passport)


def _knowledge(described: dict[str, Any], nominal: System | None) -> System:
    name = str(described.get("class"))
    if "model" in described:
        return _model_of(described["model"], nominal)
    if "robot" in described:
        text, most = str(described["robot"]), scaled_limit(MOST_TEXT)
        if len(text) > most:
            raise ContainerError(f"its robot file has {len(text)} characters; allowed is {most}; {MORE}")
        try:
            robot = robot_file.parse_robot(text, "its robot file")
        except robot_file.RobotFileError as error:
            raise ContainerError(str(error)) from None
        if nominal is not None:
            _require_same(nominal, name, _traits(robot))
        return robot
    if not isinstance(described.get("traits"), dict):
        raise ContainerError("its 'knowledge' has neither a robot nor traits")
    if nominal is None:
        raise ContainerError(
            f"its nominal model is a {name[:60]}, which no robot file describes: "
            "give it, load_model(path, knowledge=…)"
        )
    _require_same(nominal, name, described["traits"])
    return nominal


def _require_same(nominal: System, name: str, traits: dict[str, Any]) -> None:
    if type(nominal).__name__ != name:
        raise ContainerError(
            f"the nominal model given is a {type(nominal).__name__}; the model was saved with a {name[:60]}"
        )

    def short(value: Any) -> str:
        text = " ".join(str(value.tolist() if isinstance(value, np.ndarray) else value).split())
        return text if len(text) <= 100 else text[:100] + "…"

    present = _traits(nominal)
    for trait in {**present, **traits}:
        one, other = present.get(trait), traits.get(trait)
        arrays = isinstance(one, np.ndarray) and isinstance(other, np.ndarray)
        if not (np.array_equal(one, other) if arrays else repr(one) == repr(other)):  # type: ignore[arg-type]
            raise ContainerError(
                f"the nominal model given has other {trait[:60]} than the one that the model was saved with: "
                f"{short(one)}, not {short(other)}"
            )


def _require_fit(model: KNODE) -> None:
    """Raise `ContainerError` unless the equations can be traced, with results as in the layouts."""
    ny, nz = model.y_layout.size, model.z_layout.size
    history = History(np.zeros(()), np.zeros(ny), np.zeros(nz), np.zeros(ny))

    def equations(model: KNODE, y: Any, control: Any, history: History) -> tuple[Any, Any, Any]:
        y_s, z = semi_discrete.derivatives(model, Point(np.zeros(()), np.zeros(()), y, control, history))
        return y_s, z, semi_discrete.tip(model, np.zeros(()), control, y, history)

    try:
        length = np.asarray(model.length)
        results = jax.eval_shape(equations, model, np.zeros(ny), np.zeros(model.control_layout.size), history)
        shapes = [part.shape for part in results]
    except Exception as error:  # a residual may raise any error if arrays do not fit
        reason = re.sub(r"<function \S+ at 0x[0-9a-f]+>", "the equations", first_line(error))
        raise ContainerError(f"residual and nominal model do not fit together: {reason}") from None
    expected = [(ny,), (nz,), (unknown_count(model),)]
    if shapes != expected or length.shape != () or length.dtype.kind not in "fiu" or not np.isfinite(length):
        raise ContainerError(
            f"residual and nominal model do not fit together: y_s, z, tip have shapes {shapes}; allowed is "
            f"{expected}, and a length that is a number, not {length.tolist()}"
        )
