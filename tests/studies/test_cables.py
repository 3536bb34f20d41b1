"""The study of cables on a small synthetic folder: a rod of the package, held by two moving grippers."""

import dataclasses
import importlib.util
import json
import pickle

import numpy as np
import pytest

from knode_cosserat.solvers.simulate import simulate
from studies.cables import frames, study
from studies.cables.correction import learned_correction
from studies.cables.identification import SearchStage, identify_cable
from studies.cables.model import DT, CableModel, CableParameters, Grips
from studies.cables.places import marker_places
from studies.cables.recordings import CableData, CableMotion
from studies.cables.rollouts import (
    CHUNK,
    NAMES,
    CablePrediction,
    Rollouts,
    cable_coordinates,
    cable_parameters,
)
from studies.cables.shapes import CableGrid, Fitter
from studies.cables.study import CableResult, as_markdown

SPACE, NODES = "lobatto2", 9
TRUE = CableParameters(
    bending=0.02,
    torsion=0.02,
    damping_time=0.02,
    drag=1.0,
    square_drag=0.01,
    curvature=(1.0, 0.5),
    offset=(4e-3, 0.0),
)
PLACES = np.linspace(0.0, 0.4, 5)
matplotlib = pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")


def held(count, seed):
    """Markers of an arch whose grips move slowly: those that are held are right, all others near."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(count)
    angle = np.linspace(-1.0, 1.0, 200)
    arch = np.cumsum(np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1), axis=0)
    arch = 0.4 * arch / len(arch)
    along = np.interp(PLACES, np.linspace(0.0, 0.4, 200), np.arange(200))
    free = np.stack([np.interp(along, np.arange(200), arch[:, k]) for k in range(3)], axis=1)
    ends = [
        free[0] - 0.02 * frames.unit(free[1] - free[0]),
        free[-1] + 0.02 * frames.unit(free[-1] - free[-2]),
    ]
    markers = np.concatenate([ends[:1], free, ends[1:]])[None] + np.zeros((count, 1, 1))
    sway = 0.02 * (1.0 - np.cos(2.0 * np.pi * time / 0.3))[:, None, None] * rng.normal(size=3)
    markers[:, :4] += sway
    markers[:, 4:] += 0.5 * sway
    return markers


GRIPS = Grips.of([held(4, 0)])
MODEL = CableModel(PLACES, GRIPS, NODES)


def recorded(count, seed):
    """Markers of a simulated cable, settled before the first frame."""
    markers = held(count + 30, seed)
    markers[:30] = markers[30]
    prepared, _ = MODEL.prepared(TRUE, markers)
    robot = MODEL.robot(TRUE, prepared.base, prepared.tip)
    moved = simulate(robot, prepared.controls, DT, space=SPACE, initial=MODEL.initial(robot, prepared))
    beside = np.array([*TRUE.offset, 0.0])
    free = np.asarray(MODEL.free_markers(np.asarray(moved.y)[1:], beside))
    markers[2:, 2:-2] = free
    return markers[30:]


@pytest.fixture(scope="module")
def motions():
    return [recorded(24, seed) for seed in range(3)]


@pytest.fixture(scope="module")
def rollouts():
    return Rollouts(MODEL, SPACE)


def test_frames_follow_a_curve_and_meet_both_ends():
    rng = np.random.default_rng(0)
    edges = np.array([0.0, 0.0, 1.0]) + 0.3 * rng.normal(size=(50, 3)).cumsum(axis=0) / 10.0
    first = frames.shortest(frames.AXIS, frames.unit(edges[0]))
    last = frames.quaternion_product(
        frames.shortest(frames.AXIS, frames.unit(edges[-1])), frames.from_vector(0.4 * frames.AXIS)
    )
    found = frames.along_curve(edges, first, last)
    np.testing.assert_allclose(
        frames.rotated(found, np.tile(frames.AXIS, (50, 1))), frames.unit(edges), atol=1e-9
    )
    step = frames.to_vector(frames.quaternion_product(frames.conjugate(found[-1]), last))
    assert np.abs(step).max() < 0.05


def test_rotation_vectors_do_not_jump():
    angle = np.linspace(0.0, 5.0, 40)
    vectors = frames.to_vector(frames.from_vector(angle[:, None] * frames.AXIS))
    np.testing.assert_allclose(frames.continuous(vectors)[:, 2], angle, atol=1e-9)


def test_a_shape_has_the_cables_length_and_passes_its_markers():
    fitter, markers = Fitter(CableGrid(PLACES, 16)), held(3, 0)
    base, tip = MODEL.end_frames(CableParameters(), markers)
    shape = fitter.shape(markers[0, 1:-1], (base[0], tip[0]), np.zeros(3))
    lengths = np.linalg.norm(np.diff(shape.points, axis=0), axis=1)
    np.testing.assert_allclose(lengths, 0.4 / 16, rtol=2e-3)
    np.testing.assert_allclose(shape.beside, np.zeros((5, 3)), atol=3e-3)


@pytest.mark.campaign
def test_places_of_markers_are_near_the_true_ones(motions):
    found = marker_places(motions, Grips.of(motions))
    np.testing.assert_allclose(found.along, PLACES, atol=0.02)
    assert np.all(np.isfinite(found.offset))


def test_coordinates_go_there_and_back():
    again = cable_parameters(cable_coordinates(TRUE))
    for field in dataclasses.fields(TRUE):
        np.testing.assert_allclose(getattr(again, field.name), getattr(TRUE, field.name), rtol=1e-12)


@pytest.mark.campaign
def test_long_motions_are_those_of_one_simulation(motions, rollouts):
    markers = np.concatenate([motions[0], motions[0][::-1]] * 2)[: 2 * CHUNK + 2]
    values, _ = rollouts.columns(cable_coordinates(TRUE), markers, "long")
    predicted = rollouts.predict(TRUE, markers)
    assert predicted.markers is not None and predicted.failure == ""
    np.testing.assert_allclose(values, predicted.markers - markers[2:, 2:-2], atol=2e-4)


@pytest.mark.campaign
def test_derivatives_are_those_of_the_rollout(motions, rollouts):
    x, markers = cable_coordinates(TRUE.replace(eccentric=0.2)), motions[0]
    values, slopes = rollouts.columns(x, markers, "key")
    for name in ("bending", "curvature0", "eccentric", "tip_tangent1", "twist"):
        slope, step = slopes[NAMES.index(name)], 0.01 * np.eye(len(x))[NAMES.index(name)]
        after = [rollouts.columns(x + sign * step, markers, "key")[0] for sign in (1, -1)]
        np.testing.assert_allclose(slope, (after[0] - after[1]) / 0.02, atol=0.1 * np.abs(slope).max() + 2e-4)
    assert np.all(np.isfinite(values))


@pytest.mark.campaign
def test_a_wrong_stiffness_is_found(motions, rollouts):
    start = dataclasses.replace(TRUE, bending=0.01, curvature=(0.0, 0.0))

    def validate(p):
        return study._errors(rollouts, p, motions[2:])[0]

    stages = (SearchStage(12, 3, ("bending", "curvature0", "curvature1"), 4),)
    found = identify_cable(rollouts, start, motions[:2], validate, stages)
    assert found.errors[1] < 0.7 * found.errors[0]
    assert found.parameters != start


@pytest.mark.campaign
def test_a_failing_stage_leaves_the_start(motions):
    class Failing(Rollouts):
        def columns(self, x, markers, key):
            raise ValueError("nothing works")

    found = identify_cable(
        Failing(MODEL, SPACE), TRUE, motions[:1], lambda p: 1.0, (SearchStage(6, 1, ("bending",), 1),)
    )
    assert found.parameters == TRUE and "nothing works" in found.notes[0]


def test_a_correction_is_kept_only_where_it_helps():
    markers = [held(200, seed) for seed in range(4)]
    right = [each[2:, 2:-2] for each in markers]
    assert learned_correction(right, markers) == (None, 0.0)
    off = [each[2:, 2:-2] + 0.01 for each in markers]
    correction, gain = learned_correction(off, markers)
    assert gain > 0.5
    assert np.abs(correction.added(off[0], markers[0]) - markers[0][2:, 2:-2])[60:].max() < 3e-3


@pytest.mark.campaign
def test_a_prediction_that_fails_has_a_reason(motions):
    prediction = Rollouts(MODEL, "no such scheme").predict(TRUE, motions[0])
    assert prediction.markers is None and "no such scheme" in prediction.failure


def _shaken(markers):
    """One grip shakes at 5 m/s."""
    moved = markers.copy()
    moved[2:, -2:] += 0.05 * np.sin(np.arange(len(markers) - 2))[:, None, None] * np.array([0.0, 1.0, 0.0])
    return moved


def _turned(markers):
    """One grip turns by a right angle in one frame."""
    moved = markers.copy()
    moved[12:, 0] = moved[12:, 1] - [0.0, 0.02, 0.0]
    return moved


def _taut(markers):
    """The grips move apart to 2 % more than the length at 4 m/s, and jump back in one frame."""
    moved = markers.copy()
    apart = frames.unit(markers[0, -2] - markers[0, 1])
    missing = 1.02 * PLACES[-1] - np.linalg.norm(markers[0, -2] - markers[0, 1])
    away = np.zeros(len(markers))
    away[4:16] = np.minimum(0.04 * np.arange(1, 13), missing)
    moved[:, -2:] += away[:, None, None] * apart
    return moved


def _dropped(markers):
    """One grip is 12 cm away from one frame to the next."""
    moved = markers.copy()
    moved[12:, -2:] += [-0.07, 0.07, 0.07]
    return moved


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is too coarse", "ignore:outside rod theory")
@pytest.mark.parametrize("fast", [_shaken, _turned, _taut, _dropped, lambda markers: markers[::6]])
@pytest.mark.parametrize("thin", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_fast_grips_do_not_stop_a_prediction(rollouts, fast, thin):
    """Thin: a tenth of the stiffness and hardly any damping. The cable stays between its grips."""
    markers = fast(held(120, 1))
    p = TRUE.replace(bending=2e-3, torsion=2e-3, damping_time=2e-3, drag=0.1) if thin else TRUE
    found = rollouts.predict(p, markers)
    assert found.failure == "" and found.markers.shape == (len(markers) - 2, 3, 3)
    for grip in (1, -2):
        far = np.linalg.norm(found.markers - markers[2:, grip, None], axis=-1)
        assert np.max(far) < 1.1 * PLACES[-1]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the grid is too coarse")
@pytest.mark.parametrize("hardest", [4, 16])
def test_frames_without_a_solution_are_divided(rollouts, monkeypatch, hardest):
    """Whole steps, and those of a quarter, are told to fail late: the motion is nearly the same."""
    markers = held(60, 1)
    plain = rollouts.predict(TRUE, markers)
    whole = simulate

    def failing(robot, controls, dt, **given):
        found = whole(robot, controls, dt, **given)
        result, after = np.array(found.result), np.asarray(found.time) > 0.201
        if dt * hardest > 1.001 * DT and after.any():
            result[max(1, np.argmax(after)) :] = -1
        return dataclasses.replace(found, result=result)

    monkeypatch.setattr("studies.cables.rollouts.simulate", failing)
    divided = rollouts.predict(TRUE, markers)
    assert plain.divided == 0 and 30 < divided.divided < 50
    np.testing.assert_array_equal(divided.markers[:15], plain.markers[:15])
    moved = np.ptp(plain.markers, axis=0).max()
    np.testing.assert_allclose(divided.markers, plain.markers, atol=0.1 * moved)


@pytest.mark.slow
def test_a_motion_without_prediction_is_named_and_left_out(rollouts, motions, monkeypatch):
    """The means are those of the others."""
    data = CableData("A", (), tuple(CableMotion(str(k), markers) for k, markers in enumerate(motions)))
    predict_all = rollouts.predict_all

    def one_fails(p, given):
        found = predict_all(p, given)
        return [CablePrediction(None, failure="frame 7: no solution found"), *found[1:]]

    monkeypatch.setattr(rollouts, "predict_all", one_fails)
    cells, predictions = study._evaluated(data, rollouts, TRUE, None)
    result = CableResult(data, MODEL, TRUE, cells, predictions, [])
    text = as_markdown([result])
    assert "- 0, best: frame 7: no solution found" in text and "left out of the means" in text
    mean = np.mean([each["mean_abs_error"] for each in cells[2::3] if "failed" not in each])
    assert f"{1e3 * mean:.2f} (1 failed)" in text


@pytest.mark.campaign
@matplotlib
def test_the_study_writes_errors_of_all_methods(tmp_path, motions):
    for part, chosen in (("train", motions[:2]), ("eval", motions[2:])):
        (tmp_path / "A" / part).mkdir(parents=True)
        for k, markers in enumerate(chosen):
            (tmp_path / "A" / part / f"{k}.pkl").write_bytes(pickle.dumps(list(markers.astype("f4"))))
    options = study.CableOptions(
        nodes=NODES, space=SPACE, stages=(SearchStage(8, 2, ("bending", "curvature0"), 1),), validation=1
    )
    told = []
    study.rerun(tmp_path / "out", tmp_path, options=options, tell=told.append)
    cells = json.loads((tmp_path / "out" / "cables.json").read_text())
    assert [(cell["cable"], cell["method"], cell["file"]) for cell in cells] == [
        ("A", method, "0") for method in study.METHODS
    ]
    assert all(0.0 < cell["mean_abs_error"] < 0.1 for cell in cells)
    assert "| A" in (tmp_path / "out" / "cables.md").read_text()
    assert (tmp_path / "out" / "A.html").stat().st_size > 1e5
    assert (tmp_path / "out" / "figures" / "cables.png").exists()
    assert told


class OneBreaks:
    """Rollouts off by the logarithm of the stiffness; one piece can be simulated at the start only."""

    def __init__(self, start):
        self.start = cable_coordinates(start)

    def forget(self):
        pass

    def columns(self, x, markers, key):
        values, slopes = np.full((6, 1, 3), 0.01 * x[0]), np.zeros((len(NAMES), 6, 1, 3))
        slopes[0] = 0.01
        broken = key[0] == 0 and not np.array_equal(x, self.start)
        return values * (np.nan if broken else 1.0), slopes


def test_a_piece_that_cannot_be_simulated_does_not_stop_the_search():
    start = CableParameters(bending=0.5)
    motions = [np.zeros((8, 5, 3))] * 4
    found = identify_cable(
        OneBreaks(start),
        start,
        motions,
        lambda p: abs(np.log(p.bending)),
        [SearchStage(6, 4, ("bending",), 8, 1)],
    )
    assert found.parameters.bending == pytest.approx(1.0, abs=1e-3) and not found.notes
