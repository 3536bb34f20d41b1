"""Robots of every kind are identified from simulated recordings, by effects that their parts state."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat.identification import IdentificationError, evaluate, identify, predict
from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.experiments import PARTS, in_parts
from knode_cosserat.recordings import Measurements
from knode_cosserat.robots import Camera, Doubt, Effect, Insertion, Layout, ParameterError, parameter
from knode_cosserat.rods.chambers import Chambers
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.magnets import PointMagnet, UniformField
from knode_cosserat.rods.tubes import ConcentricTubeRobot, Tube
from knode_cosserat.solvers.equilibrium import equilibria

THREE = (0.0, 2.094395, 4.18879)
ARM = kc.robots.SlenderRod(
    length=0.15,
    radius=0.01,
    density=1100.0,
    youngs_modulus=4e5,
    gravity=(0.0, 0.0, 9.81),
    loads=(AttachedMass(mass=0.008),),
    effects=(Chambers(angles=THREE, offset=0.006, radius=0.003),),
    nodes=5,
)
TUBES = ConcentricTubeRobot(
    length=0.12,
    nodes=9,
    tubes=(
        Tube(
            radius=5e-4,
            inner_radius=3e-4,
            youngs_modulus=6e10,
            density=6450.0,
            curvature=10.0,
            transmission=0.1,
        ),
        Tube(
            radius=9e-4,
            inner_radius=6e-4,
            youngs_modulus=6e10,
            density=6450.0,
            curvature=6.0,
            transmission=0.06,
            end=0.6,
        ),
    ),
)


MAGNET = kc.robots.SlenderRod(
    length=0.06,
    radius=5e-4,
    density=1100.0,
    youngs_modulus=3e6,
    loads=(PointMagnet(moment=(0.0, 0.0, 0.01), field=UniformField(controlled=True)),),
    nodes=5,
)
FED = kc.robots.SlenderRod(
    length=0.1,
    radius=1e-3,
    density=1200.0,
    youngs_modulus=1e8,
    gravity=(9.81, 0.0, 0.0),
    loads=(AttachedMass(mass=0.004),),
    effects=(Insertion(reserve=0.1, retraction=0.02),),
    nodes=5,
)


def recorded(robot: Any, controls: Any, noise: float = 1e-4, seed: int = 0) -> Measurements:
    """Noisy positions of the tip in equilibria, as the robot's camera sees them."""
    nothing = np.full((len(controls), 1, 3), np.nan)
    empty = Measurements(
        time=np.arange(len(controls)) * 2.0,
        control=np.asarray(controls, dtype=float),
        fractions=np.ones(1),
        position=nothing,
        quaternion=np.full((len(controls), 1, 4), np.nan),
        measured=np.ones((len(controls), 1), dtype=bool),
        simulated=True,
        source="own.csv",
        static=True,
    )
    tip = evaluate(robot, dataclasses.replace(empty, position=np.zeros_like(nothing))).tip
    rng = np.random.default_rng(seed)
    return dataclasses.replace(empty, position=tip[:, None] + noise * rng.normal(size=nothing.shape))


def random_controls(robot: Any, low: Any, high: Any, count: int = 40, seed: int = 1) -> Any:
    size = robot.control_layout.size
    return np.random.default_rng(seed).uniform(low, high, (count, size))


# what parts state


def test_parts_state_their_doubts_in_units_and_ranges_of_their_own():
    """One number of one part is itself; of several parts there is what is common and what each has."""
    model = library_model(ARM, np.ones((2, 3)), (1.0,), static=True)
    assert {"effects.0.radius", "camera.rotation", "loads.0.mass", "hyperelastic"} <= {*model.names}
    assert not {"damping", "linear drag"} & {*model.names}
    (radius,) = model.effect("effects.0.radius").numbers
    assert (radius.unit, radius.nominal, radius.low) == ("m", 0.003, 1e-6)
    assert [it.label for it in model.effect("effects.0.angles, each").numbers] == [
        f"effects.0.angles[{k}] (own)" for k in range(3)
    ]
    tubes = library_model(TUBES, np.ones((2, 4)), (1.0,), static=True)
    common, own = (len(tubes.effect(f"tubes.curvature{it}").numbers) for it in ("", ", each"))
    assert (common, own) == (1, 2)
    # all of a tube is curved by default: there is no length in doubt
    assert not [name for name in tubes.names if name.startswith("tubes.curved")]


def test_nominal_numbers_of_stated_effects_change_nothing():
    model = library_model(ARM, np.ones((2, 3)), (1.0,), static=True)
    controls = [[2e4, 0.0, 5e3]]
    whole, bare = (equilibria(it, controls).position for it in (model.robot(np.zeros(model.size)), ARM))
    assert_allclose(whole, bare, atol=1e-9)


