"""Machine code on disk, and quick code until another process has generated the final code."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from knode_cosserat.engine import generation, machine_code
from knode_cosserat.engine.codegen import Module


def module_of(number):
    """Return a module that writes a number of its own, and sums of products."""
    module = Module()
    f = module.function("run", ["out", "x"], exported=True)
    out, x = f.arguments
    total = f.value(0.0)
    for k in range(8):
        total = total + f.load(x, k) * (number / 3.0) - f.load(x, 7 - k)
    f.store(total, out, 0)
    return module


def answer(code):
    x, out = np.linspace(0.1, 1.7, 8), np.zeros(1)
    code["run"](out.ctypes.data, x.ctypes.data)
    return out[0]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Return a cache folder of the test, in which all modules are large."""
    monkeypatch.setenv("KNODE_COSSERAT_CACHE", str(tmp_path))
    monkeypatch.delenv("KNODE_COSSERAT_CODE", raising=False)
    monkeypatch.setattr(machine_code, "LARGE", 0)
    return tmp_path


def taken_over(code, seconds=60.0):
    """Wait for the final code, and return true if it is used after the next call."""
    process, end = code._later, time.monotonic() + seconds
    # it may have been found to have ended before
    while process is not None and process.returncode is None and time.monotonic() < end:
        time.sleep(0.01)
    before = code._functions
    answer(code)
    return code._functions is not before


@pytest.mark.parametrize("damage", [lambda code: code, lambda code: code[:100], lambda code: b""])
def test_machine_code_is_kept_on_disk(tmp_path, monkeypatch, damage):
    monkeypatch.setenv("KNODE_COSSERAT_CACHE", str(tmp_path))
    found = answer(module_of(1.0).compile())
    [file] = tmp_path.rglob("engine-*")
    content = file.read_bytes()
    file.write_bytes(damage(content))
    assert answer(module_of(1.0).compile()) == found
    assert file.read_bytes() == content


def test_the_final_code_takes_over_with_the_same_bits(cache):
    code = module_of(2.0).compile()
    quick = answer(code)
    assert taken_over(code) and answer(code) == quick
    [file] = cache.rglob("engine-*")
    # a later process has it at once
    again = module_of(2.0).compile()
    assert again._later is None and answer(again) == quick
    assert file.read_bytes().startswith(generation.generate(module_of(2.0).text, generation.FINAL))


@pytest.mark.parametrize(("wanted", "level"), [("quick", generation.QUICK), ("final", generation.FINAL)])
def test_one_level_of_code_may_be_asked_for(cache, monkeypatch, wanted, level):
    monkeypatch.setenv("KNODE_COSSERAT_CODE", wanted)
    code = module_of(2.5).compile()
    assert code._later is None and answer(code) == answer(module_of(2.5).compile())
    [file] = cache.rglob("*engine-*")
    assert file.read_bytes().startswith(generation.generate(module_of(2.5).text, level))


def test_quick_code_stays_if_the_other_process_is_killed(cache):
    code = module_of(3.0).compile()
    code._later.send_signal(getattr(signal, "SIGKILL", signal.SIGTERM))
    found = answer(code)
    taken_over(code)
    assert answer(code) == found


def test_no_process_where_none_can_be(cache, monkeypatch):
    expected = answer(module_of(4.0).compile())
    (cache / "file").write_text("no folder")
    monkeypatch.setenv("KNODE_COSSERAT_CACHE", str(cache / "file"))
    code = module_of(4.0).compile()
    assert code._later is None and answer(code) == expected
    monkeypatch.setenv("KNODE_COSSERAT_CACHE", str(cache / "other"))

    def refused(*arguments, **options):
        raise PermissionError("no processes here")

    monkeypatch.setattr(subprocess, "Popen", refused)
    code = module_of(4.0).compile()
    assert code._later is None and answer(code) == expected
    monkeypatch.setattr(sys, "executable", None)
    assert answer(module_of(5.0).compile()) != expected


PROGRAM = """
from knode_cosserat.engine import machine_code
from tests.engine.test_machine_code import answer, module_of
machine_code.LARGE = 0
code = module_of(6.0).compile()
assert code._later is not None
print(answer(code))
"""


def test_a_process_ends_while_the_final_code_is_generated(cache):
    run = [sys.executable, "-W", "error", "-c", PROGRAM]
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    end = time.monotonic() + 60.0
    while not list(cache.rglob("engine-*-program")) and time.monotonic() < end:
        time.sleep(0.01)
    # what it left to do is done, and a later process uses it
    code = module_of(6.0).compile()
    assert code._later is None and answer(code) == float(done.stdout)
