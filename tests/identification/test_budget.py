"""A budget of time: the best robot so far is returned in each stage, and a later run resumes."""

import importlib

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification.search import OutOfTime, Search
from tests.identification.recorded import measured, tensions
from tests.identification.test_identify import NOMINAL, TRUE
from tests.identification.test_journal import FREE, Curve

IDENTIFY, SEARCH = (
    importlib.import_module(f"knode_cosserat.identification.{it}") for it in ("identify", "search")
)


class Clock:
    """A clock that stands still until a line is told that contains some words; then the time is over."""

    def __init__(self, words="", calls=None):
        self.words, self.calls, self.time, self.lines = words, calls, 0.0, []

    def __call__(self):
        if self.calls is not None:
            self.calls -= 1
            if self.calls < 0:
                return np.inf
        return self.time

    def tell(self, line):
        self.lines.append(line)
        if self.words and self.words in line:
            self.time = 1e6


@pytest.fixture
def use(monkeypatch):
    def used(clock):
        for module in (IDENTIFY, SEARCH):
            monkeypatch.setattr(module, "clock", clock)
        return clock

    return used


def test_nothing_is_solved_after_the_deadline(use):
    use(Clock())
    search = Search(Curve(), deadline=60.0)
    end = search.run(np.zeros(3), FREE)
    assert search.last is end
    use(Clock(calls=2))
    with pytest.raises(OutOfTime):
        search.run(np.zeros(3), FREE)
    assert search.last is end


class _Model:
    nominal = NOMINAL


class _Misfit:
    model = _Model


class _NoSearch:
    last, misfit = None, _Misfit


def test_the_best_robot_is_returned_or_belongs_to_the_interruption(use):
    clock = use(Clock("trials"))
    course = IDENTIFY._Course(clock.tell, 60.0)
    best = kc.identification.Identified(TRUE)

    def whole(interrupted=False):
        course.begin("all effects")
        course.best = lambda: best
        if interrupted:
            raise KeyboardInterrupt
        course.begin("trials")

    found = course.followed(_NoSearch, whole)
    assert found.robot is TRUE and not found.complete and not found.to_dict()["complete"]
    assert found.steps[-1].endswith("not done: trials, next experiment, band of predictions")
    assert clock.lines[0] == "stage 2 of 7, all effects, 60 s left"
    use(Clock())
    with pytest.raises(KeyboardInterrupt) as stopped:
        course.followed(_NoSearch, lambda: whole(True))
    assert stopped.value.best.robot is TRUE and not stopped.value.best.complete


def test_without_any_search_the_nominal_robot_is_returned(use):
    use(Clock("stage 1"))
    course = IDENTIFY._Course(IDENTIFY.clock.tell, 60.0)
    found = course.followed(_NoSearch, lambda: course.begin("first answer"))
    assert found.robot is NOMINAL and not found.complete and "first answer" in found.steps[-1]


@pytest.mark.parametrize("minutes", [0.0, -1.0, np.nan])
def test_a_budget_is_above_zero(minutes):
    with pytest.raises(kc.identification.IdentificationError, match="above zero"):
        kc.identify(NOMINAL, [], minutes=minutes)


@pytest.mark.campaign
def test_a_budget_ends_in_each_stage_and_a_later_run_resumes(tmp_path, use):
    given = [
        measured(TRUE, tensions(kind, 2.0, seed=k), f"r{k}", seed=k) for k, kind in enumerate((1.0, "random"))
    ]
    for stage in IDENTIFY.STAGES:
        clock = use(Clock(f", {stage}"))
        found = kc.identify(NOMINAL, given, minutes=1.0, progress=clock.tell, checkpoint=tmp_path)
        if found.complete:  # all was decided: there is no next experiment
            assert stage == "next experiment"
            continue
        assert found.steps[-1].startswith("not complete") and stage in found.steps[-1]
        if stage != "first answer":
            assert {"youngs_modulus", "bending_damping"} <= {it.label for it in found.estimates}
            assert max(found.error.values()) < 0.2 * max(found.nominal_error.values())
        if stage in ("all effects", "selection of effects"):
            assert found.held_out_error and "held-out rows" in found.steps[0]
    use(Clock())
    resumed = kc.identify(NOMINAL, given, minutes=1.0, checkpoint=tmp_path)
    assert resumed.complete and resumed.to_dict() == kc.identify(NOMINAL, given).to_dict()