def test_common_and_own_factors_multiply():
    model = library_model(TUBES, np.ones((2, 4)), (1.0,), static=True)
    x = np.zeros(model.size)
    x[model.mask(["tubes.curvature"])] = 1.0
    x[np.flatnonzero(model.mask(["tubes.curvature, each"]))[1]] = 2.0
    changed = model.reduced(x, ["tubes.curvature", "tubes.curvature, each"])
    found = [float(tube.curvature) for tube in changed.tubes]
    assert_allclose(found, [10.0 * np.exp(0.1), 6.0 * np.exp(0.1 + 2.0 * 0.05)], rtol=1e-12)


def test_effects_that_leave_a_range_together_end_at_its_limit():
    model = library_model(TUBES, np.ones((2, 4)), (1.0,), static=True)
    x = np.zeros(model.size)
    names = ["tubes.youngs_modulus", "tubes.youngs_modulus, each"]
    x[model.mask(names)] = 1e3
    assert float(model.reduced(x, names).tubes[0].youngs_modulus) == 2e12


def test_one_recording_of_equilibria_is_divided_into_parts_of_blocks():
    seen = dataclasses.replace(recorded(ARM, random_controls(ARM, 0.0, 2e4, 60)), time=np.arange(60.0))
    parts = in_parts([seen])
    assert len(parts) == PARTS and sum(len(it.time) for it in parts) == 60
    rows = np.concatenate([it.position[:, 0] for it in parts])
    assert_allclose(np.sort(rows, axis=0), np.sort(seen.position[:, 0], axis=0))
    assert in_parts([seen, seen]) == [seen, seen]


# recovery, robot by robot

