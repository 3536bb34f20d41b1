"""The solver against closed forms, with the order of convergence; the table is in docs/validation.md."""

import numpy as np
import pytest

from benchmarks import beams, closed_forms, motions

GRID = (20, 40)
#: by order 4, to rounding: polynomials of degree four, and a circle so flat that they nearly are
EXACT = ("tip force", "even load", "tendon")
LONG = pytest.mark.campaign


def of(family, *long):
    return [pytest.param(key, marks=LONG if key in long else ()) for key in family]


@pytest.mark.slow
@pytest.mark.parametrize("key", of(beams.STATICS, "tendon", "catenary"))
def test_statics_by_order_4(key):
    errors = [beams.STATICS[key].error(nodes, "lobatto4") for nodes in GRID]
    assert errors[-1] < 1e-6
    if key in EXACT:
        assert errors[0] < 1e-8
    else:
        assert beams.order(errors, GRID) == pytest.approx(4.0, abs=0.1)


#: all families but the second and third mode of vibration, whose errors at 20 nodes are 1.1 and 2.9 %
DEFAULT = {**beams.STATICS, **beams.BUCKLING, "mode 1": beams.VIBRATION["mode 1"], **motions.MOTIONS}


@pytest.mark.slow
@pytest.mark.parametrize("key", of(DEFAULT, "tendon", "catenary", *beams.BUCKLING, *motions.MOTIONS))
def test_default_scheme_at_20_nodes_is_within_1_percent(key):
    """One program for all cases of `beams.rod` at rest, one for its motion."""
    assert abs(DEFAULT[key].error(20, "lobatto2")) < 0.01


@pytest.mark.campaign
@pytest.mark.parametrize("key", ["even load", "half circle", "circle", "helix", "elastica 1", "elastica 10"])
def test_statics_by_euler(key):
    errors = [beams.STATICS[key].error(nodes, "euler") for nodes in GRID]
    assert beams.order(errors, GRID) == pytest.approx(1.0, abs=0.1)


@pytest.mark.campaign
@pytest.mark.parametrize("key", of(beams.BUCKLING, "shaft"))
def test_critical_loads(key):
    errors = [beams.BUCKLING[key].error(nodes, "lobatto4") for nodes in GRID]
    assert beams.order(errors, GRID) == pytest.approx(4.0, abs=0.1)
    assert errors[-1] < 5e-6


@pytest.mark.campaign
@pytest.mark.parametrize("key", of(beams.VIBRATION, "mode 2", "mode 3"))
def test_frequencies(key):
    errors = [beams.VIBRATION[key].error(nodes, "lobatto4") for nodes in GRID]
    assert abs(errors[-1]) < 5e-4
    assert beams.order(errors, GRID) == pytest.approx(4.0, abs=0.2)


@pytest.mark.campaign
@pytest.mark.parametrize("key", motions.MOTIONS)
def test_damped_motions(key):
    """Where the strains jump too: with one past for both sides of a cut errors were of order 1."""
    errors = [motions.MOTIONS[key].error(nodes, "lobatto4") for nodes in GRID]
    assert errors[-1] < 1e-6
    assert beams.order(errors, GRID) > 3.8


# the formulas, against what is published or known otherwise


@pytest.mark.parametrize("load", closed_forms.ELASTICA)
def test_elastica_has_the_published_digits(load):
    np.testing.assert_allclose(closed_forms.elastica(load), closed_forms.ELASTICA[load], rtol=0, atol=5.1e-6)


def test_critical_loads_have_the_published_digits():
    found = (closed_forms.COLUMN, closed_forms.SHAFT / np.pi)
    np.testing.assert_allclose(found, (7.837, 2.861), rtol=0, atol=5e-4)


def test_wave_numbers_have_the_published_digits():
    found = [closed_forms.wave_number(mode) for mode in (1, 2, 3)]
    np.testing.assert_allclose(found, (1.8751, 4.6941, 7.8548), rtol=0, atol=5e-5)


def test_a_cable_that_hardly_stretches_hangs_in_a_hyperbolic_cosine():
    cable = closed_forms.Catenary(1.0, 0.8, 1.0, 1e9)
    s = np.linspace(0, 1, 11)
    x, _, z = cable.positions(s).T
    a = cable.tension
    np.testing.assert_allclose(z, a * (np.cosh((x - 0.4) / a) - np.cosh(0.4 / a)), rtol=0, atol=1e-8)
    np.testing.assert_allclose([x[-1], z[-1]], [0.8, 0.0], rtol=0, atol=1e-12)
