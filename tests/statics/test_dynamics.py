"""Stability under loads without a potential: classical flutter and divergence loads, and an independent beam.

All columns are one robot with other parameters, so that one program serves them: a clamped rod with a force
and a torque that follow its tip, a tangential force along it, a dead force, a tip mass, internal damping and
drag.
"""

import dataclasses

import numpy as np
import pytest
from numpy.polynomial import Legendre, Polynomial

import knode_cosserat as kc
from knode_cosserat.rods.loads import AttachedMass, DistributedWrench, PointWrench

L, RADIUS, E, DENSITY = 1.0, 0.005, 1e9, 1e3
EI, MASS = E * np.pi * RADIUS**4 / 4, DENSITY * np.pi * RADIUS**2
UNIT, TIME = EI / L**2, L**2 * np.sqrt(MASS / EI)


def column(follower=0.0, tangential=0.0, dead=0.0, torque=0.0, mass=0.0, damping=0.0, drag=0.0, side=0.0):
    """Return a column: loads in EI/L², mass in that of the rod, damping and drag in natural units."""
    loads = (
        PointWrench(force=[0.0, 0.0, -follower * UNIT], moment=[0.0, 0.0, torque * EI / L], follows=True),
        DistributedWrench(force=[0.0, 0.0, -tangential * UNIT / L], follows=True),
        PointWrench(force=[side * UNIT, 0.0, -dead * UNIT]),
        AttachedMass(mass=mass * MASS * L),
    )
    return kc.robots.SlenderRod(
        length=L,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=E,
        gravity=[0.0, 0.0, 0.0],
        nodes=21,
        loads=loads,
        bending_damping=damping * EI * TIME,
        linear_drag=drag * MASS / TIME,
    )


def decided(**loads):
    rest = kc.equilibrium(column(**loads), np.zeros(0), space="lobatto4", with_stability=False)
    return kc.statics.stability(rest)


def beam(follower=0.0, tangential=0.0, dead=0.0, mass=0.0, damping=0.0, drag=0.0):
    """Return λ of the slowest modes of a plane column (natural units), by Galerkin's method."""
    x = Polynomial([0.0, 1.0])
    # clamped at 0
    basis = [x**2 * Legendre.basis(k, domain=[0.0, 1.0]).convert(kind=Polynomial) for k in range(9)]

    def integral(product):
        whole = product.integ()
        return whole(1.0) - whole(0.0)

    def matrix(form):
        return np.array([[form(v, w) for w in basis] for v in basis])

    M = matrix(lambda v, w: integral(v * w) + mass * v(1.0) * w(1.0))
    bending = matrix(lambda v, w: integral(v.deriv(2) * w.deriv(2)))
    K = bending - matrix(
        lambda v, w: (
            (follower + dead) * integral(v.deriv() * w.deriv())
            - follower * v(1.0) * w.deriv()(1.0)
            + tangential * (integral((1.0 - x) * v.deriv() * w.deriv()) - integral(v * w.deriv()))
        )
    )
    D = damping * bending + drag * matrix(lambda v, w: integral(v * w))
    count = len(basis)
    zero, one = np.zeros((count, count)), np.eye(count)
    first = np.block([[zero, one], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    values = np.linalg.eigvals(first)
    return values[np.argsort(np.abs(values))][:8]


@pytest.mark.slow
def test_a_force_that_follows_the_tip_flutters_and_never_buckles():
    """Beck (1952): 20.05 EI/L², in both planes at once; a dead force buckles at π²/4."""
    for load in (5.0, 15.0, 19.8):
        found = decided(follower=load)
        assert found.kind == "stable" and found.stable and found.unstable_directions == 0
        slowest = np.min(np.abs(beam(follower=load)))
        assert found.eigenvalue.imag * TIME == pytest.approx(slowest, rel=0.01)
    found, theory = decided(follower=21.0), beam(follower=21.0)
    fastest = theory[np.argmax(theory.real)]
    assert found.kind == "flutter" and not found.stable and found.unstable_directions == 2
    assert found.eigenvalue.real * TIME == pytest.approx(fastest.real, rel=0.02)
    assert found.eigenvalue.imag * TIME == pytest.approx(abs(fastest.imag), rel=0.01)
    # the tip moves most, and sideways
    moved = np.linalg.norm(found.mode[:, :2], axis=1)
    assert np.max(moved) == pytest.approx(1.0, abs=1e-3)
    assert "unstable in 2 directions by flutter" in repr(found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("load", "critical", "kind"),
    [
        # Leipholz: a tangential load along the column
        (lambda q: {"tangential": q}, 40.05, "flutter"),
        # Pflüger: a tip mass equal to the column's; Galerkin's method
        (lambda P: {"follower": P, "mass": 1.0}, 16.21, "flutter"),
        # Bolotin & Zhinzher (1969): slight internal damping halves Beck's load
        (lambda P: {"follower": P, "damping": 1e-3}, 10.94, "flutter"),
        # drag raises it; Galerkin's method
        (lambda P: {"follower": P, "drag": 2.0}, 20.26, "flutter"),
        # three tenths follow: cos √P = -3/7
        (lambda P: {"follower": 0.3 * P, "dead": 0.7 * P}, 4.055, "divergence"),
        (lambda P: {"follower": 0.6 * P, "dead": 0.4 * P}, 16.26, "flutter"),
    ],
    ids=["Leipholz", "Pflüger", "Ziegler", "drag", "part, divergence", "part, flutter"],
)
def test_classical_loads_are_found_from_both_sides(load, critical, kind):
    below, above = (decided(**load(part * critical)) for part in (0.98, 1.02))
    assert below.kind == "stable" and above.kind == kind and above.unstable_directions == 2
    theory = beam(**load(1.02 * critical))
    assert above.eigenvalue.real * TIME == pytest.approx(np.max(theory.real), rel=0.1)


@pytest.mark.slow
def test_the_least_torque_at_a_free_end_is_unstable_without_damping():
    """Nicolai's paradox (1928): growth in proportion to the torque; drag c slows every growth by c/2."""
    growth = [decided(torque=torque).eigenvalue.real * TIME for torque in (0.05, 0.5)]
    assert growth[1] == pytest.approx(10.0 * growth[0], rel=0.02)
    found = decided(torque=0.5, drag=1.0)
    assert found.kind == "flutter"
    assert found.eigenvalue.real * TIME == pytest.approx(growth[1] - 0.5, abs=1e-3)
    assert decided(torque=0.05, drag=1.0).kind == "stable"


@pytest.mark.slow
def test_strong_damping_of_bending_leaves_a_decision():
    """Over-damped bending, and undamped stretching."""
    assert decided(follower=5.0, damping=0.3).kind == "stable"


@pytest.mark.slow
def test_dead_loads_are_decided_by_energy():
    for load, kind in ((0.98, "stable"), (1.02, "divergence")):
        found = decided(dead=load * np.pi**2 / 4.0)
        assert found.kind == kind and found.eigenvalue is None and found.asymmetry < 1e-8


@pytest.mark.slow
def test_velocities_of_rounding_size_are_no_motion():
    rest = kc.equilibrium(column(dead=1.0), np.zeros(0), space="lobatto4")
    y = np.array(rest.y)
    y[..., rest.system.y_layout.slice("w")] = 3e-8 / TIME
    found, still = kc.statics.stability(dataclasses.replace(rest, y=y)), kc.statics.stability(rest)
    assert found.stable and found.least == pytest.approx(still.least, rel=1e-9)
