"""Limits of texts, controls, references and trajectories; and the setting of all limits."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from knode_cosserat import controls
from knode_cosserat._files import csv_rows, limits, yaml_text
from knode_cosserat._files.limits import MORE, VARIABLE, LimitSettingError, excess, scaled_limit
from knode_cosserat.cli.control import parsed_reference
from tests.limits import assert_limited, limited


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


# files, and functions that read them


def text(folder, words="a: 1234567890"):
    path = folder / "it.yaml"
    path.write_text(words)
    return path, lambda: yaml_text.read_yaml(path)


def mapping(folder):
    return None, lambda: yaml_text.mapping_of("a: &a [1, 2]\nb: *a", "a")


def tensions(folder, dt=None):
    path = folder / "tensions.csv"
    controls.save(path, np.full((30, 4), 5.0), 0.05)
    return path, lambda: controls.load(path, dt)


def reference(folder):
    path = folder / "it.csv"
    path.write_text("t,x,y\n0,0.1,0.1\n1,0.1,0.2\n")
    return path, lambda: parsed_reference(str(path))


@pytest.mark.parametrize(
    ("file", "module", "limit", "value"),
    [
        # None: one byte less than the file has
        (mapping, yaml_text, "MOST_CHARACTERS", 10),
        (text, yaml_text, "MOST_CHARACTERS", 3),
        (mapping, yaml_text, "MOST_VALUES", 5),
        (tensions, csv_rows, "LARGEST_FILE", None),
        (tensions, csv_rows, "MOST_LINES", 30),
        (tensions, csv_rows, "MOST_COLUMNS", 4),
        (lambda folder: tensions(folder, 0.005), csv_rows, "MOST_STEPS", 100),
        (reference, csv_rows, "LARGEST_FILE", 20),
    ],
)
def test_a_refusal_names_the_setting_and_the_setting_allows_the_file(
    tmp_path, monkeypatch, file, module, limit, value
):
    assert_limited(limited(file, module, {limit: value}), tmp_path, monkeypatch)


# the setting


@pytest.mark.parametrize("text", ["ten", "0", "-1", "nan", "inf", "1e999", "10\n20", "x" * 1000])
def test_a_wrong_setting_is_refused_in_one_line(monkeypatch, text):
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(LimitSettingError) as refused:
        scaled_limit(5)
    message = str(refused.value)
    assert message.startswith(f"{VARIABLE} must be a finite number above 0 (got ") and len(message) < 200
    assert "\n" not in message and isinstance(refused.value, ValueError)


def test_the_default_and_an_empty_setting_change_nothing(monkeypatch):
    assert scaled_limit(1_000_000_000) == 1_000_000_000
    monkeypatch.setenv(VARIABLE, "")
    assert scaled_limit(7) == 7 and excess(7, 7, "bytes") == ""
    assert excess(8, 7, "bytes") == f"it has 8 bytes; allowed are 7; {MORE}"


numbers, factors = st.integers(0, 2**40), st.floats(1e-9, 1e300)


@given(numbers, numbers, factors, factors)
def test_limits_grow_with_the_factor_and_are_integers_of_64_bits(one, other, factor, larger):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, repr(factor))
        low, high = sorted((one, other))
        found = scaled_limit(low)
        assert type(found) is int and 0 <= found <= scaled_limit(high) <= limits._LARGEST
        assert found == int(min(low * factor, limits._LARGEST))
        assert bool(excess(one, other, "rows")) == (one > scaled_limit(other))
        patch.setenv(VARIABLE, repr(max(factor, larger)))
        assert found <= scaled_limit(low)
