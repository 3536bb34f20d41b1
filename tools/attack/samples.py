"""Good files of every kind that the package writes: their writers and readers, in two versions each."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import knode_cosserat as kc

DT = 0.05
ROBOT = "delrin-tendon-robot"


class Sample(NamedTuple):
    """A kind of file: writer of one of its two versions, and reader."""

    write: Callable[[Path, int], None]
    read: Callable[[Path], Any]


def samples() -> dict[str, Sample]:
    """Return the kinds of files by the file's name."""
    return {**_of_robots(), **_of_recordings(), **_of_learning(), **_of_sweeps()}


def fingerprint(value: Any) -> str:
    """Return a hash of all numbers and texts of what was read."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(getattr(value, "columns", value)):
        array = np.asarray(leaf)
        digest.update(str(array.dtype.kind).encode())
        digest.update(repr(leaf).encode() if array.dtype.kind == "O" else array.tobytes())
    return digest.hexdigest()


@functools.cache
def motion(version: int) -> kc.Trajectory:
    """Return a motion of the robot, another one for each version."""
    return kc.simulate(kc.load_robot(ROBOT), kc.controls.sine(1.0 + version, 10, DT), DT)


def _of_robots() -> dict[str, Sample]:
    def robot(version: int) -> Any:
        return kc.load_robot("delrin-routed-tendon-robot").replace(length=0.6 + 0.01 * version)

    def config(version: int) -> kc.recordings.RecordingConfig:
        return kc.recordings.RecordingConfig.paper_robot().replace(longest_gap=0.1 + 0.1 * version)

    def read_trajectory(path: Path) -> Any:
        found = kc.load_trajectory(path)
        return [np.asarray(each) for each in (found.y, found.z, found.control, found.residual, found.time)]

    def figure(path: Path, version: int) -> None:
        kc.figures.path({"a": np.eye(2) * (1.0 + version)}).savefig(path)

    return {
        "trajectory.nc": Sample(lambda path, version: motion(version).save(path), read_trajectory),
        "robot.yaml": Sample(
            lambda path, version: kc.save_robot(robot(version), path), lambda path: kc.load_robot(path)
        ),
        "recording.yaml": Sample(
            lambda path, version: config(version).save(path),
            lambda path: repr(kc.recordings.RecordingConfig.load(path)),
        ),
        "controls.csv": Sample(
            lambda path, version: kc.controls.save(path, np.full((5, 4), 5.0 + version), DT),
            lambda path: kc.controls.load(path, DT),
        ),
        "figure.png": Sample(figure, _pixels),
    }


def _pixels(path: Path) -> np.ndarray:
    import matplotlib.image

    return np.asarray(matplotlib.image.imread(path))


def _of_recordings() -> dict[str, Sample]:
    def write(path: Path, version: int) -> None:
        kc.recordings.Measurements.of(motion(version)).save(path)

    def read(path: Path) -> Any:
        config = None
        if path.suffix in (".bag", ".mcap", ".db3"):
            config = kc.recordings.RecordingConfig.load(path.with_suffix(".yaml"))
        found = kc.load_recording(path, config).sampled(DT)
        return [found.time, found.position, found.quaternion, found.control]

    names = ("table.csv", "table.parquet", "bag.bag", "bag.mcap", "bag.db3")
    return dict.fromkeys(names, Sample(write, read))


def _of_learning() -> dict[str, Sample]:
    from knode_cosserat.learning.config import FitConfig
    from knode_cosserat.learning.residual import Network, input_layout
    from knode_cosserat.learning.training.checkpoint import Checkpoints, Identity

    robot = kc.load_robot(ROBOT)

    network_of: Any = Network

    def model(version: int) -> kc.KNODE:
        generator = np.random.default_rng(version)
        inputs, outputs = input_layout(robot, False).size, robot.y_layout.size + robot.z_layout.size
        shapes = ((3, inputs), (3,), (outputs, 3), (outputs,), (inputs,))
        arrays = [1e-2 * generator.normal(size=shape) for shape in shapes]
        return kc.KNODE(robot, network_of(*arrays, np.ones(inputs), np.full(outputs, 1e-2)))

    @functools.cache
    def checkpoints(folder: Path) -> Any:
        return Checkpoints(folder, Identity.of(robot, [motion(0)], [], FitConfig()))

    def snapshot(version: int) -> dict[str, Any]:
        weights = [np.full((20, 20), 1.0 + version), np.arange(7.0)]
        return {"weights": weights, "step": version, "loss": [0.5, 0.25]}

    return {
        "model.model": Sample(lambda path, version: model(version).save(path), kc.load_model),
        "member.checkpoint": Sample(
            lambda path, version: checkpoints(path.parent).save(path.stem, snapshot(version)),
            lambda path: checkpoints(path.parent).load(path.stem),
        ),
    }


def _of_sweeps() -> dict[str, Sample]:
    from knode_cosserat.sweeps._folder import FORMAT, VERSION, read_manifest, write_manifest
    from knode_cosserat.sweeps._shards import read_shard, shard_bytes, write_shard

    def write(path: Path, version: int) -> None:
        columns = {
            "case": np.arange(50),
            "tip": np.random.default_rng(version).normal(size=(50, 4, 3)),
            "reason": np.array(["", "no solution"] * 25),
        }
        write_shard(path, shard_bytes(columns, {"sweep": "attack"}))

    def write_description(path: Path, version: int) -> None:
        manifest = {
            "format": FORMAT, "version": VERSION, "identity": f"{version}", "sweep": {"steps": 10},
            "made_by": {}, "machine": {},
            "cases": 50, "shards": 5, "shard_cases": 10, "robots": [{"label": "robot", "columns": {}}],
        }  # fmt: skip
        write_manifest(path.parent, manifest)

    return {
        "shard.parquet": Sample(write, read_shard),
        "sweep.json": Sample(write_description, lambda path: read_manifest(path.parent)),
    }
