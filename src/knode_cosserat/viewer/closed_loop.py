"""A closed loop in the browser: a robot follows a target that is dragged with the mouse."""

from __future__ import annotations

import asyncio
import gc
from pathlib import Path
from typing import Any

from knode_cosserat.control import Controller, LoopLog, Plant
from knode_cosserat.viewer.document import document
from knode_cosserat.viewer.live import require_websockets
from knode_cosserat.viewer.loop_session import FollowedTarget, LoopSession
from knode_cosserat.viewer.page_server import serve_page
from knode_cosserat.viewer.scene import Point
from knode_cosserat.viewer.serve import Opening, checked_port


def control_live(
    controller: Controller,
    plant: Plant,
    *,
    title: str | None = None,
    target: Point | None = None,
    export: str | Path | None = None,
    port: int = 0,
    open_browser: Opening = True,
) -> LoopLog | None:
    """Control a robot in the browser until interrupted (Ctrl-C), and return the log of its last run.

    The tip follows a target that is dragged with the mouse. The page shows the true and the estimated shape,
    the predicted path of the tip, the limits, and the times of the computation. The last 12 000 periods since
    the last start are kept.

    Args:
        controller: a controller of the tip's position; it is copied.
        plant: the robot. Of one that does not know its shape, only the estimate is drawn.
        title: heading of the page; by default the robot's class.
        target: first target (x, y, z) in m; by default the tip at the start.
        export: file to which the last run is written at the end, as by the page's *Export run*.
        port: port of the server, which only this machine reaches; 0 for any free one.
        open_browser: True opens the page and prints its address; False only prints it. A function is called
            with the address instead.

    Returns:
        The log of the run since the last start; None without a period.

    Raises:
        ImportError: `websockets` is not installed.
        ValueError: a controller that does not track the tip, or an impossible target or port.
    """
    require_websockets()
    checked_port(port)
    followed = FollowedTarget(controller, plant, title, target)
    page = loop_page(followed)
    gc.collect()
    gc.freeze()  # a collection of everything that is loaded would take longer than a period
    try:
        asyncio.run(
            serve_page(page, lambda connection: LoopSession(followed, connection), port, open_browser)
        )
    finally:
        gc.unfreeze()
        followed.thread.shutdown()
    if not followed.record.moments:
        return None
    if export is not None:
        followed.record.export(export, followed.title)
    return followed.loop.log()


def loop_page(followed: FollowedTarget) -> bytes:
    """Return the page of a closed loop."""
    shown: dict[str, Any] = {
        "title": followed.title,
        "tracks": followed.tracks,
        "target": [float(x) for x in followed.start],
        "loop": followed.facts.for_page(),
        "live": {"dt": followed.facts.dt},
    }
    return document(shown, "'self' ws:").encode("utf-8")
