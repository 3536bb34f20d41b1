"""A budget of time: the best robot so far is returned in each stage, and a later run resumes."""

import importlib
from types import SimpleNamespace

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification import journal
from knode_cosserat.identification.journal import STAGES, Journal, OutOfTimeError, SearchError
from knode_cosserat.identification.search import ParameterSearch
from tests.identification.recorded import measured, tensions
from tests.identification.test_identify import NOMINAL, TRUE
from tests.identification.test_journal import FREE, Curve
from tests.identification.test_selection import ROWS

IDENTIFY = importlib.import_module("knode_cosserat.identification.identify")


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
        monkeypatch.setattr(journal, "clock", clock)
        return clock

    return used


def test_nothing_is_solved_after_the_deadline(use):
    use(Clock())
    search = ParameterSearch(Curve(), Journal(minutes=1.0))
    end = search.run(np.zeros(3), FREE)
    assert search.journal.last == (search, end)
    use(Clock(calls=2))
    with pytest.raises(OutOfTimeError):
        search.run(np.zeros(3), FREE)
    assert search.journal.last == (search, end)


def _run(monkeypatch, clock, stages):
    """Begin some stages in place of a search; the last one may be an interruption."""

    def staged(searched, *_):
        course = searched(NOMINAL).journal
        for stage in stages:
            if stage is KeyboardInterrupt:
                raise KeyboardInterrupt
            course.begin(stage)
            if stage == "trials":
                course.result = kc.identification.Identified(TRUE)

    monkeypatch.setattr(
        IDENTIFY, "ParameterSearch", lambda misfit, journal: ParameterSearch(Curve(), journal)
    )
    monkeypatch.setattr(IDENTIFY, "Misfit", lambda *_: None)
    monkeypatch.setattr(IDENTIFY, "identify_effects", staged)
    return kc.identify(NOMINAL, [ROWS], minutes=1.0, progress=clock.tell)


@pytest.mark.parametrize("stage", STAGES)
def test_a_result_says_what_was_not_done(monkeypatch, use, stage):
    clock = use(Clock(f", {stage}"))
    found = _run(monkeypatch, clock, STAGES)
    assert not found.complete and not found.to_dict()["complete"]
    missing = ", ".join(STAGES[STAGES.index(stage) :])
    assert found.steps[-1] == f"not complete, the time is over; not done: {missing}"
    assert (found.robot is TRUE) == (stage == STAGES[-1])
    assert clock.lines[0] == "stage 1 of 6, first answer, 60 s left"


def test_the_best_robot_belongs_to_an_interruption(monkeypatch, use):
    with pytest.raises(KeyboardInterrupt) as stopped:
        _run(monkeypatch, use(Clock()), [*STAGES, KeyboardInterrupt])
    assert stopped.value.best.robot is TRUE and "interrupted" in stopped.value.best.steps[-1]


def test_a_search_in_a_part_of_the_rows_that_cannot_be_simulated_ends_as_the_nominal_robot(monkeypatch, use):
    class Unsolvable:
        misfit = SimpleNamespace(model=SimpleNamespace(effects=()))

        def run(self, *_, **__):
            raise SearchError("the robot that the search begins from cannot be simulated")

    def stopped(searched, *_):
        journal = searched(NOMINAL).journal
        journal.last = Unsolvable(), SimpleNamespace(x=np.zeros(0), free=np.zeros(0, dtype=bool))
        raise OutOfTimeError

    use(Clock())
    monkeypatch.setattr(
        IDENTIFY, "ParameterSearch", lambda misfit, journal: ParameterSearch(Curve(), journal)
    )
    monkeypatch.setattr(IDENTIFY, "Misfit", lambda *_: None)
    monkeypatch.setattr(IDENTIFY, "identify_effects", stopped)
    found = kc.identify(NOMINAL, [ROWS], minutes=1.0)
    assert found.robot is NOMINAL and not found.complete
    assert "nominal robot is returned: the robot that the search begins from" in found.steps[-2]


@pytest.mark.parametrize("minutes", [0.0, -1.0, np.nan])
def test_a_budget_is_above_zero(minutes):
    with pytest.raises(kc.identification.IdentificationError, match="above zero"):
        kc.identify(NOMINAL, [], minutes=minutes)


@pytest.mark.campaign
def test_a_budget_ends_in_each_stage_and_a_later_run_resumes(tmp_path, use):
    given = [
        measured(TRUE, tensions(kind, 2.0, seed=k), f"r{k}", seed=k) for k, kind in enumerate((1.0, "random"))
    ]
    for stage in STAGES:
        clock = use(Clock(f", {stage}"))
        found = kc.identify(NOMINAL, given, minutes=1.0, progress=clock.tell, checkpoint=tmp_path)
        assert found.steps[-1].startswith("not complete") and stage in found.steps[-1]
        if stage != "first answer":
            assert {"youngs_modulus", "bending_damping"} <= {it.label for it in found.estimates}
            assert max(found.error.values()) < 0.2 * max(found.nominal_error.values())
            assert "held-out rows" in found.steps[0]
    use(Clock())
    resumed = kc.identify(NOMINAL, given, minutes=1.0, checkpoint=tmp_path)
    assert resumed.complete and resumed.to_dict() == kc.identify(NOMINAL, given).to_dict()
