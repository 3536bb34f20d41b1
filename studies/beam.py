"""Study of a real silicone beam: identified from training recordings, tested on held-out ones.

The beam is clamped, held by hand and released. Recordings are CSV files of motion-capture markers: columns
`time_s` and `mK_x_m`, `mK_y_m`, `mK_z_m`, markers 0 to 2 on the tip and 3 to 5 on the base; x points up, z
along the beam. A file's name states the load: `…load52…` for 52 g at the tip, `…gravity…` for none. In the
model the held beam is the equilibrium under a vertical force of the hand at the tip that reproduces the
measured height of the tip. At the release this force vanishes.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from knode_cosserat._files import csv_rows
from knode_cosserat._files.reading import read_bytes
from knode_cosserat.figures.comparison import REFERENCE, legend_below
from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure
from knode_cosserat.recordings.findings import RecordingError, naming
from knode_cosserat.recordings.formats.csv_table import read_csv
from knode_cosserat.recordings.table import columns_of
from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.loads import AttachedMass, PointWrench
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory
from studies.report import Report, markdown_table, write_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: markers on the tip, and on the base
TIP, BASE = (0, 1, 2), (3, 4, 5)
COLUMNS = ("time_s", *(f"m{k}_{axis}_m" for k in TIP + BASE for axis in "xyz"))
#: drop of the tip (m) that aligns the clocks of recording and prediction; the noise and the creep of the
#: hand before the release are both below 0.1 mm
THRESHOLD = 2e-3
#: rows before the threshold that may already belong to the fall or to the release by the hand
MARGIN = 10
#: the fewest rows of a held beam
FEWEST_HELD = 5
#: rows in which the tip must stay below the threshold: a glitch of one row is not a release
LASTING = 4


@dataclasses.dataclass(frozen=True)
class BeamRecording:
    """Marker trajectories of a beam, its load and its release time."""

    name: str
    #: (T,) s
    time: Float[np.ndarray, " T"]
    #: (T, 3 markers, 3) displacements (m) from the held positions; NaN where a marker is lost
    tip: Float[np.ndarray, "T 3 3"]
    #: (3 markers, 3) tip positions (m) while the beam was held
    held: Float[np.ndarray, "3 3"]
    #: (3 markers, 3) base positions (m) while the beam was held
    base: Float[np.ndarray, "3 3"]
    #: mass of the load (kg)
    load: float
    #: time at which the tip has dropped by `THRESHOLD` (s)
    crossing: float

    @property
    def drop(self) -> Float[np.ndarray, " T"]:
        """Drop of the tip from its held position (m), averaged over its markers."""
        return tip_drop(self.tip)


def tip_drop(moved: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, " T"]:
    """Return the mean drop (m) of markers from their displacements; NaN where a marker is lost."""
    return -np.asarray(moved[:, :, 0].mean(axis=1))


def load_of(name: str) -> float:
    """Return the mass of the load (kg) stated by a file's name.

    Raises:
        RecordingError: the name states no load.
    """
    grams = re.search(r"load[_-]?(\d+(?:\.\d+)?)", name, re.IGNORECASE)
    if grams:
        return 1e-3 * float(grams.group(1))
    if "gravity" in name.lower():
        return 0.0
    raise RecordingError(
        f"{name}: the name tells no load; allowed is a name with load<grams>, such as beam_load52_a.csv, or "
        "with gravity (no load); or give the load of each such file by --load NAME=GRAMS"
    )


def read_beam(path: Path, load: float | None = None) -> BeamRecording:
    """Read a beam's recording.

    Args:
        path: the CSV file.
        load: mass at the tip (kg); None: taken from the file's name.

    Raises:
        RecordingError: the file is invalid, its load is unknown, or the beam is never released.
    """
    load = load_of(path.stem) if load is None else load
    with naming(path):
        table = read_csv(read_bytes(path, csv_rows.LARGEST_FILE)).numbers
    missing = [name for name in COLUMNS if name not in table.columns]
    if missing:
        raise RecordingError(
            f"{path}: the column {missing[0]} is missing; needed are time_s and mK_x_m, mK_y_m, mK_z_m "
            "of the markers 0 to 5"
        )
    titles = list(table.columns)
    with naming(path):
        values = columns_of(table, [titles.index(name) for name in COLUMNS])
    time, markers = values[:, 0], values[:, 1:].reshape(-1, len(TIP + BASE), 3)
    if not np.all(np.diff(time) > 0.0):
        raise RecordingError(f"{path}: time_s does not grow from row to row")
    crossing, first = find_release(time, markers[:, TIP], str(path))
    held = np.nanmedian(markers[:first], axis=0)
    if not np.all(np.isfinite(held)):
        lost = int(np.argwhere(~np.isfinite(held))[0, 0])
        raise RecordingError(f"{path}: marker {lost} is lost all the time before the beam is let go")
    tip = markers[:, TIP] - held[list(TIP)]
    return BeamRecording(path.stem, time, tip, held[list(TIP)], held[list(BASE)], load, crossing)


def find_release(
    time: Float[np.ndarray, " T"], tip: Float[np.ndarray, "T 3 3"], source: str
) -> tuple[float, int]:
    """Return the time at which the tip has dropped by `THRESHOLD` (s), and the number of held rows.

    The held level is the running median of the earlier rows. Slow creep of the hand and glitches are
    therefore not detected as a fall.

    Raises:
        RecordingError: the tip never drops lastingly by the threshold, or it is not held before.
    """
    # the median of the markers would jump where one is lost
    height = np.asarray(tip[:, :, 0].mean(axis=1))
    for row in range(MARGIN + FEWEST_HELD, len(height) - LASTING):
        level = (
            np.nanmedian(height[: row - MARGIN]) if np.any(np.isfinite(height[: row - MARGIN])) else np.nan
        )
        lasting = level - height[row : row + LASTING]
        if np.any(lasting > THRESHOLD) and not np.any(lasting <= THRESHOLD):
            break
    else:
        raise RecordingError(
            f"{source}: no release found: after at least {MARGIN + FEWEST_HELD} rows in which the beam is "
            f"held, the markers m0 to m2 have to drop by more than {1e3 * THRESHOLD:g} mm along x"
        )
    held = row - MARGIN
    drop = tip_drop(tip - np.nanmedian(tip[:held], axis=0))
    # rows in which every marker is seen, on both sides of the threshold
    seen = np.flatnonzero(np.isfinite(drop))
    after = next((k for k in seen if k >= held and drop[k] > THRESHOLD), None)
    before = seen[:0] if after is None else seen[seen < after]
    if after is None or not len(before):
        raise RecordingError(f"{source}: no release found: a marker of m0 to m2 is lost all the time")
    return float(np.interp(THRESHOLD, drop[[before[-1], after]], time[[before[-1], after]])), held


#: the beam of srl-ethz/diffPD_sim2real (RA-L 2022, arXiv 2201.12560): m, m, kg/m³
LENGTH, WIDTH, DENSITY, POISSON = 0.1, 0.03, 1070.0, 0.499
GRAVITY = 9.81
#: markers 0 to 2 from the centre of the end face (m)
MARKERS = np.array([[0.021, 0.0, 0.0], [0.009, 0.021, 0.0], [-0.009, -0.021, 0.0]])
#: the load hangs at the upper edge of the end face
UPPER_EDGE = (WIDTH / 2, 0.0, 0.0)
#: in time: at 2.5 ms the beam's fastest motion that is seen (8 Hz) is damped by less than 0.1 % of critical
TIME = "bdf-alpha"
#: time of a prediction (s) beyond that of the recording after the threshold
LEAD = 0.1
#: terms of the series of the torsion constant
TERMS = 20


class Numerics(NamedTuple):
    """Numerical settings: nodes along the rod, and time step (s)."""

    nodes: int = 11
    dt: float = 2.5e-3


#: settings of the studies
DEFAULT = Numerics()


@dataclasses.dataclass(frozen=True)
class Beam:
    """Parameters of the beam and of its rig; the identification fits them."""

    #: Young's modulus at rest (Pa)
    youngs_modulus: float
    #: Kelvin-Voigt damping over stiffness (s)
    damping_time: float
    #: stiffness of the Maxwell branch over that at rest, and its relaxation time (s)
    branch_stiffness: float = 0.0
    relaxation_time: float = 0.1
    #: the clamped end points down by this angle (rad)
    tilt: float = 0.0
    #: height (m) of the unloaded tip over the mean of the base's markers; None: where it was held
    level: float | None = None


def shear_factor(poisson: float = POISSON) -> float:
    """Return the shear correction factor of a rectangle, 10 (1 + ν) / (12 + 11 ν) (Cowper 1966)."""
    return 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson)


def torsion_constant(width: float = WIDTH) -> float:
    """Torsion constant of a square section (m⁴), Saint-Venant's series: 0.1406 times the fourth power."""
    odd = 2.0 * np.arange(TERMS) + 1.0
    series = float(np.sum(np.tanh(odd * np.pi / 2.0) / odd**5))
    return width**4 * (1.0 / 3.0 - 64.0 / np.pi**5 * series)


