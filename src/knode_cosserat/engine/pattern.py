"""Machine code of a process, kept by the pattern of a system, and functions of a system along the rod."""

from __future__ import annotations

import dataclasses
import functools
import gc
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.engine.codegen import Module, vector_lanes
from knode_cosserat.engine.counts import in_room
from knode_cosserat.engine.equations import MOST_OPERATIONS, PLACE, RUN, STEP, constant_zeros, is_moving
from knode_cosserat.engine.program import EngineError, Program
from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.system import System, is_traced

#: compiled code, or the reason why there is none, by what it depends on; the last used come last
_CODES: dict[Any, Any] = {}
#: number of codes that a process keeps: that of a time loop takes about 5 MB
MOST_CODES = 100
#: time (s) from which a terminal says that code is compiled
PATIENCE = 2.0
_COMPILING = threading.Lock()

Code = TypeVar("Code")


@dataclasses.dataclass(frozen=True)
class Pattern:
    """Structure of a system, and its parameters that are zero: constants of the code."""

    structure: Any
    #: shape of each leaf, and its zeros as bits
    zeros: tuple[tuple[tuple[int, ...], bytes], ...]

    @staticmethod
    @kept
    def of(system: System) -> Pattern:
        """Return the pattern of a system; zeros of a batch are those of all, and no traced value is one."""
        leaves, structure = jax.tree.flatten(system)
        axis, zeros = np.ndim(system.length), []
        for leaf in leaves:
            known = np.ones(np.shape(leaf)) if is_traced(leaf) else np.asarray(leaf, float)
            # any number for a parameter that is not zero in all robots of a batch
            zeros.append(constant_zeros(np.any(is_moving(known), axis=tuple(range(axis))).astype(float)))
        return Pattern(structure, masks_of(zeros))

    @functools.cached_property
    def system(self) -> System:
        """A system of this pattern, with ones for all other parameters."""
        leaves = []
        for shape, bits in self.zeros:
            size = int(np.prod(shape))
            mask = np.unpackbits(np.frombuffer(bits, np.uint8), count=size).reshape(shape)
            leaves.append(1.0 - mask)
        return jax.tree.unflatten(self.structure, leaves)

    @functools.cached_property
    def in_room(self) -> Pattern:
        """The pattern of this structure for which code is written, which serves other grids too."""
        return Pattern(jax.tree.structure(in_room(self.system)), self.zeros)


def _say() -> None:
    if sys.stderr is not None and sys.stderr.isatty():
        print("knode_cosserat: compiling …", file=sys.stderr, flush=True)


def masks_of(masks: Iterable[np.ndarray]) -> Any:
    """Return shapes and bits of masks, which can be compared."""
    return tuple((mask.shape, np.packbits(mask).tobytes()) for mask in masks)


def compiled(
    key: tuple[Any, ...], kind: type[Code], build: Callable[[], Code], given: Mapping[str, Any] | None = None
) -> Code:
    """Return compiled code of a kind that is kept by a key, in this process and on disk.

    `given` are its attributes that are not stored on disk.

    Raises:
        EngineError: the engine does not cover the system or the settings.
    """
    with _COMPILING:
        code: Any = _CODES.pop(key, None)
        if code is None:
            patience = threading.Timer(PATIENCE, _say)
            patience.daemon = True
            patience.start()
            # tracing makes many objects that live on: a tenth of its time was collections
            collects = gc.isenabled()
            gc.disable()
            try:
                # also while JAX traces a caller: equations are traced by themselves
                with jax.core.eval_context():
                    code = _kept_on_disk((kind, *key), kind, build, given or {})
            except EngineError as error:
                # without the frames that a traceback keeps alive
                code = error.with_traceback(None)
            finally:
                patience.cancel()
                if collects:
                    gc.enable()
        _CODES[key] = code
        if len(_CODES) > MOST_CODES:
            del _CODES[next(iter(_CODES))]
    if isinstance(code, EngineError):
        raise code.with_traceback(None)
    return code


def _kept_on_disk(
    key: tuple[Any, ...], kind: type[Code], build: Callable[[], Code], given: Mapping[str, Any]
) -> Code:
    from knode_cosserat.engine import sidecars  # which need all of the engine

    name = sidecars.name_of([each.system if isinstance(each, Pattern) else each for each in key])
    attributes = None if name is None else sidecars.restore(name)
    if attributes is not None:
        code = kind.__new__(kind)
        vars(code).update(attributes, **given)
        return code
    code = build()
    sidecars.forget_writers(code)
    if name is not None:
        sidecars.keep(name, code, given)
    return code


@kept
def packed(system: System) -> np.ndarray:
    """Return the numeric parameters of a system (n,), or of a batch of robots (robots, n)."""
    axes = np.shape(system.length)
    leaves = [np.asarray(leaf, float).reshape(*axes, -1) for leaf in jax.tree.leaves(system)]
    return np.concatenate(leaves, axis=-1)


class _PlaceCode:
    """Machine code of a function of a system, a place s (m) and a control."""

    def __init__(self, function: Callable[[Any, Any, Any], Any], system: System, controls: int):
        leaves, tree = jax.tree.flatten(system)
        program, self.lanes = Program(MOST_OPERATIONS), vector_lanes()
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
        with f.loop(count, 0, self.lanes) as j:
            here = known | {s.item(): f.load(places, j.value, self.lanes)}
            values, target = f.evaluate(program, nodes, here, self.lanes), f.pointer(results, j.value)
            for k, node in enumerate(nodes):
                f.store(values[node], target, count * k, self.lanes)
        self._functions = module.compile()

    def evaluate(self, data: np.ndarray, s: Float[np.ndarray, " n"]) -> Any:
        """Return results at places (n, ...), of parameters and control in one vector."""
        places = np.pad(s, (0, -len(s) % self.lanes), mode="edge")
        found = np.empty((self.size, len(places)))
        self._functions.run("run", data, places, found, len(places))
        shapes, structure = jax.tree.flatten(self.result)
        ends = np.cumsum([int(np.prod(each.shape)) for each in shapes])[:-1]
        parts = np.split(found[:, : len(s)].T, ends, axis=1)
        return jax.tree.unflatten(
            structure, [part.reshape(-1, *each.shape) for part, each in zip(parts, shapes, strict=True)]
        )


def values_along(function: Callable[[Any, Any, Any], Any], system: System, s: Any, control: Any = ()) -> Any:
    """Return a function (system, s, control) at places s (n,), in m: its results with one more axis in front.

    A batch of robots has places (robots, n), and results with two more axes.

    Raises:
        EngineError: the engine does not cover the function.
    """
    pattern, control = Pattern.of(system).in_room, np.asarray(control, dtype=float)
    code = compiled(
        (pattern, function, len(control)),
        _PlaceCode,
        lambda: _PlaceCode(function, pattern.system, len(control)),
    )
    s = np.asarray(s, dtype=float)
    if s.ndim == 1:
        return code.evaluate(np.concatenate([packed(system), control]), s)
    found = [
        code.evaluate(np.append(own, control), places) for own, places in zip(packed(system), s, strict=True)
    ]
    return jax.tree.map(lambda *parts: np.stack(parts), *found)
