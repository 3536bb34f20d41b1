"""Random robots of each kind that has parts: every step is solved, or the one that is not says why.

A case that has no solution with 11 nodes is asked again with 41: discrete equations of a coarse grid need not
have one.

What is drawn is of everyday sizes, without regard to whether it is easy: rods of 0.1 to 1 m and 1 to 10 mm
from silicone to steel, loaded up to a few times EI/L², pushed at obstacles, pulled by tendons or reels. All
of one kind have the same parts, and so one program. Time steps of 1 to 100 ms are a hundred thousandth to a
thousand of a rod's natural times.
"""

import collections
import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.rods.ends import Clamped, Driven, Pinned
from knode_cosserat.rods.loads import AttachedMass, DistributedWrench, PointWrench
from knode_cosserat.rods.routing import Helical, Polynomial, Straight, Tapered
from knode_cosserat.rods.surroundings import Cylinder, Plane, Sphere
from knode_cosserat.rods.tendons import TendonFriction
from tests.solvers.test_random_cases import Case, worst_result

STEPS = 40
SOME = 4
#: how far a base moves in a rod's natural time L² √(ρA/EI), in lengths (and angles, in rad); reels in tendon
#: offsets. What moves at L per natural time bends the rod by 1/L: this is to a motion what a few EI/L² are to
#: a force.
QUICK = 4.0


