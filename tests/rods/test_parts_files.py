"""Parts of robots in files: every kind comes back equal, errors say where, and batches keep their own."""

import dataclasses
import re
import subprocess
import sys
import warnings
from pathlib import Path

import hypothesis.strategies as st
import jax
import numpy as np
import pytest
import yaml
from hypothesis import given, settings

import knode_cosserat as kc
from knode_cosserat.learning import NetworkOptions
from knode_cosserat.learning.residual import network
from knode_cosserat.robots import RobotFileError, SlenderRod, SpinningFrame
from knode_cosserat.rods.ends import Driven, End
from knode_cosserat.rods.loads import AttachedMass, DistributedWrench, Load, PointWrench
from knode_cosserat.rods.parameters import Choice, kinds_of, parameters_of, stated_of
from knode_cosserat.rods.parts import Part
from knode_cosserat.rods.robot_file import KINDS, format_robot, parse_robot
from knode_cosserat.rods.routing import FunctionRouting, Routing
from knode_cosserat.rods.section import SectionChange
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.surroundings import Obstacle, Sphere
from knode_cosserat.rods.tendon_robots import VirtualRobot
from knode_cosserat.rods.tendons import TendonFriction
from knode_cosserat.rods.tubes import Tube
from tests.trajectories import edited

BODY = {"length": 0.5, "radius": 0.005, "density": 1000.0, "youngs_modulus": 1e6}


def assert_equal(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one, other)


def numbers(stated):
    each = st.floats(stated.low, stated.high, allow_subnormal=False)
    sizes = {"vector": (3, 3), "direction": (3, 3), "quaternion": (4, 4), "list": (1, 4)}
    if stated.shape == "scalar":
        return each
    if stated.shape == "matrix":
        return each.map(lambda size: size * np.eye(3))
    least, most = sizes[stated.shape]
    found = st.lists(each, min_size=least, max_size=most)
    return found.filter(long) if stated.shape in ("direction", "quaternion") else found


def long(vector):
    return np.linalg.norm(vector) > 1e-9


@st.composite
def parts(draw, family):
    cls = draw(st.sampled_from(list(kinds_of(family).values())))
    fields = {field.name: field for field in dataclasses.fields(cls)}
    given = {}
    for name, stated in parameters_of(cls).items():
        required = fields[name].default is dataclasses.MISSING
        if (name not in ("begin", "end") or "begin" not in fields) and (required or draw(st.booleans())):
            direction = name in ("normal", "axis")
            if family is SectionChange and name in ("radius", "stiffness"):
                stated = dataclasses.replace(stated, low=1e-3)
            given[name] = draw(numbers(stated).filter(long) if direction else numbers(stated))
    if "begin" in fields and draw(st.booleans()):
        # what is nearer to an end than rounding is at it
        places = st.lists(st.floats(0.0, 1.0).map(lambda s: round(s, 6)), min_size=2, max_size=2, unique=True)
        given["begin"], given["end"] = sorted(draw(places))
    for name, stated in stated_of(cls, Choice).items():
        words = st.sampled_from(stated.allowed)
        given[name] = draw(st.lists(words, min_size=1, unique=True) if stated.many else words)
    return cls(**given)


def some(family):
    return st.lists(parts(family), max_size=3).map(tuple)


def everywhere(found):
    """Parts at the tip or all along: tubes move others with their insertion, and refuse them."""
    whole, moved = {"at": 1.0, "begin": 0.0, "end": 1.0}, []
    for part in found:
        names = {field.name for field in dataclasses.fields(part)}
        moved.append(dataclasses.replace(part, **{name: whole[name] for name in whole if name in names}))
    return tuple(moved)


