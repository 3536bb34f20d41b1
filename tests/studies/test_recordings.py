"""The study of recordings: which are learned from, what is written, and that the best model predicts."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.recordings import RecordingConfig
from knode_cosserat.recordings.streams import Body, ControlRows
from knode_cosserat.recordings.write import write_recording
from knode_cosserat.rods.section import Sleeve
from knode_cosserat.rods.tendons import TendonFriction
from knode_cosserat.schemes.result import Result, SimulationError
from studies import recordings as study
from studies.recordings import table_of
from studies.runner import StudyError
from tests.commands import run_study

PAPER = RecordingConfig.paper_robot()
DT = 0.01
TRUE = kc.robots.RoutedTendonRobot.like(
    kc.load_robot("delrin-tendon-robot"),
    bending_damping=5e-3,
    friction=TendonFriction(wobble=0.5, reach=0.15),
    sections=(Sleeve(stiffening=0.5, length=0.11),),
)
SECONDS = 4.0


def recorded(path, tension, seed):
    """A bag of the true robot: 1 s of rest, then the tensions at 100 Hz."""
    rng = np.random.default_rng(seed)
    rest = np.full((100, 4), 5.0)
    control = np.concatenate([rest, tension, tension[-30:]])
    moved = kc.simulate(TRUE, control, DT)
    time = np.asarray(moved.time)
    nodes = dict(zip((marker.name for marker in PAPER.markers), (3, 5, 7, 9), strict=True))
    poses = {}
    for name, node in nodes.items():
        turned = Rotation.from_quat(np.asarray(moved.quaternion)[:, node], scalar_first=True)
        poses[name] = Body(
            time,
            np.asarray(moved.position)[:, node] + rng.normal(0.0, 2e-4, (len(time), 3)),
            (turned * Rotation.from_rotvec(rng.normal(0.0, 2e-3, (len(time), 3)))).as_quat(scalar_first=True),
        )
    still = np.tile([0.0, 0.0, PAPER.base.height], (len(time), 1))
    poses["base"] = Body(time, still, np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1)))
    pulled = ControlRows(time[::2][: len(control[::2])], control[::2])
    write_recording(path, PAPER, poses, pulled, pulled)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Four short bags."""
    there = tmp_path_factory.mktemp("bags")
    rows = int(SECONDS / DT)

    def sine(period):
        return kc.controls.sine(period, rows, DT, base=5.0, amplitude=3.0)

    given = {
        "sine_1p0": sine(1.0),
        "rand_0": kc.controls.random(rows, low=4.0, high=7.0, seed=1, hold=40),
        "sine_2p0": sine(2.0),
        "other": kc.controls.random(rows, low=4.0, high=7.0, seed=2, hold=40),
    }
    for k, (name, tension) in enumerate(given.items()):
        recorded(there / f"{name}.bag", tension, k)
    return there


def run(*arguments):
    return run_study("recordings", *arguments)


@pytest.mark.campaign
def test_the_knowledge_alone(folder, tmp_path):
    """A second run takes what is there; what is written is the same."""
    given = (folder, "--out", tmp_path, "--train", "sine_1p0,rand_0", "--methods", "baseline", "--seconds", 3)
    first = run(*given)
    assert first.exit_code == 0, first.output
    cells = json.loads((tmp_path / "table2.json").read_text())
    assert [cell["recording"] for cell in cells] == ["other", "sine_2p0"]
    assert all(
        set(cell) == {"recording", "method", "seed", "tip_dtw", "pose_mse", "tip_rmse", "rotation_rmse"}
        for cell in cells
    )
    # the figures are those of the plain way, by hand
    seen = kc.load_recording(folder / "sine_2p0.bag").sampled(0.05, 1.0, 4.0)
    robot = kc.load_robot("delrin-tendon-robot")
    still = kc.equilibrium(robot, seen.initial_control, space=study.SPACE)
    moved = kc.simulate(robot, seen.control[:-1], 0.05, initial=still, space=study.SPACE)
    off = np.asarray(moved.tip_position)[:60] - seen.tip_position[:60]
    assert cells[1]["tip_rmse"] == pytest.approx(np.sqrt(np.mean(np.sum(off**2, axis=1))), rel=1e-9)
    table = (tmp_path / "table2.md").read_text()
    assert "It is not stated whether" in table and "| sine_2p0 " in table
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == {"paths", "tip-x", "horizon"}
    kept = (tmp_path / "jobs" / "baseline.json").stat().st_mtime_ns
    again = run(*given, "--simulated")
    assert again.exit_code == 0 and (tmp_path / "jobs" / "baseline.json").stat().st_mtime_ns == kept
    assert "of a simulated robot, not of a physical one" in (tmp_path / "table2.md").read_text()


@pytest.mark.campaign
@pytest.mark.sample
def test_a_folder_describes_its_robot_and_its_topics(folder, tmp_path):
    """robot.yaml and recording.yaml beside the recordings are used, and named, unless others are given."""
    own = tmp_path / "own"
    own.mkdir()
    for name in ("sine_1p0", "sine_2p0"):
        (own / f"{name}.bag").symlink_to(folder / f"{name}.bag")
    softer = kc.load_robot("delrin-tendon-robot").replace(youngs_modulus=2.0e9)
    kc.save_robot(softer, own / "robot.yaml")
    kc.recordings.RecordingConfig.paper_robot().replace(description="ours").save(own / "recording.yaml")
    given = (own, "--train", "sine_1p0", "--methods", "baseline", "--seconds", 2)

    def errors(name, *more):
        done = run(*given, "--out", tmp_path / name, *more)
        assert done.exit_code == 0, done.output
        (cell,) = json.loads((tmp_path / name / "table2.json").read_text())
        return cell["tip_rmse"], done.output

    (found, told), (same, silent) = errors("a"), errors("b", "--robot", own / "robot.yaml")
    assert found == same
    assert f"using robot.yaml and recording.yaml of {own}" in told
    assert f"using recording.yaml of {own}" in silent
    assert errors("c", "--robot", "delrin-tendon-robot")[0] != pytest.approx(found, rel=0.1)


