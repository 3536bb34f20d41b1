"""How the files beside this one were made, by version 0.1 of the package. They are kept as they are.

    python tests/files/make.py FOLDER

A change of a format adds files of the new one; those of the old stay, and must go on loading.
"""

import json
import sys
from pathlib import Path

import numpy as np

import knode_cosserat as kc


def main(folder: Path) -> None:
    robot = kc.load_robot("delrin-tendon-robot").replace(nodes=5)
    tensions = kc.controls.sine(1.0, 12, 0.05)
    truth = kc.simulate(robot, tensions, 0.05)
    model = kc.fit(robot.replace(youngs_modulus=4e9), [truth])
    kc.save_robot(robot, folder / "robot-1.yaml", description="format 1: numbers only")
    laden = kc.robots.SlenderRod(
        length=0.4, radius=0.005, density=1100.0, youngs_modulus=2e6, nodes=5, drag=0.01,
        loads=(
            kc.robots.loads.PointWrench(at=0.5, force=[0.01, 0.0, 0.0]),
            kc.robots.loads.AttachedMass(mass=0.001),
        ),
    )  # fmt: skip
    kc.save_robot(laden, folder / "robot-2.yaml", description="format 2: with parts")
    truth.save(folder / "trajectory-1.nc")
    model.save(folder / "model-1.model")
    predicted = kc.simulate(model, tensions, 0.05)
    predicted.save(folder / "prediction-1.nc")
    told = {
        "tip": np.asarray(truth.tip_position[-1]).tolist(),
        "predicted tip": np.asarray(predicted.tip_position[-1]).tolist(),
        "tension": tensions[-1].tolist(),
    }
    (folder / "told.json").write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
