"""The examples of CONTRIBUTING.md are those of tests; here are those of effects that `identify` finds."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification import (
    effects,
    numbers_at,
    part_effects,
    reel_effects,
    rod_effects,
    soft_effects,
    tendon_effects,
)
from knode_cosserat.identification.effects import PossibleEffect, along_axes, library_model, register
from knode_cosserat.robots import Wrench, loads, parameter

ROOT = Path(__file__).parents[1]
EXAMPLES = re.findall(
    r"^```python\n(.*?)^```\n\n`(tests/[\w/]+\.py)`", (ROOT / "CONTRIBUTING.md").read_text(), re.M | re.S
)


def tilted(robot, values):
    return robot.replace(gravity=jnp.asarray(robot.gravity) + jnp.stack([*values, 0.0 * values[0]]))


class Wind(loads.SpreadLoad):
    """A steady wind."""

    kind: ClassVar[str] = "wind"

    force: Any = parameter(
        "N/m", "force per length, global frame", shape="vector", low=-1e3, high=1e3, default=(0.0, 0.0, 0.0)
    )

    def wrench(self, motion, control):
        return Wrench(self.force, jnp.zeros(3))


def in_wind(robot):
    return robot.replace(loads=(*robot.loads, Wind()))


#: they register themselves when they are imported, and that is to last
REGISTERED = part_effects, reel_effects, rod_effects, soft_effects, tendon_effects


@pytest.fixture
def tilt(monkeypatch):
    monkeypatch.setattr(effects, "_libraries", dict(effects._libraries))

    @register()
    def tilt_effects(nominal, usual):
        """Return the effect of a table that is not level."""
        return [PossibleEffect("tilt", along_axes("gravity", "m/s2", 0.5, "xy"), tilted)]


@pytest.fixture
def wind(monkeypatch):
    monkeypatch.setattr(effects, "_libraries", dict(effects._libraries))

    @register()
    def wind_effects(nominal, usual):
        """Return the effect of a wind of some 0.05 N/m."""
        return [PossibleEffect("wind", numbers_at(in_wind(nominal), "loads.wind.force", 0.05), part=in_wind)]


def test_an_effect_finds_its_part_among_those_of_others(wind):
    """The tip mass of the library is a load too, and stands before the wind."""
    nominal = kc.load_robot("delrin-routed-tendon-robot")
    model = library_model(nominal, np.ones((2, 4)))
    x = np.zeros(model.size)
    x[model.slice("wind")] = 1.0, -2.0, 0.0
    for names, added in ((model.names, ["attached-mass", "wind"]), (("wind",), ["wind"])):
        robot = model.reduced(x, names)
        assert [load.kind for load in robot.loads[len(nominal.loads) :]] == added
        np.testing.assert_allclose(robot.loads[-1].force, [0.05, -0.1, 0.0])


def test_each_way_to_extend_the_package_has_an_example():
    assert len(EXAMPLES) == 13


@pytest.mark.parametrize(("code", "file"), EXAMPLES, ids=[file for _, file in EXAMPLES])
def test_an_example_is_code_of_its_test(code, file):
    def statements(text):
        """Return the code without imports, as the formatter may break its lines elsewhere."""
        tree = ast.parse(text)
        return [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.stmt)]

    own = {line for text in statements((ROOT / file).read_text()) for line in text.splitlines()}
    lines = [line for text in statements(code) for line in text.splitlines() if "import" not in line]
    assert not [line for line in lines if line not in own]


def test_each_example_is_complete():
    """Each runs alone, in one process with the others."""
    run = "import sys, json\nfor code in json.load(sys.stdin): exec(code, {'__name__': 'example'})"
    given = json.dumps([code for code, _ in EXAMPLES])
    subprocess.run([sys.executable, "-c", run], input=given, text=True, check=True)


@pytest.mark.slow
def test_a_registered_effect_is_identified(tilt):
    robot = kc.load_robot("delrin-tendon-robot").replace(nodes=6)
    truth = robot.replace(gravity=(0.2, -0.1, -9.81), bending_damping=1e-3)
    controls = kc.controls.sine(1.0, 40, 0.05, amplitude=0.5, base=1.0)
    motion = kc.simulate(truth, controls, 0.05, initial=kc.equilibrium(truth, controls[0]))
    measured = kc.recordings.Measurements.of(motion, fractions=(0.5, 1.0))
    found = kc.identify(robot, [measured], effects=["tilt"])
    # the base's rotation, which is always identified, has nearly the same effect
    assert "tilt" in found.effects and np.any(np.asarray(found.robot.gravity)[:2] != 0.0)
    assert {"gravity.x", "gravity.y"} <= {estimate.label for estimate in found.estimates}
    (nominal,), (error,) = found.nominal_error.values(), found.error.values()
    assert error < nominal
    assert len({float(np.asarray(it.knowledge.gravity)[0]) for it in found.ensemble}) > 5
