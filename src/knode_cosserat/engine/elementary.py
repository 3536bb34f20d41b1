"""Elementary functions of vectors, as functions of a module: exp, expm1, log, log1p, sin, cos, tan, tanh.

Each reduces its argument to a small interval and evaluates a polynomial there, in all lanes at once; errors
are below two units in the last place. Coefficients of log, sin and cos, and the reduction of angles, are
those of fdlibm (Sun Microsystems, 1993); exp uses the Taylor polynomial. Angles beyond `LARGEST_ANGLE`, at
which more digits of π are needed, are left to the C library.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from knode_cosserat.engine.codegen import Function, Value

#: ln 2 and π/2 as sums of numbers; products of all but the last with small whole numbers are exact
LN2 = 6.93147180369123816490e-01, 1.90821492927058770002e-10
HALF_PI = 1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21
LARGEST_ANGLE = 1000.0
#: 1.5·2⁵²: its sum with a small whole number has this number in the last bits
WHOLE = 6755399441055744.0
#: highest power of the Taylor polynomial of exp, for |x| < ln(2)/2
EXP_POWER = 13
LOG = (
    6.666666666666735130e-01,
    3.999999999940941908e-01,
    2.857142874366239149e-01,
    2.222219843214978396e-01,
    1.818357216161805012e-01,
    1.531383769920937332e-01,
    1.479819860511658591e-01,
)
SIN = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
COS = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)


def _polynomial(x: Any, coefficients: Sequence[Any]) -> Any:
    """Return c₀ + c₁ x + … by Estrin's scheme: sums that do not wait for each other."""
    if len(coefficients) == 1:
        return coefficients[0]
    pairs = itertools.zip_longest(coefficients[::2], coefficients[1::2])
    return _polynomial(x * x, [a if b is None else a + x * b for a, b in pairs])


def _bits(f: Function, x: Value) -> Value:
    return f.result(f"bitcast {x.type} {x.name} to <{x.lanes} x i64>", "i64", x.lanes)


def _number(f: Function, x: Value) -> Value:
    return f.result(f"bitcast {x.type} {x.name} to <{x.lanes} x double>", "double", x.lanes)


def _whole(f: Function, operation: str, x: Value, other: Any) -> Value:
    """Return an operation of whole numbers in lanes, with others or with one number."""
    other = f.splat(f.value(other, "i64"), x.lanes)
    return f.result(f"{operation} {x.type} {x.name}, {other.name}", "i64", x.lanes)


def _power(f: Function, k: Value) -> Value:
    """Return 2ᵏ for whole numbers from -1022 to 1023."""
    return _number(f, _whole(f, "shl", _bits(f, k + (WHOLE + 1023.0)), 52))


def _reduce(f: Function, x: Value) -> tuple[Value, Value]:
    """Return k and exp(r) - 1, with exp(x) = 2ᵏ exp(r)."""
    k = f.intrinsic("roundeven", x * (1.0 / math.log(2.0)))
    r = (x - k * LN2[0]) - k * LN2[1]
    tail = _polynomial(r, [1.0 / math.factorial(n) for n in range(2, EXP_POWER + 1)])
    return k, r + r * r * tail


def exp(f: Function, x: Value) -> Value:
    """Return the exponential function; very large and small results by two factors, rounded once."""
    k, grown = _reduce(f, x)
    shift = _whole(f, "shl", _bits(f, k + WHOLE), 52)
    found = f.variable(_number(f, _whole(f, "add", _bits(f, 1.0 + grown), shift)))
    with f.if_(f.any(~(f.apply("abs", x) < 708.0))):
        bounded = f.select(x > 720.0, 720.0, f.select(x < -760.0, -760.0, x))
        k, grown = _reduce(f, bounded)
        half = f.apply("floor", k * 0.5)
        found.set((1.0 + grown) * _power(f, half) * _power(f, k - half))
    return found.get()


def expm1(f: Function, x: Value) -> Value:
    """Return the exponential function less 1."""
    x = f.select(x > 709.9, 709.9, f.select(x < -100.0, -100.0, x))
    k, grown = _reduce(f, x)
    scale = _power(f, k - 1.0)
    return f.select(f.compare("eq", k, 0.0), grown, 2.0 * (scale * grown + (scale - 0.5)))


