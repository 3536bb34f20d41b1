"""The study of state estimation and the command that records: tables, files, and the bar."""

import importlib.util
import json

import pytest

import knode_cosserat as kc
from studies import estimation
from tests.commands import run, run_study

matplotlib = pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")


def cell(method, quantity, rms, balance=estimation.TRUE):
    about = {"recording": "sine", "signal": "sine:1.0", "balance": balance}
    return {**about, "method": method, "quantity": quantity, "rms": rms, "size": 1.0, "unit": "m"}


def test_the_table_has_errors_ratios_and_noise():
    cells = [
        cell(method, quantity, rms, balance)
        for balance in (estimation.TRUE, estimation.CRUDE)
        for method, rms in (("paper", 0.006), ("best", 0.001))
        for quantity in estimation.QUANTITIES
    ]
    text = estimation.as_markdown(cells)
    assert "simulated" in text
    [row] = [line for line in text.splitlines() if line.startswith("| position")]
    assert [part.strip() for part in row.strip("|").split("|")][1:] == ["1e+03", "0.26", "6", "1", "6.0"]


@pytest.mark.campaign
@matplotlib
def test_the_best_is_three_times_better_on_every_recording(tmp_path):
    result = run_study("estimation", "--out", tmp_path, "--json")
    assert result.exit_code == 0, result.stderr
    told = json.loads(result.stdout)
    assert told["failed"] == 0 and (tmp_path / "figures" / "estimation.png").exists()
    cells = json.loads((tmp_path / "estimation.json").read_text())
    own = {
        (it["recording"], it["method"], it["quantity"]): it["rms"]
        for it in cells
        if it["balance"] == estimation.TRUE
    }
    for name in estimation.SIGNALS:
        for quantity in ("n", "m", "q", "w"):
            assert 3.0 * own[name, "best", quantity] < own[name, "paper", quantity], (name, quantity)
        assert own[name, "best", "p"] < 0.15e-3 and own[name, "best", "h"] < 2e-3


@pytest.mark.campaign
def test_recording_on_the_command_line(tmp_path):
    bag, states = tmp_path / "x.bag", tmp_path / "x.nc"
    result = run("record-virtual", "step:1", "--out", bag, "--seconds", 2.5, "--states", states, "--json")
    assert result.exit_code == 0, result.stderr
    told = json.loads(result.stdout)
    assert told["simulated"] is True and told["out"] == str(bag)
    truth = kc.load_trajectory(states)
    recording = kc.load_recording(bag)
    assert recording.simulated is True
    found = kc.estimate_states(recording, truth.system.replace(nodes=10))
    assert kc.metrics.state_errors(found, truth)["p"].rms < 0.3e-3


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("wave:1", "--out", "x.bag"), "no such signal or file"),
        (("sine:1", "--out", "x.wav"), "allowed is a name that ends in"),
        (("sine:1", "--out", "nowhere/x.bag"), "there is no folder"),
        (("sine:1",), "Missing option '--out'"),
    ],
)
def test_bad_input_is_one_line(arguments, said):
    result = run("record-virtual", *arguments)
    assert result.exit_code == 2 and said in result.stderr and result.stderr.count("\n") == 1
