"""The PyElastica test robot: an independent implementation, and a robot with friction, lag and noise."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat.control import ControlLimits, PredictiveController, Sensor, circle, run_loop
from knode_cosserat.control.commands import apply_lag, identified_lag
from knode_cosserat.control.planning import lag_weights
from knode_cosserat.estimation import Curvatures, KalmanObserver, TipPose, TipPosition
from knode_cosserat.robots import RoutedTendonRobot

ROBOT = kc.load_robot("delrin-tendon-robot")
LENGTH = float(ROBOT.length)


# the motors' lag


def test_a_lag_is_identified_from_noisy_tensions():
    rng = np.random.default_rng(1)
    commanded = np.repeat(rng.uniform(0.0, 8.0, (40, 4)), 8, axis=0)
    measured = apply_lag(commanded, 0.0125, 0.06, np.ones(4)) + rng.normal(0.0, 0.05, commanded.shape)
    assert_allclose(identified_lag(commanded, measured, 0.0125, np.ones(4)), 0.06, rtol=0.02)


def test_lag_weights_are_those_of_the_lag():
    """Oracle: the mean over each period of the exponential approach to a constant command."""
    weights = lag_weights(np.ones((5, 1)), 0.1, 0.05)
    times = 0.05 * (np.arange(5)[:, None] + (np.arange(10_000) + 0.5) / 10_000)
    remaining = np.exp(-times / 0.1).mean(axis=1)
    assert_allclose(weights, np.stack([1.0 - remaining, remaining], axis=1), rtol=1e-8)


@pytest.mark.campaign
def test_a_planning_controller_predicts_with_the_lag():
    """Oracle: a plant whose tensions follow the commands by the same lag, in eight steps of each period."""
    lag, dt, parts = 0.08, 0.05, 8
    limits = ControlLimits(0.0, 10.0, 40.0, lag=lag)
    sensor = Sensor(TipPosition())

    class Lagging(kc.control.SimulatedPlant):
        def start(self):
            self.pulled = super().start()
            return self.pulled

        def apply(self, control):
            ends = apply_lag(np.tile(control, (parts, 1)), dt / parts, lag, self.pulled)
            for start, end in zip([self.pulled, *ends[:-1]], ends, strict=True):
                self._stepper.step(0.5 * (start + end))
            self.pulled = ends[-1]
            self._sense()

    plant, errors = Lagging(ROBOT, dt, sensor, substeps=parts), {}
    for known in (True, False):
        limits = dataclasses.replace(limits, lag=lag if known else 0.0)
        controller = PredictiveController(KalmanObserver(ROBOT, dt, TipPosition()), TipPosition(), limits)
        errors[known] = run_loop(controller, plant, circle(0.1, 1.5), 4.0).tip_rmse(3.0) / LENGTH
    assert errors[True] < 2e-3 and errors[False] > 5.0 * errors[True]


# the test robot; compiling takes some 40 s, once for all processes

elastica = pytest.importorskip("elastica", reason="the test robot needs the extra studies")
from studies.elastica.plant import ElasticaPlant, record_elastica  # noqa: E402
from studies.elastica.rod import PERFECT, ElasticaRod, Imperfections  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def perfect():
    return ElasticaRod(ROBOT, PERFECT)


@pytest.fixture(scope="module")
def rubbing():
    return ElasticaRod(ROBOT, Imperfections())


def test_a_static_tip_is_that_of_our_equations(perfect):
    """Two implementations of the same physics: the tip within 0.2 % of the length."""
    tension = np.array([9.0, 1.0, 0.0, 5.0])
    perfect.restart()
    perfect.advance(tension, 3.0)
    found = kc.equilibrium(RoutedTendonRobot.like(ROBOT), tension, space="lobatto4")
    assert np.linalg.norm(perfect.tip() - np.asarray(found.tip_position[-1])) < 2e-3 * LENGTH
    assert_allclose(perfect.quaternions([1.0])[0], np.asarray(found.quaternion[-1, -1]), atol=0.01)


def test_the_loop_is_that_of_pyelastica(perfect):
    """Without tendons and damping the compiled loop takes the steps of PyElastica's own `PositionVerlet`.

    The clamp differs: here the first half element bends. So the first element's motion is compared with
    nothing; the rod is bent at its tip, and the elements near the tip do not yet know of the clamp.
    """
    from elastica.rod.cosserat_rod import CosseratRod
    from elastica.timestepper.symplectic_steppers import PositionVerlet

    n = 12
    robot = ROBOT.replace(bending_damping=0.0, drag=0.0, gravity=np.zeros(3))
    rod = ElasticaRod(robot, PERFECT, elements=n, rotary_inertia=1.0)
    other = CosseratRod.straight_rod(
        n,
        np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        np.array([1.0, 0.0, 0.0]),
        LENGTH,
        float(robot.radius),
        float(robot.density),
        youngs_modulus=float(robot.youngs_modulus),
        shear_modulus=float(robot.G),
    )
    other.mass_second_moment_of_inertia[2, 2] = other.mass_second_moment_of_inertia[0, 0]
    other.inv_mass_second_moment_of_inertia[2, 2] = other.inv_mass_second_moment_of_inertia[0, 0]
    rod.restart()
    for velocity in (rod._rod.velocity, other.velocity_collection):
        velocity[0, -1] = 0.5
    other.v_w_collection = np.zeros((2, 0))
    stepper, dt, steps = PositionVerlet(), rod.dt, 8

    def dynamics(time, dt):
        other.velocity_collection += dt * other.acceleration_collection
        other.omega_collection += dt * other.alpha_collection

    def kinematics(time, dt):
        from elastica.rod.data_structures import overload_operator_kinematic_numba

        overload_operator_kinematic_numba(
            dt,
            other.position_collection,
            other.director_collection,
            other.velocity_collection,
            other.omega_collection,
        )

    other.update_dynamics, other.update_kinematics = dynamics, kinematics
    for _ in range(steps):
        stepper.step_single_instance(other, 0.0, dt)
    rod.advance(np.zeros(4), steps * dt)
    moved = np.abs(other.position_collection[0, -4:])
    assert moved.max() > 1e-6
    assert_allclose(rod._rod.position[:, -4:], other.position_collection[:, -4:], rtol=0, atol=1e-12)


def test_friction_leaves_a_hysteresis(rubbing):
    """After a pull and its release the tip is not where it was; without friction it is (to 0.1 mm)."""
    rest, pull = np.full(4, 3.0), np.array([8.0, 3.0, 3.0, 3.0])
    rubbing.restart()
    for tension in (rest, pull, rest):
        rubbing.advance(tension, 2.0)
    assert np.linalg.norm(rubbing.tip()[:2]) > 1e-3


def test_tensions_lag(rubbing):
    rubbing.restart()
    rubbing.advance(np.full(4, 5.0), 0.06)
    assert_allclose(rubbing.tension, 5.0 * (1.0 - np.exp(-1.0)), rtol=1e-9)


def test_the_plant_senses_with_noise_latency_and_losses(rubbing):
    plant = ElasticaPlant(rubbing, 0.05, Sensor(TipPosition(), noise=0.75, latency=1))
    start = plant.measure()
    plant.apply(np.array([8.0, 0.0, 0.0, 0.0]))
    assert_allclose(plant.measure(), start)  # one period old
    tips = []
    for seed in range(40):
        plant = ElasticaPlant(rubbing, 0.05, Sensor(TipPosition(), noise=0.75, dropout=0.3, seed=seed))
        tips.append(plant.measure() - plant.tip())
    known = np.isfinite(tips).all(axis=1)
    assert 0.4 < known.mean() < 0.95
    assert_allclose(np.std(np.array(tips)[known]), 1.5e-4, rtol=0.3)
    pose = ElasticaPlant(rubbing, 0.05, Sensor(TipPose())).measure()
    assert_allclose(np.linalg.norm(pose[3:]), 1.0)


def test_a_recording_has_the_tension_of_the_end_of_a_row(rubbing):
    commands = np.concatenate([np.full((4, 4), 2.0), np.full((8, 4), 4.0)])
    found = record_elastica(rubbing, commands, 0.05, seed=1)
    measured = found.measured
    assert measured.simulated and measured.continuous
    assert measured.position.shape == (48, 4, 3) and measured.dt == 0.0125
    expected = apply_lag(found.commanded, measured.dt, 0.06, np.full(4, 2.0))
    assert np.std(measured.control - expected) < 0.06
    assert_allclose(measured.initial_control, 2.0, atol=0.05)
    assert np.std(measured.position[:15, -1], axis=0).max() < 3e-4


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (
            lambda: ElasticaRod(ROBOT, Imperfections(friction=-1.0)),
            "friction is -1.0; allowed is zero or more",
        ),
        (
            lambda: ElasticaRod(kc.load_robot("soft-slender-robot"), PERFECT),
            "allowed is a robot with tendons",
        ),
        (lambda: ElasticaRod(kc.load_robot("delrin-routed-tendon-robot"), PERFECT), "robot has sections"),
        (lambda: ElasticaRod(ROBOT.replace(tendon_offset=0.0), PERFECT), "tendon_offset is 0"),
    ],
)
def test_errors_say_what_is_allowed(make, told):
    with pytest.raises(ValueError, match=told):
        make()


def test_a_sensor_that_the_stand_in_has_not_is_refused(rubbing):
    with pytest.raises(ValueError, match="the sensor measures Curvatures; the test robot has positions"):
        ElasticaPlant(rubbing, 0.05, Sensor(Curvatures((0.5,))))


@pytest.mark.campaign
@pytest.mark.parametrize("damping", [0.03, 0.003])
def test_a_sine_is_that_of_our_equations(damping):
    """A sine of 1 s, 2 N: the tip within 0.3 % of the length at all times."""
    from knode_cosserat.schemes.time import LIGHTLY_DAMPED

    robot, dt = ROBOT.replace(bending_damping=damping), 0.0025
    time = np.arange(0.0, 3.0, dt)[:, None]
    phase = 2.0 * np.pi * time + np.array([0.0, 1.0, np.pi, 1.0 + np.pi])
    tension = 4.0 + 2.0 * (np.sin(phase) - np.sin(phase[0]))
    routed = RoutedTendonRobot.like(robot, nodes=20)
    ours = np.asarray(kc.simulate(routed, tension, dt, time=LIGHTLY_DAMPED, space="lobatto4").tip_position)
    rod = ElasticaRod(robot, PERFECT)
    theirs = [rod.tip()]
    for each in tension:
        rod.advance(each, dt)
        theirs.append(rod.tip())
    assert np.abs(ours[:, :2]).max() > 0.1 * LENGTH
    apart = np.linalg.norm(np.array(theirs) - ours, axis=1)
    assert apart.max() < 3e-3 * LENGTH


@pytest.mark.campaign
def test_a_model_identified_from_recordings_controls_the_stand_in():
    """Friction, lag, noise, a wrong data sheet: tip RMSE below 0.5 % of the length (three minutes)."""
    from studies import stand_in

    rod = stand_in.true_rod(ROBOT)
    model = stand_in.identified(ROBOT, stand_in.recordings(rod, 4.0))
    assert_allclose(float(model.robot.youngs_modulus), float(rod.robot.youngs_modulus), rtol=0.03)
    assert_allclose(model.lag, rod.imperfections.lag, rtol=0.05)
    controller = stand_in.controller_of(model, "predictive", 0.05, ControlLimits(0.0, 10.0, 40.0), "adaptive")
    plant = ElasticaPlant(rod, 0.05, Sensor(TipPosition(), noise=0.75))
    log = run_loop(controller, plant, circle(0.1, 4.0), 10.0)
    assert log.tip_rmse(5.0) < 5e-3 * LENGTH and log.fallbacks == 0
