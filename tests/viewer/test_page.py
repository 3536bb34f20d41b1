"""The page itself, in a headless browser: it opens from a file, and draws what the trajectories say."""

import numpy as np
import pytest

from knode_cosserat.viewer import export_scene


@pytest.fixture(scope="module")
def page(browser, truth, prediction, failed, tmp_path_factory):
    """Opens a scene of the named trajectories."""
    folder = tmp_path_factory.mktemp("scenes")

    def opened(**trajectories):
        path = export_scene(trajectories, folder / f"{'-'.join(trajectories)}.html")
        browser.size(1280, 800)
        browser.open(path.as_uri())
        return browser

    return opened


def drawn_end(browser, robot=0):
    """The middle of the last ring of the rod that is drawn."""
    return browser.run(f"Array.from(viewer.robots[{robot}].rods[0].tube.position.slice(-3))")


def settled(browser):
    """After the next frame that is drawn."""
    browser.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def test_a_scene_opens_from_a_file_without_errors_and_asks_for_nothing(page, truth, tmp_path):
    browser = page(truth=truth)
    assert browser.run("document.title") == "truth · KNODE-Cosserat"
    np.testing.assert_allclose(drawn_end(browser), truth.tip_position[0], atol=1e-6)
    browser.picture(tmp_path / "page.png")
    assert (tmp_path / "page.png").stat().st_size > 20_000
    assert browser.errors() == []
    assert [url.split(":")[0] for url in browser.requests()] == ["file"]


def test_the_time_slider_moves_the_tip_to_its_rows(page, truth):
    browser = page(truth=truth)
    browser.drag("#time", 0.8)
    settled(browser)
    row = int(browser.run("document.getElementById('time').value"))
    assert 30 < row < 60
    np.testing.assert_allclose(drawn_end(browser), truth.tip_position[row], atol=1e-6)
    assert browser.run("document.getElementById('clock').textContent").startswith(f"{row * 0.05:.2f} / 3.00")


def test_it_plays_in_real_time_until_paused(page, truth):
    browser = page(truth=truth)
    browser.run("document.getElementById('play').click()")
    browser.wait(lambda: browser.run("viewer.time") > 0.3)
    browser.run("document.getElementById('play').click()")
    settled(browser)
    time = browser.run("viewer.time")
    settled(browser)
    assert browser.run("viewer.time") == time and 0.3 < time < 3.0
    # between two rows, what lies between them
    between = [np.interp(time, truth.time, truth.tip_position[:, k]) for k in range(3)]
    np.testing.assert_allclose(drawn_end(browser), between, atol=1e-6)


def test_two_lie_on_each_other_or_stand_side_by_side(page, truth, prediction):
    browser = page(truth=truth, prediction=prediction)
    browser.run("viewer.seek(2.0)")
    settled(browser)
    np.testing.assert_allclose(drawn_end(browser, 1), prediction.tip_position[40], atol=1e-6)
    assert browser.run("document.querySelectorAll('#labels div').length") == 0
    browser.run("document.getElementById('apart').click()")
    settled(browser)
    cells = browser.run(
        "[...document.querySelectorAll('#labels div')]"
        ".map((e) => [e.textContent, e.getBoundingClientRect().x])"
    )
    assert [cell[0] for cell in cells] == ["truth", "prediction"] and cells[1][1] > cells[0][1] + 200
    browser.run("document.querySelectorAll('#legend button')[1].click()")
    settled(browser)
    assert browser.run("viewer.robots.map((robot) => robot.group.visible)") == [True, False]
    assert browser.errors() == []


def test_the_distance_of_the_tips_is_that_of_the_states(page, truth, prediction):
    browser = page(truth=truth, prediction=prediction)
    browser.run("viewer.seek(2.0)")
    settled(browser)
    wanted = 1000.0 * np.linalg.norm(truth.tip_position - prediction.tip_position, axis=1)
    np.testing.assert_allclose(browser.run("viewer.errors[0].values"), wanted, rtol=1e-4)
    said = browser.run("document.getElementById('error-now').textContent")
    assert said.startswith("to truth: ") and float(said.split()[2]) == pytest.approx(wanted[40], rel=1e-3)


