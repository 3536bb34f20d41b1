"""The linearised step of an equilibrium's code, against the tangents of a time step, which are other code."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.engine.loops import has_friction, linear_step
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.system import unknowns_of
from knode_cosserat.rods.tendons import TendonFriction
from knode_cosserat.schemes.history import StepCoefficients, used_places
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.solvers.replay import still_state
from knode_cosserat.solvers.sensitivity import Changes, TangentState, tangent_time_loop
from tests.engine.test_core import Stretching
from tests.engine.test_tangents import cut_legs

C0, COLUMNS = 30.0, 5
PAPER, ROUTED, FED = "delrin-tendon-robot", "delrin-routed-tendon-robot", "fed-catheter"
OWN = {"bar": Stretching, "legs": cut_legs}


def by_tangents(robot, space, control, y, changes):
    """Return the changes of the record after a step of implicit Euler by the tangents of a time loop."""
    step = Settings.of("bdf1", space, "paper", NewtonOptions())
    still = still_state(robot, step.space, control, y)
    records = still.records[: used_places(robot, step.space)]
    d_past = np.zeros((step.memory, *records.shape, changes.shape[1]))
    d_past[0] = changes.reshape(*records.shape, -1)
    before = np.stack([records] * step.memory)
    state = TangentState(before, np.zeros_like(records), d_past, np.zeros_like(d_past[0]), 0.0)
    row = np.concatenate([y, np.asarray(still.records)[: len(y), y.shape[1] :]], axis=1)
    solved = row[None], np.asarray(unknowns_of(robot, y))[None]
    moved, _ = tangent_time_loop(
        StepCoefficients.of(step, 1.0 / C0, step.memory),
        solved,
        (robot, control[None]),
        Changes(np.zeros((1, len(control), changes.shape[1]))),
        state,
    )
    return np.asarray(moved.d_records[0]).reshape(changes.shape)


@pytest.mark.parametrize(
    ("name", "space", "control"),
    [
        (PAPER, "euler", 5.0), (PAPER, "lobatto4", 5.0), (FED, "lobatto2", 0.005),
        pytest.param(ROUTED, "lobatto2", 5.0, marks=pytest.mark.slow),
        pytest.param("bar", "lobatto4", 0.0, marks=pytest.mark.slow),
        pytest.param("legs", "lobatto2", 0.01, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_the_map_of_a_step_is_that_of_the_tangents(name, space, control):
    """Stages and cuts between nodes, y_s in the history, several strands and a fed length enter."""
    robot = OWN[name]() if name in OWN else kc.load_robot(name)
    control = np.linspace(0.5, 1.0, robot.control_layout.size) * control
    rest = kc.equilibrium(robot, control, space=space, with_stability=False)
    y, scheme = np.asarray(rest.y[0]), rest.settings.space
    step = linear_step(robot, scheme, control, y)
    step.linearise(C0)
    changes = np.random.default_rng(0).normal(size=(len(step.unit), COLUMNS)) * step.unit[:, None]
    found, known = step(changes), by_tangents(robot, space, control, y, changes)
    assert np.max(np.abs(known)) > 0.0
    off = (found - known) / step.unit[:, None]
    assert np.max(np.abs(off)) < 1e-11 * np.max(np.abs(known / step.unit[:, None]))


def test_it_knows_units_residual_and_friction():
    robot = kc.load_robot(ROUTED)
    rest = kc.equilibrium(robot, np.full(4, 5.0), with_stability=False)
    space, y = rest.settings.space, np.asarray(rest.y[0])
    step, scales = linear_step(robot, space, np.full(4, 5.0), y), strand_of(robot).scales()
    np.testing.assert_allclose(step.scale_y, scales.y, rtol=1e-14)
    np.testing.assert_allclose(step.scale_tip, scales.tip, rtol=1e-14)
    assert step.error_at(0.618) < 1e-8
    assert linear_step(robot, space, np.array([6.0, 4.0, 5.0, 5.0]), y).error_at(0.618) > 1e-3
    assert not has_friction(robot, space)
    assert has_friction(robot.replace(friction=TendonFriction(wobble=0.6, reach=0.1)), space)
