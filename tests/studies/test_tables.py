import csv
import io
import statistics

import pytest

from studies.report import Published, Spread, as_csv, as_markdown, in_words, ratio_in_words, spreads

PUBLISHED = {
    ("length", "sine"): Published((40.16, 16.46), (4.31, 1.44), (4.03, 1.17)),
    ("self-weight", "sine"): Published((1.75, 0.09), (0.0, 0.0), (0.0, 0.0)),
}


def cell(imperfection, method, seed, dtw, mse, **more):
    return {
        "imperfection": imperfection,
        "control": "sine",
        "method": method,
        "seed": seed,
        "tip_dtw": dtw,
        "pose_mse": mse,
        "rotation_rmse": None if mse is None else 0.01 * mse,
        **more,
    }


CELLS = [
    cell("length", "baseline", 0, 40.2, 16.5),
    cell("length", "best", 0, 0.001, 0.3),
    cell("length", "best", 1, 0.003, 0.4),
    cell("length", "best", 2, None, None, failed="step 7 (t = 0.35 s): no solution found"),
    cell("self-weight", "best", 0, None, None, failed="the loss diverged"),
    cell("self-weight", "best", 1, None, None, failed="the loss diverged"),
]


def test_figures_are_gathered_by_case_and_method():
    found = spreads(CELLS, "tip_dtw")
    assert list(found) == [("length", "sine"), ("self-weight", "sine")]
    best = found["length", "sine"]["best"]
    assert best == Spread((0.001, 0.003), ("step 7 (t = 0.35 s): no solution found",))
    assert best.mean == pytest.approx(0.002)
    assert best.deviation == pytest.approx(statistics.stdev([0.001, 0.003]))
    assert found["length", "sine"]["baseline"].deviation is None
    assert found["self-weight", "sine"]["best"].mean is None


@pytest.mark.parametrize(
    ("spread", "words"),
    [
        (Spread((1.23456,), ()), "1.23"),
        (Spread((1.0, 1.2), ()), "1.1 ± 0.1"),
        (Spread((1.5e-9, 2.5e-9), ("why",)), "2e-09 ± 7e-10 (1 of 3 failed)"),
        (Spread((), ("why", "why")), "failed (2 of 2)"),
        (Spread((), ("why",)), "failed"),
        (Spread((), ()), ""),
    ],
)
def test_a_spread_in_words(spread, words):
    assert in_words(spread) == words


@pytest.mark.parametrize(
    ("value", "published", "words"),
    [
        (2.155, 4.31, "0.50"),
        (8.62, 4.31, "2.00"),
        (0.0431, 4.31, "1/100"),
        (4.31e-9, 4.31, "1/1.0e+09"),
        (0.0, 4.31, "0.00"),
        (0.1, 0.0, "-"),
        (None, 4.31, ""),
    ],
)
def test_a_ratio_in_words(value, published, words):
    assert ratio_in_words(value, published) == words


def test_the_markdown_has_the_papers_figures_beside_ours_and_every_failure():
    text = as_markdown(CELLS, PUBLISHED, ("A note.",))
    lines = [line.strip("|") for line in text.splitlines() if "|" in line]
    rows = [[part.strip() for part in line.split("|")] for line in lines]
    head, rule, length, weight = rows[:4]
    assert head[:5] == ["imperfection", "control", "paper: baseline", "paper: KNODE", "its rerun"]
    assert head[5:] == ["baseline", "best", "ratio"]
    assert set("".join(rule)) == {"-"}
    assert length == [
        "length",
        "sine",
        "40.16",
        "4.31",
        "4.03",
        "40.2",
        "0.002 ± 0.001 (1 of 3 failed)",
        "1/2,155",
    ]
    assert weight == ["self-weight", "sine", "1.75", "0.00", "0.00", "", "failed (2 of 2)", ""]
    assert rows[6][2:6] == ["16.46", "1.44", "1.17", "16.5"]
    # the paper has no angles; cells have radians, tables degrees
    assert rows[8:11:2] == [
        ["imperfection", "control", "baseline", "best"],
        ["length", "sine", "9.45", "0.201 ± 0.04 (1 of 3 failed)"],
    ]
    assert len({len(line) for line in text.splitlines()[4:8]}) == 1
    assert text.count("length, sine, best: step 7 (t = 0.35 s): no solution found") == 1
    assert text.count("self-weight, sine, best: the loss diverged") == 2
    assert text.endswith("A note.\n")


def test_without_a_failure_nothing_is_said_of_any():
    text = as_markdown(CELLS[:3], PUBLISHED)
    assert "failed" not in text
    assert text.startswith("Mean and standard deviation over seeds. Ratios are to the paper's KNODE")


def test_the_csv_has_all_of_it_as_numbers():
    rows = list(csv.DictReader(io.StringIO(as_csv(CELLS, PUBLISHED))))
    assert len(rows) == 3 * 3
    best = next(row for row in rows if row["method"] == "best" and row["measure"] == "pose_mse")
    assert float(best["mean"]) == pytest.approx(0.35)
    assert (float(best["least"]), float(best["most"])) == (0.3, 0.4)
    assert (best["seeds"], best["failed"]) == ("3", "1")
    assert float(best["paper_knode"]) == 1.44
    assert float(best["ratio_to_paper_knode"]) == pytest.approx(0.35 / 1.44)
    failed = next(row for row in rows if row["imperfection"] == "self-weight")
    assert (failed["mean"], failed["ratio_to_paper_knode"], failed["failed"]) == ("", "", "2")


def test_a_case_that_was_not_published_is_told_alone():
    for published, columns in ((PUBLISHED, ["", "", "", "1", "-"]), ({}, ["1"])):
        text = as_markdown([cell("radius", "best", 0, 1.0, 2.0)], published)
        row = [part.strip() for part in text.splitlines()[6].strip("|").split("|")]
        assert row == ["radius", "sine", *columns]