class Draws:
    """Numbers of one case, from its seed."""

    def __init__(self, seed):
        self.generator = np.random.default_rng(seed)

    def log(self, low, high):
        return float(np.exp(self.generator.uniform(np.log(low), np.log(high))))

    def vector(self, size):
        direction = self.generator.normal(size=3)
        return size * self.generator.uniform() * direction / np.linalg.norm(direction)

    def signals(self, count, low, high):
        """Sines, a step, or noise between low and high (steps, count)."""
        t = np.arange(1, STEPS + 1)[:, None] / STEPS
        kind = self.generator.integers(3)
        if kind == 0:
            phase, times = self.generator.uniform(0, 6, count), self.log(1, 6)
            wave = 0.5 + 0.5 * np.sin(2 * np.pi * times * t + phase)
        elif kind == 1:
            wave = np.where(t > 0.3, *self.generator.uniform(size=(2, count)))
        else:
            wave = np.repeat(self.generator.uniform(size=(STEPS // 5, count)), 5, axis=0)
        return low + (high - low) * wave


def unhurried(signal, most):
    """A signal that begins at zero and changes by no more than `most` in a step."""
    reached = np.zeros(signal.shape[1])
    for row in signal:
        reached = row[:] = reached + np.clip(row - reached, -most, most)
    return signal


def rod(draws):
    """Parameters of a rod, its EI, its length, a time step, and that step in the rod's natural times."""
    E, radius, L = draws.log(2e5, 200e9), draws.log(1e-3, 1e-2), draws.log(0.1, 1.0)
    EI, density = E * np.pi * radius**4 / 4, draws.log(500.0, 8000.0)
    heavy = 4.0 * EI / (density * np.pi * radius**2 * L**3)
    period = L**2 * np.sqrt(density * np.pi * radius**2 / EI)
    parameters = {
        "length": L, "radius": radius, "density": density, "youngs_modulus": E, "nodes": 11,
        "bending_damping": draws.log(1e-3, 0.1) * EI * period, "drag": draws.log(1e-5, 1e-1),
        "gravity": draws.vector(min(9.81, heavy)),
    }  # fmt: skip
    dt = draws.log(1e-3, 0.1)
    return parameters, EI, L, dt, dt / period


def with_loads(seed):
    draws = Draws(seed)
    parameters, EI, L, dt, _ = rod(draws)
    F, mass = 4.0 * EI / L**2, parameters["density"] * np.pi * parameters["radius"] ** 2 * L
    loads = (
        PointWrench(at=0.35, force=draws.vector(F), moment=draws.vector(F * L / 2), controlled=True),
        PointWrench(at=1.0, force=draws.vector(F), follows=True, controlled=True),
        DistributedWrench(begin=0.2, end=0.7, force=draws.vector(F / L), moment=draws.vector(F / 4)),
        AttachedMass(at=0.6, mass=mass * draws.log(0.1, 2.0), offset=draws.vector(0.1 * L)),
        AttachedMass(at=1.0, mass=mass * draws.log(0.01, 0.5), inertia=np.full(3, 0.01 * mass * L**2)),
    )
    return Case(kc.robots.SlenderRod(**parameters, loads=loads), draws.signals(2, -1.0, 1.0), dt)


def with_ends(seed, hurry=QUICK):
    """Driven at its base; clamped or pinned at its tip, somewhat away from where it would be."""
    draws = Draws(seed)
    parameters, _, L, dt, times = rod(draws)
    end = Clamped if seed % 2 else Pinned
    base = Driven(axes=("x", "z", "ry"), position=[0.0, 0.0, 0.0])
    tip = end(
        position=np.array([0.0, 0.0, L]) + draws.vector(0.15 * L) - [0.0, 0.0, 0.1 * L],
        orientation=Rotation.from_rotvec(draws.vector(0.6)).as_quat(scalar_first=True),
    )
    control = draws.signals(3, -1.0, 1.0) * np.array([0.1 * L, 0.05 * L, 0.4])
    control = unhurried(control, hurry * times * np.array([L, L, 1.0]))
    return Case(kc.robots.SlenderRod(**parameters, base_end=base, tip_end=tip), control, dt)


def in_contact(seed, hurry=QUICK):
    """Pushed and turned among a plane, a ball and a bar, with friction."""
    draws = Draws(seed)
    parameters, EI, L, dt, times = rod(draws)
    k = draws.log(10.0, 1e4) * EI / L**4
    law = {
        "stiffness": k,
        "smoothing": draws.log(3e-4, 3e-2) * L,
        "damping": 1.0,
        "friction": draws.generator.uniform(0.0, 0.6),
        "slip": 0.02 * L,
    }
    across = np.array([0.0, 3.0, 0.0])
    surroundings = (
        Plane(point=[-0.1 * L, 0.0, 0.0], normal=[1.0, 0.0, 0.0], **law),
        Sphere(center=[0.25 * L, 0.1 * L, 0.6 * L], radius=0.15 * L, **law),
        Cylinder(point=[0.0, 0.0, 1.2 * L], axis=draws.vector(1.0) + across, radius=0.15 * L, **law),
    )
    base = Driven(axes=("x", "z", "ry"))
    control = draws.signals(3, 0.0, 1.0) * np.array([0.2 * L, 0.2 * L, 0.5])
    control = unhurried(control, hurry * times * np.array([L, L, 1.0]))
    return Case(kc.robots.SlenderRod(**parameters, base_end=base, surroundings=surroundings), control, dt)


def with_sections(seed):
    draws = Draws(seed)
    parameters, _, L, dt, _ = rod(draws)
    sections = tuple(
        kc.robots.Stretch(
            begin=begin,
            end=end,
            controlled=True,
            radius=[1.0, draws.generator.uniform(-0.3, 0.3)],
            stiffness=[draws.log(0.3, 3.0)],
            curvature=draws.vector(2.0 / L),
            stiffness_gain=0.3,
            curvature_gain=draws.vector(4.0 / L),
        )
        for begin, end in ((0.0, 0.37), (0.37, 1.0))
    )
    return Case(kc.robots.SlenderRod(**parameters, sections=sections), draws.signals(2, -1.0, 1.0), dt)


def with_tendons(seed, drive="tension", hurry=QUICK):
    draws = Draws(seed)
    parameters, EI, L, dt, times = rod(draws)
    r = min(draws.log(1.5, 8.0) * parameters["radius"], 0.1 * L)
    phase = draws.generator.uniform(0.0, 6.0, 4)
    routing = (
        Straight(r * np.cos(phase[0]), r * np.sin(phase[0])),
        Helical(r, phase[1], draws.generator.uniform(-2.0, 2.0)),
        Tapered(r, 0.3 * r, phase[2], end=0.63),
        Polynomial([0.0, r, -r], [r, -2 * r]),
    )
    more = {}
    if drive == "reel":
        # a curvature of up to 3/L
        control = unhurried(draws.signals(4, -3.0 * r, 3.0 * r), hurry * times * r)
        compliance = min(1.0, draws.log(1e-4, 1.0) * r**2 * L / EI)
        more = {"drive": "reel", "tendon_compliance": compliance}
    else:
        control = draws.signals(4, 0.0, 3.0 * EI / (L * r))
        more = {"friction": TendonFriction(wobble=draws.log(0.01, 1.0) / L, curvature=draws.log(0.01, 0.5))}
    return Case(kc.robots.RoutedTendonRobot(**parameters, routing=routing, **more), control, dt)


def with_reels(seed, hurry=QUICK):
    return with_tendons(seed, "reel", hurry)


def several_rods(seed, hurry=QUICK):
    """Six legs that stand anyhow and a platform of up to a quarter of what buckles them.

    They are pushed along, where they are stiff, and the platform has to follow: by 0.02 hurry L in the time
    in which it would swing on its legs.
    """
    draws = Draws(seed)
    parameters, EI, L, dt, times = rod(draws)
    base = np.sort(draws.generator.uniform(0.0, 2.0 * np.pi, 6))
    gravity = np.linalg.norm(parameters["gravity"])
    heavy = 6.0 * np.pi**2 * EI / L**2 / gravity
    mass = min(1e4, draws.generator.uniform(0.0, 0.25) * heavy)
    robot = kc.robots.ParallelRobot(
        **{**parameters, "gravity": [0.0, 0.0, -gravity]},
        base_angles=base,
        platform_angles=base + draws.generator.uniform(-0.6, 0.6, 6),
        base_radius=L * draws.generator.uniform(0.1, 0.3),
        platform_radius=L * draws.generator.uniform(0.1, 0.3),
        platform_mass=mass,
    )
    legs = 6.0 * parameters["density"] * np.pi * parameters["radius"] ** 2 * L
    slower = np.sqrt(1.0 + mass / legs)
    control = unhurried(draws.signals(6, -0.04 * L, 0.04 * L), 0.02 * hurry * times / slower * L)
    return Case(robot, control, dt)


KINDS = {
    each.__name__: each
    for each in (with_loads, with_ends, in_contact, with_sections, with_tendons, with_reels, several_rods)
}


def outcome(case):
    """The worst result; one without an equilibrium to begin in says so by an error."""
    try:
        return worst_result(case)
    except kc.SimulationError as error:
        if error.step > 0:
            raise
        return error.result


def on_fine_grid(case):
    """The same case with four segments in place of one: what is without a solution may lack nodes."""
    return dataclasses.replace(case, robot=case.robot.replace(nodes=41))


def share_solved(name, seeds, **drawn):
    cases = {seed: KINDS[name](seed, **drawn) for seed in seeds}
    results = {seed: outcome(case) for seed, case in cases.items()}
    coarse = [seed for seed, result in results.items() if not result.solved]
    results |= {seed: outcome(on_fine_grid(cases[seed])) for seed in coarse}
    counted = collections.Counter(result.name for result in results.values())
    share = float(np.mean([result.solved for result in results.values()]))
    print(f"\n{name}: {100 * share:.1f} % of {len(results)} solved; {dict(counted)}")
    print(f"not solved with 11 nodes: {coarse}")
    print(f"not solved with 41 nodes: {[seed for seed, result in results.items() if not result.solved]}")
    return share


@pytest.mark.campaign
@pytest.mark.parametrize(("name", "seed"), [("with_tendons", 5), ("with_tendons", 27), ("in_contact", 29)])
def test_friction_that_flips_is_reached_from_a_gentler_one(name, seed):
    """Without it no solution is found: friction of tendons, or in contact, turns round within a step."""
    case = KINDS[name](seed)
    found = kc.simulate(case.robot, case.tensions, case.dt)
    assert np.all(found.result >= 0) and np.all(found.residual <= 1e-8)
    print(collections.Counter(kc.Result(int(each)).name for each in found.result))


@pytest.mark.campaign
@pytest.mark.parametrize("name", ["with_loads"])
def test_some_random_cases(name):
    assert share_solved(name, range(SOME)) == 1.0


@pytest.mark.campaign
@pytest.mark.parametrize("name", KINDS)
def test_500_random_cases(name):
    assert share_solved(name, range(500)) >= 0.99


@pytest.mark.campaign
@pytest.mark.parametrize("name", ["with_ends", "in_contact", "with_reels"])
def test_what_moves_in_jumps_says_so_where_it_is_not_solved(name):
    """Bases and reels that move by any of their range within one step, however short that is."""
    assert share_solved(name, range(60), hurry=np.inf) >= 0.8
