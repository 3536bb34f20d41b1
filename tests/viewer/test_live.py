"""A robot that follows sliders: the page, what it says to the simulation, and who may speak to that."""

import asyncio
import dataclasses
import json
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.passport import Origin, Passport
from knode_cosserat.viewer import view_live
from knode_cosserat.viewer.live import MOST_PER_SECOND, Session, require_websockets, usual_step
from knode_cosserat.viewer.pages import MOST_PAGES
from tests.viewer.connection import Connection, numbers

websockets = pytest.importorskip("websockets", reason="the live mode is of the extra viz")
DT = 0.05


@pytest.fixture(scope="module")
def address(robot):
    found, known = [], threading.Event()

    def ready(address):
        found.append(address)
        known.set()

    threading.Thread(target=view_live, args=(robot,), kwargs={"open_browser": ready}, daemon=True).start()
    assert known.wait(120)
    return found[0]


@pytest.fixture
def session(robot):
    return Session(kc.solvers.Stepper(robot, DT), None)


def solve(session, control, sequence, over):
    """Solve as the session's clock does; the message, and whether there is no solution."""
    message, session.stepper, stuck = session.attempt(control, sequence, over)
    return message, stuck


def test_a_frame_is_the_step_in_progress_under_the_newest_control(session, robot):
    first, then = np.array([7.0, 5.0, 5.0, 7.0]), np.array([5.0, 7.0, 7.0, 5.0])
    stepper = kc.solvers.Stepper(robot, DT)
    # both of the same step, until it is over
    for sequence, control in ((1, first), (2, then)):
        message, stuck = solve(session, control, sequence, over=False)
        wanted = stepper.preview(control)
        head, row = numbers(message)
        assert not stuck and head[0] == sequence and head[1] == np.float32(DT)
        np.testing.assert_array_equal(row[:190], wanted.y.astype(np.float32).ravel())
        np.testing.assert_array_equal(row[-4:], control)
    message, _ = solve(session, then, 3, over=True)
    stepper.step(then)
    head, row = numbers(message)
    assert head[1] == np.float32(2 * DT)
    np.testing.assert_array_equal(row[:190], stepper.preview(then).y.astype(np.float32).ravel())


def test_what_cannot_be_solved_is_said_and_nothing_moves(session):
    # in another unit: a thousand times less is solved, on a grid too coarse for it
    fair, hopeless = np.full(4, 6.0), np.array([1e9, 0.0, 0.0, 1e9])
    for _ in range(2):
        solve(session, fair, 1, over=True)
    before = session.stepper.state
    for count in range(1, 10):
        message, stuck = solve(session, hopeless, 7, over=count > 1)
        reached = session.stepper.state
        if stuck:
            break
    assert stuck
    said = json.loads(message)
    assert said["sequence"] == 7 and said["unsolved"].startswith("Not solved: no solution found.")
    assert session.stepper.state is reached and (count > 1 or reached is before)
    message, stuck = solve(session, fair, 8, over=False)
    assert not stuck and np.all(np.isfinite(numbers(message)[1]))


#: first tension (N) at which the tests' solves end only when they are cancelled
SLOW = 11.0


@pytest.fixture
def slow_solves(monkeypatch):
    """Solves above `SLOW` never end by themselves; the list has the sequence numbers of those that ended."""
    attempt, ended = Session.attempt, []

    def waits(self, control, sequence, over, stop=None):
        while control[0] > SLOW and not stop():
            time.sleep(0.002)
        if control[0] > SLOW:
            ended.append(sequence)
        return attempt(self, np.minimum(control, SLOW), sequence, over, stop)

    monkeypatch.setattr(Session, "attempt", waits)
    return ended


