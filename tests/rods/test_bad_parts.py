"""Constructors of robots and of their parts refuse what does not fit, in one line."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.robots import (
    Insertion,
    ParameterError,
    Relaxation,
    SpinningFrame,
    chambers,
    ends,
    loads,
    routing,
    section,
    surroundings,
    tendons,
    tubes,
)
from knode_cosserat.rods.assembly import NeighbourContact

PAPER = kc.load_robot("delrin-tendon-robot")
TABLE = {
    "bending_stiffness": [1.0, 2.0],
    "torsional_stiffness": [1.0],
    "axial_stiffness": [1.0],
    "mass_per_length": [1.0],
}


def paper(**changes):
    return PAPER.replace(**changes)


def rod(**changes):
    return kc.robots.SlenderRod(
        **{"length": 0.5, "radius": 0.005, "density": 1e3, "youngs_modulus": 1e7} | changes
    )


def strip(**changes):
    flat = section.RectangularSection(width=0.012, height=0.003)
    return rod(radius=None, cross_section=flat).replace(**changes)


def arm(**changes):
    own = {"angles": 2.0 * np.pi / 3.0 * np.arange(3), "offset": 0.007, "radius": 0.004} | changes
    return rod(radius=0.0125, effects=(chambers.Chambers(**own),))


def fed(effects=(), **changes):
    return rod(effects=(Insertion(reserve=0.5, retraction=0.3), *effects), **changes)


def tube(k, **changes):
    return tubes.Tube(
        **{
            "radius": 1e-3 * (k + 1),
            "inner_radius": 1e-3 * (k + 0.5),
            "density": 6450.0,
            "youngs_modulus": 6e10,
            "curvature": 0.0,
        }
        | changes
    )


def nested(**changes):
    return tubes.ConcentricTubeRobot(**{"length": 0.2, "tubes": (tube(0), tube(1))} | changes)


def routed(**changes):
    return kc.robots.RoutedTendonRobot.like(PAPER, **changes)


def legs(**changes):
    return kc.load_robot("six-legged-robot").replace(**changes)


def assembly(*rods, bodies=(), **more):
    return kc.robots.Assembly(rods=rods, bodies=bodies, **more)


def pulled(function):
    return routing.FunctionRouting(function)


def misspelt(**names):
    return kc.robots.TendonRobot(length=1.0, radius=0.01, density=1e3, **names)


class Wire(kc.robots.SlenderRod):
    """A user's rod with a constructor of its own."""

    def __init__(self, gauge):
        super().__init__(length=1.0, radius=1e-3 / gauge, density=8e3, youngs_modulus=2e11)


def on(body, end=ends.Clamped):
    return end(body=body)


def held_by_a_body():
    return ARM.replace(base_end=on("hand")).rest(0.0)


def directions(part, name):
    refused = rf"^{part}: {name} must be a direction, "
    short = ([0, 0, 0], [0, 1e-12, 0], [1e-9, 0, 0], [1e-200, 0, 0])
    return (
        ({name: "up"}, refused + ".*got 'up'"),
        *(({name: it}, refused + r".*above 1e-09\), ") for it in short),
    )


