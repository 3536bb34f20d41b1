"""Magnets in fields: elastica, buckling, energy and reciprocity of dipoles, a catheter that follows."""

import jax
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.rods.loads import Motion
from knode_cosserat.rods.magnets import DipoleField, Magnet, PointMagnet, UniformField
from knode_cosserat.rods.robot_file import format_robot, parse_robot

L, RADIUS, E = 0.04, 5e-4, 3e6
EI = E * np.pi * RADIUS**4 / 4
#: magnetisation of which 1 T bends by EI/L²
UNIT = EI / L**2


PLAIN = kc.robots.SlenderRod(
    length=L,
    radius=RADIUS,
    density=1700.0,
    youngs_modulus=E,
    bending_damping=1e-9,
    nodes=11,
    gravity=[0.0, 0.0, 0.0],
)
#: magnetised along its axis in a uniform field, in that of a dipole, and at its tip: one compiled program
MAGNETIC = PLAIN.replace(
    loads=(Magnet(), Magnet(field=DipoleField([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])), PointMagnet())
)


def uniform(B, nodes=11, magnetisation=UNIT):
    changes = {"loads.0.magnetisation": [0.0, 0.0, magnetisation], "loads.0.field.flux_density": B}
    return MAGNETIC.replace(nodes=nodes, **changes)


def rest(robot, space="lobatto4"):
    return kc.equilibrium(robot, np.zeros(0), space=space, with_stability=False)


# uniform fields


def elastica(B):
    """Tip angle and tip of a rod along z in a field along x, from EI θ'²/2 = M B (sin θ_L - sin θ)."""

    def along(function, end):
        def integrand(x):  # θ = θ_L - x² has no singularity
            rise = 2.0 * np.cos(end - x * x / 2) * np.sin(x * x / 2)
            return function(end - x * x) * 2.0 * x / np.sqrt(2.0 * B / L**2 * rise)

        return quad(integrand, 0.0, np.sqrt(end), epsabs=1e-15, epsrel=1e-13)[0]

    end = brentq(lambda end: along(lambda x: 1.0, end) - L, 1e-3, np.pi / 2 - 1e-6, xtol=1e-15)
    return end, np.array([along(np.sin, end), 0.0, along(np.cos, end)])


@pytest.mark.parametrize(("space", "order"), [("lobatto2", 2.0), ("lobatto4", 4.0)])
def test_a_large_deflection_is_an_elastica(space, order):
    end, tip = elastica(4.0)
    assert end > 1.1
    found = [rest(uniform([4.0, 0.0, 0.0], nodes=nodes), space=space) for nodes in (11, 21, 41)]
    errors = np.array([np.linalg.norm(one.tip_position[0] - tip) / L for one in found])
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), order, atol=0.02)
    assert errors[-1] < (1e-7 if space == "lobatto4" else 2e-4)
    # a uniform field exerts no force
    assert np.abs(found[-1].part("n")).max() < 1e-9 * EI / L**2


@pytest.mark.parametrize("along", [2.0, -1.5])
def test_a_small_deflection_with_a_field_along_the_rod(along):
    """EI θ'' = M B∥ θ - M B⊥ with θ(0) = 0 = θ'(L)."""
    across, s = 1e-4, np.linspace(0.0, L, 21)
    k = np.sqrt(complex(along)) / L
    theta = (across / along * (1.0 - np.cosh(k * (L - s)) / np.cosh(k * L))).real
    found = rest(uniform([across, 0.0, along], nodes=21))
    turned = Rotation.from_quat(np.asarray(found.quaternion)[0], scalar_first=True).as_rotvec()[:, 1]
    np.testing.assert_allclose(turned, theta, atol=1e-6 * np.abs(theta).max())


@pytest.mark.slow
def test_a_field_against_the_magnetisation_buckles_the_rod():
    critical, near = np.pi**2 / 4, np.array([0.999, 1.001])
    below, above = (kc.statics.stability(rest(uniform([0.0, 0.0, -c * critical], nodes=6))) for c in near)
    assert below.stable and not above.stable and above.asymmetry < 1e-6
    # the least eigenvalue is zero there
    found = near[0] + (near[1] - near[0]) * below.least / (below.least - above.least)
    assert found == pytest.approx(1.0, abs=3e-6)


