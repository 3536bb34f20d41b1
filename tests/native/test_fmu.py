"""FMUs of robots: run by FMPy, they make the steps of `simulate`."""

import ctypes
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine.native import TargetError
from knode_cosserat.native import ExportError
from knode_cosserat.native.fmu import VERSIONS, Packer
from tests.engine.networks import PAPER, with_network

fmpy = pytest.importorskip("fmpy")
fmi2, fmi3 = pytest.importorskip("fmpy.fmi2"), pytest.importorskip("fmpy.fmi3")
validation = pytest.importorskip("fmpy.validation")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="FMUs are made on Linux")
DT, STEPS = 0.02, 40
CONTROLS = kc.controls.sine(0.6, STEPS, DT)
TENSIONS = range(4)
#: as far as steps that begin with other first guesses agree, by Newton's tolerance (m)
SAME = 1e-9


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """C code of the paper's robot."""
    return kc.export(PAPER, tmp_path_factory.mktemp("fmu") / "paper", DT)


@pytest.fixture(scope="module")
def files(exported):
    """FMUs of it by their versions."""
    folder = exported.folder.parent
    for version in VERSIONS:
        Packer.of(folder / f"{version}.fmu", version, "native").write(exported, PAPER)
    return {version: folder / f"{version}.fmu" for version in VERSIONS}


@pytest.fixture(scope="module")
def motion():
    return kc.simulate(PAPER, CONTROLS, DT)


class Instance:
    """An instance of an FMU of either version, with the messages that it has logged."""

    def __init__(self, path: Path, settled: bool = False, inputs=None, start_time: float = 0.0):
        description = fmpy.read_model_description(str(path))
        self.references = {each.name: each.valueReference for each in description.modelVariables}
        self.is_3 = description.fmiVersion == "3.0"
        self.messages: list[str] = []
        self.folder = fmpy.extract(str(path))
        kind = fmi3.FMU3Slave if self.is_3 else fmi2.FMU2Slave
        self.fmu = kind(
            guid=description.guid, unzipDirectory=self.folder, instanceName="arm",
            modelIdentifier=description.coSimulation.modelIdentifier,
        )  # fmt: skip
        if self.is_3:
            self.log = fmi3.fmi3LogMessageCallback(lambda *given: self.messages.append(given[-1].decode()))
            self.fmu.instantiate(logMessage=self.log)
        else:
            self.log = fmi2.fmi2CallbackLoggerTYPE(lambda *given: self.messages.append(given[-1].decode()))
            callbacks = fmi2.fmi2CallbackFunctions()
            callbacks.logger = self.log
            self.fmu.instantiate(callbacks=callbacks)
        if settled:
            self.fmu.setBoolean([self.references["settled"]], [True])
        if not self.is_3:
            self.fmu.setupExperiment(startTime=start_time)
        self.fmu.enterInitializationMode(**({"startTime": start_time} if self.is_3 else {}))
        if inputs is not None:
            self.set(inputs)
        self.fmu.exitInitializationMode()

    def set(self, inputs):
        (self.fmu.setFloat64 if self.is_3 else self.fmu.setReal)(list(TENSIONS), list(map(float, inputs)))

    def tip(self):
        if self.is_3:
            return np.array(self.fmu.getFloat64([self.references["tip_position"]], 3))
        return np.array(self.fmu.getReal([self.references[f"tip_position[{k}]"] for k in (1, 2, 3)]))

    def step(self, inputs, time, step=DT):
        self.set(inputs)
        self.fmu.doStep(time, step)
        return self.tip()

    def close(self):
        self.fmu.terminate()
        self.fmu.freeInstance()
        shutil.rmtree(self.folder)


@pytest.fixture
def opened(files):
    """Open instances by their version; they are closed after a test."""
    instances = []

    def new(version="3.0", **options):
        instances.append(Instance(files[version], **options))
        return instances[-1]

    yield new
    for each in instances:
        each.close()