ARM, HAND = rod(name="arm"), kc.robots.RigidBody(name="hand")
BAD = {
    paper: (
        ({"youngs_modulo": 1e9},
         r"no parameter 'youngs_modulo'; there are length, radius, .*; did you mean youngs_modulus\?$"),
        ({"length": -0.1}, r"length must be between 0.001 and 20 m \(got -0.1\)$"),
        ({"length": "long"}, r"length must be a number between 0.001 and 20 m \(got 'long'\)$"),
        ({"length": [1.0, 2.0]}, r"length must be a number .* \(got \[1, 2\]\)$"),
        ({"density": np.nan}, r"density must be between .* \(got nan\)$"),
        ({"nodes": 1}, "nodes is 1; allowed is a whole number"),
        ({"nodes": 10.0}, "nodes is 10.0"),
        ({"gravity": [0.0, 1.0]}, r"gravity must be three numbers, .* \(got \[0, 1\]\)$"),
        ({"bending_stiffness": [[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]},
         r"bending_stiffness must be .*, not symmetric\)$"),
        ({"bending_stiffness": [-1.0, 1.0, 1.0]}, "bending_stiffness must be one number, three"),
        ({"drag": ["1", "2", "3"]}, "drag must be"),
        ({"drag": [True, True, False]}, "drag must be"),
        ({"drag": [[1.0], [1.0, 2.0]]}, "drag must be"),
    ),
    misspelt: (
        ({"yongs_modulus": 1e9},
         r"^TendonRobot has no parameter 'yongs_modulus'; .*; did you mean youngs_modulus\?$"),
    ),
    Wire: (({"gage": 2.0}, r"^Wire has no parameter 'gage'; there are gauge; did you mean gauge\?$"),),
    rod: (
        ({"base_end": ends.Sliding(axes=("x",), along="z")},
         "base_end is sliding; that is allowed as tip_end only"),
        ({"base_end": ends.Universal()}, "base_end is universal; that is allowed as tip_end only"),
        ({"effects": (Insertion(retraction=0.5),)}, "less than the robot's length"),
        ({"name": "a b"}, "name is 'a b'; allowed is a name of letters"),
    ),
    ends.Clamped: tuple(
        ({"orientation": short}, r"Clamped: orientation must be .* \(length above 1e-09\)")
        for short in ([1e-200, 0, 0, 0], [0, 0, 1e-9, 0], [0, 0, 0, 0])
    ),
    surroundings.Plane: directions("Plane", "normal"),
    surroundings.Cylinder: directions("Cylinder", "axis"),
    strip: (
        ({"radius": 0.01}, "radius and a cross_section are given; allowed is one of them"),
        ({"cross_section": None}, "radius is missing; required is radius, or a cross_section"),
        ({"density": None}, "density is missing; required is density, or a tabulated cross_section"),
        ({"youngs_modulus": None}, "youngs_modulus is missing; required is youngs_modulus, or a tabulated"),
        ({"cross_section": section.TabulatedSection(at=(0.0, 1.0), **TABLE)},
         "density and a tabulated cross_section are given; allowed is one of them"),
        ({"tip_radius": 0.01},
         "tip_radius is given with a rectangular cross_section; allowed is .* Use sect"),
        ({"cross_section.width": -1.0}, "RectangularSection: width must be between 1e-06 and 1 m"),
        ({"cross_section": 3.0}, "cross_section holds a float; allowed is a crosssection"),
    ),
    section.TabulatedSection: (
        (TABLE, "bending_stiffness has 2 values; allowed is 1, or one"),
        ({"at": (0.5, 0.2), **TABLE}, r"at is \[0.5, 0.2\]; allowed is places in order"),
    ),
    arm: (
        ({"radius": 0.0065}, "Chambers overlap: radius is 0.0065 m, and centres are 0.0121 m apart"),
        ({"angles": (0.0, 0.1)}, "overlap"),
        ({"area": 1e-5}, "allowed is either radius, of round chambers, or area"),
        ({"radius": None}, "allowed is either radius, of round chambers, or area"),
        ({"begin": 0.5, "end": 0.5}, "end is 0.5; allowed is a place beyond begin, 0.5"),
        ({"drive": "air"}, "drive is 'air'; allowed is pressure, liquid, gas"),
        ({"offset": -1.0}, "offset must be between 0 and 1 m"),
    ),
    fed: (
        ({"base_end": ends.Pinned()}, "clamped or driven base_end"),
        ({"loads": (loads.AttachedMass(mass=0.1, at=0.5),)},
         "load0 at a place within the rod; allowed are point"),
        ({"effects": (Relaxation(stiffness=0.5, time=1.0),)}, "parts without internal variables"),
        ({"effects": (SpinningFrame(1.0),)}, "a spinning-frame before it"),
    ),
    tube: (({"k": 0, "inner_radius": 0.002}, "inner_radius is 0.002; allowed is less than radius, 0.001"),),
    nested: (
        ({"tubes": ()}, r"tubes is \[\]; allowed is one or more, the innermost first"),
        ({"tubes": (tube(1), tube(0))}, "allowed are tubes in one another, the innermost first"),
        ({"tubes": (tube(0, end=0.5),)}, "no tube ends at the tip"),
        ({"loads": (loads.PointWrench(force=(1.0, 0.0, 0.0), at=0.5),)},
         "load0 within the rod; allowed on tubes"),
    ),
    tendons.Reels: (
        ({"motors": (1, 3), "radius": (0.1,)}, "one whole number for each tendon"),
        ({"motors": (1, -1)}, "radius is missing"),
        ({"motors": (1, -1), "radius": (0.1, 0.2)}, "radius has 2 numbers; allowed is 1, one for each motor"),
        ({"motors": (1, 2, 3), "radius": (0.1,) * 6},
         r"6 numbers.*motors, \[1, 2, 3\], has one number for each ten"),
        ({"motors": (1, 2), "taken_in": (0.0,)}, "taken_in has 1 numbers; allowed is 2, one for each tendon"),
    ),
    routed: tuple(({"routing": none}, r"^routing is \[\]; allowed is one or more, one for each tendon")
                  for none in ((), [])),
    routing.Straight: (
        ({"x": 20.0, "y": 0.0}, r"Straight: x must be between -1 and 1 m \(got 20\)"),
        ({"x": "left", "y": 0.0}, r"Straight: x must be a number .*'left'"),
        ({"x": 0.0, "y": 0.0, "end": 0.0}, r"Straight: end must be between 0.001 and 1 \(got 0\)"),
        ({"x": 0.0, "y": 0.0, "end": 1.2}, r"Straight: end must be .*\(got 1.2\)"),
        ({"x": 0.0, "y": 0.0, "end": "tip"}, r"Straight: end must be .*'tip'"),
        ({"x": 0.0, "y": 0.0, "end": True}, r"Straight: end must be .*True"),
    ),
    routing.Tapered: (
        ({"base_offset": 0.02, "end_offset": [0.01, 0.0]},
         r"Tapered: end_offset must be a number .*\(got \[0.01, 0\]\)"),
    ),
    routing.Helical: (
        ({"radius": -0.01, "phase": 0.0, "turns": 1.0},
         r"Helical: radius must be between 0 and 1 m \(got -0.01\)"),
        ({"radius": 0.01, "phase": 0.0, "turns": np.nan}, r"Helical: turns must be .*\(got nan\)"),
        ({"radius": 0.02, "phase": 0.0, "trns": 1.0},
         r"'trns'; there are radius, phase, turns, .*; did you mean turns\?"),
    ),
    routing.Polynomial: (({"x": [], "y": [0.0]}, r"Polynomial: x must be a list .*\(got \[\]\)"),),
    pulled: (
        ({"function": 0.02}, "FunctionRouting: function is 0.02; allowed is a JAX-traceable"),
        ({"function": lambda sigma: sigma}, "FunctionRouting: function gives shapes"),
        ({"function": lambda sigma: (sigma, [0.0])}, "FunctionRouting: function"),
        ({"function": lambda sigma: (float(sigma), 0.0)}, "function raises Concretization"),
    ),
    legs: (({"base_angles": np.arange(5) * np.pi / 3}, "there are 5 base_angles and 6 platform_angles"),),
    on: (({"body": "hand", "end": ends.Sliding}, "an end on a body cannot slide"),),
    held_by_a_body: (({}, "an end is held by the body 'hand'"),),
}  # fmt: skip
ASSEMBLIES = {
    r"rods is \[\]; allowed is one or more": ((), {}),
    "a rod or a body has no name": ((ARM,), {"bodies": (kc.robots.RigidBody(),)}),
    "2 of the rods and bodies have the name 'arm'": ((ARM, ARM), {}),
    "arm.tip_end.body is 'hnad'; allowed is hand; did you mean hand": (
        (ARM.replace(tip_end=on("hnad")),), {"bodies": (HAND,)}
    ),
    "the body 'hand' holds no rod": ((ARM,), {"bodies": (HAND,)}),
    "no rod joins arm to the ground": ((ARM.replace(base_end=on("hand")),), {"bodies": (HAND,)}),
    "arm.base_end is free; allowed is an end that is held": ((ARM.replace(base_end=ends.Free()),), {}),
    "arm has a spinning frame": ((ARM.replace(effects=(SpinningFrame(1.0),)),), {}),
    "arm has a gravity of its own": ((ARM.replace(gravity=(0.0, 0.0, 1.0)),), {}),
    "a contact is of 'arm' and 'leg'; allowed is two of arm": (
        (ARM,), {"contacts": (NeighbourContact(first="arm", second="leg"),)}
    ),
}  # fmt: skip
CASES = [(make, (), given, words) for make, cases in BAD.items() for given, words in cases]
CASES += [(assembly, rods, given, words) for words, (rods, given) in ASSEMBLIES.items()]


def test_what_is_just_allowed_is_taken():
    assert Wire(gauge=2.0).radius == 5e-4
    assert ends.Clamped(orientation=[1e-8, 0, 0, 0]).kind == "clamped"


@pytest.mark.parametrize(("make", "parts", "given", "words"), CASES)
def test_bad_arguments_are_refused_in_one_line(make, parts, given, words):
    with pytest.raises(ParameterError, match=words) as caught:
        make(*parts, **given)
    assert "\n" not in str(caught.value)
