"""Take the pictures of the viewer for the documentation, in a headless Chromium.

make demo
.venv/bin/python -m tools.viewer_picture            # the demo's scene
.venv/bin/python -m tools.viewer_picture --control  # a closed loop, while its target is dragged
"""

import argparse
import threading
import time
from pathlib import Path

from PIL import Image

import knode_cosserat as kc
from tests.viewer.browser import Browser

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
#: where the sine of the demo has bent the robot most to the side, as a part of its time
AT = 0.43
#: pixels by which the target is dragged: first to one side, then to the other
FIRST, THEN = (170, 40), (-300, 45)
#: keeps the picture once the predicted path of the tip is long (m) and ends near the target
KEEP = """{
  const far = (a, b) => Math.hypot(...a.map((x, k) => x - b[k]));
  const watch = setInterval(() => {
    const { loop } = viewer;
    const end = loop.end.position.toArray();
    if (far(end, viewer.tip()) < 0.06 || far(end, loop.place) > 0.07) return;
    clearInterval(watch);
    viewer.live.moved = () => {};
    viewer.kept = true;
  }, 5);
}"""
#: part of the way from the camera to the robot by which the picture is nearer
NEARER = 0.3


def take_scene(browser: Browser, scene: Path, out: Path) -> None:
    """Take the picture of a scene's file."""
    browser.open(scene.resolve().as_uri())
    browser.run("document.getElementById('hint-close').click()")
    browser.drag("#time", AT)
    # shadows and smooth edges come once nothing moves
    time.sleep(1.5)
    browser.picture(out)


def take_loop(browser: Browser, out: Path) -> None:
    """Take the picture of a closed loop whose target has just been dragged."""
    browser.open(loop_address())
    browser.run("document.getElementById('hint-close').click()")
    browser.run(f"viewer.stage.camera.position.lerp(viewer.stage.controls.target, {NEARER})")
    browser.run("viewer.stage.controls.update()")
    browser.wait(lambda: browser.run("viewer.time > 1"))
    drag(browser, FIRST, 20)
    time.sleep(2.0)
    browser.run(KEEP)
    drag(browser, THEN, 3)
    browser.wait(lambda: browser.run("viewer.kept"))
    time.sleep(1.5)
    browser.picture(out)


def loop_address() -> str:
    """Start a closed loop whose model is too stiff, and return its page's address."""
    robot = kc.load_robot("delrin-tendon-robot")
    tip = kc.estimation.TipPosition()
    observer = kc.estimation.KalmanObserver(robot, 0.05, tip, adapt=["youngs_modulus"])
    box = kc.control.SoftLimit(tip, [-0.22, -0.22, 0.4], [0.22, 0.22, 0.66])
    limits = kc.control.ControlLimits(0.0, 6.0, 30.0)
    controller = kc.control.PredictiveController(observer, tip, limits, soft=[box])
    softer = robot.replace(youngs_modulus=2.2e9)
    plant = kc.control.SimulatedPlant(softer, 0.05, kc.control.Sensor(tip, noise=1.0))
    known, found = threading.Event(), []

    def ready(address: str) -> None:
        found.append(address)
        known.set()

    options = {"title": "delrin-tendon-robot", "open_browser": ready}
    threading.Thread(
        target=kc.viewer.control_live, args=(controller, plant), kwargs=options, daemon=True
    ).start()
    known.wait(120)
    return found[0]


def drag(browser: Browser, way: tuple[int, int], steps: int) -> None:
    """Drag the target by some pixels."""
    x, y = browser.run(
        "(() => { const s = viewer.stage, r = s.canvas.getBoundingClientRect();"
        " const p = s.project(s.target.position.toArray(), 0, s.cellAt(5, 5));"
        " return [p.x + r.left, p.y + r.top]; })()"
    )
    browser.mouse("mouseMoved", x, y)
    browser.mouse("mousePressed", x, y)
    for k in range(1, steps + 1):
        browser.mouse("mouseMoved", x + way[0] * k / steps, y + way[1] * k / steps)
        time.sleep(0.02)
    browser.mouse("mouseReleased", x + way[0], y + way[1])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Take the pictures of the viewer for the documentation.")
    parser.add_argument("--scene", type=Path, default=ROOT / "demo" / "scene.html")
    parser.add_argument("--control", action="store_true", help="a closed loop in place of a scene")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    out = given.out or IMAGES / ("control-live.png" if given.control else "viewer.png")
    browser = Browser(1280, 840 if given.control else 760)
    try:
        if given.control:
            take_loop(browser, out)
        else:
            take_scene(browser, given.scene, out)
    finally:
        browser.close()
    with Image.open(out) as image:
        image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    main()
