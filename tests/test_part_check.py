"""kc.robots.check: every part of the library passes, and each check finds a part that is wrong."""

from typing import Any

import jax
import jax.numpy as jnp
import pytest
from jax.tree_util import Partial

import knode_cosserat as kc
from knode_cosserat.robots import Effect, Wrench, check, law, loads, parameter
from knode_cosserat.rods.parameters import kinds_of
from knode_cosserat.rods.parts import Part
from knode_cosserat.rotation import dot

FIELD = kc.robots.magnets.DipoleField(moment=(0.0, 0.0, 10.0), position=(0.05, 0.0, 0.4))
#: parameters of parts that need some, or that do nothing without; within the default rod of 0.3 m
GIVEN: dict[str, dict[str, Any]] = {
    "attached-mass": {"mass": 0.01, "offset": (0.01, 0.0, 0.0)},
    "chambers": {"angles": (0.0, 2.0, 4.0), "offset": 0.005, "radius": 0.002},
    "cylinder": {"radius": 0.01, "point": (0.0, 0.0, 0.1), "axis": (1.0, 0.0, 0.0)},
    "dipole": {"moment": (0.0, 0.0, 10.0), "position": (0.05, 0.0, 0.4)},
    "distributed-wrench": {"force": (0.0, 0.1, -0.1)},
    "early-anchors": {"at": 0.8, "share": (0.5, 0.5, 0.5, 0.5)},
    "elliptic": {"semi_axis_x": 0.003, "semi_axis_y": 0.002},
    "fluid": {"density": 1000.0},
    "helical": {"radius": 0.01, "phase": 0.3, "turns": 0.5},
    "hollow": {"radius": 0.003, "inner_radius": 0.002},
    "magnet": {"magnetisation": (0.0, 0.0, 1.0), "field": FIELD},
    "markers": {"at": (0.5, 1.0), "stated": (0.5, 1.0)},
    "plane": {"point": (0.0, 0.0, 0.129), "normal": (0.0, 0.0, 1.0)},
    "point-magnet": {"moment": (0.0, 0.0, 0.1), "field": FIELD},
    "point-wrench": {"force": (0.0, 0.1, -0.1)},
    "polynomial": {"x": (0.01, -0.004), "y": (0.0, 0.003)},
    "rectangular": {"width": 0.003, "height": 0.002},
    "reels": {"motors": (1.0, 2.0, 3.0, 4.0), "radius": (0.01,) * 4},
    "relaxation": {"stiffness": 0.3, "time": 0.05},
    "sphere": {"center": (0.0, 0.0, 0.1), "radius": 0.03},
    "spinning-frame": {"rate": 2.0},
    "straight": {"x": 0.01, "y": 0.002},
    "stretch": {"curvature": (0.0, 2.0, 0.0)},
    "tabulated": {
        "at": (0.0, 1.0),
        "bending_stiffness": (3e-3, 2e-3),
        "torsional_stiffness": (2e-3, 1e-3),
        "axial_stiffness": (1e3, 1e3),
        "mass_per_length": (0.03, 0.02),
    },
    "tapered": {"base_offset": 0.012, "end_offset": 0.008, "angle": 0.2},
    "trained-range": {
        "strain_low": (-1.0,) * 6,
        "strain_high": (2.0,) * 6,
        "rate_low": (-1.0,) * 6,
        "rate_high": (1.0,) * 6,
        "control_low": (0.0,) * 4,
        "control_high": (9.0,) * 4,
    },
    "tube": {"radius": 1e-3, "youngs_modulus": 6e10, "density": 6450.0, "curvature": 5.0},
    "vibration": {"tension": 10.0, "rate": 1.0},
}
#: parts of robots that are not made of one part
ELSEWHERE = {"body", "neighbours"}
KINDS = {kind: cls for kind, cls in kinds_of(Part).items() if cls.__module__.startswith("knode_cosserat.")}


@pytest.mark.campaign
@pytest.mark.parametrize("kind", sorted(set(KINDS) - ELSEWHERE))
def test_every_part_of_the_library_passes(kind):
    found = check(KINDS[kind](**GIVEN.get(kind, {})))
    assert found.passed, repr(found)


