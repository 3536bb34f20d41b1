"""Parts of robots as CAD models: dimensions from the robot file, solids, files, bill of materials."""

import dataclasses
import importlib.util
import itertools
import math
import re
import struct
from collections import Counter
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat.rods.robot_file import format_robot
from knode_cosserat_hardware import Dimensions, HardwareDescription, Limits
from knode_cosserat_hardware.cad import PartError, bill_of_materials, export_parts, load_dimensions
from knode_cosserat_hardware.cad.dimensions import BOARD_LIMIT, capacity, part_dimensions
from tests.commands import run, succeeded, told

ROOT = Path(__file__).parents[2]
ROBOT = kc.load_robot("delrin-routed-tendon-robot")
PART = part_dimensions(ROBOT)
CAD = importlib.util.find_spec("build123d") is not None
with_cad = pytest.mark.skipif(not CAD, reason="needs build123d: pip install 'knode-cosserat-hardware[cad]'")
NAMES = ("rib", "spool", "base", "motor-plate", "load-cell", "load-cell-mount", "motor-bracket")


def described(**dimensions):
    return HardwareDescription(dimensions=Dimensions(**dimensions))


# dimensions


def test_dimensions_equal_the_robot_file():
    angles, offset = np.asarray(ROBOT.tendon_angles), 1e3 * float(ROBOT.tendon_offset)
    wanted = offset * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for holes in (PART.rib.tendon_holes, PART.base.eyelets, PART.plate.passages):
        np.testing.assert_allclose(holes, wanted, atol=1e-9)
    assert PART.rod_length == 635.0 and PART.rod_radius == 3.175
    assert PART.rib.rod_hole == PART.base.rod_hole == pytest.approx(6.35 + 0.1)
    assert PART.rib.outer_radius == 25.0 and PART.rib.thickness == 3.0 and PART.rib.tendon_hole == 1.2
    assert PART.spool.bore == pytest.approx(4.1) and PART.spool.drum_radius + 0.25 == 10.0
    assert PART.base.height == 63.5 and PART.base.flange_radius == 40.0


def test_ribs_are_at_the_attached_masses_else_at_equal_distances():
    np.testing.assert_allclose(PART.rib_heights, [635 * at for at in (1 / 3, 5 / 9, 7 / 9, 1)])
    plain = part_dimensions(kc.load_robot("delrin-tendon-robot"), described(rib_count=5))
    np.testing.assert_allclose(plain.rib_heights, [127, 254, 381, 508, 635])


def test_the_hardware_section_of_a_file_is_used(tmp_path):
    path = tmp_path / "robot.yaml"
    text = format_robot(kc.load_robot("delrin-tendon-robot"))
    path.write_text(text + "hardware: {spool_radius: 0.012, hole_diameter: 0.002, rib_count: 3}\n")
    part = load_dimensions(path)
    assert (
        part.spool.drum_radius + 0.25 == 12.0 and part.rib.tendon_hole == 2.0 and len(part.rib_heights) == 3
    )
    assert load_dimensions("delrin-routed-tendon-robot") == PART


def test_the_tendon_meets_the_spool_and_the_load_cell():
    # the motor's axis is one spool radius beyond the tendon, and the beam is in line with the tendon
    assert PART.bracket.axis[0] == 10.0
    ends = np.reshape(PART.plate.cell_holes, (4, 2, 2))
    for k, angle in enumerate(PART.angles):
        radial = ends[k] @ [math.cos(angle), math.sin(angle)]
        np.testing.assert_allclose(radial, PART.tendon_radius)


