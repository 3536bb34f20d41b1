"""The package in a minute: simulate, learn what a model misses, calibrate, predict a held-out recording.

python examples/demo.py --out demo/

All robots in this demo are simulated.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import knode_cosserat as kc
from knode_cosserat.metrics import rms_distance
from knode_cosserat.recordings import load_example

#: the paper's simulation study (studies/simulation.py): time step (s), rows of training and of evaluation,
#: controls, and the errors of its trained network (tip DTW, then pose MSE)
DT, TRAINING_ROWS, ROWS = 0.05, 30, 100
TRAINING = ("sine:0.5", "sine:1.0")
CONTROLS = {"sine": "sine:1.5", "step": "step:1.5"}
PUBLISHED = {"sine": (5.07, 1.31), "step": (10.95, 5.94)}
#: recording of the same robot as `load_example`, under other tensions
HELD_OUT = Path(__file__).parent / "recordings" / "sine_2p0.csv"


def simulate_the_papers_robot(out: Path) -> None:
    """Simulate the paper's robot from rest, its tendons on sines."""
    announce("simulates; compiles machine code for this robot, once")
    robot = kc.load_robot("delrin-tendon-robot")
    tensions = kc.controls.sine(period=1.5, steps=100, dt=DT)
    truth = kc.simulate(robot, tensions, DT)
    truth.save(out / "truth.nc")
    kc.figures.overview(truth).savefig(out / "overview.png")

    x, y, z = np.asarray(truth.tip_position)[-1]
    print("1. Simulated the paper's robot for 5 s, with its tendons on sines of 1.5 s.")
    print(f"   100 steps, all solved; final tip position ({x:.3f}, {y:.3f}, {z:.3f}) m.")
    print(f"   states:  {out / 'truth.nc'}")
    print(f"   picture: {out / 'overview.png'}")


def learn_what_a_model_misses(out: Path) -> None:
    """Learn the hardest case of the paper's simulation study: a model of the wrong length and stiffness."""
    announce("learns what a wrong model misses, and predicts")
    robot = kc.load_robot("delrin-tendon-robot")
    imperfect = robot.replace(length=0.4, youngs_modulus=10e9)
    training = [moved(robot, control, TRAINING_ROWS) for control in TRAINING]
    truth = {name: moved(robot, control, ROWS) for name, control in CONTROLS.items()}

    began = time.perf_counter()
    model = kc.fit(imperfect, training)
    seconds = time.perf_counter() - began
    model.save(out / "model")

    models = {"imperfect model": imperfect, "learned model": model}
    predictions = {
        label: {name: moved(system, control, ROWS) for name, control in CONTROLS.items()}
        for label, system in models.items()
    }
    sines = {label: prediction["sine"] for label, prediction in predictions.items()}
    kc.figures.compare(truth["sine"], sines).savefig(out / "learning.png")
    # the paper's grid is too coarse to be looked at closely
    tensions = kc.controls.parse(CONTROLS["sine"], ROWS, DT)
    motions = {name: kc.simulate(system, tensions, DT) for name, system in {"robot": robot, **models}.items()}
    kc.viewer.export_scene(motions, out / "scene.html", title="What the model missed")
    kc.figures.animate(motions, out / "motion.gif", fps=10, dpi=100)

    errors = {
        label: [
            measure(prediction[name], truth[name])
            for measure in (kc.metrics.tip_dtw, kc.metrics.pose_mse)
            for name in CONTROLS
        ]
        for label, prediction in predictions.items()
    }
    published = [PUBLISHED[name][k] for k in (0, 1) for name in CONTROLS]
    print("2. Took a model of this robot that is 37 % too short and 3.6 times too stiff, and learned the")
    print(f"   difference from two sines of {TRAINING_ROWS * DT:g} s, in {seconds:.1f} s with compilation.")
    print("   Errors on held-out controls; simulated, noise-free data, 100 rows. (DTW aligns two paths in")
    print("   time and sums their distances.)")
    print()
    print(f"   {'':30}{'tip DTW [m]':>20}{'pose MSE [1e-3]':>24}")
    print(f"   {'':30}" + "".join(f"{name:>12}" for name in (*CONTROLS, *CONTROLS)))
    for label, values in (
        ("imperfect model", errors["imperfect model"]),
        ("paper's network, published", published),
        ("learned model", errors["learned model"]),
    ):
        print(f"   {label:30}" + "".join(f"{value:12.3g}" for value in values))
    print()
    print(f"   model:   {out / 'model'}")
    print(f"   picture: {out / 'learning.png'}")


def predict_a_held_out_recording(out: Path) -> None:
    """Calibrate the paper's robot from one recording of another robot, and predict a second recording."""
    announce("reads a recording, calibrates, predicts another")
    training = load_example().sampled(DT).between(1.0, 7.0)
    held_out = kc.load_recording(HELD_OUT).sampled(DT).between(1.0, 11.0)
    nominal = kc.load_robot("delrin-tendon-robot")
    found = kc.identify(nominal, [training], parameters=["youngs_modulus", "bending_damping"])
    kc.save_robot(found.robot, out / "calibrated.yaml")
    # row 0 is the state at rest, so the last row's tension is not used
    predictions = {
        label: kc.simulate(robot, held_out.control[:-1], DT)
        for label, robot in {"nominal model": nominal, "calibrated model": found.robot}.items()
    }
    kc.figures.prediction_against_measurement(predictions["calibrated model"], held_out).savefig(
        out / "recording.png"
    )

    print("3. Read two recordings (tensions and tip positions) of a test robot, which was simulated with")
    print("   PyElastica and is not a physical one. It has friction, rib masses and routed tendons that the")
    print("   model does not have. Calibrated Young's modulus and damping of the model from 6 s of a sine")
    print("   of 1 s, and predicted 10 s of a sine of 2 s from its tensions alone.")
    print(f"   robot:   {out / 'calibrated.yaml'}")
    print(f"   picture: {out / 'recording.png'}")
    print()
    print(f"   {'held-out recording (simulated)':32}{'tip RMSE [cm]':>14}")
    for label, prediction in predictions.items():
        error = float(rms_distance(np.asarray(prediction.tip_position), held_out.tip_position))
        print(f"   {label:32}{100 * error:14.1f}")


def announce(task: str) -> None:
    """Say what is done now, before it takes its time."""
    print(f"… {task} …", flush=True)


def moved(system: kc.System, control: str, rows: int) -> kc.Trajectory:
    """Return the rows that the paper's study keeps: rest, and the states after all controls but the last."""
    # the paper's schemes, to compare with its figures
    tensions = kc.controls.parse(control, rows, DT, sampled="end")
    return kc.simulate(system, tensions, DT, time="bdf2", start="paper", space="euler", initial="unstressed")[
        :rows
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("demo"), help="output folder")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    simulate_the_papers_robot(out)
    print()
    learn_what_a_model_misses(out)
    print()
    predict_a_held_out_recording(out)
    print()
    print(f"The robot and both models in motion, with the default schemes: {out / 'motion.gif'},")
    print(f"and {out / 'scene.html'}, to turn and zoom in a browser.")
    print("Next, a robot of your own:  .venv/bin/knode-cosserat init my-robot.yaml")


if __name__ == "__main__":
    main()
