"""Command that asks about a robot and writes its file: init."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import typer

from knode_cosserat._files.writing import replacing
from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat._units import UnitError, in_unit
from knode_cosserat.cli.arguments import argument, command_line
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app

#: kinds of robots, with what drives them
KINDS = {
    "tendons": "a backbone that tendons bend, pulled by forces or wound up by motors",
    "chambers": "a soft arm with pressure chambers",
    "tubes": "precurved concentric tubes, turned and pushed at their bases",
    "rod": "a rod or cable that is moved or loaded at its ends",
}
#: by name: Young's modulus and density, of data sheets; the first name of a material is the usual one
MATERIALS = {
    "ecoflex-30": ("70 kPa", "1070 kg/m3"),
    "dragon-skin-10": ("260 kPa", "1070 kg/m3"),
    "dragon-skin-30": ("600 kPa", "1080 kg/m3"),
    "silicone": ("300 kPa", "1080 kg/m3"),
    "rubber": ("3 MPa", "1100 kg/m3"),
    "tpu": ("26 MPa", "1200 kg/m3"),
    "nylon": ("2.5 GPa", "1140 kg/m3"),
    "delrin": ("2.8 GPa", "1410 kg/m3"),
    "peek": ("3.7 GPa", "1310 kg/m3"),
    "fibreglass": ("40 GPa", "1900 kg/m3"),
    "nitinol": ("60 GPa", "6450 kg/m3"),
    "carbon": ("120 GPa", "1600 kg/m3"),
    "steel": ("200 GPa", "7850 kg/m3"),
}
#: gravity (m/s2, global frame; z points along the straight robot) of a robot by how it is mounted
MOUNTED = {"up": [0.0, 0.0, -9.81], "down": [0.0, 0.0, 9.81], "sideways": [-9.81, 0.0, 0.0]}
#: damping ratio of the first bending mode that the file begins with, and β² of this mode
DAMPING_RATIO, FIRST_MODE = 0.05, 3.516


class Question(NamedTuple):
    """Question about a robot: text, default by kind or for all, unit (None: not a number), and choices."""

    text: str
    default: Any
    unit: str | None = None
    choices: Sequence[str] = ()


#: questions that several kinds have
LENGTH = Question("length beyond the clamp", "250 mm", "m")
MATERIAL = Question("material", "silicone", None, tuple(MATERIALS))
TIP_MASS = Question("mass at the tip, such as a marker", "5 g", "kg")
UP, DOWN = (Question("direction of the straight robot", way, None, tuple(MOUNTED)) for way in ("up", "down"))
#: questions about each kind, in their order
QUESTIONS = {
    "tendons": {
        "length": LENGTH,
        "diameter": Question("diameter of the backbone", "3 mm", "m"),
        "material": MATERIAL._replace(default="steel"),
        "tendons": Question("number of tendons", "3", ""),
        "offset": Question("distance of the tendons from the axis", "8 mm", "m"),
        "drive": Question("what is commanded", "tension", None, ("tension", "motor")),
        "tip_mass": TIP_MASS,
        "mounted": UP,
    },
    "chambers": {
        "length": LENGTH,
        "diameter": Question("diameter of the arm", "25 mm", "m"),
        "material": MATERIAL,
        "chambers": Question("number of chambers", "3", ""),
        "chamber_diameter": Question("diameter of a chamber", "6 mm", "m"),
        "offset": Question("distance of the chambers from the axis", "7 mm", "m"),
        "tip_mass": TIP_MASS,
        "mounted": DOWN,
    },
    "tubes": {
        "material": MATERIAL._replace(default="nitinol"),
        "lengths": Question("lengths beyond the plate, the inner tube first", "150, 125, 85 mm", "m"),
        "outer": Question("outer diameters", "1.1, 1.7, 2.2 mm", "m"),
        "inner": Question("inner diameters", "0.6, 1.2, 1.75 mm", "m"),
        "curvatures": Question("curvatures of the curved parts", "18, 12, 3.5 1/m", "1/m"),
        "curved": Question("lengths of the curved parts", "90, 100, 85 mm", "m"),
        "behind": Question("lengths behind the plate, up to where tubes are held", "250, 180, 90 mm", "m"),
        "mounted": UP,
    },
    "rod": {
        "length": LENGTH,
        "diameter": Question("diameter", "5 mm", "m"),
        "material": MATERIAL,
        "tip_mass": TIP_MASS._replace(default="0 g"),
        "mounted": DOWN,
    },
}


class _Answers(NamedTuple):
    """Answers; those that are not given are asked for on a terminal, and else have their defaults.

    Options:
        kind (--kind): What drives the robot.
        length (--length LENGTH): Length beyond the clamp, such as 250mm.
        mounted (--mounted): Direction of the straight robot.
        diameter (--diameter LENGTH): Outer diameter, such as 3mm.
        material (--material NAME): Material, such as steel, silicone or nitinol.
        tendons (--tendons N): Number of tendons, evenly around the axis.
        chambers (--chambers N): Number of chambers, evenly around the axis.
        chamber_diameter (--chamber-diameter LENGTH): Diameter of a chamber.
        offset (--offset LENGTH): Distance of tendons or chambers from the axis.
        drive (--drive): What is commanded: tensions, or angles of motors that wind up the tendons.
        tip_mass (--tip-mass MASS): Mass at the tip, such as 5g.
        lengths (--lengths LENGTHS): Lengths of tubes beyond the plate, the inner tube first.
        outer (--outer LENGTHS): Outer diameters of tubes.
        inner (--inner LENGTHS): Inner diameters of tubes.
        curvatures (--curvatures CURVATURES): Curvatures of the tubes' curved parts.
        curved (--curved LENGTHS): Lengths of the tubes' curved parts.
        behind (--behind LENGTHS): Lengths of tubes behind the plate.
    """

    kind: Literal["tendons", "chambers", "tubes", "rod"] | None = None
    length: str | None = None
    mounted: Literal["up", "down", "sideways"] | None = None
    diameter: str | None = None
    material: str | None = None
    tendons: int | None = None
    chambers: int | None = None
    chamber_diameter: str | None = None
    offset: str | None = None
    drive: Literal["tension", "motor"] | None = None
    tip_mass: str | None = None
    lengths: str | None = None
    outer: str | None = None
    inner: str | None = None
    curvatures: str | None = None
    curved: str | None = None
    behind: str | None = None


@app.command()
def init(
    answers: _Answers,
    file: Annotated[Path, argument("[FILE]", "Robot file that is written.")] = Path("my-robot.yaml"),
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Write a robot file from a few answers.

    Without --kind the questions are asked one by one, each with a default. Numbers have units: 250 mm, 3mm,
    50 GPa. The file has comments, and is a start: measure what you can, and `identify` finds the rest.

    Options:
        force (--force): Replace the file if it is there.
        as_json (--json): Print one JSON object on stdout instead of text.

    Examples:
        init
        init my-arm.yaml --kind chambers --length 180mm --diameter 22mm --material silicone --mounted down
        init tubes.yaml --kind tubes --curvatures "18, 12, 3.5 1/m"
    """
    if file.suffix not in (".yaml", ".yml"):
        raise ValueError(f"{file}: allowed is a name that ends in .yaml")
    if file.exists() and not force:
        raise ValueError(f"{file} is there already; give another name, or --force to replace it")
    given = {name: str(value) for name, value in answers._asdict().items() if value is not None}
    asks = "kind" not in given and is_terminal()
    if "kind" not in given and not asks:
        raise ValueError(f"--kind is missing; required where nobody can be asked: {', '.join(KINDS)}")
    if asks:
        for name, words in KINDS.items():
            typer.echo(f"  {name:9} {words}")
        given["kind"] = _asked(Question("what drives the robot", "tendons", None, tuple(KINDS)))
    kind = given.pop("kind")
    questions = QUESTIONS[kind]
    for name in given:
        if name not in questions:
            option = f"--{name.replace('_', '-')}"
            allowed = ", ".join(f"--{it.replace('_', '-')}" for it in questions)
            raise ValueError(f"{option} is not for --kind {kind}; allowed is {allowed}")
    values = {
        name: _asked(question)
        if asks and name not in given
        else _value(question, given.get(name, question.default), f"--{name.replace('_', '-')}")
        for name, question in questions.items()
    }
    text = "\n".join(_WRITERS[kind](values)) + "\n"
    from knode_cosserat.rods.robot_file import parse_robot

    robot = parse_robot(text, str(file))
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
    facts = {"robot": str(file), "kind": robot.kind, "controls": list(robot.control_layout.names)}
    following = {
        "see all numbers": command_line("info", file),
        "move it with the mouse": command_line("view", "--live", file),
        "read a log": command_line("inspect", "LOG.csv"),
        "identify it": command_line(
            "identify", file, "LOG.csv", "--config", "recording.yaml", "--out", "found.yaml"
        ),
    }
    lines = [f"wrote {file}, a {robot.kind}", "next:"]
    lines += [f"  {typed}  # {words}" for words, typed in following.items()]
    write_output(as_json, facts | {"next": list(following.values())}, lines)


