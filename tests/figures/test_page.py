"""The page of evaluations: complete, self-contained, and readable where it is read."""

import base64
import dataclasses
import json
import re

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.figures import evaluation as drawn
from knode_cosserat.identification import Comparison, Evaluation
from knode_cosserat.identification.evaluate import compared, evaluate
from tests.commands import run, succeeded
from tests.viewer import browser as driver

pytestmark = pytest.mark.filterwarnings("error")

DT = 0.05
ROBOT = kc.load_robot("delrin-tendon-robot").replace(nodes=7)
SOFTER = ROBOT.replace(youngs_modulus=0.9 * ROBOT.youngs_modulus)
NASTY = '<script>alert("a")</script>.bag'


@pytest.fixture(scope="module")
def seen():
    truth = kc.simulate(ROBOT, kc.controls.sine(0.5, 12, DT), DT, initial="equilibrium")
    return kc.recordings.Measurements.of(truth, (0.5, 1.0))


@pytest.fixture(scope="module")
def found(seen):
    members = [ROBOT.replace(youngs_modulus=factor * ROBOT.youngs_modulus) for factor in (0.9, 1.0, 1.06)]
    it = evaluate(SOFTER, seen, ensemble=members)
    outside = np.arange(len(seen.time)) > 8
    return dataclasses.replace(
        it,
        extrapolated=float(outside.mean()),
        comparison=dataclasses.replace(it.comparison, extrapolated=outside),
    )


@pytest.fixture(scope="module")
def failed(seen):
    return Evaluation(
        failed="step 3: no <solution> found", comparison=Comparison(ROBOT, seen, np.arange(13), "lobatto4")
    )


