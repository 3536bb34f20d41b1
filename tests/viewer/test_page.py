"""The page itself, in a headless browser: it opens from a file, and draws what the trajectories say."""

import itertools

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.viewer import export_scene


@pytest.fixture(scope="module")
def page(browser, truth, prediction, failed, tmp_path_factory):
    """Opens a scene of the named trajectories."""
    folder = tmp_path_factory.mktemp("scenes")

    def opened(target=None, **trajectories):
        path = folder / f"{'-'.join(trajectories)}{'-target' if target else ''}.html"
        if not path.exists():
            export_scene(trajectories, path, target=target)
        browser.size(1280, 800)
        browser.open(path.as_uri())
        return browser

    return opened


def drawn_end(browser, robot=0):
    """The middle of the last ring of the rod that is drawn."""
    return browser.run(f"Array.from(viewer.robots[{robot}].rods[0].tube.position.slice(-3))")


def text(browser, selector):
    """Texts of all elements that a selector finds."""
    return browser.run(f"[...document.querySelectorAll({selector!r})].map((e) => e.textContent)")


def hover(browser, point):
    """Move the mouse to a drawn point, an expression of three numbers, and read what is said of it."""
    x, y = browser.run(
        f"(() => {{ const p = {point}; const camera = viewer.stage.camera;"
        " const q = camera.position.clone().set(p[0], p[1], p[2]).project(camera);"
        " const r = viewer.stage.canvas.getBoundingClientRect();"
        " return [r.x + 0.5 * (1 + q.x) * r.width, r.y + 0.5 * (1 - q.y) * r.height]; })()"
    )
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    return text(browser, "#hover > *")


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
    assert browser.run("viewer.time") == time and 0.3 <= time < 3.0
    # it stops at a row: every shape that stands still is a solution
    row = round(time / 0.05)
    assert time == truth.time[row]
    np.testing.assert_allclose(drawn_end(browser), truth.tip_position[row], atol=1e-6)
    # between two rows, what lies between them
    browser.run("viewer.seek(1.02)")
    settled(browser)
    between = [np.interp(1.02, truth.time, truth.tip_position[:, k]) for k in range(3)]
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


def test_measured_bodies_are_drawn_beside_their_prediction(page, evaluation):
    browser = page(softer=evaluation)
    it = evaluation.comparison
    browser.run("viewer.seek(1.0)")
    settled(browser)
    drawn = "viewer.robots[0].measured"
    np.testing.assert_allclose(
        browser.run(f"{drawn}.balls.map((ball) => ball.position.toArray())"), it.seen[20], atol=1e-6
    )
    centre, half = (it.band.high[20] + it.band.low[20]) / 2, (it.band.high[20] - it.band.low[20]) / 2
    np.testing.assert_allclose(
        browser.run(f"{drawn}.bands.map((it) => it.position.toArray())"), centre, atol=1e-6
    )
    np.testing.assert_allclose(
        browser.run(f"{drawn}.bands.map((it) => it.scale.toArray())"), np.maximum(half, 1e-4 * 0.6), atol=1e-4
    )
    wanted = 1e3 * it.distance[:, -1]
    np.testing.assert_allclose(
        [np.nan if x is None else x for x in browser.run("viewer.panels.errors[0].values")],
        wanted,
        rtol=1e-3,
        atol=1e-3,
    )
    said, unit = browser.run("document.getElementById('error-now').textContent").split()
    assert float(said) == pytest.approx(wanted[20], rel=1e-3) and unit == "mm"
    assert text(browser, "#legend span") == ["softer", "measured", "90 % band"]
    # a row in which a body was not seen counts for none
    browser.run("viewer.seek(1.5)")
    settled(browser)
    assert browser.run(f"{drawn}.balls.map((ball) => ball.visible)") == [False] * 3
    browser.run("viewer.seek(1.0)")
    browser.run("document.querySelector('[data-part=measured]').click()")
    settled(browser)
    assert browser.run(f"{drawn}.objects.some((it) => it.visible)") is False
    assert browser.errors() == []


