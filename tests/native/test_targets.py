"""Exported models of all kinds, for all computers: against `simulate`, without Python, under sanitizers."""

import dataclasses
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.structured.residual import CURVED, Load, Structured, expansion, loaded
from knode_cosserat.rods.aspects import Observed
from tests.engine.networks import with_network
from tests.native.library import STRICT, has

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not has("cc"), reason="no C compiler")]
HERE, DT = Path(__file__).parent, 0.02
#: amplitudes of controls by their units
AMPLITUDES = {"N": 1.0, "Pa": 2e4, "m": 0.005, "rad": 0.5, "T": 0.01}
CATALOG = (
    *("delrin-tendon-robot", "delrin-routed-tendon-robot", "three-chamber-arm", "three-tube-robot"),
    *("variable-curvature-robot", "magnetic-catheter", "fed-catheter"),
)


def smooth_controls(system, steps):
    """Return controls that begin at zero and stay within their limits."""
    t, columns = np.arange(steps) * DT, []
    fields = [field for field in system.control_layout.fields for _ in range(field.size)]
    for k, field in enumerate(fields):
        wave = np.sin(2 * np.pi * t / 1.5 + k)
        wave = 0.5 * (1.0 + wave) if field.low >= 0.0 else wave
        column = AMPLITUDES.get(field.unit, 0.1) * np.minimum(1.0, t / 0.5) * wave
        columns.append(np.clip(column, field.low, field.high))
    return np.stack(columns, axis=1)


def run_in_c(model, folder, controls, compiler=("cc",), runs=(), **options):
    """Return the rows that an exported model prints in a process without Python."""
    exported = kc.export(model, folder, DT, name="arm", **options)
    command = [*compiler, *STRICT, "-O2", "-static", "example.c", "arm.c", "arm.o", "-lm", "-o", "steps"]
    subprocess.run(command, cwd=folder, check=True)
    text = "\n".join(" ".join(map(repr, row)) for row in controls.tolist())
    found = subprocess.run(
        [*runs, folder / "steps"], input=text, capture_output=True, text=True, check=True, env={}
    )
    return exported, np.loadtxt(found.stdout.splitlines())


def with_structured_residual():
    """Return the paper's robot with laws and loads of random numbers, as in tests of model files."""
    robot, rng = kc.load_robot("delrin-tendon-robot"), np.random.default_rng(5)
    seen = Observed.of(robot).layout
    layout = kc.robots.Layout(*((name, 3, "", name) for name in ("v", "u", "v_t", "u_t")))
    law, load = (
        dataclasses.replace(found, weights=size * rng.normal(size=np.shape(found.weights)))
        for found, size in (
            (expansion(layout, rng.normal(size=(50, 12)), {"u": CURVED}, 6), 1e-5),
            (expansion(seen, rng.normal(size=(9, seen.size)), {}, loaded(robot).size), 1e-5),
        )
    )
    return KNODE(robot, Structured(np.array(0.02), law, Load(load, None), None))


def with_friction():
    """Return the paper's rod with routed tendons that rub."""
    robot = kc.load_robot("delrin-tendon-robot")
    friction = kc.robots.tendons.TendonFriction(wobble=0.6, curvature=0.1)
    return kc.robots.RoutedTendonRobot.like(robot, friction=friction)


#: models beside those of the catalog
OTHERS = {
    "network of 512": lambda: with_network(512),
    "structured residual": with_structured_residual,
    "friction": with_friction,
}


@pytest.mark.parametrize("name", [*CATALOG, *OTHERS])
def test_1000_steps_are_those_of_simulate(name, tmp_path):
    model = OTHERS[name]() if name in OTHERS else kc.load_robot(name)
    controls = smooth_controls(model, 1000)
    wanted = kc.simulate(model, controls, DT)
    exported, rows = run_in_c(model, tmp_path, controls)
    assert len(rows) == 1000
    np.testing.assert_allclose(rows[:, 1:4], wanted.tip_position[1:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rows[:, 4], np.asarray(wanted.result[1:]))
    assert exported.object_size - exported.data_size < 2e6


@pytest.mark.parametrize("target", ["x86-64", "x86-64-v3"])
def test_other_targets_of_this_computer_give_the_same_numbers(target, tmp_path):
    robot = kc.load_robot("delrin-tendon-robot")
    controls = smooth_controls(robot, 300)
    wanted = kc.simulate(robot, controls, DT)
    _, rows = run_in_c(robot, tmp_path, controls, target=target)
    np.testing.assert_allclose(rows[:, 1:4], wanted.tip_position[1:], rtol=0, atol=1e-10)


@pytest.mark.skipif(not has("qemu-aarch64", "aarch64-linux-gnu-gcc"), reason="no emulator of ARM")
@pytest.mark.parametrize("name", [*CATALOG[:4], *OTHERS])
def test_arm_gives_the_same_numbers(name, tmp_path):
    robot = OTHERS[name]() if name in OTHERS else kc.load_robot(name)
    controls = smooth_controls(robot, 200)
    wanted = kc.simulate(robot, controls, DT)
    _, rows = run_in_c(
        robot, tmp_path, controls, ("aarch64-linux-gnu-gcc",), ("qemu-aarch64",), target="aarch64"
    )
    np.testing.assert_allclose(rows[:, 1:4], wanted.tip_position[1:], rtol=0, atol=1e-10)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An exported arm, with another compiler too if there is one."""
    found = tmp_path_factory.mktemp("arm")
    kc.export(kc.load_robot("delrin-tendon-robot"), found, DT, name="arm", horizon=8)
    return found


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_compiler_warns_and_nothing_is_allocated(folder, compiler):
    if not has(compiler):
        pytest.skip(f"no {compiler}")
    command = [compiler, *STRICT, "-O2", HERE / "quiet.c", "arm.c", "arm.o", "-I.", "-lm", "-o", "quiet"]
    subprocess.run(command, cwd=folder, check=True)
    assert subprocess.run([folder / "quiet"], check=False).returncode == 0


def test_wrong_input_never_crashes(folder):
    """10 s here; `FUZZ_SECONDS=600` for longer."""
    seconds = os.environ.get("FUZZ_SECONDS", "10")
    command = ["cc", "-std=c11", "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    subprocess.run(
        [*command, HERE / "fuzz.c", "arm.c", "arm.o", "-I.", "-lm", "-o", "fuzz"], cwd=folder, check=True
    )
    found = subprocess.run([folder / "fuzz", seconds, "1"], capture_output=True, text=True, check=False)
    assert found.returncode == 0, f"{found.returncode}: {found.stderr[-2000:]}"
    assert int(found.stdout.split()[2]) > 100
