"""Plain mode of tension boards, the paper's: no states, armed by the first command, disarmed by silence."""

from __future__ import annotations

from knode_cosserat_hardware.board_link import BoardLink
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.faults import fault_message
from knode_cosserat_hardware.lines import encode_tensions

#: a plain board disarms itself after a silence of 0.5 s
SILENCE = 0.45


def is_armed(link: BoardLink) -> bool:
    """True while commands are repeated and the board has not disarmed itself."""
    return bool(link.plain_line) and link.transport.now() - link.sent_at < SILENCE


def arm(link: BoardLink, tendons: int, timeout: float) -> None:
    """Send zero tensions until the board does not refuse them: one that tares does.

    Raises:
        HardwareError: the board has a fault, or refused for the whole time (s).
    """
    zeros = encode_tensions([0] * tendons)
    end = link.transport.now() + timeout
    while link.transport.now() < end:
        link.last_refusal = ""
        link.write(zeros)
        link.until(lambda: link.last_refusal or link.fault, 0.1)
        if link.fault:
            raise HardwareError(fault_message(link.fault))
        if not link.last_refusal:
            link.plain_line = zeros
            return
    raise HardwareError(
        f"{link.transport.name}: the board refused to arm ({link.last_refusal}); wait for its tare"
    )


def release(link: BoardLink, tendons: int) -> None:
    """Send zero tensions once; the silence that follows disarms the board."""
    if link.plain_line:
        link.write(encode_tensions([0] * tendons))
    link.plain_line = b""


def reset(link: BoardLink) -> None:
    """Ask the board to clear its fault, after its release of the tendons.

    Raises:
        HardwareError: the emergency stop is pressed.
    """
    for _ in range(2):
        link.last_refusal = ""
        link.send_plain("reset")
        if link.until(lambda: link.last_refusal, 0.2) != "state":
            break
        link.until(lambda: None, 0.6)
    if link.last_refusal == "emergency-stop":
        raise HardwareError(fault_message("emergency-stop:0"))
    link.host_fault = link.plain_fault = ""
