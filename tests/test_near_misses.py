"""Near misses of every argument of every public function: one line at the border, and nothing is compiled."""

import inspect
import itertools
import sys
import traceback
import types
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
import pytest

import knode_cosserat as kc
from knode_cosserat.control import LoopLog
from knode_cosserat.engine.machine_code import MachineCode
from knode_cosserat.learning.residual import Nothing
from tests.trajectories import synthetic

NAME = "delrin-tendon-robot"
ROBOT = kc.load_robot(NAME)
STEPS = np.full((3, 4), 5.0)


class StillController(kc.control.Controller):
    """A controller that no call gets to use."""

    dt = 0.05
    reset = command = None


class StillPlant(kc.control.Plant):
    """A plant that no call gets to use."""

    dt = 0.05
    start = measure = apply = None


def bare(kind: type) -> Any:
    """An object that no call gets to use."""
    return object.__new__(kind)


#: an object of each kind that a user has at hand
OBJECTS: dict[str, Any] = {
    "robot": ROBOT,
    "robots": [ROBOT, ROBOT.replace(length=0.5)],
    "model": kc.KNODE(ROBOT, Nothing()),
    "name": NAME,
    "path": Path("it.nc"),
    "trajectory": synthetic(),
    "recording": kc.recordings.load_example(),
    "measurements": kc.recordings.load_example().sampled(0.05),
    "recordings": [kc.recordings.load_example()],
    "controls": STEPS,
    "control": STEPS[0],
    "table": pd.DataFrame({"a": [5.0, 5.0], "b": [5.0, 6.0]}),
    "number": 0.05,
    "whole": 3,
    "position": [0.0, 0.1, 0.5],
    "fit settings": kc.FitConfig(),
    "meaning": kc.recordings.RecordingConfig.paper_robot(),
    "reference": kc.control.constant([0.0, 0.0, 0.5]),
    "controller": bare(StillController),
    "plant": bare(StillPlant),
    "limits": kc.control.ControlLimits(0.0, 20.0),
    "part": kc.robots.loads.PointWrench(),
    "environment": bare(kc.envs.Environment),
    "sweep": bare(kc.sweeps.Sweep),
    "log": bare(LoopLog),
    "modes": bare(kc.statics.Modes),
    "workspace": bare(kc.statics.Workspace),
    "evaluation": kc.identification.Evaluation(failed="no solution"),
    "None": None,
    "class": kc.robots.TendonRobot,
    "function": kc.simulate,
    "mapping": {"a": 1},
    "object": object(),
    "words": ["a", "b"],
}  # fmt: skip
#: kinds that serve where another one is meant
SERVES = {
    "robot": {"model"},
    "robot or batch": {"robot", "robots", "model"},
    "name": {"path"}, "path": {"name"},
    "words": set[str](),
    "controls": {"table"},  # which has its own test
    "control": {"table", "position", "controls"},
    "number": {"whole"},
    "whole": set[str](),
    "recording": {"measurements"}, "measurements": {"recording"},
    "measurable": {"trajectory", "recording", "measurements"},
    "data": {"recordings"},
    "shown": {"trajectory"},
    "motions": {"trajectory", "measurements"},
    "position": {"control"},
    "keys": {"control", "controls"},
    "callable": {"function", "class"},
}  # fmt: skip
GOOD = {
    "robot or batch": ROBOT, "measurable": OBJECTS["trajectory"], "data": OBJECTS["recordings"],
    "shown": OBJECTS["trajectory"], "motions": OBJECTS["trajectory"],
    "motions by name": {"a": OBJECTS["trajectory"]}, "callable": print,
    "keys": jax.random.split(jax.random.key(0)),
}  # fmt: skip
#: kinds of the arguments of each public function, in order
FUNCTIONS: dict[Any, dict[str, str]] = {
    kc.simulate: {"robot": "robot or batch", "controls": "controls", "dt": "number"},
    kc.equilibrium: {"robot": "robot or batch", "control": "control"},
    kc.solvers.equilibria: {"robot": "robot or batch", "controls": "controls"},
    kc.solvers.Stepper: {"robot": "robot", "dt": "number"},
    kc.fit: {"knowledge": "robot", "data": "data", "config": "fit settings"},
    kc.identify: {"robot": "robot", "data": "data"},
    kc.identification.predict: {"robot": "robot", "measured": "measurements"},
    kc.identification.evaluate: {"robot": "robot", "measured": "measurements"},
    kc.recordings.Measurements.of: {"data": "measurable"},
    kc.recordings.estimate_states: {"recording": "recording", "robot": "robot"},
    kc.recordings.estimate_parts: {"recording": "recording", "robot": "robot"},
    kc.workspace: {"robot": "robot", "controls": "controls"},
    partial(kc.inverse_kinematics, low=0.0, high=9.0): {"robot": "robot", "position": "position"},
    kc.statics.configuration: {"robot": "robot", "control": "control"},
    kc.statics.equilibrium_path: {"robot": "robot", "first": "control", "last": "control"},
    kc.statics.stability: {"equilibrium": "trajectory"},
    kc.statics.modes: {"equilibrium": "trajectory"},
    kc.load_robot: {"name_or_path": "name"},
    kc.robots.check: {"part": "part"},
    kc.save_robot: {"robot": "robot", "path": "path"},
    kc.export: {"model": "robot", "folder": "path", "dt": "number"},
    kc.load_trajectory: {"path": "path"},
    kc.load_model: {"path": "path"},
    kc.learning.load_ensemble: {"folder": "path"},
    kc.learning.explain: {"model": "model"},
    kc.load_recording: {"path": "path"},
    kc.recordings.proposed_config: {"path": "path"},
    kc.controls.load: {"path": "path"},
    partial(kc.controls.base_motion, position=np.zeros((3, 3))): {
        "robot": "robot",
        "controls": "controls",
        "dt": "number",
    },
    kc.controls.save: {"path": "path", "tensions": "controls", "dt": "number"},
    kc.controls.parse: {"specification": "name", "steps": "whole", "dt": "number"},
    kc.controls.constant: {"tension": "number", "steps": "whole"},
    kc.controls.sine: {"period": "number", "steps": "whole", "dt": "number"},
    kc.controls.step: {"height": "number", "steps": "whole", "dt": "number"},
    kc.controls.ramp: {"height": "number", "steps": "whole", "dt": "number"},
    kc.controls.random: {"steps": "whole"},
    kc.control.run_loop: {
        "controller": "controller",
        "plant": "plant",
        "reference": "reference",
        "seconds": "number",
    },
    kc.control.controller_named: {"name": "name", "robot": "robot", "dt": "number", "limits": "limits"},
    kc.control.circle: {"radius": "number", "period": "number"},
    kc.control.figure_eight: {"radius": "number", "period": "number"},
    kc.control.steps: {"points": "controls", "hold": "number"},
    kc.control.constant: {"value": "position"},
    kc.control.table: {"time": "position", "values": "controls"},
    kc.sweeps.load_sweep: {"folder": "path"},
    kc.sweeps.run_sweep: {"sweep": "sweep", "folder": "path"},
    kc.envs.animate_episode: {
        "environment": "environment",
        "policy": "callable",
        "key": "keys",
        "path": "path",
    },
    kc.envs.controller_scores: {"environment": "environment", "keys": "keys"},
    kc.envs.policy_scores: {"environment": "environment", "policy": "callable", "keys": "keys"},
    kc.view: {"trajectories": "shown"},
    kc.viewer.export_scene: {"trajectories": "shown", "path": "path"},
    kc.viewer.view_live: {"robot": "robot"},
    kc.viewer.control_live: {"controller": "controller", "plant": "plant"},
    kc.figures.animate: {"trajectories": "shown", "path": "path"},
    kc.figures.closed_loop: {"log": "log"},
    kc.figures.compare: {"reference": "trajectory", "predictions": "motions by name"},
    kc.figures.evaluation_page: {"evaluations": "evaluation", "path": "path"},
    kc.figures.health: {"recording": "recording"},
    kc.figures.residual: {"model": "model", "trajectory": "trajectory"},
    kc.figures.overview: {"trajectory": "trajectory"},
    kc.figures.shape: {"trajectory": "trajectory"},
    kc.figures.spread: {"batch": "trajectory"},
    kc.figures.summary: {"motion": "trajectory"},
    kc.figures.tensions: {"trajectory": "trajectory"},
    kc.figures.states: {"trajectories": "shown"},
    kc.figures.tips: {"trajectories": "motions"},
    kc.figures.prediction_against_measurement: {"prediction": "motions", "recording": "measurements"},
    kc.figures.vibration: {"modes": "modes"},
    kc.figures.workspace: {"samples": "workspace"},
    kc.metrics.state_errors: {"estimate": "trajectory", "truth": "trajectory"},
    kc.metrics.tip_rmse: {"prediction": "motions", "reference": "motions"},
    kc.metrics.tip_dtw: {"prediction": "motions", "reference": "motions"},
    kc.metrics.pose_mse: {"prediction": "motions", "reference": "motions"},
    kc.metrics.node_error: {"prediction": "motions", "reference": "motions"},
    kc.metrics.rotation_rmse: {"prediction": "motions", "reference": "motions"},
    kc.metrics.dtw_distance: {"a": "controls", "b": "controls"},
}
#: functions without arguments, for who extends the package, or of anything that is drawn
OTHERS = {
    "catalog",
    "load_example",
    "robot_schema",
    "register",
    "register_controller",
    "parameter",
    "effects_of",
    "numbers_at",
    "make",
    "curves",
    "error",
    "path",
}


