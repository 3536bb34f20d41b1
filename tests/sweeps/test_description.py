"""Descriptions of sweeps: grids, files, and one clear line for each mistake."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat.sweeps import Plan, Range, Sweep, SweepError
from knode_cosserat.sweeps._description import values_at

ROBOT = "delrin-tendon-robot"
WORD = "sine:{period}"
VARY = {"period": {"low": 0.5, "high": 2.0}}
RANDOM = {"sampler": "random", "samples": 8}


def sweep(**changes):
    return Sweep.of({"robots": ROBOT, "controls": WORD, "steps": 4, "dt": 0.05, "vary": VARY} | changes)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(2, 4), min_size=0, max_size=3), st.integers(0, 2), st.integers(1, 7))
def test_a_grid_has_every_combination_once(counts, seeds, shard):
    values = [np.arange(1.0, count + 1.0) for count in counts]
    vary = {f"a{k}": each.tolist() for k, each in enumerate(values)}
    words = ["constant:1", "random:{seed},low=1,high=2"] if seeds else ["constant:1"]
    if vary:
        words[0] = "constant:" + ",".join(f"{{a{k}}}" for k in range(len(vary))) + ",3" * (4 - len(vary))
    plan = Plan.of(sweep(controls=words, vary=vary, seeds=list(range(seeds)), shard=shard))
    every = [plan.cases(number) for number in range(plan.shard_count)]
    rows = [
        (int(word), int(seed) if seeds else 0, *(cases.values[name][k] for name in vary))
        for cases in every
        for k, (word, seed) in enumerate(zip(cases.word, cases.seed, strict=True))
    ]
    expected = itertools.product(range(len(words)), range(max(1, seeds)), *values)
    assert sorted(rows) == sorted(expected) and len(rows) == plan.sweep.case_count
    np.testing.assert_array_equal(np.concatenate([each.case for each in every]), np.arange(len(rows)))


def test_ranges_are_uniform_in_the_number_or_its_logarithm():
    part = np.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(values_at(Range(1.0, 3.0), part), [1.0, 1.5, 2.0, 2.5, 3.0])
    np.testing.assert_allclose(values_at(Range(1.0, 16.0, "log"), part), [1.0, 2.0, 4.0, 8.0, 16.0])
    low, high = 1.1e-7, 3.3e5
    inside = values_at(Range(low, high, "log"), part)
    assert np.all((inside >= low) & (inside <= high)) and inside[0] < 1.001 * low


def test_a_file_describes_what_the_constructor_does(tmp_path):
    path = tmp_path / "sweep.yaml"
    path.write_text(
        f"""
robots: [{ROBOT}, {{robot: {ROBOT}, set: {{nodes: 6}}}}]
controls: ["sine:{{period}}", "random:{{seed}}"]
vary:
  period: {{low: 0.5, high: 2}}
  length: [0.5, 0.6]
  youngs_modulus: {{low: 1e9, high: 1e10, scale: log}}
