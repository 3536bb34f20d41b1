"""Faults of tension boards: what each means and the likely fix."""

from __future__ import annotations

#: by name: meaning, and the likely fix
FAULTS: dict[str, tuple[str, str]] = {
    "over-tension": (
        "a load cell measured more than the board's limit",
        "reduce tensions or the board's gains; check the tendon's way and the cell's gain",
    ),
    "watchdog": (
        "the board received no valid line in time",
        "the program paused longer than host_timeout, or lines were damaged: call command() or wait() often, "
        "check the cable; on a busy computer raise the setting watchdog",
    ),
    "sensor-rail": (
        "a load cell reads 0 or full scale",
        "check the wiring and supply of the cell's amplifier",
    ),
    "sensor-stuck": (
        "a load cell's reading does not change while its motor drives",
        "check the wiring of cell and motor, and that the reel turns",
    ),
    "slack": (
        "a motor reels in and no tension comes",
        "check that the tendon is on its reel and not torn, and that the motor's direction is right",
    ),
    "tare-timeout": (
        "a load cell did not react, or did not settle, while taring",
        "wind the tendons so that they are nearly tight, or raise the settings tare_drive and tare_time",
    ),
    "stopped": ("the robot was stopped", "make sure that the robot is safe"),
    "settings": (
        "the board's EEPROM held no valid settings",
        "check gains and calibration: reset() accepts those of the program, then tare() and save_settings()",
    ),
    "emergency-stop": (
        "the emergency stop is pressed, or its wire is broken; motors stand, tendons may be tensioned",
        "release the switch; without one, join D18 and GND, or turn off the setting estop",
    ),
    # found by the driver
    "restarted": (
        "the board restarted",
        "check the supply: motors that draw it down reset the board (brown-out)",
    ),
    "measured-tension": (
        "the driver measured more than its own limit and stopped the robot",
        "reduce the commanded tension, or raise measured_high",
    ),
    # motors that are commanded by torque
    "travel": (
        "a motor is beyond its travel",
        "check that the tendon is on its reel and not torn; tare() sets the zero",
    ),
    "motor-watchdog": (
        "the motor received nothing in time",
        "call command() or read() at least every host_timeout, check the cable",
    ),
    "input-voltage": ("the supply is beyond the motor's range", "check voltage and cables of the supply"),
    "overheating": ("the motor is too hot", "let it cool, and reduce tensions"),
    "encoder": ("the motor's encoder failed", "start the motor again; replace it if this returns"),
    "electrical-shock": ("the motor's circuit has a fault or too little power", "check the supply"),
    "overload": ("the motor was overloaded for long", "reduce tensions, check that the reel turns freely"),
    "heartbeat": ("a drive sends no heartbeat", "check its power, the CAN cable, its terminator and node id"),
    "drive-error": ("a drive reports an error", "read its errors with the maker's tool, and mend the cause"),
    "drive-idle": ("a drive left the closed loop by itself", "check its limits, watchdog and supply"),
}


def fault_message(fault: str) -> str:
    """Return the error message for a fault such as "over-tension:3": its meaning and the likely fix."""
    name, _, tendon = fault.partition(":")
    meaning, fix = FAULTS.get(name, ("unknown to this version", "see the board's documentation"))
    place = f" at tendon {tendon} (counted from 1)" if tendon not in ("", "0") else ""
    last = "" if "reset()" in fix else "; then reset()"
    return f"fault {name}{place}: {meaning}; {fix}{last}"
