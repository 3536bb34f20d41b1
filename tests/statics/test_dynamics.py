"""Stability under loads without a potential: classical flutter and divergence loads, and an independent beam.

All columns are one robot with other parameters, so that one program serves them: a clamped rod with a force
and a torque that follow its tip, a tangential force along it, a dead force, a tip mass, internal damping and
drag.
"""

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
        length=L, radius=RADIUS, density=DENSITY, youngs_modulus=E, gravity=[0.0, 0.0, 0.0], nodes=21,
        loads=loads, bending_damping=damping * EI * TIME, linear_drag=drag * MASS / TIME,
    )  # fmt: skip


def decided(**loads):
    return kc.statics.stability(kc.equilibrium(column(**loads), np.zeros(0), space="lobatto4"))


def beam(follower=0.0, tangential=0.0, dead=0.0, mass=0.0, damping=0.0, drag=0.0):
    """Return λ of the slowest modes of a plane Euler-Bernoulli column (natural units), by Galerkin's method."""
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


def kinds(loads, name, **others):
    return [decided(**{name: load}, **others).kind for load in loads]