def signals(controls, labels, dt=DT):
    """Return inputs as FMPy reads them."""
    rows = np.zeros(len(controls) + 1, dtype=[("time", float), *((label, float) for label in labels)])
    rows["time"] = dt * np.arange(len(rows))
    for k, label in enumerate(labels):
        rows[label] = np.append(controls[:, k], controls[-1, k])
    return rows


def array_of(found, name, version, size):
    """Return rows of an output that is an array."""
    if version == "3.0":
        return found[name].reshape(len(found), -1)
    names = [each for each in found.dtype.names if each.startswith(f"{name}[")]
    assert len(names) == size
    return np.stack([found[each] for each in names], axis=-1)


@pytest.mark.parametrize("version", VERSIONS)
def test_an_fmu_is_valid_and_its_motion_is_that_of_simulate(files, motion, version):
    path = str(files[version])
    assert validation.validate_fmu(path) == []
    labels = PAPER.control_layout.labels
    found = fmpy.simulate_fmu(path, input=signals(CONTROLS, labels), stop_time=STEPS * DT, output_interval=DT)
    expected = {
        "tip_position": motion.tip_position,
        "tip_orientation": motion.quaternion[:, -1],
        "node_positions": motion.position.reshape(len(motion.position), -1),
        "base_force": motion.force[:, 0],
        "base_moment": motion.moment[:, 0],
    }
    assert len(found) == STEPS + 1
    for name, values in expected.items():
        np.testing.assert_allclose(array_of(found, name, version, values.shape[1]), values, rtol=0, atol=SAME)
    np.testing.assert_allclose(found["position_error"][1:], motion.position_error[1:], rtol=1e-6)
    assert found["position_error"][0] == -1.0
    assert list(found["result"]) == list(motion.result)


def test_variables_have_units_limits_and_starts(files):
    variables = {each.name: each for each in fmpy.read_model_description(str(files["3.0"])).modelVariables}
    assert [variables[label].unit for label in PAPER.control_layout.labels] == ["N"] * 4
    assert {each.start for each in variables.values() if each.causality == "input"} == {"0.0"}
    assert [variables[name].unit for name in ("base_force", "base_moment", "tip_position")] == [
        "N",
        "N m",
        "m",
    ]
    units = {
        each.name: each.baseUnit for each in fmpy.read_model_description(str(files["2.0"])).unitDefinitions
    }
    assert (units["N m"].m, units["N m"].kg, units["N m"].s) == (2, 1, -2)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_state_is_restored_and_serialized(opened, version):
    one, other = opened(version), opened(version)
    for k in range(5):
        one.step(CONTROLS[k], k * DT)
    state = one.fmu.getFMUState() if one.is_3 else one.fmu.getFMUstate()
    content = one.fmu.serializeFMUState(state) if one.is_3 else one.fmu.serializeFMUstate(state)
    tip = one.tip()
    expected = [one.step(CONTROLS[k], k * DT) for k in range(5, 10)]
    (one.fmu.setFMUState if one.is_3 else one.fmu.setFMUstate)(state)
    assert np.array_equal(one.tip(), tip)
    again = [one.step(CONTROLS[k], k * DT) for k in range(5, 10)]
    np.testing.assert_allclose(again, expected, rtol=0, atol=SAME)
    if other.is_3:
        other.fmu.setFMUState(other.fmu.deserializeFMUState(content))
    else:
        other.fmu.setFMUstate(other.fmu.deSerializeFMUstate(content))
    assert np.array_equal([other.step(CONTROLS[k], k * DT) for k in range(5, 10)], again)
    (one.fmu.freeFMUState if one.is_3 else one.fmu.freeFMUstate)(state)


