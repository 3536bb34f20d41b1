"""Full states from poses: closed forms, orders, symmetry, the virtual robot, and bad input."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.recordings import Recording, RecordingConfig
from knode_cosserat.recordings.estimation import kinematics
from knode_cosserat.recordings.streams import Body, ControlRows
from knode_cosserat.recordings.virtual import virtual_robot

LENGTH, FRACTIONS = 0.635, np.array([3, 5, 7, 9]) / 9
ROBOT = kc.load_robot("delrin-tendon-robot")
#: a rod without loads but its own inertia
BARE = ROBOT.replace(gravity=[0.0, 0.0, 0.0], drag=0.0)


def arc(time, s):
    """A circular arc that swings: position, orientation, q and ω of a point, closed forms."""
    k, k_t = 1.5 * np.sin(5.0 * time), 7.5 * np.cos(5.0 * time)
    x = k * s
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    one, two = np.where(small, x / 2, (1 - np.cos(safe)) / safe), np.where(small, 1.0, np.sin(safe) / safe)
    position = s * np.stack([one, 0 * x, two], axis=-1)
    # their derivatives by x
    d1 = np.where(small, 0.5, (safe * np.sin(safe) - 1 + np.cos(safe)) / safe**2)
    d2 = np.where(small, -x / 3, (safe * np.cos(safe) - np.sin(safe)) / safe**2)
    velocity = s * np.stack([d1, 0 * x, d2], axis=-1) * (k_t * s)[:, None]
    turn = Rotation.from_rotvec(x[:, None] * [0.0, 1.0, 0.0])
    w = (k_t * s)[:, None] * np.array([0.0, 1.0, 0.0])
    return position, turn, turn.inv().apply(velocity), w


def recorded(of=arc, seconds=3.0, noise=(0.0, 0.0), seed=0, lost=(), tendons=4, about_z=0.0, turned=True):
    """A recording of a motion, as it is after reading."""
    random = np.random.default_rng(seed)
    time = np.round(np.arange(0.0, seconds + 1e-9, 0.01), 9)
    for start, end in lost:
        time = time[(time < start) | (time > end)]
    round_z = Rotation.from_rotvec([0.0, 0.0, about_z])
    bodies = []
    for k, fraction in enumerate(FRACTIONS):
        position, turn = of(time, fraction * LENGTH)[:2]
        position = round_z.apply(position + random.normal(0.0, 1.0, position.shape) * noise[0])
        shaken = Rotation.from_rotvec(random.normal(0.0, 1.0, position.shape) * noise[1]) * turn
        quaternion = (round_z * shaken * round_z.inv()).as_quat(scalar_first=True)
        bodies.append(Body(time, position, quaternion if turned else None, f"rib {k}", f"/rib{k}", fraction))
    stamps = np.arange(0.0, seconds + 0.01, 0.02)
    pulls = ControlRows(stamps, np.full((len(stamps), tendons), 5.0), "/tension")
    config = RecordingConfig.paper_robot()
    return Recording("made", config, tuple(bodies), None, pulls, None, None, True, (), {})


def true_part(name, time, nodes=10):
    index = {"p": 0, "q": 2, "w": 3}[name]
    return np.stack([arc(time, s)[index] for s in np.linspace(0.0, LENGTH, nodes)], axis=1)


def test_exact_poses_give_exact_motion():
    states = kc.estimate_states(recorded(), BARE)
    time = np.asarray(states.time)
    inner = slice(4, -4)
    for name, most in (("p", 2e-6), ("q", 2e-4), ("w", 1e-3)):
        error = np.asarray(states.part(name)) - true_part(name, time)
        assert np.abs(error[inner]).max() < most, name
    np.testing.assert_allclose(
        np.asarray(states.part("u"))[inner, :, 1],
        np.tile(1.5 * np.sin(5 * time), (10, 1)).T[inner],
        atol=5e-3,
    )
    assert states.settings is None and states.all_valid


def test_the_kinematics_are_of_order_four():
    a = np.random.default_rng(0).normal(size=(2, sum(kinematics.MODES))) * 2.0
    tips = []
    for finest in (1 / 18, 1 / 36, 1 / 288):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kinematics, "FINEST", finest)
            rod = kinematics.RodGeometry.of(LENGTH, 10, FRACTIONS, np.array([1.0, 0, 0, 0]), np.zeros(3))
        tips.append(kinematics.rod_shape(rod, a, 1.0).p[:, -1])
    coarse, fine = (np.abs(tip - tips[2]).max() for tip in tips[:2])
    assert 12.0 < coarse / fine < 24.0


def test_sensitivities_are_derivatives():
    rod = kinematics.RodGeometry.of(LENGTH, 10, FRACTIONS, np.array([1.0, 0, 0, 0]), np.zeros(3))
    random = np.random.default_rng(1)
    a, da = random.normal(size=(2, 1, rod.modes))
    it = kinematics.rod_shape(rod, a, 1.01)
    turns, shifts = kinematics.sensitivity(rod, it)
    ahead, behind = (kinematics.rod_shape(rod, a + step * da, 1.01) for step in (1e-5, -1e-5))
    shift = (ahead.p - behind.p)[:, rod.bodies] / 2e-5
    turn = kinematics.turn_between(ahead.h, behind.h)[:, rod.bodies] / 2e-5
    np.testing.assert_allclose(shifts @ da[0], shift, atol=3e-5)
    np.testing.assert_allclose(turns @ da[0], turn, atol=3e-5)


def test_the_paper_s_velocities_are_of_order_two_in_time():
    errors = []
    for dt in (0.1, 0.05, 0.03):
        states = kc.estimate_states(recorded(), BARE, "paper", dt=dt)
        error = np.asarray(states.part("q")) - true_part("q", np.asarray(states.time))
        errors.append(np.abs(error[2:-2, -1]).max())
    orders = np.log(np.array(errors[:-1]) / errors[1:]) / np.log([2.0, 5.0 / 3.0])
    assert np.all(np.abs(orders - 2.0) < 0.25)


@pytest.mark.campaign
@pytest.mark.parametrize("method", ["best", "paper"])
def test_turning_everything_about_z_turns_the_states(method):
    noise, angle = (0.15e-3, 2e-3), 0.7
    straight = kc.estimate_states(recorded(noise=noise), BARE, method)
    turned = kc.estimate_states(
        recorded(noise=noise, about_z=angle),
        BARE.replace(tendon_angles=np.asarray(BARE.tendon_angles) + angle),
        method,
    )
    R = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
    # the probes of the evidence are random: their share of the noise is left
    for name, most in (("p", 3e-5), ("q", 6e-4), ("n", 2e-3), ("m", 1e-3)):
        difference = np.asarray(turned.part(name)) - np.asarray(straight.part(name)) @ R.T
        assert np.abs(difference[2:-2]).max() < (most if method == "best" else 1e-9), name


@pytest.mark.campaign
def test_a_loaded_equilibrium_has_its_own_forces():
    robot = ROBOT.replace(nodes=28)
    truth = kc.equilibrium(robot, np.array([5.0, 5.0, 5.3, 5.2]), space="lobatto4")
    position, quaternion = np.asarray(truth.position)[0], np.asarray(truth.quaternion)[0]

    def still(time, s):
        node = round(27 * s / LENGTH)
        h = np.tile(quaternion[node], (len(time), 1))
        return np.tile(position[node], (len(time), 1)), Rotation.from_quat(h, scalar_first=True)

    recording = recorded(still)
    pulls = dataclasses.replace(
        recording.control, values=np.tile([5.0, 5.0, 5.3, 5.2], (len(recording.control.time), 1))
    )
    states = kc.estimate_states(dataclasses.replace(recording, control=pulls), ROBOT)
    for name in ("n", "m", "u"):
        true = np.asarray(truth.part(name))[0, ::3]
        # u hardly: four bodies tell little of how it goes along the rod
        allowed = (0.1 if name == "u" else 2e-3) * np.abs(true).max()
        np.testing.assert_allclose(np.asarray(states.part(name))[10], true, atol=allowed)


@pytest.mark.campaign
def test_on_the_virtual_robot_the_best_is_three_times_better(virtual):
    path, truth = virtual
    recording = kc.load_recording(path)
    paper, best = (
        kc.metrics.state_errors(kc.estimate_states(recording, virtual_robot(10), method), truth)
        for method in ("paper", "best")
    )
    assert best["p"].rms < 0.15e-3 and best["h"].rms < 2e-3
    for name in ("n", "m", "q", "w"):
        assert 3.0 * best[name].rms < paper[name].rms, name


@pytest.mark.campaign
def test_measurements_on_a_grid_will_do(virtual):
    path, truth = virtual
    states = kc.estimate_states(kc.load_recording(path).sampled(0.05), virtual_robot(10))
    errors = kc.metrics.state_errors(states, truth)
    assert errors["p"].rms < 0.4e-3 and errors["q"].rms < 0.05 * errors["q"].size


@pytest.mark.campaign
def test_what_is_estimated_can_be_learned_from(virtual):
    path, _ = virtual
    states = kc.estimate_states(kc.load_recording(path), ROBOT, end=2.0)
    config = dataclasses.replace(kc.FitConfig.paper(history=True), segments=kc.learning.Training(epochs=3))
    model = kc.fit(ROBOT, [states], config)
    assert isinstance(model, kc.KNODE)


def test_a_recording_in_parts_says_so():
    recording = recorded(lost=[(1.0, 1.5)])
    with pytest.raises(kc.recordings.RecordingError, match=r"in 2 parts .0 to .* estimate_parts"):
        kc.estimate_states(recording, BARE)
    first, second = kc.recordings.estimate_parts(recording, BARE)
    assert first.time[-1] <= 1.0 + 1e-9 and second.time[0] >= 1.5 - 1e-9
    for part in (first, second):
        error = np.asarray(part.part("p")) - true_part("p", np.asarray(part.time))
        assert np.abs(error).max() < 1e-3
    chosen = kc.estimate_states(recording, BARE, start=1.6, end=2.4)
    assert chosen.time[0] == pytest.approx(1.6) and chosen.time[-1] == pytest.approx(2.4)


def test_the_controls_are_those_that_led_to_each_row():
    recording = recorded(tendons=4)
    ramp = np.linspace(1.0, 2.0, len(recording.control.time))[:, None] * np.ones(4)
    recording = dataclasses.replace(recording, control=dataclasses.replace(recording.control, values=ramp))
    states = kc.estimate_states(recording, BARE, "paper")
    held = recording.sampled(0.05).control
    np.testing.assert_array_equal(states.control[1:], held[:-1])
    np.testing.assert_array_equal(states.control[0], held[0])


@pytest.mark.parametrize(
    ("recording", "robot", "options", "said"),
    [
        (recorded(turned=False), BARE, {}, "no body has orientations"),
        (recorded(tendons=3), BARE, {}, r"the controls tension \(4\); the recording has 3 controls"),
        (recorded(), BARE.replace(length=2.0), {}, "allowed is up to 2 times"),
        (recorded(), BARE, {"method": "kalman"}, 'allowed is "best" or "paper"'),
        (recorded(), BARE, {"start": 9.0}, "no rows"),
        (recorded(), BARE, {"start": 2.9}, "no 4 rows"),
        (recorded(), "robot", {}, "robot is a str"),
        ("x.bag", BARE, {}, "recording is a str"),
        (dataclasses.replace(recorded(), bodies=recorded().bodies[-1:]), BARE, {}, "1 bodies on the rod"),
        (recorded().sampled(0.05), BARE, {"dt": 0.02}, "rows are 0.05 s apart"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(recording, robot, options, said):
    with pytest.raises(kc.recordings.RecordingError, match=said) as caught:
        kc.estimate_states(recording, robot, **options)
    assert "\n" not in str(caught.value)


def test_the_paper_needs_every_orientation():
    recording = recorded()
    bodies = (dataclasses.replace(recording.bodies[0], quaternion=None), *recording.bodies[1:])
    recording = dataclasses.replace(recording, bodies=bodies)
    with pytest.raises(kc.recordings.RecordingError, match="needs that of every body"):
        kc.estimate_states(recording, BARE, "paper")
    states = kc.estimate_states(recording, BARE)
    error = np.asarray(states.part("p")) - true_part("p", np.asarray(states.time))
    assert np.abs(error).max() < 1e-4


def test_systems_that_are_no_clamped_rods_are_turned_down():
    class Other(kc.robots.TendonRobot):
        base_unknowns = ("n", "w")

    other = Other(**{name: getattr(ROBOT, name) for name in ROBOT.parameters()})
    with pytest.raises(kc.recordings.RecordingError, match="clamped"):
        kc.estimate_states(recorded(), other)