def test_any_state_of_any_node_is_plotted(page, truth):
    browser = page(truth=truth)
    browser.run(
        "(() => { const f = document.getElementById('field'); f.value = 'u'; f.onchange();"
        " const n = document.getElementById('node'); n.value = 4; n.oninput(); })()"
    )
    lines = browser.run("viewer.statePlot.lines.map(({values}) => values)")
    np.testing.assert_allclose(np.transpose(lines), truth.part("u")[:, 4], rtol=1e-5, atol=1e-6)
    browser.run("document.getElementById('field').value = 'tension'")
    browser.run("document.getElementById('field').onchange()")
    lines = browser.run("viewer.statePlot.lines.map(({values}) => values)")
    np.testing.assert_allclose(np.transpose(lines), truth.part("tension"), rtol=1e-6)


def test_tendons_run_at_their_places_and_have_the_colours_of_their_tensions(page, truth, robot):
    browser = page(truth=truth)
    browser.run("viewer.seek(2.0)")
    settled(browser)
    points = np.array(browser.run("viewer.robots[0].tendons.map((t) => Array.from(t.points))")).reshape(
        4, 10, 3
    )
    w, *v = np.moveaxis(truth.quaternion[40] / np.linalg.norm(truth.quaternion[40], axis=1)[:, None], 1, 0)
    v = np.stack(v, axis=1)
    for k, angle in enumerate(np.asarray(robot.tendon_angles)):
        r = float(robot.tendon_offset) * np.array([np.cos(angle), np.sin(angle), 0.0])
        turned = r + 2.0 * np.cross(v, np.cross(v, r) + w[:, None] * r)
        np.testing.assert_allclose(points[k], truth.position[40] + turned, atol=2e-6)
    red = np.array(browser.run("viewer.robots[0].tendons.map((t) => t.colours[0])"))
    assert list(np.argsort(red)) == list(np.argsort(truth.part("tension")[40]))


def test_what_is_not_solved_is_not_drawn_as_solved(page, failed, truth):
    browser = page(failed=failed)
    browser.run("viewer.seek(2.5)")
    settled(browser)
    said = browser.run("document.getElementById('message').textContent")
    assert said == "failed: not solved from 2.000 s on (no solution found); its last solution is drawn."
    np.testing.assert_allclose(drawn_end(browser), truth.tip_position[39], atol=1e-6)
    assert browser.run("viewer.robots[0].material.opacity") < 1
    browser.run("viewer.seek(1.0)")
    settled(browser)
    assert browser.run("document.getElementById('message').hidden")
    assert browser.run("viewer.robots[0].material.opacity") == 1


def test_names_are_texts_and_nothing_else(browser, truth, tmp_path):
    evil = ["<img src=x onerror='window.hacked = 1'>", "</script><script>window.hacked = 2</script>"]
    path = export_scene(dict.fromkeys(evil, truth), tmp_path / "scene.html", title=evil[0])
    browser.open(path.as_uri())
    assert browser.run("window.hacked") is None
    assert browser.run("document.querySelectorAll('img').length") == 0
    names = browser.run("[...document.querySelectorAll('#legend button')].map((e) => e.textContent)")
    assert names == evil and browser.run("document.getElementById('title').textContent") == evil[0]


def test_a_narrow_and_a_dark_window_show_everything(page, truth, prediction, tmp_path):
    browser = page(truth=truth, prediction=prediction)
    browser.size(420, 900, dark=True)
    settled(browser)
    assert browser.run("document.documentElement.scrollWidth") <= 420
    assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(18, 22, 28)"
    assert browser.run("document.getElementById('canvas').getBoundingClientRect().height") > 300
    assert browser.errors() == []
