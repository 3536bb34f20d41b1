"""`init`: files for each kind that load, hold the answers and have equilibria; questions; bad answers."""

import json
import math
import re

import pytest
from typer.testing import CliRunner

import knode_cosserat as kc
from knode_cosserat.cli import app
from knode_cosserat.cli.arguments import modified
from knode_cosserat.cli.init import MATERIALS, QUESTIONS
from tests.commands import run, succeeded

KINDS = {
    "tendons": "routed-tendon-robot",
    "chambers": "slender-rod",
    "tubes": "concentric-tube-robot",
    "rod": "slender-rod",
}


def written(tmp_path, *options):
    file = tmp_path / "mine.yaml"
    succeeded("init", file, "--force", *options)
    return kc.load_robot(file)


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_alone_writes_a_robot_with_comments(tmp_path, kind):
    file = tmp_path / "mine.yaml"
    facts = json.loads(succeeded("init", file, "--kind", kind, "--json"))
    robot = kc.load_robot(file)
    assert robot.kind == KINDS[kind] == facts["kind"]
    assert facts["controls"] == list(robot.control_layout.names)
    assert file.read_text().count("#") > 4


def test_answers_are_in_the_file(tmp_path):
    robot = written(
        tmp_path,
        *("--kind", "tendons", "--length", "0.4 m", "--diameter", "2.5mm", "--material", "nitinol"),
        *("--tendons", "4", "--offset", "1 cm", "--tip-mass", "0.012", "--mounted", "down"),
    )
    assert (robot.length, robot.radius, robot.density) == (0.4, 0.00125, 6450.0)
    assert robot.youngs_modulus == 60e9 and robot.tendon_offset == 0.01
    assert robot.tendon_angles == pytest.approx([0, math.pi / 2, math.pi, 3 * math.pi / 2], abs=1e-6)
    assert robot.gravity[2] == 9.81 and robot.loads[0].mass == 0.012
    rest = kc.equilibrium(robot, [5.0, 0.0, 0.0, 0.0])
    # it hangs, and its tip bends towards the tendon that pulls
    assert rest.position[0, -1, 0] > 1e-3


def test_motors_wind_up_tendons(tmp_path):
    robot = written(tmp_path, "--kind", "tendons", "--drive", "motor")
    assert robot.drive == "reel" and robot.control_layout.names == ("motor",)


def test_tubes_have_a_number_each(tmp_path):
    robot = written(
        tmp_path,
        *("--kind", "tubes", "--lengths", "0.2, 0.1 m", "--outer", "1.5, 2.5 mm", "--inner", "1, 2mm"),
        *("--curvatures", "10, 5", "--curved", "50 mm, 3 cm", "--behind", "100, 50 mm"),
    )
    inner, outer = robot.tubes
    assert (inner.radius, inner.inner_radius, inner.curvature, inner.curved) == (0.00075, 0.0005, 10.0, 0.05)
    assert (outer.transmission, outer.end, outer.curved) == (0.05, 0.5, 0.03)


def test_a_guess_of_damping_is_a_twentieth_of_the_critical(tmp_path):
    robot = written(tmp_path, "--kind", "rod", "--material", "nitinol", "--tip-mass", "0 g")
    fixed = robot.replace(base_end=kc.robots.ends.Clamped(), gravity=[0, 0, 0])
    (ratio,) = kc.statics.modes(kc.equilibrium(fixed, []), count=1).damping
    # the formula takes rotary inertia and shear of a slender rod as none
    assert ratio == pytest.approx(0.05, rel=0.03)


def test_questions_are_asked_one_by_one_and_wrong_answers_again(tmp_path, monkeypatch):
    monkeypatch.setattr("knode_cosserat.cli.init.is_terminal", lambda: True)
    file = tmp_path / "asked.yaml"
    answers = ["chambers", "long", "180 mm", "22 mm", "dragon-skin-30", "", "", "", "10 g", "down"]
    result = CliRunner().invoke(app, ["init", str(file)], input="\n".join(answers) + "\n")
    assert result.exit_code == 0, result.stderr
    assert "allowed is such as 250 mm" in result.stderr
    robot = kc.load_robot(file)
    assert (robot.length, robot.radius, robot.youngs_modulus) == (0.18, 0.011, 600e3)
    assert robot.loads[0].mass == 0.01 and robot.effects[0].count == 3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "--kind is missing; required where nobody can be asked: tendons, chambers, tubes, rod"),
        (["--kind", "tendons", "--length", "3 kg"], "kg is no unit of a number in m"),
        (["--kind", "tendons", "--length", "-3 mm"], "numbers are zero or more"),
        (["--kind", "tendons", "--length", "3, 4 mm"], "allowed is one number, such as 250 mm"),
        (["--kind", "tendons", "--length", "300"], "length must be .* Did you mean 0.3"),
        (
            ["--kind", "tendons", "--chambers", "3"],
            "--chambers is not for --kind tendons; allowed is --length",
        ),
        (["--kind", "rod", "--material", "siliconee"], "did you mean silicone"),
        (["--kind", "chambers", "--chamber-diameter", "20 mm"], "allowed is a smaller diameter or distance"),
        (["--kind", "chambers", "--chambers", "0"], "a whole number from 1 to 64"),
        (["--kind", "tubes", "--outer", "1, 2 mm"], "lengths has 3, outer has 2; .* change --outer"),
    ],
)
def test_a_wrong_answer_is_one_line_and_writes_nothing(tmp_path, options, words):
    file = tmp_path / "bad.yaml"
    result = run("init", file, *options)
    assert result.exit_code == 2 and not file.exists()
    assert re.search(words, result.stderr), result.stderr


def test_a_file_is_not_replaced_unless_forced(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("mine")
    result = run("init", file, "--kind", "rod")
    assert result.exit_code == 2 and "is there already" in result.stderr and file.read_text() == "mine"
    succeeded("init", file, "--kind", "rod", "--force")
    assert kc.load_robot(file).kind == "slender-rod"


@pytest.mark.parametrize("material", MATERIALS)
def test_materials_are_within_what_robots_allow(tmp_path, material):
    written(tmp_path, "--kind", "rod", "--material", material)


def test_every_question_is_an_option():
    from knode_cosserat.cli.init import _Answers

    assert {name for questions in QUESTIONS.values() for name in questions} | {"kind"} == set(
        _Answers._fields
    )


def test_a_modulus_without_effect_is_said():
    robot = kc.load_robot("delrin-tendon-robot").replace(bending_stiffness=[0.1, 0.1, 0.07])
    with pytest.warns(
        UserWarning, match="youngs_modulus has no effect on bending and twisting: the robot states"
    ) as seen:
        modified(robot, ["youngs_modulus=1 GPa"])
    assert len(seen) == 1
