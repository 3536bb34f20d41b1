"""A closed loop whose target a page moves: its messages, its record, its export, and its page."""

import asyncio
import base64
import contextlib
import gzip
import io
import json
import re
import threading
import time

import numpy as np
import pandas as pd
import pytest

import knode_cosserat as kc
from knode_cosserat.control import ControlLimits, PredictiveController, Sensor, SimulatedPlant, SoftLimit
from knode_cosserat.estimation import KalmanObserver, TipPose, TipPosition
from knode_cosserat.viewer.closed_loop import STATUSES, FollowedTarget, LoopSession, loop_page
from knode_cosserat.viewer.pages import document
from tests.commands import run
from tests.viewer.connection import Connection, numbers

pytestmark = pytest.mark.slow

DT, LIMITS = 0.05, ControlLimits(0.0, 10.0, 40.0)
#: (m) reached without a limit; and one that is out of reach
NEAR, FAR = [0.08, 0.04, None], [0.3, 0.1, 0.9]


def controller_of(robot, **options):
    # the programs of tests/control
    observer = KalmanObserver(robot, DT, TipPosition(), adapt=["youngs_modulus"])
    return PredictiveController(observer, TipPosition(), LIMITS, **options)


def plant_of(robot):
    softer = robot.replace(youngs_modulus=0.9 * float(robot.youngs_modulus))
    return SimulatedPlant(softer, DT, Sensor(TipPosition(), noise=0.5))


@pytest.fixture(scope="module")
def loop(robot):
    return FollowedTarget(controller_of(robot), plant_of(robot), "a robot")


@pytest.fixture
def followed(loop):
    loop.position = loop.start
    loop.thread.submit(loop.restart).result()  # after the last period of the test before
    return loop


def converse(followed, talk, **session):
    """Run a session with a page that talks: `talk` gets the connection and the session."""

    async def both():
        connection = Connection()
        own = LoopSession(followed, connection)
        running = asyncio.create_task(own.run())
        try:
            return await talk(connection, own)
        finally:
            running.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running

    return asyncio.run(both())


def column(followed, frame, name):
    first, size = followed.facts.columns[name]
    own = numbers(frame)[1][-followed.facts.width :]
    return own[first : first + size]


def is_frame(said):
    return not isinstance(said, dict)


def test_a_dragged_target_moves_the_reference_and_the_robot_follows(followed):
    async def talk(connection, session):
        connection.given.put_nowait({"target": NEAR, "sequence": 3})
        first = await connection.until(lambda head: is_frame(head) and head[0] == 3)
        last = await connection.until(lambda head: is_frame(head) and head[1] > 2.0)
        return first, last

    first, last = converse(followed, talk)
    np.testing.assert_array_equal(column(followed, first, "target"), np.float32([0.08, 0.04, np.nan]))
    log = followed.loop.log()
    assert np.all(np.isnan(log.reference[-10:, 2]))  # the height is free, also in the log
    apart = np.linalg.norm(log.tip[-10:, :2] - np.array(NEAR[:2]), axis=1)
    assert apart.max() < 3e-3
    assert log.control.min() >= 0.0 and log.control.max() <= 10.0
    assert column(followed, last, "status")[0] == STATUSES.index("optimal")
    np.testing.assert_allclose(column(followed, last, "control"), log.control[-1], atol=0.5)
    path = column(followed, last, "path").reshape(-1, 3)
    assert path.shape == (20, 3) and np.linalg.norm(path[-1, :2] - np.array(NEAR[:2])) < 5e-3
    # the first row's numbers are the true robot's, then come the estimate's
    row, width = numbers(last)[1], 190 + 60 + 4
    tips = [row[k * width + 171 : k * width + 174] for k in range(2)]
    np.testing.assert_allclose(tips[0], tips[1], atol=2e-3)


def test_a_target_out_of_reach_is_approached(followed):
    async def talk(connection, session):
        connection.given.put_nowait({"target": FAR, "sequence": 1})
        await connection.until(lambda head: is_frame(head) and head[1] > 2.5)

    converse(followed, talk)
    log = followed.loop.log()
    distance, direction = log.tip_distance, np.array(FAR[:2]) / np.linalg.norm(FAR[:2])
    assert distance[-1] < distance[0] - 0.02  # no rod of this length gets there
    assert np.ptp(distance[-10:]) < 5e-3
    bent = log.tip[-1, :2] / np.linalg.norm(log.tip[-1, :2])
    assert bent @ direction > 0.99
    assert log.fallbacks == 0


