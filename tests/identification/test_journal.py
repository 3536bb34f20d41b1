"""Interrupted identifications resume: finished searches are kept, and damaged files count as missing."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.estimation import BodyPositions
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.journal import Journal, SearchError
from knode_cosserat.identification.misfit import Rollout
from knode_cosserat.identification.search import ParameterSearch, Subset
from tests.identification.recorded import measured, tensions
from tests.identification.test_identify import NOMINAL, TRUE

ROWS, BODIES = 60, 2


class Curve:
    """A misfit without a robot: a curve with three numbers, and so cheap that each call can be counted."""

    def __init__(self, true=(0.4, -0.3, 0.2), fails=False):
        numbers = tuple((f"number {k}", 0.0) for k in range(3))
        self.model = SimpleNamespace(
            size=3,
            nominal=SimpleNamespace(length=1.0),
            prior=np.ones(3),
            bounds=(np.full(3, -5.0), np.full(3, 5.0)),
            begin=np.zeros(3),
            numbers=numbers,
            names=("curve",),
            robot=(np.zeros(3),),
        )
        t = np.linspace(0.0, 1.0, ROWS)
        self.shape = np.stack([t, np.sin(5.0 * t), t**3])
        rng = np.random.default_rng(0)
        self.data = [self._seen(true, name, rng) for name in ("one", "two")]
        self.calls, self.fails = 0, fails

    def _seen(self, true, name, rng):
        position = np.tanh(np.asarray(true) @ self.shape)[:, None, None] + 1e-3 * rng.normal(
            size=(ROWS, BODIES, 3)
        )
        return Experiment(
            0.05,
            np.zeros((ROWS - 1, 1)),
            BodyPositions((0.5, 1.0)),
            position.reshape(ROWS, -1),
            np.zeros(1),
            name=name,
        )

    def differences(self, x, rows=None, which=None, offsets=None):
        self.calls += 1
        value = np.tanh(x @ self.shape)
        slope = np.broadcast_to(((1.0 - value**2) * self.shape)[:, :, None], (3, ROWS, 3 * BODIES))
        chosen = [self.data[k] for k in (range(2) if which is None else which)]
        if self.fails:
            return [None for _ in chosen]
        return [Rollout(it, value[:, None] - it.data, lambda which: slope[which]) for it in chosen]

    def whole(self, x, which=None):
        return self.differences(x, None, which)

    def refined(self, rollouts, x):
        return rollouts

    def differentiated(self, rollouts, which=None):
        pass


FREE = np.array([True, True, True])


def searched(folder, curve, stop=None):
    """Three searches; the run is interrupted before the one with the number `stop`."""
    search = ParameterSearch(curve, Journal(folder=folder))
    ends = []
    for k, which in enumerate((None, [0], [1])):
        if k == stop:
            raise KeyboardInterrupt
        ends.append(search.run(np.zeros(3), FREE, Subset(None, which)))
    return ends


def same(ends, others):
    return all(
        np.array_equal(a, b)
        for end, other in zip(ends, others, strict=True)
        for a, b in zip(jax.tree.leaves(end.facts()), jax.tree.leaves(other.facts()), strict=True)
    )


@pytest.mark.parametrize("stop", [1, 2])
def test_an_interrupted_run_resumes_and_ends_as_an_undisturbed_one(tmp_path, stop):
    undisturbed = Curve()
    expected = searched(None, undisturbed)
    np.testing.assert_allclose(expected[0].x, (0.4, -0.3, 0.2), atol=0.02)
    with pytest.raises(KeyboardInterrupt):
        searched(tmp_path, Curve(), stop)
    resumed = Curve()
    assert same(searched(tmp_path, resumed), expected)
    assert 0 < resumed.calls < undisturbed.calls
    finished = Curve()
    assert same(searched(tmp_path, finished), expected) and finished.calls == 0


def test_other_recordings_or_another_model_are_searched_anew(tmp_path):
    searched(tmp_path, Curve())
    other = Curve(true=(0.1, 0.1, 0.1))
    assert not same(searched(tmp_path, other), searched(None, Curve())) and other.calls > 0
    wider = Curve()
    wider.model.numbers = tuple((name, 1.0) for name, _ in wider.model.numbers)
    searched(tmp_path, wider)
    assert wider.calls > 0


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:100], lambda data: data[::-1]])
def test_a_damaged_file_counts_as_missing(tmp_path, damage):
    expected = searched(tmp_path, Curve())
    for path in tmp_path.iterdir():
        path.write_bytes(damage(path.read_bytes()))
    again = Curve()
    assert same(searched(tmp_path, again), expected) and again.calls > 0


def test_a_failed_search_is_kept_too(tmp_path):
    for calls in (1, 0):
        curve = Curve(fails=True)
        with pytest.raises(SearchError, match="cannot be simulated"):
            searched(tmp_path, curve)
        assert curve.calls == calls


@pytest.mark.campaign
def test_identify_resumes(tmp_path):
    """Interrupted at its tenth line of progress, and repeated: the same robot."""
    given = [
        measured(TRUE, tensions(kind, 2.0, seed=k), f"r{k}", seed=k) for k, kind in enumerate((1.0, 2.0))
    ]
    effects = ["stiffness", "damping", "friction"]
    expected = kc.identify(NOMINAL, given, effects)
    lines = []

    def interrupt(line):
        lines.append(line)
        if len(lines) == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kc.identify(NOMINAL, given, effects, progress=interrupt, checkpoint=tmp_path)
    assert list(tmp_path.iterdir())
    again = []
    found = kc.identify(NOMINAL, given, effects, progress=again.append, checkpoint=tmp_path)
    assert found.to_dict() == expected.to_dict()