def test_a_load_cell_is_as_thick_as_the_tension_needs():
    moment = BOARD_LIMIT * PART.cell.lever
    stress = moment / (PART.cell.width * PART.cell.thickness**2 / 6)
    assert PART.cell.strain == pytest.approx(stress / 69000)
    strong = part_dimensions(ROBOT, HardwareDescription(tension=Limits(high=60.0, total=200.0)))
    assert strong.cell.thickness > PART.cell.thickness and strong.cell.strain <= 1e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rib_diameter": 0.04}, r"rib_diameter must be at least 0.0432 m, .*\(got 0.04\)"),
        ({"rib_count": 100}, "ribs must be at least 0.009 m apart"),
        ({"spool_radius": 0.003}, "spool_radius must be at least 0.0033 m"),
        ({"flange_height": 0.001}, "flange_height must be at least 0.0032 m"),
        ({"spool_width": 0.002}, "spool_width must hold 0.1457 m of tendon"),
        ({"base_height": 0.02}, "base_height must be at least 0.033 m"),
        ({"base_diameter": 0.05}, "base_diameter must be at least 0.0723 m"),
        ({"mount_diameter": 0.025}, "mount_diameter must keep the mounting holes clear"),
        ({"motor_diameter": 0.06}, "motors 1 and 2 overlap"),
        ({"shaft_diameter": 0.001}, "shaft_diameter must be at least 0.002 m"),
    ],
)
def test_dimensions_that_do_not_fit_are_refused_in_one_line(changes, message):
    with pytest.raises(PartError, match=message) as caught:
        part_dimensions(kc.load_robot("delrin-tendon-robot"), described(**changes))
    assert "\n" not in str(caught.value) and "got" in str(caught.value)


def test_robots_without_straight_tendons_are_refused():
    for name in ("soft-slender-robot", "six-legged-robot"):
        with pytest.raises(PartError, match="straight tendons"):
            load_dimensions(name)
    with pytest.raises(PartError, match="straight tendons"):
        part_dimensions(ROBOT.replace(tendon_twist=1.0))
    with pytest.raises(PartError, match=r"must have 4 angles.*got 3"):
        part_dimensions(kc.load_robot("delrin-tendon-robot").replace(tendon_angles=[0.0, 2.0, 4.0]))
    with pytest.raises(PartError, match="must be at most 314 N"):
        part_dimensions(ROBOT, HardwareDescription(tension=Limits(high=1000.0, total=4000.0)))
    with pytest.raises(PartError, match="tendon_offset must be at least"):
        part_dimensions(ROBOT.replace(tendon_offset=0.005))
    with pytest.raises(PartError, match="tendon_angles"):
        part_dimensions(ROBOT.replace(tendon_angles=[0.0, 0.01, 2.0, 4.0]))


ANGLES = st.lists(st.floats(0.0, 2 * math.pi), min_size=4, max_size=4) | st.floats(0.0, 1.5).map(
    lambda first: [first + k * math.pi / 2 for k in range(4)]
)
SIZES = st.fixed_dictionaries(
    {},
    optional={
        "spool_radius": st.floats(0.002, 0.03),
        "spool_width": st.floats(0.001, 0.02),
        "flange_height": st.floats(0.0, 0.01),
        "rib_diameter": st.floats(0.02, 0.1),
        "hole_diameter": st.floats(0.0005, 0.004),
        "base_diameter": st.floats(0.05, 0.12),
        "mount_diameter": st.floats(0.04, 0.1),
        "mount_hole_count": st.integers(2, 8),
        "motor_diameter": st.floats(0.01, 0.04),
    },
)


