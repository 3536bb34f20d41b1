"""What sensors get wrong is found, said and mended, and what is right is left alone."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.recordings import RecordingConfig, checks
from knode_cosserat.recordings.config import ControlSource, MarkerSource
from knode_cosserat.recordings.formats import bag
from knode_cosserat.recordings.streams import Body, ControlRows
from knode_cosserat.recordings.write import START, write_recording
from tests.recordings.made import CLAMP, PAPER, TURNED, changed, made, moved, write

TIP = "/vicon/continuum_3/pose"
CUBE = Rotation.create_group("O")
CUBE = CUBE[np.flatnonzero(CUBE.magnitude() > 0.1)]


@pytest.fixture(scope="module")
def streams():
    return made()


def read(tmp_path, streams, config=PAPER, **options):
    return kc.load_recording(write(tmp_path / "it.bag", streams, config, **options), config)


def said(recording, words):
    found = [finding for finding in recording.findings if words in finding.message]
    assert len(found) == 1, [str(finding) for finding in recording.findings]
    return found[0]


def largest_turn(body):
    """How far orientations are from the truth at most (rad)."""
    truth = moved(body.time, body.fraction)[1]
    return (Rotation.from_quat(body.quaternion, scalar_first=True).inv() * truth).magnitude().max()


def test_a_clean_recording_has_nothing_to_say(tmp_path, streams):
    recording = read(tmp_path, streams)
    assert recording.findings == ()
    assert recording.rest == pytest.approx((0.0, 1.0), abs=0.05)
    assert [len(body.time) for body in recording.bodies] == [300] * 4
    assert max(map(largest_turn, recording.bodies)) < 0.01


# swapped axes


def swapped(streams, at, by):
    """The tip's axes swapped from a row on."""
    quaternion = streams[0]["rib 4"].quaternion.copy()
    turned = Rotation.from_quat(quaternion[at:], scalar_first=True) * by
    quaternion[at:] = turned.as_quat(scalar_first=True)
    return changed(streams, "rib 4", quaternion=quaternion)


def test_every_swap_of_axes_is_undone(streams):
    # in the fastest motion
    time, quaternion = streams[0]["rib 4"].time, streams[0]["rib 4"].quaternion
    assert len(CUBE) == 23
    for by in CUBE:
        wrong = swapped(streams, 150, by)[0]["rib 4"].quaternion
        mended, swaps, unclear = checks.swaps_undone(time, wrong)
        assert [row for row, _, _ in swaps] == [150]
        assert unclear == []
        np.testing.assert_allclose(np.abs(np.sum(mended * quaternion, axis=1)), 1.0, rtol=0, atol=1e-9)


def test_a_swap_is_said_with_its_time(tmp_path, streams):
    recording = read(tmp_path, swapped(streams, 150, Rotation.from_euler("x", 90, degrees=True)))
    finding = said(recording, "axes were swapped")
    assert finding.severity == "warning"
    assert finding.topic == TIP
    assert finding.times == pytest.approx((1.5,))
    assert "at 1.500 s, by 90 degrees about (1, 0, 0); undone" in finding.message
    assert largest_turn(recording.bodies[3]) < 0.01


def test_swaps_one_after_the_other_and_back_are_undone(tmp_path, streams):
    first, second = Rotation.from_euler("y", 90, degrees=True), Rotation.from_euler("z", 180, degrees=True)
    wrong = swapped(swapped(streams, 120, first), 180, second)
    wrong = swapped(wrong, 240, (first * second).inv())
    recording = read(tmp_path, wrong)
    assert sum("axes were swapped" in finding.message for finding in recording.findings) == 3
    assert largest_turn(recording.bodies[3]) < 0.01


def test_a_swap_while_frames_are_lost_is_undone(tmp_path, streams):
    wrong = swapped(streams, 150, Rotation.from_euler("x", -90, degrees=True))
    recording = read(tmp_path, changed(wrong, "rib 4", rows=np.r_[0:147, 151:300]))
    said(recording, "axes were swapped at 1.510 s")
    assert largest_turn(recording.bodies[3]) < 0.01


def test_motion_is_no_swap():
    # 90 degrees in 0.1 s, seen at 100 Hz and, as far as it can be judged, with pauses
    time = np.arange(0.0, 2.0, 0.01)
    turning = Rotation.from_rotvec(np.outer(time, [0.0, np.radians(900.0), 0.0]))
    quaternion = turning.as_quat(scalar_first=True)
    for kept in (slice(None), np.r_[0:100, 109:200], np.r_[0:50, 60:200]):
        mended, swaps, _ = checks.swaps_undone(time[kept], quaternion[kept])
        assert swaps == []
        np.testing.assert_array_equal(mended, quaternion[kept])


