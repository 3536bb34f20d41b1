"""Stability of every equilibrium: closed forms for rods whose parts have no energy here, and reasons."""

import warnings

import jax
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

import knode_cosserat as kc
from knode_cosserat.robots import tendons
from knode_cosserat.schemes.result import Verdict

r = kc.robots
L, A, E, RHO = 1.0, 0.004, 1e8, 1000.0
EI, AREA = E * np.pi * A**4 / 4, np.pi * A**2
#: Greenhill's load: weight per length times L³ over EI, of a column that stands
GREENHILL = 7.83735
#: positions of a guess
UPRIGHT = np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, L], 9)
ROD = {"length": L, "radius": A, "density": RHO, "youngs_modulus": E, "bending_damping": 1e-4, "nodes": 15}


def column(load, **parts):
    """A column that stands under a part of Greenhill's load, its buoyancy and insertion included."""
    weight = load * GREENHILL * EI / (L**3 * RHO * AREA)
    return r.SlenderRod(**ROD | {"gravity": (0.0, 0.0, -weight)} | parts)


def magnetic(load):
    """A magnet along the rod in an opposed field: it buckles at B M = π²/4 EI/L²."""
    field = r.magnets.UniformField(flux_density=(0, 0, -load * np.pi**2 / 4 * EI / L**2 / 0.05))
    magnet = r.magnets.Magnet(field=field, magnetisation=(0, 0, 0.05))
    return r.SlenderRod(**ROD, gravity=(0, 0, 0), loads=(magnet,))


def follower(load):
    """Beck's column: without damping it flutters at 20.05 EI/L², and never diverges."""
    force = r.loads.PointWrench(force=(0.0, 0.0, -load * 20.05 * EI / L**2), follows=True)
    return r.SlenderRod(**ROD | {"bending_damping": 0.0}, gravity=(0, 0, 0), loads=(force,))


KINDS = {
    # buoyancy takes half of the weight
    "fluid": lambda load: column(2.0 * load, loads=(r.fluids.Fluid(density=RHO / 2.0),)),
    "hyperelastic": lambda load: column(load, effects=(r.chambers.Hyperelastic(),)),
    # the branch relaxes: the stiffness at rest decides
    "relaxation": lambda load: column(load, effects=(r.Relaxation(stiffness=0.3, time=0.1),)),
    "spinning frame": lambda load: column(load, effects=(r.SpinningFrame(rate=0.01, axis=(0, 0, 1)),)),
    "magnet": magnetic,
}


def rest(robot, control=None, **options):
    """Return an equilibrium, and the warnings on its stability."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        control = np.zeros(robot.control_layout.size) if control is None else control
        found = kc.equilibrium(robot, control, **options)
    return found, [str(each.message) for each in said if "unstable" in str(each.message)]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_rod_is_unstable_beyond_its_critical_load_whatever_its_parts(kind):
    below, quiet = rest(KINDS[kind](0.93))
    assert below.result[0] == kc.Result.CONVERGED and below.stability[0] == Verdict.STABLE and not quiet
    above, said = rest(KINDS[kind](1.07), initial=UPRIGHT)
    assert above.result[0] == kc.Result.UNSTABLE and above.stability[0] == Verdict.UNSTABLE and said
    assert np.max(np.abs(above.position[0, :, :2])) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_without_a_guess_an_unstable_rod_is_given_in_the_shape_to_which_it_falls(kind):
    """Under weight it falls as a column does from a bent guess, and in a field it is an elastica."""
    found, said = rest(KINDS[kind](2.0))
    assert found.result[0] == kc.Result.RECOVERED_RELAXATION and found.stability[0] == Verdict.STABLE
    assert found.residual[0] < 1e-8 and not said
    if kind == "magnet":
        # Euler's elastica: K(m) = π/2 √2, height 2 E / K - 1
        m = brentq(lambda m: ellipk(m) - np.pi / 2 * np.sqrt(2.0), 0.1, 0.99)
        height = 2.0 * ellipe(m) / ellipk(m) - 1.0
    else:
        angle = np.linspace(0.0, 2.0, 21)
        bent = np.stack([1.0 - np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1) / 2.0
        height = float(rest(column(2.0), initial=bent)[0].position[0, -1, 2])
    assert float(found.position[0, -1, 2]) == pytest.approx(height, abs=0.01)


def test_a_search_that_may_take_no_time_is_not_made():
    found, said = rest(magnetic(2.0), recovery_budget=0.0)
    assert found.stability[0] == Verdict.UNSTABLE and said


@pytest.mark.slow
def test_the_length_that_is_fed_decides_on_a_fed_column():
    robot = column(1.0, effects=(r.Insertion(reserve=0.1, retraction=0.1),))
    # Greenhill's load grows with the cube of the length
    assert rest(robot, [-0.03])[0].stability[0] == Verdict.STABLE
    assert rest(robot, [0.03], initial=UPRIGHT)[0].stability[0] == Verdict.UNSTABLE


@pytest.mark.slow
def test_a_follower_load_makes_a_column_flutter():
    assert rest(follower(0.9))[0].stability[0] == Verdict.STABLE
    found, said = rest(follower(1.1))
    assert found.stability[0] == Verdict.FLUTTER and found.result[0] == kc.Result.UNSTABLE and said
    assert "by flutter" in str(found)


@pytest.mark.slow
@pytest.mark.parametrize(("part", "verdict"), [(0.9, Verdict.STABLE), (1.1, Verdict.FLUTTER)])
def test_a_load_along_the_line_makes_a_column_flutter(part, verdict):
    """Leipholz's column flutters at q L³/EI = 40.05."""
    load = r.loads.DistributedWrench(force=(0.0, 0.0, -part * 40.05 * EI / L**3), follows=True)
    column = r.SlenderRod(**ROD | {"bending_damping": 0.0, "nodes": 21}, gravity=(0, 0, 0), loads=(load,))
    assert rest(column)[0].stability[0] == verdict


