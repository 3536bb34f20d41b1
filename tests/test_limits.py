"""Limits of texts, controls, references and trajectories; and the setting of all limits."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from knode_cosserat import controls
from knode_cosserat._files import csv_rows, limits, yaml_text
from knode_cosserat._files.limits import MORE, VARIABLE, LimitSettingError, allowed, excess
from knode_cosserat.cli.control import parsed_reference
from tests.limits import Readers, assert_limited, limit_size

READERS = Readers()


@pytest.fixture(autouse=True)
def unset(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


@READERS
def yaml_characters(folder, patch):
    patch.setattr(yaml_text, "MOST_CHARACTERS", 10)
    return lambda: yaml_text.mapping_of("a: 12345678", "a")


@READERS
def yaml_bytes(folder, patch):
    patch.setattr(yaml_text, "MOST_CHARACTERS", 3)
    path = folder / "it.yaml"
    path.write_text("a: 1234567890")
    return lambda: yaml_text.read_yaml(path)


@READERS
def yaml_aliases(folder, patch):
    patch.setattr(yaml_text, "MOST_VALUES", 5)
    return lambda: yaml_text.mapping_of("a: &a [1, 2]\nb: *a", "a")


def tensions(folder):
    path = folder / "tensions.csv"
    controls.save(path, np.full((30, 4), 5.0), 0.05)
    return path


@READERS
def controls_size(folder, patch):
    path = tensions(folder)
    limit_size(patch, csv_rows, path)
    return lambda: controls.load(path)


@READERS
def controls_lines(folder, patch):
    patch.setattr(csv_rows, "MOST_LINES", 30)
    return lambda: controls.load(tensions(folder))


@READERS
def controls_columns(folder, patch):
    patch.setattr(csv_rows, "MOST_COLUMNS", 4)
    return lambda: controls.load(tensions(folder))


@READERS
def controls_steps(folder, patch):
    patch.setattr(csv_rows, "MOST_STEPS", 100)
    return lambda: controls.load(tensions(folder), 0.005)


@READERS
def reference_size(folder, patch):
    patch.setattr(csv_rows, "LARGEST_FILE", 20)
    path = folder / "it.csv"
    path.write_text("t,x,y\n0,0.1,0.1\n1,0.1,0.2\n")
    return lambda: parsed_reference(str(path))


@pytest.mark.parametrize("name", READERS)
def test_a_refusal_names_the_setting_and_the_setting_allows_the_file(name, tmp_path, monkeypatch):
    assert_limited(READERS[name], tmp_path, monkeypatch)


# the setting


@pytest.mark.parametrize("text", ["ten", "0", "-1", "nan", "inf", "1e999", "10\n20", "x" * 1000])
def test_a_wrong_setting_is_refused_in_one_line(monkeypatch, text):
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(LimitSettingError) as refused:
        allowed(5)
    message = str(refused.value)
    assert message.startswith(f"{VARIABLE} must be a finite number above 0 (got ") and len(message) < 200
    assert "\n" not in message and isinstance(refused.value, ValueError)


def test_the_default_and_an_empty_setting_change_nothing(monkeypatch):
    assert allowed(1_000_000_000) == 1_000_000_000
    monkeypatch.setenv(VARIABLE, "")
    assert allowed(7) == 7 and excess(7, 7, "bytes") == ""
    assert excess(8, 7, "bytes") == f"it has 8 bytes; allowed are 7; {MORE}"


numbers, factors = st.integers(0, 2**40), st.floats(1e-9, 1e300)


@given(numbers, numbers, factors, factors)
def test_limits_grow_with_the_factor_and_are_integers_of_64_bits(one, other, factor, larger):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, repr(factor))
        low, high = sorted((one, other))
        found = allowed(low)
        assert type(found) is int and 0 <= found <= allowed(high) <= limits._LARGEST
        assert found == int(min(low * factor, limits._LARGEST))
        assert bool(excess(one, other, "rows")) == (one > allowed(other))
        patch.setenv(VARIABLE, repr(max(factor, larger)))
        assert found <= allowed(low)
