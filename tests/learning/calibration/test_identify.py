"""A robot from its measured poses: what is found, what is ignored, and what is said when it cannot be."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.calibration import identify as identification
from knode_cosserat.learning.calibration.identify import NAMES, VIBRATION, _beginning

DT = 0.05
KNOWN = kc.load_robot("delrin-tendon-robot")
#: another stiffness, tendons that rub, a sleeve as long as it is taken to be
TRUE = kc.RoutedTendonRobot.like(
    KNOWN,
    youngs_modulus=2.2e9,
    bending_damping=0.01,
    sleeve_stiffening=1.5,
    sleeve_length=0.11 * 0.635,
    friction_wobble=0.4,
    friction_curvature=0.15,
    friction_reach=0.2,
)
#: of ten nodes, the second lies on one of these and the others between two
FRACTIONS = np.array([0.4, 6 / 9, 0.95, 1.0])
ROWS = 60
#: m, and rad of a quaternion's numbers
NOISE = 2e-4
#: where searches begin that are not about where they begin; all of them look for the same, so that they share
#: what is compiled
NEAR = TRUE.replace(youngs_modulus=2.4e9, friction_wobble=0.3)


def sine(amplitude=4.0, period=1.5, tendons=4):
    """Half a second of rest, then a sine."""
    rest = np.full((10, tendons), 5.0)
    moving = kc.controls.sine(period, ROWS - 10, DT, base=5.0, amplitude=amplitude, tendons=tendons)
    return np.concatenate([rest, moving])


def random(seed):
    """Tensions that also vary in all, held for 0.4 s."""
    moving = kc.controls.random(ROWS - 10, low=4.0, high=8.0, seed=seed, hold=8)
    return np.concatenate([np.full((10, 4), 5.0), moving])


def between_nodes(values, fractions):
    """Values (T, N, k) at fractions of the length, on lines between nodes."""
    place = fractions * (values.shape[1] - 1)
    low = np.minimum(place.astype(int), values.shape[1] - 2)
    part = (place - low)[:, None]
    return (1.0 - part) * values[:, low] + part * values[:, low + 1]


def measured(robot, tension, source="sine", noise=NOISE, seed=0, fractions=FRACTIONS, **options):
    """What motion capture would see of a robot."""
    moved, rng = kc.simulate(robot, tension, DT, **options), np.random.default_rng(seed)
    position = between_nodes(np.asarray(moved.position), fractions)
    quaternion = between_nodes(np.asarray(moved.quaternion), fractions)
    quaternion = quaternion + 5.0 * noise * rng.normal(size=quaternion.shape)
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return kc.Measurements(
        time=np.asarray(moved.time),
        # the last row's leads beyond the end
        tension=np.concatenate([tension, tension[-1:]]),
        fractions=fractions,
        position=position + noise * rng.normal(size=position.shape),
        quaternion=quaternion,
        measured=np.ones(position.shape[:2], dtype=bool),
        simulated=True,
        source=source,
    )


@pytest.fixture(scope="module")
def seen():
    return measured(TRUE, sine())


@pytest.fixture(scope="module")
def found(seen):
    """What one recording tells: others are compared with that."""
    return kc.calibrate(NEAR, [seen], NAMES, by="rollouts")


def blinded(given, rows=slice(None), bodies=slice(None), *, position=False):
    """Measurements without orientations, or without poses at all, in some rows of some bodies."""
    changes = {}
    for name in ("position", "quaternion") if position else ("quaternion",):
        changes[name] = getattr(given, name).copy()
        changes[name][rows, bodies] = np.nan
    return dataclasses.replace(given, **changes)


# what is found


def test_a_robot_is_found_from_the_crude_knowledge(seen):
    """From tendons that only push sideways to those that rub; a control it did not see is predicted."""
    result = kc.identify(KNOWN, [seen])
    assert type(result.robot) is kc.RoutedTendonRobot
    assert (
        tuple(result.estimates) == (*NAMES, "sleeve_length")
        and result.undetermined == ()
        and result.unexplained == ()
    )
    for name in (*NAMES, "sleeve_length"):
        true = np.max(getattr(TRUE, name))
        # by how the friction grows with the angle is told least
        part = 0.5 if name == "friction_curvature" else 0.1
        assert result.estimates[name] == pytest.approx(true, rel=part), name
        assert abs(result.estimates[name] - true) < 4.0 * result.standard_errors[name], name
    # stiffness and offset of the tendons are known by their ratio first of all
    ratio = result.estimates["youngs_modulus"] / result.estimates["tendon_offset"]
    assert ratio == pytest.approx(2.2e9 / 0.02, rel=0.01)
    assert result.remainder["position"] == pytest.approx(NOISE, rel=0.1)
    unseen = kc.simulate(TRUE, random(3), DT)
    errors = [kc.tip_rmse(kc.simulate(robot, random(3), DT), unseen) for robot in (KNOWN, result.robot)]
    assert errors[1] < 1e-3 and errors[0] > 100.0 * errors[1]


def test_places_between_nodes_are_compared_on_lines(found):
    """Without noise nothing would be left; with it, what is left is the noise."""
    for name in NAMES:
        away = abs(found.estimates[name] - np.max(getattr(TRUE, name)))
        assert away < 4.0 * found.standard_errors[name], name
    assert found.remainder["position"] == pytest.approx(NOISE, rel=0.1)
    assert found.unexplained == ()


def test_what_was_not_seen_is_ignored(seen, found):
    """Frames without any pose, one body that is lost for a while, another that never has orientations."""
    holes = blinded(seen, slice(20, 26), position=True)
    holes = blinded(holes, slice(30, 50), 1, position=True)
    holes = blinded(holes, slice(None), 2)
    result = kc.calibrate(NEAR, [holes], NAMES, by="rollouts")
    assert set(result.remainder) == {"position", "orientation"}
    for name in ("youngs_modulus", "friction_wobble", "sleeve_stiffening"):
        away = abs(result.estimates[name] - np.max(getattr(TRUE, name)))
        assert away < 4.0 * result.standard_errors[name] < 0.25 * np.max(getattr(TRUE, name)), name
        assert result.standard_errors[name] > found.standard_errors[name]


def test_bodies_without_orientation(seen):
    result = kc.calibrate(NEAR, [blinded(seen)], NAMES, by="rollouts")
    assert set(result.remainder) == {"position"}
    away = abs(result.estimates["youngs_modulus"] - 2.2e9)
    assert away < 4.0 * result.standard_errors["youngs_modulus"] < 0.05 * 2.2e9
    both = kc.calibrate(NEAR, [blinded(seen), seen], NAMES, by="rollouts")
    assert tuple(both.remainder) == (
        "position in sine (1)",
        "position in sine (2)",
        "orientation in sine (2)",
    )
    away = abs(both.estimates["youngs_modulus"] - 2.2e9)
    assert (
        away < 4.0 * both.standard_errors["youngs_modulus"] < 4.0 * result.standard_errors["youngs_modulus"]
    )


def test_of_several_recordings_each_has_its_own_remainder(seen):
    """One that is worse counts for less; two that are called the same are still two."""
    worse = measured(TRUE, sine(3.0, 1.0), "b.csv: a robot", noise=10 * NOISE, seed=1)
    named = dataclasses.replace(seen, source="a.csv: a robot")
    result = kc.calibrate(NEAR, [named, worse], NAMES, by="rollouts")
    assert tuple(result.remainder) == (
        "position in a.csv", "orientation in a.csv", "position in b.csv", "orientation in b.csv",
    )  # fmt: skip
    assert result.remainder["position in a.csv"] == pytest.approx(NOISE, rel=0.1)
    assert result.remainder["position in b.csv"] == pytest.approx(10 * NOISE, rel=0.1)
    alike = [dataclasses.replace(each, source="robot: today") for each in (named, worse)]
    again = kc.calibrate(NEAR, alike, NAMES, by="rollouts")
    assert again.estimates == result.estimates
    assert tuple(again.remainder.values()) == tuple(result.remainder.values())
    assert tuple(again.remainder) == (
        "position in robot: today (1)", "orientation in robot: today (1)",
        "position in robot: today (2)", "orientation in robot: today (2)",
    )  # fmt: skip
    begins = [dataclasses.replace(named, source="robot: a"), dataclasses.replace(worse, source="robot: b")]
    last = kc.calibrate(NEAR, begins, NAMES, by="rollouts")
    assert next(iter(last.remainder)) == "position in robot: a"


def test_what_the_model_cannot_explain_is_said(seen):
    """A rod that is known to be too short: no stiffness makes it longer."""
    result = kc.calibrate(NEAR.replace(length=0.6), [seen], NAMES, by="rollouts")
    assert "position" in result.unexplained
    assert "not explained: what is left in position" in str(result)


def test_what_measurements_do_not_determine(seen):
    """A search from no friction at all cannot tell within which bend it would build up."""
    smooth = NEAR.replace(friction_wobble=0.0, friction_curvature=0.0)
    with pytest.raises(kc.CalibrationError, match=r"^friction_reach has no effect on these data; leave"):
        kc.calibrate(smooth, [seen], NAMES, by="rollouts", undetermined="stop")
    kept = kc.calibrate(smooth, [seen], NAMES, by="rollouts", undetermined="keep")
    assert "friction_reach" in kept.undetermined and "friction_reach" not in kept.estimates
    assert float(kept.robot.friction_reach) == 0.2
    assert "left as before, not determined by these data: friction_reach" in str(kept)
    # where tendons pull alike the rod stays straight, whatever it is
    still = measured(TRUE, np.full((ROWS, 4), 5.0), "still")
    with pytest.raises(kc.CalibrationError, match=r"no effect on these data|do not determine|determine only"):
        kc.calibrate(NEAR, [still], NAMES, by="rollouts")


def test_what_is_not_searched_is_as_the_knowledge_has_it():
    """No friction is made up where none is asked for, and some is begun with where it is."""
    names = ["youngs_modulus", "friction_wobble"]
    plain = _beginning(KNOWN, names)
    assert float(plain.friction_wobble) == 0.3
    assert plain.sleeve_stiffening is None and plain.friction_curvature is None
    routed = kc.RoutedTendonRobot.like(KNOWN, bending_damping=0.01, sleeve_stiffening=0.7)
    begun = _beginning(routed, [*names, "sleeve_stiffening"])
    assert float(begun.sleeve_stiffening) == 0.7 and begun.bending_damping[0, 0] == 0.01
    assert float(begun.friction_wobble) == 0.3 and begun.friction_curvature is None


@pytest.mark.parametrize("fails", ["search", "value"])
def test_an_offset_that_runs_off_is_left_as_it_was_measured(seen, found, monkeypatch, fails):
    """Stiffness and offset of a light rod are known by their ratio only."""
    asked = []

    def calibrated(start, measurements, names, **_):
        asked.append(tuple(names))
        if "tendon_offset" not in names:
            return dataclasses.replace(found, robot=start)
        if fails == "search":
            raise kc.CalibrationError("the search did not converge")
        return dataclasses.replace(found, robot=start.replace(tendon_offset=0.07))

    monkeypatch.setattr(identification, "calibrate", calibrated)
    result = kc.identify(KNOWN, [seen])
    fewer = tuple(name for name in NAMES if name != "tendon_offset")
    assert asked == [NAMES, fewer, (*found.estimates, "sleeve_length")]
    assert result.undetermined == ("tendon_offset",) and float(result.robot.tendon_offset) == 0.02
    assert "left as before, not determined by these data: tendon_offset" in str(result)


@pytest.mark.campaign
def test_the_model_is_for_the_scheme_that_is_asked_for():
    """Positions and orientations of a real rod do not fit together by Euler's scheme with ten nodes."""
    # whose sleeve is longer than it is taken to be
    true = TRUE.replace(sleeve_length=0.15 * 0.635)
    exact = measured(true, sine(), space="lobatto4")
    rough, fine = (kc.identify(KNOWN, [exact], space=space) for space in ("euler", "lobatto4"))
    assert rough.unexplained and rough.remainder["orientation"] > 1.5 * fine.remainder["orientation"]
    assert fine.remainder["position"] == pytest.approx(NOISE, rel=0.1)
    # by Euler's scheme the length of the sleeve is not searched
    assert fine.before == {**rough.before, "sleeve_length": fine.before["sleeve_length"]}
    assert fine.unexplained == ()
    for name in (*NAMES, "sleeve_length"):
        away = abs(fine.estimates[name] - np.max(getattr(true, name)))
        assert away < 4.0 * fine.standard_errors[name], name
    unseen = kc.simulate(true, random(3), DT, space="lobatto4")
    assert kc.tip_rmse(kc.simulate(fine.robot, random(3), DT, space="lobatto4"), unseen) < 1e-3


