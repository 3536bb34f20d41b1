"""The program, called in the process of the tests."""

import json

import pytest
import typer.testing

from knode_cosserat.cli import app
from studies.__main__ import app as studies

ROBOT = "delrin-tendon-robot"
COMMANDS = (
    "init",
    "simulate",
    "equilibrium",
    "info",
    "reach",
    "modes",
    "workspace",
    "fit",
    "evaluate",
    "plot",
    "animate",
    "inspect",
    "sweep",
    "record-virtual",
    "schema",
    "doctor",
    "view",
    "robot connect",
    "robot reset",
    "robot tare",
    "robot calibrate",
    "robot jog",
    "robot record",
    "robot run",
    "robot steer",
    "robot commission",
)


def run(*arguments):
    """What the program prints and exits with, in this process."""
    return typer.testing.CliRunner().invoke(app, [str(argument) for argument in arguments])


def run_study(*arguments):
    """The same of `python -m studies`."""
    return typer.testing.CliRunner().invoke(studies, [str(argument) for argument in arguments])


def succeeded(*arguments):
    result = run(*arguments)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    return result.stdout


def told(*arguments):
    """The one JSON object on stdout."""
    text = succeeded(*arguments, "--json")
    assert text.count("\n") == 1
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def simulated(path, *more, controls="sine:0.5", steps=16):
    return ("simulate", ROBOT, "--controls", controls, "--steps", steps, "--out", path, *more)