def name_of(function: Any) -> str:
    function = getattr(function, "func", function)
    return f"{function.__module__.partition('.')[2]}.{function.__qualname__}"


def test_every_public_function_is_tried():
    tried = {getattr(it, "func", it) for it in FUNCTIONS}
    spaces = [it for name in kc.__all__ if isinstance(it := getattr(kc, name), types.ModuleType)]
    public = {
        (name, thing)
        for space in (kc, *spaces)
        for name in getattr(space, "__all__", ())
        if inspect.isfunction(thing := getattr(space, name))
    }
    assert {name for name, thing in public if thing not in tried} == OTHERS


def misses(kinds: dict[str, str]) -> Any:
    """Yield arguments of which one is a near miss, or two are swapped, and the names of these."""
    good = {name: GOOD.get(kind, OBJECTS.get(kind)) for name, kind in kinds.items()}
    for name, kind in kinds.items():
        for wrong in set(OBJECTS) - {kind, *SERVES.get(kind, ())}:
            yield good | {name: OBJECTS[wrong]}, f"{name}: {wrong}"
    names = list(kinds)
    for one, other in itertools.pairwise(names):
        allowed = {kinds[one], *SERVES.get(kinds[one], ())}
        if kinds[other] not in allowed and kinds[one] not in SERVES.get(kinds[other], ()):
            yield good | {one: good[other], other: good[one]}, f"{one} and {other} swapped"