def test_a_slow_solve_is_cancelled_or_replaced_by_a_newer_control(robot, slow_solves):
    async def moved():
        connection = Connection()
        own = Session(kc.solvers.Stepper(robot, DT), connection)
        running = asyncio.create_task(own.run())
        give = connection.given.put_nowait
        try:
            give({"control": [SLOW + 1, 6.0, 6.0, 6.0], "sequence": 1})
            await connection.until(lambda said: said == {"solving": 1})
            give({"command": "cancel"})
            message = await connection.until(lambda said: isinstance(said, dict) and "unsolved" in said)
            assert json.loads(message)["unsolved"].startswith("Cancelled: the last solved shape is shown.")
            stepper = own.stepper
            give({"command": "pause"})
            give({"command": "resume"})
            await asyncio.sleep(2.5 * DT)
            assert own.stepper is stepper  # the clock stands still, and the same control is not tried again
            give({"control": [7.0, 6.0, 6.0, 6.0], "sequence": 2})
            await connection.until(lambda head: not isinstance(head, dict) and head[0] == 2)
            # replaced without being cancelled, and the newest of several
            give({"control": [SLOW + 1, 6.0, 6.0, 6.0], "sequence": 3})
            await connection.until(lambda said: said == {"solving": 3})
            for sequence in (4, 5):
                give({"control": [6.5, 6.0, 6.0, float(sequence)], "sequence": sequence})
            message = await connection.until(lambda head: not isinstance(head, dict) and head[0] >= 4)
            head, row = numbers(message)
            assert head[0] == 5 and row[-1] == 5.0
            # a reset also ends it
            give({"control": [SLOW + 1, 6.0, 6.0, 6.0], "sequence": 6})
            await connection.until(lambda said: said == {"solving": 6})
            give({"control": [6.0] * 4, "sequence": 7})
            give({"command": "reset"})
            message = await connection.until(lambda head: not isinstance(head, dict) and head[0] == 7)
            assert numbers(message)[0][1] == np.float32(DT)
            # dropped solves end: nothing goes on in the background
            async with asyncio.timeout(30.0):
                while len(slow_solves) < 3:
                    await asyncio.sleep(0.002)
        finally:
            running.cancel()

    asyncio.run(moved())
    assert slow_solves == [1, 3, 6]


def test_a_cancelled_recovery_ends_without_a_solution_and_changes_nothing(robot):
    stepper = kc.solvers.Stepper(robot, DT)
    before = stepper.state
    with pytest.raises(kc.SimulationError):
        stepper.step([1e9, 0.0, 0.0, 1e9], stop=lambda: True)
    assert stepper.state is before and stepper.time == 0.0
    # a step that needs no recovery is not affected
    assert stepper.step([6.0] * 4, stop=lambda: True).result[0] == kc.Result.CONVERGED


def test_a_shape_with_a_meaningless_error_is_neither_drawn_nor_kept(session, robot, monkeypatch):
    preview, error = kc.solvers.Stepper.preview, 0.3 * float(robot.length)
    monkeypatch.setattr(
        kc.solvers.Stepper,
        "preview",
        lambda *given: dataclasses.replace(preview(*given), position_error=np.array([error])),
    )
    before = session.stepper
    message, stuck = solve(session, np.full(4, 6.0), 3, over=False)
    assert stuck and session.stepper is before
    assert json.loads(message)["unsolved"].startswith(
        "Not solved: the grid of 10 nodes is too coarse, positions would be off by about 0.19 m (30% of"
    )


def test_a_control_outside_its_range_is_said_and_the_session_goes_on(session):
    message, stuck = solve(session, np.array([np.inf, 6.0, 6.0, 6.0]), 3, over=False)
    assert stuck and json.loads(message)["unsolved"].startswith("Not solved: the control is")


def test_a_model_moves_at_the_step_it_learned_at(robot):
    model = kc.KNODE(robot, None)
    assert usual_step(robot) == usual_step(model) == 0.05
    known = Passport("fit", (Origin("a", "0", 9, learned=False), Origin("b", "1", 31, 0.6)))
    assert usual_step(kc.KNODE(robot, None, passport=known)) == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ({"control": [1.0], "sequence": 1}, "4 finite numbers"),
        ({"control": [1.0, 2.0, 3.0, None], "sequence": 1}, "4 finite numbers"),
        ({"control": ["x"] * 4, "sequence": 1}, "could not convert"),
        ({"command": "rm"}, "command is 'rm'"),
    ],
)
def test_a_wrong_message_changes_nothing(session, message, error):
    before = session.control.copy()
    with pytest.raises(ValueError, match=error):
        session.understand(message)
    np.testing.assert_array_equal(session.control, before)