@hypothesis.settings(max_examples=150, deadline=None)
@hypothesis.given(offset=st.floats(0.008, 0.05), radius=st.floats(0.0005, 0.008), angles=ANGLES, sizes=SIZES)
def test_random_robots_have_walls_or_are_refused(offset, radius, angles, sizes):
    robot = kc.load_robot("delrin-tendon-robot").replace(
        tendon_offset=offset, radius=radius, tendon_angles=angles
    )
    try:
        part = part_dimensions(robot, described(**sizes))
    except PartError:
        return
    rib, spool, base = part.rib, part.spool, part.base
    hole, least = rib.tendon_hole / 2, 1.0 - 1e-6
    assert rib.outer_radius - rib.tendon_radius - hole >= least
    assert rib.tendon_radius - hole - rib.hub_radius >= least and rib.hub_radius - rib.rod_hole / 2 >= least
    assert min(math.dist(a, b) for a, b in itertools.combinations(rib.tendon_holes, 2)) - 2 * hole >= least
    assert (rib.spoke_width - rib.tendon_hole) / 2 >= least
    assert spool.drum_radius - spool.bore / 2 >= least and capacity(spool) >= part.travel
    assert spool.flange_radius > spool.hub_radius
    assert base.column_radius - base.rod_hole / 2 >= least and base.height - base.socket_depth >= least
    rim = base.flange_radius - base.mount_radius - base.mount_hole / 2
    assert rim >= least and base.top_radius - base.tendon_radius - base.eyelet / 2 >= least
    bracket = part.bracket
    assert bracket.axis[0] - bracket.screw_spacing / 2 - bracket.screw_hole / 2 - bracket.left >= least
    assert part.plate.radius > base.flange_radius and part.cell.strain <= 1e-3


# bill of materials


def test_the_bill_of_materials_counts_what_the_robot_has():
    items = bill_of_materials("delrin-routed-tendon-robot")
    counts = Counter()
    for item in items:
        counts[item.part] += item.count
        assert item.count > 0 and item.specification and item.source
    for name in ("rib", "spool", "gear motor", "strain gauge", "amplifier", "tendon", "motor bracket"):
        assert counts[name] == 4
    assert counts["dual H-bridge"] == 2 and counts["rod"] == counts["base"] == counts["motor plate"] == 1


def test_the_command_prints_the_bill_of_materials():
    assert "Arduino Mega 2560" in succeeded("robot-parts", "delrin-tendon-robot")
    found = told("robot-parts", "delrin-routed-tendon-robot")
    assert found["files"] == {} and found["materials"][0]["part"] == "rib"
    refused = run("robot-parts", "soft-slender-robot")
    assert refused.exit_code == 2 and refused.stderr.count("\n") == 1


@pytest.mark.skipif(CAD, reason="build123d is installed")
def test_without_the_library_the_error_names_the_extra(tmp_path):
    refused = run("robot-parts", "delrin-tendon-robot", "--out", tmp_path / "parts")
    assert refused.exit_code == 2 and "pip install 'knode-cosserat-hardware[cad]'" in refused.stderr
    assert not (tmp_path / "parts").exists()


# solids


@pytest.fixture(scope="module")
def solids():
    from knode_cosserat_hardware.cad.parts import make_parts

    return make_parts(PART)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("parts")
    export_parts("delrin-routed-tendon-robot", path)
    return path


def size(solid):
    return [solid.bounding_box().size.X, solid.bounding_box().size.Y, solid.bounding_box().size.Z]


def bores(solid, radius):
    """Centres of the upright cylindrical faces of a radius, by the middle of their axes."""
    found = set()
    for face in solid.faces():
        if str(face.geom_type).endswith("CYLINDER") and abs((face.radius or 0.0) - radius) < 1e-6:
            axis = face.axis_of_rotation
            if abs(axis.direction.Z) > 0.999:
                found.add((round(axis.position.X, 4) + 0.0, round(axis.position.Y, 4) + 0.0))
    return found


def rounded(points):
    return {(round(x, 4) + 0.0, round(y, 4) + 0.0) for x, y in points}


@with_cad
@pytest.mark.parametrize("name", NAMES)
def test_a_part_is_one_valid_solid(solids, name):
    assert len(solids[name].solids()) == 1 and solids[name].is_valid


