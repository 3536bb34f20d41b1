"""Against closed forms: beams, circles, helices, the elastica, a column, a bar in motion; orders in space."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from benchmarks.closed_forms import COLUMN, ELASTICA, elastica, helix

LENGTH, RADIUS, YOUNGS_MODULUS, DENSITY = 0.5, 0.004, 3e9, 1200.0
AREA, EI = np.pi * RADIUS**2, YOUNGS_MODULUS * np.pi * RADIUS**4 / 4
FORCE, MOMENT = EI / LENGTH**2, EI / LENGTH
#: the elastica and the column neither shear nor stretch
RIGID = 1e10 * FORCE
#: solved so far that what is left is the schemes' error
NEWTON = kc.solvers.NewtonOptions(tolerance=1e-13)
#: name, order, and the numbers of nodes at which it shows
SPACES = [("euler", 1, (21, 41)), ("lobatto2", 2, (21, 41)), ("lobatto4", 4, (11, 21))]


def _vector(value):
    return np.asarray(value, dtype=float)


class TipLoaded(kc.robots.TendonRobot):
    """A rod with a dead force (N) and moment (N m) at its tip."""

    tip_force: Any = eqx.field(converter=_vector, default=(0.0, 0.0, 0.0))
    tip_moment: Any = eqx.field(converter=_vector, default=(0.0, 0.0, 0.0))

    def tip(self, t, control, y, y_t):
        return super().tip(t, control, y, y_t) + jnp.concatenate([self.tip_force, self.tip_moment])


def rod(*, nodes=21, **changes):
    """Without gravity, of a section that cannot shear; two tendons, one along x and one along y."""
    parameters = {
        "length": LENGTH,
        "radius": RADIUS,
        "youngs_modulus": YOUNGS_MODULUS,
        "density": DENSITY,
        "gravity": (0.0, 0.0, 0.0),
        "tendon_angles": (0.0, np.pi / 2),
        "shear_stiffness": RIGID,
    }
    return TipLoaded(nodes=nodes, **{**parameters, **changes})


def shape(robot, tension=(0.0, 0.0), space="lobatto4"):
    """Positions of the nodes at rest."""
    found = kc.equilibrium(robot, tension, space=space, newton=NEWTON)
    assert found.all_valid
    return found.position[0]


# stiffness


def test_stiffness_follows_from_the_section():
    robot = rod(shear_stiffness=None)
    G = YOUNGS_MODULUS / 2.6
    np.testing.assert_allclose(robot.Kse, np.diag([G * AREA, G * AREA, YOUNGS_MODULUS * AREA]), rtol=1e-14)
    np.testing.assert_allclose(robot.Kbt, np.diag([EI, EI, 2 * EI / 2.6]), rtol=1e-14)


# small deflection: what is missing is the nonlinear part, of relative size load²

SHEAR = 30 * FORCE  # so soft that shear is a tenth of the deflection
LINEAR = {
    "tip force": lambda load: (
        {"tip_force": (load, 0.0, 0.0)},
        (0.0, 0.0),
        load * LENGTH**3 / (3 * EI) + load * LENGTH / SHEAR,
    ),
    "tendon force": lambda load: (
        {},
        (load / LENGTH, 0.0),
        load * LENGTH**3 / (8 * EI) + load * LENGTH / (2 * SHEAR),
    ),
    "weight": lambda load: (
        {"gravity": (load / (LENGTH * AREA * DENSITY), 0.0, 0.0)},
        (0.0, 0.0),
        load * LENGTH**3 / (8 * EI) + load * LENGTH / (2 * SHEAR),
    ),
    "tip moment": lambda load: (
        {"tip_moment": (0.0, load * LENGTH, 0.0)},
        (0.0, 0.0),
        load * LENGTH**3 / (2 * EI),
    ),
}


@pytest.mark.campaign
@pytest.mark.parametrize("loading", LINEAR)
def test_cantilever_of_small_deflection(loading):
    errors = []
    for part in (0.04, 0.02, 0.01):
        loads, tension, expected = LINEAR[loading](part * FORCE)
        tip = shape(rod(shear_stiffness=(SHEAR, SHEAR, 1e3 * SHEAR), **loads), tension)[-1]
        assert tip[1] == pytest.approx(0.0, abs=1e-12)
        errors.append(abs(tip[0] / expected - 1))
    assert errors[-1] < 3e-5
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, rtol=0, atol=0.01)


# a tip moment alone: the tangent turns about the moment's axis at |M| / EI


MOMENTS = {
    "half circle": (0.0, np.pi * MOMENT, 0.0),
    "full circle": (1.2 * np.pi * MOMENT, 1.6 * np.pi * MOMENT, 0.0),
    "helix": (3.0 * MOMENT, -1.0 * MOMENT, 4.0 * MOMENT),
}


@pytest.mark.campaign
@pytest.mark.parametrize("moment", MOMENTS)
def test_moment_bends_the_rod_to_a_circle_and_with_twist_to_a_helix(moment):
    found = shape(rod(tip_moment=MOMENTS[moment]))
    expected = helix(MOMENTS[moment], np.linspace(0, LENGTH, 21), EI)
    # order 4 at 20 segments, of which each turns by 18 degrees in a full circle
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-5 * LENGTH)


@pytest.mark.campaign
def test_full_circle_closes():
    tip = shape(rod(tip_moment=(0.0, 2 * np.pi * MOMENT, 0.0)))[-1]
    np.testing.assert_allclose(tip, 0.0, atol=1e-4 * LENGTH)


# the elastica: a dead force across the tip


def bent(load, nodes=21, space="lobatto4"):
    """The same two numbers of the rod."""
    tip = shape(rod(tip_force=(load * FORCE, 0.0, 0.0), nodes=nodes), space=space)[-1]
    return np.array([tip[0], LENGTH - tip[2]]) / LENGTH


@pytest.mark.slow
@pytest.mark.parametrize("load", ELASTICA)
def test_elastica(load):
    # at 20 segments order 4 is better than the five digits that are published
    np.testing.assert_allclose(bent(load), elastica(load), rtol=0, atol=5e-6)


@pytest.mark.slow
def test_elastica_in_another_direction():
    # the force along -y instead of x, of a rod whose x and y are alike
    tip = shape(rod(tip_force=(0.0, -2 * FORCE, 0.0)))[-1]
    np.testing.assert_allclose(tip / LENGTH, [0, -elastica(2)[0], 1 - elastica(2)[1]], rtol=0, atol=5e-6)


# the order in space: what doubling the segments does to the distance from the closed form


@pytest.mark.campaign
@pytest.mark.parametrize(("space", "order", "grids"), SPACES)
def test_order_in_space_of_the_elastica(space, order, grids):
    errors = [np.abs(bent(5, nodes=nodes, space=space) - elastica(5)) for nodes in grids]
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), order, rtol=0, atol=0.15)


@pytest.mark.campaign
@pytest.mark.parametrize(("space", "order", "grids"), SPACES)
def test_order_in_space_of_the_helix(space, order, grids):
    moment = np.array(MOMENTS["helix"]) / 2
    errors = []
    for nodes in grids:
        expected = helix(moment, np.linspace(0, LENGTH, nodes), EI)
        found = shape(rod(tip_moment=moment, nodes=nodes), space=space)
        errors.append(np.linalg.norm(found - expected, axis=1).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


class Bar(kc.System):
    """A bar that only stretches, of unit length, stiffness and mass, damped, under a load along a sine.

    Its displacement is a(t) sin(κ s), for which BDF2 makes a recursion of a: what is left is the error in
    space, and history in the middle of the segments has its part in that.
    """

    y_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(
        ("p", 1, "m", "position"), ("n", 1, "N", "force"), ("q", 1, "m/s", "velocity")
    )
    z_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(("v", 1, "1", "stretch"))
    control_layout: ClassVar[kc.robots.Layout] = kc.robots.Layout(("load", 1, "N/m", "largest load"))
    base_unknowns: ClassVar[tuple[str, ...]] = ("n",)
    mixed: ClassVar[bool] = False
    #: a wave number at which nothing moves at the base nor pulls at the tip
    wave_number: ClassVar[float] = 1.5 * np.pi

    damping: Any = 0.5
    length: Any = 1.0
    nodes: int = eqx.field(static=True, default=11)

    def constitutive(self, s, t, y, y_t, control):
        return jnp.eye(1), self.damping * jnp.eye(1), y[1:2] + 1.0

    def balance(self, s, t, y, y_t, z, z_t, control):
        n_s = y_t[2] - control[0] * jnp.sin(self.wave_number * s)
        return jnp.stack([z[0], n_s, z_t[0]])

    def rest(self, s):
        return jnp.stack([s, jnp.zeros(()), jnp.zeros(())]), jnp.ones(1)

    def tip(self, t, control, y, y_t):
        return self.y_layout.get(y, "n")

    def amplitude(self, load, dt):
        """a of all rows by the recursion."""
        c0, c1, c2 = 1.5 / dt, -2.0 / dt, 0.5 / dt
        stiff = self.wave_number**2
        a, rate = [0.0, 0.0], [0.0, 0.0]
        for force in load:
            h_a, h_rate = (c1 * past[-1] + c2 * past[-2] for past in (a, rate))
            drag = c0 + stiff * self.damping
            a.append((force - h_rate - drag * h_a) / (c0 * drag + stiff))
            rate.append(c0 * a[-1] + h_a)
        return np.array(a[1:])


@pytest.mark.parametrize(
    ("space", "order", "grids"),
    [
        pytest.param("euler", 1, (41, 81), marks=pytest.mark.campaign),
        ("lobatto2", 2, (41, 81)),
        ("lobatto4", 4, (21, 41)),
    ],
)
def test_order_in_space_of_a_motion(space, order, grids):
    dt, load = 0.2, np.sin(np.linspace(0.2, 3.0, 12))
    errors = []
    for nodes in grids:
        bar = Bar(nodes=nodes)
        s = np.linspace(0, 1, nodes)
        expected = s + bar.amplitude(load, dt)[:, None] * np.sin(bar.wave_number * s)
        found = kc.simulate(bar, load[:, None], dt, time="bdf2", start="paper", space=space, newton=NEWTON)
        errors.append(np.abs(found.part("p")[..., 0] - expected).max())
    # order 4 with a linearly interpolated history shows order 2 here
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


# an upright column under its own weight (Greenhill)


def test_column_buckles_under_its_own_weight():
    length = 2 * LENGTH  # so slender that a gravity below ten times the Earth's does it
    push = 1e-6 * EI / length**3

    def sideways(weight):
        """What a small force does to a column of ρ A g L³ / EI = weight."""
        gravity = (0.0, 0.0, -weight * EI / (DENSITY * AREA * length**3))
        return shape(rod(gravity=gravity, length=length), (push, 0.0))[-1, 0]

    # Beyond the critical weight the column that is still nearly straight leans against the push.
    assert sideways(COLUMN * 0.999) > 100 * sideways(0.0)
    assert sideways(COLUMN * 1.001) < -100 * sideways(0.0)
