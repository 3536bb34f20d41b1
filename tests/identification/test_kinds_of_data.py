"""A known robot is recovered from each kind of data that laboratories measure."""

import dataclasses
from functools import partial

import jax
import numpy as np
import pytest
import yaml
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.estimation.outputs import BaseWrench, BendingAngles, Curvatures, Orientations
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.recordings import Measurements, RecordingConfig, RecordingError
from knode_cosserat.recordings.streams import Sensor
from knode_cosserat.rods.tendons import Markers
from knode_cosserat.rotation import quaternion_product

DT = 0.025
FREE = ["youngs_modulus", "bending_damping"]
ROBOT = kc.robots.RoutedTendonRobot.like(kc.load_robot("delrin-tendon-robot")).replace(
    length=0.5, radius=0.003, density=1200.0, tendon_offset=0.025, nodes=5
)
TRUE = ROBOT.replace(youngs_modulus=1.5e9, bending_damping=2e-3)
NOMINAL = ROBOT.replace(youngs_modulus=2.2e9, bending_damping=4e-3)


@pytest.fixture(scope="module")
def motion():
    sine = kc.controls.sine(0.8, 35, DT, base=4.0, amplitude=2.5)
    pulled = np.concatenate([np.full((5, 4), 4.0), sine])
    start = kc.equilibrium(TRUE, pulled[0], space="lobatto4")
    return kc.simulate(TRUE, pulled, DT, initial=start, space="lobatto4")


def sensed(motion, fractions, outputs):
    """Measurements of bodies, and of the outputs by other sensors."""
    time, y, z = (np.asarray(part) for part in (motion.time, motion.y, motion.z))
    sensors = [
        Sensor(time, np.asarray(jax.vmap(partial(it.value, TRUE))(y, z)), it, it.fields[0]) for it in outputs
    ]
    return dataclasses.replace(Measurements.of(motion, fractions), sensors=tuple(sensors))


def recovered(data):
    """Numbers found by identification, over those of the true robot."""
    found = kc.identify(NOMINAL, data, parameters=FREE)
    return found, [it.value / np.max(getattr(TRUE, it.label)) for it in found.estimates if it.label in FREE]


def mounted(orientations):
    """Orientations of a body whose axes are permuted, which begins upside down."""
    product = np.vectorize(quaternion_product, signature="(4),(4)->(4)")
    return product(orientations.reshape(-1, 4), np.array([0.5, 0.5, 0.5, 0.5])).reshape(orientations.shape)


@pytest.mark.parametrize(
    "output",
    [Orientations((1.0,)), BendingAngles((1.0,)), Curvatures((0.25, 0.6)), BaseWrench()],
    ids=lambda output: output.fields[0],
)
def test_no_motion_capture_is_needed(motion, output):
    seen = sensed(motion, (), [output])
    (sensor,) = seen.sensors
    values = sensor.values.copy()
    if isinstance(output, Orientations):
        values = mounted(values)
    values[[7, 20]] = np.nan
    seen = dataclasses.replace(seen, sensors=(dataclasses.replace(sensor, values=values),))
    found, parts = recovered([seen])
    np.testing.assert_allclose(parts, 1.0, rtol=1e-6)
    errors = [evaluate(robot, seen).sensors for robot in (found.robot, NOMINAL)]
    assert all(errors[0][name] < 1e-3 * errors[1][name] for name in errors[1])


def test_positions_of_the_tip_alone_are_enough(motion):
    seen = Measurements.of(motion)
    found, parts = recovered([dataclasses.replace(seen, quaternion=np.full_like(seen.quaternion, np.nan))])
    np.testing.assert_allclose(parts, 1.0, rtol=1e-6)
    assert found.error[seen.source] < 1e-8


