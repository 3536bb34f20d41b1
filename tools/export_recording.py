"""Export a bag of the paper's robot as a table of tensions and tip positions (CSV).

    python tools/export_recording.py sine_1p0.bag src/knode_cosserat/recordings/data/sine_1p0.csv \
        --simulated-with PyElastica

This made the recording that comes with the package: `load_recording(bag).sampled(step)` and nothing else.
"""

import argparse
import csv
from pathlib import Path

import knode_cosserat as kc


def write_table(path, measured, source, simulated_with):
    said = "recorded on a physical robot"
    if simulated_with:
        said = f"a recording of a SIMULATED test robot ({simulated_with}), not of a physical one"
    comments = [
        f"source: {source}, exported by tools/export_recording.py",
        f"simulated: {'true' if simulated_with else 'false'}",
        f"This is {said}.",
        "tension_k: measured tension of tendon k, the last sample at or before the row's time.",
        "tip: position interpolated at the row's time; z is up, the origin the rod's clamped end.",
    ]
    tendons = range(1, measured.control.shape[1] + 1)
    names = ["time [s]", *(f"tension_{k} [N]" for k in tendons), *(f"tip_{axis} [m]" for axis in "xyz")]
    with path.open("w", encoding="utf-8", newline="") as file:
        file.writelines(f"# {line}\n" for line in comments)
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        for t, newtons, metres in zip(measured.time, measured.control, measured.tip_position, strict=True):
            writer.writerow([f"{t:g}", *(f"{x:.5f}" for x in newtons), *(f"{x:.6f}" for x in metres)])


def main():
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], epilog="Needs rosbags: pip install 'knode-cosserat[ros]'"
    )
    parser.add_argument("bag", type=Path)
    parser.add_argument("table", type=Path, help="the CSV file to write")
    parser.add_argument("--step", type=float, default=0.05, help="time from row to row (s); default 0.05")
    parser.add_argument(
        "--simulated-with", metavar="PROGRAM", help="what simulated the robot, if it was simulated"
    )
    given = parser.parse_args()
    measured = kc.load_recording(given.bag).sampled(given.step)
    write_table(given.table, measured, given.bag.name, given.simulated_with)
    print(f"wrote {given.table}: {len(measured.time)} rows, {measured.time[0]:g} to {measured.time[-1]:g} s")


if __name__ == "__main__":
    main()