@with_cad
def test_sizes_of_solids_are_the_dimensions(solids):
    rib, spool, plate, cell = PART.rib, PART.spool, PART.plate, PART.cell
    wanted = {
        "rib": (50, 50, rib.hub_height),
        "spool": (2 * spool.flange_radius, 2 * spool.flange_radius, spool.length),
        "base": (80, 80, 63.5),
        "motor-plate": (2 * plate.radius, 2 * plate.radius, plate.thickness),
        "load-cell": (cell.width, cell.length, cell.thickness),
        "load-cell-mount": (PART.mount.width, PART.mount.length, PART.mount.height),
        "motor-bracket": (32, PART.bracket.foot_length, PART.bracket.height),
    }
    for name in NAMES:
        np.testing.assert_allclose(size(solids[name]), wanted[name], atol=1e-5)


@with_cad
def test_holes_of_solids_are_where_the_dimensions_say(solids):
    rib, base, plate = PART.rib, PART.base, PART.plate
    assert bores(solids["rib"], rib.tendon_hole / 2) == rounded(rib.tendon_holes)
    assert bores(solids["rib"], rib.rod_hole / 2) == {(0.0, 0.0)}
    assert bores(solids["base"], base.eyelet / 2) == rounded(base.eyelets)
    assert bores(solids["base"], base.passage / 2) == rounded(base.eyelets)
    assert bores(solids["base"], base.mount_hole / 2) == rounded(base.mount_holes)
    assert bores(solids["motor-plate"], plate.cell_hole / 2) == rounded(plate.cell_holes)
    assert bores(solids["motor-plate"], plate.leg_hole / 2) == rounded(plate.leg_holes)
    assert bores(solids["motor-plate"], plate.mount_hole / 2) == rounded(base.mount_holes)
    assert bores(solids["load-cell"], 1.7) == rounded((0.0, y) for y in PART.cell.holes)
    assert bores(solids["spool"], PART.spool.bore / 2) == {(0.0, 0.0)}


@with_cad
def test_volumes_of_solids_are_those_of_the_dimensions(solids):
    plate, cell, mount = PART.plate, PART.cell, PART.mount
    holes = [(plate.passage, 4), (plate.mount_hole, 4), (plate.cell_hole, 8), (plate.leg_hole, 4)]
    area = math.pi * (plate.radius**2 - sum(count * (size / 2) ** 2 for size, count in holes))
    assert solids["motor-plate"].volume == pytest.approx(area * plate.thickness, rel=1e-6)
    for name, each, count in (("load-cell", cell, 4), ("load-cell-mount", mount, 2)):
        height = cell.thickness if each is cell else mount.height
        area = each.width * each.length - count * math.pi * (each.hole / 2) ** 2
        assert solids[name].volume == pytest.approx(area * height, rel=1e-6)
    # rib: disk, hub and spokes by integration along the radius; the screw's hole by a cylinder, roughly
    rib = PART.rib
    r = np.linspace(rib.window[0], rib.window[1], 20001)
    spokes = 4 * np.trapezoid(2 * r * np.arcsin(rib.spoke_width / 2 / r), r)
    disk = math.pi * (rib.outer_radius**2 - rib.window[1] ** 2 + rib.window[0] ** 2 - (rib.rod_hole / 2) ** 2)
    area = disk + spokes - 4 * math.pi * (rib.tendon_hole / 2) ** 2
    hub = math.pi * (rib.hub_radius**2 - (rib.rod_hole / 2) ** 2) * (rib.hub_height - rib.thickness)
    screw = math.pi * (rib.screw_hole / 2) ** 2 * (rib.hub_radius - rib.rod_hole / 2)
    assert solids["rib"].volume == pytest.approx(area * rib.thickness + hub - screw, rel=2e-3)


@with_cad
def test_a_printed_rib_has_about_the_mass_of_the_model(solids):
    # PLA, 1240 kg/m3; the robot file has 3.4 g
    assert 1240e-9 * solids["rib"].volume == pytest.approx(0.0034, rel=0.15)