#: messages of a hostile page, and a part of their answers
HOSTILE = (
    ({"target": [float("nan"), 0.0, 0.0], "sequence": 1}, "three finite numbers"),
    ('{"target": [1e999, 0, 0], "sequence": 1}', "three finite numbers"),
    ({"target": [10**400, 0, 0], "sequence": 1}, "three finite numbers"),
    ({"target": [100.0, 0.0, 0.0], "sequence": 1}, "target must be within 12.7 m of the origin"),
    ({"target": [None, None, None], "sequence": 1}, "at least one number"),
    ({"target": ["0.1", 0.0, 0.0], "sequence": 1}, "three numbers in m"),
    ({"target": [0.1, 0.0], "sequence": 1}, "three numbers in m"),
    ({"target": {"x": 1}, "sequence": 1}, "three numbers in m"),
    ({"target": [0.1, 0.0, 0.5]}, "the message has no 'sequence'"),
    ({"target": [0.1, 0.0, 0.5], "sequence": 10**30}, "sequence must be"),
    ({"sequence": 1}, "the message has no 'target'"),
    ({"command": "cancel"}, "allowed is pause, resume, reset, export or log"),
    ({"command": ["reset"]}, "allowed is pause"),
    ([1, 2], "must be an object"),
    ("{", "Expecting property name"),
    ("[" * 3000, "nested too deeply"),
    ({"target": "x" * 5000, "sequence": 1}, "allowed are 4096"),
)


def test_a_hostile_message_is_answered_by_one_line(followed):
    async def talk(connection, session):
        session.paused = True
        answers = []
        for message, _ in HOSTILE:
            connection.given.put_nowait(message)
            answers.append(await connection.until(lambda said: isinstance(said, dict) and "error" in said))
        return [json.loads(each)["error"] for each in answers]

    for answer, (message, error) in zip(converse(followed, talk), HOSTILE, strict=True):
        assert error in answer and "\n" not in answer and len(answer) < 250, message
    assert followed.position is followed.start


def test_pause_holds_the_time_and_reset_starts_again(followed):
    async def talk(connection, session):
        give = connection.given.put_nowait
        await connection.until(lambda head: is_frame(head) and head[1] > 3 * DT)
        give({"command": "pause"})
        # a step that was under way ends first, on a busy machine some time later
        stopped = None
        while stopped != followed.loop.time:
            stopped = followed.loop.time
            await asyncio.sleep(10 * DT)
        give({"target": NEAR, "sequence": 1})
        await asyncio.sleep(3 * DT)
        assert followed.loop.time == stopped and followed.position[0] == NEAR[0]
        give({"command": "resume"})
        await connection.until(lambda head: is_frame(head) and head[0] == 1 and head[1] > stopped)
        moved = len(followed.moments)
        give({"command": "reset"})
        await connection.until(lambda head: is_frame(head) and head[1] == 0.0)
        assert len(followed.moments) < moved
        assert followed.position[0] == NEAR[0]  # the page sends its own target

    converse(followed, talk)


def scene_of(text):
    return json.loads(re.search(r'id="scene">(.*?)</script>', text, re.DOTALL)[1])


def decoded(packed):
    """An array of a scene, decoded without the code that wrote it."""
    raw = np.frombuffer(gzip.decompress(base64.b64decode(packed["bytes"])), np.uint8)
    values = raw.reshape(4, -1).T.copy().view("<f4").ravel()
    return values.reshape(-1, packed["shape"][0]).T.reshape(packed["shape"])


def test_the_exported_file_and_the_log_are_the_run(followed):
    async def talk(connection, session):
        give = connection.given.put_nowait
        session.paused = True
        give({"command": "export"})
        nothing = await connection.until(lambda said: isinstance(said, dict) and "error" in said)
        assert json.loads(nothing)["error"] == "no period has passed; there is nothing to export"
        give({"target": NEAR, "sequence": 1})
        give({"command": "resume"})
        await connection.until(lambda head: is_frame(head) and head[1] > 0.5)
        give({"command": "pause"})
        # the period that has begun ends
        count = -1
        while count != (count := len(followed.loop.log().time)):
            await asyncio.sleep(5 * DT)
        files = []
        for command in ("export", "log"):
            give({"command": command})
            files.append(await connection.until(lambda said: isinstance(said, dict) and "file" in said))
        return [json.loads(each)["file"] for each in files]

    page, table = converse(followed, talk)
    log = followed.loop.log()
    shown = scene_of(page["text"])
    assert page["name"] == "run.html" and "connect-src 'none'" in page["text"] and "live" not in shown
    overlays = {each["name"]: each["overlay"] for each in shown["tracks"]}
    assert overlays == {"robot": False, "estimate": True}
    rows = decoded(shown["loop"]["rows"])
    assert len(rows) == len(log.time)
    first, size = shown["loop"]["columns"]["control"]
    np.testing.assert_array_equal(rows[:, first : first + size], log.control.astype(np.float32))
    tips = decoded(shown["tracks"][0]["arrays"]["y"])[:, -1, :3]
    np.testing.assert_array_equal(tips, log.tip.astype(np.float32))
    assert shown["loop"]["parameters"] == [{"name": "youngs_modulus", "unit": "Pa"}]
    assert table["name"] == "log.csv"
    written = pd.read_csv(io.StringIO(table["text"]))
    np.testing.assert_allclose(written["control 1"], log.control[:, 0])
    # a free coordinate of the first target has the tip's value in the picture
    assert np.all(np.isfinite(shown["target"]))
    assert len(document(followed.scene())) > 1e6