# answers


def is_terminal() -> bool:
    """Return True if somebody can answer."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _asked(question: Question) -> Any:
    """Return the value of an answer; wrong answers are told, and asked for again."""
    choices = f" ({', '.join(question.choices)})" if question.choices else ""
    while True:
        answer = typer.prompt(f"{question.text}{choices}", default=question.default)
        try:
            return _value(question, answer, question.text)
        except ValueError as error:
            typer.echo(str(error), err=True)


def _value(question: Question, answer: str, name: str) -> Any:
    """Return a word, a number in SI units, or a list of numbers. Raises `ValueError`."""
    if question.unit is None:
        if answer not in question.choices:
            hint = did_you_mean(answer, question.choices)
            raise ValueError(f"{name} is {answer!r}; allowed is {', '.join(question.choices)}{hint}")
        return answer
    words = [word.strip() for word in str(answer).split(",")]
    unit = next((it for word in reversed(words) if (it := word.lstrip("+-.0123456789eE").strip())), "")
    try:
        numbers = [_number(word, unit, question.unit) for word in words]
    except (UnitError, ValueError) as error:
        raise ValueError(f"{name} is {answer!r}; allowed is such as {question.default}: {error}") from None
    several = "," in str(question.default)
    if not several and len(numbers) > 1:
        raise ValueError(f"{name} is {answer!r}; allowed is one number, such as {question.default}")
    return numbers if several else numbers[0]


def _number(word: str, usual: str, unit: str) -> float:
    """Return a number in SI units; one without a unit has the usual one of the answer."""
    number = in_unit(word, unit)
    if number is None:
        number = in_unit(f"{word} {usual}", unit) if usual else float(word)
    if number is None or not (math.isfinite(number) and number >= 0.0):
        raise ValueError("numbers are zero or more")
    return number


# files


def _head(kind: str, description: str) -> list[str]:
    return [
        "# Numbers are in SI units, or have a unit, such as 250 mm. Change what you can measure; `identify`",
        "# finds stiffness, damping and other numbers from recordings.",
        "# yaml-language-server: $schema=robot.schema.json",
        "format: 2",
        f"kind: {kind}",
        f"description: {description}",
        "parameters:",
    ]


def _of_length(number: float) -> str:
    return f"{1e3 * number:.6g} mm"


def _gravity(mounted: str) -> str:
    words = {"up": "it stands", "down": "it hangs", "sideways": "its rest direction is level"}[mounted]
    return f"  gravity: {MOUNTED[mounted]}  # m/s2, global frame; z points along the straight robot: {words}"


def _material(name: str) -> list[str]:
    modulus, density = MATERIALS[name]
    return [
        f"  youngs_modulus: {modulus}  # {name}, of data sheets: a guess will do",
        f"  density: {density}  # {name}; parts along the robot count, too",
    ]


def _damping(values: dict[str, Any], second_moment: float, area: float) -> str:
    """Return the damping for a usual damping ratio of the first mode of a clamped rod."""
    modulus, density = (
        in_unit(it, unit) or 0.0
        for it, unit in zip(MATERIALS[values["material"]], ("Pa", "kg/m3"), strict=True)
    )
    length, stiffness = values["length"], modulus * second_moment
    carried = density * area * length + values.get("tip_mass", 0.0)
    frequency = FIRST_MODE * math.sqrt(stiffness * length / carried) / length**2
    number = 2.0 * DAMPING_RATIO * stiffness / frequency
    return (
        f"  bending_damping: {number:.2g} N m2 s  # a guess: {DAMPING_RATIO:.0%} of the critical damping at "
        f"{frequency / (2.0 * math.pi):.2g} Hz, the first mode"
    )


def _backbone(values: dict[str, Any]) -> list[str]:
    radius = values["diameter"] / 2.0
    return [
        f"  length: {_of_length(values['length'])}  # from the clamp to the tip, with a ruler",
        f"  radius: {_of_length(radius)}  # with a calliper",
        *_material(values["material"]),
        _damping(values, math.pi * radius**4 / 4.0, math.pi * radius**2),
        _gravity(values["mounted"]),
    ]


def _tip_mass(values: dict[str, Any]) -> list[str]:
    if not values["tip_mass"]:
        return []
    return ["  loads:", f"    - {{kind: attached-mass, at: 1, mass: {1e3 * values['tip_mass']:.4g} g}}"]


def _around(count: float, text: str) -> list[float]:
    if not (count == int(count) and 1 <= count <= 64):
        raise ValueError(f"the number of {text} is {count:g}; allowed is a whole number from 1 to 64")
    return [round(2.0 * math.pi * k / count, 6) for k in range(int(count))]


def _tendons(values: dict[str, Any]) -> list[str]:
    angles = _around(values["tendons"], "tendons")
    lines = [
        *_head("routed-tendon-robot", f"a backbone with {len(angles)} tendons"),
        *_backbone(values),
        f"  tendon_offset: {_of_length(values['offset'])}  # from the axis to the holes of the tendons",
        f"  tendon_angles: {angles}  # rad, about the backbone",
    ]
    if values["drive"] == "motor":
        motors, radii, zeros = [*range(1, len(angles) + 1)], [0.01] * len(angles), [0.0] * len(angles)
        lines += [
            "  drive: reel  # motors wind up the tendons: controls are their angles in rad",
            f"  reels: {{kind: reels, motors: {motors}, radius: {radii}, zero: {zeros}}}"
            "  # m; rad, what the log reads of the straight arm: 2048 ticks are 3.1416",
        ]
    return [*lines, *_tip_mass(values)]


def _chambers(values: dict[str, Any]) -> list[str]:
    angles = _around(values["chambers"], "chambers")
    radius, hole, offset = values["diameter"] / 2.0, values["chamber_diameter"] / 2.0, values["offset"]
    if offset + hole >= radius:
        raise ValueError(
            f"chambers of {_of_length(2.0 * hole)} at {_of_length(offset)} from the axis leave the arm of "
            f"{_of_length(2.0 * radius)}; allowed is a smaller diameter or distance"
        )
    return [
        *_head("slender-rod", f"a soft arm with {len(angles)} pressure chambers"),
        *_backbone(values),
        *_tip_mass(values),
        "  effects:",
        f"    - {{kind: chambers, angles: {angles}, offset: {_of_length(offset)}, "
        f"radius: {_of_length(hole)}}}",
        "    - {kind: hyperelastic}  # silicone stiffens as it is stretched: neo-Hookean",
    ]


def _tubes(values: dict[str, Any]) -> list[str]:
    names = ("lengths", "outer", "inner", "curvatures", "curved", "behind")
    counts = {len(values[name]) for name in names}
    if len(counts) > 1:
        count = len(values["lengths"])
        others = [name for name in names if len(values[name]) != count]
        words = ", ".join(f"{name} has {len(values[name])}" for name in others)
        options = ", ".join(f"--{name}" for name in others)
        raise ValueError(f"lengths has {count}, {words}; allowed is a number for each tube: change {options}")
    modulus, density = MATERIALS[values["material"]]
    longest = values["lengths"][0]
    lines = [
        *_head("concentric-tube-robot", f"{len(values['outer'])} concentric tubes"),
        f"  length: {_of_length(longest)}  # of the inner tube beyond the plate, without insertion",
        _damping(values | {"length": longest}, *_all_tubes(values)),
        _gravity(values["mounted"]),
        "  tubes:  # the inner tube first; end is a part of the length",
    ]
    for length, outer, inner, curvature, curved, behind in zip(
        *(values[name] for name in names), strict=True
    ):
        lines.append(
            f"    - {{kind: tube, radius: {_of_length(outer / 2)}, inner_radius: {_of_length(inner / 2)}, "
            f"youngs_modulus: {modulus}, density: {density}, curvature: {curvature:g} 1/m, "
            f"curved: {_of_length(curved)}, transmission: {_of_length(behind)}, end: {length / longest:.8g}}}"
        )
    return lines


def _all_tubes(values: dict[str, Any]) -> tuple[float, float]:
    """Return second moment and area of all sections of tubes together."""
    sections = [*zip(values["outer"], values["inner"], strict=True)]
    moment = sum(outer**4 - inner**4 for outer, inner in sections) * math.pi / 64.0
    return moment, sum(outer**2 - inner**2 for outer, inner in sections) * math.pi / 4.0


def _rod(values: dict[str, Any]) -> list[str]:
    return [
        *_head("slender-rod", "a rod that is moved at its base"),
        *_backbone(values),
        "  base_end: {kind: driven, axes: [x, y, z, rx, ry, rz]}  # controls: displacements and rotations",
        *_tip_mass(values),
    ]


_WRITERS: dict[str, Callable[[dict[str, Any]], list[str]]] = {
    "tendons": _tendons,
    "chambers": _chambers,
    "tubes": _tubes,
    "rod": _rod,
}
