"""Assemblies: frames in closed form, joints, loops, motion of bodies, neighbours in contact, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp

import knode_cosserat as kc
from knode_cosserat.robots import Assembly, RigidBody, SlenderRod
from knode_cosserat.rods.assembly import NeighbourContact
from knode_cosserat.rods.ends import Clamped, Driven, Pinned
from knode_cosserat.rods.loads import AttachedMass, DistributedWrench
from knode_cosserat.rods.parts import ease
from knode_cosserat.solvers.simulate import check_limits

L, RADIUS, E, DENSITY = 0.3, 4e-3, 2e9, 1000.0
EI = E * np.pi * RADIUS**4 / 4
#: so small that what is not linear is a part of about 1e-7, and to solve for it
FORCE = 2e-7 * EI / L**2
NEWTON = kc.solvers.NewtonOptions(tolerance=1e-15, acceptable=1e-12)
#: orientations of rods along x, and along -z
ALONG_X, DOWN = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0), (0.0, 1.0, 0.0, 0.0)


def on(body, end=Clamped, **more):
    return end(body=body, **more)


def rod(name, **more):
    """Return a rod that does not shear."""
    section = {"radius": RADIUS, "density": DENSITY, "youngs_modulus": E, "shear_stiffness": 1e9}
    return SlenderRod(name=name, **{"length": L, **section, **more})


def assembly(*rods, bodies, nodes=11, **more):
    still = {"gravity": (0.0, 0.0, 0.0), "nodes": nodes}
    return Assembly(rods=rods, bodies=tuple(bodies), **still | more)


def moved(robot, body, **options):
    """Return the displacement of a body in an equilibrium without control."""
    controls = np.zeros(robot.control_layout.size)
    found = kc.equilibrium(robot, controls, newton=NEWTON, **options)
    assert found.all_valid
    return found.part(f"{body}_p")[0, 0] - np.asarray(robot.y_layout.get(robot.rest(0.0)[0], f"{body}_p"))


def errors(make, exact, nodes, **options):
    return [abs(make(count, **options) / exact - 1.0) for count in nodes]


def angle_frame(nodes, **options):
    """Return the height lost by the tip of a beam on a column, under a force at the tip (m)."""
    column, beam = (
        rod("column", tip_end=on("corner")),
        rod("beam", base_end=on("corner", orientation=ALONG_X), tip_end=on("load")),
    )
    bodies = RigidBody(name="corner"), RigidBody(name="load", force=(0.0, 0.0, -FORCE))
    return -moved(assembly(column, beam, bodies=bodies, nodes=nodes), "load", **options)[2]


def four_bar(nodes, **options):
    """Return the sway of a coupler on two upright rods, all of them elastic (m)."""
    rods = (
        rod("left", tip_end=on("a")),
        rod("right", base_end=Clamped(position=(L, 0.0, 0.0)), tip_end=on("b")),
        rod("coupler", base_end=on("a", orientation=ALONG_X), tip_end=on("b", orientation=ALONG_X)),
    )
    bodies = RigidBody(name="a", force=(FORCE, 0.0, 0.0)), RigidBody(name="b")
    return moved(assembly(*rods, bodies=bodies, nodes=nodes), "a", **options)[0]


def grid(nodes, **options):
    """Return the height lost by the crossing of four rods that the ground holds at their other ends (m)."""
    rods = [
        rod(name, base_end=Clamped(position=way, orientation=turn), tip_end=on("crossing", orientation=turn))
        for name, way, turn in (
            ("west", (-L, 0.0, 0.0), ALONG_X),
            ("east", (L, 0.0, 0.0), (1.0, 0.0, -1.0, 0.0)),
            ("north", (0.0, L, 0.0), (1.0, 1.0, 0.0, 0.0)),
            ("south", (0.0, -L, 0.0), (1.0, -1.0, 0.0, 0.0)),
        )
    ]
    crossing = RigidBody(name="crossing", force=(0.0, 0.0, -FORCE))
    return -moved(assembly(*rods, bodies=[crossing], nodes=nodes), "crossing", **options)[2]


#: a frame of two beams, whose column has the moment F L; a portal frame of equal rods, (2 + 3) / (1 + 6);
#: four beams that neither end turns
FRAMES = {
    angle_frame: FORCE * L**3 / EI * (1 / 3 + 1),
    four_bar: FORCE * L**3 / (12 * EI) * 5 / 7,
    grid: FORCE * L**3 / (48 * EI),
}


@pytest.mark.parametrize(
    "frame", [angle_frame, *(pytest.param(frame, marks=pytest.mark.slow) for frame in (four_bar, grid))]
)
def test_frames_bend_as_beams_with_order_two(frame):
    missing = errors(frame, FRAMES[frame], (11, 21))
    assert np.log2(missing[0] / missing[1]) == pytest.approx(2.0, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("frame", FRAMES)
def test_frames_bend_as_beams_to_a_millionth(frame):
    assert frame(11, space="lobatto4") == pytest.approx(FRAMES[frame], rel=1e-6)


@pytest.mark.slow
def test_a_ball_joint_passes_forces_on_but_no_moments():
    """Two rods on one line meet at a body, one of them with a ball joint: 3 EI / L³ each."""
    below, above = (
        rod("below", tip_end=on("hub")),
        rod(
            "above",
            base_end=Clamped(position=(0.0, 0.0, 2.0 * L), orientation=DOWN),
            tip_end=on("hub", Pinned, orientation=DOWN),
        ),
    )
    hub = RigidBody(name="hub", force=(FORCE, 0.0, 0.0))
    sway = moved(assembly(below, above, bodies=[hub]), "hub", space="lobatto4")[0]
    assert sway == pytest.approx(FORCE * L**3 / (6 * EI), rel=1e-6)


@pytest.mark.slow
def test_a_driven_joint_turns_a_rod_on_a_body():
    lower, upper = (
        rod("lower", tip_end=on("elbow")),
        rod("upper", base_end=on("elbow", Driven, axes=("rx", "z"))),
    )
    robot = assembly(lower, upper, bodies=[RigidBody(name="elbow")])
    assert kc.controls.labels(robot.control_layout) == ["upper_base_rx", "upper_base_z"]
    tip = kc.equilibrium(robot, [0.5, 0.02]).part("upper_p")[0, -1]
    np.testing.assert_allclose(tip, [0.0, -L * np.sin(0.5), L + 0.02 + L * np.cos(0.5)], atol=1e-12)


def swinging(heavy, **more):
    """Return a rod with a body at its tip: a load of the rod, or a body of an assembly."""
    more = {"bending_damping": 1e-3, **more}
    if heavy:
        return rod("arm", loads=(AttachedMass(mass=0.1, inertia=(1e-4, 2e-4, 3e-4)),), **more)
    return Assembly(
        rods=(rod("arm", tip_end=on("mass"), **more),),
        bodies=(RigidBody(name="mass", mass=0.1, inertia=np.diag([1e-4, 2e-4, 3e-4])),),
        nodes=10,
    )


@pytest.mark.slow
def test_a_body_at_the_tip_moves_as_a_mass_on_the_rod():
    """Its base is pushed and turned. The rates of the body are those of its pose, not the rod's."""
    t = 0.01 * np.arange(1, 61)[:, None]
    turning = {"base_end": Driven(axes=("x", "ry"))}
    control = np.concatenate([0.02 * (1.0 - np.cos(5.0 * t)), 0.15 * (1.0 - np.cos(7.0 * t))], axis=1)
    tips = [kc.simulate(swinging(heavy, **turning), control, 0.01).tip_position for heavy in (True, False)]
    assert np.ptp(tips[0][:, 0]) > 0.1
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-5)