@pytest.mark.campaign
def test_vibration_is_found_where_tensions_tell():
    shaking = TRUE.replace(vibration_tension=24.0, vibration_rate=0.4, vibration_softening=2e-3)
    data = [measured(shaking, random(seed), f"random {seed}", seed=seed) for seed in (0, 1)]
    result = kc.identify(KNOWN, data)
    assert {*NAMES, *VIBRATION} <= set(result.estimates) <= {*NAMES, *VIBRATION, "sleeve_length"}
    assert result.estimates["vibration_tension"] == pytest.approx(24.0, rel=0.05)
    unseen = kc.simulate(shaking, random(5), DT)
    assert kc.tip_rmse(kc.simulate(result.robot, random(5), DT), unseen) < 2e-3
    # of a robot that does not vibrate none is found that changes its motion
    calm = [measured(TRUE, random(seed), f"random {seed}", seed=seed) for seed in (0, 1)]
    still = kc.identify(KNOWN, calm)
    unseen = kc.simulate(TRUE, random(5), DT)
    assert kc.tip_rmse(kc.simulate(still.robot, random(5), DT), unseen) < 2e-3


# what is not allowed


def test_measurements_that_are_not_allowed(seen):
    def refused(given, message, error=kc.DataError, **options):
        with pytest.raises(error, match=message) as caught:
            kc.calibrate(NEAR, given, NAMES, **{"by": "rollouts", **options})
        assert "\n" not in str(caught.value)

    three = dataclasses.replace(seen, tension=seen.tension[:, :3])
    refused([three], r"^sine: 3 tensions in a row; the robot has 4$")
    gap = dataclasses.replace(
        seen, tension=np.where(np.arange(ROWS + 1)[:, None] == 12, np.nan, seen.tension)
    )
    refused([gap], r"^sine: no tension is known at 0\.6 s; use the part before \(`parts`\)$")
    refused([seen.rows(0, 1)], r"^sine: 1 rows; at least 2 are needed$")
    refused([blinded(seen, position=True)], r"^sine: no pose was seen after the first row$")
    refused([seen, blinded(seen, position=True)], r"^sine: no pose was seen after the first row$")
    refused([seen], r'^measurements are no states: calibrate\(…, by="rollouts"\)', by="segments")
    trajectory = kc.simulate(NEAR, sine(), DT)
    refused([seen, trajectory], r"^trajectories and measurements are mixed; allowed is a list of one kind$")
    refused([], r"^there are no trajectories")
    refused(seen, r"^trajectories is a Measurements; allowed is a list")
    refused([seen], r"^undetermined is 'drop'; allowed", kc.CalibrationError, undetermined="drop")


