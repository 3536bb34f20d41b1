"""Arguments shared by several commands, and functions that read them."""

from __future__ import annotations

import contextlib
import os
import shlex
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from knode_cosserat._numbers import numbers_in
from knode_cosserat._reprs import count_of
from knode_cosserat._units import UnitError, numbers_with_units
from knode_cosserat.recordings.formats import read_suffixes
from knode_cosserat.rods.parameters import parameter_at
from knode_cosserat.rods.wrapped import nominal_model

if TYPE_CHECKING:
    from knode_cosserat.learning.ensemble import Ensemble
    from knode_cosserat.recordings.recording import Recording
    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory

#: endings of figure files
FORMATS = (".png", ".pdf", ".svg")
#: endings of recordings
RECORDINGS = read_suffixes()
#: kinds of files, see `io.container.kind_of`
TRAJECTORY, MODEL = "knode-cosserat trajectory", "knode-cosserat model"


def option(metavar: str, help: str, *names: str, **more: Any) -> Any:
    """Return an option of a command; by default its name is that of the argument."""
    return typer.Option(*names, metavar=metavar, help=help, **more)


def argument(metavar: str, help: str, **more: Any) -> Any:
    """Return an argument of a command."""
    return typer.Argument(metavar=metavar, help=help, **more)


ROBOT = "Name of a catalog robot (listed by `knode-cosserat info`), robot file (YAML), or fitted model."


def _robots(incomplete: str) -> list[str]:
    """Return the catalog's names for the shell's completion; the shell completes files itself."""
    from knode_cosserat.rods.robot_file import catalog

    return [name for name in catalog() if name.startswith(incomplete)]


