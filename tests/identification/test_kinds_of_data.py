"""A known robot is recovered from each kind of data that laboratories measure."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.estimation.outputs import BaseWrench, BendingAngles, Curvatures, Orientations
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.recordings import Measurements
from knode_cosserat.rods.parts import Markers
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
    return kc.simulate(TRUE, pulled, DT, initial=kc.equilibrium(TRUE, pulled[0]))


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
    seen = Measurements.of(motion, (), [output])
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
    seen = Measurements.of(motion, (1.0,), [Orientations((0.5,)), BaseWrench()])
    found, parts = recovered([seen])
    np.testing.assert_allclose(parts, 1.0, rtol=1e-6)
    errors = evaluate(found.robot, seen)
    assert {*errors.sensors} == {"orientations (rad)", "base wrench (N)", "base wrench (N m)"}
    assert str(errors).count("RMSE") == 4