def complaint(function: Any, arguments: dict[str, Any]) -> str | None:
    """Return what is wrong with the refusal of a call, or None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            function(*arguments.values())
    except (kc.KnodeCosseratError, ValueError, TypeError) as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        if "knode_cosserat" not in last.filename or not (last.line or "").startswith("raise"):
            return f"{type(error).__name__} from inside, {last.name}: {error}"
        return "several lines" if len(str(error).splitlines()) != 1 else None
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}, {last.name}: {error}"
    return "not refused"


@pytest.fixture(autouse=True)
def nothing_is_compiled(monkeypatch, tmp_path, request):
    if "compiles" in request.node.name:
        return

    def refuse(*_, **__):
        raise AssertionError("code is compiled")

    monkeypatch.setattr(MachineCode, "of", refuse)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("function", FUNCTIONS, ids=name_of)
def test_near_misses_are_refused_in_one_line(function):
    found = {
        name: said
        for arguments, name in misses(FUNCTIONS[function])
        if (said := complaint(function, arguments))
    }
    assert not found, "\n".join(f"{name}: {said}" for name, said in sorted(found.items()))


@pytest.mark.parametrize("function", FUNCTIONS, ids=name_of)
def test_other_arguments_are_no_plain_objects(function):
    plain = getattr(function, "func", function)
    given = {name: GOOD.get(kind, OBJECTS.get(kind)) for name, kind in FUNCTIONS[function].items()}
    found = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if name in given or parameter.kind is parameter.VAR_KEYWORD or parameter.default is parameter.empty:
            continue
        said = complaint(partial(plain, **{**getattr(function, "keywords", {}), name: object()}), given)
        if said:
            found[name] = said
    assert not found, "\n".join(f"{name}: {said}" for name, said in sorted(found.items()))


# one object, everywhere


def shuffled(names: list[str], rows: int = 3) -> tuple[pd.DataFrame, np.ndarray]:
    """Return a table of controls in another order, and its rows in the robot's order."""
    values = np.arange(1.0, 4.0 * rows + 1.0).reshape(rows, 4)
    return pd.DataFrame(values, columns=names)[[names[k] for k in (2, 0, 3, 1)]], values


