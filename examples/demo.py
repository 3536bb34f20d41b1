"""What this package does, in a minute: simulate a robot, predict a recorded one, learn what a model misses.

python examples/demo.py --out demo/
"""

import argparse
import time
from pathlib import Path

import numpy as np

import knode_cosserat as kc
from knode_cosserat.evaluation import figures, study_figures
from knode_cosserat.evaluation.metrics import dtw_distance, rms_distance
from knode_cosserat.recordings import load_example
from knode_cosserat.studies.simulation import CONTROLS, DT, PUBLISHED, ROWS, TRAINING, TRAINING_ROWS


def simulate_the_papers_robot(out: Path) -> None:
    """The robot of the paper under its evaluation sine, from rest."""
    robot = kc.load_robot("delrin-tendon-robot")
    tensions = kc.controls.sine(period=1.5, steps=100, dt=DT)
    truth = kc.simulate(robot, tensions, DT)
    truth.save(out / "truth.nc")
    figures.overview(truth).savefig(out / "overview.png")

    x, y, z = np.asarray(truth.tip_position)[-1]
    print("1. Simulated the paper's robot for 5 s, its tendons on sines of 1.5 s.")
    print(f"   100 steps, all solved; the tip ends at ({x:.3f}, {y:.3f}, {z:.3f}) m.")
    print(f"   states:  {out / 'truth.nc'}")
    print(f"   picture: {out / 'overview.png'}")


def predict_a_recording(out: Path) -> None:
    """The paper's robot under the tensions that were measured on another one, against where its tip went."""
    measured = load_example().sampled(DT).between(1.0, 11.0)
    robot = kc.load_robot("delrin-tendon-robot")
    # row 0 is the state at rest, so that the last row's tension would lead beyond the last row
    prediction = kc.simulate(robot, measured.held_tension[:-1], measured.dt)
    figures.prediction_against_measurement(prediction, measured).savefig(out / "recording.png")

    predicted = np.asarray(prediction.tip_position)
    dtw = dtw_distance(predicted, measured.tip_position)
    rmse = float(rms_distance(predicted, measured.tip_position))
    print("2. Predicted 10 s of a recording from its measured tensions, by the same physics.")
    print(f"   tip DTW {dtw:.1f} m over {len(predicted)} rows, tip RMSE {100 * rmse:.1f} cm.")
    print(f"   picture: {out / 'recording.png'}")
    print("   The recording comes from a simulated stand-in robot (PyElastica), not from a physical one.")


def learn_what_a_model_misses(out: Path) -> dict[str, kc.Trajectory]:
    """The hardest case of the paper's simulation study: a model of the wrong length and stiffness."""
    robot = kc.load_robot("delrin-tendon-robot")
    imperfect = robot.replace(length=0.4, youngs_modulus=10e9)
    training = [moved(robot, control, TRAINING_ROWS) for control in TRAINING]
    truth = {name: moved(robot, control, ROWS) for name, control in CONTROLS.items()}

    began = time.perf_counter()
    model = kc.fit(imperfect, training)
    seconds = time.perf_counter() - began
    model.save(out / "model")
    network = kc.fit(imperfect, training, kc.FitConfig.paper(seed=0))

    predictions = {
        label: {name: moved(system, control, ROWS) for name, control in CONTROLS.items()}
        for label, system in (("baseline", imperfect), ("paper", network), ("best", model))
    }
    sines = {label: prediction["sine"] for label, prediction in predictions.items()}
    study_figures.comparison(truth["sine"], sines).savefig(out / "learning.png")

    print("3. Took a model of the robot that is 37 % too short and 3.6 times too stiff, and learned what it")
    print(f"   misses from two sines of {TRAINING_ROWS * DT:g} s ({seconds:.1f} s, most of it compiling).")
    print("   How far it then is from the robot (simulated, without noise) on controls not seen before:")
    print()
    measured = {
        label: [
            measure(prediction[name], truth[name])
            for measure in (kc.tip_dtw, kc.pose_mse)
            for name in CONTROLS
        ]
        for label, prediction in predictions.items()
    }
    published = [PUBLISHED["length-stiffness", name].learned[k] for k in (0, 1) for name in CONTROLS]
    print(f"   {'':30}{'tip DTW [m]':>20}{'pose MSE [1e-3]':>24}")
    print(f"   {'':30}" + "".join(f"{name:>12}" for name in (*CONTROLS, *CONTROLS)))
    for label, values in (
        ("the model, before", measured["baseline"]),
        ("the paper's KNODE, published", published),
        ("the paper's KNODE, run here", measured["paper"]),
        ("this package's", measured["best"]),
    ):
        print(f"   {label:30}" + "".join(f"{value:12.3g}" for value in values))
    print()
    print(f"   model:   {out / 'model'}")
    print(f"   picture: {out / 'learning.png'}")
    return {"robot": truth["sine"], "model, before": sines["baseline"], "this package's model": sines["best"]}


def show(compared: dict[str, kc.Trajectory], out: Path) -> None:
    """All of the third part in one page, and what else the viewer does."""
    kc.export_scene(compared, out / "scene.html", title="What the model missed")
    print("4. Drew the robot, the wrong model and the corrected one in motion; open it in a browser:")
    print(f"   page:    {out / 'scene.html'}")
    print("   To see the first part, and to pull the robot's tendons yourself:")
    print(f"     .venv/bin/knode-cosserat view {out / 'truth.nc'}")
    print(f"     .venv/bin/knode-cosserat view --live {out / 'model'}")


def moved(system: kc.System, control: str, rows: int) -> kc.Trajectory:
    """As many rows as the paper's study keeps: the state at rest, and after all controls but the last."""
    return kc.simulate(system, kc.controls.parse(control, rows, DT), DT)[:rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder for what is written")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    simulate_the_papers_robot(out)
    print()
    predict_a_recording(out)
    print()
    compared = learn_what_a_model_misses(out)
    print()
    show(compared, out)


if __name__ == "__main__":
    main()
