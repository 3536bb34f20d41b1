"""Points of the unit cube by index, so that any worker can compute any part of a sweep.

Point k depends on the seed and on k only (and on the number of points, for the Latin hypercube).
"""

from __future__ import annotations

import functools
import math

import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.sweeps._description import SweepError


def unit_points(
    sampler: str, span: tuple[int, int], dimensions: int, samples: int, seed: int
) -> Float[np.ndarray, "n d"]:
    """Return points first to last (exclusive) of a sampler, each in [0, 1)."""
    first, last = span
    if dimensions == 0 or last <= first:
        return np.zeros((max(0, last - first), dimensions))
    if sampler == "random":
        return _uniform(span, dimensions, (seed, 1))
    if sampler == "latin-hypercube":
        return _latin_hypercube(samples, dimensions, seed)[first:last]
    from scipy.stats import qmc

    if sampler == "sobol" and dimensions > qmc.Sobol.MAXDIM:
        raise SweepError(
            f"{dimensions} variables; allowed is up to {qmc.Sobol.MAXDIM} with the sampler sobol"
        )
    kind = qmc.Sobol if sampler == "sobol" else qmc.Halton
    engine = kind(dimensions, scramble=True, seed=np.random.default_rng(seed))
    if first:
        engine.fast_forward(first)
        return np.asarray(engine.random(last - first))
    # SciPy warns of a first draw of Sobol points that is no power of two
    head = engine.random(1)
    return np.concatenate([head, engine.random(last - 1)]) if last > 1 else head


@functools.lru_cache(maxsize=1)
def _latin_hypercube(samples: int, dimensions: int, seed: int) -> Float[np.ndarray, "n d"]:
    from scipy.stats import qmc

    points = qmc.LatinHypercube(dimensions, seed=np.random.default_rng(seed)).random(samples)
    return np.clip(points, 0.0, np.nextafter(1.0, 0.0))


def _uniform(span: tuple[int, int], dimensions: int, key: tuple[int, int]) -> Float[np.ndarray, "n d"]:
    """Return uniform numbers by a counter-based generator, at the counter of the first point."""
    # four numbers a count
    width = 4 * math.ceil(dimensions / 4)
    bits = np.random.Philox(np.random.SeedSequence(list(key)))
    bits.advance(span[0] * width // 4)
    return np.random.Generator(bits).random((span[1] - span[0], width))[:, :dimensions]


def case_seeds(seed: int, span: tuple[int, int]) -> Int[np.ndarray, " n"]:
    """Return a seed of 31 bits for samples first to last (exclusive) of a sweep."""
    return (_uniform(span, 1, (seed, 2))[:, 0] * 2**31).astype(np.int64)