def test_messages_are_answered_during_a_slow_period(followed, monkeypatch):
    period = FollowedTarget.period
    monkeypatch.setattr(FollowedTarget, "period", lambda self: (time.sleep(0.6), period(self))[1])

    async def talk(connection, session):
        await connection.until(lambda said: isinstance(said, dict) and "solving" in said)
        began = time.monotonic()
        connection.given.put_nowait({"command": "rm"})
        await connection.until(lambda said: isinstance(said, dict) and "error" in said)
        assert time.monotonic() - began < 0.25
        await connection.until(lambda head: is_frame(head) and head[1] > 0.0)
        assert followed.loop.missed >= 1

    converse(followed, talk)


def test_a_robot_that_is_not_solved_stands_until_it_starts_again(followed, monkeypatch):
    apply = SimulatedPlant.apply

    def fails(self, control):
        raise kc.SimulationError(1, 0.0, 1.0, kc.Result.NO_CONVERGENCE, "a test")

    async def talk(connection, session):
        await connection.until(lambda head: is_frame(head) and head[1] > 0.0)
        monkeypatch.setattr(SimulatedPlant, "apply", fails)
        said = await connection.until(lambda said: isinstance(said, dict) and "unsolved" in said)
        assert json.loads(said)["unsolved"].startswith("The robot was not solved: ")
        monkeypatch.setattr(SimulatedPlant, "apply", apply)
        connection.given.put_nowait({"command": "reset"})
        await connection.until(lambda head: is_frame(head) and head[1] > 0.0)

    converse(followed, talk)


def test_a_fallback_is_shown_with_its_reason(robot, monkeypatch):
    monkeypatch.setattr("knode_cosserat.control.qp.solve", lambda problem: None)
    followed = FollowedTarget(controller_of(robot), plant_of(robot), "a robot")

    async def talk(connection, session):
        reason = await connection.until(lambda said: isinstance(said, dict) and "reason" in said)
        frame = await connection.until(lambda head: is_frame(head) and head[1] > 11 * DT)
        return json.loads(reason)["reason"], frame

    reason, frame = converse(followed, talk)
    assert reason == "the quadratic program was not solved"
    assert column(followed, frame, "status")[0] == STATUSES.index("going safe")
    assert np.all(np.isnan(column(followed, frame, "path")))
    assert {moment.reason for moment in followed.moments} == {reason}


def test_a_second_page_takes_over(followed):
    async def talk(connection, session):
        await connection.until(lambda head: is_frame(head) and head[1] > 0.0)
        second = Connection()
        running = asyncio.create_task(LoopSession(followed, second).run())
        said = await connection.until(lambda said: isinstance(said, dict) and "ended" in said)
        assert json.loads(said)["ended"].startswith("Another page moves the target now.")
        await second.until(lambda head: is_frame(head) and head[1] > 0.0)
        running.cancel()

    converse(followed, talk)


def test_what_cannot_be_followed_is_refused_in_one_line(robot):
    observer = KalmanObserver(robot, DT, TipPosition())
    posed = PredictiveController(observer, TipPose(), LIMITS)
    with pytest.raises(ValueError, match="the page moves a position of the tip: use TipPosition"):
        FollowedTarget(posed, plant_of(robot), "a robot")


