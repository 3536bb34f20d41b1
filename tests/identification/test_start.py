"""The state from which compared simulations start: as the data do, at rest or unstressed."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification import identify
from knode_cosserat.identification.experiments import experiments_of
from knode_cosserat.identification.free_parameters import parameter_effects
from knode_cosserat.identification.misfit import Misfit
from knode_cosserat.solvers.segments import DataError
from tests.identification.motions import require_exact_slopes
from tests.learning.bar import BAR, Bar, pulled


class Weighed(Bar):
    """A bar whose own weight stretches it by a quarter: its equilibrium is far from its unstressed shape."""

    def balance(self, s, t, y, y_t, z, z_t, control):
        return super().balance(s, t, y, y_t, z, z_t, control).at[1].add(-9.81 * self.density)


REAL = Weighed(**{name: getattr(BAR, name) for name in BAR.parameters()}, nodes=6)
GUESS = REAL.replace(stiffness=26.0, damping=0.8)
NAMES = ["stiffness", "damping"]


def measured(trajectory, noise=0.0):
    seen = kc.recordings.Measurements.of(trajectory, (0.4, 1.0))
    rng = np.random.default_rng(0)
    return dataclasses.replace(seen, position=seen.position + noise * rng.normal(size=seen.position.shape))


def found(data):
    result = identify(GUESS, [data], parameters=NAMES, space="euler")
    return result["stiffness"].value, result["damping"].value


def settled(**options):
    return pulled(1.0, robot=REAL, space="euler", initial="equilibrium", **options)


def pretensioned():
    still = kc.equilibrium(REAL, [3.0], space="euler")
    return pulled(1.0, robot=REAL, space="euler", initial=still)


def rested():
    pull = np.concatenate([np.full(3, 3.0), 3.0 + 2.0 * np.sin(0.7 * np.arange(1, 18))])[:, None]
    still = kc.equilibrium(REAL, [3.0], space="euler")
    moved = measured(kc.simulate(REAL, pull, 0.1, space="euler", initial=still))
    return dataclasses.replace(moved, initial_control=None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "tolerance"),
    [
        pytest.param(lambda: settled(), 1e-6, id="states from rest"),
        pytest.param(lambda: measured(settled()), 1e-6, id="measured from rest"),
        pytest.param(lambda: measured(settled(), 1e-4), 2e-2, id="noisy from rest"),
        pytest.param(lambda: measured(pretensioned()), 1e-6, id="measured from a pull"),
        pytest.param(lambda: rested(), 1e-6, id="at rest for a while, with an unknown pull before"),
        pytest.param(lambda: pulled(1.0, robot=REAL, space="euler"), 1e-6, id="unstressed states"),
        pytest.param(lambda: measured(pulled(1.0, robot=REAL, space="euler")), 1e-6, id="unstressed"),
    ],
)
def test_what_starts_at_rest_gives_the_robot_that_made_it(data, tolerance):
    np.testing.assert_allclose(found(data()), (20.0, 0.4), rtol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize(
    "data",
    [
        pytest.param(lambda: measured(settled()).rows(4, 20), id="from the middle of a motion"),
        pytest.param(
            lambda: dataclasses.replace(measured(settled()), initial_control=np.array([9.0])), id="wrong pull"
        ),
    ],
)
def test_data_that_do_not_start_at_rest_are_refused(data):
    with pytest.raises(DataError, match=r"row 0 is .* mm from the equilibrium under \["):
        found(data())


@pytest.mark.slow
def test_slopes_of_a_start_in_equilibrium_are_exact():
    model = ParameterModel(GUESS, parameter_effects(GUESS, ["length", "density", *NAMES]))
    misfit = Misfit(model, experiments_of([measured(pretensioned())], model, "euler"))
    (here,) = misfit.differences(np.zeros(4))
    # row 0 is compared too, and depends on the stiffness
    assert np.abs(here.derivatives[2, 0, 1]) > 0.01
    require_exact_slopes(misfit, 4, rtol=1e-7)


ROD = kc.robots.SlenderRod(
    length=0.3,
    radius=0.004,
    density=1200.0,
    youngs_modulus=2e8,
    bending_damping=1e-3,
    nodes=5,
    gravity=[9.81, 0.0, 0.0],
    base_end=kc.robots.ends.Driven(axes=("x",)),
    loads=(
        kc.robots.loads.AttachedMass(mass=0.02),
        kc.robots.loads.PointWrench(at=0.5, force=[0.0, 0.1, 0.0]),
    ),
)


def test_parameters_of_parts_have_names_with_dots():
    names = ["youngs_modulus", "loads.0.mass", "loads.1.force"]
    model = ParameterModel(ROD, parameter_effects(ROD, names))
    assert list(model.names) == names
    np.testing.assert_allclose(model.values(np.zeros(5)), [2e8, 0.02, 0.0, 0.1, 0.0])
    assert tuple(number.unit for number in model.numbers) == ("Pa", "kg", "N", "N", "N")
    numbers = (1e8, 0.05, 0.1, 0.2, 0.3)
    x = np.array([it.coordinate(value) for it, value in zip(model.numbers, numbers, strict=True)])
    changed = model.reduced(x, names)
    assert float(changed.loads[0].mass) == pytest.approx(0.05)
    assert changed.loads[1].force.tolist() == pytest.approx([0.1, 0.2, 0.3])
    low, high = model.bounds
    assert np.all(low <= 0.0) and np.all(high >= 0.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("loads.2.mass", "there is no parameter 'loads.2': no '2' among 0, 1"),
        ("loads.0.weight", "AttachedMass has no parameter 'weight'; there are .*mass"),
        ("load.0.mass", "there is no parameter 'load.0': no 'load' among"),
        ("loads.0.at", "loads.0.at is a place, which a search cannot move"),
        ("loads.0", "loads.0 is a part; allowed is one of its parameters"),
        ("loads.7", "there is no parameter 'loads.7': no '7' among 0, 1"),
    ],
)
def test_names_of_parts_that_are_not_right(name, message):
    with pytest.raises(kc.robots.ParameterError, match=message):
        parameter_effects(ROD, [name])


@pytest.mark.slow
def test_a_mass_at_the_tip_is_found():
    t = 0.02 * np.arange(1, 26)[:, None]
    moved = kc.simulate(ROD, 0.03 * np.sin(8.0 * t), 0.02, space="euler", initial="equilibrium")
    guess = ROD.replace(**{"loads.0.mass": 0.03, "youngs_modulus": 2.4e8})
    result = identify(guess, [moved], parameters=["youngs_modulus", "loads.0.mass"])
    np.testing.assert_allclose(result["loads.0.mass"].value, 0.02, rtol=1e-4)
    np.testing.assert_allclose(result["youngs_modulus"].value, 2e8, rtol=1e-4)
