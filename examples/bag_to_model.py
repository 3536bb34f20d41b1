"""From recorded bags to a model that predicts: record, read, identify, test on a held-out recording.

A simulated robot is recorded, with friction, ribs, a lag and noisy sensors that the model does not have.
`knode-cosserat record-virtual` makes the same bags; with your own bags, start at `load_recording`.
"""

import tempfile
from pathlib import Path

import knode_cosserat as kc
from knode_cosserat.recordings.virtual import record_virtual

NAMES = ("youngs_modulus", "bending_damping")


def main(out: str = "bag_to_model.png", seconds: float = 4.0) -> tuple[float, float]:
    """Identify from one sine, predict another; return the tip's errors (RMSE in m) before and after."""
    with tempfile.TemporaryDirectory() as folder:
        bags = {"sine:1.5": Path(folder) / "seen.bag", "sine:1.0": Path(folder) / "unseen.bag"}
        for signal, path in bags.items():
            record_virtual(path, signal, seconds)
        config = kc.recordings.RecordingConfig.paper_robot()
        recordings = [kc.load_recording(path, config) for path in bags.values()]
    seen, unseen = (recording.sampled(0.0125, mean=True) for recording in recordings)

    # realistic tendons, which bend the rod; without names, friction is found too, which takes longer
    nominal = kc.robots.RoutedTendonRobot.like(kc.load_robot("delrin-tendon-robot"))
    found = kc.identify(nominal, [seen], parameters=NAMES)
    print(found)
    before, after = (kc.simulate(each, unseen.control[:-1], 0.0125) for each in (nominal, found.robot))
    kc.figures.prediction_against_measurement(after, unseen).savefig(out)
    errors = tuple(
        float(((each.tip_position - unseen.tip_position) ** 2).sum(axis=1).mean() ** 0.5)
        for each in (before, after)
    )
    print(f"held-out tip RMSE: {100 * errors[0]:.1f} cm before, {100 * errors[1]:.2f} cm after")
    return errors[0], errors[1]


if __name__ == "__main__":
    main()