ROD = {
    "sections": some(SectionChange), "loads": some(Load), "surroundings": some(Obstacle),
    "effects": st.tuples(parts(SpinningFrame)),
    "base_end": parts(End).filter(lambda end: end.anywhere and end.at_tip),
    "tip_end": parts(End).filter(lambda end: end.at_tip),
}  # fmt: skip
TENDONS = {"tendon_offset": st.just(0.01), "tendon_angles": st.just([0.0, 2.0])}
ROUTED = {
    **ROD, **TENDONS, "drive": st.sampled_from(["tension", "reel"]),
    "routing": st.none() | st.lists(parts(Routing), min_size=2, max_size=2).map(tuple),
    "friction": st.none() | parts(TendonFriction), "tendon_compliance": st.floats(0.0, 1.0),
}  # fmt: skip
#: two tubes in one another
TUBES = st.tuples(
    *(
        st.builds(
            Tube,
            radius=st.just(radius),
            inner_radius=st.just(0.7 * radius),
            density=st.just(6e3),
            youngs_modulus=st.floats(1e3, 2e12),
            curvature=st.floats(-1e3, 1e3),
            curved=st.none() | st.floats(0.0, 20.0),
        )
        for radius in (1e-3, 2e-3)
    )
)
FIELDS = {
    "slender-rod": ROD,
    "routed-tendon-robot": ROUTED,
    "tendon-robot": ROD,
    "virtual-robot": {**ROD, **TENDONS},
    "concentric-tube-robot": {
        **{name: ROD[name].map(everywhere) for name in ("loads", "surroundings")},
        "tip_end": ROD["tip_end"], "tubes": TUBES,
    },
    "assembly": {
        "rods": st.tuples(
            st.builds(
                SlenderRod, name=st.just("arm"), **{name: st.just(value) for name, value in BODY.items()},
                **{name: ROD[name] for name in ROD if name != "effects"}
                | {"base_end": parts(End).filter(lambda end: end.anywhere and end.at_tip and end.held)},
            )
        ),
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "parallel-robot"])
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_robots_with_parts_come_back_equal(kind, data):
    # a robot of several rods has no parts
    assert {*FIELDS, "parallel-robot"} == set(KINDS)
    body = {"concentric-tube-robot": {"length": 0.5}, "assembly": {}}.get(kind, BODY)
    robot = KINDS[kind](**body, **data.draw(st.fixed_dictionaries(FIELDS[kind])))
    text = format_robot(robot)
    assert_equal(parse_robot(text, "here"), robot)
    content = yaml.safe_load(text)
    assert content["kind"] == kind
    # what needs nothing new is still a file of the first format
    new = set(content["parameters"]) - set(KINDS[kind].parameters()) - {"nodes"}
    assert content["format"] == (2 if new else 1)


def test_a_file_of_the_first_format_is_read_and_written_as_it_was():
    robot = kc.load_robot("delrin-tendon-robot")
    text = format_robot(robot)
    assert text.startswith("format: 1\n") and "base_end" not in text and "loads" not in text
    assert_equal(parse_robot(text, "here"), robot)


# errors

