"""Parameters whose nominal value is zero, and quaternions, are identified."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.free_parameters import parameter_effects
from knode_cosserat.rods.parameters import value_at

ends, loads = kc.robots.ends, kc.robots.loads
PUSH = [0.05, 0.0, 0.0]
#: a turn of 0.2 rad about an axis across the rod
TILT = Rotation.from_rotvec(0.2 * np.array([0.6, 0.8, 0.0])).as_quat(scalar_first=True)


def rod(**changes):
    body = {"length": 0.5, "radius": 0.004, "density": 1500.0, "youngs_modulus": 5e7, "bending_damping": 2e-3}
    return kc.robots.SlenderRod(**body | {"nodes": 6, "gravity": [0.0, 0.0, 9.81]} | changes)


@pytest.mark.parametrize(
    ("nominal", "turn"),
    [
        ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ([1.0, 0.0, 0.0, 0.0], [0.3, -0.2, 0.1]),
        ([-2.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0]),
        ([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1e-9]),
        ([0.5, 0.5, -0.5, 0.5], [-1.0, 2.0, 0.5]),
    ],
)
def test_a_quaternion_is_searched_by_its_turn(nominal, turn):
    robot = rod(base_end=ends.Clamped(orientation=nominal))
    model = ParameterModel(robot, parameter_effects(robot, ["base_end.orientation"]))
    assert model.size == 3 and [it.unit for it in model.numbers] == ["rad"] * 3
    found = Rotation.from_quat(
        np.asarray(value_at(model.robot(np.array(turn)), "base_end.orientation")), scalar_first=True
    )
    wanted = Rotation.from_rotvec(turn) * Rotation.from_quat(nominal, scalar_first=True)
    assert (found * wanted.inv()).magnitude() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("measured", [False, True])
@pytest.mark.parametrize(
    ("nominal", "true", "name"),
    [
        (
            {"loads": [loads.PointWrench(force=[0.0] * 3)]},
            {"loads": [loads.PointWrench(force=[0.02, -0.01, 0.0])]}, "loads.0.force",
        ),
        (
            {"loads": [loads.AttachedMass(mass=0.0), loads.PointWrench(force=PUSH)]},
            {"loads": [loads.AttachedMass(mass=4e-3), loads.PointWrench(force=PUSH)]}, "loads.0.mass",
        ),
        ({"drag": 0.0}, {"drag": 2e-3}, "drag"),
        (
            {"base_end": ends.Clamped(position=[0.0] * 3)},
            {"base_end": ends.Clamped(position=[0.01, -0.02, 0.0])}, "base_end.position",
        ),
        ({"gravity": [0.0] * 3}, {"gravity": [1.0, 2.0, -9.0]}, "gravity"),
        (
            {"base_end": ends.Clamped(orientation=[1.0, 0.0, 0.0, 0.0])},
            {"base_end": ends.Clamped(orientation=TILT)}, "base_end.orientation",
        ),
    ],
)  # fmt: skip
def test_what_is_nominally_zero_or_a_quaternion_is_found(nominal, true, name, measured):
    if "loads" not in nominal:
        nominal, true = ({"loads": [loads.PointWrench(force=PUSH)], **it} for it in (nominal, true))
    data = kc.simulate(rod(**true), np.zeros((12, 0)), 0.02, initial="unstressed")
    if measured:
        data = kc.recordings.Measurements.of(data, (0.5, 1.0))
    if measured and name == "base_end.orientation":
        # a round rod that turns about itself is seen in its states alone
        with pytest.raises(
            kc.identification.IdentificationError, match=r"not determine base_end\.orientation"
        ):
            kc.identify(rod(**nominal), [data], parameters=[name], space="lobatto2")
        return
    found = kc.identify(rod(**nominal), [data], parameters=[name], space="lobatto2")
    np.testing.assert_allclose(value_at(found.robot, name), value_at(rod(**true), name), rtol=1e-5, atol=1e-6)
    assert not found.undetermined
