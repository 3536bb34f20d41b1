"""History at the places of a scheme, of motions that begin and that continue from others."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from benchmarks.motions import soft_rod
from examples.hanging_string import HangingString
from knode_cosserat.rods.loads import PointWrench
from knode_cosserat.schemes.grid import at_places, grid_of
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.settings import schemes
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers import Settings
from knode_cosserat.solvers.initial import continued_state
from knode_cosserat.solvers.replay import replay
from knode_cosserat.solvers.rest import resting_history, still_records

SCHEMES = {name: scheme() for name, scheme in schemes(SpaceScheme).items()}
DT = 0.02
NONE = np.zeros((12, 0))


@pytest.fixture(scope="module")
def rod():
    """A damped one that falls, whose section changes between two nodes."""
    return soft_rod(0.317).replace(nodes=9)


@pytest.fixture(scope="module")
def whole(rod):
    return kc.simulate(rod, NONE, DT, space="lobatto4", initial="unstressed")


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1e-2, 1e-3])
def test_what_is_in_equilibrium_stays_there_however_short_the_steps(rod, dt):
    """With strains of the past interpolated between nodes this rod crept by 1.7 mm, or 22 mm."""
    hanging = kc.equilibrium(rod, np.zeros(0), space="lobatto4")
    moved = kc.simulate(rod, np.zeros((60, 0)), dt, space="lobatto4", initial=hanging)
    assert np.max(np.abs(moved.tip_position - hanging.tip_position)) < 1e-9 * rod.length


@pytest.mark.campaign
@pytest.mark.parametrize("control", [np.full(4, 6.0), np.array([8.0, 5.0, 4.0, 7.0])])
def test_a_robot_with_a_sleeve_and_ribs_stays_in_equilibrium(control):
    robot = kc.load_robot("delrin-routed-tendon-robot")
    still = kc.equilibrium(robot, control, space="lobatto4")
    moved = kc.simulate(robot, np.tile(control, (40, 1)), 1e-3, space="lobatto4", initial=still)
    assert np.max(np.abs(moved.tip_position - still.tip_position)) < 1e-8 * robot.length


# going on


def gone_on(rod, before, count, **how):
    return kc.simulate(rod, NONE[:count], DT, space="lobatto4", initial=before, **how)


@pytest.mark.campaign
@pytest.mark.parametrize("time", ["bdf2", "trapezoidal"])
def test_a_motion_goes_on_as_if_it_had_not_been_parted(rod, time, tmp_path):
    """From rows, from what itself went on, from part of that, from a file, and from a stepper's state."""
    one = kc.simulate(rod, NONE, DT, space="lobatto4", time=time, initial="unstressed")
    first = kc.simulate(rod, NONE[:4], DT, space="lobatto4", time=time, initial="unstressed")
    second = gone_on(rod, first, 4, time=time)
    second.save(tmp_path / "second.nc")
    stepper = kc.solvers.Stepper(rod, DT, space="lobatto4", time=time, initial="unstressed")
    for _ in range(8):
        row = stepper.step(np.zeros(0))
    for before, count in (
        (one[:9], 4),
        (second, 4),
        (second[:3], 6),
        (kc.load_trajectory(tmp_path / "second.nc"), 4),
        (row, 4),
    ):
        found = gone_on(rod, before, count, time=time)
        np.testing.assert_allclose(found.y, one.y[-count - 1 :], atol=2e-8)


@pytest.mark.slow
def test_parts_keep_the_states_of_their_own_rows(rod, whole):
    second = gone_on(rod, whole[:5], 4)
    assert whole.initial_state.dt is None and second.initial_state.dt == whole.final_state.dt == DT
    assert second[:3].initial_state is second.initial_state and second[:3].final_state is None
    assert second[1:].initial_state is None and second[1:].final_state is second.final_state
    # one row is where a motion begins and ends; rows further apart cannot be replayed
    assert second[:1].final_state is second.initial_state
    assert second[::2].initial_state is None and second[::2].final_state is second.final_state


@pytest.mark.slow
@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("time", ["bdf2", pytest.param("trapezoidal", marks=pytest.mark.campaign)])
def test_a_whole_motion_goes_on_by_the_state_of_the_solver(rod, time, traced, monkeypatch):
    """Without a replay, with the error estimate of one run, and in one program too."""
    monkeypatch.setattr("knode_cosserat.solvers.initial.replay", None)
    one = kc.simulate(rod, NONE, DT, space="lobatto4", time=time, initial="unstressed")

    def parted(controls):
        first = kc.simulate(rod, controls, DT, space="lobatto4", time=time, initial="unstressed")
        return gone_on(rod, first, 8, time=time)

    found = (jax.jit(parted) if traced else parted)(NONE[:4])
    np.testing.assert_allclose(found.y, one.y[4:], atol=1e-9)
    np.testing.assert_allclose(found.position_error[1:], one.position_error[5:], rtol=1e-3)