def test_a_magnet_at_the_tip_is_a_moment_that_turns_with_it():
    """EI θ' = m B cos θ_L along the rod, whose line is a circle."""
    robot = MAGNETIC.replace(
        **{
            "loads.2.moment": [0.0, 0.0, UNIT * L],
            "loads.2.field.flux_density": [1.3, 0.0, 0.0],
        }
    )
    found = rest(robot)
    angle = brentq(lambda angle: angle - 1.3 * np.cos(angle), 0.0, 1.5, xtol=1e-15)
    np.testing.assert_allclose(np.asarray(found.part("u"))[0, :, 1], angle / L, rtol=1e-8)
    circle = L / angle * np.array([1.0 - np.cos(angle), 0.0, np.sin(angle)])
    np.testing.assert_allclose(found.tip_position[0], circle, atol=1e-6 * L)


# dipoles

MOMENT, PLACE = np.array([0.3, -1.0, 2.0]), np.array([0.05, 0.02, -0.03])


def pose(seed):
    rng = np.random.default_rng(seed)
    return Motion(rng.normal(size=3) * 0.1, Rotation.random(rng=rng).as_matrix(), *np.zeros((4, 3)))


def flux(p, position, moment):
    """Jackson (1999), equation 5.56."""
    r = p - position
    n = r / np.linalg.norm(r)
    return 1e-7 * (3.0 * n * (n @ moment) - moment) / np.linalg.norm(r) ** 3


@pytest.mark.parametrize("seed", range(4))
def test_the_wrench_of_a_dipole_is_the_slope_of_its_energy(seed):
    motion, own = pose(seed), np.array([0.2, 0.5, -0.4])
    force, couple = PointMagnet(moment=own, field=DipoleField(PLACE, MOMENT)).wrench(motion, None)

    def energy(x, turn=(0.0, 0.0, 0.0)):
        m = Rotation.from_rotvec(turn).apply(motion.R @ own)
        return -m @ flux(motion.p + x, PLACE, MOMENT)

    h, none = 1e-5 * np.linalg.norm(motion.p - PLACE), np.zeros(3)
    slope = [(energy(h * e) - energy(-h * e)) / (2 * h) for e in np.eye(3)]
    turned = [(energy(none, h * e) - energy(none, -h * e)) / (2 * h) for e in np.eye(3)]
    for own, expected in ((force, slope), (couple, turned)):
        np.testing.assert_allclose(own, -np.array(expected), atol=1e-7 * np.linalg.norm(expected))


def test_a_dipole_and_a_magnet_exchange_momentum():
    """Forces are opposite, and couples with the moments of the forces cancel."""
    own, motion = np.array([0.2, 0.5, -0.4]), pose(7)
    there = motion._replace(p=PLACE, R=np.eye(3))
    force, couple = PointMagnet(moment=own, field=DipoleField(PLACE, MOMENT)).wrench(motion, None)
    back, turned = PointMagnet(moment=MOMENT, field=DipoleField(motion.p, motion.R @ own)).wrench(there, None)
    np.testing.assert_allclose(force, -np.asarray(back), rtol=1e-9)
    total = couple + turned + np.cross(motion.p - PLACE, force)
    np.testing.assert_allclose(total, 0.0, atol=1e-9 * np.abs(couple).max())