def beam_rod(beam: Beam, load: float, nodes: int) -> SlenderRod:
    """Return the rod of a beam with a load (kg); its control is the vertical force of the hand (N).

    The rod's own section is round. Its radius gives the square's area; its rotary inertia is 4.5 % less than
    the square's, and stiffness and damping are given as matrices.
    """
    E, G = beam.youngs_modulus, beam.youngs_modulus / (2.0 * (1.0 + POISSON))
    area, second_moment = WIDTH**2, WIDTH**4 / 12.0
    shear = shear_factor() * G * area
    Kse = np.diag([shear, shear, E * area])
    Kbt = np.diag([E * second_moment, E * second_moment, G * torsion_constant()])
    half = 0.5 * beam.tilt
    return SlenderRod(
        length=LENGTH,
        radius=WIDTH / np.sqrt(np.pi),
        density=DENSITY,
        youngs_modulus=E,
        shear_modulus=G,
        shear_stiffness=Kse,
        bending_stiffness=Kbt,
        shear_damping=beam.damping_time * Kse,
        bending_damping=beam.damping_time * Kbt,
        effects=(Relaxation(beam.branch_stiffness, beam.relaxation_time, shear=True),),
        gravity=(-GRAVITY, 0.0, 0.0),
        nodes=nodes,
        base_end=Clamped(orientation=(np.cos(half), 0.0, -np.sin(half), 0.0)),
        loads=(
            AttachedMass(mass=load, offset=UPPER_EDGE),
            PointWrench(force=(1.0, 0.0, 0.0), controlled=True),
        ),
    )