@pytest.mark.slow
@pytest.mark.parametrize(("part", "verdict"), [(0.9, Verdict.STABLE), (1.1, Verdict.FLUTTER)])
def test_a_damped_shaft_whirls_beyond_its_first_frequency(part, verdict):
    """Gyroscopic forces stabilise it there, and damping of the material undoes that (Thomson and Tait)."""
    rate = part * 3.516 * np.sqrt(EI / (RHO * AREA)) / L**2
    shaft = r.SlenderRod(**ROD, gravity=(0, 0, 0), effects=(r.SpinningFrame(rate=rate, axis=(0, 0, 1)),))
    assert rest(shaft)[0].stability[0] == verdict


def test_tendons_that_compress_a_straight_rod_do_not_buckle_it():
    """The force of a tendon turns with the line and bends nothing: stable at ten times Euler's load."""
    robot = kc.load_robot("delrin-tendon-robot").replace(gravity=(0.0, 0.0, 0.0))
    euler = np.pi**2 / 4 * float(robot.Kbt[0, 0]) / float(robot.length) ** 2
    found, said = rest(robot, np.full(4, 10.0 * euler / 4.0))
    assert found.stability[0] == Verdict.STABLE and not said
    assert str(found).splitlines()[1] == "stable"


def test_an_unstable_guess_is_kept_and_said():
    robot = column(1.5)
    found, said = rest(robot, initial=UPRIGHT)
    assert found.result[0] == kc.Result.UNSTABLE and found.stability[0] == Verdict.UNSTABLE and said
    # hanging over is stable
    bent = np.stack(
        [np.sin(np.linspace(0, 2, 21)), 0 * np.linspace(0, 2, 21), 1 - np.cos(np.linspace(0, 2, 21))]
    )
    fallen, said = rest(robot, initial=bent.T)
    assert fallen.stability[0] == Verdict.STABLE and not said


def test_opposed_tubes_are_unstable_beyond_the_known_product():
    """Opposite tubes turn about each other where √C L = π/2 (Dupont et al. 2010)."""
    radii, length, modulus = ((3.5e-4, 2e-4), (7e-4, 4.5e-4)), 0.2, 6e10
    stiffness = [modulus * np.pi / 4 * (a**4 - b**4) for a, b in radii]
    root = np.sqrt(stiffness[0] * stiffness[1] / sum(stiffness) * sum(1.3 / each for each in stiffness))
    opposed, before = [0.0, 0.0, np.pi, 0.0], None
    for part, stable in ((0.95, True), (1.05, False)):
        curvature = part * np.pi / 2 / (length * root)
        tubes = tuple(
            r.tubes.Tube(
                radius=a, inner_radius=b, youngs_modulus=modulus, density=6450.0, curvature=curvature
            )
            for a, b in radii
        )
        robot = r.tubes.ConcentricTubeRobot(
            length=length, tubes=tubes, gravity=(0, 0, 0), bending_damping=1e-5, nodes=17
        )
        found, _ = rest(robot, opposed, initial=before)
        straight = np.ptp(np.diff(found.part("angle")[0], axis=1)) < 1e-6
        assert straight
        assert found.stability[0] == (Verdict.STABLE if stable else Verdict.UNSTABLE)
        before = found


def test_an_untested_equilibrium_says_why(tmp_path):
    robot = kc.load_robot("delrin-tendon-robot")
    many = kc.equilibrium(robot, np.full((2, 4), 5.0))
    assert "stability not tested: one of several equilibria" in str(many)
    assert np.all(many.stability == Verdict.UNTESTED_MANY) and many[0].stability.shape == (1,)
    unasked = kc.equilibrium(robot, np.full(4, 5.0), with_stability=False)
    assert "stability not tested: with_stability is False" in repr(unasked)
    unasked.save(tmp_path / "rest.nc")
    assert kc.load_trajectory(tmp_path / "rest.nc").verdict == unasked.verdict
    # a motion has no verdict
    assert "stab" not in str(kc.simulate(robot, np.full((2, 4), 5.0), 0.01))
    traced = jax.jit(lambda control: kc.equilibrium(robot, control))(np.full(4, 5.0))
    assert "inside JAX" in traced.verdict


def test_friction_has_a_reason():
    robot = kc.load_robot("delrin-routed-tendon-robot")
    rubbing = robot.replace(friction=tendons.TendonFriction(wobble=0.6, reach=0.1))
    found, _ = rest(rubbing, np.full(4, 5.0))
    assert found.verdict == "stability not tested: friction has no linearisation at rest"


def test_the_command_prints_the_verdict():
    from typer.testing import CliRunner

    from knode_cosserat.cli import app

    for robot, control, verdict in (
        ("delrin-tendon-robot", "7,5,5,7", "stable"),
        ("variable-curvature-robot", "section0_input=0.3", "stable"),
    ):
        run = CliRunner().invoke(app, ["equilibrium", robot, "--control", control])
        assert verdict in run.stdout.splitlines()
