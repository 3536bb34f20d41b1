"""Compiled programs on disk: what was damaged, or half written by a killed process, is stored anew."""

import os
import subprocess
import sys

import pytest

from knode_cosserat._program_cache import SUFFIX, ProgramCache

PROGRAM = """
import collections
import jax
import knode_cosserat
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
events = collections.Counter()
jax.monitoring.register_event_listener(lambda name, **_: events.update([name.rpartition("/")[2]]))
print(float(jax.jit(lambda x: (x * 3.0).sum())(jax.numpy.arange(4.0))))
print(events["cache_hits"] > 0, events["cache_misses"])
"""


def damage_half(content):
    return content[: len(content) // 2]


def damage_all(content):
    return b""


def damage_bit(content):
    at = len(content) // 2
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def run(folder):
    """Run a program in a process of its own; return its number, and the numbers of hits and misses."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, "KNODE_COSSERAT_CACHE": str(folder)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and done.stderr == "", done.stderr
    return done.stdout.split()


def test_a_process_stores_a_damaged_program_anew(tmp_path):
    first = run(tmp_path)
    files = list(tmp_path.rglob(f"*{SUFFIX}"))
    assert files and first[0] == "18.0" and int(first[2]) == len(files)
    for file in files:
        file.write_bytes(damage_half(file.read_bytes()))
    assert run(tmp_path) == first
    assert run(tmp_path) == ["18.0", "True", "0"]
    # nothing is left of the writes
    assert {each for each in tmp_path.rglob("*") if each.is_file()} == set(files)


@pytest.mark.parametrize("damage", [damage_half, damage_all, damage_bit])
def test_a_damaged_program_is_removed(tmp_path, damage):
    cache = ProgramCache(tmp_path / "new" / "folder")
    assert cache.get("a") is None
    cache.put("a", b"program " * 100)
    assert cache.get("a") == b"program " * 100
    file = tmp_path / "new" / "folder" / f"a{SUFFIX}"
    file.write_bytes(damage(file.read_bytes()))
    assert cache.get("a") is None and not file.exists()
    cache.put("a", b"another")
    assert cache.get("a") == b"another"


def test_what_is_there_is_kept(tmp_path):
    cache = ProgramCache(tmp_path)
    cache.put("a", b"one")
    cache.put("a", b"two")
    assert cache.get("a") == b"one"