def tip_height(recording: BeamRecording) -> float:
    """Return the height (m) of the held end face over the mean of the base's markers."""
    return float(np.mean(recording.held[:, 0] - MARKERS[:, 0]) - np.mean(recording.base[:, 0]))


def held_beam(rod: SlenderRod, load: float, deflection: float) -> Trajectory:
    """Return the equilibrium with the tip held at a height (m) over that of the unloaded beam.

    The height is so nearly linear in the hand's force that two forces give the third.
    """
    height = deflection + float(rod.rest(LENGTH)[0][0])
    weight = GRAVITY * load
    forces = [weight + part * GRAVITY * DENSITY * WIDTH**2 * LENGTH for part in (0.375, 0.25)]
    heights = [_settled(rod, force).tip_position[0, 0] for force in forces]
    slope = (forces[1] - forces[0]) / (heights[1] - heights[0])
    return _settled(rod, forces[0] + slope * (height - heights[0]))


def _settled(rod: SlenderRod, force: float) -> Trajectory:
    return equilibrium(rod, np.array([force]))


def step_count(recordings: list[BeamRecording], dt: float) -> int:
    """Return the number of time steps that predicts each of several recordings: one program for all."""
    # the beam falls for 20 to 30 ms before it crosses the threshold
    longest = max(each.time[-1] - each.crossing for each in recordings) + LEAD
    return int(np.ceil(longest / dt))


def markers_of(motion: Trajectory) -> Float[np.ndarray, "T 3 3"]:
    """Return the displacements (m) of the markers from the first row."""
    p, h = np.asarray(motion.tip_position), np.asarray(motion.quaternion)[:, -1]
    turned = Rotation.from_quat(h, scalar_first=True).as_matrix()
    positions = p[:, None] + np.einsum("tij,kj->tki", turned, MARKERS)
    return positions - positions[0]