@pytest.mark.slow
def test_a_row_that_was_changed_moves_the_state_of_the_solver(rod, whole):
    """A change of rates in the last rows acts as it does in a replay of these rows."""
    changed = np.array(whole.y)
    spin = rod.y_layout.slice("w").stop - 1
    changed[-2:, :, spin] += 0.2 * np.linspace(0.0, 1.0, rod.nodes)
    kept = dataclasses.replace(whole, y=changed)
    replayed = dataclasses.replace(kept, final_state=None)
    straight, moved, wanted = (gone_on(rod, each, 2).y[1:, :, spin] for each in (whole, kept, replayed))
    assert np.max(np.abs(wanted - straight)) > 1e-3
    # between nodes the change is interpolated; a replay evaluates the equations there
    np.testing.assert_allclose(moved, wanted, atol=0.02 * np.max(np.abs(wanted - straight)))


@pytest.mark.slow
def test_the_middle_of_a_motion_is_known_at_its_nodes_only(rod, whole):
    """What between them is not is forgotten, like the initial state of any damped motion."""
    near = np.max(np.abs(gone_on(rod, whole[6:9], 4).y - whole.y[8:]), axis=(1, 2))
    assert 0.0 < near[-1] < 1e-3


@pytest.mark.campaign
def test_rows_tell_what_the_last_step_looked_back_on(rod, whole):
    """The past that is found again is the one that the solver had."""
    settings = Settings.of("bdf2", "lobatto4", "paper", kc.solvers.NewtonOptions())
    again = continued_state(rod, dataclasses.replace(whole, final_state=None), settings, DT)
    assert again.state.known(settings) == 2
    assert again.state.history.t0 == pytest.approx(len(NONE) * DT)
    np.testing.assert_allclose(again.state.history.records, whole.final_state.history.records, atol=2e-8)


def test_transformations_continue_from_solver_states_only(rod):
    first = kc.simulate(rod, NONE[:3], DT, initial="unstressed")

    def tip(change, before):
        moved = dataclasses.replace(before, y=before.y + change * np.sin(before.y))
        return kc.simulate(rod, NONE[3:5], DT, initial=moved).tip_position[-1]

    wanted = (tip(1e-4, first) - tip(-1e-4, first)) / 2e-4
    found = jax.jacfwd(tip)(0.0, first)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-7)
    with pytest.raises(ValueError, match="without its final state on this grid; allowed is"):
        jax.jacfwd(tip)(0.0, dataclasses.replace(first, final_state=None))


@pytest.mark.campaign
def test_what_is_at_the_nodes_beside_a_solution_is_carried_over(rod):
    """States that were changed since are taken as they are."""
    whole = kc.simulate(rod, NONE, DT, space="lobatto4", time="bdf2", initial="unstressed")
    changed = dataclasses.replace(whole, z=whole.z + 1e-3)
    plain, moved = (replay(each, rod).terms for each in (whole, changed))
    # c1 + c2 of BDF2 is -3/2 of 1/dt, whatever the past
    shift = (moved - plain)[2:, :, rod.y_layout.size :] * DT / -1.5e-3
    np.testing.assert_allclose(shift[:, grid_of(rod).nodes], 1.0, atol=1e-6)


# beginning


@pytest.mark.campaign
def test_only_an_equilibrium_is_taken_for_one(rod):
    space, none = SCHEMES["lobatto4"], jnp.zeros(0)
    hanging = kc.equilibrium(rod, none, space="lobatto4")
    row = jnp.concatenate([hanging.y[0], hanging.z[0]], axis=-1)
    still = StepProblem.still(rod, space, none)
    state = still.evaluated(hanging.y[0])
    between = at_places(rod, space, row)
    found = still_records(rod, space, row, state)
    np.testing.assert_array_equal(found, state.records)
    assert np.max(np.abs(found - between)) > 1e-6
    for other in (row.at[:, -1].add(1e-6), row.at[3, 9].add(1e-6), 0.999 * row):
        seen = still_records(rod, space, other, still.evaluated(other[:, : rod.y_layout.size]))
        np.testing.assert_array_equal(seen, at_places(rod, space, other))


