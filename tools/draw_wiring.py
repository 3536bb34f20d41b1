"""Draw the wiring diagram of the documentation.

python -m tools.draw_wiring
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Circle, FancyBboxPatch

ROOT = Path(__file__).parents[1]
FILE = ROOT / "docs" / "images" / "hardware-wiring.svg"
#: pins of each motor: pulse width, two directions, as in firmware/main.cpp
PINS = (("D11", "D22", "D23"), ("D12", "D24", "D25"), ("D5", "D26", "D27"), ("D2", "D28", "D29"))
POWER, GROUND, SIGNAL, ANALOG, MOTOR = "#c8322b", "#222222", "#2f6fb3", "#3a8f5c", "#8a5a2b"
MEGA, BRIDGE = (270.0, 430.0), (650.0, 810.0)


def box(ax, low, high, title, colour="#f4f6f9", at=None):
    """Box with a title in its middle, or at a place."""
    ax.add_patch(
        FancyBboxPatch(
            low,
            high[0] - low[0],
            high[1] - low[1],
            boxstyle="round,pad=0,rounding_size=8",
            fc=colour,
            ec="#4a5560",
            lw=1.4,
        )
    )
    x, y = at or ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    ax.text(x, y, title, ha="center", va="center", fontsize=10, weight="bold", linespacing=1.3)


def wire(ax, points, colour):
    ax.plot(*zip(*points, strict=True), color=colour, lw=1.7, solid_capstyle="round")


def pin(ax, x, y, name, side):
    """Pin at a box's left or right side, its name inside."""
    ax.plot([x], [y], "o", ms=4.5, color="#4a5560", zorder=3)
    shift, align = (9, "left") if side == "left" else (-9, "right")
    ax.text(x + shift, y, name, ha=align, va="center", fontsize=9)


def draw_bridge(ax, number, top):
    """One bridge with its two motors and its wires to the board."""
    box(ax, (BRIDGE[0], top), (BRIDGE[1], top + 218), f"XY-160D\nno. {number}", at=(733, top + 95))
    names = ("ENA", "IN1", "IN2", "ENB", "IN3", "IN4")
    first = 2 * number - 2
    sources = [*PINS[first], *PINS[first + 1]]
    for k, (name, source) in enumerate(zip(names, sources, strict=True)):
        y = top + 20 + 27 * k
        pin(ax, BRIDGE[0], y, name, "left")
        pin(ax, MEGA[1], y, source, "right")
        wire(ax, [(MEGA[1], y), (BRIDGE[0], y)], SIGNAL)
    for k, name in enumerate(("5 V", "GND")):
        pin(ax, BRIDGE[0], top + 182 + 22 * k, name, "left")
    wire(ax, [(BRIDGE[0], top + 182), (595, top + 182)], POWER)
    wire(ax, [(BRIDGE[0], top + 204), (565, top + 204)], GROUND)
    for k in range(2):
        y = top + 35 + 75 * k
        for j in range(2):
            pin(ax, BRIDGE[1], y + 26 * j, f"OUT{2 * k + j + 1}", "right")
            wire(ax, [(BRIDGE[1], y + 26 * j), (925, y + 26 * j)], MOTOR)
        ax.add_patch(Circle((950, y + 13), 29, fc="#fdf3e7", ec="#4a5560", lw=1.4, zorder=2))
        ax.text(950, y + 13, f"motor\n{first + k + 1}", ha="center", va="center", fontsize=9.5, weight="bold")
    pin(ax, BRIDGE[1], top + 182, "12 V", "right")
    pin(ax, BRIDGE[1], top + 204, "GND", "right")
    wire(ax, [(BRIDGE[1], top + 182), (1030, top + 182)], POWER)
    wire(ax, [(BRIDGE[1], top + 204), (1055, top + 204)], GROUND)


