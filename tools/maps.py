"""Errors of simple learned maps from controls to tip on the splits of docs/real-robots.md.

    python -m tools.maps trunk=observations_controlled_11.csv.gz three-cables servo=v6_train.csv,v6_val.csv
    python -m tools.maps beam=recordings

Each map's own numbers are chosen by blocks of training rows that are left out in turn; the held-out rows are
predicted once, by the best of each kind:

    linear    affine map of the controls, and of those some rows before
    kernel    ridge regression with a Gaussian kernel of the same
    echo      echo-state network: a reservoir that remembers the controls, and a linear map of its states

A release of the beam has no controls: it is predicted by the training recording with the same load.
"""

import itertools
import sys
from pathlib import Path

import numpy as np

import knode_cosserat as kc
from knode_cosserat.recordings import RecordingConfig
from studies import beam
from tools.pictures import ROOT

EXAMPLES = ROOT / "examples"
#: blocks of training rows, and rows between kept rows of a motion (10 a second)
BLOCKS, DT = 6, 0.1
RIDGES = (1e-6, 1e-4, 1e-2, 1e-1, 1.0, 10.0)
#: time from a beam's release until its drop is seen (s)
RELEASED = 0.03
#: rows before that a map sees, for motions
LAGS = ((), (1,), (1, 2, 4), (1, 2, 4, 8))
#: units of the reservoir, its radii, and how much of each state is new
UNITS, RADII, LEAKS, INPUTS = 200, (0.5, 0.9), (0.1, 0.3, 1.0), (0.3, 1.0)


def with_lags(u, lags):
    """Return controls (T, c) beside those some rows before."""
    return np.hstack([u, *(np.concatenate([np.repeat(u[:1], k, axis=0), u[:-k]]) for k in lags)])


def ridge(X, Y, strength):
    """Return the weights of standardised features, the constant last."""
    X = np.hstack([X, np.ones((len(X), 1))])
    square = X.T @ X + strength * len(X) * np.diag([*np.ones(X.shape[1] - 1), 1e-9])
    return np.linalg.solve(square, X.T @ Y)


def linear(u, options):
    """Return a function of (training rows, their values) that predicts all rows."""
    lags, strength = options
    X = with_lags(u, lags)

    def fitted(rows, Y):
        W = ridge(X[rows], Y, strength)
        return X @ W[:-1] + W[-1]

    return fitted


def kernel(u, options):
    """Return the same by a Gaussian kernel, about the mean of the training rows."""
    lags, strength, reach = options
    X = with_lags(u, lags)
    distance = np.sum((X[:, None] - X) ** 2, axis=-1) / (X.shape[1] * reach**2)
    K = np.exp(-0.5 * distance)

    def fitted(rows, Y):
        mean = Y.mean(axis=0)
        inner = K[np.ix_(rows, rows)] + strength * np.eye(len(rows))
        return mean + K[:, rows] @ np.linalg.solve(inner, Y - mean)

    return fitted


def echo(u, options):
    """Return the same by a reservoir of fixed random units with memory."""
    radius, leak, size, strength = options
    rng = np.random.default_rng(0)
    inner = rng.normal(size=(UNITS, UNITS))
    inner *= radius / np.max(np.abs(np.linalg.eigvals(inner)))
    outer = size * rng.normal(size=(UNITS, u.shape[1] + 1))
    state, states = np.zeros(UNITS), []
    for row in np.hstack([u, np.ones((len(u), 1))]):
        state = (1.0 - leak) * state + leak * np.tanh(inner @ state + outer @ row)
        states.append(state)
    X = np.hstack([np.array(states), u])

    def fitted(rows, Y):
        W = ridge(X[rows], Y, strength)
        return X @ W[:-1] + W[-1]

    return fitted


def candidates(moving):
    """Return the numbers that are tried, by kind of map."""
    lags = LAGS if moving else LAGS[:1]
    kinds = {
        linear: itertools.product(lags, RIDGES),
        kernel: itertools.product(lags, RIDGES, (0.3, 0.5, 1.0, 2.0, 4.0)),
    }
    if moving:
        kinds[echo] = itertools.product(RADII, LEAKS, INPUTS, RIDGES)
    return kinds