def predict_markers(
    beam: Beam, recording: BeamRecording, steps: int, numerics: Numerics = DEFAULT
) -> Float[np.ndarray, "T 3 3"]:
    """Return the markers' displacements (m) at the times of a recording; NaN before the release.

    The prediction is put on the recording's clock where both tips have dropped by `THRESHOLD`.
    """
    rod = beam_rod(beam, recording.load, numerics.nodes)
    held = held_beam(rod, recording.load, 0.0 if beam.level is None else tip_height(recording) - beam.level)
    motion = simulate(
        rod, np.zeros((steps, 1)), numerics.dt, time=TIME, start="paper", initial=held, on_failure="return"
    )
    moved = markers_of(motion)
    drop, times = tip_drop(moved), np.arange(steps + 1) * numerics.dt
    row = int(np.argmax(drop > THRESHOLD))
    if not row:
        return np.full((len(recording.time), 3, 3), np.nan)
    crossing = np.interp(THRESHOLD, drop[row - 1 : row + 1], times[row - 1 : row + 1])
    at = recording.time - recording.crossing + crossing
    columns = moved.reshape(len(times), -1).T
    found = np.stack([np.interp(at, times, each, left=np.nan) for each in columns], axis=1)
    return found.reshape(-1, 3, 3)


#: Young's modulus published with the recordings (Pa); the other parameters are initial values
NOMINAL = Beam(youngs_modulus=263_824.0, damping_time=5e-3)
#: from a branch of 0.1 and 0.1 s the search stops in a flat valley, with 0.697 mm on the training recordings
#: instead of 0.685
START = dataclasses.replace(NOMINAL, damping_time=2e-3, branch_stiffness=0.3, relaxation_time=0.05)
#: positive numbers are searched by their logarithms, between these factors of where the search begins
POSITIVE = {"youngs_modulus": 30.0, "damping_time": 300.0, "branch_stiffness": 100.0, "relaxation_time": 30.0}
#: others are searched in these units, so far at most to both sides
FREE = {"tilt": (0.05, 0.3), "level": (1e-3, 0.01)}
#: residuals are in millimetres; a row that cannot be predicted counts so much
LOST = 100.0
#: step of the difference quotients, in the units of the search; its tolerances
STEP, TOLERANCE = 1e-3, 3e-3


def marker_rmse(predicted: Float[np.ndarray, "T 3 3"], recording: BeamRecording) -> float:
    """Return the root mean square (m) of the distances over rows after the release and tip markers."""
    released = np.isfinite(predicted).all(axis=(1, 2))
    distances = np.linalg.norm((predicted - recording.tip)[released], axis=2)
    return float(np.sqrt(np.nanmean(distances**2)))


def identify_beam(
    recordings: Sequence[BeamRecording],
    steps: int,
    numerics: Numerics = DEFAULT,
    progress: Callable[[str], None] = lambda line: None,
) -> Beam:
    """Return the beam whose parameters fit the training recordings best.

    Each recording has the same weight, independent of its number of rows.
    """
    start = dataclasses.replace(START, level=float(np.mean([tip_height(each) for each in recordings])))
    names = (*POSITIVE, *FREE)
    calls = 0

    def residuals(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, " r"]:
        nonlocal calls
        calls += 1
        beam = _moved(start, x)
        return np.concatenate([_residual(beam, each, steps, numerics) for each in recordings])

    def jacobian(x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "r k"]:
        here = residuals(x)
        progress(f"evaluation {calls}: {np.sqrt(np.sum(here**2) / len(recordings)):.3f} mm RMSE")
        return np.stack([(residuals(x + step) - here) / STEP for step in STEP * np.eye(len(x))], axis=1)

    most = np.array([*np.log(list(POSITIVE.values())), *(most / unit for unit, most in FREE.values())])
    found = scipy.optimize.least_squares(
        residuals, np.zeros(len(names)), jacobian, bounds=(-most, most), xtol=TOLERANCE, ftol=TOLERANCE
    )
    return _moved(start, found.x)


def _moved(start: Beam, x: Float[np.ndarray, " k"]) -> Beam:
    """Return the beam at a point of the search, which begins at zero."""
    changes: dict[str, float] = dict(zip((*POSITIVE, *FREE), x.tolist(), strict=True))
    values = {name: getattr(start, name) * math.exp(changes[name]) for name in POSITIVE}
    values |= {name: getattr(start, name) + unit * changes[name] for name, (unit, _) in FREE.items()}
    return dataclasses.replace(start, **values)