def test_without_its_package_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "websockets.asyncio.server", None)
    with pytest.raises(
        ImportError, match=r"^the live mode needs websockets: pip install 'knode-cosserat\[viz\]'$"
    ):
        require_websockets()


def test_only_its_own_page_may_speak_to_it(address):
    from websockets.asyncio.client import connect

    async def speak(origin, **headers):
        async with connect(
            address.replace("http", "ws") + "live", origin=origin, additional_headers=headers
        ) as own:
            await own.send(json.dumps({"sequence": 5, "control": [6.0] * 4}))
            while True:
                message = await asyncio.wait_for(own.recv(), 30)
                if isinstance(message, bytes) and numbers(message)[0][0] == 5:
                    return numbers(message)

    head, row = asyncio.run(speak(address.rstrip("/")))
    assert head[2] >= 0 and np.all(np.isfinite(row))
    for origin in ("http://elsewhere.example", None):
        with pytest.raises(websockets.exceptions.InvalidStatus, match="HTTP 403"):
            asyncio.run(speak(origin))


def test_under_another_name_it_answers_nothing(address):
    request = urllib.request.Request(address, headers={"Host": "elsewhere.example"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request)
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(address + "pyproject.toml")


def test_a_slider_bends_the_robot_that_is_drawn(browser, address, robot):
    browser.size(1280, 800)
    browser.open(address)
    browser.wait(lambda: browser.run("viewer.time > 0.2"))
    before = np.array(browser.run("viewer.tip()"))
    browser.drag(".slider:nth-child(1) input[type=range]", 0.7)
    browser.wait(lambda: np.linalg.norm(np.array(browser.run("viewer.tip()")) - before) > 0.03)
    control = browser.run("viewer.live.control")
    assert control[0] > 6.5 and control[1:] == [6.0, 6.0, 6.0]
    rest = kc.simulate(robot, np.tile(control, (100, 1)), DT).tip_position[-1]

    def settled():
        return np.linalg.norm(np.array(browser.run("viewer.tip()")) - rest) < 2e-3

    assert browser.wait(settled)
    assert browser.run("viewer.live.latencies.length") > 0
    assert browser.errors() == []


def test_all_tendons_are_one_group_and_visible_at_once(browser, address):
    browser.size(1280, 800)
    browser.open(address)
    titles = browser.run("[...document.querySelectorAll('#sliders h3')].map((e) => e.textContent)")
    assert titles == ["tendon tension (N)"]
    boxes = browser.run(
        "[...document.querySelectorAll('.slider')].map((e) => { const r = e.getBoundingClientRect();"
        " return [e.querySelector('span').textContent, r.top, r.bottom]; })"
    )
    assert [box[0] for box in boxes] == ["1", "2", "3", "4"]
    assert all(0 <= top < bottom <= 800 for _, top, bottom in boxes)


def test_the_page_shows_a_slow_solve_and_escape_cancels_it(browser, address, slow_solves):
    browser.open(address)
    browser.wait(lambda: browser.run("viewer.time > 0.2"))
    pull = (
        "(() => { const n = document.querySelectorAll('.slider input[type=number]')[%d]; n.value = %s;"
        " n.dispatchEvent(new Event('change')); })()"
    )
    solving = "document.getElementById('solving').textContent"
    assert browser.run("document.getElementById('cancel').disabled") is True
    browser.run(pull % (0, SLOW + 1))
    browser.wait(lambda: browser.run(solving).startswith("solving… "))
    assert browser.run("document.getElementById('cancel').disabled") is False
    browser.run("document.dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape'}))")
    message = "document.getElementById('message').textContent"
    browser.wait(lambda: browser.run(message).startswith("Cancelled: the last solved shape is shown."))
    assert browser.run(solving) == "" and browser.run("document.getElementById('cancel').disabled") is True
    browser.wait(lambda: browser.run("viewer.robots[0].material.opacity") < 1)
    tip = browser.run("viewer.tip()")
    assert np.all(np.isfinite(tip))
    browser.run(pull % (0, 7))
    browser.wait(lambda: browser.run(message) == "" and browser.run("viewer.robots[0].material.opacity") == 1)
    assert browser.errors() == []


def test_it_stops_and_starts_again(browser, address):
    browser.open(address)
    browser.wait(lambda: browser.run("viewer.time > 0.2"))
    browser.run("document.getElementById('play').click()")
    browser.run("new Promise((done) => setTimeout(done, 300))")
    stopped = browser.run("viewer.time")
    browser.run("new Promise((done) => setTimeout(done, 300))")
    assert browser.run("viewer.time") == stopped
    browser.run("document.getElementById('reset').click(); document.getElementById('play').click()")
    browser.wait(lambda: browser.run("viewer.time") < stopped)
    assert browser.errors() == []


@pytest.mark.campaign
def test_the_page_says_what_cannot_be_solved_and_goes_on_after_it(browser, address):
    browser.open(address)
    browser.wait(lambda: browser.run("viewer.time > 0.2"))
    pull = (
        "(() => { const n = document.querySelectorAll('.slider input[type=number]')[0]; n.value = %s;"
        " n.dispatchEvent(new Event('change')); })()"
    )
    browser.run(pull % 1e6)
    browser.wait(lambda: "Not solved" in browser.run("document.getElementById('message').textContent"), 120)
    tip = browser.run("viewer.tip()")
    browser.run("new Promise((done) => setTimeout(done, 500))")
    assert browser.run("viewer.tip()") == tip and np.all(np.isfinite(tip))
    browser.run(pull % 7)
    browser.wait(lambda: browser.run("document.getElementById('message').hidden"), 60)
    assert browser.wait(lambda: browser.run("viewer.tip()") != tip)


@pytest.mark.slow
def test_no_more_pages_are_served_than_can_be_solved(robot, address):
    from websockets.asyncio.client import connect

    async def crowd():
        own, link = address.rstrip("/"), address.replace("http", "ws") + "live"
        pages = []
        try:
            refused = None
            while refused is None and len(pages) <= MOST_PAGES:
                try:
                    pages.append(await connect(link, origin=own))
                except websockets.exceptions.InvalidStatus as error:
                    refused = error
            assert refused is not None and refused.response.status_code == 503
            with pytest.raises(urllib.error.HTTPError, match="503"):
                await asyncio.to_thread(urllib.request.urlopen, address)
        finally:
            for page in pages:
                await page.close()
        # closed pages make room
        for _ in range(100):
            try:
                async with connect(link, origin=own):
                    return len(pages)
            except websockets.exceptions.InvalidStatus:
                await asyncio.sleep(0.05)

    # browsers of other tests may have pages open
    assert 1 <= asyncio.run(crowd()) <= MOST_PAGES


def test_of_many_values_the_newest_counts_and_a_flood_is_cut_off(robot):
    async def moved(count):
        connection = Connection()
        closed = []

        async def close(code, reason):
            closed.append((code, reason))

        connection.close = close
        own = Session(kc.solvers.Stepper(robot, DT), connection)
        taken, take = [], own.take
        own.take = lambda message: (taken.append(message["sequence"]), take(message))
        for sequence in range(1, count + 1):
            connection.given.put_nowait({"control": [6.0] * 4, "sequence": sequence})
        connection.given.put_nowait({"command": "pause"})
        running = asyncio.create_task(own.run())
        await asyncio.sleep(0.3)
        running.cancel()
        return own, taken, closed

    own, taken, closed = asyncio.run(moved(200))
    # the value before a command is taken over before it
    assert own.sequence == taken[-1] == 200 and len(taken) < 5 and own.paused and not closed
    _, taken, closed = asyncio.run(moved(MOST_PER_SECOND + 1))
    assert closed == [(1008, f"more than {MOST_PER_SECOND} messages in a second")]
