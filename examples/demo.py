"""What this package does, in half a minute: simulate a robot, and predict a recorded one.

python examples/demo.py --out demo/
"""

import argparse
from pathlib import Path

import numpy as np

import knode_cosserat as kc
from knode_cosserat.evaluation import figures
from knode_cosserat.evaluation.metrics import dtw_distance, rms_distance
from knode_cosserat.recordings import load_example

#: time step of the paper's studies (s)
DT = 0.05


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
    measured = load_example().between(1.0, 11.0)
    robot = kc.load_robot("delrin-tendon-robot")
    # row 0 is the state at rest, so that the last row's tension would lead beyond the last row
    prediction = kc.simulate(robot, measured.tension[:-1], measured.dt)
    figures.prediction_against_measurement(prediction, measured).savefig(out / "recording.png")

    predicted = np.asarray(prediction.tip_position)
    dtw = dtw_distance(predicted, measured.tip_position)
    rmse = float(rms_distance(predicted, measured.tip_position))
    print("2. Predicted 10 s of a recording from its measured tensions, by the same physics.")
    print(f"   tip DTW {dtw:.1f} m over {len(predicted)} rows, tip RMSE {100 * rmse:.1f} cm.")
    print(f"   picture: {out / 'recording.png'}")
    print(
        "   This gap between physics and measurement is what learning will close; the recording comes from a"
    )
    print("   simulated stand-in robot (PyElastica), not from a physical one.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("demo"), help="folder for what is written")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    simulate_the_papers_robot(out)
    print()
    predict_a_recording(out)


if __name__ == "__main__":
    main()
