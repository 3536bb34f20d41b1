"""The comparison of packages on one rod: its table, and its rod against closed forms."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import matched

ROOT = Path(__file__).parents[1]


def test_the_page_has_the_table_of_the_results():
    found = json.loads((ROOT / "benchmarks" / "matched.json").read_text(encoding="utf-8"))
    assert set(found) == set(matched.PACKAGES)
    assert matched.table(found) in (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")


def test_the_fastest_accurate_settings_count():
    found = json.loads((ROOT / "benchmarks" / "matched.json").read_text(encoding="utf-8"))
    for name, each in found.items():
        accurate = [
            row for row in each["rows"] if row["error"] is not None and row["error"] <= matched.ALLOWED
        ]
        assert each["best"] in accurate, name
        assert each["best"]["cpu"] == min(row["cpu"] for row in accurate)


def test_missing_and_inaccurate_packages_are_reported():
    row = {"settings": [4, 0.02, "trapezoidal"], "error": 0.03, "seconds": 0.1}
    found = {"ours": {"version": "1", "rows": [row]}, "soromox": {"missing": "No module named 'soromox'"}}
    inaccurate, missing = matched.table(found).splitlines()[2:]
    assert "| none |" in inaccurate and "3.00 %" in inaccurate
    assert missing.startswith("| soromox | missing: No module named 'soromox' |")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:bending_damping is 0")
def test_the_rod_swings_about_its_sag_at_its_own_frequency():
    tips = matched.ours(6, 0.01, "trapezoidal")()[:, 0]
    area, EI = np.pi * matched.RADIUS**2, matched.YOUNGS_MODULUS * np.pi * matched.RADIUS**4 / 4
    mass, L = matched.DENSITY * area, matched.LENGTH
    # clamped and free: β = 1.8751. Released straight, a rod swings to twice its sag, higher modes apart
    sag = mass * 9.81 * L**4 / (8 * EI)
    period = 2 * np.pi * L**2 / 1.8751**2 * np.sqrt(mass / EI)
    rows = np.arange(len(tips)) * matched.ROW
    assert rows[np.argmin(tips[: round(period / matched.ROW)])] == pytest.approx(
        0.5 * period, abs=matched.ROW
    )
    assert tips.min() == pytest.approx(-2.0 * sag, rel=0.05)