HEAD = (
    "format: 2\nkind: slender-rod\nparameters:\n  " + "\n  ".join(f"{k}: {v}" for k, v in BODY.items()) + "\n"
)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("loads: [{kind: attached-mass, mass: -1}]", "loads.0.mass must be between 0 and 10000 kg (got -1)"),
        ("loads: [{kind: attached-mass}, {kind: attached-mass, at: 2}]",
         "loads.1.at must be between 0 and 1 (got 2)"),
        (
            "loads: [{kind: attached-mas}]",
            "loads.0.kind is 'attached-mas'; allowed is attached-mass, distributed-wrench, "
            "fluid, magnet, point-magnet, point-wrench, tail.*; did you mean attached-mass?",
        ),
        ("loads: [{mass: 1}]", "loads.0 is {'mass': 1}; allowed is a mapping with a kind: attached-mass"),
        ("loads: {kind: attached-mass}", "loads is {'kind': 'attached-mass'}; allowed is a list of mappings"),
        ("loads: 3", "loads is 3; allowed is a list of mappings, each with a kind"),
        ("loads: [{kind: attached-mass, weight: 1}]",
         "loads.0: the key 'weight' is unknown; allowed is at, mass"),
        ("loads: [{kind: point-wrench, follows: maybe}]",
         "loads.0.follows is 'maybe'; allowed is false, true"),
        ("loads: [{kind: point-wrench, force: [1, 2]}]",
         "loads.0.force must be three numbers, each .*(got [1, 2])"),
        ("loads: [{kind: fluid, density: -1}]", "loads.0.density must be between 0 and 25000 kg/m3 (got -1)"),
        ("loads: [{kind: fluid, stream: 1}]",
         "loads.0.stream must be three numbers, each between -100 and 100 m/s"),
        ("loads: [{kind: magnet, field: {kind: dipol}}]",
         "loads.0.field.kind is 'dipol'; allowed is dipole, uniform; did you mean dipole?"),
        ("loads: [{kind: magnet, field: {kind: dipole, moment: [0, 0, 1]}}]",
         "loads.0.field: the key 'position' is missing"),
        ("loads: [{kind: magnet, field: {kind: uniform, flux_density: [0, 0, 1.0e+9]}}]",
         "loads.0.field.flux_density must be three numbers, each between -100 and 100 T"),
        ("loads: [{kind: magnet, field: 3}]",
         "loads.0.field is 3; allowed is a mapping with a kind: dipole, uniform"),
        ("cross_section: {kind: hollow, radius: 0.01}", "cross_section: the key 'inner_radius' is missing"),
        ("cross_section: {kind: hollow, radius: 0.01, inner_radius: 0.01}",
         ".*inner_radius is 0.01; allowed is less than radius, 0.01"),
        ("cross_section: {kind: oval, radius: 0.01}",
         "cross_section.kind is 'oval'; allowed is elliptic, hollow, rectangular, tabulated"),
        ("cross_section: {kind: elliptic, semi_axis_x: 5, semi_axis_y: 1}", ".*Did you mean 0.005 (5 mm)"),
        ("base_end: {kind: driven, axes: [[x]]}", "base_end.axes is [['x']]; allowed is a list of different"),
        ("base_end: clamped",
         "base_end is 'clamped'; allowed is a mapping with a kind: clamped, driven, free, moving, pinned"),
        ("base_end: {kind: driven, axes: [x, x]}",
         "base_end.axes is ['x', 'x']; allowed is a list of different ones of x, y"),
        ("base_end: {kind: driven, axes: [q]}",
         "base_end.axes is ['q']; allowed is a list of different ones of x, y"),
        ("tip_end: {kind: pinned, orientation: [0, 0, 0, 0]}",
         "tip_end.orientation must be four numbers, not all zero"),
        ("tip_end: {kind: clamped, orientation: [1.0e-200, 0, 0, 0]}",
         "tip_end.orientation must be four numbers, .*length above 1e-09"),
        ("surroundings: [{kind: plane, normal: [0, 0, 1.0e-12]}]",
         "surroundings.0.normal must be a direction, .*above 1e-09"),
        ("surroundings: [{kind: sphere, radius: 0}]",
         "surroundings.0.radius must be between 1e-06 and 1000 m (got 0)"),
        ("sections: [{kind: stretch, radius: []}]", "sections.0.radius must be a list of numbers"),
        ("sections: [{kind: stretch, begin: 0.5, end: 0.5}]",
         "sections.0: .*end is 0.5; allowed is a place beyond begin, 0.5"),
        ("loads: [{kind: distributed-wrench, begin: 0.7, end: 0.2}]",
         "loads.0: .*end is 0.2; allowed is a place beyond begin, 0.7"),
    ],
)  # fmt: skip
def test_errors_name_file_place_value_and_what_is_allowed(more, words):
    with pytest.raises(RobotFileError) as caught:
        parse_robot(HEAD + f"  {more}\n", "robots/mine.yaml")
    pattern = ".*".join(map(re.escape, f"robots/mine.yaml: {words}".split(".*")))
    assert re.search(pattern, str(caught.value)), caught.value
    assert "\n" not in str(caught.value)