def test_a_damaged_state_is_refused(opened):
    one = opened()
    one.step(CONTROLS[0], 0.0)
    content = bytearray(one.fmu.serializeFMUState(one.fmu.getFMUState()))
    tip = one.tip()
    half = len(content) // 2
    for damaged in (content[:-8], b"\0" * 8 + content[8:], content[:half] + b"\xff" * (len(content) - half)):
        with pytest.raises(Exception, match="failed with status"):
            one.fmu.setFMUState(one.fmu.deserializeFMUState(bytes(damaged)))
    assert "not a state of this FMU" in one.messages[0] and "is damaged" in one.messages[-1]
    assert np.array_equal(one.tip(), tip)
    assert np.all(np.isfinite(one.step(CONTROLS[1], DT)))


@pytest.mark.parametrize(("version", "count"), [("2.0", 1), ("3.0", 1), ("3.0", 4)])
def test_derivatives_are_those_of_the_last_step_by_its_inputs(opened, version, count):
    one = opened(version)
    for k in range(5):
        one.step(CONTROLS[k], k * DT)
    get, put = (
        (one.fmu.getFMUState, one.fmu.setFMUState) if one.is_3 else (one.fmu.getFMUstate, one.fmu.setFMUstate)
    )
    read = one.fmu.getFloat64 if one.is_3 else one.fmu.getReal
    before, inputs, change = get(), np.array(CONTROLS[5]), 1e-3
    names = ("tip_position", "tip_orientation", "base_moment")
    if one.is_3:
        outputs, size = [one.references[name] for name in names], (10,)
    else:
        outputs = [
            one.references[f"{name}[{k}]"]
            for name, most in zip(names, (3, 4, 3), strict=True)
            for k in range(1, most + 1)
        ]
        size = ()

    def after(inputs):
        put(before)
        one.step(inputs, 5 * DT, count * DT)
        return np.array(read(outputs, *size))

    differences = [
        (after(inputs + change * unit) - after(inputs - change * unit)) / (2 * change) for unit in np.eye(4)
    ]
    after(inputs)
    directional = one.fmu.getDirectionalDerivative
    found = [directional(outputs, [k], [1.0], *size) for k in TENSIONS]
    scale = np.abs(differences).max(axis=0)
    # central differences, whose error is their third derivative and Newton's tolerance over the change
    np.testing.assert_allclose(found / scale, differences / scale, rtol=0, atol=2e-4)
    # of all inputs at once
    seed = [0.5, -1.0, 2.0, 0.25]
    np.testing.assert_allclose(directional(outputs, list(TENSIONS), seed, *size), seed @ np.array(found))


def test_derivatives_by_outputs_are_refused(opened):
    one = opened()
    one.step(CONTROLS[0], 0.0)
    for unknown, known in ((one.references["position_error"], 0), (4, 4), (0, 0), (5, 0)):
        with pytest.raises(Exception, match="failed with status"):
            one.fmu.getDirectionalDerivative([unknown], [known], [1.0], 1)


def test_fmus_in_one_process_do_not_know_of_each_other(files, opened):
    instances = [opened("2.0"), opened("3.0"), opened("3.0")]
    # all symbols are seen by all libraries
    for each in instances:
        (library,) = Path(each.folder).glob("binaries/*/*.so")
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    # the third, in the second's library
    runs = [CONTROLS, CONTROLS, CONTROLS[:, ::-1]]
    tips = [[each.step(run[k], k * DT) for each, run in zip(instances, runs, strict=True)] for k in range(10)]
    alone = opened("3.0")
    expected = [alone.step(CONTROLS[k, ::-1], k * DT) for k in range(10)]
    first, second, third = np.moveaxis(tips, 1, 0)
    assert np.array_equal(first, second) and np.array_equal(third, expected)
    assert not np.array_equal(second, third)


