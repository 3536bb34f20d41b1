"""Several equilibria under the same controls: two tubes that snap, a buckled strip, robots with one only."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import knode_cosserat as kc
from knode_cosserat.identification import evaluate
from knode_cosserat.solvers.branches import other_equilibria

L, E = 0.2, 6e10
RADII = ((0.35e-3, 0.2e-3), (0.7e-3, 0.45e-3))
EI = [E * np.pi / 4 * (outer**4 - inner**4) for outer, inner in RADII]
#: of two tubes of curvature κ, the relative angle obeys θ'' = (FACTOR κ)² sin θ, with GJ = EI / 1.3
FACTOR = np.sqrt(EI[0] * EI[1] / (EI[0] + EI[1]) * 1.3 * (1 / EI[0] + 1 / EI[1]))
#: curvature at which opposite tubes bifurcate: (FACTOR κ) L = π/2 (Dupont et al. 2010)
CRITICAL = np.pi / 2 / (L * FACTOR)


def pair(share):
    tubes = tuple(
        kc.robots.tubes.Tube(
            radius=outer, inner_radius=inner, curvature=share * CRITICAL, youngs_modulus=E, density=6450.0
        )
        for outer, inner in RADII
    )
    return kc.robots.tubes.ConcentricTubeRobot(length=L, gravity=(0.0, 0.0, 0.0), nodes=21, tubes=tubes)


def controls_of(angles):
    control = np.zeros((len(angles), 4))
    control[:, 2] = angles
    return control


def tips(share, angle):
    """Relative angles at the tip by shooting from there: the tubes' base is at the angle, up to turns."""
    rate = FACTOR * share * CRITICAL
    every = np.linspace(0.0, 2 * np.pi, 721)[:-1] + 1e-3
    back = solve_ivp(
        lambda s, y: np.concatenate([y[720:], rate**2 * np.sin(y[:720])]),
        (0.0, L),
        np.concatenate([every, np.zeros(720)]),
        rtol=1e-9,
        atol=1e-9,
    ).y[:720, -1]
    off = np.append(back, back[0] + 2 * np.pi) - angle
    turn = np.floor(off / (2 * np.pi))
    crossed = np.flatnonzero(np.diff(turn))
    return np.append(every, every[0] + 2 * np.pi)[crossed]


@pytest.mark.slow
@pytest.mark.parametrize(("share", "counts"), [(0.9, (1, 1, 1)), (1.4, (1, 1, 3)), (4.0, (3, 3, 5))])
def test_two_tubes_have_the_equilibria_of_their_pendulum(share, counts):
    """Below the critical product there is one; beyond it more, in growing ranges about opposite."""
    angles = np.array([0.4, 2.0, 3.1])
    robot = pair(share)
    known = kc.solvers.equilibria(
        robot, controls_of(angles), space="lobatto4", initial="separate", with_stability=False
    )
    rows, records = other_equilibria(known)
    at = known.system.y_layout.slice("angle")
    for k, angle in enumerate(angles):
        own = np.concatenate([np.asarray(known.y[k : k + 1]), records[rows == k][..., : known.y.shape[-1]]])
        found = np.sort((own[:, -1, at][:, 1] - own[:, -1, at][:, 0]) % (2 * np.pi))
        assert len(found) == counts[k]
        # half a degree of the scan, and the discretisation error
        np.testing.assert_allclose(found, np.sort(tips(share, angle) % (2 * np.pi)), atol=0.02)


@pytest.mark.slow
def test_a_row_at_another_equilibrium_is_named_and_does_not_count():
    angles = np.linspace(-3.0, 3.0, 7)
    robot = pair(1.4)
    truth = kc.solvers.equilibria(
        robot, controls_of(angles), space="lobatto4", initial="separate", with_stability=False
    )
    rows, records = other_equilibria(truth)
    position = np.array(truth.tip_position)
    position[rows[-1]] = records[-1, -1, :3]
    measured = measurements(controls_of(angles), position + 1e-4)
    found = evaluate(robot, measured)
    several = found.several
    assert several.rows.tolist() == sorted(set(rows.tolist())) == [0, 6]
    assert several.equilibria.tolist() == [3, 3]
    assert several.elsewhere.tolist() == [k == rows[-1] for k in several.rows]
    noise = np.sqrt(3) * 1e-4
    np.testing.assert_allclose(several.nearest, noise, rtol=1e-3)
    for value in (several.tip_rmse_nearest, several.tip_rmse_same, several.tip_rmse_unambiguous):
        assert value == pytest.approx(noise, rel=1e-3)
    assert found.tip_rmse > 10 * noise
    words = str(found)
    assert "2 rows with 3 equilibria (0, 6; tip RMSE of the other rows 0.17 mm)" in words
    assert f"row {rows[-1]}: {1e3 * several.predicted.max():.2f} mm, the nearest 0.17 mm" in words
    assert found.to_dict()["several_equilibria"]["rows"] == [0, 6]


def measurements(control, tip):
    count = len(control)
    return kc.recordings.Measurements(
        time=np.arange(float(count)),
        control=control,
        fractions=np.ones(1),
        position=tip[:, None],
        quaternion=np.full((count, 1, 4), np.nan),
        measured=np.ones((count, 1), bool),
        simulated=True,
        source="",
        static=True,
    )


@pytest.mark.slow
def test_a_buckled_strip_is_also_in_equilibrium_on_the_other_side():
    side = kc.robots.ends.Clamped(position=(0.0, 0.0, 0.45), orientation=(1.0, 0.0, 0.0, 0.0))
    strip = kc.robots.SlenderRod(
        length=0.5,
        cross_section=kc.robots.section.RectangularSection(width=0.01, height=0.002),
        density=1100.0,
        youngs_modulus=5e6,
        gravity=(0.0, 0.0, 0.0),
        nodes=21,
        tip_end=side,
    )
    known = kc.equilibrium(strip, np.zeros(0))
    rows, records = other_equilibria(known)
    assert set(rows.tolist()) == {0}
    away = [np.abs(record[:, :2] + known.position[0, :, :2]).max() for record in records]
    # tolerance of the solver
    assert min(away) < 1e-6


@pytest.mark.slow
def test_a_robot_with_one_equilibrium_has_no_other():
    robot = kc.load_robot("delrin-tendon-robot").replace(nodes=7)
    control = np.array([[4.0, 0.0, 0.0, 0.0], [0.0, 3.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]])
    known = kc.solvers.equilibria(robot, control, space="lobatto4", initial="separate")
    assert not len(other_equilibria(known)[0])
    found = evaluate(robot, measurements(control, np.array(known.tip_position)))
    assert found.several is None and "several_equilibria" not in found.to_dict()