def test_code_cannot_be_saved(tmp_path):
    rod = kc.robots.SlenderRod(**BODY, sections=(kc.robots.section.FunctionSection(),))
    with pytest.raises(RobotFileError, match=r"^a FunctionSection cannot be written .* made of code"):
        kc.save_robot(rod, tmp_path / "rod.yaml")
    routed = kc.robots.RoutedTendonRobot(
        **BODY,
        tendon_offset=0.01,
        tendon_angles=[0.0],
        routing=(FunctionRouting(lambda s: (0.01 * s, 0.0 * s)),),
    )
    with pytest.raises(RobotFileError, match=r"^a FunctionRouting cannot be written"):
        kc.save_robot(routed, tmp_path / "rod.yaml")
    assert not list(tmp_path.iterdir())


# parameters of parts by name

LADEN = kc.robots.SlenderRod(
    **BODY,
    nodes=6,
    base_end=Driven(axes=("x", "ry")),
    loads=(AttachedMass(mass=0.1, at=0.4), PointWrench(controlled=True), DistributedWrench(begin=0.3)),
    surroundings=(Sphere(center=[0.0, 0.0, -1.0]),),
    sections=(kc.robots.Stretch(end=0.4, stiffness=[1.0, 2.0]),),
)


def test_parameters_of_parts_by_name():
    changed = LADEN.replace(
        **{
            "loads.0.mass": 0.3,
            "loads.1.force": [1, 2, 3],
            "surroundings.0.radius": 0.2,
            "base_end.position": [1, 0, 0],
            "loads.0.at": 0.6,
        }
    )
    assert (
        changed.loads[0].mass == 0.3 and changed.loads[0].at == 0.6 and 0.6 in changed.discontinuities.places
    )
    np.testing.assert_array_equal(changed.loads[1].force, [1, 2, 3])
    assert changed.surroundings[0].radius == 0.2 and changed.loads[2] is LADEN.loads[2]
    np.testing.assert_array_equal(changed.base_end.position, [1, 0, 0])
    assert LADEN.loads[0].mass == 0.1


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("loads.3.mass", 1.0, r"no parameter 'loads.3.mass': no '3' among 0, 1, 2"),
        ("loads.0.weight", 1.0,
         r"no parameter 'loads.0.weight': no 'weight' among at, mass, inertia, offset"),
        ("loads.0.mass", -1.0, r"AttachedMass: mass must be between 0 and 10000 kg \(got -1\)"),
        ("cargo.0.mass", 1.0, r"no parameter 'cargo"),
        ("loads.0", 3.0, r"loads holds a float; allowed is a load"),
        ("length.0", 3.0, r"no parameter 'length.0': no '0' among nothing"),
    ],
)  # fmt: skip
def test_wrong_names_of_parts(name, value, words):
    with pytest.raises(kc.robots.ParameterError, match=words) as caught:
        LADEN.replace(**{name: value})
    assert "\n" not in str(caught.value)


# files of trajectories and of models


def made(robots):
    """A trajectory's arrays need not be a solution to be written."""
    one = robots[0]
    batch = (len(robots),) if len(robots) > 1 else ()
    rng = np.random.default_rng(0)
    numbers = np.zeros((*batch, 3))
    system = jax.tree.map(lambda *leaves: np.stack(leaves), *robots) if batch else one
    return kc.Trajectory(
        system,
        None,
        np.arange(3) * 0.1,
        rng.normal(size=(*batch, 3, one.nodes, one.y_layout.size)),
        rng.normal(size=(*batch, 3, one.nodes, one.z_layout.size)),
        rng.normal(size=(*batch, 3, one.control_layout.size)),
        numbers.astype(int),
        numbers,
        numbers.astype(int),
    )