@pytest.mark.parametrize("version", VERSIONS)
def test_steps_are_whole_multiples_of_the_internal_one(opened, motion, version):
    one = opened(version, start_time=7.0)
    for wrong in (0.5 * DT, 1.5 * DT, 0.0, -DT, np.nan, np.inf, 1e-300):
        with pytest.raises(Exception, match="failed with status 3"):
            one.step(CONTROLS[0], 7.0, wrong)
        assert "allowed are 0.02 s and whole multiples" in one.messages[-1]
    with pytest.raises(Exception, match="failed with status 3"):
        one.step(CONTROLS[0], 7.5)
    assert one.messages[-1] == "the communication point is t = 7.5 s, but the robot is at t = 7 s"
    held = np.repeat(CONTROLS[::3][:4], 3, axis=0)
    found = [one.step(held[3 * k], 7.0 + 3 * k * DT, 3 * DT) for k in range(4)]
    expected = kc.simulate(PAPER, held, DT).tip_position[3::3]
    np.testing.assert_allclose(found, expected, rtol=0, atol=SAME)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_inputs_that_are_not_finite_leave_the_robot_as_it_was(opened, version, wrong):
    one, other = opened(version), opened(version)
    inputs = [1.0, 2.0, wrong, 3.0]
    with pytest.raises(Exception, match="failed with status 3"):
        one.step(inputs, 0.0)
    assert one.messages[-1].startswith(
        f"t = 0 s: the input tension_3 is {wrong} N; allowed are finite numbers"
    )
    assert np.array_equal(one.step(CONTROLS[0], 0.0), other.step(CONTROLS[0], 0.0))


def test_a_step_that_fails_is_not_made_in_part(opened):
    one = opened()
    tip = one.step(CONTROLS[0], 0.0)
    with pytest.raises(Exception, match="failed with status 3"):
        one.step([1e9, 0.0, 0.0, 0.0], DT, 3 * DT)
    assert "no solution found" in one.messages[-1]
    assert np.array_equal(one.tip(), tip)
    one.step(CONTROLS[1], DT)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_settled_robot_rests_under_its_inputs(opened, version):
    inputs = [6.0, 5.0, 4.0, 5.0]
    one = opened(version, settled=True, inputs=inputs)
    expected = kc.equilibrium(PAPER, inputs).tip_position[-1]
    np.testing.assert_allclose(one.tip(), expected, rtol=0, atol=SAME)
    # by the equilibrium's inputs: its compliance
    outputs = [one.references["tip_position"]] if one.is_3 else [4, 5, 6]
    size = (3,) if one.is_3 else ()
    found = one.fmu.getDirectionalDerivative(outputs, [0], [1.0], *size)
    more, less = ([6.0 + change, 5.0, 4.0, 5.0] for change in (1e-3, -1e-3))
    ends = [kc.equilibrium(PAPER, each).tip_position[-1] for each in (more, less)]
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-3, rtol=0, atol=1e-6)
    np.testing.assert_allclose(one.step(inputs, 0.0), expected, rtol=0, atol=1e-8)


def test_a_reset_robot_starts_again(opened):
    one = opened()
    start, first = one.tip(), one.step(CONTROLS[0], 0.0)
    one.fmu.reset()
    one.fmu.enterInitializationMode()
    one.fmu.exitInitializationMode()
    assert np.array_equal(one.tip(), start) and np.array_equal(one.step(CONTROLS[0], 0.0), first)


def test_calls_out_of_order_and_unknown_variables_are_refused(opened):
    one = opened()
    for call in (
        one.fmu.enterInitializationMode,
        one.fmu.exitInitializationMode,
        one.fmu.enterEventMode,
        lambda: one.fmu.getFloat64([10_000]),
        lambda: one.fmu.getFloat64([5]),
        lambda: one.fmu.getFloat64([one.references["tip_position"]], 2),
        lambda: one.fmu.setFloat64([one.references["tip_position"]], [0.0]),
        lambda: one.fmu.getInt32([0]),
        lambda: one.fmu.setBoolean([one.references["settled"]], [True]),
    ):
        messages = len(one.messages)
        with pytest.raises(Exception, match="failed with status 3"):
            call()
        assert len(one.messages) == messages + 1