sampler: sobol
samples: 16
steps: 20
dt: 0.05
store: [tip_position, controls]
"""
    )
    found = Sweep.load(path)
    expected = Sweep(
        [ROBOT, {"robot": ROBOT, "set": {"nodes": 6}}],
        [WORD, "random:{seed}"],
        20,
        0.05,
        vary={"period": Range(0.5, 2.0), "length": [0.5, 0.6], "youngs_modulus": Range(1e9, 1e10, "log")},
        sampler="sobol",
        samples=16,
        store=["tip_position", "controls"],
    )
    assert found == expected and Plan.of(found).identity == Plan.of(expected).identity
    assert found.case_count == 2 * 2 * 16
    assert Sweep.of(found.described()) == found
    text = repr(found)
    assert "64 cases" in text and "2 robots, 2 controls, 1 seeds, 16 samples by sobol" in text


def test_a_plan_depends_on_everything_that_changes_results(tmp_path):
    base = Plan.of(sweep(**RANDOM)).identity
    for changes in ({"samples": 9}, {"seed": 1}, {"steps": 5}, {"dt": 0.01}, {"shard": 3}, {"store": ["y"]}):
        assert Plan.of(sweep(**{**RANDOM, **changes})).identity != base
    path = tmp_path / "robot.yaml"
    kc.save_robot(kc.load_robot(ROBOT), path)
    one = Plan.of(sweep(**RANDOM, robots=str(path))).identity
    kc.save_robot(kc.load_robot(ROBOT).replace(length=0.6), path)
    assert Plan.of(sweep(**RANDOM, robots=str(path))).identity != one


def test_shards_are_of_one_robot_and_of_bounded_size():
    plan = Plan.of(sweep(**RANDOM, robots=[ROBOT, {"robot": ROBOT, "set": {"nodes": 40}}], shard=5))
    assert [plan.span(k) for k in range(plan.shard_count)] == [(0, 0, 5), (0, 5, 8), (1, 0, 5), (1, 5, 8)]
    large = Plan.of(sweep(sampler="sobol", samples=2**20, steps=200, store=["y", "z"]))
    assert large.shard_cases % 16 == 0 and large.shard_cases * large.case_bytes(0) < 16e6
    assert math.isclose(large.total_bytes, 2**20 * large.case_bytes(0))
    assert Plan.of(sweep(sampler="sobol", samples=10**6)).shard_cases == 4096


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robots": "delrin-tendon"}, "robots: .*no such file or robot; .*did you mean delrin-tendon-robot"),
        ({"robots": []}, "robots is empty; allowed is one robot or more"),
        ({"robots": {"robot": ROBOT, "nodes": 3}}, "is not understood; allowed is a name"),
        ({"robots": {"robot": ROBOT, "set": {"size": 3}}}, "robots: .*no parameter 'size'; there are length"),
        ({"controls": "sine:{perod}"}, "{perod} is not varied; .*did you mean period"),
        ({"controls": "sinus:{period}"}, "no such signal or file; .*did you mean sine"),
        ({"controls": []}, r"controls is \[\]; allowed is a word or a list of words"),
        ({"vary": {"lenght": [1.0]}}, "{period} is not varied"),
        ({"vary": {**VARY, "lenght": [1.0]}}, "vary: .*no parameter 'lenght'; .*did you mean length"),
        ({"vary": {**VARY, "loads.0.mass": [1.0]}}, "vary: there is no parameter 'loads.0.mass'"),
        ({"vary": {**VARY, "length": [400.0]}}, r"vary: length must be between .* Did you mean 0.4"),
        ({"vary": {**VARY, "nodes": [5, 6]}}, "vary: nodes cannot vary within a robot, .*list of robots"),
        ({"vary": {**VARY, "gravity": Range(1.0, 2.0)}}, "gravity is not one number; allowed is a list"),
        ({"vary": {"period": {"low": 2.0, "high": 1.0}}}, "period: low is 2 and high 1; allowed is low"),
        ({"vary": {"period": {"low": -1, "high": 1, "scale": "log"}}}, "above 0"),
        ({"vary": {"period": {"low": 1, "hihg": 2}}}, "'hihg' is unknown; .*did you mean high"),
        ({"vary": {"period": {"low": 1}}}, "the key 'high' is missing; required is low, high"),
        ({"vary": {"period": ["a"]}}, "is not a list of finite numbers"),
        ({"vary": {"period": 3}}, "allowed is low and high, or a list of values"),
        ({"vary": [3]}, "vary is a list; allowed is a mapping of names"),
        ({"sampler": "sobl"}, "sampler is 'sobl'; allowed is grid, .*did you mean sobol"),
        ({"sampler": "grid", "samples": None}, "period has no count; required on a grid"),
        ({"sampler": "grid"}, "a grid has all combinations"),
        ({"samples": None}, "samples is missing"),
        ({"samples": 0}, "samples is 0; allowed is a whole number from 1 on"),
        ({"sampler": "sobol", "samples": 2**31}, "allowed with sobol is up to"),
        ({"samples": 10**13}, "allowed is up to 1e\\+12"),
        ({"steps": 0}, "steps is 0; allowed is a whole number from 1 on"),
        ({"steps": True}, "steps is True"),
        ({"dt": "fast"}, "dt is 'fast'; allowed is a number"),
        ({"dt": 0.0}, "dt is 0.0"),
        ({"seeds": [1, 2]}, "seeds are given, and no controls use {seed}"),
        ({"seeds": [-1]}, r"seeds is \[-1\]; allowed is a list of whole numbers"),
        ({"store": ["tip"]}, "store: 'tip' is unknown; allowed is tip_position"),
        ({"store": ["y", "y"]}, "each name once"),
        ({"precision": "half"}, 'precision is .half.; allowed is "double" or "single"'),
        ({"recovery": "yes"}, "recovery is 'yes'; allowed is True or False"),
        ({"time": "rk4"}, "time is 'rk4'; allowed is"),
        ({"smaples": 3}, "'smaples' is unknown; .*did you mean samples"),
        ({"shard": 0}, "shard is 0"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_with_what_is_allowed(changes, message):
    with pytest.raises(SweepError, match=message) as caught:
        Plan.of(sweep(**{**RANDOM, **changes}))
    assert "\n" not in str(caught.value)


def test_files_that_are_no_descriptions(tmp_path):
    path = tmp_path / "sweep.yaml"
    for text, message in (
        ("[1, 2]", "allowed is a mapping with robots"),
        ("robots: a\nrobots: b", "there twice"),
        ("steps: 3", "'robots' is missing"),
        ("{", "not YAML"),
    ):
        path.write_text(text)
        with pytest.raises(SweepError, match=message):
            Sweep.load(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(SweepError, match="not UTF-8"):
        Sweep.load(path)
    with pytest.raises(SweepError, match=r"none\.yaml: no such file"):
        Sweep.load(tmp_path / "none.yaml")
