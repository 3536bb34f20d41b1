"""The command line: it parses, calls and prints, and knows nothing that the package does not.

Wrong input, and whatever the package says of it, ends in one line on stderr and exit status 2; a simulation
that finds no solution in status 1. Modules that take long to import are imported by the commands.
"""

from __future__ import annotations

import enum
import os
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from typer.core import TyperGroup

from knode_cosserat.cli_facts import at_rest, derived, outcome, parameters, shown, table, tell, vector
from knode_cosserat.solvers.result import SimulationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory

PROGRAM = "knode-cosserat"
#: what figures can be written as
FORMATS = (".png", ".pdf", ".svg")
#: what the user can do something about; anything else is a mistake of ours, and shows where it is
_EXPECTED = (SimulationError, ValueError, OSError, ImportError, MemoryError, OverflowError)


class _Program(TyperGroup):
    """Says in one line what is wrong, and no more."""

    def main(
        self, args: Sequence[str] | None = None, prog_name: str | None = None, *_: Any, **extra: Any
    ) -> Any:
        args = list(sys.argv[1:] if args is None else args)
        try:
            status = super().main(args or ["--help"], PROGRAM, **{**extra, "standalone_mode": False})
        except typer.Abort:
            sys.exit(1)
        except Exception as error:
            parser_says = getattr(error, "format_message", None)
            if parser_says is None and not isinstance(error, _EXPECTED):
                raise
            text = parser_says() if parser_says else str(error)
            typer.echo("error: " + " ".join(text.split()), err=True)
            sys.exit(1 if isinstance(error, SimulationError) else 2)
        sys.exit(status or 0)


app = typer.Typer(
    cls=_Program,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["--help", "-h"]},
)


def main() -> None:
    """The program `knode-cosserat`."""
    app()


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import PackageNotFoundError, version

        try:
            number = version(PROGRAM)
        except PackageNotFoundError:
            number = "(version unknown: run from a checkout that is not installed)"
        typer.echo(f"{PROGRAM} {number}")
        raise typer.Exit


def _examples(*commands: str) -> str:
    """The end of a help text; the mark keeps its lines as they are."""
    title = "Example:" if len(commands) == 1 else "Examples:"
    return "\n".join(["\b", title, *(f"  {PROGRAM} {command}" for command in commands)])


@app.callback(epilog=_examples("simulate delrin-tendon-robot --controls sine:1.5 --steps 100 --out truth.nc"))
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Simulate tendon-driven Cosserat-rod robots. Units are SI: m, s, N, Pa, rad."""


# arguments of several commands

ROBOT = "A robot of the catalog (`knode-cosserat info` lists them) or a YAML file."
Robot = Annotated[str, typer.Argument(metavar="ROBOT", help=ROBOT)]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change a parameter of the robot; may be repeated."),
]
Nodes = Annotated[int | None, typer.Option(metavar="N", help="Nodes along the rod, base and tip included.")]
Space = Annotated[str, typer.Option(metavar="SCHEME", help="Scheme along the rod: euler or rk4.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and nothing else.")]
NetCDF = typer.Option(metavar="FILE", help="Write the states to this netCDF file.")
Picture = typer.Option(metavar="FILE", help="Write the figure to this PNG, PDF or SVG file.")
Progress = Annotated[
    bool | None,
    typer.Option(
        "--progress/--no-progress", help="Progress bar on stderr.", show_default="if it is a terminal"
    ),
]


class Kind(enum.StrEnum):
    """The figures of a trajectory that `plot` can draw."""

    overview = "overview"
    rods = "rods"
    tip = "tip"
    tensions = "tensions"


# the commands


@app.command(
    epilog=_examples(
        "simulate delrin-tendon-robot --controls sine:1.5 --steps 100 --out truth.nc",
        "simulate delrin-tendon-robot --controls step:1.5,at=2 --steps 200 --dt 0.02 --out step.nc",
        "simulate my-robot.yaml --controls tensions.csv --set youngs_modulus=10e9 --out stiff.nc",
        "simulate my-robot.yaml --controls random:0 --steps 100 --out r.nc --figure r.png --json",
    )
)
def simulate(
    robot: Robot,
    controls: Annotated[
        str,
        typer.Option(
            metavar="CONTROLS",
            help="sine:PERIOD, step:HEIGHT, ramp:HEIGHT, random:SEED, constant:TENSION or a CSV file.",
        ),
    ],
    out: Annotated[Path, NetCDF],
    steps: Annotated[
        int | None, typer.Option(metavar="N", help="Time steps.", show_default="as many as a file has")
    ] = None,
    dt: Annotated[
        float | None, typer.Option(metavar="S", help="Time step in s.", show_default="0.05, or a file's own")
    ] = None,
    time: Annotated[
        str, typer.Option(metavar="SCHEME", help="Scheme in time: bdf1, bdf2, bdf-alpha or trapezoidal.")
    ] = "bdf2",
    space: Space = "euler",
    changes: Changes = None,
    nodes: Nodes = None,
    allow_failure: Annotated[
        bool, typer.Option("--allow-failure", help="Write what was solved even if a step has no solution.")
    ] = False,
    figure: Annotated[Path | None, Picture] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Simulate a robot under tendon tensions."""
    _require_writable(out, figure)
    figures = _figures() if figure else None
    import knode_cosserat as kc

    system = _changed(kc.load_robot(robot), changes, nodes)
    if dt is None:
        dt = kc.controls.load(controls).dt if os.path.isfile(controls) else 0.05
    tensions = kc.controls.parse(controls, steps, dt, tendons=system.control_size)
    began = perf_counter()
    trajectory = kc.simulate(
        system, tensions, dt, time=time, space=space, progress=_wanted(progress),
        on_failure="return" if allow_failure else "raise",
    )  # fmt: skip
    seconds = perf_counter() - began
    trajectory.save(out)
    if figures:
        figures.overview(trajectory).savefig(figure)
    came = outcome(trajectory)
    facts = {"robot": robot, "steps": len(tensions), "dt": dt, "computing_time": round(seconds, 4), **came}
    results = ", ".join(f"{count} {result}" for result, count in came["results"].items())
    lines = [
        f"simulated {robot}: {len(tensions)} steps of {dt:g} s in {seconds:.2f} s of computing",
        f"steps: {results}; largest residual {came['largest_residual']:.1e} of its natural scale",
        f"tip after the last step that was solved: {vector(came['tip_position'])} m",
    ]
    if came["first_failure"]:
        step, at, message = came["first_failure"].values()
        lines.append(f"NOT SOLVED from step {step} (t = {at:g} s) on: {message}")
    tell(as_json, facts, lines, out=out, figure=figure)


