"""New physics in one file: a load and an effect with an internal variable, known nowhere else."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.robots import (
    Effect,
    RoutedTendonRobot,
    SlenderRod,
    Wrench,
    law,
    loads,
    parameter,
    tendons,
)
from knode_cosserat.rotation import cross, dot


class AddedMass(loads.SpreadLoad):
    """Inertia of the surrounding water across the rod."""

    mass: Any = parameter("kg/m", "added mass per length", low=0.0, high=1e3, default=0.0)

    def wrench(self, motion, control):
        acceleration = motion.q_t + cross(motion.w, motion.q)
        return Wrench(-self.mass * dot(motion.R, acceleration * np.array([1.0, 1.0, 0.0])), jnp.zeros(3))


class Spring(loads.PointLoad):
    """A spring from a place of the rod to a fixed point."""

    stiffness: Any = parameter("N/m", "k, of the spring", low=0.0, high=1e6)
    anchor: Any = parameter("m", "its fixed end, global frame", shape="vector", low=-10.0, high=10.0)

    def wrench(self, motion, control):
        return Wrench(self.stiffness * (self.anchor - motion.p), jnp.zeros(3))


class FrictionLayer(Effect):
    """Bristles that hold the rod: x_t = velocity while |x| < reach, and the force -k x per length."""

    kind: ClassVar[str] = "friction-layer"

    stiffness: Any = parameter("N/m2", "k, of the bristles, per length", low=0.0, high=1e6)
    reach: Any = parameter("m", "deflection at which they slide", low=1e-6, high=1.0, default=0.01)

    def z_fields(self, rod):
        return (("bristle", 3, "m", "deflection of the bristles, global frame"),)

    def evolutions(self, point):
        velocity = dot(point.motion.R, point.motion.q)
        return {"bristle": law.Evolution(velocity, jnp.zeros(3), -self.reach, self.reach)}

    def load(self, point):
        return Wrench(-self.stiffness * point.get("bristle"), jnp.zeros(3))


ROD = {
    "length": 0.3,
    "radius": 0.002,
    "density": 2e3,
    "youngs_modulus": 1e9,
    "bending_damping": 1e-4,
}
DT, STEPS = 0.02, 20


def layered(stiffness=2.0, reach=0.01):
    return SlenderRod(**ROD, gravity=(3.0, 0.0, 0.0), effects=(FrictionLayer(stiffness, reach),))


def motion(robot):
    batch = (len(robot),) if isinstance(robot, list) else ()
    return kc.simulate(robot, np.zeros((*batch, STEPS, 0)), DT, initial="unstressed")


def test_a_spring_bends_a_beam_as_in_the_books():
    """Its force is k X / (1 + k c), with the compliance c of the beam there; at the tip the slope adds."""
    L, r, E, k, X = 0.4, 0.004, 200e9, 200.0, 0.05
    beam = SlenderRod(
        L,
        radius=r,
        density=1.0,
        youngs_modulus=E,
        gravity=(0.0, 0.0, 0.0),
        nodes=41,
        loads=(Spring(at=0.5, stiffness=k, anchor=(X, 0.0, 0.5 * L)),),
    )
    found = kc.equilibrium(beam, space="lobatto4")
    EI, GA, a = E * np.pi * r**4 / 4, E / 2.6 * np.pi * r**2, 0.5 * L
    c = a**3 / (3 * EI) + a / GA
    force = k * X / (1 + k * c)
    # the deflection is small: its square is 2e-5
    assert found.tip_position[0, 0] == pytest.approx(force * (c + a**2 / (2 * EI) * (L - a)), rel=1e-4)


def test_bristles_follow_the_rod_until_they_slide():
    plain, found = motion(SlenderRod(**ROD, gravity=(3.0, 0.0, 0.0))), motion(layered())
    bristle = np.asarray(found.part("bristle"))
    assert found.all_valid and found.system.z_layout.names == ("v", "u", "bristle")
    assert 0.0 < found.tip_position[-1, 0] < 0.9 * plain.tip_position[-1, 0]
    moved = np.asarray(found.position - found.position[0])
    assert np.max(moved) < 0.01
    np.testing.assert_allclose(bristle[:, 1:], moved[:, 1:], atol=1e-5)
    sliding = np.asarray(motion(layered(reach=1e-4)).part("bristle"))
    assert np.max(np.abs(sliding)) == pytest.approx(1e-4)


def test_it_runs_in_batches_and_is_differentiable():
    def tip(stiffness):
        return motion(layered().replace(**{"effects.0.stiffness": stiffness})).tip_position[-1, 0]

    both = motion([layered(1.0), layered(2.0)])
    np.testing.assert_allclose(both[1].tip_position, motion(layered(2.0)).tip_position, rtol=0.0, atol=1e-12)
    slope, h = jax.grad(tip)(2.0), 1e-4
    assert float(slope) == pytest.approx(float(tip(2.0 + h) - tip(2.0 - h)) / (2 * h), rel=1e-4)


def test_a_robot_file_holds_it(tmp_path):
    kc.save_robot(layered(), tmp_path / "layered.yaml")
    assert "kind: friction-layer" in (tmp_path / "layered.yaml").read_text()
    loaded = kc.load_robot(tmp_path / "layered.yaml")
    assert loaded.effects[0].reach == 0.01
    assert "friction-layer" in str(kc.robots.robot_schema())


def test_added_mass_slows_the_rod_down():
    free = SlenderRod(**ROD, gravity=(3.0, 0.0, 0.0))
    slow = motion(free.replace(loads=(AddedMass(mass=0.1),)))
    heavier = 1.0 + 0.1 / float(free.mass_per_length)
    # a rod that is heavier by the added mass under the same weight moves alike, but for its rotary inertia
    other = free.replace(density=free.density * heavier, gravity=np.array([3.0, 0.0, 0.0]) / heavier)
    np.testing.assert_allclose(slow.tip_position, motion(other).tip_position, atol=2e-5)


def test_effects_join_those_of_a_tendon_robot():
    robot = RoutedTendonRobot(
        **ROD, tendon_offset=0.01, friction=tendons.TendonFriction(wobble=0.5), effects=(FrictionLayer(2.0),)
    )
    assert robot.z_layout.names == ("v", "u", "f", "bristle") and robot.y_layout.names[-1] == "loss"
    found = kc.simulate(robot, np.tile([1.0, 0.0, 0.0, 0.0], (10, 1)), DT)
    assert found.all_valid and np.max(np.abs(np.asarray(found.part("bristle")))) > 1e-5


def test_a_rate_of_an_unknown_field_is_refused():
    class Wrong(FrictionLayer):
        kind: ClassVar[str] = ""

        def rates(self, point):
            return {"bristel": jnp.zeros(3)}

    with pytest.raises(KeyError, match="no field 'bristel'"):
        motion(layered().replace(effects=(Wrong(1.0),)))


def test_two_effects_with_the_same_field_are_refused():
    twice = layered().replace(effects=(FrictionLayer(1.0), FrictionLayer(2.0)))
    with pytest.raises(kc.robots.ParameterError, match="two parts have a field 'bristle'"):
        motion(twice)


def test_a_relaxing_material_of_any_rod_is_that_of_a_routed_robot():
    relaxation, tensions = kc.robots.Relaxation(0.5, 0.1), np.zeros((5, 4))
    robots = (
        RoutedTendonRobot(**ROD, gravity=(3.0, 0.0, 0.0), **{name: value})
        for name, value in (("relaxation", relaxation), ("effects", (relaxation,)))
    )
    one, other = (kc.simulate(robot, tensions, DT) for robot in robots)
    np.testing.assert_array_equal(one.z, other.z)
