"""Draw the pictures of docs/real-robots.md and print the errors of its table.

    python -m tools.real_pictures trunk=observations_controlled_11.csv.gz three-cables cables=OUT/cables.json

`cables.json` is written by `python -m studies cables`; the data of the trunk come from their authors.
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

import knode_cosserat as kc
from knode_cosserat.identification import predict
from knode_cosserat.identification.evaluate import compared
from knode_cosserat.recordings import RecordingConfig
from tools.pictures import ROOT, reduced

IMAGES = ROOT / "docs" / "images"
EXAMPLES = ROOT / "examples"


class Robot(NamedTuple):
    """Held-out recording of a robot, and its models by label, all in one folder of examples."""

    folder: str
    models: dict[str, str]
    #: committed recording, if no other is given
    recording: str = ""
    #: start (s), and time from row to row (s)
    start: float = 0.0
    dt: float = 0.0125


ROBOTS = {
    "trunk": Robot("asl_trunk", {"nominal": "nominal", "identified": "identified_11"}, start=30.0),
    "three-cables": Robot("three_cables", {"nominal": "nominal", "identified": "identified"}, "held_out.csv"),
}


def robot_figure(robot: Robot, recording: str):
    """Return a figure of the tip over time, or of the sorted errors of separate equilibria."""
    folder = EXAMPLES / robot.folder
    config = RecordingConfig.load(folder / "recording.yaml")
    seen = kc.load_recording(recording or folder / robot.recording, config)
    rows = seen.sampled() if config.static else seen.sampled(robot.dt, robot.start, mean=True)
    models = {label: kc.load_robot(folder / f"{name}.yaml") for label, name in robot.models.items()}
    motions = {label: predict(model, rows) for label, model in models.items()}
    for label, moved in motions.items():
        off = (compared(models[label], moved, rows).tip - rows.tip_position)[rows.complete]
        axes = ", ".join(f"{each:.2f}" for each in 1e3 * np.sqrt(np.mean(off**2, axis=0)))
        whole = 1e3 * np.sqrt(np.mean(np.sum(off**2, axis=1)))
        print(f"  {label}: x, y, z {axes} mm, in all {whole:.2f} mm", flush=True)
    if config.static:
        tips = {label: moved.tip_position for label, moved in motions.items()}
        return error_figure(
            {label: np.linalg.norm(tip - rows.tip_position, axis=1) for label, tip in tips.items()},
            "held-out positions, sorted by error",
            "distance of the tips [mm]",
        )
    shown = dataclasses.replace(rows, time=rows.time - rows.time[0])
    return kc.figures.tips({"measured": shown, **motions}, columns=2)


def cables_figure(path: str):
    """Return a figure of the sorted errors of all cables' held-out motions, by the study's cells."""
    cells = json.loads(Path(path).read_text(encoding="utf-8"))
    labels = {"guess": "nominal", "identified": "identified", "best": "with a learned correction"}
    errors = {
        label: [cell["mean_abs_error"] or np.nan for cell in cells if cell["method"] == method]
        for method, label in labels.items()
    }
    return error_figure(errors, "held-out motions, sorted by error", "mean error of the markers [mm]")


def error_figure(errors, xlabel, ylabel):
    """Return a figure of sorted errors (m) by label."""
    lines = {label: np.sort(1e3 * np.asarray(each)) for label, each in errors.items()}
    count = len(next(iter(lines.values())))
    return kc.figures.curves(np.arange(1, count + 1), lines, xlabel, ylabel, columns=2)


def main() -> None:
    for given in sys.argv[1:] or ["three-cables"]:
        name, _, path = given.partition("=")
        print(name, flush=True)
        figure = cables_figure(path) if name == "cables" else robot_figure(ROBOTS[name], path)
        picture = IMAGES / f"real-{name}.png"
        figure.savefig(picture)
        reduced(picture)
        print(f"  {picture.relative_to(ROOT)}: {picture.stat().st_size // 1000} kB", flush=True)


if __name__ == "__main__":
    main()
