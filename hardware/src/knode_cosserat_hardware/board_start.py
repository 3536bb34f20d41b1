"""Start of a connection to a tension board: banner, protocol, end of taring."""

from __future__ import annotations

from typing import NamedTuple

from knode_cosserat_hardware.board_link import BoardLink
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.lines import GRAM_FORCE

#: a board without a banner that has sent telemetry for this time is running (s). One that restarts is silent
RUNNING_TIME = 0.5
#: longest wait for a banner or telemetry (s): the boot loader of an Arduino takes up to 2 s
FIRST_LINE = 5.0


class StartedBoard(NamedTuple):
    """Number of tendons of a board, and the greatest tension that it accepts (N, None if it states none)."""

    tendons: int
    high: float | None


def find_board(link: BoardLink, timeout: float) -> None:
    """Wait (s) for a board's banner or a running one's telemetry: a boot loader would take other lines."""
    opened = link.transport.now()

    def is_there() -> bool:
        running = link.telemetry is not None and link.arrival - opened >= RUNNING_TIME
        return link.banner is not None or running

    link.until(is_there, min(FIRST_LINE, timeout))


def negotiate(link: BoardLink, protocol: int, tendons: int, timeout: float) -> StartedBoard:
    """Choose framed or plain lines, and wait (s) until a framed board has tared or has a fault.

    Args:
        link: the connection; its mode is set.
        protocol: 2, or 1 for plain lines.
        tendons: number of tendons of a plain board.
        timeout: longest wait for the end of taring (s).

    Raises:
        HardwareError: the board does not answer, is not ready in time, or sends another number of tensions.
    """
    offered = link.banner.protocol if link.banner else protocol
    answer = None
    if min(offered, protocol) >= 2:
        for _ in range(3):
            if answer := link.hello(2, 0.5):
                break
    if answer is None:
        return _plain(link, tendons)
    with link.lock:
        link.mode, link.telemetry = "framed", None
    started = _stated(link, answer.values)
    # taring moves the motors; the link feeds the watchdog meanwhile
    settled = ("ready", "armed", "fault")
    if not link.until(lambda: link.telemetry and link.telemetry.state in settled, timeout):
        raise HardwareError(
            f"{link.transport.name}: the board was not ready in {timeout:g} s; check the tendons, "
            "or turn off the setting tare_on_start"
        )
    return _checked(link, started)


def _plain(link: BoardLink, tendons: int) -> StartedBoard:
    if link.until(lambda: link.telemetry, 1.0) is None:
        raise HardwareError(
            f"{link.transport.name}: no answer; check that this is the board's port, its power, "
            "and that 115200 baud is its speed"
        )
    link.mode = "plain"
    return _checked(link, StartedBoard(tendons, None))


def _stated(link: BoardLink, values: tuple[str, ...]) -> StartedBoard:
    """Return what the answer to hello states: `2 knode-tension 1.0.0 TENDONS RATE LIMIT`."""
    try:
        return StartedBoard(int(values[3]), int(values[5]) * GRAM_FORCE)
    except (IndexError, ValueError):
        raise HardwareError(
            f"{link.transport.name}: the answer to hello is not understood ({' '.join(values)[:60]})"
        ) from None


def _checked(link: BoardLink, started: StartedBoard) -> StartedBoard:
    count = len(link.telemetry.tension) if link.telemetry else 0
    if count != started.tendons:
        raise HardwareError(
            f"{link.transport.name}: the board sends {count} tensions (expected {started.tendons}); "
            "give the right tendon_count"
        )
    return started