CASES = {
    "chambers": (
        ARM,
        ARM.replace(
            **{
                "youngs_modulus": 3.2e5,
                "camera": Camera(rotation=(0.02, -0.03, 0.0), marker=(0.0, 0.0, 0.004)),
            }
        ),
        (0.0, 2.5e4),
        ["youngs_modulus", "camera.rotation", "camera.marker"],
    ),
    "tubes": (
        TUBES,
        TUBES.replace(**{"tubes.0.curvature": 11.0, "tubes.1.curvature": 5.5, "tubes.1.rotation_zero": 0.1}),
        ([-1.5, -0.01, -1.5, -0.01], [1.5, 0.02, 1.5, 0.02]),
        ["tubes.curvature", "tubes.curvature, each", "tubes.rotation_zero, each"],
    ),
    "magnet": (
        MAGNET,
        MAGNET.replace(**{"loads.0.moment": (0.0, 0.0, 0.012)}),
        (-0.01, 0.01),
        ["loads.0.moment"],
    ),
    "fed rod": (
        FED,
        FED.replace(youngs_modulus=1.3e8),
        (-0.01, 0.08),
        ["youngs_modulus"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_robot_is_found_by_effects_of_its_parts(case):
    """With named effects, unseen rows are predicted to little more than the noise, 0.1 mm a coordinate."""
    nominal, true, (low, high), names = CASES[case]
    seen = recorded(true, random_controls(true, low, high))
    unseen = recorded(true, random_controls(true, low, high, 15, seed=5), seed=6)
    found = identify(nominal, [seen], names)
    before, after = (evaluate(it, unseen).tip_rmse for it in (nominal, found.robot))
    assert after < 2.3e-4 < 2.0 * before
    assert {*names} <= {*found.effects}
    assert len(found.held_out_error) == PARTS


@pytest.mark.slow
def test_a_platform_and_an_assembly_are_found_from_equilibria():
    legs = kc.load_robot("six-legged-robot")
    true = legs.replace(
        youngs_modulus=1.1 * float(legs.youngs_modulus), camera=Camera(position=(0.002, 0, 0))
    )
    controls = random_controls(legs, -0.01, 0.01, 30)
    found = identify(legs, [recorded(true, controls)], ["camera.position", "platform_radius"])
    assert found["camera.position[0]"].value == pytest.approx(0.002, abs=2e-4)


class Plate(Effect):
    """A part of yours, whose thickness is known to 10 %, and whose angle to 0.05 rad."""

    thickness: Any = parameter("m", "its thickness", low=1e-6, high=1.0, doubt=Doubt(0.1))
    angle: Any = parameter("rad", "its angle", low=-4.0, high=4.0, default=0.0, doubt=Doubt(absolute=0.05))


def test_a_users_part_brings_its_effects():
    """Two of a kind have a common factor, and one each; a list of one part needs neither."""
    one, two = ((Plate(thickness=0.001),) * count for count in (1, 2))
    names = [library_model(ARM.replace(effects=it), np.ones((2, 0))).names for it in (one, two)]
    assert {"effects.0.thickness", "effects.0.angle"} <= {*names[0]}
    assert {f"effects.{it}" for it in ("thickness", "thickness, each", "angle", "angle, each")} <= {*names[1]}


class Spring(kc.System):
    """A user's robot: a straight bar that a control pulls, with a law of one number."""

    y_layout = Layout(("p", 1, "m", "position"), ("n", 1, "N", "force"))
    z_layout = Layout(("e", 1, "1", "stretch"))
    control_layout = Layout(("pull", 1, "N", "force at the tip"))
    base_unknowns = ("n",)
    mixed = False

    length: Any = parameter("m", "length", low=1e-3, high=10.0)
    stiffness: Any = parameter("N", "stiffness", low=1e-6, high=1e6, doubt=Doubt(0.3))

    def constitutive(self, s, t, y, y_t, control):
        return 1.0 + self.y_layout.get(y, "n") / self.stiffness

    def balance(self, s, t, y, y_t, z, z_t, control):
        return jnp.concatenate([z, jnp.zeros(1)])

    def rest(self, s):
        return jnp.stack([s, 0.0 * s]), jnp.ones(1)

    def tip(self, t, control, y, y_t):
        return self.y_layout.get(y, "n") - control


def test_a_users_own_system_brings_its_effects():
    """The stiffness of a bar follows from its lengths under known forces, u = F L / K."""
    true, nominal = Spring(length=1.0, stiffness=50.0), Spring(length=1.0, stiffness=40.0)
    controls = np.linspace(0.0, 10.0, 12)[:, None]
    position = (1.0 + controls / 50.0)[:, None]
    seen = Measurements(
        time=np.arange(12.0),
        control=controls,
        fractions=np.ones(1),
        position=position,
        quaternion=np.full((12, 1, 4), np.nan),
        measured=np.ones((12, 1), dtype=bool),
        simulated=True,
        source="bar",
        static=True,
    )
    assert library_model(true, controls).names == ("stiffness",)
    found = identify(nominal, [seen], ["stiffness"])
    assert found["stiffness"].value == pytest.approx(50.0, rel=1e-3)


# the camera


def test_a_camera_turns_what_is_measured_and_not_gravity():
    """Measured is C (p + R marker) + c; the equilibrium is that without a camera."""
    camera = Camera(rotation=(0.0, 0.0, np.pi / 2.0), position=(0.01, 0.0, 0.0), marker=(0.0, 0.002, 0.005))
    controls = np.array([[2e4, 0.0, 5e3], [0.0, 0.0, 0.0]])
    seen = recorded(ARM.replace(camera=camera), controls, noise=0.0)
    moved = predict(ARM, seen)
    p, h = np.asarray(moved.position)[:, -1], np.asarray(moved.quaternion)[:, -1]
    assert_allclose(predict(ARM.replace(camera=camera), seen).y, moved.y, atol=1e-12)
    from scipy.spatial.transform import Rotation

    carried = p + Rotation.from_quat(h, scalar_first=True).apply(camera.marker)
    expected = np.stack([-carried[:, 1], carried[:, 0], carried[:, 2]], axis=1) + camera.position
    assert_allclose(seen.position[:, 0], expected, atol=1e-9)


def test_a_camera_is_part_of_a_robots_file(tmp_path):
    robot = ARM.replace(camera=Camera(rotation=(0.02, 0.0, 0.0)))
    kc.save_robot(robot, tmp_path / "arm.yaml")
    assert_allclose(kc.load_robot(tmp_path / "arm.yaml").camera.rotation, (0.02, 0.0, 0.0))


# bad input


def test_bad_input_is_refused_in_one_line():
    seen = recorded(ARM, random_controls(ARM, 0.0, 2e4, 8))
    with pytest.raises(ParameterError, match=r"there is no effect 'camera.rotatoin'.*camera.rotation"):
        identify(ARM, [seen], ["camera.rotatoin"])
    with pytest.raises(ParameterError, match=r"area_factors has 2 numbers; allowed is one for each of 3"):
        Chambers(angles=THREE, offset=0.006, radius=0.003, area_factors=(1.0, 1.0))
    with pytest.raises(
        ValueError, match=r"the robot has the controls pressure \(3\); the recording has 2 controls"
    ):
        identify(ARM, [dataclasses.replace(seen, control=seen.control[:, :2])], ["youngs_modulus"])

    class Bare(Spring):
        stiffness: Any = parameter("N", "stiffness", low=1e-6, high=1e6)

    bar = dataclasses.replace(seen, control=seen.control[:, :1])
    with pytest.raises(IdentificationError, match=r"a Bare states no doubt of a parameter"):
        identify(Bare(length=1.0, stiffness=40.0), [bar])
