"""Sidecars: a later process runs stored code without tracing; other equations have another name."""

import importlib.util
import itertools
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine import loops, pattern, sidecars
from knode_cosserat.engine.tangents import TangentCore
from knode_cosserat.schemes.settings import NewtonOptions, Settings

CONTROLS = np.random.default_rng(0).uniform(4.0, 8.0, (3, 4))
SETTINGS = Settings.of("bdf2", "lobatto2", "paper", NewtonOptions())


def paper_robot(**changes):
    return kc.load_robot("delrin-tendon-robot").replace(nodes=5, **changes)


def simulated(robot):
    return kc.simulate(robot, CONTROLS, 0.05, time="bdf2", start="paper").y


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("KNODE_COSSERAT_CACHE", str(tmp_path))
    return tmp_path


def forget(monkeypatch):
    """Forget the code of this process."""
    monkeypatch.setattr(pattern, "_CODES", {})


def refuse_traces(monkeypatch):
    def refused(*_, **__):
        raise AssertionError("traced again")

    monkeypatch.setattr(jax, "make_jaxpr", refused)


def test_code_is_restored_without_tracing(cache, monkeypatch):
    forget(monkeypatch)
    robot = paper_robot()
    found, core = simulated(robot), loops.core_of(pattern.Pattern.of(robot), SETTINGS, robots=False)
    moving = [np.zeros(np.shape(leaf), dtype=bool) for leaf in jax.tree.leaves(robot)]
    tangents = loops.tangents_for(TangentCore, pattern.Pattern.of(robot), SETTINGS, moving)
    forget(monkeypatch)
    with monkeypatch.context() as refusing:
        refuse_traces(refusing)
        np.testing.assert_array_equal(simulated(paper_robot()), found)
        # another robot of the same structure has the same code
        other = paper_robot(length=0.5)
        assert np.max(np.abs(simulated(other) - found)) > 1e-3
        again = loops.core_of(pattern.Pattern.of(other), SETTINGS, robots=False)
        assert again is not core and again._functions.name == core._functions.name
        assert again.equations.__class__.__name__ == "Sizes"
        again = loops.tangents_for(TangentCore, pattern.Pattern.of(other), SETTINGS, moving)
        assert again.tangents == tangents.tangents and again is not tangents
        # and another grid of the same robot
        assert simulated(robot.replace(nodes=6)).shape != found.shape
    # of another structure
    refuse_traces(monkeypatch)
    with pytest.raises(AssertionError, match="traced again"):
        simulated(robot.replace(loads=(kc.robots.loads.AttachedMass(mass=0.01),)))


def damage_half(content):
    return content[: len(content) // 2]


def damage_bit(content):
    return content[:-1] + bytes([content[-1] ^ 1])


@pytest.mark.parametrize("damage", [damage_half, damage_bit, None])
@pytest.mark.parametrize("kind", ["core-*", "engine-*"])
def test_damaged_files_are_written_again(cache, monkeypatch, kind, damage):
    s, robot = np.linspace(0.0, 0.6, 4), paper_robot()
    forget(monkeypatch)
    found = pattern.values_along(at_rest, robot, s)
    [file] = cache.rglob(kind)
    content = file.read_bytes()
    file.write_bytes(damage(content)) if damage else file.unlink()
    forget(monkeypatch)
    for one, other in zip(pattern.values_along(at_rest, robot, s), found, strict=True):
        np.testing.assert_array_equal(one, other)
    assert file.read_bytes() == content


def at_rest(system, s, control):
    return system.rest(s)


PROGRAM = """
import jax
import numpy as np
from tests.engine import test_sidecars as tests
if len(__import__("sys").argv) > 1:
    jax.make_jaxpr = None
print(tests.simulated(tests.paper_robot()).tobytes().hex())
"""


def test_another_process_does_not_trace(cache):
    run = [sys.executable, "-c", PROGRAM]
    environment = {**os.environ, "KNODE_COSSERAT_CODE": "quick"}
    found = []
    for seed, arguments in (("1", []), ("2", ["again"])):
        environment["PYTHONHASHSEED"] = seed
        done = subprocess.run(run + arguments, capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        found.append(done.stdout)
    assert found[0] == found[1]


OWN = """
import functools
import knode_cosserat as kc
import own_helper

FACTOR = 2.0
TABLE = {"a": (1.0, 2.0)}


def power(x):
    return FACTOR * x * TABLE["a"][1]


def made(gain):
    return lambda x: gain * x


law = made(3.0)


class Robot(kc.robots.TendonRobot):
    SLOPE = 4.0

    def balance(self, *arguments):
        y_s = super().balance(*arguments)
        return y_s + 0.0 * power(self.SLOPE) + own_helper.shift(law(0.0)) * [each for each in (0.0,)][0]
"""
HELPER = "def shift(x):\n    return x + 5.0\n"


def name_of_own(folder, own, helper):
    """Return the sidecar's name of a function of two modules of a user."""
    for name, text in (("own_helper", helper), ("own", own)):
        path = folder / f"{name}.py"
        path.write_text(text)
        spec = importlib.util.spec_from_file_location(name, path)
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        exec(compile(text, path, "exec"), module.__dict__)
    return sidecars.name_of((module.Robot, module.law))


def test_code_of_users_is_part_of_the_name(tmp_path):
    first = name_of_own(tmp_path, OWN, HELPER)
    assert first is not None and name_of_own(tmp_path, OWN, HELPER) == first
    changes = ("FACTOR = 2.0", "FACTOR = 2.5"), ("1.0, 2.0", "1.0, 2.5"), ("made(3.0)", "made(3.5)")
    changes += ("SLOPE = 4.0", "SLOPE = 4.5"), ("y_s + 0.0", "y_s + 0.5"), ("(0.0,)", "(0.5,)")
    names = [name_of_own(tmp_path, OWN.replace(*change), HELPER) for change in changes]
    names += [first, name_of_own(tmp_path, OWN, HELPER.replace("5.0", "5.5"))]
    assert None not in names and all(one != other for one, other in itertools.combinations(names, 2))


def test_what_cannot_be_described_has_no_sidecar(tmp_path):
    assert name_of_own(tmp_path, OWN.replace("FACTOR = 2.0", "FACTOR = open(__file__)"), HELPER) is None
    assert sidecars.name_of((object(),)) is None
    assert sidecars.name_of((lambda: object,)) is not None


@pytest.mark.parametrize("name", kc.catalog())
def test_systems_of_the_package_have_one(name):
    names = [sidecars.name_of((pattern.Pattern.of(kc.load_robot(name)).system,)) for _ in range(2)]
    assert names[0] is not None and names[0] == names[1]