@pytest.mark.parametrize("space", ["lobatto2", pytest.param("lobatto4", marks=pytest.mark.campaign)])
def test_rest_is_rest_at_all_places(space):
    """Also beside a discontinuity, on either side of it."""
    bent = kc.robots.SlenderRod(
        length=0.5,
        radius=0.005,
        density=1200.0,
        youngs_modulus=5e6,
        nodes=6,
        sections=(
            kc.robots.Stretch(end=0.4, curvature=[6.0, 0.0, 0.0]),
            kc.robots.Stretch(begin=0.73, curvature=[0.0, 3.0, 0.0]),
        ),
    )
    past = jax.jit(resting_history, static_argnums=1)(bent, kc.solvers.Settings(space=SCHEMES[space]))
    records, grid = past.records[0], grid_of(bent, SCHEMES[space])
    u = bent.z_layout.get(records[..., bent.y_layout.size :], "u")
    middle = (grid.segment + grid.bounds.mean(axis=1)) / (bent.nodes - 1)
    pieces = np.arange(grid.tip)
    inner, outer = middle[:, None, None] < 0.4, middle[:, None, None] > 0.73
    expected = inner * np.array([6.0, 0.0, 0.0]) + outer * np.array([0.0, 3.0, 0.0])
    # at both ends of every piece, and at all stages between
    found = np.asarray(u)[grid.places_of(pieces)]
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-12)
    np.testing.assert_array_equal(past.records[1], records)
    np.testing.assert_array_equal(past.rate, 0.0)
    np.testing.assert_array_equal(past.error, 0.0)


# order


def tips(rod, steps, nodes, until=0.4):
    """Return the tip's position at ten times while a force at the tip grows smoothly.

    A rod that is let go rings along itself, undamped, 31 ms at a time: steps that do not resolve it show no
    order (SDIRK2: -0.9, -0.7, 1.6, 1.8 from 20 steps on), and neither do BDF2's.
    """
    force = np.sin(np.linspace(0.0, 0.5 * np.pi, steps + 1)[1:, None]) ** 2
    pulled = rod.replace(nodes=nodes, loads=(PointWrench(controlled=True, force=[0.02, 0.01, 0.0]),))
    found = kc.simulate(pulled, force, until / steps, space="lobatto4", between="linear")
    assert np.all(found.result == kc.Result.CONVERGED)
    return found.tip_position[steps // 2 :: steps // 20]


def orders(found):
    """Of convergence, from one grid to the next twice as fine."""
    changes = np.sqrt(np.mean(np.square(np.diff(found, axis=0)), axis=(1, 2)))
    return np.log2(changes[:-1] / changes[1:])


@pytest.mark.campaign
@pytest.mark.parametrize("ends", [(), (0.317,), (0.1, 0.104)], ids=["alike", "a cut", "a short stretch"])
def test_damped_motions_have_the_schemes_orders(ends):
    """Order 2 in time at any number of nodes, and 4 or more along the rod, short stretches or not."""
    rod = soft_rod(*ends)
    assert np.all(orders([tips(rod, steps, 11) for steps in (20, 40, 80, 160)]) > 1.7)
    assert np.all(orders([tips(rod, 160, nodes) for nodes in (11, 21, 41, 81)]) > 3.5)


@pytest.mark.campaign
def test_derivatives_go_through_what_stages_look_back_on(rod):
    """Along a motion that goes on, by forward and reverse mode, against differences."""

    def end(stiffness):
        changed = rod.replace(youngs_modulus=stiffness)
        hanging = kc.equilibrium(changed, jnp.zeros(0), space="lobatto4")
        first = kc.simulate(changed, jnp.zeros((3, 0)), DT, space="lobatto4", initial=hanging)
        pulled = changed.replace(gravity=(0.0, 0.0, -2.0))
        return kc.simulate(pulled, jnp.zeros((3, 0)), DT, space="lobatto4", initial=first).tip_position[-1, 0]

    value = jax.jit(end)
    difference = (value(5e6 + 50.0) - value(5e6 - 50.0)) / 100.0
    for slope in (jax.jacfwd(end), jax.grad(end)):
        np.testing.assert_allclose(jax.jit(slope)(5e6), difference, rtol=1e-5)


@pytest.mark.campaign
def test_a_robot_that_was_changed_begins_where_the_other_one_rested(rod):
    """And not in an equilibrium of its own."""
    hanging = kc.equilibrium(rod, np.zeros(0), space="lobatto4")
    pushed = rod.replace(gravity=(2.0, 0.3, -2.0))
    coarse = kc.simulate(pushed, np.zeros((60, 0)), 3e-4, space="lobatto4", initial=hanging)
    assert np.all(coarse.result == kc.Result.CONVERGED)
    other = rod.replace(nodes=41)
    fine = kc.simulate(
        other.replace(gravity=pushed.gravity),
        np.zeros((60, 0)),
        3e-4,
        space="lobatto4",
        initial=kc.equilibrium(other, np.zeros(0), space="lobatto4"),
    )
    aside = [each.tip_position[-1, 1] for each in (coarse, fine)]
    assert aside[0] == pytest.approx(aside[1], rel=0.02) and abs(aside[1]) < 1e-3 * rod.length


@pytest.mark.campaign
@pytest.mark.parametrize("time", ["bdf2", "bdf-alpha", "sdirk2"])
@pytest.mark.parametrize("dt", [0.02, 0.005])
def test_waves_of_a_string_do_not_grow(dt, time):
    """Of an undamped one, in whose slowest part they go 1.2 segments in a time step, or a third of one.

    The hand goes to and fro once, in 0.8 s, and rests three times as long. It begins smoothly: a jump of its
    velocity makes the string slack, which then has no solution.
    """
    rows = round(0.8 / dt)
    way = np.sin(np.pi * np.minimum(np.arange(1, 4 * rows + 1) / rows, 1.0)) ** 2
    string = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.15, nodes=41)
    hanging = kc.equilibrium(string, np.array([0.6, 0.0]), space="lobatto4")
    hand = np.stack([0.6 + 0.05 * way, 0.0 * way], axis=1)
    found = kc.simulate(string, hand, dt, space="lobatto4", time=time, initial=hanging)
    rough = np.abs(np.diff(found.part("q"), n=4, axis=1)).max(axis=(1, 2))
    # the air takes it: 0.10 to 0.20 of it is left
    assert rough[-rows:].max() < 0.25 * rough[:rows].max()