def _residual(
    beam: Beam, recording: BeamRecording, steps: int, numerics: Numerics
) -> Float[np.ndarray, " r"]:
    """Return the scaled residuals (mm) of rows from the threshold on; their squares sum to the MSE."""
    rows = recording.time >= recording.crossing
    left = 1e3 * (predict_markers(beam, recording, steps, numerics) - recording.tip)[rows]
    seen = np.isfinite(recording.tip[rows])
    left = np.where(seen, np.nan_to_num(left, nan=LOST), 0.0)
    return np.asarray(left.ravel()) / math.sqrt(max(int(np.count_nonzero(seen.all(axis=2))), 1))


#: names of the files
PATTERN = "beam_*.csv"
#: the default training recordings, if they are there
TRAIN = ("beam_gravity_V2_b", "beam_load52_V2_a")
#: the numbers of a beam as the table has them: title, factor, unit
QUANTITIES = {
    "youngs_modulus": ("Young's modulus at rest", 1e-3, "kPa"),
    "damping_time": ("Kelvin-Voigt damping over stiffness", 1e3, "ms"),
    "branch_stiffness": ("stiffness of the Maxwell branch over that at rest", 1.0, ""),
    "relaxation_time": ("relaxation time of the Maxwell branch", 1.0, "s"),
    "tilt": ("downward tilt of the clamp", 1e3, "mrad"),
    "level": ("height of the unloaded tip over the base's markers", 1e3, "mm"),
}

Predictions = Mapping[str, Mapping[str, Float[np.ndarray, "T 3 3"]]]


def read_folder(folder: Path, loads: Mapping[str, float] | None = None) -> list[BeamRecording]:
    """Read all recordings of a folder, in the order of their names.

    Args:
        folder: has `beam_*.csv`.
        loads: masses (kg) by file name without suffix, for names that do not state the load.

    Raises:
        RecordingError: there is no recording, or one is invalid.
    """
    loads = loads or {}
    paths = sorted(folder.glob(PATTERN)) if folder.is_dir() else []
    if not paths:
        raise RecordingError(f"{folder}: no recordings found; allowed is a folder with {PATTERN}")
    unknown = [name for name in loads if name not in {path.stem for path in paths}]
    if unknown:
        raise RecordingError(_no_such(folder, "--load", unknown[0], [path.stem for path in paths]))
    return [read_beam(path, loads.get(path.stem)) for path in paths]


def training_names(recordings: Sequence[BeamRecording]) -> list[str]:
    """Return the default training recordings: `TRAIN`, or the first with each of the two lightest loads."""
    if set(TRAIN) <= {each.name for each in recordings}:
        return list(TRAIN)
    found: dict[float, str] = {}
    for each in recordings:
        found.setdefault(each.load, each.name)
    return [found[load] for load in sorted(found)[:2]]


def rerun(
    out: Path,
    folder: Path,
    train: Sequence[str] | None = None,
    loads: Mapping[str, float] | None = None,
    numerics: Numerics = DEFAULT,
    tell: Callable[[str], None] = lambda line: None,
) -> Report:
    """Identify the beam from the training recordings, predict all, and write errors, a table and a figure.

    Args:
        out: the output folder.
        folder: the folder of recordings.
        train: names of the training recordings, without suffixes; None: `training_names`.
        loads: masses (kg) by name, for names that do not state the load.
        numerics: nodes and time step of every rollout.
        tell: callback that receives a line for each iteration.

    Raises:
        RecordingError: a recording is invalid, or does not exist.
    """
    recordings = read_folder(folder, loads)
    by_name = {each.name: each for each in recordings}
    names = training_names(recordings) if train is None else list(dict.fromkeys(train))
    for name in names:
        if name not in by_name:
            raise RecordingError(_no_such(folder, "--train", name, list(by_name)))
    if not names:
        raise RecordingError("--train names no recording; at least one is needed")
    steps = step_count(recordings, numerics.dt)
    beam = identify_beam([by_name[name] for name in names], steps, numerics, tell)
    beams = {"nominal": NOMINAL, "identified": beam}
    predictions = {
        each.name: {method: predict_markers(beam, each, steps, numerics) for method, beam in beams.items()}
        for each in recordings
    }
    cells = _cells(recordings, names, predictions)
    figures = {"beam": drops(recordings, predictions, names)}
    return write_report(out, "beam", cells, as_markdown(cells, beam), figures)


def _no_such(folder: Path, option: str, name: str, known: Sequence[str]) -> str:
    return f"{option}: there is no recording {name!r} in {folder}; there are {', '.join(known)}"


