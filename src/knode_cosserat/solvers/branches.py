"""Several equilibria under the same controls, each found by Newton's method from another first guess.

The first guesses of a row are the unloaded shape, the mirror image of its known equilibrium about that shape,
the known equilibria under the nearest controls, and those that the system states (`Ends.branches`).
New equilibria are then the first guesses of rows with near controls, until nothing new is found.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.aspects import Drawing, Ends
from knode_cosserat.rods.passport import without_passport
from knode_cosserat.rods.strands import in_strands, strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.guess import turns_between
from knode_cosserat.solvers.rest import unloaded_shape
from knode_cosserat.solvers.run import TimeIntegration, run_batch
from knode_cosserat.trajectory import Trajectory

#: distance of two shapes from which they are two equilibria, as a part of the length
APART = 1e-3
#: rows with the nearest controls whose equilibria are first guesses, and most rounds with new ones
NEIGHBOURS, ROUNDS = 2, 3


def other_equilibria(known: Trajectory) -> tuple[Int[np.ndarray, " K"], Float[np.ndarray, "K N x"]]:
    """Return further equilibria under the controls of known ones: the row of each, and y and z at its nodes.

    They solve the same equations to the same tolerances, are stable or not, and differ from the known one and
    from each other by more than `APART`. There may be more: a search from several guesses proves nothing.

    Args:
        known: equilibria of one robot, each with its control.
    """
    assert known.settings is not None
    system, settings, controls = without_passport(known.system), known.settings, np.asarray(known.control)
    task = TimeIntegration(settings, steps=1, recovery_budget=0.0)
    records = np.concatenate([np.asarray(known.y), np.asarray(known.z)], axis=-1)
    nearest = _nearest(controls)
    every = list(range(len(controls)))
    #: equilibria of each row, and their positions
    found = [[record] for record in records]
    places = [[_positions(system, record)] for record in records]
    solved = np.asarray(known.result) >= 0
    rows, guesses = _first_guesses(system, settings.space, controls, records)
    new = [(k, records[k]) for k in every if solved[k]]
    for _ in range(ROUNDS):
        spread = grid_of(system).spread
        more = [(int(row), spread(y[:, : system.y_layout.size])) for k, y in new for row in nearest[k]]
        rows = np.concatenate([rows, [row for row, _ in more]]).astype(int)
        guesses = np.concatenate([guesses, *(y[None] for _, y in more)])
        new = []
        if not len(rows):
            break
        start = guesses, controls[rows]
        solutions, _, _ = run_batch(task, system, controls[rows][:, None], start, watch=None)
        for k, record, result in zip(rows, solutions.records[:, 0], solutions.result[:, 0], strict=True):
            if result < 0 or not solved[k] or turns_between(system, found[k][0], record):
                continue
            place = _positions(system, record)
            away = [np.max(np.linalg.norm(place - it, axis=-1)) for it in places[k]]
            if min(away) > APART * float(system.length):
                found[k].append(record)
                places[k].append(place)
                new.append((int(k), record))
        rows, guesses = rows[:0], guesses[:0]
    others = [(k, record) for k in every for record in found[k][1:]]
    return (
        np.array([k for k, _ in others], dtype=int),
        np.stack([record for _, record in others]) if others else records[:0],
    )


def _nearest(controls: np.ndarray) -> Int[np.ndarray, "T k"]:
    """Return for each row those with the nearest controls, in units of their ranges."""
    size = np.ptp(controls, axis=0)
    scaled = controls / np.where(size > 0.0, size, 1.0)
    away = np.array([np.linalg.norm(scaled - row, axis=1) for row in scaled])
    np.fill_diagonal(away, np.inf)
    return np.argsort(away, axis=1)[:, : min(NEIGHBOURS, len(controls) - 1)]


def _positions(system: System, record: np.ndarray) -> np.ndarray:
    return np.asarray(Drawing.of(system).positions(record[:, : system.y_layout.size]))


def _first_guesses(
    system: System, space: SpaceScheme, controls: np.ndarray, records: np.ndarray
) -> tuple[Int[np.ndarray, " G"], Float[np.ndarray, "G M y"]]:
    """Return the rows of first guesses that need no other row, and their y at all points."""
    layout, grid, count = strand_of(system).y_layout, grid_of(system, space), len(controls)
    rest = unloaded_shape(system, space)
    along = grid.along[: len(rest)]
    begins = np.array(Ends.of(system).unloaded(rest, along, controls))
    known = np.stack([grid.spread(record[:, : system.y_layout.size]) for record in records])
    mirrored = 2.0 * begins - known
    for rows in layout.ranges("h"):
        # of unit quaternions h and g, 2 (g·h) g - h is the rotation from h back over g
        g, h, image = (in_strands(system, each)[..., rows] for each in (begins, known, mirrored))
        image[...] = 2.0 * np.sum(g * h, axis=-1, keepdims=True) * g - h
    rows, stated = Ends.of(system).branches(rest, along, controls)
    return (
        np.concatenate([np.arange(count), np.arange(count), rows]).astype(int),
        np.concatenate([begins, mirrored, stated]),
    )
