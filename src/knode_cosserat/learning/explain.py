"""Readable terms of a structured residual, with units: corrections of length, stress, loads and tip."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.structured.residual import (
    Expansion,
    Structured,
    Term,
    ambient_layout,
    loaded,
    material_layout,
)
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System
from knode_cosserat.solvers import semi_discrete
from knode_cosserat.solvers.segments import Samples, samples, start_point
from knode_cosserat.trajectory import Trajectory


class ExplainedTerm(NamedTuple):
    """One term: part, corrected field, function, coefficient, and the coefficient's unit."""

    part: str
    target: str
    function: str
    coefficient: float
    unit: str

    def __str__(self) -> str:
        return f"{self.part:<8} {self.target:<5} {self.coefficient:+.5g} {self.function}  [{self.unit}]"


def explain(model: KNODE) -> list[ExplainedTerm]:
    """Return the terms that the residual adds to the nominal model, the largest first within each part.

    The parts are length, stress, load and tip. A star marks terms in the global frame; all others are in the
    material frame.

    A coefficient multiplies the function in SI units, of the unscaled vector; for a saturating function it is
    the initial slope. Stress is the missing term of the constitutive law, C z + D z_t + stress = f2. Loads
    are added to the rates of the balanced fields, or to the tip's boundary conditions.

    Raises:
        TypeError: not a model, or its residual is not structured.
    """
    if not isinstance(model, KNODE):
        raise TypeError(f"model is a {type(model).__name__}; allowed is a KNODE, which `fit` gives")
    residual, knowledge = model.residual, model.knowledge.strand
    if not isinstance(residual, Structured):
        raise TypeError(f"a {type(residual).__name__} has no terms to read; allowed is a structured residual")
    found = []
    if float(residual.stretch) != 0.0:
        found.append(ExplainedTerm("length", "", "of the knowledge's length", float(residual.stretch), "1"))
    strain = knowledge.z_layout
    rates = Layout(
        *((f"{name}_t", size, f"{unit}/s", meaning) for name, size, unit, meaning, *_ in strain.fields)
    )
    found += _terms("stress", strain, residual.stress, strain + rates)
    whole = model.knowledge
    parts: list[tuple[str, System, Layout, Any]] = [
        ("load", knowledge, loaded(knowledge), residual.load),
        ("tip", whole, whole.tip_layout, residual.tip_load),
    ]
    for part, system, targets, load in parts:
        if load is not None:
            found += _terms(part, targets, load.material, material_layout(system))
            found += _terms(f"{part}*", targets, load.ambient, ambient_layout(system))
    return found


def _terms(part: str, targets: Layout, expansion: Expansion | None, inputs: Layout) -> list[ExplainedTerm]:
    if expansion is None:
        return []
    rows = [
        (field, f"{field.name}{_axis(field.size, i)}") for field in targets.fields for i in range(field.size)
    ]
    found: list[tuple[float, ExplainedTerm]] = []
    weights = np.asarray(expansion.weights)
    for (field, target), row in zip(rows, weights, strict=True):
        base = field.load or field.unit
        if row[0] != 0.0:
            found.append((abs(float(row[0])), ExplainedTerm(part, target, "1", float(row[0]), base)))
        for term, where in expansion.columns():
            unit = inputs.fields[inputs.names.index(term.name)].unit
            for axis, k in enumerate(where):
                if row[k] != 0.0:
                    power = {"linear": 1, "square": 2, "square_norm": 2, "cube": 3, "cube_norm": 3}.get(
                        term.form, 1
                    )
                    size = float(row[k]) / float(expansion.scales[term.scale]) ** power
                    shape = _function(term, axis, expansion)
                    divided = f"{base} / ({unit}){'' if power == 1 else f'^{power}'}"
                    found.append((abs(float(row[k])), ExplainedTerm(part, target, shape, size, divided)))
    return [finding for _, finding in sorted(found, key=lambda pair: -pair[0])]


def _axis(size: int, i: int) -> str:
    return "" if size == 1 else f"_{'xyz'[i]}" if size == 3 else f"_{i + 1}"


def _function(term: Term, axis: int, expansion: Expansion) -> str:
    x = f"{term.name}{_axis(term.size, axis)}"
    if term.form == "linear":
        return x
    if term.form == "square":
        return f"|{x}| {x}"
    if term.form == "cube":
        return f"{x}³"
    if term.form == "square_norm":
        return f"|{term.name}| {x}"
    if term.form == "cube_norm":
        return f"|{term.name}|² {x}"
    reach = float(expansion.scales[term.scale] / expansion.slopes[term.slope])
    if term.form == "saturating":
        return f"{reach:.4g} tanh({x} / {reach:.4g})"
    return f"{x} / √(1 + |{term.name}|² / {reach:.4g}²)"


class Added(NamedTuple):
    """Derivatives without and with a residual at the states of a trajectory, at every segment's start."""

    time: Float[np.ndarray, " T"]
    #: y_s and z of the nominal model alone, and of the whole model
    knowledge: tuple[Float[np.ndarray, "T N y"], Float[np.ndarray, "T N z"]]
    model: tuple[Float[np.ndarray, "T N y"], Float[np.ndarray, "T N z"]]


def added(model: KNODE, trajectory: Trajectory) -> Added:
    """Return y_s and z at a trajectory's states, without the residual (of any kind) and with it.

    Raises:
        DataError: the trajectory does not fit the model.
    """
    data = samples(model.knowledge, [trajectory]).segments
    rows = np.unique(data.origin[:, 1])
    both = [
        tuple(np.asarray(part).reshape(len(rows), -1, part.shape[-1]) for part in _derivatives(system, data))
        for system in (model.knowledge, model)
    ]
    return Added(np.asarray(trajectory.time)[rows], both[0], both[1])  # type: ignore[arg-type]


@jax.jit
def _derivatives(system: System, data: Samples) -> Any:
    return jax.vmap(lambda sample: semi_discrete.derivatives(system, start_point(system, sample)))(data)