def test_a_turn_that_is_neither_is_said(tmp_path, streams):
    recording = read(tmp_path, swapped(streams, 150, Rotation.from_euler("x", 60, degrees=True)))
    finding = said(recording, "too large for a motion, and no swap of axes")
    assert finding.times == pytest.approx((1.5,))


# frames


def test_frames_that_jump_are_left_out(tmp_path, streams):
    position = streams[0]["rib 4"].position.copy()
    jumping = [40, 150, 151, 260]
    position[jumping] += [[0.02, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, -1.0]]
    recording = read(tmp_path, changed(streams, "rib 4", position=position))
    finding = said(recording, "out of the motion and back")
    assert finding.times == pytest.approx([0.4, 1.5, 1.51, 2.6])
    tip = recording.bodies[3]
    assert len(tip.time) == 296
    np.testing.assert_allclose(tip.position, moved(tip.time, 1.0)[0], rtol=0, atol=1e-3)


def test_single_orientations_that_jump_are_left_out(tmp_path, streams):
    quaternion = streams[0]["rib 4"].quaternion.copy()
    turned = Rotation.from_quat(quaternion[200], scalar_first=True) * Rotation.from_rotvec([0.5, 0.0, 0.2])
    quaternion[200] = turned.as_quat(scalar_first=True)
    recording = read(tmp_path, changed(streams, "rib 4", quaternion=quaternion))
    assert said(recording, "out of the motion and back").times == pytest.approx((2.0,))
    assert largest_turn(recording.bodies[3]) < 0.01


def test_no_frame_of_a_motion_is_an_outlier():
    rng = np.random.default_rng(0)
    for rate, noise in ((100.0, 1e-4), (20.0, 1e-4), (100.0, 0.0), (20.0, 0.0), (5.0, 1e-3)):
        time = np.arange(0.0, 16.0, 1.0 / rate)
        run = np.clip(time - 1.0, 0.0, None)
        decay = np.exp(-2.0 * run)
        for course in (
            0.3 * np.sin(2 * np.pi * run),
            0.3 * (1.0 - decay * np.cos(25.0 * run)),
            np.where(np.floor(run / 0.4) % 2, 0.2, -0.1) * (run > 0),
            1e-9 * run,
        ):
            seen = np.stack([course, 0.5 * course, 0.0 * course], axis=1)
            seen += rng.normal(0.0, noise, seen.shape)
            found = checks.outliers(np.diff(seen, axis=0), time, floor=5e-3, longest=4)
            # a square course that is seen five times a second does come back after two frames
            assert not found.any() or rate == 5.0


def test_poses_that_are_no_numbers_are_left_out(tmp_path, streams):
    position, quaternion = streams[0]["rib 4"].position.copy(), streams[0]["rib 4"].quaternion.copy()
    position[10], quaternion[20], quaternion[30] = np.nan, np.nan, 0.0
    position[40, 1], quaternion[50] = np.inf, 3.0
    recording = read(tmp_path, changed(streams, "rib 4", position=position, quaternion=quaternion))
    finding = said(recording, "5 poses are not finite, or no rotation; left out")
    assert finding.topic == TIP
    assert finding.times == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5])
    assert len(recording.bodies[3].time) == 295


def test_tensions_that_are_no_numbers_or_spikes_are_left_out(tmp_path, streams):
    poses, tension, command = streams
    wrong = tension.values.copy()
    wrong[20, 1], wrong[100, 2] = np.nan, 40.0
    recording = read(tmp_path, (poses, ControlRows(tension.time, wrong), command))
    assert said(recording, "1 tension is not finite").times == pytest.approx((0.4,))
    assert said(recording, "1 tension jumps up or down and back").times == pytest.approx((2.0,))
    assert len(recording.control.time) == len(tension.time) - 2


def test_a_base_that_moves_is_said(tmp_path, streams):
    position = streams[0]["base"].position.copy()
    position[150:] += [0.03, 0.0, 0.0]
    recording = read(tmp_path, changed(streams, "base", position=position))
    assert said(recording, "the base moves by 31 mm").topic == "/vicon/continuum_base/pose"


# clocks


def test_messages_out_of_order_and_twice_are_sorted(tmp_path, streams):
    config = dataclasses.replace(PAPER, base=None, origin=(0.3, -0.2, 0.8))
    poses = {name: pose for name, pose in streams[0].items() if name != "base"}
    order = np.r_[0:100, 101, 100, 102:200, 199, 200:300]
    tip = poses["rib 4"]
    poses["rib 4"] = Body(tip.time[order], tip.position[order], tip.quaternion[order])
    recording = read(tmp_path, (poses, *streams[1:]), config)
    assert said(recording, "a stamp is before the one in front of it; the messages were sorted").topic == TIP
    assert said(recording, "1 stamp is there twice").times == pytest.approx((1.99,))
    np.testing.assert_allclose(recording.bodies[3].time, tip.time, rtol=0, atol=1e-9)
    np.testing.assert_allclose(recording.bodies[3].position, tip.position - config.origin, rtol=0, atol=1e-12)


