"""Fits that are interrupted, and checkpoints that are of something else or damaged."""

import contextlib
import dataclasses
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from knode_cosserat.learning.config import FitConfig, NetworkOptions, RolloutTraining, Training
from knode_cosserat.learning.states import fit_states
from knode_cosserat.learning.training.checkpoint import (
    CheckpointError,
    Checkpoints,
    Identity,
    data_hash,
    unpacked,
)
from knode_cosserat.learning.training.runs import ProgressMonitor
from tests.learning.bar import BAR, WRONG, pulled

ROOT = Path(__file__).parents[3]
CONFIG = FitConfig(
    NetworkOptions(hidden=5, convex=False, standardised=True),
    Training(epochs=130, schedule="plateau", patience=5),
)
LONG = FitConfig(
    NetworkOptions(hidden=5, convex=False, standardised=True),
    Training(epochs=4000, learning_rate=3e-3),
    RolloutTraining(updates=150, horizon=6),
    seed=(2, 5),
)


def assert_same(one, other):
    """Weights and histories, bit for bit."""
    for found, expected in zip(_members(one), _members(other), strict=True):
        for leaf, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(leaf, wanted)
        for stage in ("segments", "rollouts"):
            ours, theirs = found.about.facts.get(stage), expected.about.facts.get(stage)
            assert (ours is None) == (theirs is None)
            for name in ours or ():
                np.testing.assert_array_equal(ours[name], theirs[name])


def _members(found):
    return [found] if hasattr(found, "residual") else list(found)


def test_an_interrupted_training_keeps_its_weights(monkeypatch):
    """The model so far predicts better than the nominal model, and says that it was interrupted."""
    bars, steps = [pulled(1.0)], ProgressMonitor.steps

    def interrupt(monitor, *arguments):
        steps(monitor, *arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(ProgressMonitor, "steps", interrupt)
    with pytest.raises(KeyboardInterrupt) as caught:
        fit_states(WRONG, bars, CONFIG, checkpoint_every=100)
    found = caught.value.best
    losses = found.about.facts["segments"]["loss"]
    assert found.about.facts["interrupted"] and 1 < len(losses) <= 130 and losses[-1] < losses[0]


class Interruption(Exception):  # noqa: N818
    pass


@pytest.fixture
def interrupted(monkeypatch):
    """Lets a fit fail after so many pieces of work."""

    def after(count):
        left = [count]
        steps = ProgressMonitor.steps

        def limited(self, *arguments):
            if left[0] == 0:
                raise Interruption
            left[0] -= 1
            return steps(self, *arguments)

        monkeypatch.setattr(ProgressMonitor, "steps", limited)

    return after


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 7, 40, 1000])
def test_interrupted_and_resumed(bars, tmp_path, interrupted, monkeypatch, every):
    expected = fit_states(WRONG, bars, CONFIG)
    for _ in range(3):
        with monkeypatch.context():
            interrupted(4)
            with contextlib.suppress(Interruption):
                fit_states(WRONG, bars, CONFIG, checkpoint=tmp_path, checkpoint_every=every)
            monkeypatch.undo()
    found = fit_states(WRONG, bars, CONFIG, checkpoint=tmp_path, checkpoint_every=every)
    assert_same(found, expected)
    assert len(found.about.facts["segments"]["loss"]) == 130
    # all is done now: nothing is left to do
    interrupted(0)
    assert_same(fit_states(WRONG, bars, CONFIG, checkpoint=tmp_path, checkpoint_every=every), expected)


@pytest.mark.slow
def test_resumed_with_early_stopping(bars, unseen, tmp_path, interrupted, monkeypatch):
    """The best weights so far, and what was seen of the held-out rollouts, are kept too."""
    training = Training(epochs=400, learning_rate=0.02, schedule="constant", stop_after=40, check_every=10)
    config = FitConfig(
        CONFIG.residual,
        training,
        RolloutTraining(updates=6, horizon=6, stop_after=4, check_every=2),
        seed=(0, 1),
    )
    held_out = [unseen]
    expected = fit_states(WRONG, bars, config, held_out=held_out)
    assert len(expected[0].about.facts["segments"]["loss"]) < 400
    for count in (3, 9, 2):
        with monkeypatch.context():
            interrupted(count)
            with contextlib.suppress(Interruption):
                fit_states(WRONG, bars, config, held_out=held_out, checkpoint=tmp_path, checkpoint_every=10)
            monkeypatch.undo()
    assert_same(fit_states(WRONG, bars, config, held_out=held_out, checkpoint=tmp_path), expected)


# killed


def long_fit(folder):
    """What the process that is killed does; a checkpoint after every few steps keeps it busy."""
    fit_states(WRONG, [pulled(1.0), pulled(0.7)], LONG, checkpoint=folder, checkpoint_every=4)


def kill_during(stage, folder, delay):
    """Start the fit, kill it a while after the first checkpoint of a stage; whether it was still running."""
    code = "import sys; from tests.learning.training.test_checkpoint import long_fit; long_fit(sys.argv[1])"
    path = os.pathsep.join([str(ROOT / "src"), str(ROOT)])
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], cwd=ROOT, env={**os.environ, "PYTHONPATH": path}
    )
    try:
        began = time.monotonic()
        # of the stage itself: what an earlier process wrote does not count
        while process.poll() is None and not any(
            file.stat().st_mtime_ns > _newest.get(file, 0) for file in folder.glob(f"{stage}-*.checkpoint")
        ):
            assert time.monotonic() - began < 300
            time.sleep(0.002)
        time.sleep(delay)
        running = process.poll() is None
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.wait()
    _newest.update({file: file.stat().st_mtime_ns for file in folder.glob("*.checkpoint")})
    return running


