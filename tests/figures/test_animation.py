import dataclasses
import os
import sys

import numpy as np
import pytest
from PIL import Image

import knode_cosserat as kc
from examples.hanging_string import HangingString

pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture(scope="module")
def trajectory():
    robot = kc.load_robot("delrin-tendon-robot")
    return kc.simulate(robot, kc.controls.sine(period=0.5, steps=16, dt=0.05), 0.05)


def frames_of(path):
    with Image.open(path) as image:
        for k in range(image.n_frames):
            image.seek(k)
            yield image.info["duration"], np.asarray(image.convert("RGB")).astype(int)


@pytest.mark.parametrize(
    ("fps", "speed", "count", "milliseconds"),
    [(25.0, 1.0, 21, 40), (30.0, 1.0, 27, 30), (10.0, 0.5, 17, 100)],
)
def test_a_gif_lasts_as_long_as_the_motion(tmp_path, trajectory, fps, speed, count, milliseconds):
    """0.8 s, first and last picture included; a GIF counts in hundredths of a second."""
    path = kc.figures.animate(trajectory, tmp_path / "it.gif", fps=fps, speed=speed)
    durations = [duration for duration, _ in frames_of(path)]
    assert durations == [milliseconds] * count
    assert (count - 1) * milliseconds / 1000 == pytest.approx(0.8 / speed, abs=milliseconds / 1000)
    with Image.open(path) as image:
        assert image.info["loop"] == 0  # for ever


def test_pictures_show_the_robot_where_it_is(tmp_path, trajectory):
    """Blue dots from the side reach to the tip's height and place, in metres by the axes' scale."""
    straight = trajectory[:1]
    bent = dataclasses.replace(straight, y=np.asarray(trajectory.y)[-1:], result=np.asarray(straight.result))
    two = dataclasses.replace(
        trajectory[:2],
        y=np.concatenate([np.asarray(straight.y), np.asarray(bent.y)]),
        time=np.array([0.0, 1.0]),
    )
    path = kc.figures.animate(two, tmp_path / "it.gif", fps=2.0, view="xz", dpi=100)
    places = []
    for _, picture in frames_of(path):
        blue = (picture[..., 2] > picture[..., 0] + 80) & (picture[..., 0] < 60)
        rows, columns = np.nonzero(blue)
        top = columns[rows <= rows.min() + 1].mean()
        base = columns[rows >= rows.max() - 1].mean()
        places.append(((top - base), rows.max() - rows.min()))
    (across, up), _, (moved, lower) = places
    dots = up / 0.635
    x, _, z = np.asarray(bent.tip_position)[0]
    assert abs(across) < 2 and abs(x) > 0.02
    assert moved / dots == pytest.approx(x, abs=3 / dots)
    assert lower / dots == pytest.approx(z, abs=4 / dots)


def test_several_are_overlaid_and_named(tmp_path, trajectory):
    one = kc.figures.animate({"truth": trajectory}, tmp_path / "one.gif", fps=10)
    both = kc.figures.animate({"truth": trajectory, "other": trajectory[:8]}, tmp_path / "both.gif", fps=10)
    counts = [len(list(frames_of(path))) for path in (one, both)]
    assert counts == [9, 9]
    grey = [
        (np.ptp(picture, axis=2) < 12) & (picture.mean(axis=2) > 150) & (picture.mean(axis=2) < 190)
        for _, picture in frames_of(both)
    ]
    assert all(each.sum() > 200 for each in grey)


def test_what_lives_in_a_plane_moves_too(tmp_path, trajectory):
    string = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=21)
    hanging = kc.equilibrium(string, np.array([0.6, -0.1]), space="lobatto4")
    two = dataclasses.replace(
        hanging,
        time=np.array([0.0, 0.2]),
        y=np.repeat(np.asarray(hanging.y), 2, axis=0),
        control=np.repeat(np.asarray(hanging.control), 2, axis=0),
        result=np.zeros(2, dtype=int),
    )
    assert len(list(frames_of(kc.figures.animate(two, tmp_path / "string.gif")))) == 6
    with pytest.raises(ValueError, match="some trajectories are in a plane and some in space"):
        kc.figures.animate({"a": two, "b": trajectory}, tmp_path / "no.gif")
    with pytest.raises(ValueError, match='seen from "xy" only'):
        kc.figures.animate(two, tmp_path / "no.gif", view="xz")


def test_what_was_not_solved_is_not_there(tmp_path, trajectory):
    y, result = np.array(trajectory.y), np.array(trajectory.result)
    y[9:], result[9:] = np.nan, kc.Result.NOT_REACHED
    path = kc.figures.animate(
        dataclasses.replace(trajectory, y=y, result=result), tmp_path / "it.gif", fps=20
    )
    blue = [((p[..., 2] > p[..., 0] + 80) & (p[..., 0] < 60)).sum() for _, p in frames_of(path)]
    assert len(blue) == 17 and min(blue[:9]) > 3 * max(blue[9:])


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("it.avi", {}, r"it.avi: allowed for a motion is a name that ends in .gif, .mp4"),
        ("it.gif", {"fps": 0}, "fps is 0; allowed is 1 to 50"),
        ("it.gif", {"fps": float("nan")}, "fps is nan"),
        ("it.gif", {"speed": -1.0}, "speed is -1.0"),
        ("it.gif", {"speed": 0.001}, "is 20001 pictures; allowed is up to 5000"),
        ("it.gif", {"view": "up"}, "view is 'up'"),
        ("it.gif", {"columns": 4}, "columns is 4"),
    ],
)
def test_wrong_input_is_one_line_and_no_file(tmp_path, trajectory, name, options, words):
    with pytest.raises(ValueError, match=words) as said:
        kc.figures.animate(trajectory, tmp_path / name, **options)
    assert "\n" not in str(said.value) and not list(tmp_path.iterdir())


def test_what_does_not_move_is_said(tmp_path, trajectory):
    with pytest.raises(ValueError, match="one row: nothing moves"):
        kc.figures.animate(trajectory[:1], tmp_path / "it.gif")
    with pytest.raises(ValueError, match="no trajectories"):
        kc.figures.animate({}, tmp_path / "it.gif")
    batch = dataclasses.replace(trajectory, y=np.asarray(trajectory.y)[None])
    with pytest.raises(ValueError, match="a batch of 1"):
        kc.figures.animate(batch, tmp_path / "it.gif")


def test_an_mp4_needs_ffmpeg_and_says_so(tmp_path, trajectory, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="needs the program ffmpeg, which is not on the PATH"):
        kc.figures.animate(trajectory, tmp_path / "it.mp4")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="a stand-in that is a script")
def test_ffmpeg_gets_every_dot_of_every_picture(tmp_path, trajectory, monkeypatch):
    """A stand-in for ffmpeg keeps what it is given; another one fails, and its words are told."""
    stand_in = tmp_path / "ffmpeg"
    stand_in.write_text(
        f"#!{sys.executable}\nimport sys\nopen(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())\n"
    )
    stand_in.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    path = kc.figures.animate(trajectory, tmp_path / "it.mp4", fps=10, dpi=50)
    gif = kc.figures.animate(trajectory, tmp_path / "it.gif", fps=10, dpi=50)
    with Image.open(gif) as image:
        width, height = image.size
    assert path.stat().st_size == 9 * width * height * 3
    stand_in.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('no such codec')\n")
    with pytest.raises(ValueError, match=r"ffmpeg could not write .*: no such codec"):
        kc.figures.animate(trajectory, tmp_path / "other.mp4", fps=10, dpi=50)
    assert not (tmp_path / "other.mp4").exists()