@pytest.mark.slow
def test_a_body_at_the_tip_vibrates_as_a_mass_on_the_rod():
    modes = []
    for heavy in (True, False):
        found = kc.equilibrium(swinging(heavy, bending_damping=1e-4).replace(nodes=11), [], space="lobatto4")
        modes.append(kc.statics.modes(found, count=6))
    np.testing.assert_allclose(modes[1].values, modes[0].values, rtol=1e-6)
    # the arm, then the body; torsion, the third, moves no line
    bending = [0, 1, 3, 4]
    shapes = [np.abs(shape) for shape in (modes[1].shapes[bending, :, 0], modes[0].shapes[bending])]
    np.testing.assert_allclose(*shapes, atol=1e-5)


@pytest.mark.slow
def test_a_divided_rod_bends_as_a_whole_one():
    """The grids are the same, and the body between both halves weighs nothing."""
    whole = rod("whole", length=2.0 * L, nodes=11)
    halves = Assembly(
        rods=(rod("lower", tip_end=on("joint")), rod("upper", base_end=on("joint"))),
        bodies=(RigidBody(name="joint"),),
        gravity=(40.0, 10.0, -90.0),
        nodes=6,
    )
    one = kc.equilibrium(whole.replace(gravity=(40.0, 10.0, -90.0)), [], newton=NEWTON).part("p")[0]
    two = kc.equilibrium(halves, [], newton=NEWTON)
    assert one[-1, 0] > 0.05
    np.testing.assert_allclose(two.part("lower_p")[0], one[:6], atol=1e-10)
    np.testing.assert_allclose(two.part("p")[0, :, 1], one[5:], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("legs", [3, pytest.param(6, marks=pytest.mark.campaign)])
def test_legs_and_a_platform_are_the_parallel_robot(legs):
    robot = kc.load_robot("six-legged-robot")
    base, platform = (np.asarray(angles)[:legs] for angles in (robot.base_angles, robot.platform_angles))
    robot = robot.replace(base_angles=base, platform_angles=platform)
    circle = 0.087 * np.stack(
        [np.cos([base, platform]), np.sin([base, platform]), np.zeros((2, legs))], axis=-1
    )
    section = {
        name: getattr(robot, name)
        for name in ("length", "radius", "density", "youngs_modulus", "bending_damping", "drag")
    }
    same = Assembly(
        rods=tuple(
            SlenderRod(
                name=f"leg{k}",
                base_end=Driven(position=circle[0, k]),
                tip_end=Clamped(body="platform", position=circle[1, k]),
                **section,
            )
            for k in range(legs)
        ),
        bodies=(RigidBody(name="platform", mass=robot.platform_mass, inertia=robot.inertia),),
    )
    control = np.array([0.02, -0.03, 0.05, 0.01, 0.0, -0.02])[:legs]
    both = [kc.equilibrium(one, control, newton=NEWTON) for one in (robot, same)]
    assert all(one.all_valid for one in both)
    place = robot.platform_position(both[0].y)[0]
    np.testing.assert_allclose(both[1].part("platform_p")[0, 0], place, atol=1e-9)


def side_by_side(stiffness, **more):
    """Return two upright rods that touch, of which the left is pressed to the right."""
    pushed = rod("left", loads=(DistributedWrench(force=(1e-4 * EI / L**3, 0.0, 0.0)),))
    other = rod("right", base_end=Clamped(position=(2.0 * RADIUS, 0.0, 0.0)))
    contact = NeighbourContact(first="left", second="right", stiffness=stiffness, smoothing=1e-6, **more)
    return assembly(pushed, other, bodies=(), nodes=21, contacts=(contact,))


@pytest.mark.slow
def test_neighbours_share_a_load():
    """The mean bends by half of the load, w L⁴ / 16 EI; the gap bends by EI g⁗ = w - 2 f(g)."""
    load, stiffness = 1e-4 * EI / L**3, 400.0 * EI / L**4
    found = kc.equilibrium(side_by_side(stiffness), [], newton=NEWTON, space="lobatto4")
    x = [found.part(f"{name}_p")[0, :, 0] - start for name, start in (("left", 0.0), ("right", 2.0 * RADIUS))]
    assert 0.5 * (x[0] + x[1])[-1] == pytest.approx(load * L**4 / (16 * EI), rel=1e-6)

    def curve(s, y):
        pushed = stiffness * 1e-6 * np.logaddexp(0.0, y[0] / 1e-6)
        return np.stack([y[1], y[2], y[3], (load - 2.0 * pushed) / EI])

    exact = solve_bvp(
        curve,
        lambda a, b: np.array([a[0], a[1], b[2], b[3]]),
        np.linspace(0.0, L, 60),
        np.zeros((4, 60)),
        tol=1e-10,
    ).sol(np.linspace(0.0, L, 21))[0]
    np.testing.assert_allclose(x[0] - x[1], exact, atol=1e-6 * load * L**4 / EI)


def test_recovery_smooths_contacts_of_the_assembly_and_of_its_rods():
    ball = kc.robots.surroundings.Sphere(smoothing=1e-5)
    robot = side_by_side(1e4).replace(**{"rods.right.surroundings": (ball,)})
    easier = ease(robot, 0.1)
    assert easier.contacts[0].smoothing == pytest.approx(1e-5)
    assert easier.rods[1].surroundings[0].smoothing == pytest.approx(1e-4)
    assert easier.rods[0] is robot.rods[0]


@pytest.mark.slow
def test_friction_of_neighbours_is_a_part_of_their_pressure():
    """The right rod is pulled past the left: μ times the pressure of both holds its base back."""
    robot = side_by_side(400.0 * EI / L**4, friction=0.5, slip=1e-6)
    robot = robot.replace(
        rods=(robot.rods[0], robot.rods[1].replace(base_end=Driven(position=(2.0 * RADIUS, 0.0, 0.0)))),
        **{"rods.left.bending_damping": 0.1},
    )
    robot = robot.replace(**{"rods.right.bending_damping": 0.1})
    moved = kc.simulate(robot, 1e-3 * 0.02 * np.arange(1, 101)[:, None], 0.02)
    assert moved.all_valid
    pressure, friction = (np.abs(moved.part("right_n")[-1, 0, k]) for k in (0, 2))
    assert friction == pytest.approx(0.5 * pressure, rel=1e-3)


@pytest.mark.slow
def test_gradients_and_batches_are_those_of_single_assemblies():
    control = np.zeros((20, 0))

    def tip(modulus):
        robot = swinging(False, gravity=(0.0, 0.0, -9.81)).replace(**{"rods.arm.youngs_modulus": modulus})
        return kc.simulate(robot.replace(gravity=(3.0, 0.0, -9.0)), control, 0.02).tip_position[-1, 0]

    slope, step = jax.grad(tip)(E), 1e-4 * E
    assert slope == pytest.approx((tip(E + step) - tip(E - step)) / (2.0 * step), rel=1e-5)
    robots = [
        swinging(False).replace(gravity=(x, 0.0, -9.0), **{"rods.arm.length": L * x}) for x in (1.0, 1.1)
    ]
    several = kc.simulate(
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *robots), np.stack([control] * 2), 0.02
    )
    for row, robot in zip(several.tip_position, robots, strict=True):
        np.testing.assert_allclose(row, kc.simulate(robot, control, 0.02).tip_position, atol=1e-9)