_newest: dict[Path, int] = {}


@pytest.mark.campaign
def test_killed_and_resumed(bars, tmp_path):
    expected = fit_states(WRONG, bars, LONG)
    random.seed(3)
    killed = [kill_during(stage, tmp_path, random.uniform(0.0, 0.15)) for stage in ("segments", "rollouts")]
    assert killed == [True, True]
    assert_same(fit_states(WRONG, bars, LONG, checkpoint=tmp_path), expected)
    assert not list(tmp_path.glob(".*"))  # what a killed process left half written is gone


@pytest.mark.campaign
def test_killed_many_times(bars, tmp_path):
    expected = fit_states(WRONG, bars, LONG)
    count = 0
    for round_ in range(4):
        folder = tmp_path / str(round_)
        folder.mkdir()
        random.seed(round_)
        for _ in range(3):
            count += kill_during("segments", folder, random.uniform(0.0, 1.0))
        count += kill_during("rollouts", folder, random.uniform(0.0, 0.3))
        assert_same(fit_states(WRONG, bars, LONG, checkpoint=folder), expected)
    assert count >= 10


# of something else, or damaged


@pytest.fixture
def kept(bars, tmp_path):
    fit_states(WRONG, bars, CONFIG, checkpoint=tmp_path)
    return tmp_path / "segments-0.checkpoint"


@pytest.mark.slow
def test_another_fit_is_refused(bars, kept):
    other = dataclasses.replace(CONFIG.segments, learning_rate=0.02)
    for arguments, words in (
        (
            (WRONG, bars, dataclasses.replace(CONFIG, segments=other)),
            "segments.learning_rate is 0.01 there and 0.02",
        ),
        ((BAR, bars, CONFIG), "another nominal model"),
        ((WRONG, bars[:1], CONFIG), "other trajectories"),
        ((WRONG, [bars[0][:-1], bars[1]], CONFIG), "other trajectories"),
    ):
        with pytest.raises(CheckpointError, match=words) as caught:
            fit_states(*arguments, checkpoint=kept.parent)
        assert str(kept) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(CheckpointError, match="other held-out trajectories"):
        fit_states(WRONG, bars, CONFIG, held_out=bars, checkpoint=kept.parent)
    # another seed has a file of its own; the same knowledge written otherwise is the same
    found = fit_states(WRONG, bars, dataclasses.replace(CONFIG, seed=1), checkpoint=kept.parent)
    assert found.about.facts["seed"] == 1
    assert sorted(file.name for file in kept.parent.iterdir()) == [
        "segments-0.checkpoint",
        "segments-1.checkpoint",
    ]
    kept.with_name("segments-1.checkpoint").rename(kept)
    with pytest.raises(CheckpointError, match="it is of 'segments-1'"):
        fit_states(WRONG, bars, CONFIG, checkpoint=kept.parent)


def test_a_damaged_checkpoint_is_refused(bars, kept):
    whole = kept.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [whole[: int(part * len(whole))] for part in (0.0, 0.01, 0.5, 0.999)]
    places = rng.integers(0, len(whole), 20)
    damaged += [whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :] for place in places]
    for data in (*damaged, whole + b"x", b"PK\x03\x04"):
        kept.write_bytes(data)
        with pytest.raises(CheckpointError, match="delete it to start again") as caught:
            fit_states(WRONG, bars, CONFIG, checkpoint=kept.parent)
        assert str(kept) in str(caught.value) and "\n" not in str(caught.value)


def test_a_checkpoint_with_other_content_is_refused(bars, kept):
    """One with a right checksum, but with something else in it than this fit writes."""
    checkpoints = Checkpoints(kept.parent, Identity.of(WRONG, bars, (), CONFIG))
    good = checkpoints.load("segments-0")
    for change in (
        {"state": good["state"][:-1]},
        {"state": [np.zeros(3), *good["state"][1:]]},
        {"state": 3},
        {"losses": good["losses"][:5]},
        {"best": []},
        {"checks": None},
    ):
        checkpoints.save("segments-0", {**good, **change})
        with pytest.raises(CheckpointError, match="delete it to start again") as caught:
            fit_states(WRONG, bars, CONFIG, checkpoint=kept.parent)
        assert "\n" not in str(caught.value)
    checkpoints.save("segments-0", good)
    fit_states(WRONG, bars, CONFIG, checkpoint=kept.parent)


def test_a_folder_that_cannot_be(bars, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="cannot be made a folder"):
        fit_states(WRONG, bars, CONFIG, checkpoint=tmp_path / "file")


def test_unpacked_checks_type_and_shape():
    like = {"a": np.zeros(3), "b": np.zeros((), dtype=int)}
    assert unpacked([np.arange(3.0), np.array(4)], like)["b"] == 4
    for wrong in (
        [np.arange(3.0)],
        [np.arange(3), np.array(4)],
        [np.arange(4.0), np.array(4)],
        [1.0, 2],
        None,
    ):
        with pytest.raises(CheckpointError):
            unpacked(wrong, like)


def test_hash_of_data(bars):
    one = bars[0]
    assert data_hash(one) == data_hash(dataclasses.replace(one, residual=one.residual + 1.0))
    changed = np.array(one.y)
    changed[3, 2, 1] = np.nextafter(changed[3, 2, 1], 1.0)
    assert data_hash(one) != data_hash(dataclasses.replace(one, y=changed))
    assert len({data_hash(one), data_hash(bars[1]), data_hash(one[:-1])}) == 3