def _cells(
    recordings: Sequence[BeamRecording], train: Sequence[str], predictions: Predictions
) -> list[dict[str, Any]]:
    """Return a cell for each recording and method."""
    cells: list[dict[str, Any]] = []
    for each in recordings:
        for method, predicted in predictions[each.name].items():
            rmse = marker_rmse(predicted, each)
            about = {"file": f"{each.name}.csv", "method": method}
            solved = {"rmse": rmse} if np.isfinite(rmse) else {"rmse": None, "failed": "the rollout diverged"}
            released = np.flatnonzero(np.isfinite(predicted).all(axis=(1, 2)))
            window = [float(each.time[k]) for k in released[[0, -1]]] if len(released) else None
            use = "train" if each.name in train else "held out"
            cells.append({**about, **solved, "use": use, "load": each.load, "window": window})
    return cells


def as_markdown(cells: Sequence[Mapping[str, Any]], beam: Beam) -> str:
    """Return Markdown with the errors of every recording and the identified parameters."""
    methods = list(dict.fromkeys(cell["method"] for cell in cells))
    rows = []
    for name in dict.fromkeys(cell["file"] for cell in cells):
        own = {cell["method"]: cell for cell in cells if cell["file"] == name}
        first = own[methods[0]]
        window = "" if first["window"] is None else "{:.2f} to {:.2f}".format(*first["window"])
        said = ["failed" if own[it]["rmse"] is None else f"{1e3 * own[it]['rmse']:.2f}" for it in methods]
        rows.append([name, f"{1e3 * first['load']:g}", first["use"], window, *said])
    heads = ["recording", "load [g]", "use", "window [s]", *(f"{method} [mm]" for method in methods)]
    numbers = [
        [title, f"{factor * value:.4g} {unit}".strip()]
        for (title, factor, unit), value in zip(
            QUANTITIES.values(), (getattr(beam, name) for name in QUANTITIES), strict=True
        )
    ]
    return (
        "\n\n".join(
            [
                "# A real beam of silicone, let go by hand",
                "RMSE of the tip markers: the root mean square of the distances between predicted and\n"
                "measured markers, over three markers and all rows from the release to the end of the\n"
                "recording. `nominal` has the Young's modulus of the recordings' authors, 263,824 Pa, and a\n"
                "damping time of 5 ms; `identified` has the numbers below, from the recordings that are\n"
                "marked train.",
                markdown_table(heads, rows),
                "## Identified numbers",
                markdown_table(["quantity", "value"], numbers),
            ]
        )
        + "\n"
    )


#: line styles of predictions, by method
LINES: dict[str, dict[str, Any]] = {
    "nominal": {"color": PALETTE[1], "linewidth": 0.8},
    "identified": {"color": PALETTE[0], "linewidth": 1.0},
}
#: duration of the enlarged motion after the release (s)
SHOWN = 1.5


def drops(
    recordings: Sequence[BeamRecording],
    predictions: Mapping[str, Mapping[str, Float[np.ndarray, "T 3 3"]]],
    train: Collection[str],
) -> Figure:
    """Return a figure of the tip drop over time, a row per recording: first 1.5 s left, all right.

    Raises:
        ImportError: matplotlib is not installed.
    """
    with new_figure(TWO_COLUMNS, 1.7 * len(recordings) + 0.4) as figure:
        grid = figure.subplots(len(recordings), 2, squeeze=False, width_ratios=(1.6, 1.0), sharey="row")
        for row, each in zip(grid, recordings, strict=True):
            time = each.time - each.crossing
            for axes in row:
                axes.plot(time, 1e3 * each.drop, label="measured", **REFERENCE)
                for method, predicted in predictions[each.name].items():
                    axes.plot(time, 1e3 * tip_drop(predicted), label=method, **LINES[method])
                axes.invert_yaxis()
            use = "training" if each.name in train else "held out"
            row[0].set(ylabel="tip drop [mm]", xlim=(-0.1, SHOWN))
            row[0].set_title(f"load {1e3 * each.load:g} g, {use} ({each.name})")
            row[1].set_xlim(-0.1, float(time[-1]))
        for axes in grid[-1]:
            axes.set_xlabel("time from the release [s]")
        legend_below(figure, grid[:1, 0])
    return figure