def growth(formula, time, passed):
    """Largest amplification of any wavelength in a time step (von Neumann), along an endless elastic bar.

    In that time its waves pass so many segments. History is kept at all places of a scheme.
    """
    c0, c1, c2, d1 = time.coefficients(passed, passed)
    # n_s = c0 q + its history, q_s = c0 n + its history
    swap, size = np.array([[0.0, 1.0], [1.0, 0.0]]), 2 * (1 + len(formula.stages))
    A = c0 * swap
    largest = 0.0
    for turn in np.exp(1j * np.linspace(0.02, np.pi, 60)):
        # everything is linear in y at a node and in the history at its place and at the stages behind it
        def of(k, size=size):
            return np.eye(2, size + 2, 2 * k)

        y = [of(0), turn * of(0)]
        rates = [A @ y[k] + (1.0, turn)[k] * swap @ of(1) for k in (0, 1)]
        inner = []
        for k, stage in enumerate(formula.stages):
            between = (1.0 - stage.end) * y[0] + stage.end * y[1]
            between = between + sum(x * f for x, f in zip(stage.rates, rates, strict=False))
            inner.append(between)
            rates.append(A @ between + swap @ of(2 + k))
        missing = y[0] + sum(b * f for b, f in zip(formula.weights, rates, strict=True)) - y[1]
        by_history = np.linalg.solve(-missing[:, :2], missing[:, 2:])
        step = np.concatenate([by_history, *(own[:, :2] @ by_history + own[:, 2:] for own in inner)])
        eye, none = np.eye(size), np.zeros((size, size))
        history = np.concatenate([c1 * eye, c2 * eye, d1 * eye], axis=1)
        records = step @ history
        both = np.block([[records], [eye, none, none], [c0 * records + history]])
        largest = max(largest, np.abs(np.linalg.eigvals(both)).max())
    return largest


@pytest.mark.parametrize(
    "time",
    [kc.solvers.BDF1(), kc.solvers.BDF2(), kc.solvers.BDFAlpha(-0.3), kc.solvers.Trapezoidal()],
    ids=repr,
)
@pytest.mark.parametrize("space", ["lobatto2", "lobatto4"])
def test_waves_grow_in_no_time_step(space, time):
    """Short or long: with history interpolated between nodes they grew where segments were long."""
    for passed in (0.01, 0.1, 0.3, 1.0, 1.2, 3.0, 10.0, 1e3):
        assert growth(SCHEMES[space].formula, time, passed) <= 1.0 + 1e-6, passed


@pytest.mark.campaign
@pytest.mark.parametrize("alpha", [-0.5, -0.3])
def test_schemes_with_a_memory_of_rates_stay_smooth_along_the_rod(alpha):
    """Where history was interpolated, waves between two nodes grew by up to a half a step."""
    rod = soft_rod().replace(nodes=11)
    found = kc.simulate(
        rod, np.zeros((80, 0)), 5e-3, time=kc.solvers.BDFAlpha(alpha), space="lobatto4", initial="unstressed"
    )
    rough = np.abs(np.diff(found.part("q"), n=4, axis=1)).max(axis=(1, 2))
    assert rough[-1] < 0.1 * np.abs(found.part("q")).max()
