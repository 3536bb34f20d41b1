"""Controllers by name: a worked example of a new one, and lists that come from the registry."""

import re
from pathlib import Path

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.control import (
    Command,
    Controller,
    ControlLimits,
    PredictiveController,
    Sensor,
    SimulatedPlant,
    constant,
    controller_named,
    register_controller,
    run_loop,
)
from knode_cosserat.control.commands import CONTROLLERS
from knode_cosserat.control.tip_feedback import PID
from knode_cosserat.estimation import TipPosition
from tests.commands import run, succeeded, told

ROBOT = kc.load_robot("delrin-tendon-robot")
LIMITS = ControlLimits(0.0, 10.0, 40.0)


@register_controller("bend", "the tendon on the side of the target pulls")
class Bend(Controller):
    """Controller of the example in CONTRIBUTING.md: four tendons around a robot along z."""

    def __init__(self, robot, dt, limits, *, gain: float = 5.0, turns: int = 0):
        """Set the gain (N/m) and the number of quarter turns from the target to the tendon."""
        self.dt, self.limits, self.gain, self.turns = dt, limits.of(robot), gain, turns
        self.reset(self.limits.safe)

    def reset(self, control):
        """Start from a control that acts now."""
        self._control = np.array(control)

    def command(self, time, measured, reference):
        """Return pulls in proportion to the target's coordinates."""
        x, y, _ = reference.at([time])[0]
        pull = np.roll(self.gain * np.array([x, y, -x, -y]), self.turns)
        self._control = self.limits.applied(pull, self._control, self.dt)
        return Command(self._control)


@pytest.fixture(scope="module", autouse=True)
def forgotten():
    """The registry of other tests does not have the example."""
    yield
    CONTROLLERS.pop("bend", None)


def test_a_controller_of_this_file_is_used_by_its_name():
    controller = controller_named("bend:gain=8,turns=1", ROBOT, 0.05, LIMITS)
    assert (type(controller), controller.gain, controller.turns) == (Bend, 8.0, 1)
    plant = SimulatedPlant(ROBOT, 0.05, Sensor(TipPosition()))
    log = run_loop(controller, plant, constant([0.5, 0.0, np.nan]), 0.2)
    assert log.fallbacks == 0 and log.control[-1].tolist() == [0.0, 4.0, 0.0, 0.0]


def test_the_command_line_has_it_without_more_code():
    assert "bend: the tendon on the side of the target pulls (bend:gain=5.0,turns=0)" in succeeded(
        "control", "delrin-tendon-robot", "--method", "list"
    )
    arguments = ("control", "delrin-tendon-robot", "--reference", "circle:radius=0.05,period=4")
    facts = told(*arguments, "--method", "bend:gain=20", "--seconds", 0.2)
    assert facts["periods"] == 4 and facts["fallbacks"] == 0
    refused = run(*arguments, "--method", "bend:gian=2")
    assert refused.exit_code == 2 and "has no option 'gian'; there are gain, turns; did you" in refused.stderr


def test_names_and_options_that_do_not_exist_are_told_in_one_line():
    assert isinstance(controller_named("pid", ROBOT, 0.05, LIMITS), PID)
    for name, message in (
        ("mpc", "there is no controller 'mpc'; there are "),
        ("pid:speed=1", "the controller 'pid' has no option 'speed'; there are proportional, integral"),
        ("pid:integral=fast", "pid: integral is 'fast'; allowed is a number"),
        ("predictive:horizon=2.5", "predictive: horizon is '2.5'; allowed is a whole number"),
    ):
        with pytest.raises(ValueError, match=message):
            controller_named(name, ROBOT, 0.05, LIMITS)
    with pytest.raises(ValueError, match=r"'pid' adapts no parameters; .*: ilqr, mppi, predictive"):
        controller_named("pid", ROBOT, 0.05, LIMITS, ["youngs_modulus"])
    with pytest.raises(ValueError, match="'pid' is registered already"):
        register_controller("pid", "another")(Bend)


def test_options_reach_the_controller():
    short = controller_named("predictive:horizon=10,knots=4", ROBOT, 0.05, LIMITS)
    assert isinstance(short, PredictiveController)
    assert (short.knots.horizon, short.knots.count) == (10, 4)


def test_the_documentation_lists_the_registry():
    text = (Path(__file__).parents[2] / "docs" / "control.md").read_text()
    rows = re.findall(r"^\| (\w+) \| `(\w+)` \| (.+?) \|$", text, re.MULTILINE)
    expected = {(name, each.__name__, each.help) for name, each in CONTROLLERS.items() if name != "bend"}
    assert set(rows) == expected and len(rows) == len(expected)