@app.command(epilog=_examples("equilibrium delrin-tendon-robot --tension 7,5,5,7"))
def equilibrium(
    robot: Robot,
    tension: Annotated[
        str, typer.Option(metavar="N,N,…", help="Tension of every tendon in N, such as 7,5,5,7.")
    ],
    space: Space = "euler",
    changes: Changes = None,
    nodes: Nodes = None,
    out: Annotated[Path | None, NetCDF] = None,
    as_json: Json = False,
) -> None:
    """Find a robot's shape at rest under constant tensions."""
    _require_writable(out)
    import knode_cosserat as kc

    system = _changed(kc.load_robot(robot), changes, nodes)
    rest = kc.equilibrium(system, _tensions(tension, system.control_size), space=space)
    if out:
        rest.save(out)
    facts = {"robot": robot, **at_rest(rest)}
    lines = [
        f"tip: {vector(facts['tip_position'])} m",
        f"the tip leans {np.degrees(facts['tip_inclination']):.2f} degrees from the z axis",
        f"internal force at the base: {vector(facts['base_force'])} N",
        f"internal moment at the base: {vector(facts['base_moment'])} N m",
    ]
    tell(as_json, facts, lines, out=out)


@app.command(epilog=_examples("info", "info delrin-tendon-robot --set length=0.4"))
def info(
    robot: Annotated[
        str | None, typer.Argument(metavar="[ROBOT]", help=f"{ROBOT} Without: list the catalog.")
    ] = None,
    changes: Changes = None,
    nodes: Nodes = None,
    as_json: Json = False,
) -> None:
    """Show a robot's parameters, or list the catalog."""
    import knode_cosserat as kc

    robots = kc.catalog()
    if robot is None:
        if changes or nodes:
            raise ValueError("--set and --nodes change a robot: name it")
        tell(as_json, {"catalog": robots}, table(list(robots.items())))
        return
    system = _changed(kc.load_robot(robot), changes, nodes)
    parts = {"parameters": parameters(system), "derived": derived(system)}
    rows = []
    for title, quantities in parts.items():
        rows += [[""] * 4, [title, "", "", ""]]
        rows += [
            [f"  {name}", shown(it["value"]), it["unit"], it["meaning"]] for name, it in quantities.items()
        ]
    heading = f"{robot}: {robots[robot]}" if robot in robots else robot
    tell(as_json, {"robot": robot, "kind": type(system).__name__, **parts}, [heading, *table(rows)])


