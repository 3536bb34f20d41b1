"""Modes of vibration against closed forms of beams."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.ends import Clamped, Free, Pinned, Universal

L, RADIUS, E, DENSITY = 1.0, 0.001, 1e9, 1e3
EI, MASS = E * np.pi * RADIUS**4 / 4, DENSITY * np.pi * RADIUS**2
TIME = L**2 * np.sqrt(MASS / EI)
#: roots of the characteristic equations: clamped and free, pinned, clamped; Universal: base and tip pinned;
#: None: two free ends
ROOTS = {
    Free: [1.87510407, 4.69409113, 7.85475744, 10.99554073, 14.13716839],
    Pinned: [3.92660231, 7.06858275, 10.21017612, 13.35176878, 16.49336143],
    Clamped: [4.73004074, 7.85320462, 10.99560784, 14.13716549, 17.27875966],
    Universal: [np.pi * k for k in range(1, 6)],
    None: [4.73004074, 7.85320462, 10.99560784, 14.13716549, 17.27875966],
}


def beam(end, nodes=40, **changes):
    rod = kc.robots.SlenderRod(
        length=L,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=E,
        gravity=[0.0, 0.0, 0.0],
        nodes=nodes,
        tip_end=Free() if end in (Free, None) else end(position=(0.0, 0.0, L)),
        base_end=Pinned() if end is Universal else Clamped(),
        **changes,
    )
    if end is None:
        return kc.simulate(
            rod.replace(base_end=Free(), bending_damping=1e-15),
            np.zeros((2, 0)),
            0.01 * TIME,
            initial="unstressed",
        )
    return kc.equilibrium(rod, np.zeros(0))


@pytest.mark.slow
@pytest.mark.parametrize("end", ROOTS, ids=lambda end: str(end).split(".")[-1])
def test_frequencies_and_shapes_of_a_beam(end):
    """Each mode twice, in two planes at right angles; a mode has one more node than the one before."""
    found = kc.statics.modes(beam(end))
    expected = np.repeat(np.square(ROOTS[end]) / TIME / (2 * np.pi), 2)
    np.testing.assert_allclose(found.frequency, expected, rtol=1e-3)
    assert np.all(np.abs(found.frequency / expected - 1.0)[:4] < 1e-4) and np.all(found.error < 1e-3)
    assert np.abs(found.damping).max() < 1e-9
    for k, shape in enumerate(found.shapes[::2]):
        assert abs(np.vdot(shape, found.shapes[2 * k + 1])) < 1e-6 and np.abs(shape[:, 2]).max() < 1e-3
        plane = shape @ shape[np.argmax(np.linalg.norm(shape, axis=1))]
        assert np.count_nonzero(np.diff(np.sign(plane[np.abs(plane) > 1e-3]))) == k + 2 * (end is None)


def test_damping_of_the_material():
    """Kelvin and Voigt: the ratio is half of frequency times time constant."""
    constant, slow = 0.02 * TIME, np.square(ROOTS[Free][:2]) / TIME
    found = kc.statics.modes(beam(Free, nodes=11, bending_damping=constant * EI), count=4)
    np.testing.assert_allclose(found.damping, np.repeat(0.5 * slow * constant, 2), rtol=2e-3)
    np.testing.assert_allclose(np.abs(found.values), np.repeat(slow, 2), rtol=2e-3)
    assert "damping ratio" in repr(found) and len(repr(found).splitlines()) == 5


def test_what_has_no_modes_says_so():
    with pytest.raises(ValueError, match="count is 0"):
        kc.statics.modes(beam(Free, nodes=11), count=0)
    moving = kc.simulate(kc.load_robot("delrin-tendon-robot"), np.full((3, 4), [5.0, 0.0, 0.0, 0.0]), 0.05)
    with pytest.raises(ValueError, match="no equilibrium"):
        kc.statics.modes(moving)


@pytest.mark.slow
def test_a_figure_shows_both_extremes_about_the_equilibrium():
    bent = kc.equilibrium(beam(Free, nodes=11).system.replace(gravity=(0.5, 0.0, 0.0)), np.zeros(0))
    found = kc.statics.modes(bent, count=4)
    np.testing.assert_array_equal(found.position, bent.position[0])
    figure = kc.figures.vibration(found, count=3)
    assert len(figure.axes) == 3
    for k, axes in enumerate(figure.axes):
        still, *ends = (np.stack(line.get_data_3d(), axis=-1) for line in axes.lines)
        np.testing.assert_allclose((ends[0] + ends[1]) / 2.0, still, atol=1e-12)
        moved = np.linalg.norm(ends[0] - still, axis=1).max()
        assert moved == pytest.approx(0.25 * np.ptp(still, axis=0).max(), rel=1e-6)
        assert f"{found.frequency[k]:.4g} Hz" in axes.get_title()
    with pytest.raises(ValueError, match="count is 0 of 4 modes"):
        kc.figures.vibration(found, count=0)