@pytest.fixture(scope="module")
def page(found, failed, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "errors.html"
    assert kc.figures.evaluation_page({"sine": found, NASTY: failed}, path, robot="a & b.yaml") == path
    return path


@pytest.fixture(scope="module")
def text(page):
    return page.read_text(encoding="utf-8")


def words(text):
    """The page's words, without pictures and markup."""
    return re.sub(r"\s+", " ", re.sub(r"<style>.*?</style>|<[^>]*>", " ", text, flags=re.DOTALL))


def test_the_table_has_the_errors_and_the_failures(text, found):
    said = words(text)
    tip = 1e3 * found.comparison.distance[:, -1]
    numbers = (np.sqrt(np.mean(tip**2)), np.median(tip), np.percentile(tip, 95), tip.max())
    row = re.search(r"<tr><td>sine</td>.*?</tr>", text)[0]
    cells = re.findall(r"<td>(.*?)</td>", row)
    assert [cell.split("<")[0] for cell in cells[2:6]] == [f"{number:.3g}" for number in numbers]
    share = f"{1e-1 * numbers[0] / float(ROBOT.length):.2g} %"
    assert share in cells[2] and cells[6] == f"{np.degrees(found.rotation_rmse):.3g}"
    assert f"{100 * found.band.coverage:.0f} %" in cells[8] and "31 %" in cells[7]
    assert cells[9] == f"{found.pose_mse:.3g}"
    assert "1 of 2 predicted, 1 failed" in said
    assert said.count("step 3: no &lt;solution&gt; found") == 2
    assert f"{numbers[0]:.3g} mm tip RMSE" in said


def test_the_conditions_are_stated(text):
    said = words(text)
    for part in (
        "a &amp; b.yaml",
        "TendonRobot",
        "0.635 m",
        "lobatto4",
        "0.05 s",
        "a simulated robot",
        "90 %, of 3 models",
    ):
        assert part in said, part
    assert re.search(r"knode-cosserat \d+\.\d+", said) and re.search(r"date \d{4}-\d\d-\d\d \d\d:\d\d", said)
    assert "13 rows from 0 to 0.6 s, 0.05 s apart; 2 bodies at 50 %, 100 % of the length" in said


def test_the_page_is_self_contained_and_runs_nothing(text):
    assert "<script" not in text and "&lt;script&gt;" in text
    assert "default-src 'none'" in text
    sources = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert all(source.startswith("data:") for source in sources)
    pictures = [base64.b64decode(each.partition(",")[2]).decode() for each in sources if "svg" in each]
    # four of the prediction, one of the recording that was not predicted
    assert len(pictures) == 5 and all("<svg" in picture for picture in pictures)


def test_columns_and_panels_that_no_recording_has_are_left_out(tmp_path, seen):
    tip = dataclasses.replace(
        seen,
        position=seen.position[:, 1:],
        quaternion=np.full((13, 1, 4), np.nan),
        measured=seen.measured[:, 1:],
        fractions=np.ones(1),
    )
    text = kc.figures.evaluation_page(evaluate(SOFTER, tip), tmp_path / "it.html").read_text(encoding="utf-8")
    assert "angle [" not in text and "polated" not in text and "band" not in words(text)
    assert "Errors along the rod" not in text and text.count("<figure>") == 3


def test_equilibria_have_rows_and_no_time(tmp_path, seen):
    control = np.array([[5.0, 5.0, 5.0, 5.0], [6.0, 5.0, 4.0, 5.0], [7.0, 5.0, 3.0, 5.0]])
    rows = kc.solvers.equilibria(ROBOT, control)
    measured = dataclasses.replace(kc.recordings.Measurements.of(rows, (0.5, 1.0)), static=True)
    it = compared(SOFTER, kc.solvers.equilibria(SOFTER, control), measured)
    said = words(kc.figures.evaluation_page(it, tmp_path / "it.html").read_text(encoding="utf-8"))
    assert "3 equilibria" in said and "each row is an equilibrium" in said and "time between" not in said
    assert sorted(drawn.worst_rows(it.comparison)) == [0, 1, 2]
    assert drawn.over_time(it.comparison).axes[-1].get_xlabel() == "row"


def test_sensors_alone_have_a_page(tmp_path, seen):
    nothing = dataclasses.replace(
        seen,
        position=np.zeros((13, 0, 3)),
        quaternion=np.zeros((13, 0, 4)),
        measured=np.zeros((13, 0), bool),
        fractions=np.zeros(0),
    )
    it = dataclasses.replace(evaluate(SOFTER, nothing), sensors={"gauge (1/m)": 0.25})
    said = words(kc.figures.evaluation_page({"it": it}, tmp_path / "it.html").read_text(encoding="utf-8"))
    assert "gauge (1/m) 0.25" in said and "no tracked body" in said
    with pytest.raises(ValueError, match="no evaluations"):
        kc.figures.evaluation_page({}, tmp_path / "it.html")


def test_the_worst_instants_are_apart(found):
    it = found.comparison
    rows = drawn.worst_rows(it)
    assert rows[0] == int(np.argmax(it.distance.max(axis=1)))
    assert np.min(np.abs(np.subtract.outer(rows, rows)) + 9 * np.eye(3)) >= 1
    axes = drawn.worst_instants(it).axes
    assert axes[0].get_title() == f"{it.time[rows[0]]:.4g} s: {1e3 * it.distance[rows[0]].max():.3g} mm"
    assert [each.get_xlabel() for each in axes] == ["x [mm]"] * 3 + ["y [mm]"] * 3


def test_what_hangs_is_drawn_hanging(found):
    hanging = dataclasses.replace(found.comparison, robot=ROBOT.replace(gravity=[0.0, 0.0, 9.81]))
    assert drawn.worst_instants(hanging).axes[0].yaxis_inverted()
    assert not drawn.worst_instants(found.comparison).axes[0].yaxis_inverted()


def test_panels_over_time_have_their_units_and_marks(found):
    figure = drawn.over_time(found.comparison)
    labels = [" ".join(axes.get_ylabel().split()) for axes in figure.axes]
    assert labels == [
        "tip x [mm]", "tip y [mm]", "tip z [mm]", "tip error [mm]", "orient. error [°]", "tension [N]",
    ]  # fmt: skip
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["90 % band", "measured", "predicted", "extrapolated"]
    assert drawn.spans(np.array([True, False, True, True])) == [(0, 0), (2, 3)]


def test_lengths_have_a_unit_that_suits_them():
    assert [drawn.length_unit(size)[1] for size in (2e-6, 3e-3, 0.6, 2.0, 0.0)] == [
        "µm",
        "mm",
        "mm",
        "m",
        "mm",
    ]


def test_long_lines_keep_their_extremes():
    time = np.arange(50_000) * 1e-3
    values = np.sin(time)
    values[31_234] = 7.0
    values[100:200] = np.nan
    thin = drawn.thinned(time, values)
    assert len(thin[0]) <= drawn.MOST_POINTS and np.nanmax(thin[1]) == 7.0
    assert np.nanmin(thin[1]) == np.nanmin(values) and np.isnan(thin[1]).any()
    np.testing.assert_array_equal(drawn.thinned(time[:10], values[:10])[0], time[:10])


@pytest.mark.slow
def test_the_command_writes_the_page(tmp_path, seen):
    table, out = tmp_path / "seen.csv", tmp_path / "errors.html"
    seen.save(table)
    given = ("evaluate", "delrin-tendon-robot", table, "--dt", DT, "--page", out)
    assert succeeded(*given).endswith(f"wrote {out}\n")
    assert "seen.csv" in words(out.read_text(encoding="utf-8"))
    succeeded(*given, "--rows", 5)
    assert "5 rows from 0 to 0.2 s" in words(out.read_text(encoding="utf-8"))
    facts = json.loads(succeeded(*given, "--json"))
    assert facts["page"] == str(out) and facts["recordings"][str(table)]["rotation_rmse"] is not None
    for wrong, said in ((tmp_path / "a.txt", "must end in .html"), (tmp_path / "no" / "a.html", "no folder")):
        result = run("evaluate", "delrin-tendon-robot", table, "--page", wrong)
        assert result.exit_code == 2 and said in result.stderr and result.stderr.count("\n") == 1


@pytest.fixture(scope="module")
def browser():
    if driver.find() is None:
        pytest.skip(f"no browser: none of {', '.join(driver.NAMES)} is installed")
    pytest.importorskip("websockets", reason="websockets, of the extra viz, drives the browser")
    started = driver.Browser()
    yield started
    started.close()


@pytest.mark.parametrize("width", [360, 1280])
def test_a_browser_shows_it_without_a_network(browser, page, width):
    browser.messages.clear()
    browser.size(width, 800)
    browser.call("Page.navigate", url=page.as_uri())
    loaded = "document.readyState === 'complete' && document.images.length === 5"
    browser.wait(lambda: browser.run(loaded))
    assert browser.run("[...document.images].every((it) => it.naturalWidth > 200)")
    # nothing but the table scrolls sideways
    assert browser.run("document.documentElement.scrollWidth") <= width
    columns = browser.run(
        "new Set([...document.images].map((it) => Math.round(it.getBoundingClientRect().x))).size"
    )
    assert columns == (1 if width < 700 else 2)
    assert browser.errors() == []
    assert [url.split(":")[0] for url in browser.requests()] == ["file"]