@pytest.mark.slow
def test_an_unknown_heading_of_the_global_frame_is_found(motion):
    seen = sensed(motion, (), [Orientations((1.0,))])
    (sensor,) = seen.sensors
    turned = Rotation.from_rotvec([0.0, 0.0, 0.15]) * Rotation.from_quat(sensor.values, scalar_first=True)
    rotated = dataclasses.replace(sensor, values=turned.as_quat(scalar_first=True))
    found = kc.identify(NOMINAL, [dataclasses.replace(seen, sensors=(rotated,))], ["base rotation"])
    values = {it.label: it.value for it in found.estimates}
    assert values["youngs_modulus"] == pytest.approx(1.5e9, rel=0.01)
    turns = [values[f"base_rotation.{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(turns, [0.0, 0.0, 0.15], atol=3e-3)


def test_few_markers_at_unknown_places_are_enough(motion):
    seen = Measurements.of(motion, (0.37, 0.68))
    unsure = dataclasses.replace(
        seen,
        fractions=np.array([0.3, 0.75]),
        deviations=(0.1, 0.1),
        quaternion=np.full_like(seen.quaternion, np.nan),
    )
    found, parts = recovered([unsure])
    np.testing.assert_allclose(parts, 1.0, rtol=1e-4)
    places = [it.value for it in found.estimates if it.label.startswith("place")]
    np.testing.assert_allclose(places, [0.37, 0.68], atol=1e-4)
    assert evaluate(found.robot, unsure).tip_rmse < 1e-5


def test_places_are_kept_in_the_robots_file(motion, tmp_path):
    part = Markers(at=np.array([0.37, 0.68]), stated=(0.3, 0.75))
    kc.save_robot(TRUE.replace(effects=(part,)), tmp_path / "robot.yaml")
    seen = Measurements.of(motion, (0.37, 0.68))
    stated = dataclasses.replace(seen, fractions=np.array([0.3, 0.75]))
    assert evaluate(kc.load_robot(tmp_path / "robot.yaml"), stated).tip_rmse < 1e-9


def test_kinds_are_weighted_in_one_objective(motion):
    seen = sensed(motion, (1.0,), [Orientations((0.5,)), BaseWrench()])
    found, parts = recovered([seen])
    np.testing.assert_allclose(parts, 1.0, rtol=1e-6)
    errors = evaluate(found.robot, seen)
    assert {*errors.sensors} == {"orientations (rad)", "base wrench (N)", "base wrench (N m)"}
    assert str(errors).count("RMSE") == 4


SENSED = """format: 1
columns: {time: t, tension: [I1, I2, I3, I4]}
tension: {gain: 0.8e-3, held: true}
sensors:
  - {kind: orientation, columns: [roll, pitch, yaw], unit: deg, fractions: 1.0}
  - {kind: bending_angle, columns: [bend, direction], fractions: 0.5}
  - {kind: curvature, columns: [kx1, ky1, kx2, ky2], fractions: [0.25, 0.6], unit: 1/mm}
  - {kind: base_wrench, columns: [fx, fy, fz, mx, my, mz], unit: mN, rotation: [0.5, 0.5, 0.5, 0.5]}
repeats: drop
"""


def logged(motion, path):
    """Currents (mA) of motors and all sensors, at irregular times, with lost and repeated rows."""
    outputs = [Orientations((1.0,)), BendingAngles((0.5,)), Curvatures((0.25, 0.6)), BaseWrench()]
    seen = sensed(motion, (), outputs)
    rng = np.random.default_rng(1)
    time = np.sort(np.append(rng.uniform(0.0, 1.0, 240), seen.time))
    time = time[(time < 0.61) | (time > 0.62)]
    turns, angles, curvatures, wrench = (
        CubicSpline(seen.time, sensor.values)(time) for sensor in seen.sensors
    )
    euler = Rotation.from_quat(mounted(turns), scalar_first=True).as_euler("ZYX", degrees=True)[:, ::-1]
    bend = np.stack([np.linalg.norm(angles, axis=1), np.arctan2(angles[:, 1], angles[:, 0])], axis=1)
    frame = Rotation.from_quat([0.5, 0.5, 0.5, 0.5], scalar_first=True).inv()
    forces = 1e3 * frame.apply(wrench.reshape(-1, 3)).reshape(wrench.shape)
    currents = seen.control[np.searchsorted(seen.time, time + 1e-9, side="right") - 1] / 0.8e-3
    table = np.hstack([time[:, None], currents, euler, bend, 1e-3 * curvatures, forces])
    table = np.repeat(table, 1 + (np.arange(len(time)) % 7 == 3), axis=0)
    table[40:42, 5:8] = np.nan
    titles = "t,I1,I2,I3,I4,roll,pitch,yaw,bend,direction,kx1,ky1,kx2,ky2,fx,fy,fz,mx,my,mz"
    np.savetxt(path, table, delimiter=",", header=titles, comments="")
    return seen


def test_a_log_of_sensors_is_read_and_recovers_the_robot(motion, tmp_path):
    seen = logged(motion, tmp_path / "log.csv")
    (tmp_path / "map.yaml").write_text(SENSED)
    config = RecordingConfig.load(tmp_path / "map.yaml")
    assert RecordingConfig.from_dict(yaml.safe_load(config.to_yaml())) == config
    recording = kc.load_recording(tmp_path / "log.csv", config)
    rows = recording.sampled(DT)
    np.testing.assert_allclose(rows.control, seen.control[: len(rows.time)], atol=1e-9)
    for read, exact in zip(rows.sensors[1:], seen.sensors[1:], strict=True):
        np.testing.assert_allclose(
            read.values, exact.values[: len(rows.time)], atol=1e-3 * np.ptp(exact.values)
        )
    assert "orientation" in repr(recording) and "orientation" in str(recording.health)
    parts = recovered([recording.sampled(DT)])[1]
    np.testing.assert_allclose(parts, 1.0, rtol=0.01)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("kind: curvature, columns: [kx1, ky1, kx2], fractions: [0.5]", "allowed for curvature is 2"),
        ("kind: orientation, columns: [roll, pitch], fractions: 1.0", "allowed for orientation is 4 or 3"),
        ("kind: orientation, columns: [roll, pitch, yaw], unit: 1/m", "unit"),
        ("kind: strain, columns: [kx1, ky1]", "allowed is"),
        ("kind: curvature, columns: [kx1, ky1], fractions: 1.5", "1.5"),
        ("kind: base_wrench", "the columns of the sensor base_wrench are missing"),
        ("kind: bending_angle, columns: [bend, no]", "no"),
    ],
)
def test_wrong_sensors_are_refused_in_one_line(motion, tmp_path, text, words):
    logged(motion, tmp_path / "log.csv")
    (tmp_path / "map.yaml").write_text(
        f"format: 1\ncolumns: {{time: t, tension: [I1, I2, I3, I4]}}\nsensors:\n  - {{{text}}}\n"
    )
    with pytest.raises(RecordingError) as refused:
        kc.load_recording(tmp_path / "log.csv", RecordingConfig.load(tmp_path / "map.yaml"))
    assert words in str(refused.value) and "\n" not in str(refused.value)
