"""One rod in three packages: `python -m benchmarks.matched` simulates it in each, in a process of its own.

A clamped Delrin rod with the dimensions of the catalog's delrin-tendon-robot, without tendons and damping,
is released straight from rest; gravity acts across it. Of a package's listed settings whose tip stays within
1 % of the length of a fine reference, in rows 20 ms apart, those with the least CPU time count. A package
that is not installed is reported as missing. SoRoMoX may have an environment of its own: --soromox PYTHON.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

LENGTH, RADIUS, DENSITY, YOUNGS_MODULUS = 0.635, 0.003175, 1411.6751, 2.757903e9  # m, m, kg/m³, Pa
SHEAR_MODULUS, GRAVITY = YOUNGS_MODULUS / 2.6, (-9.81, 0.0, 0.0)  # Pa, m/s²; the rod points along z
SECONDS, ROW, ALLOWED, ROBOTS = 1.0, 0.02, 0.01, 256  # s, s, part of the length, robots of a batch
#: stiffnesses of the robots of a batch, relative to the rod's
FACTORS = np.linspace(0.9, 1.1, ROBOTS)
ROOT = Path(__file__).parents[1]

Tips = Callable[[], np.ndarray]


# this package: nodes, time step, time scheme; Lobatto's scheme of order 4 along the rod


def ours(nodes: int, dt: float, scheme: str) -> Tips:
    """Return a simulation of one rod, which gives its tip (rows, 3)."""
    import knode_cosserat as kc

    robot, controls = _our_rod(nodes), np.zeros((round(SECONDS / dt), 0))

    def run() -> np.ndarray:
        tips = kc.simulate(
            robot, controls, dt, time=scheme, space="lobatto4", initial="unstressed"
        ).tip_position
        return np.asarray(tips)[:: round(ROW / dt)]

    return run


def ours_batch(nodes: int, dt: float, scheme: str) -> Tips:
    """Return a simulation of all robots of a batch, which gives their tips (robots, rows, 3)."""
    import knode_cosserat as kc

    robots = [_our_rod(nodes, factor) for factor in FACTORS]
    controls = np.zeros((round(SECONDS / dt), 0))

    def run() -> np.ndarray:
        tips = kc.simulate(
            robots, controls, dt, time=scheme, space="lobatto4", initial="unstressed"
        ).tip_position
        return np.asarray(tips)[:, :: round(ROW / dt)]

    return run


def _our_rod(nodes: int, factor: float = 1.0) -> Any:
    import knode_cosserat as kc

    return kc.robots.SlenderRod(
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=factor * YOUNGS_MODULUS,
        nodes=nodes,
        shear_modulus=factor * SHEAR_MODULUS,
        gravity=GRAVITY,
    )


# PyElastica: elements, part of the largest stable step. Its clamp fixes the whole first element, so the rod
# begins half an element before the clamp: it would be too short by this half, an error of first order.


def elastica(elements: int, part: float) -> Tips:
    """Return a simulation of one rod by position Verlet, which gives its tip (rows, 3)."""
    import elastica as ea

    size = LENGTH / (elements - 0.5)
    turning = 4.0 * SHEAR_MODULUS / RADIUS**2 + 4.0 * YOUNGS_MODULUS / size**2
    stable = 2.0 / np.sqrt((turning + 4.0 * SHEAR_MODULUS / size**2) / DENSITY)
    each = int(np.ceil(ROW / (part * stable)))  # steps of a row

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing):  # type: ignore[misc]
        pass

    def run() -> np.ndarray:
        simulator = Simulator()
        rod = ea.CosseratRod.straight_rod(
            elements,
            np.array([0.0, 0.0, -0.5 * size]),
            np.array([0.0, 0.0, 1.0]),
            np.array([1.0, 0.0, 0.0]),
            elements * size,
            RADIUS,
            DENSITY,
            youngs_modulus=YOUNGS_MODULUS,
            shear_modulus=SHEAR_MODULUS,
        )
        simulator.append(rod)
        simulator.constrain(rod).using(
            ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
        )
        simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=np.array(GRAVITY))
        simulator.finalize()
        verlet, now, rows = ea.PositionVerlet(), np.float64(0.0), [rod.position_collection[:, -1].copy()]
        for _ in range(round(SECONDS / ROW) * each):
            now = verlet.step(simulator, now, np.float64(ROW / each))
            if round(now / ROW * each) % each == 0:
                rows.append(rod.position_collection[:, -1].copy())
        return np.array(rows)

    return run


# SoRoMoX: geometric variable strain (GVS), with bending and twist as polynomials of an order along the rod


def soromox(order: int, solver: str, size: float) -> Tips:
    """Return a simulation of one rod, which gives its tip (rows, 3).

    Args:
        order: order of the polynomials.
        solver: "tsit5 adaptive", "tsit5", or "semi-implicit Euler".
        size: relative tolerance of adaptive steps, or the time step (s).
    """
    simulated = _soromox_program(order, solver, size)
    return lambda: np.asarray(simulated(YOUNGS_MODULUS))


def soromox_batch(order: int, solver: str, size: float) -> Tips:
    """Return a simulation of all robots of a batch by `vmap`, which gives their tips (robots, rows, 3)."""
    import jax

    simulated = jax.jit(jax.vmap(_soromox_program(order, solver, size)))
    return lambda: np.asarray(simulated(FACTORS * YOUNGS_MODULUS))


def _soromox_program(order: int, solver: str, size: float) -> Any:
    import diffrax  # type: ignore[import-not-found]
    import jax
    import jax.numpy as jnp
    import soromox as sx  # type: ignore[import-not-found]

    jax.config.update("jax_enable_x64", True)
    link = sx.LinkSpec.circular(
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        young_modulus=YOUNGS_MODULUS,
        shear_modulus=SHEAR_MODULUS,
        reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
    )
    basis = sx.StrainBasisSpec("legendre", ("kappa_x", "kappa_y", "kappa_z"), order)
    segment = sx.GVSSegment(link, sx.JointSpec.fixed(), basis, max(5, order + 4))
    robot = sx.GVS.from_segments([segment], gravity=jnp.array(GRAVITY))
    adaptive = solver == "tsit5 adaptive"
    count, rows = robot.num_internal_dofs, jnp.linspace(0.0, SECONDS, round(SECONDS / ROW) + 1)

    def simulated(modulus: Any) -> Any:
        material = sx.IsotropicMaterialParams(young_modulus=modulus, shear_modulus=modulus / 2.6)
        moved = robot.with_isotropic_material(material)
        steps = diffrax.PIDController(rtol=size, atol=0.1 * size) if adaptive else diffrax.ConstantStepSize()
        found = moved.rollout_to(
            sx.SystemState(t=jnp.zeros(()), y=jnp.zeros(2 * count)),
            t1=SECONDS,
            save_ts=rows,
            max_steps=200_000,
            solver_dt=1e-4 if adaptive else size,
            stepsize_controller=steps,
            solver=sx.SemiImplicitEuler(moved) if solver == "semi-implicit Euler" else diffrax.Tsit5(),
        )
        poses = jax.vmap(lambda q: moved.forward_kinematics(q, jnp.asarray(LENGTH)))(found.y[:, :count])
        return poses[:, :3, 3]

    return jax.jit(simulated)


# one package, in a process of its own


class Package(NamedTuple):
    """A package with its settings, from the coarsest to the finest."""

    distribution: str
    model: str
    labels: tuple[str, ...]
    single: Callable[..., Tips]
    batch: Callable[..., Tips] | None
    settings: tuple[tuple[Any, ...], ...]


PACKAGES = {
    "ours": Package(
        "knode-cosserat", "Cosserat rod, implicit steps", ("nodes", "time step (s)", "scheme"), ours,
        ours_batch,
        (
            (3, 0.02, "trapezoidal"), (3, 0.01, "trapezoidal"), (4, 0.01, "trapezoidal"),
            (6, 0.01, "trapezoidal"), (6, 0.005, "bdf2"),
            (10, 0.005, "bdf2"), (10, 0.005, "trapezoidal"), (20, 0.002, "trapezoidal"),
        ),
    ),
    "elastica": Package(
        "pyelastica", "Cosserat rod, explicit steps", ("elements", "part of the stable step"), elastica, None,
        ((4, 0.95), (6, 0.95), (10, 0.95), (20, 0.95)),
    ),
    "soromox": Package(
        "soromox", "GVS without shear and stretch, explicit steps",
        ("order", "solver", "tolerance or time step (s)"), soromox, soromox_batch,
        (
            (0, "semi-implicit Euler", 2e-3), (1, "semi-implicit Euler", 4e-3),
            (1, "semi-implicit Euler", 2e-3), (1, "semi-implicit Euler", 1.5e-3),
            (1, "semi-implicit Euler", 1e-3), (1, "tsit5 adaptive", 3e-2), (1, "tsit5 adaptive", 1e-2),
            (1, "tsit5", 4e-3), (2, "tsit5 adaptive", 1e-3), (3, "tsit5 adaptive", 1e-3),
            (4, "tsit5 adaptive", 1e-4),
        ),
    ),
}  # fmt: skip
#: settings of this package for the reference; half the time step moves its tip by 0.04 % of the length
REFERENCE = (41, 1e-3, "trapezoidal")
#: most calls of a timing, and seconds after which there are no more
CALLS, LIMIT = 30, 5.0


def seconds_of(run: Tips) -> tuple[float, float]:
    """Return wall time and CPU time (s) of the fastest calls; nothing is compiled in them.

    Other programs on the machine make calls slower, never faster.
    """
    wall: list[float] = []
    cpu: list[float] = []
    while len(wall) < CALLS and sum(wall) < LIMIT:
        begin, used = time.perf_counter(), time.process_time()
        run()
        wall.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - used)
    return min(wall), min(cpu)


def measured(name: str, reference: np.ndarray) -> dict[str, Any]:
    """Return a package's errors and times with all settings, and the time of a batch with the best ones."""
    package, rows = PACKAGES[name], list[dict[str, Any]]()
    for settings in package.settings:
        run = package.single(*settings)
        row: dict[str, Any] = {"settings": list(settings), "error": None, "seconds": None, "cpu": None}
        rows.append(row)
        try:
            tips = run()
        except RuntimeError:  # an unstable step: infinite numbers stop some solvers
            continue
        if np.all(np.isfinite(tips)):
            row["error"] = float(np.max(np.linalg.norm(tips - reference, axis=-1))) / LENGTH
            row["seconds"], row["cpu"] = seconds_of(run)
    allowed = [row for row in rows if row["error"] is not None and row["error"] <= ALLOWED]
    found: dict[str, Any] = {"version": importlib.metadata.version(package.distribution), "rows": rows}
    if allowed:
        found["best"] = min(allowed, key=lambda row: row["cpu"])
        if package.batch is not None:
            together = package.batch(*found["best"]["settings"])
            together()
            found["batch"] = dict(zip(("seconds", "cpu"), seconds_of(together), strict=True))
    return found


