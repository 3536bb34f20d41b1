"""Export a ROS 1 bag of the paper's robot as a table of tensions and tip positions (CSV).

    python tools/export_recording.py sine_1p0.bag src/knode_cosserat/recordings/data/sine_1p0.csv \
        --simulated-with PyElastica

This made the recording that comes with the package. The conventions:

- Time runs from the earliest of the poses and tensions, by the stamp in each message's header (when it was
  measured; the bag's own times are up to 1.6 ms later), to the microsecond: stamps are inexact by 0.1 µs.
- Row i is at i times the step (0.05 s), up to where all of the signals still have a sample.
- Tensions are those of the last sample at or before the row's time, in N, and are meant to be held until the
  next row: row i is the control of the simulation's step from row i to row i + 1.
- The tip is interpolated linearly between the two nearest poses. The frame is the robot's: z up, origin at
  the clamped end of the rod. That end does not move, so the base's position is the recording's mean.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

BASE = "/vicon/continuum_base/pose"
TIP = "/vicon/continuum_3/pose"
TENSION = "/tension"
#: the fields of the tension message that hold tendons 1, 2, 3, 4
TENDON_FIELDS = ("y", "z", "w", "x")
GRAMS_FORCE = 9.81 / 1000.0
#: the base's body above the clamped end (m)
BASE_HEIGHT = 0.0635


def read_bag(path):
    """Per topic: times (n,) in s by the headers' stamps, from the earliest on, and values (n, 3 or 4)."""
    stamps, values = {}, {}
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic in (BASE, TIP, TENSION)]
        for connection, _, raw in reader.messages(connections=wanted):
            message = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            if connection.topic == TENSION:
                value = [getattr(message.quaternion, field) for field in TENDON_FIELDS]
            else:
                value = [getattr(message.pose.position, axis) for axis in "xyz"]
            stamps.setdefault(connection.topic, []).append(stamp)
            values.setdefault(connection.topic, []).append(value)
    missing = {BASE, TIP, TENSION} - stamps.keys()
    if missing:
        raise SystemExit(f"{path}: no messages on {', '.join(sorted(missing))}")
    start = min(min(times) for times in stamps.values())
    return {
        topic: (np.round((np.array(times) - start) * 1e-9, 6), np.array(values[topic]))
        for topic, times in stamps.items()
    }


def sample(signals, step):
    """Times (rows,) in s, tensions (rows, 4) in N and tip positions (rows, 3) in m, every `step` seconds."""
    end = min(time[-1] for time, _ in signals.values())
    time = np.round(np.arange(int(end / step + 1e-6) + 1) * step, 9)
    measured, tension = signals[TENSION]
    held = np.searchsorted(measured, time, side="right") - 1
    if held[0] < 0:
        raise SystemExit(f"the first tension is at {measured[0]} s, after the first row")
    seen, tip = signals[TIP]
    tip = np.stack([np.interp(time, seen, tip[:, axis]) for axis in range(3)], axis=-1)
    clamp = signals[BASE][1].mean(axis=0) - [0.0, 0.0, BASE_HEIGHT]
    return time, tension[held] * GRAMS_FORCE, tip - clamp


def write_table(path, time, tension, tip, source, simulated_with):
    said = "recorded on a physical robot"
    if simulated_with:
        said = f"a recording of a SIMULATED stand-in robot ({simulated_with}), not of a physical one"
    comments = [
        f"source: {source}, exported by tools/export_recording.py",
        f"simulated: {'true' if simulated_with else 'false'}",
        f"This is {said}.",
        "tension_k: measured tension of tendon k, the last sample at or before the row's time.",
        "tip: position interpolated linearly at the row's time; z is up, the origin the rod's clamped end.",
    ]
    names = ["time [s]", *(f"tension_{k} [N]" for k in range(1, 5)), *(f"tip_{axis} [m]" for axis in "xyz")]
    with path.open("w", encoding="utf-8", newline="") as file:
        file.writelines(f"# {line}\n" for line in comments)
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        for t, newtons, metres in zip(time, tension, tip, strict=True):
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
    time, tension, tip = sample(read_bag(given.bag), given.step)
    write_table(given.table, time, tension, tip, given.bag.name, given.simulated_with)
    print(f"wrote {given.table}: {len(time)} rows, {time[0]:g} to {time[-1]:g} s")


if __name__ == "__main__":
    main()
