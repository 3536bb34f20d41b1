"""Passports of identified robots: what they name, and what a changed recording does to that."""

import dataclasses
import hashlib

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification import evaluate
from tests.commands import run, succeeded, told

pytestmark = pytest.mark.slow

ARM = kc.load_robot("three-chamber-arm").replace(nodes=7, bending_stiffness=None, shear_stiffness=None)
DT = 0.05


def recorded(path, seed, scale=1.0):
    """Write a recording of an arm that is 10 % stiffer, and return it as it is read."""
    rng = np.random.default_rng(seed)
    pressure = np.repeat(rng.uniform(0.0, 3e4 * scale, (6, 3)), 4, axis=0)
    stiffer = ARM.replace(youngs_modulus=1.1 * ARM.youngs_modulus)
    motion = kc.simulate(stiffer, pressure, DT, space="lobatto4")
    kc.recordings.Measurements.of(motion).save(path)
    return kc.load_recording(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("passports")


@pytest.fixture(scope="module")
def given(folder):
    return [recorded(folder / f"{name}.csv", seed).sampled(DT) for seed, name in enumerate(("one", "two"))]


@pytest.fixture(scope="module")
def found(folder, given):
    identified = kc.identify(ARM, given, parameters=["youngs_modulus"])
    kc.save_robot(identified.robot, folder / "found.yaml")
    return identified


def test_a_recording_knows_the_hash_of_its_file(folder, given):
    data = (folder / "one.csv").read_bytes()
    assert given[0].files == (("one.csv", hashlib.sha256(data).hexdigest()),)
    assert given[0].between(0.2, 0.8).files == given[0].files != given[1].files


def test_an_identified_robot_of_any_kind_has_a_passport(found, given):
    passport = found.robot.passport
    assert passport.command == "identify" and [it.learned for it in passport.origins] == [True, True]
    for origin, it in zip(passport.origins, given, strict=True):
        assert ((origin.name, origin.sha256),) == it.files and origin.rows == len(it.time)
        assert origin.dt == pytest.approx(DT)
    low, high = passport.bounds("controls", ARM.control_layout)
    every = np.concatenate([it.control[:-1] for it in given])
    np.testing.assert_allclose(high, every.max(axis=0), rtol=1e-6)
    assert np.all(low <= every.min(axis=0)) and set(passport.strains) == set(passport.rates) == {"u", "v"}


def test_predictions_say_where_they_extrapolate(found, given, folder):
    assert all(evaluate(found.robot, it).extrapolated == 0.0 for it in given)
    harder = dataclasses.replace(given[0], control=1.5 * given[0].control)
    # the robot of a file says the same
    outside = [evaluate(it, harder) for it in (found.robot, kc.load_robot(folder / "found.yaml"))]
    assert outside[0].extrapolated == outside[1].extrapolated > 0.2
    assert str(outside[0]) == str(outside[1])
    assert "of the rows extrapolated (pressure_" in str(outside[0]) and " Pa (learned " in str(outside[0])


def test_info_names_recordings_and_finds_a_changed_one(found, folder):
    file, one = folder / "found.yaml", folder / "one.csv"
    words = succeeded("info", file, "--recording", one)
    assert "passport: learned by identify, 20" in words and "one.csv: 25 rows, 1.2 s at 20 Hz" in words
    assert f"{one}: learned from, unchanged" in words
    changed, other = folder / "changed" / "one.csv", folder / "other.csv"
    changed.parent.mkdir()
    text = one.read_text()
    changed.write_text(text[:-2] + ("1" if text[-2] != "1" else "2") + "\n")
    other.write_text(text + "\n")
    facts = told("info", file, "--recording", changed, "--recording", other)
    assert facts["passport"] == found.robot.passport.to_dict()
    assert facts["recordings"][str(changed)].startswith("not what the model learned from: a recording of")
    assert facts["recordings"][str(other)] == "not among these recordings"
    refused = run("info", "three-chamber-arm", "--recording", one)
    assert refused.exit_code and "this robot has no passport" in refused.stderr


def test_info_finds_trajectories_of_an_ensemble(folder):
    motion = kc.simulate(ARM, np.full((12, 3), 1e4), DT)
    motion.save(folder / "motion.nc")
    config = kc.FitConfig.network(seed=(0, 1), hidden=4, epochs=5)
    kc.fit(ARM, [motion[:10]], config).save(folder / "models")
    facts = told("info", folder / "models", "--recording", folder / "motion.nc")
    assert facts["recordings"] == {str(folder / "motion.nc"): "learned from, unchanged"}
    assert "ensemble of 2 models" in succeeded("info", folder / "models")


def test_one_recording_of_equilibria_and_trajectories_with_a_state(given):
    """Trajectories that begin in motion, and experiments, have hashes of their rows."""
    motion = kc.simulate(ARM, np.repeat([[1e4, 0.0, 2e4], [0.0, 1e4, 0.0]], 6, axis=0), DT)
    softer = ARM.replace(youngs_modulus=0.9 * ARM.youngs_modulus)
    passport = kc.identify(softer, [motion, motion[4:]], parameters=["youngs_modulus"]).robot.passport
    assert [it.name for it in passport.origins] == ["trajectory 0", "trajectory 1"]
    assert len({it.sha256 for it in passport.origins}) == 2 and passport.rates
