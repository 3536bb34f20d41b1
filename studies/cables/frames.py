"""Orientations of many points at once: quaternions (…, 4), scalar first, as NumPy arrays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: the axis of a rod in its own frame
AXIS = np.array([0.0, 0.0, 1.0])


def unit(vectors: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n k"]:
    """Return vectors divided by their lengths."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def cross(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return cross products; `numpy.cross` takes ten times as long for few vectors."""
    a, b = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], axis=-1
    )


def quaternion_product(
    a: Float[np.ndarray, "*n 4"], b: Float[np.ndarray, "*n 4"]
) -> Float[np.ndarray, "*n 4"]:
    """Return the rotation b followed by a, as a ∘ b."""
    real = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + cross(a[..., 1:], b[..., 1:])
    return np.concatenate([real, vector], axis=-1)


def conjugate(h: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
    """Return the inverse rotations."""
    return h * np.array([1.0, -1.0, -1.0, -1.0])


def rotated(h: Float[np.ndarray, "*n 4"], vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return vectors rotated by quaternions of length one."""
    twice = 2.0 * cross(h[..., 1:], vectors)
    return vectors + h[..., :1] * twice + cross(h[..., 1:], twice)


def from_vector(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 4"]:
    """Return the rotations about vectors by their lengths (rad)."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2.0), 0.5 * np.sinc(angle / (2.0 * np.pi)) * vectors], axis=-1)


def to_vector(h: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 3"]:
    """Return rotation vectors of at most π (rad)."""
    h = np.where(h[..., :1] < 0.0, -h, h)
    sine = np.linalg.norm(h[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, h[..., :1])
    return np.where(sine < 1e-12, 2.0, angle / np.maximum(sine, 1e-12)) * h[..., 1:]


def shortest(a: Float[np.ndarray, "*n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 4"]:
    """Return the rotations without twist that take the directions a to b.

    Of opposite directions the axis is arbitrary, but finite.
    """
    a, b = np.broadcast_arrays(a, b)
    real = 1.0 + np.sum(a * b, axis=-1, keepdims=True)
    return unit(np.concatenate([np.maximum(real, 1e-9), cross(a, b)], axis=-1))


def continuous(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Return the same rotations by vectors that do not jump by a full turn from row to row."""
    found = np.array(vectors)
    for k in range(1, len(found)):
        angle = np.linalg.norm(found[k])
        if angle > 1e-9:
            turns = np.round((found[k - 1] @ found[k] / angle - angle) / (2.0 * np.pi))
            found[k] *= 1.0 + 2.0 * np.pi * turns / angle
    return found


def mean_of_two(a: Float[np.ndarray, "*n 4"], b: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
    """Return the rotations midway between neighbouring ones."""
    same = np.sum(a * b, axis=-1, keepdims=True) >= 0.0
    return unit(a + np.where(same, b, -b))


def along_curve(
    edges: Float[np.ndarray, "n 3"], first: Float[np.ndarray, "4"], last: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "n 4"]:
    """Return the frames of a curve's edges between given frames at its ends.

    Each has its axis along the edge. The twist between the ends, at most half a turn, is spread evenly.
    """
    directions = unit(edges)
    before = np.concatenate([rotated(first, AXIS)[None], directions[:-1]])
    frames = np.empty((len(directions), 4))
    w, x, y, z = first.tolist()
    for k, (a, b, c, d) in enumerate(shortest(before, directions).tolist()):
        w, x, y, z = (
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        )
        frames[k] = w, x, y, z
    frame, along = frames[-1], directions[-1]
    end = quaternion_product(shortest(along, rotated(last, AXIS)), frame)
    left = quaternion_product(conjugate(end), last)
    twist = 2.0 * np.arctan2(left[3], left[0])
    twist = (twist + np.pi) % (2.0 * np.pi) - np.pi
    half = 0.5 * twist * (np.arange(len(frames)) + 0.5) / len(frames)
    zero = np.zeros_like(half)
    return quaternion_product(frames, np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1))