def test_only_the_estimate_is_drawn_of_a_plant_that_does_not_know_its_shape(robot):
    class Hidden(SimulatedPlant):
        @property
        def state(self):
            raise AttributeError

    followed = FollowedTarget(controller_of(robot), Hidden(robot, DT, Sensor(TipPosition())), "a robot")

    async def talk(connection, session):
        await connection.until(lambda head: is_frame(head) and head[1] > 0.1)

    converse(followed, talk)
    shown = followed.scene()
    assert [(each["name"], each["overlay"]) for each in shown["tracks"]] == [
        ("estimate (the true shape is unknown)", False)
    ]
    pid = kc.control.controller_named("pid", robot, DT, LIMITS)
    with pytest.raises(
        ValueError, match=r"^there is no shape to draw: .* Use a controller such as predictive$"
    ):
        FollowedTarget(pid, Hidden(robot, DT, Sensor(TipPosition())))


def test_the_page_knows_limits_and_soft_limits(robot):
    soft = [SoftLimit(TipPosition(), [-0.1, -np.inf, 0.2], np.inf)]
    own = controller_of(robot, soft=soft)
    # without a loop: nothing is compiled for another set of limits
    from knode_cosserat.viewer.closed_loop import LoopFacts

    facts = LoopFacts.of(own, robot, np.zeros(4)).for_page()
    assert facts["soft"] == [[-0.1, None, 0.2], [None, None, None]]
    assert [(each["low"], each["high"]) for each in facts["controls"]] == [(0.0, 10.0)] * 4
    json.dumps(facts, allow_nan=False)


def test_the_command_states_what_it_needs():
    for options, error in (
        ((), "give either --reference, or --live"),
        (("--live", "--reference", "circle:radius=0.1,period=4"), "give either --reference, or --live"),
        (("--reference", "circle:radius=0.1,period=4", "--port", 80), "use them with --live"),
    ):
        result = run("control", "delrin-tendon-robot", *options)
        assert result.exit_code != 0 and error in result.stderr and result.stderr.count("\n") == 1


# the page

TARGET = (
    "(() => { const s = viewer.stage, r = s.canvas.getBoundingClientRect();"
    " const p = s.project(s.target.position.toArray(), 0, s.cellAt(5, 5));"
    " return [p.x + r.left, p.y + r.top]; })()"
)


@pytest.fixture(scope="module")
def address(loop):
    from knode_cosserat.viewer.pages import serve_page

    found, known = [], threading.Event()

    def ready(address):
        found.append(address)
        known.set()

    def serve():
        page = loop_page(loop)
        asyncio.run(serve_page(page, lambda connection: LoopSession(loop, connection), 0, ready))

    threading.Thread(target=serve, daemon=True).start()
    assert known.wait(60)
    return found[0]


def test_the_target_is_dragged_and_the_robot_follows(browser, address, loop, tmp_path):
    loop.position = loop.start
    browser.size(1280, 860)
    browser.open(address)
    browser.wait(lambda: browser.run("viewer.time > 0.2"))
    turned = browser.run("viewer.stage.camera.position.toArray()")
    x, y = browser.run(TARGET)
    browser.mouse("mouseMoved", x, y)
    browser.mouse("mousePressed", x, y)
    for k in range(1, 7):
        browser.mouse("mouseMoved", x + 12 * k, y + 3 * k)
    browser.mouse("mouseReleased", x + 72, y + 18)
    target = browser.run("viewer.live.target")
    assert np.linalg.norm(np.array(target) - loop.start) > 0.05
    assert browser.run(TARGET) == pytest.approx([x + 72, y + 18], abs=0.5)
    assert browser.run("viewer.stage.camera.position.toArray()") == turned  # the camera stays
    near = "Math.hypot(...viewer.tip().map((p, k) => p - viewer.live.target[k]))"
    browser.wait(lambda: browser.run(near) < 0.02)
    words = browser.run("document.getElementById('sliders').innerText")
    assert "optimal" in words and "youngs_modulus" in words and "missed deadlines" in words
    # elsewhere the camera turns
    browser.mouse("mousePressed", x - 150, y + 150)
    browser.mouse("mouseMoved", x - 100, y + 150)
    browser.mouse("mouseReleased", x - 100, y + 150)
    assert browser.run("viewer.stage.camera.position.toArray()") != turned
    browser.run("document.getElementById('reset').click()")
    browser.wait(lambda: browser.run("viewer.time") < 0.5)
    assert browser.run("viewer.live.target") == pytest.approx(loop.start)
    browser.wait(lambda: browser.run("viewer.time > 0.2"))
    assert browser.errors() == []
    file = tmp_path / "run.html"
    file.write_text(document(loop.scene()), encoding="utf-8")
    browser.open(file.as_uri())
    assert browser.run("document.querySelector('.badge').textContent") == "optimal"
    assert browser.run("viewer.robots.map((r) => r.overlay)") == [False, True]
    assert browser.errors() == []