def draw_power(ax):
    """Supply, fuse, and the switch that cuts the motors' supply."""
    box(ax, (520, 20), (640, 80), "supply\n12 V DC", "#fdecea")
    box(ax, (700, 28), (770, 62), "fuse", "#fdecea")
    box(ax, (830, 14), (985, 76), "emergency stop\n2 normally closed", "#fbd5d1")
    wire(ax, [(640, 45), (700, 45)], POWER)
    wire(ax, [(770, 45), (830, 45)], POWER)
    wire(ax, [(985, 45), (1030, 45), (1030, 582)], POWER)
    wire(ax, [(640, 72), (665, 72), (665, 100), (1055, 100), (1055, 604)], GROUND)
    ax.text(1043, 215, "motors' 12 V", fontsize=9, rotation=90, ha="center", va="center", color=POWER)
    joints = [(595, 582, POWER), (565, 604, GROUND), (565, 665, GROUND), (1030, 332, POWER)]
    joints += [(1055, 354, GROUND), (1055, 604, GROUND)]
    joints += [(190, 255 + 85 * k, POWER) for k in range(3)] + [(215, 285 + 85 * k, GROUND) for k in range(3)]
    for x, y, colour in joints:
        ax.plot([x], [y], "o", ms=5.5, color=colour)
    # sense contact
    pin(ax, MEGA[1], 128, "D18", "right")
    wire(ax, [(MEGA[1], 128), (905, 128), (905, 76)], SIGNAL)
    ax.text(445, 119, "second contact, to GND; 1 kohm to 5 V: low = released", fontsize=8.5, color=SIGNAL)


def draw_board(ax):
    """The board, its amplifiers and its host."""
    box(ax, (MEGA[0], 100), (MEGA[1], 690), "Arduino\nMega 2560", at=(340, 330))
    for k in range(4):
        y = 185 + 85 * k
        box(ax, (30, y - 29), (165, y + 29), f"amplifier {k + 1}\nBF350 beam {k + 1}", "#e9f5ee")
        pin(ax, MEGA[0], y, f"A{k}", "left")
        wire(ax, [(165, y), (MEGA[0], y)], ANALOG)
        wire(ax, [(165, y - 15), (190, y - 15)], POWER)
        wire(ax, [(165, y + 15), (215, y + 15)], GROUND)
    pin(ax, MEGA[0], 525, "5 V", "left")
    pin(ax, MEGA[0], 550, "GND", "left")
    wire(ax, [(190, 170), (190, 525), (MEGA[0], 525)], POWER)
    wire(ax, [(215, 200), (215, 550), (MEGA[0], 550)], GROUND)
    box(ax, (30, 620), (165, 670), "host computer", "#eef0fb")
    pin(ax, MEGA[0], 645, "USB", "left")
    wire(ax, [(165, 645), (MEGA[0], 645)], "#6a4fb0")
    pin(ax, MEGA[1], 640, "5 V", "right")
    pin(ax, MEGA[1], 665, "GND", "right")
    wire(ax, [(MEGA[1], 640), (595, 640), (595, 332)], POWER)
    wire(ax, [(MEGA[1], 665), (565, 665), (565, 354)], GROUND)
    # one common ground
    wire(ax, [(565, 665), (1055, 665), (1055, 604)], GROUND)
    ax.text(820, 680, "one common ground", fontsize=9, ha="center", va="center")


def draw_legend(ax):
    rows = [
        ("supply, 5 V and 12 V", POWER),
        ("ground", GROUND),
        ("logic: pulse width, direction", SIGNAL),
        ("load-cell signal, 0 to 5 V", ANALOG),
        ("motor", MOTOR),
    ]
    for k, (name, colour) in enumerate(rows):
        x, y = 30, 18 + 19 * k
        wire(ax, [(x, y), (x + 28, y)], colour)
        ax.text(x + 36, y, name, fontsize=9, va="center")


def main() -> None:
    matplotlib.rcParams["svg.hashsalt"] = "wiring"
    figure = plt.figure(figsize=(11, 7))
    ax = figure.add_axes((0, 0, 1, 1), xlim=(0, 1120), ylim=(712, 0))
    ax.set_axis_off()
    draw_power(ax)
    draw_board(ax)
    for number, top in ((1, 150), (2, 400)):
        draw_bridge(ax, number, top)
    draw_legend(ax)
    figure.savefig(FILE, metadata={"Date": None}, facecolor="white")
    for path in sys.argv[1:]:
        figure.savefig(path, dpi=100, facecolor="white")
    print(f"{FILE.relative_to(ROOT)}: {FILE.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