class Wind(loads.SpreadLoad):
    """A steady force per length."""

    force: Any = parameter("N/m", "force", shape="vector", low=-9.0, high=9.0, default=(0.1, 0.0, 0.0))

    def wrench(self, motion, control):
        return Wrench(jnp.asarray(self.force), jnp.zeros(3))


class Damper(Effect):
    """Drag by velocity."""

    drag: Any = parameter("N s/m2", "force by velocity, per length", low=-9.0, high=9.0)

    def load(self, point):
        return Wrench(-self.drag * dot(point.motion.R, point.motion.q), jnp.zeros(3))


class Bristles(Effect):
    """Bristles that hold the rod, and slide."""

    def z_fields(self, rod):
        return (("bristle", 3, "m", "deflection of the bristles, global frame"),)

    def evolutions(self, point):
        velocity = dot(point.motion.R, point.motion.q)
        return {"bristle": law.Evolution(velocity, jnp.zeros(3), -2e-3, 2e-3)}

    def load(self, point):
        return Wrench(-2.0 * point.get("bristle"), jnp.zeros(3))


def moment_of(k, u, u_t):
    return k[0] * jnp.sum(u * u) * u + k[1]


class Stiffening(Effect):
    """A cubic moment of the curvature, and one that does not vanish at rest."""

    offset: Any = parameter("N m", "moment at rest", low=-9.0, high=9.0, default=0.0)

    def law(self, point, law, internal):
        u = law.strains["u"]
        return law.with_strain("u", u._replace(moment=Partial(moment_of, (1e-5, self.offset))))


@pytest.mark.slow
def test_the_report_is_a_table_and_values():
    found = check(Wind())
    assert found.passed
    assert [line.name for line in found.lines] == ["units", "derivative", "energy", "rest", "batch", "engine"]
    lines = repr(found).splitlines()
    assert lines[0] == "Wind in a SlenderRod" and len(lines) == 8
    # the force per length that it states
    assert "0.1 N/m" in found["rest"].detail
    assert found.to_dict()["rest"]["value"] == pytest.approx(0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "kind"),
    [
        (Wind(), "conservative"),
        (Damper(drag=0.5), "passive"),
        (Bristles(), "passive"),
        (Stiffening(), "conservative"),
    ],
)
def test_the_energy_of_known_parts(part, kind):
    """A dead force and an elastic law have a potential; drag and sliding bristles dissipate."""
    found = check(part)
    assert found.passed, repr(found)
    assert found["energy"].detail.startswith(kind)


class WrongUnit(Wind):
    width: Any = parameter("parsec", "its width", low=0.0, high=1.0, default=0.5)


class OneNumber(Wind):
    def wrench(self, motion, control):
        return Wrench(jnp.ones(1), jnp.zeros(3))


class NoDerivative(Wind):
    def wrench(self, motion, control):
        return Wrench(jax.lax.stop_gradient(motion.p), jnp.zeros(3))


class Asks(Wind):
    def wrench(self, motion, control):
        return Wrench(motion.p if motion.p[2] > 0.0 else -motion.p, jnp.zeros(3))


class Decomposes(Wind):
    def wrench(self, motion, control):
        return Wrench(jnp.linalg.eigvalsh(motion.R), jnp.zeros(3))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "name", "words"),
    [
        (WrongUnit(), "units", "width: the unit 'parsec' is not known"),
        (OneNumber(), "units", r"the force has shape (1,); allowed is (3,)"),
        (NoDerivative(), "derivative", "by the state"),
        (Damper(drag=-0.5), "energy", "active"),
        (loads.PointWrench(force=(0.1, 0.0, 0.0), follows=True), "energy", "active"),
        (Stiffening(offset=1e-3), "rest", "unloaded shape has stress"),
        (Asks(), "batch", "TracerBoolConversionError"),
        (Decomposes(), "engine", "EngineError"),
    ],
)
def test_each_check_finds_a_wrong_part(part, name, words):
    found = check(part)
    assert not found.passed
    assert found[name].verdict == "failed" and words in found[name].detail, repr(found)


def test_a_part_that_no_robot_takes_is_refused_in_one_line():
    with pytest.raises(kc.robots.PartCheckError, match="part is a function; allowed is a part"):
        check(moment_of)
    with pytest.raises(kc.robots.PartCheckError, match="a ParallelRobot has no slot for a Wind"):
        check(Wind(), kc.load_robot("six-legged-robot"))
