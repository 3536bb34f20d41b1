"""A rod on a site of a MuJoCo model: momentum, vibration on a free flange, stability, refusals."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq, curve_fit
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.mujoco import CouplingError, RodOnSite
from knode_cosserat.robots import ends

mujoco = pytest.importorskip("mujoco")

L, RADIUS, DENSITY, E, NODES = 0.3, 0.004, 1100.0, 2e7, 21
AREA, SECOND = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4.0
MASS = DENSITY * AREA * L
ROD = kc.robots.SlenderRod(
    length=L, radius=RADIUS, density=DENSITY, youngs_modulus=E, bending_damping=2e-6, nodes=NODES
)
#: Simpson's weights
WEIGHTS = np.array([1, *[4, 2] * (NODES // 2 - 1), 4, 1]) / 3.0 / (NODES - 1) * L


def inertia(mass):
    """Of a ball, about its centre."""
    return 0.4 * mass * 0.03**2


def on_flange(mass, dt=2e-3, velocity=(0.0,) * 6, robot=ROD, integrator="implicitfast", **options):
    """A rod on a free body of this mass."""
    J = inertia(mass)
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{dt}" gravity="0 0 0" integrator="{integrator}"/>
        <worldbody><body name="flange"><freejoint/>
        <inertial pos="0 0 0" mass="{mass}" diaginertia="{J} {J} {J}"/></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qvel[:] = velocity
    return RodOnSite(robot, model, data, "flange", space="lobatto4", **options)


def kicked(coupled, seconds=0.06, moment=3e-4):
    """Turn the flange by a short moment about y, so that the rod vibrates."""
    count = round(seconds / coupled.dt)
    for k in range(count):
        coupled.data.xfrc_applied[1, 4] = moment * np.sin(np.pi * k / count)
        coupled.step()
    coupled.data.xfrc_applied[:] = 0.0
    return coupled


def momenta(coupled):
    """Momentum, angular momentum about the origin, and energy of flange and rod."""
    mass, J = coupled.model.body_mass[1], coupled.model.body_inertia[1]
    row, layout = coupled.state, coupled.robot.y_layout
    control = coupled.robot.control_layout
    p0, v0, w0 = (
        control.get(row.control[0], f"base_{name}") for name in ("position", "velocity", "angular_velocity")
    )
    p, h, q, w = (layout.get(row.y[0], name) for name in "phqw")
    R = Rotation.from_quat(h, scalar_first=True)
    v, own = R.apply(q), DENSITY * SECOND * np.array([1.0, 1.0, 2.0]) * w
    linear = mass * v0 + DENSITY * AREA * WEIGHTS @ v
    angular = np.cross(p0, mass * v0) + J * w0
    angular = angular + WEIGHTS @ (DENSITY * AREA * np.cross(p, v) + R.apply(own))
    strain = row.z[0] - [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    K = np.concatenate([np.diag(np.asarray(each)) for each in (coupled.robot.Kse, coupled.robot.Kbt)])
    moving = (
        mass * v0 @ v0
        + J[0] * w0 @ w0
        + WEIGHTS @ (DENSITY * AREA * np.sum(v * v, axis=1) + np.sum(own * w, axis=1))
    )
    return linear, angular, 0.5 * (moving + WEIGHTS @ (strain**2 @ K))


def drift(coupled, seconds):
    """Largest change of momentum and of angular momentum, relative to theirs, and energies of all steps."""
    linear, angular, energy = momenta(coupled)
    worst, energies = np.zeros(2), [energy]
    for _ in range(round(seconds / coupled.dt)):
        coupled.step()
        now, turning, energy = momenta(coupled)
        change = np.linalg.norm(now - linear), np.linalg.norm(turning - angular)
        worst = np.maximum(worst, np.divide(change, [np.linalg.norm(linear), np.linalg.norm(angular)]))
        energies.append(energy)
    return worst, np.array(energies)


MOVING = (0.1, 0.05, 0.0, 0.3, 2.0, 0.0)


def test_momentum_is_kept_without_gravity():
    coupled = kicked(on_flange(MASS, velocity=MOVING))
    assert abs(coupled.state.z[0, 3, 4]) > 0.02  # it vibrates
    worst, energies = drift(coupled, 0.1)
    assert np.all(worst < 1e-3)
    assert np.all(np.diff(energies) < 1e-6 * energies[0])


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_momentum_is_kept_for_seconds(ratio):
    coupled = kicked(on_flange(MASS / ratio, velocity=MOVING))
    worst, energies = drift(coupled, 5.0)
    assert np.all(worst < 1e-3)
    assert energies[-1] < energies[0] and np.max(np.diff(energies)) < 1e-5 * energies[0]


def free_frequency(mass):
    """First frequency (Hz) of the rod on a free body: a Timoshenko beam, by the matrix exponential."""
    shear, bending = (float(np.asarray(each)[0, 0]) for each in (ROD.Kse, ROD.Kbt))

    def left_at_the_tip(frequency):
        square = (2.0 * np.pi * frequency) ** 2
        rates = np.zeros((4, 4))
        rates[0, 1], rates[0, 2], rates[1, 3], rates[3, 2] = 1.0, 1.0 / shear, 1.0 / bending, -1.0
        rates[2, 0], rates[3, 1] = -DENSITY * AREA * square, -DENSITY * SECOND * square
        body = np.array([[1.0, 0.0], [0.0, 1.0], [-mass * square, 0.0], [0.0, -inertia(mass) * square]])
        return np.linalg.det((expm(rates * L) @ body)[2:])

    grid = np.arange(0.5, 40.0, 0.25)
    signs = np.sign([left_at_the_tip(each) for each in grid])
    first = int(np.argmax(signs[1:] != signs[:-1]))
    return brentq(left_at_the_tip, *grid[first : first + 2])


@pytest.mark.slow
def test_a_rod_vibrates_on_a_free_flange_as_in_the_closed_form():
    mass = 2.0 * MASS
    coupled = kicked(on_flange(mass, dt=1e-3))
    t, bent = [], []
    for k in range(600):
        coupled.step()
        t.append(k * coupled.dt)
        bent.append(coupled.state.z[0, 5, 4])

    def vibration(t, a, b, decay, frequency, offset):
        turn = 2.0 * np.pi * frequency * t
        return np.exp(-decay * t) * (a * np.cos(turn) + b * np.sin(turn)) + offset

    found, _ = curve_fit(vibration, np.array(t), bent, [0.0, np.ptp(bent) / 2.0, 0.5, 6.7, 0.0])
    assert abs(found[3] / free_frequency(mass) - 1.0) < 0.01


def test_other_integrators_and_substeps_agree():
    tips = []
    for options in ({}, {"substeps": 2, "dt": 1e-3}, {"integrator": "RK4"}, {"integrator": "Euler"}):
        coupled = kicked(on_flange(MASS, **options))
        tips.append(np.array(coupled.state.tip_position[0]))
    moved = np.linalg.norm(tips[0] - [0.0, 0.0, L])
    assert moved > 1e-4
    assert np.max(np.abs(np.array(tips) - tips[0])) < 0.03 * moved


def test_a_rod_that_is_too_heavy_for_its_flange_is_told():
    with pytest.warns(UserWarning, match="times that of the site; motions are stable up to about 5"):
        on_flange(MASS / 100.0)


def test_the_wrench_is_the_weight_at_rest_and_the_users_forces_stay():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="hand" pos="0 0 1"><joint axis="0 1 0" damping="100"/>
        <geom size="0.05" mass="2"/><site name="flange" pos="0.1 0 0" quat="0 1 0 0"/></body></worldbody>
        </mujoco>"""
    )
    data = mujoco.MjData(model)
    data.xfrc_applied[1, 0] = 0.5
    robot = ROD.replace(**{"base_end.position": [0.0, 0.02, 0.0]}, bending_damping=2e-5)
    coupled = RodOnSite(robot, model, data, "flange")
    np.testing.assert_allclose(coupled.state.position[0, 0], [0.1, -0.02, 1.0], atol=1e-9)
    weight = 9.81 * MASS
    expected = [0.0, 0.0, -weight, 0.02 * weight, 0.0, 0.0]
    np.testing.assert_allclose(coupled.wrench, expected, atol=1e-6)
    coupled.step()
    assert data.xfrc_applied[1].tolist() == [0.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert data.time == pytest.approx(0.002) and coupled.state.time[0] == pytest.approx(0.002)


def test_what_cannot_be_coupled_is_refused(monkeypatch):
    coupled = on_flange(MASS)
    model, data = coupled.model, coupled.data
    driven = ROD.replace(base_end=ends.Driven())
    for arguments, said in (
        ((ROD, model, data, "flagne"), "no site or body 'flagne'; there are flange"),
        ((ROD, data, model, "flange"), "model and data are MjData and MjModel; allowed are a"),
        ((driven, model, data, "flange"), "base_end is driven; allowed is clamped or moving"),
    ):
        with pytest.raises(CouplingError, match=said):
            RodOnSite(*arguments)
    with pytest.raises(CouplingError, match="substeps is 0"):
        RodOnSite(ROD, model, data, "flange", substeps=0)
    with pytest.raises(CouplingError, match=r"shape \(2,\); allowed is \(0,\)"):
        coupled.step([1.0, 2.0])
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install 'knode-cosserat\[mujoco\]'"):
        RodOnSite(ROD, model, data, "flange")
