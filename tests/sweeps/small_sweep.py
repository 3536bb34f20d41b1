"""A sweep of 48 cases, half of which fail."""

from pathlib import Path

from knode_cosserat.sweeps import Range, Sweep

ROBOT = {"robot": "delrin-tendon-robot", "set": {"nodes": 5, "bending_damping": 0.02}}
#: the last of the heights gives a tension below 0, and the one before has no solution
HEIGHTS = [0.5, 1.0, 1e7, -6.0]


def described(**changes):
    given = {
        "robots": ROBOT,
        "controls": "step:{height},at=0.1",
        "steps": 4,
        "dt": 0.05,
        "shard": 16,
        "vary": {"length": Range(0.5, 0.7, count=12), "height": HEIGHTS},
    }
    return Sweep(**{**given, **changes})


def content(folder):
    """The bytes of manifest and shards; the log has dates."""
    files = [file for file in Path(folder).rglob("*") if file.is_file() and file.name != "log.jsonl"]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files if "jobs" not in file.parts}
