"""What `inspect` reports, against recordings whose noise, gaps and latency are known."""

import json

import numpy as np
import pytest
import typer.testing
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.cli import app
from knode_cosserat.recordings.frame import leans_of, rod_lengths
from knode_cosserat.recordings.streams import Body, ControlRows
from tests.recordings.made import LAG, PAPER, changed, made, write

NOISE = 2e-4


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A recording with gaps, a swap and delays."""
    streams = made(seconds=8.0, noise=NOISE)
    rng = np.random.default_rng(1)
    kept = np.flatnonzero(rng.uniform(size=800) > 0.05)
    kept = kept[(kept < 400) | (kept >= 450)]
    streams = changed(streams, "rib 2", rows=kept)
    quaternion = streams[0]["rib 4"].quaternion.copy()
    turned = Rotation.from_quat(quaternion[300:], scalar_first=True) * Rotation.from_euler(
        "z", 90, degrees=True
    )
    quaternion[300:] = turned.as_quat(scalar_first=True)
    streams = changed(streams, "rib 4", quaternion=quaternion)
    path = tmp_path_factory.mktemp("health") / "it.bag"
    return write(path, streams, delays={"/tension": 0.002}), kept


@pytest.fixture(scope="module")
def recording(bag):
    return kc.load_recording(bag[0])


@pytest.fixture(scope="module")
def report(recording):
    return recording.health()


def test_rates_and_gaps_are_counted(report, bag):
    streams = {stream.what: stream for stream in report.streams}
    assert list(streams) == ["rib 1", "rib 2", "rib 3", "rib 4", "base", "measured tensions", "commands"]
    whole, lossy = streams["rib 1"], streams["rib 2"]
    assert (whole.rows, whole.gaps, whole.missing) == (800, 0, 0.0)
    assert whole.rate == pytest.approx(100.0)
    assert whole.longest_gap == pytest.approx(0.01)
    steps = np.diff(bag[1])
    assert lossy.rows == len(bag[1])
    assert lossy.gaps == np.sum(steps > 1)
    assert lossy.missing == pytest.approx(1.0 - len(bag[1]) / (bag[1][-1] - bag[1][0] + 1), abs=1e-6)
    assert lossy.longest_gap == pytest.approx(0.01 * steps.max())
    assert streams["measured tensions"].rate == pytest.approx(50.0)
    assert streams["measured tensions"].delay == pytest.approx(0.002)
    assert streams["commands"].rate is None


def test_noise_is_told(report):
    for stream in report.streams:
        if stream.what.startswith("rib"):
            assert stream.noise == pytest.approx(NOISE, rel=0.35)
            assert stream.turn_noise == pytest.approx(10 * NOISE, rel=0.35)
        elif stream.what == "measured tensions":
            assert stream.noise == pytest.approx(0.01, rel=0.35)


def test_the_lag_of_the_motors_is_found(report):
    # all of it is lag
    assert report.latency.lag == pytest.approx(LAG, abs=0.004)
    assert report.latency.delay < 0.006
    assert report.latency.total == pytest.approx(LAG, abs=0.004)
    assert not any("configuration's latency" in finding.message for finding in report.findings)


def test_a_pure_delay_is_found_and_said_if_it_is_not_the_stated_one(tmp_path):
    poses, _, command = made(seconds=8.0)
    time = np.round(np.arange(0.0, 8.0, 0.01), 6)
    held = command.values[np.maximum(np.searchsorted(command.time, time - 0.15 + 1e-9, side="right") - 1, 0)]
    report = kc.load_recording(
        write(tmp_path / "it.bag", (poses, ControlRows(time, held + 0.1), command))
    ).health()
    assert report.latency.shift == pytest.approx(0.15, abs=0.011)
    assert report.latency.delay == pytest.approx(0.15, abs=0.006)
    assert report.latency.lag < 0.006
    words = "tensions follow commands after 0.15 s; the configuration's latency is 0.06 s"
    assert any(words in finding.message for finding in report.findings)
    # and with the delay out of the way only the offset is left
    for error in report.control_errors:
        assert error.bias == pytest.approx(0.1, abs=0.01)


def test_commands_that_do_not_change_say_nothing_about_latency(tmp_path):
    poses, tension, command = made(seconds=1.0)
    report = kc.load_recording(write(tmp_path / "it.bag", (poses, tension, command))).health()
    assert report.latency is None
    assert len(report.control_errors) == 4
    assert max(abs(error.bias) for error in report.control_errors) < 0.01


def test_the_rod_and_its_rest_are_told(report):
    assert report.rest == pytest.approx((0.0, 1.0), abs=0.06)
    np.testing.assert_allclose(report.rod_length, 0.635, atol=1e-3)
    assert report.simulated is None
    assert report.duration == pytest.approx(7.98)


def test_a_recording_without_commands_or_rest_still_has_a_report(tmp_path):
    poses, tension, _ = made(seconds=4.0)
    moving = {name: Body(it.time[120:], it.position[120:], it.quaternion[120:]) for name, it in poses.items()}
    recording = kc.load_recording(write(tmp_path / "it.bag", (moving, tension, None)))
    report = recording.health()
    assert report.rest is None
    assert report.latency is None
    assert report.control_errors == ()
    assert all(stream.noise is not None for stream in report.streams)
    kc.figures.health(recording).savefig(tmp_path / "it.png")


# the command


def told(*arguments):
    result = typer.testing.CliRunner().invoke(app, ["inspect", *map(str, arguments)])
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    return result.stdout


def test_inspect_says_it_in_words(bag):
    text = told(bag[0])
    for words in (
        "simulated: not stated",
        "at rest from 0.00 to 1.0",
        "/vicon/continuum_1/pose",
        "measured minus commanded",
        "warning: /vicon/continuum_3/pose: its axes were swapped at 3.000 s, by 90 degrees about (0, 0, 1)",
        "too long to be bridged (",
    ):
        assert words in text
    titles = next(line for line in text.splitlines() if line.startswith("topic "))
    row = next(line for line in text.splitlines() if line.startswith("/vicon/continuum_0/pose"))
    assert row[titles.index("rate [Hz]") :].startswith("100.00")


def test_inspect_draws_and_gives_json(bag, report, tmp_path):
    facts = json.loads(told(bag[0], "--json", "--plot", tmp_path / "it.png"))
    assert facts["plot"] == str(tmp_path / "it.png")
    assert facts["latency"]["lag"] == report.latency.lag
    assert facts["streams"][1]["rows"] == len(bag[1])
    assert [finding["message"] for finding in facts["findings"]] == [it.message for it in report.findings]
    assert (tmp_path / "it.png").read_bytes().startswith(b"\x89PNG")
    assert f"wrote {tmp_path / 'it.pdf'}" in told(bag[0], "--plot", tmp_path / "it.pdf")


def test_the_figure_shows_what_was_found(recording, report):
    figure = kc.figures.health(recording)
    tensions, x, y, z, frames = figure.axes[:5]
    np.testing.assert_array_equal(x.lines[0].get_xdata(), recording.bodies[0].time)
    np.testing.assert_array_equal(z.lines[3].get_ydata(), recording.bodies[3].position[:, 2])
    # a line breaks where nothing was seen for long
    assert np.isnan(y.lines[1].get_ydata()).sum() == 1
    labels = [text.get_text() for text in frames.get_legend().get_texts()]
    assert set(labels) == {"gap", "bridged", "axes swapped"}
    assert [tick.get_text() for tick in frames.get_yticklabels()][:2] == ["rib 1", "rib 2"]
    assert len(tensions.lines) == 8


def test_inspect_takes_a_configuration(bag, tmp_path):
    PAPER.replace(simulated=False, description="on the bench").save(tmp_path / "it.yaml")
    text = told(bag[0], "--config", tmp_path / "it.yaml")
    assert text.startswith("it.bag: on the bench\nsimulated: no\n")


def test_inspect_refuses_in_one_line(tmp_path):
    result = typer.testing.CliRunner().invoke(app, ["inspect", str(tmp_path / "nowhere.bag")])
    assert result.exit_code == 2
    assert result.stderr == f"error: {tmp_path / 'nowhere.bag'}: no such file\n"


# the length of a rod that is not straight at rest


SHAPES = {
    "straight": lambda u: np.ones_like(u),
    "an arc": lambda u: u,
    "a load at the tip": lambda u: 2.0 * u - u**2,
    "its weight": lambda u: 1.0 - (1.0 - u) ** 3,
    "a weight in the middle": lambda u: np.where(u < 0.5, 4.0 * (u - u**2), 1.0),
}


def places(shape, angle, length, at=(1.0,)):
    """Places on a plane curve with the angle `angle` times a shape from the z axis, by quadrature."""
    u = np.linspace(0.0, 1.0, 20001)
    turned = angle * SHAPES[shape](u)
    steps = np.stack([np.sin(turned), 0.0 * u, np.cos(turned)], axis=1)
    along = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (steps[1:] + steps[:-1]), axis=0)])
    return length * along[[round(20000 * each) for each in at]] / 20000


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("angle", [0.02, 0.1, 0.25, 0.5, 0.8, 1.2, 1.6])
def test_a_length_is_told_within_half_a_percent_or_not_at_all(shape, angle):
    fractions = (0.3, 0.6, 1.0)
    where = places(shape, angle, 0.3, fractions)
    time = np.arange(30) * 0.01
    bodies = [
        Body(time, np.tile(each, (30, 1)), None, name, name, fraction)
        for name, fraction, each in zip("abc", fractions, where, strict=True)
    ]
    lengths = rod_lengths(bodies, where)
    np.testing.assert_allclose(lengths, 0.3, rtol=5e-3)
    assert len(lengths) == np.sum(leans_of(where) <= np.radians(10.0))


def test_a_robot_that_sags_has_no_wrong_length(tmp_path):
    tip = places("its weight", 1.0, 0.3)[0]
    path = tmp_path / "it.csv"
    rows = [f"{0.01 * k:.2f},{tip[0]:.6f},0,{tip[2]:.6f},1,1" for k in range(100)]
    head = "# fraction tip: 1.0\n# source: a robot\ntime [s],tip_x [m],tip_y [m],tip_z [m],"
    path.write_text(head + "tension_1 [N],tension_2 [N]\n" + "\n".join(rows) + "\n", encoding="utf-8")
    report = kc.load_recording(path).health()
    assert report.rod_length == ()
    (note,) = [each.message for each in report.findings if "does not tell the rod's length" in each.message]
    least = float(note.split("it is above ")[1].split(" m")[0])
    assert 0.25 < least < 0.3
    assert "length of the rod" not in told(path)