def test_the_distance_of_the_tips_is_that_of_the_states(page, truth, prediction):
    browser = page(truth=truth, prediction=prediction)
    browser.run("viewer.seek(2.0)")
    settled(browser)
    wanted = 1000.0 * np.linalg.norm(truth.tip_position - prediction.tip_position, axis=1)
    np.testing.assert_allclose(browser.run("viewer.panels.errors[0].values"), wanted, rtol=1e-4)
    said = browser.run("document.getElementById('error-now').textContent")
    assert said.startswith("to truth: ") and float(said.split()[2]) == pytest.approx(wanted[40], rel=1e-3)


def test_a_comparison_opens_where_the_tips_differ_most(page, truth, prediction):
    browser = page(truth=truth, prediction=prediction)
    away = np.linalg.norm(np.asarray(truth.tip_position) - np.asarray(prediction.tip_position), axis=1)
    assert browser.run("viewer.time") == pytest.approx(float(truth.time[np.argmax(away)]))
    assert page(truth=truth).run("viewer.time") == pytest.approx(float(truth.time[0]))


def test_tubes_are_drawn_to_their_own_ends(page):
    robot = kc.load_robot("three-tube-robot")
    motion = kc.equilibrium(robot, np.zeros(6))
    browser = page(tubes=motion)
    ends = np.array(browser.run("viewer.robots[0].shapes.map((s) => Array.from(s.points.slice(-3)))"))
    radii = browser.run("viewer.robots[0].shapes.map((s) => s.radii[0])")
    position = np.asarray(motion.position)[0]
    arclength = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1)))
    for end, tube in zip(ends, robot.tubes, strict=True):
        nearest = np.argmin(np.linalg.norm(position - end, axis=1))
        # a chord of 0.3 rad, the largest here, is shorter than its arc by 0.3²/24
        assert arclength[nearest] == pytest.approx(0.3 * tube.end, rel=4e-3)
    assert radii[0] < radii[1] < radii[2] and browser.errors() == []


def test_any_state_of_any_node_is_plotted(page, truth):
    browser = page(truth=truth)
    browser.run(
        "(() => { const f = document.getElementById('field'); f.value = 'u'; f.onchange();"
        " const n = document.getElementById('node'); n.value = 4; n.oninput(); })()"
    )
    lines = browser.run("viewer.panels.statePlot.lines.map(({values}) => values)")
    np.testing.assert_allclose(np.transpose(lines), truth.part("u")[:, 4], rtol=1e-5, atol=1e-6)
    browser.run("document.getElementById('field').value = 'tension'")
    browser.run("document.getElementById('field').onchange()")
    lines = browser.run("viewer.panels.statePlot.lines.map(({values}) => values)")
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


def test_a_row_of_too_coarse_a_grid_is_drawn_faded_and_says_so(page, coarse):
    browser = page(coarse=coarse)
    browser.run("viewer.seek(1.0)")
    settled(browser)
    assert text(browser, "#message") == [""] and text(browser, ".entry small") == [""]
    assert browser.run("viewer.robots[0].material.opacity") == 1
    browser.run("viewer.seek(2.0)")
    settled(browser)
    assert text(browser, "#message") == [
        "coarse: drawn faded, because the grid is too coarse: positions are off by about 20 mm "
        "(3.15 % of the length), by estimate. Use more nodes, or position_tolerance."
    ]
    assert text(browser, ".entry small") == ["grid too coarse"]
    assert browser.run("viewer.robots[0].material.opacity") < 1
    browser.run("viewer.seek(2.5)")
    settled(browser)
    assert "the grid was too coarse in an earlier row" in text(browser, "#message")[0]
    # marks above the time slider, at the rows' times
    span = "const s = document.querySelector('#marks .coarse').style;"
    left, width = browser.run(f"(() => {{ {span} return [parseFloat(s.left), parseFloat(s.width)]; }})()")
    assert left == pytest.approx(100 * 40 / 60) and left + width == pytest.approx(100)


