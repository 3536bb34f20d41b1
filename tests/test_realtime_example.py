"""The example of real-time control: its C++ program has no warnings and moves the emulated robot."""

import subprocess

import numpy as np
import pytest

from examples.realtime import run
from knode_cosserat_hardware.emulation import missing

pytestmark = pytest.mark.slow
STRICT = ("-Wall", "-Wextra", "-pedantic", "-Werror")


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    try:
        return run.build(tmp_path_factory.mktemp("arm"), *STRICT)
    except run.NoCompilerError as error:
        pytest.skip(str(error))


@pytest.mark.skipif(bool(missing()), reason=missing())
@pytest.mark.parametrize("law", ["kinematic", "lq"])
def test_the_tip_follows_in_real_time(program, law):
    said = run.control(program, law, 3.0)
    assert said["law"] == law and said["periods"] == "1500"
    compute = np.array(said["compute_us"].split(), float)
    assert 0.0 < compute[0] <= compute[1] <= compute[2]
    # the model's own tip, which does not depend on how fast this computer is unless periods are left out
    if int(said["missed"]) < 15:
        assert float(said["model_rms_mm"]) < (1.0 if law == "kinematic" else 0.1)
    if said["speed"] > run.FAST_ENOUGH:
        assert said["tip_rms_mm"] < 10.0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("/dev/null", "lq"), "/dev/null is no serial port"),
        (("/dev/null", "pid"), "the law is pid; allowed is kinematic or lq"),
        (("/dev/null", "lq", "fast"), "SECONDS must be a number"),
        ((), "usage: controller PORT kinematic|lq [SECONDS]"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(program, words, said):
    done = subprocess.run([program, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and said in done.stderr and done.stderr.count("\n") == 1


def test_without_a_compiler_it_says_so(tmp_path, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(run.NoCompilerError, match="no C\\+\\+ compiler; install one"):
        run.build(tmp_path)
