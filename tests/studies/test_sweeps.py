"""The measurement of sweeps gives figures, and finds interrupted sweeps equal."""

import pytest

from benchmarks.sweeps import measure_sweep


@pytest.mark.campaign
def test_a_short_measurement(tmp_path):
    lines: list[str] = []
    found = measure_sweep(tmp_path / "sweeps", 256, kills=2, log=lines.append)
    assert found["identical"] is True and found["kills"] == 2 and len(lines) == 4
    # times depend on what else runs; a sweep stores less than `simulate` returns, and is no slower per core
    assert found["ratio_to_raw"]["cores"] > 0.5
    assert 0.0 < found["parallel_efficiency"]["cores"] < 2.0
    assert 0.1 < found["disk_megabytes"] < 1.0 and found["megabytes"] < 2000.0