def test_hovering_gives_position_arclength_and_the_plotted_quantity(page, truth):
    browser = page(truth=truth)
    browser.run("viewer.seek(2.0)")
    browser.run(
        "(() => { const f = document.getElementById('field'); f.value = 'm'; f.onchange();"
        " viewer.stage.view('front'); })()"
    )
    settled(browser)
    name, place, position, moment = hover(browser, "viewer.robots[0].points.slice(12, 15)")
    assert name == "truth" and place == f"node 4, s = {100 * truth.arclength[4]:.4g} cm"
    said = [float(x) for x in position.removeprefix("position (").removesuffix(") m").split(", ")]
    np.testing.assert_allclose(said, truth.position[40, 4], atol=1e-4)
    assert moment.startswith("m: x ") and moment.endswith(" N m")
    said = [float(x.split()[-1]) for x in moment.removeprefix("m: ").removesuffix(" N m").split(", ")]
    np.testing.assert_allclose(said, truth.part("m")[40, 4], rtol=1e-3)
    # a tendon, at a node where nothing hides it
    tension = truth.part("tension")[40, 2]
    browser.run("viewer.stage.view('isometric')")
    settled(browser)
    words = hover(browser, "viewer.robots[0].tendons[2].points.slice(15, 18)")
    assert words[1].startswith("tendon 3, s = ")
    assert words[3] == f"tension {tension:.4g} N, {tension:.4g} N at the base"
    # away from everything
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=40, y=300)
    assert browser.run("document.getElementById('hover').hidden")


def test_views_look_along_the_axes_and_fit_everything(page, truth, prediction):
    browser = page(truth=truth, prediction=prediction)
    seen = (
        "(() => { const c = viewer.stage.camera; const e = c.matrixWorld.elements;"
        " c.updateMatrixWorld(); return [e[0], e[1], e[2], e[4], e[5], e[6]]; })()"
    )
    for key, right, up in (("1", "x", "z"), ("2", "y", "z"), ("3", "x", "y")):
        browser.run(f"document.dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}'}}))")
        axes = np.eye(3)
        wanted = [*axes["xyz".index(right)], *axes["xyz".index(up)]]
        np.testing.assert_allclose(browser.run(seen), wanted, atol=2e-4)
    corners = (
        "(() => { const b = viewer.stage.bounds(); const c = viewer.stage.camera; const all = [];"
        " for (const x of [b.min.x, b.max.x]) for (const y of [b.min.y, b.max.y])"
        " for (const z of [b.min.z, b.max.z])"
        " { const p = c.position.clone().set(x, y, z).project(c); all.push(p.x, p.y); }"
        " return all; })()"
    )
    for name in ("front", "side", "top", "isometric"):
        browser.run(f"document.querySelector('[data-view={name}]').click()")
        settled(browser)
        reach = np.abs(browser.run(corners))
        assert 0.6 < np.max(reach) < 1.0
    # what is hidden does not count
    before = browser.run("viewer.stage.camera.position.length()")
    browser.run("document.querySelectorAll('#legend button')[0].click()")
    browser.run("document.getElementById('fit').click()")
    assert browser.run("viewer.stage.camera.position.length()") < before


def test_a_target_is_marked_and_every_tip_has_its_distance(page, truth, prediction):
    target = (0.1, 0.05, 0.6)
    browser = page(truth=truth, prediction=prediction, target=target)
    browser.run("viewer.seek(2.0)")
    settled(browser)
    assert browser.run("viewer.stage.target.position.toArray()") == list(target)
    assert text(browser, ".entry.target") == ["✛target (0.1, 0.05, 0.6) m"]
    said = text(browser, ".entry small")
    for words, each in zip(said, (truth, prediction), strict=True):
        distance = 1000 * np.linalg.norm(each.tip_position[40] - target)
        assert words == f"tip to target {distance:.4g} mm"


def test_the_legend_and_the_tensions_name_every_robot(page, truth, prediction):
    browser = page(truth=truth, prediction=prediction)
    browser.run("viewer.seek(2.0)")
    settled(browser)
    assert text(browser, "#legend button") == ["truth", "prediction"]
    tensions = " ".join(f"{k + 1}: {x:.2f}" for k, x in enumerate(truth.part("tension")[40]))
    shown = "[...document.querySelectorAll('.tensions')].filter((e) => !e.hidden)"
    cells = f"{shown}.map((e) => [...e.querySelectorAll('span')].map((s) => s.textContent).join(' '))"
    assert browser.run(cells) == [tensions]  # both have the same
    browser.run("viewer.robots[1].baseTensions = () => [1, 2, 3, 4]; viewer.stage.dirty = true")
    settled(browser)
    assert browser.run(cells) == [tensions, "1: 1.00 2: 2.00 3: 3.00 4: 4.00"]
    browser.run("document.querySelectorAll('#legend button')[1].click()")
    settled(browser)
    assert browser.run(cells) == [tensions]


