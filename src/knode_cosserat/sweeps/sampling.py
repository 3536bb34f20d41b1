"""Points of the unit cube by index: a range of points is computed without those before it.

Point k depends on the seed and on k only (and on the number of points, for the Latin hypercube), so that any
worker can compute any part of a sweep.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.sweeps.errors import SweepError

#: samplers by name, with their meaning
SAMPLERS = {
    "grid": "every combination of the values",
    "sobol": "scrambled Sobol points (SciPy); best with a power of two",
    "halton": "scrambled Halton points (SciPy)",
    "latin-hypercube": "one point in each of n strata of every variable",
    "random": "independent uniform points",
}
#: largest number of Sobol points: SciPy's points have 30 bits
MOST_SOBOL = 2**30
#: rounds of the keyed permutation; four suffice for a pseudo-random one (Luby and Rackoff, 1988)
ROUNDS = 6

_MIX = tuple(np.uint64(each) for each in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


def unit_points(
    sampler: str, span: tuple[int, int], dimensions: int, samples: int, seed: int
) -> Float[np.ndarray, "n d"]:
    """Return points first to last (exclusive) of a sampler, each in [0, 1)."""
    first, last = span
    if dimensions == 0 or last <= first:
        return np.zeros((max(0, last - first), dimensions))
    if sampler in ("sobol", "halton"):
        return _quasi_random(sampler, span, dimensions, seed)
    jitter = _uniform(span, dimensions, seed)
    if sampler == "random":
        return jitter
    if sampler != "latin-hypercube":
        raise SweepError(f"sampler is {sampler!r}; allowed is {', '.join(SAMPLERS)}")
    index = np.arange(first, last)
    strata = [permuted(index, samples, key=(seed, d)) for d in range(dimensions)]
    return np.minimum((np.stack(strata, axis=1) + jitter) / samples, np.nextafter(1.0, 0.0))


def _quasi_random(sampler: str, span: tuple[int, int], dimensions: int, seed: int) -> Any:
    from scipy.stats import qmc

    kind = qmc.Sobol if sampler == "sobol" else qmc.Halton
    if sampler == "sobol" and dimensions > qmc.Sobol.MAXDIM:
        raise SweepError(
            f"{dimensions} variables; allowed is up to {qmc.Sobol.MAXDIM} with the sampler sobol"
        )
    engine = kind(dimensions, scramble=True, seed=np.random.default_rng(seed))
    first, last = span
    if first:
        engine.fast_forward(first)
        return engine.random(last - first)
    # SciPy warns of a first draw of Sobol points that is no power of two
    begin = engine.random(1)
    return np.concatenate([begin, engine.random(last - 1)]) if last > 1 else begin


def _uniform(span: tuple[int, int], dimensions: int, seed: int) -> Float[np.ndarray, "n d"]:
    """Return uniform numbers by a counter-based generator, at the counter of the first point."""
    # four numbers a count
    width = 4 * math.ceil(dimensions / 4)
    bits = np.random.Philox(np.random.SeedSequence([seed, 1]))
    bits.advance(span[0] * width // 4)
    return np.random.Generator(bits).random((span[1] - span[0], width))[:, :dimensions]


def permuted(index: Int[np.ndarray, " n"], size: int, key: tuple[int, ...]) -> Int[np.ndarray, " n"]:
    """Return the places of indices in a keyed pseudo-random permutation of 0 to size - 1.

    A Feistel network permutes a power of four that is at least `size`. Values beyond `size` are permuted
    again until they are inside (cycle walking).
    """
    bits = max(1, math.ceil(math.log2(max(2, size)) / 2))
    half, low = np.uint64(bits), np.uint64(2**bits - 1)
    keys = np.random.SeedSequence(list(key)).generate_state(ROUNDS, np.uint64)
    found = np.asarray(index, dtype=np.uint64)
    outside = np.ones(found.shape, dtype=bool)
    while np.any(outside):
        left, right = found[outside] >> half, found[outside] & low
        for each in keys:
            left, right = right, left ^ (mixed(right + each) & low)
        found[outside] = (left << half) | right
        outside = found >= np.uint64(size)
    return found.astype(np.int64)


def mixed(values: Any) -> Any:
    """Return 64-bit integers with their bits mixed (SplitMix64; Steele, Lea and Flood, 2014)."""
    with np.errstate(over="ignore"):
        found = np.asarray(values, dtype=np.uint64) + _MIX[0]
        found = (found ^ (found >> np.uint64(30))) * _MIX[1]
        found = (found ^ (found >> np.uint64(27))) * _MIX[2]
        return found ^ (found >> np.uint64(31))


def case_seeds(seed: int, index: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Return a seed of 31 bits for every sample of a sweep."""
    own = np.random.SeedSequence([seed, 2]).generate_state(1, np.uint64)[0]
    return (mixed(mixed(np.asarray(index, dtype=np.uint64)) ^ own) >> np.uint64(33)).astype(np.int64)
