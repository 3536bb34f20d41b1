"""Machine code of single operations against NumPy, on numbers and on vectors, with NaN and infinity."""

import functools

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.special

from knode_cosserat.engine import elementary
from knode_cosserat.engine.codegen import Module
from knode_cosserat.engine.program import Program

VALUES = np.array([-2.5, -1.0, -0.3, 0.0, 0.4, 1.0, np.nan, np.inf])
ONE = {
    "neg": np.negative, "abs": np.abs, "exp": np.exp, "sin": np.sin, "cos": np.cos, "tan": np.tan,
    "tanh": np.tanh, "atan": np.arctan, "expm1": np.expm1, "floor": np.floor, "erf": scipy.special.erf,
    "sqrt": np.sqrt, "log": np.log, "log1p": np.log1p, "asin": np.arcsin, "acos": np.arccos,
    "logistic": scipy.special.expit,
}  # fmt: skip
TWO = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "max": np.maximum,
    "min": np.minimum,
    "atan2": np.arctan2,
    "rem": np.fmod,
}


@pytest.mark.parametrize("lanes", [1, 8])
def test_operations_are_those_of_numpy(lanes):
    program, module = Program(), Module()
    x, y = program.input("x", 1), program.input("y", 1)
    nodes = [program.apply(name, x) for name in ONE] + [program.apply(name, x, y) for name in TWO]
    f = module.function("run", ["x", "y", "out"], exported=True)
    left, right, out = f.arguments
    known = {x: f.load(left, 0, lanes), y: f.load(right, 0, lanes)}
    found = f.evaluate(program, nodes, known, lanes)
    for k, node in enumerate(nodes):
        f.store(found[node], out, k * lanes, lanes)
    run = module.compile()["run"]
    for first in range(0, len(VALUES), lanes):
        one = VALUES[first : first + lanes].copy()
        for shift in range(len(VALUES)):
            other = np.roll(VALUES, shift)[first : first + lanes].copy()
            numbers = np.zeros((len(nodes), lanes))
            run(one.ctypes.data, other.ctypes.data, numbers.ctypes.data)
            with np.errstate(all="ignore"):
                wanted = [g(one) for g in ONE.values()] + [g(one, other) for g in TWO.values()]
            for name, got, value in zip([*ONE, *TWO], numbers, wanted, strict=True):
                np.testing.assert_allclose(got, value, rtol=1e-14, atol=1e-15, err_msg=name)


@functools.cache
def vector_function(name):
    """Return a function of eight numbers as machine code."""
    program, module = Program(), Module()
    x = program.input("x", 1)
    f = module.function("run", ["x", "out"], exported=True)
    node = program.apply(name, x)
    f.store(f.evaluate(program, [node], {x: f.load(f.arguments[0], 0, 8)}, 8)[node], f.arguments[1], 0, 8)
    run = module.compile()["run"]

    def values(numbers):
        given, found = np.array(numbers, dtype=float), np.zeros(8)
        run(given.ctypes.data, found.ctypes.data)
        return found

    return values


SPECIAL = [
    0.0,
    -0.0,
    5e-324,
    -5e-324,
    1e-310,
    np.inf,
    -np.inf,
    np.nan,
    1e300,
    -1e300,
    709.7,
    709.79,
    -744.5,
    -745.2,
]


@pytest.mark.parametrize("name", elementary.FUNCTIONS)
@hypothesis.settings(max_examples=400, deadline=None)
@hypothesis.given(
    st.lists(st.one_of(st.floats(), st.floats(-1e3, 1e3), st.floats(-2.0, 2.0)), min_size=8, max_size=8)
)
@hypothesis.example(SPECIAL[:8])
@hypothesis.example(SPECIAL[6:])
@hypothesis.example([np.pi / 4, np.pi / 2, -np.pi / 2, np.pi, 355.0, 710.0, 1.0 + 2e-16, -1.0])
def test_functions_of_vectors_are_right_to_two_units_in_the_last_place(name, numbers):
    """The reference has 64 bits; all special values, and results that are not normal numbers, are NumPy's."""
    with np.errstate(all="ignore"):
        wanted = getattr(np, name)(np.array(numbers, dtype=np.longdouble)).astype(float)
    unit = np.spacing(np.abs(np.where(np.isfinite(wanted), wanted, 0.0)))
    np.testing.assert_array_equal(np.isnan(wanted), np.isnan(found := vector_function(name)(numbers)))
    finite = np.isfinite(wanted)
    np.testing.assert_array_equal(found[~finite], wanted[~finite])
    assert np.all(np.abs(found - wanted)[finite] <= 2.0 * unit[finite]), (found, wanted)
