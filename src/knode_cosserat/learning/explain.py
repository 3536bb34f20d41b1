"""Readable terms of a structured residual, with units: corrections of length, stress, loads and tip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.structured.residual import (
    Expansion,
    Structured,
    Term,
    loaded,
    material_layout,
)
from knode_cosserat.rods.aspects import Ends, Observed
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.strands import strand_of

#: powers of the inputs in a function; 1 for all others
POWERS = {"square": 2, "square_norm": 2, "cube": 3, "cube_norm": 3}


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

    The parts are length, stress, base, load and tip. A star marks terms in the global frame; all others are
    in the material frame.

    A coefficient multiplies the function in SI units, of the unscaled vector; for a saturating function it is
    the initial slope. Stress is the missing term of the constitutive law, C z + D z_t + stress = f2. Loads
    are added to the rates of the balanced fields, or to the tip's boundary conditions.

    Raises:
        TypeError: not a model, or its residual is not structured.
    """
    check_arguments(explain, locals())
    residual, knowledge = model.residual, strand_of(model.knowledge)
    if not isinstance(residual, Structured):
        raise TypeError(f"a {type(residual).__name__} has no terms to read; allowed is a structured residual")
    terms = []
    if float(residual.stretch) != 0.0:
        terms.append(ExplainedTerm("length", "", "of the nominal length", float(residual.stretch), "1"))
    aspect, y_layout = Observed.of(knowledge), knowledge.y_layout
    terms += _terms("stress", knowledge.z_layout, residual.stress, aspect.law_layout)
    fields = Layout(*(field for field in y_layout.fields if field.name in aspect.base_law))
    terms += _terms("base", fields, residual.at_base, aspect.base_layout)
    whole = model.knowledge
    for part, system, targets, load in (
        ("load", knowledge, loaded(knowledge), residual.load),
        ("tip", whole, Ends.of(whole).layout, residual.tip_load),
    ):
        if load is not None:
            terms += _terms(part, targets, load.material, material_layout(system))
            terms += _terms(f"{part}*", targets, load.ambient, Observed.of(system).ambient_layout)
    return terms


def _terms(part: str, targets: Layout, expansion: Expansion | None, inputs: Layout) -> list[ExplainedTerm]:
    if expansion is None:
        return []
    rows = [
        (field, f"{field.name}{_axis(field.size, i)}") for field in targets.fields for i in range(field.size)
    ]
    terms: list[tuple[float, ExplainedTerm]] = []
    for (field, target), row in zip(rows, np.asarray(expansion.weights), strict=True):
        base = field.load or field.unit
        if row[0] != 0.0:
            terms.append((abs(float(row[0])), ExplainedTerm(part, target, "1", float(row[0]), base)))
        for term, where in expansion.columns():
            unit = inputs.fields[inputs.names.index(term.name)].unit
            power = POWERS.get(term.form, 1)
            divided = f"{base} / ({unit}){'' if power == 1 else f'^{power}'}"
            for axis, k in enumerate(where):
                if row[k] != 0.0:
                    size = float(row[k]) / float(expansion.scales[term.scale]) ** power
                    shape = _function(term, axis, expansion)
                    terms.append((abs(float(row[k])), ExplainedTerm(part, target, shape, size, divided)))
    return [term for _, term in sorted(terms, key=lambda pair: -pair[0])]


def _axis(size: int, i: int) -> str:
    return "" if size == 1 else f"_{'xyz'[i]}" if size == 3 else f"_{i + 1}"


def _function(term: Term, axis: int, expansion: Expansion) -> str:
    x, norm = f"{term.name}{_axis(term.size, axis)}", f"|{term.name}|"
    scale = float(expansion.scales[term.scale]) / (term.slope or 1.0)
    return {
        "linear": x,
        "square": f"|{x}| {x}",
        "cube": f"{x}³",
        "square_norm": f"{norm} {x}",
        "cube_norm": f"{norm}² {x}",
        "saturating": f"{scale:.4g} tanh({x} / {scale:.4g})",
        "saturating_norm": f"{x} / √(1 + {norm}² / {scale:.4g}²)",
    }[term.form]