@app.command(
    epilog=_examples(
        "evaluate prediction.nc truth.nc",
        "evaluate delrin-tendon-robot truth.nc --set youngs_modulus=10e9 --rows 100",
    )
)
def evaluate(
    prediction: Annotated[
        str,
        typer.Argument(
            metavar="PREDICTION",
            help="A trajectory file, or a robot: it is simulated under each reference's controls.",
        ),
    ],
    references: Annotated[list[Path], typer.Argument(metavar="REFERENCE", help="Trajectory files.")],
    changes: Changes = None,
    rows: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Compare the first N rows only; the paper's tables: 100."),
    ] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Measure how far a prediction is from references.

    Tip DTW is the dynamic-time-warping distance between the tip paths in m, pose MSE the mean squared error
    of positions and Euler angles times 1000 (both as in the paper), tip RMSE the root mean square distance of
    the tips in m.
    """
    import knode_cosserat as kc

    given: Trajectory | System
    if not _is_trajectory(prediction):
        given = _changed(kc.load_robot(prediction), changes, None)
    elif changes:
        raise ValueError(f"--set changes a robot; {prediction} is a trajectory")
    else:
        given = kc.load_trajectory(prediction)
    found = []
    for path in references:
        reference = kc.load_trajectory(path)
        try:
            own = given if isinstance(given, kc.Trajectory) else _driven(given, reference, _wanted(progress))
            measures = {measure.__name__: measure(own[:rows], reference[:rows]) for measure in _measures()}
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        found.append({"reference": str(path), "rows": len(reference.time[:rows]), **measures})
    rows_told: list[list[str]] = [["reference", "rows", "tip DTW [m]", "pose MSE [1e-3]", "tip RMSE [m]"]]
    for name, count, *numbers in (one.values() for one in found):
        rows_told.append([name, str(count), *(f"{number:.4g}" for number in numbers)])
    tell(as_json, {"prediction": prediction, "references": found}, table(rows_told))


@app.command(epilog=_examples("plot truth.nc --out truth.png", "plot truth.nc --kind rods --out rods.pdf"))
def plot(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="A trajectory file.")],
    out: Annotated[Path, Picture],
    kind: Annotated[Kind, typer.Option(help="What to draw.")] = Kind.overview,
    as_json: Json = False,
) -> None:
    """Draw a trajectory.

    The rod's shapes over time, the path of its tip, the tensions, or an overview of all three.
    """
    _require_writable(figure=out)
    figures = _figures()
    import knode_cosserat as kc

    states = kc.load_trajectory(trajectory)
    if kind is Kind.tip:
        figure = figures.tip_path({trajectory.stem: states})
    else:
        draw = {
            Kind.overview: figures.overview,
            Kind.rods: figures.rod_shapes,
            Kind.tensions: figures.tensions,
        }
        figure = draw[kind](states)
    figure.savefig(out)
    tell(as_json, {"trajectory": str(trajectory), "kind": kind.value}, [], out=out)


# reading what was given


def _changed(system: System, changes: list[str] | None, nodes: int | None) -> System:
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


def _tensions(text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(0.0 <= value < np.inf for value in values):
        raise ValueError(f"--tension {text!r}: allowed is {count} numbers, 0 or more (N), such as 7,5,5,7")
    return values


def _is_trajectory(name: str) -> bool:
    if Path(name).suffix == ".nc" or not os.path.isfile(name):
        return Path(name).suffix == ".nc"
    with open(name, "rb") as file:
        return file.read(4) == b"\x89HDF"


def _require_writable(file: Path | None = None, figure: Path | None = None) -> None:
    """Better said before a long simulation than after it."""
    for path in (file, figure):
        if path and not path.parent.is_dir():
            raise ValueError(f"{path}: there is no folder {path.parent}")
        if path and path.is_dir():
            raise ValueError(f"{path}: this is a folder; allowed is a file")
    if figure and figure.suffix not in FORMATS:
        raise ValueError(f"{figure}: allowed for a figure is a name that ends in {', '.join(FORMATS)}")


def _wanted(progress: bool | None) -> bool:
    return sys.stderr.isatty() if progress is None else progress


# finding out what to tell


def _figures() -> Any:
    from knode_cosserat.evaluation import figures

    figures.require_matplotlib()
    return figures


def _measures() -> tuple[Any, ...]:
    import knode_cosserat as kc

    return kc.tip_dtw, kc.pose_mse, kc.tip_rmse


def _driven(system: System, reference: Trajectory, progress: bool) -> Trajectory:
    """The system from rest under the controls of the reference, by the same schemes."""
    import knode_cosserat as kc

    if np.ndim(reference.y) != 3 or len(reference.time) < 2:
        raise ValueError("allowed is a trajectory of one robot, of two rows or more")
    it = reference.settings or kc.Settings()
    return kc.simulate(
        system, reference.control[1:], reference.dt, time=it.time, space=it.space, start=it.start,
        newton=it.newton, progress=progress,
    )  # fmt: skip


if __name__ == "__main__":
    main()