@pytest.mark.parametrize("jump", [0.7, -0.4])
def test_a_clock_that_is_set_meanwhile_is_told_by_the_times_of_recording(
    tmp_path, streams, jump, monkeypatch
):
    original = bag.encoder_of

    def restamped(stream, ros):
        encode = original(stream, ros)
        first = (START + 2) * 10**9 - 3_000_000 if stream.topic == TIP else np.inf
        return lambda stamp, row, values: encode(
            stamp + round(jump * 1e9) if stamp >= first else stamp, row, values
        )

    monkeypatch.setattr(bag, "encoder_of", restamped)
    recording = read(tmp_path, streams, delays={TIP: 0.003})
    finding = said(recording, "the clock of its stamps jumped")
    assert f"{jump:+.3f} s" in finding.message
    assert finding.times == pytest.approx((2.003,), abs=2e-3)
    np.testing.assert_allclose(recording.bodies[3].time, streams[0]["rib 4"].time, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("topics", "rate"), [((TIP,), 0.01), ((TIP,), -0.008), ((TIP,), 0.001), ((), 0.01)])
def test_a_clock_that_drifts_against_the_others_is_named(tmp_path, streams, topics, rate, monkeypatch):
    original = bag.encoded_messages

    def restamped(*arguments):
        for topic, received, message in original(*arguments):
            # without topics, all clocks drift alike against the recorder's
            late = round(rate * (received - START * 10**9)) if topic in topics or not topics else 0
            yield topic, received + late, message

    monkeypatch.setattr(bag, "encoded_messages", restamped)
    recording = read(tmp_path, streams)
    found = [each for each in recording.findings if "its clock drifts" in each.message]
    if not topics or abs(rate) < 0.005:
        assert not found
        return
    (finding,) = found
    assert finding.topic == TIP
    # medians of the first and the last fifth of 3 s
    assert f"drifts by {1e3 * abs(rate) * 2.4:.0f} ms" in finding.message


def test_a_clock_that_is_another_one_is_not_used(tmp_path, streams):
    recording = read(tmp_path, streams, delays={TIP: 3.0})
    finding = said(recording, "is 3.000 s behind the recorder's")
    assert finding.topic == TIP
    # then the times of recording, which here are 3 s late
    np.testing.assert_allclose(recording.bodies[3].time, streams[0]["rib 4"].time + 3.0, atol=1e-6)


def test_delays_of_recording_are_not_delays_of_measuring(tmp_path, streams):
    recording = read(tmp_path, streams, delays={TIP: 0.2})
    assert recording.delays[TIP] == pytest.approx(0.2)
    np.testing.assert_allclose(recording.bodies[3].time, streams[0]["rib 4"].time, rtol=0, atol=1e-9)
    by_recorder = dataclasses.replace(PAPER, clock="received")
    late = kc.load_recording(tmp_path / "it.bag", by_recorder)
    np.testing.assert_allclose(late.bodies[3].time, streams[0]["rib 4"].time + 0.2, rtol=0, atol=1e-6)


def test_a_stamp_of_another_year_does_not_make_a_recording_of_a_year(tmp_path, streams):
    time = streams[0]["rib 4"].time.copy()
    time[0], time[150] = -1e8, 1e8
    recording = read(tmp_path, changed(streams, "rib 4", time=time))
    assert said(recording, "2 messages are more than 600 s from the others").topic == TIP
    assert recording.end == pytest.approx(2.98)
    assert len(recording.sampled(0.05).time) == 60


# what is not plausible


def test_tensions_in_another_unit_are_flagged(tmp_path, streams):
    read(tmp_path, streams)
    for source, words in (
        (ControlSource("/tension", (4, 1, 2, 3), "N"), "are gf read as N?"),
        (PAPER.tension, None),
    ):
        config = dataclasses.replace(PAPER, tension=source)
        recording = kc.load_recording(tmp_path / "it.bag", config)
        problems = [finding for finding in recording.findings if finding.severity == "problem"]
        assert len(problems) == (2 if words else 0)
        if words:
            assert problems[0].topic == "/tension"
            assert words in problems[0].message
            assert "not the same unit?" in problems[1].message
    newtons = dataclasses.replace(PAPER, tension=dataclasses.replace(PAPER.tension, unit="N"))
    write(tmp_path / "newtons.bag", streams, newtons)
    recording = kc.load_recording(tmp_path / "newtons.bag")
    assert said(recording, "are N read as gf?").severity == "problem"


