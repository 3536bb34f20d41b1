"""The example of a robot of one's own, and the page that is made with it."""

from pathlib import Path

import pytest

import knode_cosserat as kc
from examples import your_own_robot
from examples.your_own_robot import HERE, main

PAGE = Path(__file__).parents[1] / "docs" / "your-own-robot.md"


def test_its_files_are_those_of_the_page():
    page = PAGE.read_text(encoding="utf-8")
    for name in ("your_own_robot.yaml", "your_own_recording.yaml"):
        assert (HERE / name).read_text(encoding="utf-8") in page
    robot = kc.load_robot(HERE / "your_own_robot.yaml")
    config = kc.recordings.RecordingConfig.load(HERE / "your_own_recording.yaml")
    assert robot.control_layout.size == config.count == 3
    assert [marker.fraction for marker in config.markers] == [1.0]
    for picture in ("health", "before", "after"):
        assert f"images/own-robot-{picture}.png" in page
        assert (PAGE.parent / "images" / f"own-robot-{picture}.png").stat().st_size < 150_000


@pytest.mark.campaign
def test_it_predicts_what_it_has_not_seen(tmp_path, monkeypatch, capsys):
    """Half as long, with one recording to learn from."""
    signals = {name: your_own_robot.SIGNALS[name] for name in ("sine-1", "unseen")}
    monkeypatch.setattr(your_own_robot, "SIGNALS", signals)
    before, after = main(tmp_path, seconds=4.0)
    assert after < 0.2 * before and after < 0.01
    assert "youngs_modulus" in capsys.readouterr().out
    found = kc.load_robot(tmp_path / "found.yaml")
    assert isinstance(found, kc.robots.RoutedTendonRobot) and found.friction is not None
    assert {file.name for file in tmp_path.iterdir()} == {
        "sine-1.csv",
        "unseen.csv",
        "found.yaml",
        "health.png",
        "before.png",
        "after.png",
    }
