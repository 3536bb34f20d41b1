"""The rod's frames at its bodies while it rests: straight, or leaning as its bodies' positions say."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings import RecordingConfig, load_recording
from knode_cosserat.recordings.streams import Body
from tests.recordings.made import write

LENGTH = 0.6
TIME = np.linspace(0.0, 1.0, 50)


def resting(path, curve, fractions, noise=0.0, **settings):
    """Bodies with unknown axes that rest on a curve of the fraction of the length (m), as they are read."""
    rng = np.random.default_rng(0)
    markers = [{"name": f"body{k}", "fraction": fraction} for k, fraction in enumerate(fractions)]
    config = RecordingConfig(markers=markers, controls="none", **settings)
    poses = {}
    for marker in config.markers:
        position = curve(marker.fraction) + noise * rng.normal(size=(len(TIME), 3))
        poses[marker.name] = Body(TIME, position, np.tile(Rotation.random(rng=rng).as_quat(), (len(TIME), 1)))
    return load_recording(write(path / "it.csv", (poses, None, None), config), config).bodies


def frames(bodies):
    return [Rotation.from_quat(body.quaternion[0], scalar_first=True) for body in bodies]


def turned_off(found, true):
    """Largest angle (rad) between rotations."""
    return max((a.inv() * b).magnitude() for a, b in zip(found, true, strict=True))


def arc(angle, heading):
    """An arc that turns by an angle from z towards a heading, without twist: positions and frames."""
    across = np.array([np.cos(heading), np.sin(heading), 0.0])

    def position(s):
        turned = s * angle
        along, off = np.sinc(turned / np.pi) * s, (1.0 - np.cos(turned)) / angle
        return LENGTH * (along * np.array([0.0, 0.0, 1.0]) + off * across)

    def frame(s):
        return Rotation.from_rotvec(s * angle * np.cross([0.0, 0.0, 1.0], across))

    return position, frame


@pytest.mark.parametrize("fractions", [(1 / 3, 5 / 9, 7 / 9, 1.0), (0.5, 1.0), (0.0, 0.3, 0.6, 1.0)])
@pytest.mark.parametrize(("angle", "heading"), [(0.2, 0.0), (0.5, 2.0), (1.0, -1.3)])
def test_a_leaning_rod_has_the_frames_of_its_curve(tmp_path, fractions, angle, heading):
    """A cubic bends a fraction of the arc's angle differently, most at the tip, where it does not bend."""
    position, frame = arc(angle, heading)
    found = frames(resting(tmp_path, position, fractions, 2e-4))
    true = [frame(fraction) for fraction in fractions]
    assert turned_off(found, true) < 0.18 * angle + 0.005
    assert turned_off([Rotation.identity()] * len(true), true) > 0.9 * angle


def test_a_straight_rod_points_up_exactly(tmp_path):
    """Noise, and a mounting that is off by less than 3 degrees, do not turn its frames."""
    bodies = resting(tmp_path, lambda s: LENGTH * s * np.array([0.02, -0.03, 1.0]), (0.3, 0.6, 1.0), 1e-3)
    assert turned_off(frames(bodies), [Rotation.identity()] * 3) < 1e-12


def test_bodies_that_were_not_seen_at_rest_have_no_orientations(tmp_path):
    bodies = resting(tmp_path, arc(0.5, 0.0)[0], (0.3, 1.0), rest=(5.0, 6.0))
    assert [body.quaternion for body in bodies] == [None, None]


def test_a_curve_in_space_is_not_twisted(tmp_path):
    """Frames turn by the shortest way along bends to two sides: no turn about the axis."""

    def curve(s):
        return LENGTH * np.array([0.2 * s**2, 0.2 * max(0.0, s - 0.4) ** 2, s])

    found = frames(resting(tmp_path, curve, (0.25, 0.5, 0.75, 1.0)))
    for before, after in zip([Rotation.identity(), *found], found, strict=False):
        step = (before.inv() * after).as_rotvec()
        assert abs(step[2]) < 0.02 * np.linalg.norm(step)
