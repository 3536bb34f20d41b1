"""Reach against stiffness: the Pareto front of a rod's size and its tendons, by Optuna's NSGA-II.

A payload of 30 g hangs at the tip of a horizontal rod of glass fibre. A generation is one batch: its designs
and load cases are solved together by one compiled program. A design with an equilibrium that is unsolved or
coarse fails. It needs the extra `design`.
"""

import warnings

import matplotlib.pyplot as plt
import numpy as np
import optuna

import knode_cosserat as kc

LIMITS = {  # all in mm
    "length": (200.0, 500.0),
    "radius": (0.6, 2.5),
    "base_offset": (4.0, 20.0),
    "end_offset": (4.0, 20.0),
}
PAYLOAD, TENSION = 0.03, 15.0  # kg, N


def robot(design, mass):
    """Return a rod of glass fibre with tapered tendons on its left and right; gravity is along -x."""
    length, radius, *offsets = (1e-3 * design[name] for name in LIMITS)
    sides = [kc.robots.routing.Tapered(*offsets, angle=angle) for angle in (0.5 * np.pi, -0.5 * np.pi)]
    return kc.robots.RoutedTendonRobot(
        length=length, radius=radius, density=2000.0, youngs_modulus=40e9, nodes=21,
        gravity=(-9.81, 0.0, 0.0), tendon_offset=offsets[0], tendon_angles=(0.5 * np.pi, -0.5 * np.pi),
        routing=sides, loads=(kc.robots.loads.AttachedMass(mass=mass),),
    )  # fmt: skip


def objectives(designs):
    """Return reach and sag (B, 2) in mm, and True for designs whose equilibria are all solved and fine.

    Reach is how far a tendon pulls the tip to its side, sag how far the payload lowers it.
    """
    cases = ((0.0, 0.0), (PAYLOAD, 0.0), (PAYLOAD, TENSION))  # mass, tension of the left tendon
    robots = [robot(design, mass) for mass, _ in cases for design in designs]
    tensions = np.repeat([[pull, 0.0] for _, pull in cases], len(designs), axis=0)
    shapes = kc.equilibrium(robots, tensions, on_failure="return", recovery_budget=0.0)
    bare, loaded, pulled = 1e3 * np.asarray(shapes.tip_position)[:, 0].reshape(3, -1, 3)
    fine = np.all(np.asarray(shapes.result).reshape(3, -1) == 0, axis=0)
    return np.stack([pulled[:, 1], bare[:, 0] - loaded[:, 0]], axis=1), fine


def main(out: str = "design_pareto.png", generations: int = 30, size: int = 32) -> optuna.Study:
    """Return the study; its `best_trials` are the Pareto front."""
    warnings.filterwarnings("ignore", message="the grid is too coarse")  # such designs fail
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sampler = optuna.samplers.NSGAIISampler(population_size=size, seed=0)
    study = optuna.create_study(directions=["maximize", "minimize"], sampler=sampler)
    spaces = {name: optuna.distributions.FloatDistribution(*limits) for name, limits in LIMITS.items()}
    for _ in range(generations):
        trials = [study.ask(spaces) for _ in range(size)]
        values, fine = objectives([trial.params for trial in trials])
        for trial, value, good in zip(trials, values, fine, strict=True):
            state = optuna.trial.TrialState.COMPLETE if good else optuna.trial.TrialState.FAIL
            study.tell(trial, value.tolist() if good else None, state)

    done = study.get_trials(states=(optuna.trial.TrialState.COMPLETE,))
    distinct = {tuple(trial.values): trial for trial in study.best_trials}  # some designs are proposed twice
    front = [distinct[values] for values in sorted(distinct)]
    figure, axes = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
    axes.plot(*np.transpose([trial.values for trial in done]), ".", color="0.75", label="all designs")
    reach, sag = np.transpose([trial.values for trial in front])
    radii = [trial.params["radius"] for trial in front]
    points = axes.scatter(reach, sag, c=radii, label="Pareto front", zorder=3)
    figure.colorbar(points, label="radius (mm)")
    axes.set(xlabel="reach to the side (mm)", ylabel=f"sag under {1e3 * PAYLOAD:.0f} g (mm)", yscale="log")
    axes.legend()
    figure.savefig(out, dpi=110)
    print(
        f"{len(done)} of {len(study.trials)} designs are solved and fine, {len(front)} of them on the front"
    )
    for trial in front[:: max(1, len(front) // 4)]:
        sizes = ", ".join(f"{name} {trial.params[name]:.1f}" for name in LIMITS)
        print(f"reach {trial.values[0]:.0f} mm, sag {trial.values[1]:.2f} mm: {sizes} mm")
    return study


if __name__ == "__main__":
    main()
