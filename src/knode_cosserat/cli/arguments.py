"""Arguments of several commands, and reading what was given for them."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from knode_cosserat.learning.ensemble import Ensemble
    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory

#: file formats of figures
FORMATS = (".png", ".pdf", ".svg")
#: first bytes of netCDF-4 files, and of model files
TRAJECTORY_MARK, MODEL_MARK = b"\x89HDF", b"knode-cosserat model,"

ROBOT = "A robot of the catalog (`knode-cosserat info` lists them), a YAML file, or a model that was fitted."


def _robots(incomplete: str) -> list[str]:
    """For the shell: what the catalog has; files it completes by itself."""
    from knode_cosserat.rods.robot_file import catalog

    return [name for name in catalog() if name.startswith(incomplete)]


Robot = Annotated[str, typer.Argument(metavar="ROBOT", help=ROBOT, autocompletion=_robots)]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Change a parameter of the robot (or knowledge); may be repeated."
    ),
]
Nodes = Annotated[int | None, typer.Option(metavar="N", help="Nodes along the rod, base and tip included.")]
Space = Annotated[
    str,
    typer.Option(
        metavar="SCHEME",
        help="Scheme along the rod: lobatto2 (order 2), lobatto4 (order 4), or euler (order 1, the paper's).",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and nothing else.")]
NetCDF = typer.Option(metavar="FILE", help="Write the states to this netCDF file.")
Picture = typer.Option(metavar="FILE", help="Write the figure to this PNG, PDF or SVG file.")
Progress = Annotated[
    bool | None,
    typer.Option(
        "--progress/--no-progress", help="Progress bar on stderr.", show_default="if it is a terminal"
    ),
]


# robots and models


def system_of(name: str, changes: list[str] | None = None, nodes: int | None = None) -> System:
    """The robot or model that a name or path stands for, with the parameters of `--set` and `--nodes`.

    A file's content decides what it is.
    """
    import knode_cosserat as kc

    if name not in kc.catalog() and _begins(name, TRAJECTORY_MARK):
        raise ValueError(f"{name}: this is a trajectory; allowed is a robot or a model")
    if name not in kc.catalog() and _begins(name, MODEL_MARK):
        from knode_cosserat.learning.files.model_file import load_model

        return changed(load_model(name), changes, nodes)
    if name not in kc.catalog() and os.path.isdir(name):
        raise ValueError(
            f"{name}: this is a folder; allowed is a robot or a model, such as one in an ensemble's"
        )
    return changed(kc.load_robot(name), changes, nodes)


def ensemble_of(name: str, changes: list[str] | None) -> Ensemble | None:
    """The ensemble in a folder, with the parameters of `--set`; None if it is not a folder."""
    import knode_cosserat as kc

    if name in kc.catalog() or not os.path.isdir(name):
        return None
    from knode_cosserat.learning.ensemble import Ensemble, load_ensemble

    members: Any = [changed(member, changes) for member in load_ensemble(name)]
    return Ensemble(members)


def changed(system: System, changes: list[str] | None, nodes: int | None = None) -> System:
    """The robot with the parameters of `--set` and `--nodes`."""
    import yaml

    values: dict[str, Any] = {} if nodes is None else {"nodes": nodes}
    for change in changes or ():
        name, equals, text = (part.strip() for part in change.partition("="))
        try:
            value = _number(yaml.safe_load(text))
        except yaml.YAMLError:
            equals = ""
        if not (name and equals):
            raise ValueError(
                f"--set {change!r}: allowed is NAME=VALUE, such as length=0.4 or gravity=[0, 0, -9.81]"
            )
        if name in values:
            other = "--nodes" if name == "nodes" and nodes is not None else "another --set"
            raise ValueError(f"--set {change!r}: {name} is given by {other} too; allowed is each name once")
        values[name] = value
    return system.replace(**values)


def _number(value: Any) -> Any:
    """Also where PyYAML, which reads YAML 1.1, sees text: in 10e9."""
    if isinstance(value, list):
        return [_number(each) for each in value]
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


# files


def is_trajectory(name: str) -> bool:
    """True if a path is a trajectory: by its content, or by its suffix if there is no such file."""
    return Path(name).suffix == ".nc" or _begins(name, TRAJECTORY_MARK)


def trajectory_of(path: Path) -> Trajectory:
    """The trajectory in a file; also one of a model."""
    import knode_cosserat as kc
    from knode_cosserat.learning.files import model_file  # noqa: F401  (so that a trajectory's model is understood)

    return kc.load_trajectory(path)


def _begins(name: str, mark: bytes) -> bool:
    if not os.path.isfile(name):
        return False
    with open(name, "rb") as file:
        return file.read(len(mark)) == mark


def require_writable(
    file: Path | None = None, figure: Path | None = None, folders: Sequence[Path | None] = ()
) -> None:
    """Better said before a long computation than after it; folders are made later, if they are not there."""
    for path in (file, figure):
        if path and not path.parent.is_dir():
            raise ValueError(f"{path}: there is no folder {path.parent}")
        if path and path.is_dir():
            raise ValueError(f"{path}: this is a folder; allowed is a file")
    if figure and figure.suffix not in FORMATS:
        raise ValueError(f"{figure}: allowed for a figure is a name that ends in {', '.join(FORMATS)}")
    for path in (file, figure, *folders):
        if path:
            _try_to_write(path, folder=path in folders, replaced=path is file)


def _try_to_write(path: Path, *, folder: bool, replaced: bool) -> None:
    """Do it and leave nothing: permissions alone do not tell, of a read-only disk say."""
    # files are written beside where they belong (`_files.replacing`), figures over what is there
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


def wanted(progress: bool | None) -> bool:
    """True if progress is shown: as requested, or else on a terminal."""
    return sys.stderr.isatty() if progress is None else progress


def figures() -> Any:
    """The module of figures; `ImportError` if they cannot be drawn."""
    from knode_cosserat.evaluation import figures

    figures.require_matplotlib()
    return figures