def test_a_description_of_another_fmu_is_refused(files):
    description = fmpy.read_model_description(str(files["3.0"]))
    folder = fmpy.extract(str(files["3.0"]))
    identifier = description.coSimulation.modelIdentifier
    fmu = fmi3.FMU3Slave(
        guid="{other}", unzipDirectory=folder, modelIdentifier=identifier, instanceName="arm"
    )
    with pytest.raises(Exception, match="instantiate"):
        fmu.instantiate()


def test_errors_are_one_line(exported, tmp_path, monkeypatch):
    with pytest.raises(ExportError, match=r"fmi is '3'; allowed are 2\.0 and 3\.0\. Did you mean 3\.0\?$"):
        kc.export(PAPER, tmp_path / "arm.fmu", DT, fmi="3")
    with pytest.raises(
        ExportError, match=r"fmi is for a path that ends in \.fmu\. Did you mean .*arm\.fmu\?$"
    ):
        kc.export(PAPER, tmp_path / "arm", DT, fmi="3.0")
    with pytest.raises(ExportError, match="the last part of the path is '3_arms'"):
        kc.export(PAPER, tmp_path / "3-arms.fmu", DT)
    with pytest.raises(TargetError, match="target is 'pdp-11'"):
        kc.export(PAPER, tmp_path / "arm.fmu", DT, target="pdp-11")
    with pytest.raises(ExportError, match=r"^export: false failed: status 1$"):
        Packer(tmp_path / "arm.fmu", "3.0", "x86_64", "false").write(exported, PAPER)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(
        ExportError, match=r"^export: an FMU needs a C compiler, and there is no cc or gcc or"
    ):
        kc.export(PAPER, tmp_path / "arm.fmu", DT)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_fmu_of_a_learned_model(tmp_path):
    model = with_network(16)
    kc.export(model, tmp_path / "learned.fmu", DT)
    path = str(tmp_path / "learned.fmu")
    assert [each.name for each in tmp_path.iterdir()] == ["learned.fmu"]
    assert validation.validate_fmu(path) == []
    rows = signals(CONTROLS, model.control_layout.labels)
    found = fmpy.simulate_fmu(path, input=rows, stop_time=STEPS * DT, output_interval=DT)
    expected = kc.simulate(model, CONTROLS, DT).tip_position
    np.testing.assert_allclose(found["tip_position"], expected, rtol=0, atol=SAME)
    assert np.abs(expected - kc.simulate(PAPER, CONTROLS, DT).tip_position).max() > 1e-6


@pytest.mark.slow
def test_an_fmu_of_a_robot_with_limits(tmp_path):
    robot, path = kc.load_robot("three-chamber-arm"), tmp_path / "arm.fmu"
    kc.export(robot, path, DT, fmi="2.0")
    assert validation.validate_fmu(str(path)) == []
    inputs = [
        each for each in fmpy.read_model_description(str(path)).modelVariables if each.causality == "input"
    ]
    field = robot.control_layout.fields[0]
    assert [(each.unit, each.min, float(each.max)) for each in inputs] == [("Pa", None, field.high)] * 3
    controls = 2e4 * np.sin(2 * np.arange(1, 21) * DT)[:, None] * [1.0, 0.5, 0.2]
    rows = signals(controls, robot.control_layout.labels)
    found = fmpy.simulate_fmu(str(path), input=rows, stop_time=20 * DT, output_interval=DT)
    expected = kc.simulate(robot, controls, DT).tip_position
    np.testing.assert_allclose(array_of(found, "tip_position", "2.0", 3), expected, rtol=0, atol=SAME)
    one = Instance(path)
    try:
        one.fmu.setReal([1], [1.5 * field.high])
        with pytest.raises(Exception, match="failed with status 3"):
            one.fmu.doStep(0.0, DT)
        message = "t = 0 s: the input pressure_2 is 90000 Pa; allowed is at most 60000"
        assert one.messages == [message] and field.high == 60000.0
    finally:
        one.close()