@pytest.mark.parametrize("count", [1, 3])
def test_trajectories_of_robots_that_differ_in_their_parts_come_back(tmp_path, count):
    robots = [
        LADEN.replace(
            **{
                "loads.0.mass": 0.1 * k,
                "loads.1.moment": [k, 0, 1],
                "surroundings.0.radius": 0.1 + k,
                "length": 0.5 + k,
                "sections.0.stiffness": [1.0 + k, 2.0],
                "base_end.position": [0, 0, k],
                "loads.2.force": [0, k, 0],
            }
        )
        for k in range(count)
    ]
    truth = made(robots)
    truth.save(tmp_path / "here.nc")
    found = kc.load_trajectory(tmp_path / "here.nc")
    assert_equal(found.system, truth.system)
    for name in ("y", "z", "control"):
        np.testing.assert_array_equal(getattr(found, name), getattr(truth, name))


def test_a_batch_from_a_damaged_file_is_refused(tmp_path):
    path = tmp_path / "here.nc"
    made([LADEN, LADEN]).save(path)

    def damage(file):
        file["robot_loads.0.mass"][1] = -1.0

    edited(path, damage)
    with pytest.raises(
        kc.TrajectoryFileError, match=r"a robot of the batch is not possible: AttachedMass: mass"
    ):
        kc.load_trajectory(path)


@pytest.mark.parametrize("name", [name for name in kc.catalog() if name != "delrin-tendon-robot"])
def test_models_of_robots_with_parts_come_back(tmp_path, name):
    knowledge = kc.load_robot(name)
    model = kc.KNODE(
        knowledge, network(strand_of(knowledge), NetworkOptions(hidden=3), jax.random.PRNGKey(0))
    )
    model.save(tmp_path / "model")
    found = kc.load_model(next(Path(tmp_path).glob("model*")))
    assert_equal(found.knowledge, knowledge)


def test_the_virtual_robot_may_have_parts_too():
    robot = VirtualRobot(**BODY, tendon_offset=0.01, tendon_angles=[0.0], loads=(AttachedMass(mass=0.1),))
    assert_equal(parse_robot(format_robot(robot), "here"), robot)


def test_files_are_read_by_a_fresh_process_with_every_kind():
    """A kind that only another module registers would be unknown there."""
    code = (
        "from knode_cosserat.rods.parameters import kinds_of; import knode_cosserat.rods.robot_file;"
        "from knode_cosserat.rods.parts import Part; print(*kinds_of(Part))"
    )
    listed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    own = {name for name, cls in kinds_of(Part).items() if cls.__module__.startswith("knode_cosserat.rods")}
    assert own <= {*listed.split()}


#: a rod 0.125 m long, with tendons that end at the places
PLACES = """format: 1
kind: routed-tendon-robot
parameters:
  length: {length}
  radius: 0.002
  density: 1500.0
  youngs_modulus: 1.0e+9
  routing:
    - {{kind: straight, x: 0.01, y: 0.0, end: {one}}}
    - {{kind: straight, x: -0.01, y: 0.0, end: {other}}}
"""


@pytest.mark.parametrize(
    ("length", "one", "other", "warned"),
    [
        (0.125, 0.125, 0.125, True),
        (0.125, 0.0625, 0.125, True),
        (0.3, 0.3, 0.1, True),
        (0.125, 0.125, 1.0, False),
        (0.5, 0.5, 1.0, False),
        (0.125, 0.5, 0.75, False),
        (1.0, 1.0, 1.0, False),
    ],
)
def test_places_in_metres_are_warned_of(tmp_path, length, one, other, warned):
    path = tmp_path / "robot.yaml"
    path.write_text(PLACES.format(length=length, one=one, other=other))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        kc.load_robot(path)
    said = [str(each.message) for each in found if "did you mean end: 1" in str(each.message).lower()]
    assert len(said) == warned
    if warned:
        assert f"{1e3 * length**2:.4g} mm from the base; the robot is {length:g} m long" in said[0]
        assert str(path) in said[0]


@pytest.mark.parametrize("name", kc.catalog())
def test_no_robot_of_the_catalog_has_places_in_metres(name, tmp_path):
    path = tmp_path / "robot.yaml"
    kc.save_robot(kc.load_robot(name), path)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*Did you mean end: 1")
        kc.load_robot(path)