@pytest.mark.campaign
def test_the_whole_table(folder, tmp_path):
    """The best model is the robot's kind: what it has not seen it predicts; the paper's learns."""
    done = run(
        folder,
        "--out",
        tmp_path,
        "--train",
        "sine_1p0",
        "--train",
        "rand_0",
        "--seconds",
        3,
        "--seeds",
        2,
        "--physical",
    )
    assert done.exit_code == 0, done.output
    cells = json.loads((tmp_path / "table2.json").read_text())
    by = {(cell["recording"], cell["method"], cell["seed"]): cell for cell in cells}
    assert len(by) == 2 * (1 + 2 + 2 + 1)
    for name in ("other", "sine_2p0"):
        base, best = by[name, "baseline", 0], by[name, "best", 0]
        for measure in ("tip_dtw", "pose_mse", "tip_rmse"):
            assert best[measure] < 0.1 * base[measure]
    assert kc.load_robot(tmp_path / "models" / "best.yaml").friction.wobble > 0.0
    assert isinstance(kc.load_model(tmp_path / "models" / "paper-a-1"), kc.KNODE)
    assert (tmp_path / "figures" / "loss.png").exists()
    assert "recordings are of a physical robot" in (tmp_path / "table2.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("solved", [0, 3])
def test_a_model_that_fails_is_reported_soon(folder, monkeypatch, solved):
    """Nothing is tried to save one that fails everywhere, nor after recovery has not helped once."""
    given = []

    def failing(system, measured, *, recovery, **_):
        given.append(recovery)
        if len(given) > solved:
            raise SimulationError(1, DT, 1.0, Result.NO_CONVERGENCE, "")

    def nothing_learned(method, knowledge, *_):
        return study.TrainedSystems({0: kc.KNODE(knowledge, Nothing())})

    monkeypatch.setattr(study, "predict", failing)
    monkeypatch.setattr(study, "compared", lambda *_, **__: study.Evaluation(0.0, 0.0, 0.0))
    monkeypatch.setattr(study, "trained", nothing_learned)
    paths = study.recordings_in(folder)
    train, _ = study.recording_split(list(paths), ["sine_1p0"])
    jobs = study.jobs(paths, train, ["baseline"], study.RecordingsOptions(seconds=3.0))
    product = study.predicted(next(each for each in jobs if each.key == "baseline").settings)
    assert given == [0.0] * len(paths) + [study.RECOVERY] * (solved > 0)
    failed = [cell for cell in product.facts["cells"] if "failed" in cell]
    assert len(failed) == len(paths) - solved


def test_what_is_nearly_all_is_not_all():
    cells = [
        {"recording": "step", "method": method, "seed": 0, "tip_dtw": dtw}
        for method, dtw in (("baseline", 50.0), ("network", 12.4), ("best", 0.2), ("worse", 60.0))
    ]
    row = table_of(cells, "tip_dtw", 1.0, ["baseline", "network", "best", "worse"]).splitlines()[-1]
    assert [each.strip() for each in row.split("|")[2:-1]] == [
        "50",
        "12.4 (75 %)",
        "0.2 (99.6 %)",
        "60 (-20 %)",
    ]


def test_which_are_learned_from():
    names = ["a", "rand_0", "sine_1p0", "sine_3p0", "step"]
    assert study.recording_split(names, None) == (["sine_1p0", "sine_3p0", "rand_0"], ["a", "step"])
    assert study.recording_split(names, ["a"])[1] == ["rand_0", "sine_1p0", "sine_3p0", "step"]


@pytest.mark.parametrize(
    ("files", "train", "parts"),
    [
        ([], None, ("no recordings there", ".bag")),
        (["a.bag", "a.csv"], None, ("a.bag and a.csv", "same name")),
        (["a.bag"], None, ("'sine_1p0'", "--train")),
        (["a.bag", "b.bag"], ["c"], ("'c'", "a, b")),
        (["a.bag"], ["a"], ("others predicted",)),
    ],
)
def test_folders_that_will_not_do(tmp_path, files, train, parts):
    for name in files:
        (tmp_path / name).touch()
    with pytest.raises(StudyError) as error:
        study.recording_split(list(study.recordings_in(tmp_path)), train)
    message = str(error.value)
    assert "\n" not in message and all(part in message for part in parts)


def test_a_recording_that_is_none(tmp_path):
    for name in ("sine_1p0", "sine_3p0", "rand_0", "broken"):
        (tmp_path / f"{name}.bag").write_bytes(b"nonsense")
    broken = run(tmp_path, "--out", tmp_path / "out", "--methods", "baseline")
    assert broken.exit_code != 0 and ".bag" in broken.output and "Traceback" not in broken.output


def test_configurations_beside_recordings_are_used_if_they_are_the_same(tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.bag").write_bytes(b"")
        PAPER.save(tmp_path / f"{name}.yaml")
    assert study.described_in(tmp_path) == {"config": tmp_path / "a.yaml"}
    PAPER.replace(simulated=True).save(tmp_path / "b.yaml")
    assert study.described_in(tmp_path) == {}
    (tmp_path / "b.yaml").unlink()
    assert study.described_in(tmp_path) == {}
    PAPER.save(tmp_path / "recording.yaml")
    assert study.described_in(tmp_path) == {"config": tmp_path / "recording.yaml"}
