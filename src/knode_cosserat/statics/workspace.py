"""Workspace of a robot: poses of very many equilibria."""

from __future__ import annotations

import concurrent.futures
import csv
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.writing import replacing
from knode_cosserat._reprs import quantity, robot_text, wrap_lines
from knode_cosserat.controls import titles
from knode_cosserat.io import container
from knode_cosserat.io.container import Variable
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.result import Result, ResultCodes
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.refinement import fix_grid
from knode_cosserat.solvers.run import usable_cores
from knode_cosserat.statics import arguments
from knode_cosserat.statics.response import Pose, equilibrium_poses, tip_pose

#: samples per task of a thread; fewer are padded to a power of two
CHUNK = 1024
#: endings of the files that a workspace can be written to
FORMATS = (".nc", ".csv", ".npz")
KIND = container.Kind("knode-cosserat workspace", 1, container.ContainerError)


@dataclasses.dataclass(frozen=True)
class Workspace:
    """Poses of B equilibria. The pose of a sample without a solution (`result` < 0) is NaN."""

    system: System
    #: (B, c)
    controls: np.ndarray
    #: (B, 3) in m
    position: np.ndarray
    #: (B, 4), scalar first; None for a robot without orientation
    quaternion: np.ndarray | None
    #: (B,), a `Result` each
    result: np.ndarray
    #: (B,), largest residual in natural units
    residual: np.ndarray
    #: (B, fields): largest magnitude of each strain's change from rest along the rod, in z's own units
    strain: np.ndarray

    def __repr__(self) -> str:
        solved = self.position[self.valid]
        spans = (
            [
                f"{axis} {quantity([low, high], 'm')}"
                for axis, low, high in zip("xyz", solved.min(axis=0), solved.max(axis=0), strict=False)
            ]
            if len(solved)
            else []
        )
        return wrap_lines(
            f"Workspace of a {robot_text(self.system)}: {len(self.result)} samples, "
            f"{self.unsolved} without a solution; {', '.join(spans)}"
        )

    @property
    def valid(self) -> np.ndarray:
        """True for samples that were solved (B,)."""
        return self.result >= 0

    @property
    def unsolved(self) -> int:
        """Number of samples without a solution."""
        return int(np.sum(~self.valid))

    def peak(self, name: str) -> np.ndarray:
        """Return (B,) the largest change from rest of a strain, such as `u` (1/m), anywhere along the rod."""
        names = self.system.z_layout.names
        if name not in names:
            raise ValueError(f"there is no strain {name!r}; there are {', '.join(names)}")
        return self.strain[:, names.index(name)]

    def within(self, **limits: float) -> np.ndarray:
        """Return True for samples (B,) that are solved within the strain limits, such as `u=4.0` (1/m)."""
        inside = self.valid.copy()
        for name, limit in limits.items():
            with np.errstate(invalid="ignore"):
                inside &= self.peak(name) <= limit
        return inside

    def save(self, path: str | Path) -> None:
        """Write a labelled netCDF file (.nc), a table (.csv), or NumPy's arrays (.npz).

        Raises:
            ValueError: another ending.
        """
        path = Path(path)
        if path.suffix not in FORMATS:
            raise ValueError(f"{path}: allowed is a name that ends in {', '.join(FORMATS)}")
        arrays = {"control": self.controls, "position": self.position, "quaternion": self.quaternion}
        arrays |= {"result": self.result, "residual": self.residual, "strain": self.strain}
        known = {name: array for name, array in arrays.items() if array is not None}
        with replacing(path) as temporary:
            if path.suffix == ".nc":
                temporary.write_bytes(self._netcdf(known))
            elif path.suffix == ".csv":
                self._table(temporary, known)
            else:
                with open(temporary, "wb") as file:
                    np.savez_compressed(file, allow_pickle=False, **known)

    def _netcdf(self, arrays: dict[str, np.ndarray]) -> bytes:
        labels = {
            "control": ("", f"control: {', '.join(titles(self.system.control_layout))}"),
            "position": ("m", "position of the tip, global frame"),
            "quaternion": ("1", "orientation of the tip, scalar first"),
            "result": ("1", "how it was solved; below zero: not solved"),
            "residual": ("1", "largest residual, in natural units"),
            "strain": ("", f"largest change from rest of {', '.join(self.system.z_layout.names)}"),
        }
        variables = {
            name: Variable(
                array,
                ("sample", f"{name}_component")[: array.ndim],
                {"units": labels[name][0], "long_name": labels[name][1]},
            )
            for name, array in arrays.items()
        }
        return container.encode(KIND, {"system": type(self.system).__name__}, variables=variables)

    def _table(self, path: Any, arrays: dict[str, np.ndarray]) -> None:
        """Write controls with names and units, as in files of controls; other columns numbered from 0."""
        names, columns = [], []
        for name, array in arrays.items():
            wide = array.reshape(len(array), -1)
            if name == "control":
                names += titles(self.system.control_layout)
            else:
                names += [name] if array.ndim == 1 else [f"{name}_{i}" for i in range(wide.shape[1])]
            columns += list(wide.T)
        with open(path, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(names)
            writer.writerows(zip(*(column.tolist() for column in columns), strict=True))


def sample(low: np.ndarray, high: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Return `count` controls (count, c) from a scrambled Sobol sequence between the limits."""
    from scipy.stats import qmc

    power = max(0, int(np.ceil(np.log2(count))))
    points = qmc.Sobol(len(low), rng=np.random.default_rng(seed)).random_base2(power)[:count]
    return low + points * (high - low)


def workspace(
    robot: System,
    controls: Any = None,
    high: Any = None,
    count: int | None = None,
    *,
    low: Any = None,
    seed: int = 0,
    space: str | SpaceScheme = "lobatto2",
    newton: NewtonOptions = NewtonOptions(),
    pose: Pose = tip_pose,
    progress: bool = False,
) -> Workspace:
    """Return a robot's poses at rest under many controls.

    Call `workspace(robot, controls)` or `workspace(robot, low, high, count)`. The latter, whose arguments may
    be passed by name, spreads `count` controls evenly between limits (scrambled Sobol sequence with a seed).

    Every equilibrium is solved from the unloaded robot, as in `kc.equilibrium`, so a sample does not depend
    on the others. A robot with several equilibria gives the one found from there. Its stability is not
    computed (see `kc.statics.configuration(…).unstable`). A sample that does not converge goes through the
    recoveries of `kc.equilibrium`. Only the poses are kept: memory does not grow with the nodes.

    Args:
        robot: one robot or model.
        controls: (B, c); or the lower limits, numbers or (c,), with `high` and `count`.
        high: the upper limits.
        count: number of samples.
        low: the lower limits by name, instead of `controls`.
        seed: seed of the samples.
        space: "lobatto2", "lobatto4", "euler", or a scheme.
        newton: tolerances and limits of the solve.
        pose: pose function, as for `kc.statics.configuration`.
        progress: show a progress bar. An interruption by Ctrl-C is a `KeyboardInterrupt`, whose `best` are
            the samples so far.

    Raises:
        ValueError: arguments of a wrong shape.
    """
    check_arguments(workspace, locals())
    settings = arguments.static_settings(space, newton)
    if low is None and high is not None:
        # positional limits
        low, controls = controls, None
    given = [argument is not None for argument in (controls, low, high, count)]
    if given not in ([True, False, False, False], [False, True, True, True]):
        raise ValueError("allowed is workspace(robot, controls) or workspace(robot, low, high, count)")
    if controls is None:
        limits = arguments.checked_limits(robot, low, high)
        number: Any = count
        if not isinstance(number, int | np.integer) or not 1 <= number <= 2**30:
            raise ValueError(f"count is {count!r}; allowed is a whole number from 1 to 2^30")
        samples = sample(*limits, int(number), seed)
    else:
        size = robot.control_layout.size
        samples = arguments.checked_vectors("controls", controls, robot.control_layout, f"(B, {size})")
        if samples.ndim != 2:
            raise ValueError(f"controls have shape {samples.shape}; allowed is (B, {size})")
        arguments.within_limits(robot, samples, "controls")
    return _samples(robot, settings, pose, samples, progress)


def _samples(
    system: System, settings: Settings, pose: Pose, controls: np.ndarray, progress: bool
) -> Workspace:
    total = len(controls)
    chunk = min(CHUNK, 2 ** int(np.ceil(np.log2(max(1, -(-total // usable_cores()))))))
    #: samples and their poses, residuals and strains, by the number of the first
    chunks: dict[int, list[Any]] = {}
    found: Workspace | None = None
    with tqdm(total=total, disable=not progress, unit="sample", leave=False) as bar:

        def work(first: int) -> None:
            # the last chunk is padded with its last sample: one shape, one program
            index = np.minimum(np.arange(first, first + chunk), total - 1)
            poses = equilibrium_poses(system, settings, pose, controls[index])
            count = min(chunk, total - first)
            chunks[first] = [None if leaf is None else np.asarray(leaf)[:count] for leaf in (index, *poses)]
            bar.update(count)

        firsts = range(0, total, chunk)
        try:
            # the first chunk alone: JAX may crash if two threads compile the same program
            work(firsts[0])
            with concurrent.futures.ThreadPoolExecutor(usable_cores()) as pool:
                try:
                    for each in [pool.submit(work, first) for first in firsts[1:]]:
                        each.result()
                except KeyboardInterrupt:
                    pool.shutdown(cancel_futures=True)
                    raise
            found = _join(system, settings, controls, chunks)
            for i in np.flatnonzero(~found.valid):
                _recover(found, int(i), settings, pose)
        except KeyboardInterrupt as stop:
            if chunks:
                stop.best = found or _join(system, settings, controls, chunks)  # type: ignore[attr-defined]
            raise
    return found


def _join(
    system: System, settings: Settings, controls: np.ndarray, chunks: dict[int, list[Any]]
) -> Workspace:
    """Return the samples of all chunks that were computed."""
    joined: list[Any] = [
        None if parts[0] is None else np.concatenate(parts)
        for parts in zip(*(chunks[first] for first in sorted(chunks)), strict=True)
    ]
    index, position, quaternion, residual, strain, result = joined
    result = np.where(residual <= settings.newton.acceptable, result, int(Result.NO_CONVERGENCE))
    return Workspace(system, controls[index], position, quaternion, ResultCodes.of(result), residual, strain)


def _recover(found: Workspace, i: int, settings: Settings, pose: Pose) -> None:
    """Replace sample i by the result of `kc.equilibrium` with its recoveries, solved or not."""
    rest = equilibrium(
        fix_grid(found.system),
        found.controls[i],
        space=settings.space,
        newton=settings.newton,
        on_failure="return",
        with_stability=False,
    )
    found.result[i], found.residual[i] = rest.result[0], rest.residual[0]
    position, quaternion = pose(found.system, rest.y[0, -1])
    found.position[i] = np.asarray(position)
    if found.quaternion is not None:
        found.quaternion[i] = np.asarray(quaternion)
    length = float(found.system.length)
    nodes = np.linspace(0.0, 1.0, found.system.nodes) * length
    changes = np.asarray(rest.z[0]) - np.stack([np.asarray(found.system.rest(s)[1]) for s in nodes])
    parts = found.system.z_layout.split(changes)
    found.strain[i] = [np.max(np.linalg.norm(part, axis=-1)) for part in parts]