def _log(f: Function, x: Value, correction: Any) -> Value:
    """Return log(x) + correction/x for positive finite numbers."""
    is_small = x < 2.0**-1000
    scaled = f.select(is_small, x * 2.0**54, x)
    # x = 2ᵏ m with √½ <= m < √2
    shifted = _whole(f, "sub", _bits(f, scaled), 0x3FE6A09E667F3BCD)
    k = _whole(f, "ashr", shifted, 52)
    m = _number(f, _whole(f, "sub", _bits(f, scaled), _whole(f, "shl", k, 52)))
    exponent = f.result(f"sitofp {k.type} {k.name} to {x.type}", "double", x.lanes)
    exponent = exponent - f.select(is_small, 54.0, 0.0)
    g = m - 1.0
    s, half = g / (2.0 + g), 0.5 * g * g
    square = s * s
    rest = s * (half + square * _polynomial(square, LOG)) + (exponent * LN2[1] + correction / x)
    return exponent * LN2[0] - ((half - rest) - g)


def _with_limits(f: Function, x: Value, least: float, found: Value) -> Value:
    """Return a logarithm with its limits: at infinity, and at and below the least argument."""
    infinity = float("inf")
    found = f.select(x > least, found, f.select(f.compare("eq", x, least), -infinity, float("nan")))
    return f.select(f.compare("eq", x, infinity), infinity, found)


def log(f: Function, x: Value) -> Value:
    """Return the natural logarithm."""
    return _with_limits(f, x, 0.0, _log(f, x, 0.0))


def log1p(f: Function, x: Value) -> Value:
    """Return log(1 + x): that of the rounded sum, with a correction."""
    total = 1.0 + x
    lost = f.select(x > 1.0, 1.0 - (total - x), x - (total - 1.0))
    return _with_limits(f, x, -1.0, _log(f, total, lost))


def tanh(f: Function, x: Value) -> Value:
    """Return the hyperbolic tangent, (e - 1)/(e + 1) with e = exp(2|x|), and the sign of x."""
    size = f.apply("abs", x)
    grown = f.apply("expm1", 2.0 * f.select(size > 22.0, 22.0, size))
    return f.intrinsic("copysign", grown / (grown + 2.0), x)


def _sine_and_cosine(f: Function, x: Value) -> tuple[Value, Value, Value]:
    """Return sine and cosine of x - n π/2, at most π/4 large, and n as bits; |x| is at most LARGEST_ANGLE."""
    n = f.intrinsic("roundeven", x * (2.0 / math.pi))
    first, part = x - n * HALF_PI[0], n * HALF_PI[1]
    # the exact error of a difference (Knuth 1969)
    high = first - part
    moved = high - first
    error = (first - (high - moved)) - (part + moved)
    rest = n * HALF_PI[2] - error
    r = high - rest
    low = (high - r) - rest
    z = r * r
    sine = r - ((z * (0.5 * low - r * z * _polynomial(z, SIN[1:])) - low) - r * z * SIN[0])
    half = 0.5 * z
    one = 1.0 - half
    cosine = one + (((1.0 - one) - half) + (z * z * _polynomial(z, COS) - r * low))
    return sine, cosine, _bits(f, n + WHOLE)


def _is_odd(f: Function, bits: Value) -> Value:
    last = _whole(f, "and", bits, 1)
    zeros = f.splat(f.value(0, "i64"), bits.lanes)
    return f.result(f"icmp ne {last.type} {last.name}, {zeros.name}", "i1", bits.lanes)


def _turned(f: Function, x: Value, quarter: int) -> Value:
    """Return the sine of x + quarter π/2."""
    sine, cosine, n = _sine_and_cosine(f, x)
    n = _whole(f, "add", n, quarter)
    found = f.select(_is_odd(f, n), cosine, sine)
    return f.select(_is_odd(f, _whole(f, "lshr", n, 1)), -found, found)


def sin(f: Function, x: Value) -> Value:
    """Return the sine."""
    return _turned(f, x, 0)


def cos(f: Function, x: Value) -> Value:
    """Return the cosine."""
    return _turned(f, x, 1)


def tan(f: Function, x: Value) -> Value:
    """Return the tangent."""
    sine, cosine, n = _sine_and_cosine(f, x)
    odd = _is_odd(f, n)
    return f.select(odd, -cosine, sine) / f.select(odd, sine, cosine)


FUNCTIONS: dict[str, Callable[[Function, Value], Value]] = {
    "exp": exp,
    "expm1": expm1,
    "log": log,
    "log1p": log1p,
    "tanh": tanh,
    "sin": sin,
    "cos": cos,
    "tan": tan,
}
#: functions of angles, which are reduced up to LARGEST_ANGLE
OF_ANGLES = frozenset({"sin", "cos", "tan"})