@pytest.mark.parametrize("names", [ROBOT.control_layout.labels, kc.controls.titles(ROBOT.control_layout)])
def test_tables_of_controls_are_matched_by_the_names_of_their_columns(names):
    table, values = shuffled(names)
    layout = ROBOT.control_layout
    np.testing.assert_array_equal(layout.numbers_of(table), values)
    np.testing.assert_array_equal(layout.numbers_of(table.iloc[1]), values[1])
    np.testing.assert_array_equal(layout.numbers_of(pd.DataFrame(values)), values)
    for function, given in (
        (lambda it: kc.solvers.simulate(ROBOT, it, 0.05), table),
        (lambda it: kc.solvers.equilibria(ROBOT, it), table),
        (lambda it: kc.equilibrium(ROBOT, it), table.iloc[0]),
        (lambda it: kc.statics.configuration(ROBOT, it), table.iloc[0]),
        (lambda it: kc.workspace(ROBOT, it), table),
    ):
        renamed = given.rename({names[0]: "pull"}, axis=given.ndim - 1)
        with pytest.raises(
            ValueError, match=r"columns are .*pull.*allowed are tension_1, tension_2"
        ) as refused:
            function(renamed)
        assert "\n" not in str(refused.value)
        if given is table:  # repeated, missing, one more
            for wrong in (table[[*names, names[0]]], table[names[:3]], table.assign(time=0.0)):
                with pytest.raises(ValueError, match="their columns are"):
                    function(wrong)


def test_recordings_become_the_rows_that_models_learn_from():
    recording = OBJECTS["recording"]
    rows = kc.recordings.Measurements.of(recording)
    same = recording.sampled(0.0125, mean=True)
    for name in ("time", "control", "position", "quaternion"):
        np.testing.assert_array_equal(getattr(rows, name), getattr(same, name))
    assert kc.recordings.Measurements.of(rows) is rows
    with pytest.raises(ValueError, match="fractions are of trajectories"):
        kc.recordings.Measurements.of(recording, (0.5,))
    for wrong in ((2.0,), 0.5, [[0.5]]):
        with pytest.raises(ValueError, match=r"fractions (is|holds)"):
            kc.recordings.Measurements.of(OBJECTS["trajectory"], wrong)


def test_functions_of_measurements_take_recordings(monkeypatch):
    given = []

    def refuse(_robot, control, **_):
        given.append(control)
        raise kc.SimulationError(0, 0.0, 1.0, kc.Result.NO_CONVERGENCE, "no time")

    module = sys.modules["knode_cosserat.identification.evaluate"]
    monkeypatch.setattr(module, "equilibrium", refuse)
    recording = OBJECTS["recording"]
    for it in (recording, kc.recordings.Measurements.of(recording)):
        assert kc.identification.evaluate(ROBOT, it).failed.endswith("no time")
        with pytest.raises(kc.SimulationError):
            kc.identification.predict(ROBOT, it)
    assert len(given) == 4
    np.testing.assert_array_equal(given, [given[0]] * 4)


def test_recordings_are_read_with_the_file_of_their_configuration(tmp_path):
    path, settings = tmp_path / "it.csv", tmp_path / "config.yaml"
    recording = OBJECTS["recording"]
    recording.sampled(0.05).save(path)
    config = kc.load_recording(path).config.replace(description="named")
    config.save(settings)
    for it in (config, settings, str(settings)):
        assert "named" in kc.load_recording(path, it).source
    with pytest.raises(kc.recordings.RecordingError, match=r"none\.yaml"):
        kc.load_recording(path, tmp_path / "none.yaml")


def test_robots_without_controls_need_none_and_it_compiles():
    """A hanging rod stretches by ρgL²/2E, which is 2.5 µm here."""
    rod = kc.robots.SlenderRod(
        length=0.5, radius=0.005, density=1e3, youngs_modulus=5e8, gravity=[0.0, 0.0, 9.81], nodes=5
    )
    tip = kc.equilibrium(rod).tip_position[0]
    np.testing.assert_allclose(tip, [0.0, 0.0, 0.5 + 1e3 * 9.81 * 0.5**2 / (2.0 * 5e8)], atol=1e-9)
    np.testing.assert_allclose(kc.statics.configuration(rod).position, tip, atol=1e-9)
    with pytest.raises(ValueError, match=r"control is None; allowed is \(4,\): tension_1, tension_2"):
        kc.equilibrium(ROBOT)
    with pytest.raises(ValueError, match="control is not numbers"):
        kc.statics.configuration(ROBOT)