Robot = Annotated[str, argument("ROBOT", ROBOT, autocompletion=_robots)]
Changes = Annotated[
    list[str] | None,
    option(
        "NAME=VALUE",
        "Change a parameter of the robot, or of a model's nominal robot, in SI units: length=0.4, "
        "gravity=0,0,-9.81. May be repeated.",
        "--set",
    ),
]
Nodes = Annotated[int | None, option("N", "Number of nodes along the rod, including base and tip.")]
Space = Annotated[
    str,
    option(
        "SCHEME",
        "Scheme along the rod: lobatto2 (order 2), lobatto4 (order 4) or euler (order 1, the paper's).",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout instead of text.")]
NetCDF = option("FILE", "Write the trajectory to this netCDF file (.nc).")
Picture = option("FILE", "Write the figure to this PNG, PDF or SVG file.")
Progress = Annotated[
    bool | None,
    typer.Option("--progress/--no-progress", help="Show progress on stderr.", show_default="on a terminal"),
]


# groups of options, which several commands have


class Nominal(NamedTuple):
    """Options that state a robot or a model, with its own nodes."""

    robot: Robot
    changes: Changes = None

    def load(self) -> System:
        """Return the robot or model."""
        return load_system(self.robot, self.changes)


class Model(NamedTuple):
    """Options that state a robot or a model, and its nodes."""

    robot: Robot
    changes: Changes = None
    nodes: Nodes = None

    def load(self) -> System:
        """Return the robot or model."""
        return load_system(self.robot, self.changes, self.nodes)


class Report(NamedTuple):
    """Options of progress and output."""

    progress: Progress = None
    as_json: Json = False

    @property
    def shows_progress(self) -> bool:
        """True if progress is shown: by option, or by default on a terminal."""
        return shows_progress(self.progress)


class Sampling(NamedTuple):
    """Options of the rows of recordings, and of their simulation.

    Options:
        config (--config YAML): Meaning of the recordings' topics or columns. Default: the paper's robot for
            bags; titles and comments for tables.
        start (--start S): Start time in the recording (s), at which the robot rests. Default: 0.
        seconds (--seconds S): Duration used (s). Default: to the end.
        dt (--dt S): Time between rows of a recording (s).
    """

    config: Path | None = None
    start: float | None = None
    seconds: float | None = None
    dt: float = 0.0125
    space: Space = "lobatto4"

    @property
    def end(self) -> float | None:
        """End of the rows (s); None: that of the recording."""
        return None if self.seconds is None else (self.start or 0.0) + self.seconds


# numbers


def parse_numbers(
    option: str, text: str, count: int | None = None, example: str = "7,5,5,7", unit: str | None = None
) -> list[float]:
    """Return the numbers of an option, separated by commas or spaces. All vector options are read by it.

    Numbers that have units are separated by commas.

    Args:
        option: name of the option, for errors.
        text: the given text.
        count: the required number of numbers; None: one or more.
        example: a valid text, for errors.
        unit: SI unit of the numbers; None: they have none.
    """
    try:
        numbers = numbers_with_units(text, [] if unit is None else [unit])
    except UnitError as error:
        raise ValueError(f"{option} is {text!r}: {error}") from None
    if numbers is None or (count is not None and len(numbers) != count):
        allowed = "numbers" if count is None else count_of(count, "number")
        raise ValueError(f"{option} must be {allowed}, such as {example} (got {text!r})")
    return numbers


def limits_of(robot: System, **texts: str | None) -> dict[str, Any]:
    """Return limits of a robot's controls by name from the texts of their options; None: not given.

    Numbers may have units; those of a `rate` are per second, such as 20 kPa/s.
    """
    from knode_cosserat.controls import completed_limits, units

    given: dict[str, Any] = dict(texts)
    for name, text in texts.items():
        if text is not None:
            per = "/s" if name == "rate" else ""
            given[name] = parse_limits(
                f"--{name}", text, [f"{unit or 1}{per}" for unit in units(robot.control_layout)]
            )
    return completed_limits(robot.control_layout, given, options=True)


def parse_limits(option: str, text: str, units: Sequence[str]) -> float | list[float]:
    """Return the limits of controls in their units: one number for all, or one for each."""
    # one number with a unit has to have the unit of every control
    is_one = numbers_in(text) is None and not {",", ";"} & set(text)
    words = ",".join([text] * len(units)) if is_one else text
    try:
        numbers = numbers_with_units(words, units)
    except UnitError as error:
        raise ValueError(f"{option} is {text!r}: {error}") from None
    if numbers is None or len(numbers) not in (1, len(units)):
        raise ValueError(
            f"{option} must be one number for all controls, or {len(units)}, one for each (got {text!r})"
        )
    return numbers[0] if len(numbers) == 1 else numbers


# robots and models


def load_system(name: str, changes: list[str] | None = None, nodes: int | None = None) -> System:
    """Return a robot or model by name or path, with the parameters of `--set` and `--nodes`.

    The content of a file decides its type.
    """
    import knode_cosserat as kc
    from knode_cosserat.io.container import kind_of

    if name in kc.catalog():
        return modified(kc.load_robot(name), changes, nodes)
    kind = kind_of(name)
    if kind == TRAJECTORY:
        raise ValueError(f"{name}: this is a trajectory; allowed is a robot or a model")
    if is_recording(name):
        raise ValueError(
            f"{name}: this is a recording or table; allowed is a robot or a model. To check a recording, "
            f"type: {command_line('inspect', name)}"
        )
    if kind in (MODEL, "HDF5"):
        return modified(kc.load_model(name), changes, nodes)
    if os.path.isdir(name):
        raise ValueError(
            f"{name}: this is a folder; allowed is a robot or a model, such as one file of an ensemble"
        )
    return modified(kc.load_robot(name), changes, nodes)


def load_ensemble_folder(name: str, changes: list[str] | None) -> Ensemble | None:
    """Return the ensemble in a folder, with the parameters of `--set`; None if it is not a folder."""
    import knode_cosserat as kc

    if name in kc.catalog() or not os.path.isdir(name):
        return None
    from knode_cosserat.learning.ensemble import Ensemble, load_ensemble

    members: Any = [modified(member, changes) for member in load_ensemble(name)]
    return Ensemble(members)


def modified(system: System, changes: list[str] | None, nodes: int | None = None) -> System:
    """Return the robot with the parameters of `--set` and `--nodes`."""
    import yaml

    values: dict[str, Any] = {} if nodes is None else {"nodes": nodes}
    for change in changes or ():
        name, equals, text = (part.strip() for part in change.partition("="))
        try:
            value = _parse_value(text)
        except yaml.YAMLError:
            equals = ""
        if not (name and equals):
            raise ValueError(
                f"--set must be NAME=VALUE, such as length=0.4 or gravity=0,0,-9.81 (got {change!r})"
            )
        if name in values:
            other = "--nodes" if name == "nodes" and nodes is not None else "another --set"
            raise ValueError(f"--set {change!r}: {name} is given by {other} too; allowed is each name once")
        stated = parameter_at(nominal_model(system), name)
        values[name] = value if stated is None else stated.in_si(name, value)
    changed = system.replace(**values)
    if "tendon_offset" in values:
        from knode_cosserat.rods.robot_file import warn_of_paper_tendons

        warn_of_paper_tendons(nominal_model(changed), "--set tendon_offset")
    return changed


def _parse_value(text: str) -> Any:
    """Return a parameter's value from YAML, or from numbers with separators. Raises `yaml.YAMLError`."""
    import yaml

    value = yaml.safe_load(text)
    # PyYAML reads YAML 1.1, in which 10e9 is text
    if isinstance(value, str) or (isinstance(value, list) and any(isinstance(part, str) for part in value)):
        numbers = numbers_in(text)
        if numbers is not None:
            return numbers[0] if len(numbers) == 1 and isinstance(value, str) else numbers
    return value


# files


def is_trajectory(name: str) -> bool:
    """True if a file is a trajectory by its content, or by its ending if there is no such file."""
    from knode_cosserat.io.container import kind_of

    return Path(name).suffix == ".nc" or kind_of(name) == TRAJECTORY


def is_recording(name: str) -> bool:
    """True if a file is a bag or a table by its ending, and not a trajectory by its content."""
    from knode_cosserat.io.container import kind_of

    return name.lower().endswith(RECORDINGS) and kind_of(name) != TRAJECTORY


def command_line(*words: str | Path) -> str:
    """Return a command of this program as it is typed in a shell."""
    return shlex.join(["knode-cosserat", *map(str, words)])


def load_trajectory_file(path: Path) -> Trajectory:
    """Return the trajectory in a file, of a robot or of a model."""
    import knode_cosserat as kc

    if is_recording(str(path)) and path.exists():
        raise ValueError(
            f"{path}: this is a recording or table; allowed is a trajectory (.nc) with full states. To check "
            f"a recording, type: {command_line('inspect', path)}"
        )
    return kc.load_trajectory(path)


def trajectories_by_name(files: Sequence[str | Path]) -> dict[str, Trajectory]:
    """Return the trajectories by the stems of their files, or by paths if stems are equal."""
    stems = [Path(file).stem for file in files]
    trajectories: dict[str, Trajectory] = {}
    for file, stem in zip(files, stems, strict=True):
        name = stem if stems.count(stem) == 1 else str(file)
        while name in trajectories:
            name += " (again)"
        trajectories[name] = load_trajectory_file(Path(file))
    return trajectories


def require_writable(
    file: Path | None = None, figure: Path | None = None, folders: Sequence[Path | None] = ()
) -> None:
    """Raise `ValueError` if an output cannot be written: before a long computation, not after it.

    Folders need not exist.
    """
    for path in (file, figure):
        if path and not path.parent.is_dir():
            raise ValueError(f"{path}: there is no folder {path.parent}; create it, or give another path")
        if path and path.is_dir():
            raise ValueError(f"{path}: this is a folder; allowed is a file")
    if figure and figure.suffix not in FORMATS:
        raise ValueError(f"{figure}: the name of a figure must end in {', '.join(FORMATS)}")
    for path in (file, figure, *folders):
        if path:
            _try_to_write(path, folder=path in folders, replaced=path is file)


def _try_to_write(path: Path, *, folder: bool, replaced: bool) -> None:
    """Raise `ValueError` if writing fails. Permissions alone do not show a read-only disk."""
    # files are written to a temporary file in the same folder (`_files.replacing`), figures are overwritten
    over = path.exists() and not folder and not (replaced and path.is_file())
    at = path if folder else Path(os.path.realpath(path)).parent
    while folder and not at.exists():
        at = at.parent
    if folder and not at.is_dir():
        raise ValueError(f"{path}: {'this' if at == path else at} is a file; allowed is a folder")
    try:
        with path.open("ab") if over else tempfile.TemporaryFile(dir=at):
            pass
    except OSError as error:
        where = "" if over or at == path else f" in {at}"
        raise ValueError(f"{path}: nothing can be written{where}: {error.strerror}") from None


def require_trajectory_name(path: Path | None) -> None:
    """Raise `ValueError` if the name of a netCDF output has the ending of another type of file."""
    if path and path.name.lower().endswith((*RECORDINGS, *FORMATS, ".yaml", ".yml", ".json", ".npz")):
        raise ValueError(
            f"{path}: the name of a trajectory must end in .nc. Did you mean {path.with_suffix('.nc')}?"
        )


@contextlib.contextmanager
def coarse_grid_in_output() -> Iterator[None]:
    """Suppress the warning of a coarse grid, for commands whose output states it."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the grid is too coarse")
        yield


def load_recordings(paths: Sequence[Path], config: Path | None, *, proposals: bool = True) -> list[Recording]:
    """Return the recordings in files, read by a configuration file if there is one.

    `motors.csv+mocap.csv` is one recording in several files. With `proposals` an error about other columns or
    topics names the command that proposes a configuration.
    """
    from knode_cosserat.recordings.config import RecordingConfig
    from knode_cosserat.recordings.findings import RecordingError
    from knode_cosserat.recordings.load import load_recording

    meaning = None if config is None else RecordingConfig.load(config)
    recordings = []
    for path in paths:
        files = files_of(path)
        for file in files:
            if is_trajectory(str(file)):
                raise ValueError(
                    f"{file}: this is a trajectory; allowed is a recording ({', '.join(RECORDINGS)}). "
                    f"To draw a trajectory, type: {command_line('plot', file, '--out', file.stem + '.png')}. "
                    f"To learn a model from it, type: {command_line('fit', 'ROBOT', file, '--out', 'model')}"
                )
        try:
            recordings.append(load_recording(files if len(files) > 1 else files[0], meaning))
        except RecordingError as error:
            columns = config is None and ("the columns are" in str(error) or "is missing" in str(error))
            hint = "; or describe its own names in a YAML file with --config" + (
                f" ({command_line('inspect', *files)} proposes one)" if proposals else ""
            )
            raise ValueError(f"{error}{hint if columns else ''}") from None
    return recordings


def files_of(path: Path) -> list[Path]:
    """Return the files of a recording that is written as FILE+FILE; a file of this very name is one."""
    if "+" not in str(path) or path.exists():
        return [path]
    return [Path(part) for part in str(path).split("+") if part]


def shows_progress(progress: bool | None) -> bool:
    """True if progress is shown: by option, or by default on a terminal."""
    return sys.stderr.isatty() if progress is None else progress


def figures() -> Any:
    """Return the module of figures. Raises `ImportError` without matplotlib."""
    from knode_cosserat import figures
    from knode_cosserat.figures.style import require_matplotlib

    require_matplotlib()
    return figures