def test_positions_in_another_unit_are_flagged(tmp_path, streams):
    millimetres = dataclasses.replace(
        PAPER, position_unit="mm", base=dataclasses.replace(PAPER.base, height=0.0)
    )
    write(tmp_path / "it.bag", streams, millimetres)
    recording = kc.load_recording(tmp_path / "it.bag")
    assert "are positions in the unit that is said?" in said(recording, "bodies are up to").message


def test_bodies_in_another_order_are_flagged(tmp_path, streams):
    poses = dict(streams[0])
    poses["rib 1"], poses["rib 2"] = poses["rib 2"], poses["rib 1"]
    recording = read(tmp_path, (poses, *streams[1:]))
    finding = said(recording, "the bodies' fractions give the rod's length as 1058, 381, 635, 635 mm")
    assert finding.severity == "problem"


@pytest.mark.parametrize("degrees", [30.0, 90.0])
def test_a_straight_rod_that_does_not_point_along_its_axis_is_flagged(tmp_path, streams, degrees):
    turn = Rotation.from_rotvec([np.radians(degrees), 0.0, 0.0])
    poses = {name: each for name, each in streams[0].items() if name != "base"}
    upright = dataclasses.replace(PAPER, base=None)
    lying = dataclasses.replace(
        upright, frame_rotation=tuple(turn.as_quat(scalar_first=True)), origin=tuple(turn.apply(CLAMP))
    )
    write(tmp_path / "it.bag", (poses, *streams[1:]), upright)
    finding = said(kc.load_recording(tmp_path / "it.bag", lying), "at rest the last body")
    assert finding.severity == "problem"
    assert (
        f"{degrees:.0f} degrees from the axis of the clamped end, and the others as well" in finding.message
    )


@pytest.mark.parametrize(
    ("degrees", "severity"), [(2.0, None), (11.0, "note"), (60.0, "note"), (85.0, "problem")]
)
def test_a_robot_that_sags_at_rest_is_no_problem(tmp_path, streams, degrees, severity):
    """On an arc, as of a robot that lies, the chord leans by half of the bend; the length is the arc's."""
    poses, tension, command = streams
    bend = 2 * np.radians(degrees)
    sagging = {}
    for marker in PAPER.markers:
        own = poses[marker.name]
        s = marker.fraction
        arc = 0.635 * np.array([(1 - np.cos(s * bend)) / bend, 0.0, np.sin(s * bend) / bend])
        sagging[marker.name] = dataclasses.replace(own, position=own.position - own.position[0] + arc + CLAMP)
    recording = read(tmp_path, ({**poses, **sagging}, tension, command))
    about = [each for each in recording.findings if "at rest the last body" in each.message]
    assert [each.severity for each in about] == ([] if severity is None else [severity])
    if severity == "note":
        assert f"is {degrees:.0f} degrees" in about[0].message
        assert "sags, is bent or is pulled" in about[0].message
    np.testing.assert_allclose(recording.health().rod_length, 0.635, rtol=5e-3)
    assert not any("another order" in each.message for each in recording.findings)


def test_a_simulated_robot_is_called_one(tmp_path, streams):
    recording = read(tmp_path, streams, dataclasses.replace(PAPER, simulated=True))
    assert recording.simulated is True
    assert recording.sampled().simulated is True
    said(recording, "the robot was itself a simulation, and not a physical one")


def test_the_gravest_findings_come_first(tmp_path, streams):
    position = streams[0]["rib 4"].position.copy()
    position[150], position[200] = np.nan, 9.0
    recording = read(
        tmp_path, changed(streams, "rib 4", position=position), dataclasses.replace(PAPER, simulated=True)
    )
    assert [finding.severity for finding in recording.findings] == ["warning", "note", "note"]


def test_the_rest_can_be_given(tmp_path, streams):
    recording = read(tmp_path, streams, dataclasses.replace(PAPER, rest=(0.1, 0.6)))
    assert recording.rest == (0.1, 0.6)
    assert largest_turn(recording.bodies[3]) < 0.01


def test_two_tendons_and_a_rod_that_hardly_moves(tmp_path):
    config = RecordingConfig(
        markers=(MarkerSource("tip", "/tip", 1.0),), tension=ControlSource("/pull", (1, 2), "N")
    )
    time = np.round(np.arange(0.0, 2.0, 0.01), 6)
    turned = np.tile(TURNED[1].as_quat(scalar_first=True), (len(time), 1))
    tip = Body(time, np.tile([0.0, 0.0, 0.4], (len(time), 1)), turned)
    write_recording(
        tmp_path / "it.db3", config, {"tip": tip}, ControlRows(time, np.full((len(time), 2), 4.0))
    )
    recording = kc.load_recording(tmp_path / "it.db3", config)
    assert recording.rest == pytest.approx((0.0, 1.99))
    np.testing.assert_allclose(
        np.abs(recording.bodies[0].quaternion), np.eye(4)[:1].repeat(200, 0), atol=1e-12
    )