def test_components_have_colours_of_their_own(page, truth):
    browser = page(truth=truth)
    colours = browser.run("viewer.panels.statePlot.lines.map(({colour}) => colour)")
    assert colours == browser.run("import('viewer/colours').then((m) => m.axisColours())")
    browser.run("document.getElementById('colour-rods').click()")
    settled(browser)
    assert browser.run("viewer.robots[0].material.vertexColors") is True
    assert text(browser, "#quantity span, #quantity b")[0] == "|p|"
    browser.run("document.getElementById('colour-rods').click()")
    settled(browser)
    assert browser.run("viewer.robots[0].material.vertexColors") is False
    assert browser.errors() == []


#: linear RGB as it is seen without one kind of cones (Machado, Oliveira and Fernandes 2009)
DEFICIENCIES = {
    "none": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                   [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                     [-0.011820, 0.042940, 0.968881]],
}  # fmt: skip


def lab(colour, seen):
    """CIE L*a*b* of a colour "#rrggbb"."""
    rgb = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    linear = np.clip(np.asarray(seen) @ linear, 0, 1)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ linear
    xyz /= [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_the_first_six_robots_and_the_axes_are_told_apart_by_everybody(page, truth):
    browser = page(truth=truth)
    found = browser.run("import('viewer/colours').then(({ROBOTS, AXES}) => ({ROBOTS, AXES}))")
    for palette in found.values():
        for colours in palette.values():
            assert len(set(colours)) == len(colours)
            for deficiency, matrix in DEFICIENCIES.items():
                seen = [lab(colour, matrix) for colour in colours[:6]]
                for a, b in itertools.combinations(seen, 2):
                    # a difference of 2.3 is just noticeable
                    assert np.linalg.norm(a - b) > 14, deficiency


#: kind, size and first bytes of a blob
ABOUT = "[blob.type, blob.size, Array.from(new Uint8Array(await blob.slice(0, 4).arrayBuffer()))]"


def test_the_picture_is_exported_as_it_is(page, truth):
    browser = page(truth=truth)
    # sought, but not drawn yet
    kind, size, head = browser.run(
        f"(async () => {{ viewer.seek(2.0); const blob = await viewer.picture(); return {ABOUT}; }})()"
    )
    assert kind == "image/png" and size > 20_000 and bytes(head) == b"\x89PNG"
    np.testing.assert_allclose(drawn_end(browser), truth.tip_position[40], atol=1e-6)
    assert browser.run("viewer.capture.canvas.width === 2 * viewer.stage.canvas.parentElement.clientWidth")
    assert browser.errors() == []


def test_a_video_is_recorded_where_the_browser_can(page, truth):
    browser = page(truth=truth)
    if browser.run("import('viewer/capture').then((m) => m.videoFormat())") is None:
        pytest.skip("this browser cannot record WebM")
    kind, size, head = browser.run(
        "(async () => { viewer.capture.start(); viewer.play();"
        " for (let k = 0; k < 200 && !viewer.capture.parts.length; k++)"
        " await new Promise((done) => setTimeout(done, 100));"
        " const blob = await viewer.capture.stop();"
        f" return {ABOUT}; }})()"
    )
    assert kind == "video/webm" and size > 1000 and bytes(head) == b"\x1a\x45\xdf\xa3"
    assert browser.errors() == []


def test_without_a_recorder_the_page_says_so(page, truth):
    browser = page(truth=truth)
    browser.run("window.MediaRecorder = undefined; document.getElementById('video').click()")
    settled(browser)
    assert text(browser, "#message")[0].startswith("This browser cannot record video")


def test_the_hint_goes_away_with_the_first_use(page, truth):
    browser = page(truth=truth)
    assert browser.run("document.getElementById('hint').hidden") is False
    assert "Left button: turn." in text(browser, "#hint")[0]
    browser.mouse("mousePressed", 300, 400)
    browser.mouse("mouseReleased", 300, 400)
    assert browser.run("document.getElementById('hint').hidden") is True
    browser.run("document.dispatchEvent(new KeyboardEvent('keydown', {key: '?'}))")
    assert browser.run("document.getElementById('hint').hidden") is False


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
