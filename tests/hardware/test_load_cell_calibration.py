"""Calibration of load cells by weights."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat_hardware.calibration import fit_load_cell, wire_settings, write_calibration
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.figures import load_cell
from knode_cosserat_hardware.simulated import MachineParameters, SimulatedRobot

UP_AND_DOWN = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 4.0, 2.0, 1.0, 0.0])


def test_an_exact_line_is_found():
    fit = fit_load_cell(UP_AND_DOWN, 512.0 + 40.0 * UP_AND_DOWN)
    assert fit.gain == pytest.approx(1 / 40.0) and fit.offset == pytest.approx(512.0)
    assert fit.r_squared == pytest.approx(1.0) and fit.hysteresis == pytest.approx(0.0, abs=1e-12)
    assert np.max(np.abs(fit.residual)) < 1e-9 and fit.warnings == ()
    assert "LoadCellFit: gain 0.025" in repr(fit)


def test_standard_errors_have_the_spread_of_repeated_calibrations():
    random = np.random.default_rng(0)
    fits = [
        fit_load_cell(UP_AND_DOWN, 512.0 + 40.0 * UP_AND_DOWN + random.normal(size=len(UP_AND_DOWN)))
        for _ in range(400)
    ]
    for name in ("gain", "offset"):
        spread = np.std([getattr(fit, name) for fit in fits])
        stated = np.sqrt(np.mean([getattr(fit, f"{name}_error") ** 2 for fit in fits]))
        assert stated == pytest.approx(spread, rel=0.15)
    assert np.mean([bool(fit.warnings) for fit in fits]) < 0.1


def test_problems_are_warnings():
    bent = fit_load_cell(UP_AND_DOWN, UP_AND_DOWN + 0.02 * UP_AND_DOWN**2)
    assert any(each.startswith("not linear") for each in bent.warnings)
    # the parabola's height over its chord is 0.02 * 8² / 4, half of it from the best line
    assert bent.nonlinearity == pytest.approx(0.02 * 64 / 8 / 8 / 1.16, rel=0.05)
    leg = np.concatenate([np.zeros(5), [0.3, 0.4, 0.3, 0.0]])
    sticking = fit_load_cell(UP_AND_DOWN, UP_AND_DOWN + leg)
    assert sticking.hysteresis == pytest.approx(0.4 / 8.0, rel=0.05)
    assert any(each.startswith("hysteresis: loading") for each in sticking.warnings)
    few = fit_load_cell([0.0, 5.0], [0.0, 5.0])
    assert np.isnan(few.gain_error) and "only 2 different weights" in few.warnings[0]
    assert few.summary()["gain_error"] is None and few.summary()["gain"] == 1.0


@pytest.mark.parametrize(
    ("weights", "readings", "message"),
    [
        ([0.0, 1.0], [1.0], "one length"),
        ([1.0, 1.0], [1.0, 2.0], "two different weights"),
        ([0.0, np.nan], [1.0, 2.0], "finite"),
        ([0.0, 1.0], ["a", 2.0], "numbers"),
        ([0.0, 1.0, 2.0], [5.0, 5.0, 5.0], "do not change"),
    ],
)
def test_impossible_data_are_refused(weights, readings, message):
    with pytest.raises(HardwareError, match=message):
        fit_load_cell(weights, readings)


def test_settings_of_the_wire():
    fit = fit_load_cell(UP_AND_DOWN, 0.1 + 0.8 * UP_AND_DOWN)
    gain, zero = wire_settings(fit, 1024, 100)
    assert gain == 1280 and zero == 100 + round(0.1 / 9.80665e-3 * 4)
    with pytest.raises(HardwareError, match="polarity"):
        wire_settings(fit_load_cell(UP_AND_DOWN, -UP_AND_DOWN), 1024, 0)


def test_a_calibrated_robot_measures_the_weights():
    rod = kc.load_robot("delrin-tendon-robot").replace(nodes=6)
    with SimulatedRobot(rod, machine=MachineParameters(gain_error=-0.2, offset=0.4)) as robot:
        readings = []
        for weight in UP_AND_DOWN:
            robot.hang(2, weight)
            robot.wait(0.02)
            readings.append(np.mean([robot.read().tension[2] for _ in range(5)]))
        fit = fit_load_cell(UP_AND_DOWN, readings)
        assert fit.gain == pytest.approx(1.25, rel=0.02)
        changed = write_calibration(robot, 2, fit)
        assert set(changed) == {"gain3", "zero3"} and robot.setting("gain3") == changed["gain3"]
        robot.hang(2, 5.0)
        robot.wait(0.02)
        assert np.mean([robot.read().tension[2] for _ in range(10)]) == pytest.approx(5.0, abs=0.05)


def test_it_can_be_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    random = np.random.default_rng(0)
    fit = fit_load_cell(UP_AND_DOWN, 512.0 + 40.0 * UP_AND_DOWN + random.normal(size=len(UP_AND_DOWN)))
    load_cell(fit).savefig(tmp_path / "cell.png")
    assert (tmp_path / "cell.png").stat().st_size > 1000