def test_knowledge_and_lists_that_are_not_allowed(seen):
    from examples.hanging_string import HangingString

    string = HangingString(length=1.0, density=0.1, stiffness=1e3)
    with pytest.raises(
        kc.CalibrationError, match=r"^knowledge is a HangingString; allowed is a tendon-driven"
    ):
        kc.identify(string, [seen])
    with pytest.raises(kc.DataError, match=r"^measurements is a Measurements; allowed is a list of them"):
        kc.identify(KNOWN, seen)
    with pytest.raises(kc.DataError, match=r"^a Trajectory is no measurements; `Recording\.sampled` gives"):
        kc.identify(KNOWN, [kc.simulate(KNOWN, sine(), DT)])
    with pytest.raises(kc.DataError, match=r"^there are no measurements"):
        kc.identify(KNOWN, [])
    three = dataclasses.replace(seen, tension=seen.tension[:, :3])
    with pytest.raises(kc.DataError, match=r"^sine: 3 tensions in a row; the robot has 4$"):
        kc.identify(KNOWN, [three])
    with pytest.raises(kc.ParameterError, match=r"^RoutedTendonRobot has no parameter 'stiffness'"):
        kc.identify(KNOWN, [seen], ["stiffness"])
    with pytest.raises(
        ValueError, match=r"^space is 'rk3'; allowed is \"lobatto2\", \"lobatto4\", \"euler\""
    ):
        kc.identify(KNOWN, [seen], space="rk3")
