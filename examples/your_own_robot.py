"""Your own robot in an afternoon: three tendons, one body at the tip, four CSV recordings of 8 s.

python examples/your_own_robot.py --out afternoon/

A simulated robot is recorded: `VirtualRobot`, which has effects that the model does not have (another
friction law, masses of the ribs, a lag). Delete `record`, and use your own files.
"""

import argparse
from pathlib import Path

import numpy as np

import knode_cosserat as kc
from knode_cosserat import figures
from knode_cosserat.metrics import rms_distance
from knode_cosserat.recordings.streams import Body, ControlRows
from knode_cosserat.recordings.virtual import lagged
from knode_cosserat.recordings.write import write_recording
from knode_cosserat.rods.tendon_robots import VirtualRobot

HERE = Path(__file__).parent
SIGNALS = {"sine-1": "sine:1", "sine-2": "sine:2", "random-0": "random:0", "unseen": "random:7"}
DT, FINE, RESTING = 0.0125, 0.005, 1.0


def record(path: Path, signal: str, seconds: float) -> None:
    """Write the sensor data of the simulated robot: rest, then the signal."""
    real = VirtualRobot(
        length=0.4,
        radius=0.0025,
        density=1500,
        youngs_modulus=1.3e9,
        bending_damping=4e-3,
        drag=2e-3,
        tendon_offset=0.018,
        tendon_angles=np.arange(3) * 2 * np.pi / 3,
        rib_mass=4e-4,
        nodes=19,
    )
    count = round((seconds - RESTING) / 0.05)
    if signal.startswith("sine"):
        pulls = kc.controls.sine(float(signal[5:]), count, 0.05, base=5.0, amplitude=3.0, tendons=3)
    else:
        pulls = kc.controls.random(count, low=3.0, high=8.0, seed=int(signal[7:]), tendons=3, hold=8)
    sent = np.concatenate([np.full((round(RESTING / 0.05), 3), 5.0), pulls])
    time = FINE * np.arange(round(seconds / FINE) + 1)
    tension = lagged(ControlRows(0.05 * np.arange(len(sent)), sent), time, 0.06)
    still = kc.equilibrium(real, tension[0], space="lobatto4")
    moved = kc.simulate(real, tension[1:], FINE, space="lobatto4", initial=still)[::2]
    rng = np.random.default_rng(list(signal.encode()))
    config = kc.recordings.RecordingConfig.load(HERE / "your_own_recording.yaml")
    config = config.replace(simulated=True, description=f"{path.stem}: a simulated robot")
    seen = np.asarray(moved.tip_position) + config.origin + rng.normal(0.0, 2e-4, (len(moved.time), 3))
    turned = np.asarray(moved.quaternion)[:, -1] + rng.normal(0.0, 1e-3, (len(moved.time), 4))
    pulled = ControlRows(time[::4], (tension[::4] + rng.normal(0.0, 0.03, tension[::4].shape)).round(2))
    write_recording(path, config, {"tip": Body(time[::2], seen.round(5), turned.round(4))}, pulled)


def main(out: Path, seconds: float = 8.0) -> tuple[float, float]:
    """Record, identify, and predict a held-out recording; return the tip's errors (m) before and after."""
    out.mkdir(parents=True, exist_ok=True)
    nominal = kc.load_robot(HERE / "your_own_robot.yaml")
    config = kc.recordings.RecordingConfig.load(HERE / "your_own_recording.yaml")
    for name, signal in SIGNALS.items():
        record(out / f"{name}.csv", signal, seconds)
    recordings = {name: kc.load_recording(out / f"{name}.csv", config) for name in SIGNALS}
    unseen = recordings.pop("unseen").sampled(DT, mean=True)
    first = recordings["sine-1"]
    figures.health(first).savefig(out / "health.png", dpi=130)
    found = kc.identify(nominal, list(recordings.values()), progress=print)
    print(found)
    kc.save_robot(found.robot, out / "found.yaml")
    errors = []
    for label, robot in (("before", nominal), ("after", found.robot)):
        prediction = kc.identification.predict(robot, unseen)
        figures.prediction_against_measurement(prediction, unseen).savefig(out / f"{label}.png", dpi=130)
        errors.append(float(rms_distance(np.asarray(prediction.tip_position), unseen.tip_position)))
    print(f"held-out tip RMSE: {100 * errors[0]:.1f} cm before, {100 * errors[1]:.2f} cm after")
    return errors[0], errors[1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("afternoon"))
    main(parser.parse_args().out)
