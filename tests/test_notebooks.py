"""The notebooks run, say what they show, and are what their text says."""

import json
from base64 import b64decode

import numpy as np
import pytest

from tools.notebooks import NOTEBOOKS, Cell, cells_of, notebook, run

NAMES = ("first_steps", "learn_what_is_missed", "recording_to_control")


def source(name):
    return cells_of((NOTEBOOKS / f"{name}.py").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_its_text_with_outputs_and_no_paths(name):
    text = (NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8")
    stored = json.loads(text)
    cells = source(name)
    plain = notebook(cells, [[] for _ in cells])
    pictures = 0
    for one, expected in zip(stored["cells"], plain["cells"], strict=True):
        outputs = one.pop("outputs", [])
        expected.pop("outputs", None)
        assert one == expected, f"`make notebooks`: {name} is not what its text says"
        for output in outputs:
            assert output["output_type"] in ("stream", "display_data")
            if output["output_type"] == "display_data":
                assert b64decode(output["data"]["image/png"]).startswith(b"\x89PNG")
                pictures += 1
    assert stored | {"cells": []} == plain | {"cells": []}
    assert pictures >= 2 and len(text) < 400_000
    assert not any(place in text for place in ("/tmp", "/home", "/root", "/Users", "site-packages"))


def test_all_notebooks_are_tested():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(NAMES)
    assert {path.stem for path in NOTEBOOKS.glob("*.py")} == set(NAMES)


def test_first_steps(tmp_path):
    outputs, names = run(source("first_steps"), tmp_path, steps=40)
    said = "".join(line for cell in outputs for output in cell for line in output.get("text", []))
    assert names["truth"].all_valid and len(names["truth"].time) == 41
    assert "the same after loading: True" in said
    # a stiffer rod bends less
    reach = [np.max(np.abs(np.asarray(names[it].tip_position)[:, :2])) for it in ("stiff", "truth")]
    assert 0.3 * reach[1] < reach[0] < 0.9 * reach[1]


@pytest.mark.campaign
@pytest.mark.sample
def test_learn_what_is_missed(tmp_path):
    outputs, names = run(source("learn_what_is_missed"), tmp_path, steps=40)
    said = "".join(line for cell in outputs for output in cell for line in output.get("text", []))
    assert "the same after loading: True" in said and "length: 0.635000 m" in said
    tips = {it: np.asarray(names[it].tip_position) for it in ("truth", "before", "after")}
    errors = {it: np.max(np.abs(tips[it] - tips["truth"])) for it in ("before", "after")}
    assert errors["after"] < 1e-6 * errors["before"]


@pytest.mark.campaign
def test_recording_to_control(tmp_path):
    _, names = run(source("recording_to_control"), tmp_path, seconds=3.0, points=24)
    assert np.all(names["reached"].converged)
    true, seen = (
        names["unseen"].tip_position,
        [np.asarray(names[it].tip_position) for it in ("before", "after")],
    )
    before, after = (np.sqrt(np.mean(np.sum((each - true) ** 2, axis=1))) for each in seen)
    assert after < 0.02 and after < 0.3 * before
    final = np.asarray(names["moved"].tip_position)[-1, :2]
    np.testing.assert_allclose(final, names["wanted"][-1], atol=0.03)


# the tool


def test_cells_are_parted_and_pictures_and_text_are_kept(tmp_path):
    text = (
        '# %% [markdown]\n# # Title\n#\n# words\n\n# %% tags=["parameters"]\na = 1\n\n# %%\nprint(a + 1)\na\n'
    )
    cells = cells_of(text)
    assert cells[0] == Cell("markdown", "# Title\n\nwords")
    assert cells[1] == Cell("code", "a = 1", ("parameters",))
    outputs, names = run(cells, tmp_path, a=4)
    assert outputs[2] == [{"name": "stdout", "output_type": "stream", "text": ["5\n"]}] and names["a"] == 4
    with pytest.raises(ValueError, match="no such parameters: b"):
        run(cells, tmp_path, b=4)
