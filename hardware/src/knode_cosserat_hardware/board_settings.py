"""Settings of tension boards, by name."""

from __future__ import annotations

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat_hardware.board_link import BoardLink
from knode_cosserat_hardware.driver import HardwareError

#: names of settings, for the hints of errors; a newer board may have more
SETTINGS = (
    *("kp", "ki", "kd", "hold", "friction", "smooth", "limit", "watchdog", "silence", "release", "jog"),
    *("tare_drive", "tare_time", "tare_rise", "tare_on_start", "estop"),
    *(f"{name}{k}" for name in ("gain", "zero") for k in range(1, 5)),
)


def ask_setting(link: BoardLink, verb: str, name: str, *value: int) -> int:
    """Return a setting that the board answers to `get NAME` or `set NAME VALUE`.

    Raises:
        HardwareError: name or value are not allowed, or the board does not answer.
    """
    try:
        whole = [int(each) for each in value]
    except (TypeError, ValueError, OverflowError):
        whole = []
    if whole != list(value) or any(isinstance(each, bool) for each in value):
        raise HardwareError(f"{name} must be a whole number (got {value[0]!r:.60})")
    try:
        answer = link.request(verb, name, *whole)
    except HardwareError as error:
        hint = "" if name in SETTINGS else did_you_mean(name, SETTINGS)
        raise HardwareError(f"{error}; setting {name}{hint}") from None
    try:
        return int(answer.values[1])
    except (IndexError, ValueError):
        raise HardwareError(f"{link.transport.name}: the answer to {verb} {name} is not understood") from None
