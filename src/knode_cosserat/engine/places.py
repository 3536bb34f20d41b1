"""Functions of a system at places along the rod, as machine code with places in lanes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.engine.codegen import Module
from knode_cosserat.engine.equations import MOST_OPERATIONS, PLACE, RUN, STEP, constant_zeros
from knode_cosserat.engine.pattern import Pattern, compiled, parameters_of
from knode_cosserat.engine.program import Program
from knode_cosserat.rods.system import System


class PlaceCode:
    """Machine code of a function of a system, a place s (m) and a control."""

    def __init__(
        self, function: Callable[[Any, Any, Any], Any], system: System, controls: int, lanes: int = 8
    ):
        leaves, tree = jax.tree.flatten(system)
        program, self.lanes = Program(MOST_OPERATIONS), lanes
        parameters = [program.inputs(f"p{k}", np.shape(leaf), RUN) for k, leaf in enumerate(leaves)]
        folded = [
            np.where(constant_zeros(leaf), program.constant(0.0), nodes)
            for leaf, nodes in zip(leaves, parameters, strict=True)
        ]
        s, control = program.inputs("s", (), PLACE), program.inputs("control", (controls,), STEP)
        traced, self.result = jax.make_jaxpr(
            lambda leaves, s, control: function(jax.tree.unflatten(tree, leaves), s, control),
            return_shape=True,
        )(leaves, np.zeros(()), np.zeros(controls))
        outputs = program.evaluate(traced, [*folded, s, control])
        nodes = [int(node) for each in outputs for node in each.reshape(-1)]
        self.size, inputs = len(nodes), [*(n for each in parameters for n in each.reshape(-1)), *control]
        module, needed = Module(), set(program.needed(nodes))
        f = module.function("run", ["data", "places", "results", "n_places"], exported=True)
        data, places, results, count = f.arguments
        known = {int(node): f.load(data, k) for k, node in enumerate(inputs) if int(node) in needed}
        with f.loop(count, 0, lanes) as j:
            here = known | {s.item(): f.load(places, j.value, lanes)}
            values, target = f.evaluate(program, nodes, here, lanes), f.pointer(results, j.value)
            for k, node in enumerate(nodes):
                f.store(values[node], target, count * k, lanes)
        self._run = module.compile()["run"]

    def evaluate(self, data: np.ndarray, s: Float[np.ndarray, " n"]) -> Any:
        """Return results at places (n, ...), of parameters and control in one vector."""
        places = np.pad(s, (0, -len(s) % self.lanes), mode="edge")
        found = np.empty((self.size, len(places)))
        self._run(data.ctypes.data, places.ctypes.data, found.ctypes.data, len(places))
        shapes, structure = jax.tree.flatten(self.result)
        ends = np.cumsum([int(np.prod(each.shape)) for each in shapes])[:-1]
        parts = np.split(found[:, : len(s)].T, ends, axis=1)
        return jax.tree.unflatten(
            structure, [part.reshape(-1, *each.shape) for part, each in zip(parts, shapes, strict=True)]
        )


def values_along(function: Callable[[Any, Any, Any], Any], system: System, s: Any, control: Any = ()) -> Any:
    """Return a function (system, s, control) at places s (n,), in m: its results with one more axis in front.

    Raises:
        EngineError: the engine does not cover the function.
    """
    pattern, control = Pattern.of(system), np.asarray(control, dtype=float)
    code = compiled(
        (pattern, function, len(control)), lambda: PlaceCode(function, pattern.system, len(control))
    )
    return code.evaluate(np.concatenate([parameters_of(system), control]), np.asarray(s, dtype=float))