def errors(control, tip, count, moving):
    """Return the held-out error (m) of the best map of each kind, with its numbers.

    Args:
        control: (T, c), of the training rows and then of the others.
        tip: (T, 3), NaN where it was not seen.
        count: number of training rows.
        moving: true for motions, in which maps may look back.
    """
    train = control[:count]
    u = (control - train.mean(axis=0)) / np.where(train.std(axis=0) > 0.0, train.std(axis=0), 1.0)
    known = np.isfinite(tip).all(axis=1)
    blocks = np.arange(count) * BLOCKS // count
    found = {}
    for make, several in candidates(moving).items():
        scored = []
        for options in several:
            fitted = make(u, options)
            squares = 0.0
            for k in range(BLOCKS):
                rows = np.flatnonzero(known[:count] & (blocks != k))
                left = np.flatnonzero(known[:count] & (blocks == k))
                squares += np.sum((fitted(rows, tip[rows])[left] - tip[left]) ** 2)
            scored.append((np.sqrt(squares / known[:count].sum()), options))
        best, options = min(scored, key=lambda it: it[0])
        rows, left = np.flatnonzero(known[:count]), count + np.flatnonzero(known[count:])
        off = make(u, options)(rows, tip[rows])[left] - tip[left]
        found[make.__name__] = (float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(best), options)
    return found


def joined(*rows):
    """Return controls and tips of rows, and the number of the first."""
    control, tip = ([getattr(it, name) for it in rows] for name in ("control", "tip_position"))
    return np.concatenate(control), np.concatenate(tip), len(rows[0].time)


def of_trunk(path):
    """Return the rows of the trunk: 30 s to learn from, and the next."""
    read = kc.load_recording(path, RecordingConfig.load(EXAMPLES / "asl_trunk" / "recording.yaml"))
    rows = read.sampled(DT, mean=True)
    return *joined(rows.between(0.0, 30.0), rows.between(30.0, np.inf)), True


def of_files(folder, paths):
    """Return the rows of equilibria in two files."""
    config = RecordingConfig.load(EXAMPLES / folder / "recording.yaml")
    return *joined(*(kc.load_recording(path, config).sampled() for path in paths)), False


def three_cables(paths):
    """Return the rows of the robot with three cables; by default those of the examples."""
    own = [EXAMPLES / "three_cables" / name for name in ("identify.csv", "held_out.csv")]
    return of_files("three_cables", paths.split(",") if paths else own)


def replayed(folder):
    """Return the error (m) of each beam that was held out, if the training release is played once more."""
    recordings = beam.read_folder(Path(folder))
    train = [it for it in recordings if it.name in beam.training_names(recordings)]
    found = {}
    for it in recordings:
        for known in train:
            if it.load == known.load and it.name != known.name:
                at = it.time - it.crossing + known.crossing
                columns = known.tip.reshape(len(known.time), -1).T
                rows = [np.interp(at, known.time, each, right=np.nan) for each in columns]
                predicted = np.stack(rows, axis=1).reshape(-1, 3, 3)
                predicted[it.time < it.crossing - RELEASED] = np.nan
                found[it.name] = beam.marker_rmse(predicted, it)
    return found


ROBOTS = {
    "trunk": of_trunk,
    "three-cables": three_cables,
    "servo": lambda paths: of_files("servo_robot", paths.split(",")),
}

if __name__ == "__main__":
    for name, _, paths in (it.partition("=") for it in sys.argv[1:]):
        if name == "beam":
            for file, error in replayed(paths).items():
                print(f"beam, replay: {1e3 * error:.2f} mm on {file}", flush=True)
            continue
        for kind, (error, left_out, options) in errors(*ROBOTS[name](paths)).items():
            print(
                f"{name}, {kind}: {1e3 * error:.2f} mm held out, {1e3 * left_out:.2f} mm on training rows "
                f"left out, with {options}",
                flush=True,
            )
