"""`python -m benchmarks.viewer`: how soon the live mode answers a slider, and what a step of it costs.

In a headless Chromium whose pictures are drawn by the processor, on the cores that also simulate: a graphics
card takes the drawing off them. A slider is dragged by mouse events, 12 a second. Times are from the
browser's time stamp of the slider's event:

    simulated   the step in progress, solved again by the server: its part alone, without the way there
    answered    until the page has the new shape
    drawn       until it is drawn (a fence behind the drawing says when)

`--load N` measures beside N processes that do nothing but compute.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import knode_cosserat as kc
from knode_cosserat.viewer.live import Session, view_live
from tests.viewer.browser import Browser

DT = 0.05
EVENTS = 150

#: notes the times of what a slider's event leads to
PROBE = """(() => {
  const live = viewer.live;
  window.samples = [];
  const asked = new Map();
  const moved = live.moved;
  live.moved = (row) => {
    if (row.since !== undefined) asked.set(row.since, [live.step, performance.now()]);
    moved(row);
  };
  const drawn = live.drawn.bind(live);
  live.drawn = (since) => {
    drawn(since);
    const [step, answered] = asked.get(since);
    samples.push([step, answered - since, performance.now() - since]);
  };
})()"""

#: what it takes to draw one frame
DRAWING = """(() => {
  const taken = [];
  for (let k = 0; k < 40; k++) {
    const began = performance.now();
    viewer.robots[0].update(viewer.time, viewer.range);
    viewer.stage.draw();
    viewer.stage.finish();
    taken.push(performance.now() - began);
  }
  return taken;
})()"""


def spread(values: Any) -> dict[str, float]:
    """Median and 95th percentile (ms)."""
    low, high = np.percentile(np.asarray(values, dtype=float), [50.0, 95.0])
    return {"median": round(float(low), 2), "p95": round(float(high), 2)}


def alone(robot: kc.System) -> dict[str, Any]:
    """What the server does for one event, and for one tick of the clock, without any browser."""
    session = Session(kc.solvers.Stepper(robot, DT, space="euler"), None)
    controls = session.control + np.linspace(0.0, 1.0, 40)[:, None] * np.eye(len(session.control))[0]
    taken: dict[bool, list[float]] = {False: [], True: []}
    for k in range(400):
        for over in (False, True):
            began = time.perf_counter()
            _, session.stepper, stuck = session.attempt(controls[k % 40], k, over)
            taken[over].append(1e3 * (time.perf_counter() - began))
            assert not stuck
    return {"event": spread(taken[False]), "tick": spread(taken[True])}


def in_browser(robot: kc.System) -> dict[str, Any]:
    """From the slider to the shape."""
    found: list[str] = []
    known = threading.Event()

    def ready(address: str) -> None:
        found.append(address)
        known.set()

    threading.Thread(target=view_live, args=(robot,), kwargs={"open_browser": ready}, daemon=True).start()
    known.wait()
    browser = Browser()
    try:
        browser.open(found[0])
        time.sleep(2.0)
        browser.run(PROBE)
        box = "(() => { const r = document.querySelector('.slider input').getBoundingClientRect();"
        x, y, width, height = browser.run(box + " return [r.x, r.y, r.width, r.height]; })()")
        began, before = time.perf_counter(), browser.run("viewer.time")
        browser.mouse("mousePressed", x + width / 2, y + height / 2)
        for k in range(EVENTS):
            browser.mouse("mouseMoved", x + width * (0.5 + 0.3 * np.sin(k / 5.0)), y + height / 2)
            time.sleep(0.08)
        browser.mouse("mouseReleased", x + width / 2, y + height / 2)
        moved, passed = browser.run("viewer.time") - before, time.perf_counter() - began
        samples = np.array(browser.run("samples"))
        drawing = browser.run(DRAWING)
    finally:
        browser.close()
    names = ("simulated", "answered", "drawn")
    return {
        "events": len(samples),
        **{name: spread(samples[:, k]) for k, name in enumerate(names)},
        "within 50 ms": round(float(np.mean(samples[:, 2] <= 50.0)), 3),
        "drawing one frame": spread(drawing),
        "model time per time": round(moved / passed, 3),
    }


def robots() -> dict[str, kc.System]:
    """The paper's robot, one with routed tendons, and two models of the first from a file."""
    robot = kc.load_robot("delrin-tendon-robot")
    imperfect = robot.replace(length=0.4, youngs_modulus=10e9)
    training = [kc.simulate(robot, kc.controls.sine(period, 40, DT), DT) for period in (1.0, 2.0)]
    found: dict[str, kc.System] = {
        "physics": robot,
        "routed tendons": kc.load_robot("delrin-routed-tendon-robot"),
    }
    with tempfile.TemporaryDirectory() as folder:
        for name, config in (
            ("KNODE", kc.FitConfig()),
            ("KNODE, the paper's network", kc.FitConfig.paper(seed=0)),
        ):
            kc.fit(imperfect, training, config).save(Path(folder) / "model")
            found[name] = kc.load_model(Path(folder) / "model")
    return found


def _compute() -> None:
    while True:
        sum(range(1000))


@contextlib.contextmanager
def loaded(count: int) -> Iterator[None]:
    """Beside so many processes that only compute."""
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=_compute, daemon=True) for _ in range(count)]
    for each in others:
        each.start()
    try:
        yield
    finally:
        for each in others:
            each.terminate()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--load", type=int, default=0, help="processes that compute beside it")
    parser.add_argument("--only", help="one of the robots")
    arguments = parser.parse_args()
    measured: dict[str, Any] = {}
    with loaded(arguments.load):
        for name, robot in robots().items():
            if arguments.only in (None, name):
                measured[name] = {"server alone": alone(robot), **in_browser(robot)}
        measured["load average at the end"] = round(os.getloadavg()[0], 1)
    print(json.dumps(measured, indent=2))


if __name__ == "__main__":
    main()