def test_a_field_is_finite_at_the_dipole_itself():
    field = DipoleField([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    at = pose(0)._replace(p=np.zeros(3))
    assert all(np.all(np.isfinite(each)) for each in field.wrench(at, [1e-3, 0.0, 0.0], None))


def test_a_far_dipole_bends_as_the_uniform_field_at_the_rod():
    far, moment = np.array([100.0, 0.0, 0.0]), np.array([5e5, 0.0, 0.0])
    B, strong = flux(np.array([0.0, 0.0, L / 2]), far, moment), 1e7 * UNIT
    one = rest(uniform(B, magnetisation=strong)).tip_position[0]
    dipole = {"magnetisation": [0.0, 0.0, strong], "field.position": far, "field.moment": moment}
    other = rest(MAGNETIC.replace(**{f"loads.1.{name}": value for name, value in dipole.items()}))
    assert one[0] > 0.2 * L
    np.testing.assert_allclose(one, other.tip_position[0], atol=1e-3 * L)


def test_controls_move_and_turn_a_dipole():
    controlled = DipoleField(PLACE, MOMENT, controlled=("moment", "position"))
    names = [field.name for field in controlled.control_fields]
    assert names == ["x", "y", "z", "mx", "my", "mz"]
    p, change = np.array([0.0, 0.1, 0.02]), np.array([0.01, 0.02, 0.03, 1.0, 2.0, -1.0])
    moved = flux(p, PLACE + change[:3], MOMENT + change[3:])
    np.testing.assert_allclose(controlled.flux(p, change), moved, rtol=1e-9)
    turning = DipoleField(PLACE, MOMENT, controlled=("moment",))
    np.testing.assert_allclose(turning.flux(p, change[3:]), flux(p, PLACE, MOMENT + change[3:]), rtol=1e-9)


# the catheter of the catalog


@pytest.fixture(scope="module")
def catheter():
    return kc.load_robot("magnetic-catheter")


def rotating(steps, dt, period, size=4e-3):
    """A field that turns about the axis, from one along x, in T."""
    angle = 2 * np.pi * dt * np.arange(1, steps + 1) / period
    return size * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)


def test_the_catheter_follows_a_rotating_field(catheter):
    assert catheter.control_layout.names == ("load0_Bx", "load0_By", "load0_Bz")
    assert [field.unit for field in catheter.control_layout.fields] == ["T"] * 3
    dt, start = 0.02, np.array([4e-3, 0.0, 0.0])
    begun = kc.equilibrium(catheter, start)
    radius = begun.tip_position[0, 0]
    assert 0.1 < radius / float(catheter.length) < 0.9
    field = rotating(100, dt, period=2.0)
    found = kc.simulate(catheter, field, dt, initial=begun, between="linear")
    assert found.all_valid
    tip = np.asarray(found.tip_position)[1:]
    still = np.asarray(kc.solvers.equilibria(catheter, field[::25]).tip_position)
    np.testing.assert_allclose(np.hypot(*still[:, :2].T), radius, rtol=1e-6)
    # it turns once, on the circle of its equilibria, behind the field by a few degrees
    lag = np.angle(np.exp(1j * (np.arctan2(field[:, 1], field[:, 0]) - np.arctan2(tip[:, 1], tip[:, 0]))))
    assert np.all(np.abs(lag) < np.radians(5)) and np.all(lag[50:] > 0.0)
    np.testing.assert_allclose(np.hypot(*tip[50:, :2].T), radius, rtol=0.03)


def test_it_is_differentiable_and_runs_in_batches(catheter):
    field = rotating(10, 0.02, period=1.0)

    def tip(size):
        changed = catheter.replace(**{"loads.0.magnetisation": np.array([0.0, 0.0, 1.0]) * size})
        return kc.simulate(changed, field, 0.02).tip_position[-1, 0]

    size = float(catheter.loads[0].magnetisation[2])
    h = 1e-4 * size
    slope = float(tip(size + h) - tip(size - h)) / (2 * h)
    assert float(jax.grad(tip)(size)) == pytest.approx(slope, rel=1e-5)
    robots = [catheter.replace(**{"loads.0.field.flux_density": [0.0, 0.0, b]}) for b in (0.0, 5e-3)]
    together = kc.simulate(robots, np.stack([field, field]), 0.02)
    for k, one in enumerate(robots):
        np.testing.assert_allclose(together[k].y, kc.simulate(one, field, 0.02).y, atol=1e-11)


@pytest.mark.slow
def test_its_numbers_are_identified(catheter):
    field = rotating(40, 0.02, period=1.0)
    truth = kc.simulate(catheter, field, 0.02)
    guess = catheter.replace(**{"loads.0.magnetisation": [1e-3, 0.0, 0.04], "youngs_modulus": 2.9e6})
    found = kc.identify(guess, [truth], parameters=["loads.0.magnetisation", "youngs_modulus"])
    np.testing.assert_allclose(found.robot.loads[0].magnetisation, [0.0, 0.0, 0.047], atol=1e-6)
    assert float(found.robot.youngs_modulus) == pytest.approx(3e6, rel=1e-4)


# files


def test_robot_files_hold_magnets():
    loads = (
        Magnet(magnetisation=[0.0, 0.0, 0.02], begin=0.5, field=UniformField([0.0, 0.0, 1e-2], True)),
        PointMagnet(moment=[0.0, 0.0, 1e-3], field=DipoleField(PLACE, MOMENT, controlled=("moment",))),
    )
    text = format_robot(PLAIN.replace(loads=loads))
    assert "field: {kind: dipole, position: [0.05, 0.02, -0.03]" in text
    found = parse_robot(text, "here").loads
    assert repr(found) == repr(loads) and found[1].field.controlled == ("moment",)