def test_the_gripper_has_names_for_its_controls_and_rods():
    robot = kc.load_robot("three-finger-gripper")
    assert kc.controls.labels(robot.control_layout)[2:] == [
        "arm_tension_3",
        "thumb_tension",
        "index_tension",
        "middle_tension",
    ]
    assert robot.replace(length=0.5).rods[1].length == pytest.approx(0.16)
    assert robot.replace(**{"rods.thumb.length": 0.1}).rods[1].length == 0.1


def test_bodies_and_rods_are_at_rest_where_they_are_joined():
    robot = kc.load_robot("three-finger-gripper")
    y, get = np.asarray(robot.rest(0.0)[0]), robot.y_layout.get
    np.testing.assert_allclose(get(y, "palm_p"), [0.0, 0.0, 0.258], atol=1e-12)
    np.testing.assert_allclose(get(y, "thumb_p"), [0.02, 0.0, 0.266], atol=1e-12)
    # from the ground by the tip of a rod: its base holds the body
    hanging = rod("a", base_end=on("hook"), tip_end=Clamped(position=(1.0, 0.0, 0.0)))
    robot = assembly(hanging, bodies=[RigidBody(name="hook")])
    np.testing.assert_allclose(robot.rest(0.0)[0][-19:-16], [1.0, 0.0, -L], atol=1e-12)


def test_a_tendon_of_a_rod_that_would_push_is_told():
    robot = kc.load_robot("three-finger-gripper")
    with pytest.warns(UserWarning, match="a tension is -1 N: a tendon only pulls"):
        check_limits(robot, np.array([0.0, 0.0, 0.0, -1.0, 0.0, 0.0]))