@with_cad
@pytest.mark.parametrize("offset", [0.018, 0.02, 0.03])
def test_no_two_bodies_of_the_robot_overlap(offset):
    from knode_cosserat_hardware.cad.parts import place_parts

    part = part_dimensions(ROBOT.replace(tendon_offset=offset), described(rib_diameter=0.07))
    bodies = place_parts(part)
    # the tendon lies on the drum and runs in its holes
    for (a, first), (b, second) in itertools.combinations(bodies, 2):
        box, other = first.bounding_box(), second.bounding_box()
        if any(
            getattr(box.min, x) >= getattr(other.max, x) - 1e-6
            or getattr(other.min, x) >= getattr(box.max, x) - 1e-6
            for x in "XYZ"
        ):
            continue
        common = first & second
        volume = 0.0 if common is None else sum(each.volume for each in common.solids())
        assert volume < 1e-3, f"{a} and {b} share {volume} mm3"


# files


@with_cad
def test_all_files_are_written(folder):
    wanted = {f"{name}.{kind}" for name in NAMES for kind in ("step", "stl")} | {"robot.step"}
    assert {path.name for path in folder.iterdir()} == wanted


@with_cad
@pytest.mark.parametrize("name", NAMES)
def test_a_step_file_has_the_volume_of_the_part(folder, solids, name):
    import build123d

    again = build123d.import_step(str(folder / f"{name}.step"))
    assert again.volume == pytest.approx(solids[name].volume, rel=1e-6)


@with_cad
def test_the_assembly_has_all_bodies(folder):
    import build123d

    again = build123d.import_step(str(folder / "robot.step"))
    assert len(again.solids()) == 3 + 4 + 4 * 6 + 4


@with_cad
@pytest.mark.parametrize("name", NAMES)
def test_an_stl_file_is_watertight(folder, solids, name):
    data = (folder / f"{name}.stl").read_bytes()
    (count,) = struct.unpack_from("<I", data, 80)
    rows = np.frombuffer(data, np.dtype([("v", "<f4", (4, 3)), ("a", "<u2")]), count, 84)["v"][:, 1:]
    _, index = np.unique(rows.reshape(-1, 3), axis=0, return_inverse=True)
    triangles = index.reshape(-1, 3)
    edges = Counter(map(tuple, np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]).tolist()))
    # each edge is used once in each direction
    assert all(times == 1 and edges[b, a] == 1 for (a, b), times in edges.items())
    p = rows.astype(float)
    volume = np.einsum("ij,ij->i", p[:, 0], np.cross(p[:, 1], p[:, 2])).sum() / 6
    assert volume == pytest.approx(solids[name].volume, rel=0.01)


@with_cad
def test_equal_robots_give_equal_step_files(folder, tmp_path):
    export_parts("delrin-routed-tendon-robot", tmp_path)
    assert (tmp_path / "rib.step").read_bytes() == (folder / "rib.step").read_bytes()


def test_dimensions_are_plain_values():
    assert dataclasses.replace(PART) == PART and hash(PART.rib) == hash(PART.rib)


def test_the_page_has_the_pins_of_the_firmware():
    source = (ROOT / "firmware" / "main.cpp").read_text(encoding="utf-8")
    (pulse,) = re.findall(r"PWM_PINS\[TENDONS\] = \{([\d, ]+)\}", source)
    page = (ROOT / "docs" / "build-the-robot.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| (\d) \| no\. \d.*?\| D(\d+) \((OC\d\w)\) \| D(\d+), D(\d+) \| A(\d) \|$", page, re.M
    )
    assert re.findall(r"CONTACT_PIN = (\d+)", source) == ["18"] and "from D18 to GND" in page
    # motor k has bits 2 k and 2 k + 1 of port A: pins 22 + 2 k and 23 + 2 k
    wanted = [
        (str(k + 1), pin, name, str(22 + 2 * k), str(23 + 2 * k), str(k))
        for k, (pin, name) in enumerate(zip(pulse.split(", "), ("OC1A", "OC1B", "OC3A", "OC3B"), strict=True))
    ]
    assert rows == wanted
