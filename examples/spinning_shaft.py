"""Whirl of a shaft over its speed (Campbell diagram), beside the closed form of a rotating beam.

The shaft is seen from a frame that spins with it, in which it has an equilibrium. A mode of frequency ω in
that frame whirls at Ω + ω or Ω - ω over the ground. Gyroscopic moments raise one and lower the other.
"""

import numpy as np

import knode_cosserat as kc
from knode_cosserat.robots import SlenderRod, SpinningFrame, ends

LENGTH, RADIUS, DENSITY, E = 0.5, 0.08, 1000.0, 2e9
GA, EI = E / 2.6 * np.pi * RADIUS**2, E * np.pi * RADIUS**4 / 4
MASS, INERTIA = DENSITY * np.pi * RADIUS**2, DENSITY * np.pi * RADIUS**4 / 4


def closed_form(k: float, rate: float) -> np.ndarray:
    """Return backward (negative) and forward whirl (rad/s) of a simply supported Timoshenko beam, sin(ks)."""
    P = np.polynomial.Polynomial
    bent = P([EI * k * k + GA, 2.0 * INERTIA * rate, -INERTIA])
    return np.sort((P([GA * k * k, 0.0, -MASS]) * bent - (GA * k) ** 2).roots().real)[1:3]


def main(out: str = "spinning_shaft.png", speeds: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Return whirl frequencies (rad/s), by the package and in closed form: speeds, two modes, two ways."""
    rates = np.linspace(0.0, 5000.0, speeds)
    shaft = SlenderRod(
        length=LENGTH, radius=RADIUS, density=DENSITY, youngs_modulus=E, gravity=(0.0, 0.0, 0.0), nodes=21,
        base_end=ends.Pinned(), tip_end=ends.Universal(), effects=(SpinningFrame(0.0),),
    )  # fmt: skip
    exact = np.array([[closed_form(k * np.pi / LENGTH, rate) for k in (1, 2)] for rate in rates])
    found = np.empty_like(exact)
    for rate, each, row in zip(rates, exact, found, strict=True):
        spinning = shaft.replace(**{"effects.0.rate": rate})
        seen = np.abs(kc.statics.modes(kc.equilibrium(spinning, np.zeros(0)), count=20).values.imag)
        # over the ground: each mode of the frame, either way round
        whirl = rate + np.concatenate([seen, -seen])
        row[:] = whirl[np.argmin(np.abs(whirl[:, None, None] - each), axis=0)]
    lines = {
        f"mode {k + 1}, {way}": np.abs(exact[:, k, i]) / (2.0 * np.pi)
        for k in range(2)
        for i, way in enumerate(("backward", "forward"))
    }
    speed = rates / (2.0 * np.pi)
    figure = kc.figures.curves(speed, lines, "speed of the shaft [1/s]", "whirl frequency [Hz]", columns=2)
    axes = figure.axes[0]
    axes.plot(speed, np.abs(found.reshape(speeds, -1)) / (2.0 * np.pi), "o", color="black", markersize=3)
    axes.plot(speed, speed, color="#999999", linewidth=0.8)
    axes.text(speed[-1], speed[-1], "1 × speed", color="#777777", ha="right", va="bottom", fontsize=8)
    figure.savefig(out)
    print(f"largest difference: {np.max(np.abs(found / exact - 1.0)):.1e}")
    return found, exact


if __name__ == "__main__":
    main()