def work(name: str, folder: Path) -> None:
    """Write the reference, or the figures of a package, into a folder."""
    warnings.filterwarnings("ignore", message="bending_damping is 0")
    if name == "reference":
        np.save(folder / "reference.npy", ours(*REFERENCE)())
        return
    try:
        found = measured(name, np.load(folder / "reference.npy"))
    except (ModuleNotFoundError, importlib.metadata.PackageNotFoundError) as error:
        found = {"missing": str(error)}
    (folder / f"{name}.json").write_text(json.dumps(found))


# all packages


def compare(soromox_python: str) -> dict[str, Any]:
    """Return the figures of all packages."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("reference", *PACKAGES):
            python = soromox_python if name == "soromox" else sys.executable
            command = [python, "-m", "benchmarks.matched", "--work", name, "--folder", folder]
            subprocess.run(command, cwd=ROOT, check=True)
            if name != "reference":
                found[name] = json.loads((Path(folder) / f"{name}.json").read_text())
    return found


def table(found: dict[str, Any]) -> str:
    """Return the figures as a Markdown table."""
    columns = (
        "package", "model", "fastest accurate settings", "error of the tip", "simulated s per s, 1 robot",
        "per s of CPU time", f"{ROBOTS} robots, together, per s", "per s of CPU time",
        "finest settings: error",
    )  # fmt: skip
    lines = [f"| {' | '.join(columns)} |", "| --- " * len(columns) + "|"]
    for name, each in found.items():
        package = PACKAGES[name]
        if "missing" in each:
            lines.append(f"| {package.distribution} | missing: {each['missing']} | | | | | | | |")
            continue
        title, last = f"{package.distribution} {each['version']}", each["rows"][-1]["error"]
        if "best" not in each:
            lines.append(f"| {title} | {package.model} | none | | | | | | {100 * last:.2f} % |")
            continue
        best = each["best"]
        pairs = zip(package.labels, best["settings"], strict=True)
        settings = ", ".join(f"{label} {value}" for label, value in pairs)
        many = "not found | "
        if "batch" in each:
            speeds = (ROBOTS * SECONDS / each["batch"][name] for name in ("seconds", "cpu"))
            many = " | ".join(f"{speed:,.3g}" for speed in speeds)
        lines.append(
            f"| {title} | {package.model} | {settings} | {100 * best['error']:.2f} % | "
            f"{SECONDS / best['seconds']:,.3g} | {SECONDS / best['cpu']:,.3g} | {many} | {100 * last:.2f} % |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure, print, and write the table into docs/performance.md and the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--soromox", default=sys.executable, help="Python of an environment with SoRoMoX")
    parser.add_argument("--work", choices=("reference", *PACKAGES), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.work:
        work(given.work, given.folder)
        return
    found = compare(given.soromox)
    (ROOT / "benchmarks" / "matched.json").write_text(json.dumps(found, indent=2) + "\n")
    page, text = ROOT / "docs" / "performance.md", table(found)
    old = page.read_text(encoding="utf-8")
    new = re.sub(r"(<!-- matched -->\n)(?:(?!<!-- end -->).)*", rf"\g<1>{text}\n", old, flags=re.DOTALL)
    page.write_text(new, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
