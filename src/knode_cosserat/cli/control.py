"""Command that closes a loop: predictive control of a simulated robot."""

from __future__ import annotations

import re
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import typer

from knode_cosserat._files.csv_rows import size_excess
from knode_cosserat.cli.arguments import Json, Nominal, limits_of, load_system, option, require_writable
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app
from knode_cosserat.recordings.formats import written_suffixes
from knode_cosserat.rods.wrapped import nominal_model

if TYPE_CHECKING:
    from knode_cosserat.control import ControlLimits
    from knode_cosserat.rods.system import System

#: plants of other simulators by the word before the colon: functions of the rest of the text, dt and sensor
PLANTS: dict[str, Callable[[str, float, Any], Any]] = {}


def _listed(method: str) -> str:
    """Return the name of a controller; for `list`, print all controllers with their options, and exit."""
    if method == "list":
        from knode_cosserat.control.commands import CONTROLLERS

        for name, controller in CONTROLLERS.items():
            options = ",".join(f"{key}={value}" for key, value in controller.options.items())
            typer.echo(f"{name}: {controller.help}" + (f" ({name}:{options})" if options else ""))
        raise typer.Exit
    return method


#: option of commands with a controller
Method = Annotated[
    str,
    option(
        "NAME",
        "Controller, such as predictive, pid or predictive:horizon=10; `list` prints all.",
        callback=_listed,
        is_eager=True,
    ),
]


class _TaskOptions(NamedTuple):
    """Reference of the tip, and the controlled robot.

    Options:
        reference (--reference NAME|CSV): Wanted tip: circle:radius=0.1,period=4, eight:radius=0.1,period=6,
            or a CSV table with the columns time [s], x [m], y [m] and perhaps z [m], or in ms and mm. The
            centre is at x=, y=, z= (m), in plane=xy, yz or xz.
        seconds (--seconds S): Duration (s).
        plant (--plant ROBOT): Robot that is controlled, simulated. Default: the model itself.
        noise (--noise FACTOR): Noise of the tip sensor, in multiples of 0.2 mm.
    """

    reference: str | None = None
    seconds: float = 10.0
    plant: str | None = None
    noise: float = 0.0

    def plant_of(self, model: System, dt: float) -> Any:
        """Return the controlled robot: another simulator's, another robot or the model itself."""
        from knode_cosserat import control as kcc
        from knode_cosserat.estimation import TipPosition

        sensor = kcc.Sensor(TipPosition(), self.noise)
        word, _, rest = (self.plant or "").partition(":")
        if word in PLANTS:
            return PLANTS[word](rest, dt, sensor)
        return kcc.SimulatedPlant(model if self.plant is None else load_system(self.plant), dt, sensor)


class _ControlMethod(NamedTuple):
    """Controller and limits.

    Options:
        dt (--dt S): Period of the control (s).
        realtime (--realtime): Choose the longest prediction that this computer computes in 60 % of a period.
        low (--low NUMBERS): Least control: one number, or one for each. Default: that of the robot's file;
            0 N for tensions.
        high (--high NUMBERS): Greatest control: one number, or one for each. Default: that of the robot's
            file; 10 N for tensions.
        rate (--rate NUMBERS): Greatest change of a control in 1 s: one number, or one for each. Default: 40 N
            for tensions.
        lag (--lag S): Time constant of the motors that the controller expects (s).
        adapt (--adapt NAME): Adapt this parameter of the model while running; may be repeated.
        deviation (--tip-deviation M): Standard deviation of the measured tip for the observer (m): noise and
            error of the model.
    """

    method: Method = "predictive"
    dt: float = 0.05
    realtime: bool = False
    low: str | None = None
    high: str | None = None
    rate: str | None = None
    lag: float = 0.0
    adapt: list[str] | None = None
    deviation: float = 2e-4

    @property
    def name(self) -> str:
        """Controller with its options."""
        if not self.realtime:
            return self.method
        from knode_cosserat.control.realtime import SHARE

        return f"{self.method}{',' if ':' in self.method else ':'}realtime={SHARE}"

    def limits(self, robot: System) -> ControlLimits:
        """Return the limits of a robot's controls."""
        from knode_cosserat.control import ControlLimits

        return ControlLimits(**limits_of(robot, low=self.low, high=self.high, rate=self.rate), lag=self.lag)


class _LoopFiles(NamedTuple):
    """Files and output of a closed loop.

    Options:
        out (--out FILE): Write one row a period to this CSV file.
        states (--states FILE): Write the estimated states as a trajectory (.nc), to view or plot.
        figure (--figure FILE): Draw path, error and controls into this file.
    """

    out: Path | None = None
    recording: Annotated[
        Path | None,
        option(
            "FILE",
            f"Write the measured tip and the controls as a recording: {', '.join(written_suffixes())}.",
        ),
    ] = None
    states: Path | None = None
    figure: Path | None = None
    as_json: Json = False


class _Viewer(NamedTuple):
    """Viewer with a target.

    Options:
        live (--live): Open the viewer: the tip follows a target that you drag.
        export (--export FILE): With --live: at the end, write the last run as one HTML file.
        port (--port N): With --live: port of the local web server. Default: any free port.
        no_open (--no-open): With --live: do not open the browser.
    """

    live: bool = False
    export: Path | None = None
    port: int = 0
    no_open: bool = False


@app.command()
def control(
    nominal: Nominal, task: _TaskOptions, method: _ControlMethod, output: _LoopFiles, viewer: _Viewer
) -> None:
    """Control the tip of a robot in closed loop, and report the tracking error.

    ROBOT is the model that predicts. The controlled robot is simulated; it may be another one (--plant), so
    that the effect of a wrong model is seen. Controls stay within --low, --high and --rate in every period.
    With --live, the target is dragged in the browser, and the report is of the last run, until Ctrl-C.

    Examples:
        control delrin-tendon-robot --reference circle:radius=0.1,period=4
        control my-model.knode --plant my-robot.yaml --reference path.csv --adapt youngs_modulus
        control delrin-tendon-robot --live
    """
    if viewer.live == (task.reference is not None):
        raise ValueError("give either --reference, or --live to drag the target in the browser")
    if not viewer.live and viewer != _Viewer():
        raise ValueError("--export, --port and --no-open are of the viewer; use them with --live")
    for path in (output.out, output.recording, output.states, output.figure, viewer.export):
        require_writable(path)
    from knode_cosserat import control as kcc
    from knode_cosserat.estimation import TipPosition

    model = nominal.load()
    length, limits = float(nominal_model(model).length), method.limits(model)
    controller = kcc.controller_named(
        method.name, model, method.dt, limits, method.adapt or (), TipPosition(sigma=method.deviation)
    )
    plant = task.plant_of(model, method.dt)
    if task.reference is not None:
        wanted, seconds = parsed_reference(task.reference), task.seconds
        log = kcc.run_loop(controller, plant, wanted, seconds)
    else:
        from knode_cosserat.viewer import control_live

        def announce(address: str) -> None:
            lines = [f"the viewer is at {address} (Ctrl-C ends it)"]
            write_output(output.as_json, {"address": address}, lines)
            if not viewer.no_open:
                webbrowser.open(address)

        robot = nominal.robot
        title = robot if task.plant is None else f"{task.plant}, controlled by {robot}"
        run = control_live(
            controller, plant, title=title, export=viewer.export, port=viewer.port, open_browser=announce
        )
        if run is None:
            return
        log = run
    if output.out is not None:
        log.to_csv(output.out)
    if output.recording is not None:
        log.measurements(simulated=True).save(output.recording)
    if output.states is not None:
        if log.estimated is None:
            raise ValueError(
                f"--states: the method {method.method} estimates no states; predictive, ilqr and mppi do"
            )
        log.estimated.save(output.states)
    if output.figure is not None:
        from knode_cosserat.figures import closed_loop

        closed_loop(log).savefig(output.figure)
    choice = getattr(controller, "choice", None)
    again = ",".join(f"{name}={value}" for name, value in log.settings.items())
    beyond = log.out_of_reach  # None with --live, where the target moves
    facts = log.summary() | {"tip_rmse_percent": 100.0 * log.tip_rmse() / length, "out_of_reach": beyond}
    lines = [
        f"tip RMSE {facts['tip_rmse']:.3g} m over the second half, "
        f"{facts['tip_rmse_percent']:.3g} % of the length",
        *([f"the reference is up to {1e3 * beyond:.3g} mm out of reach"] if beyond else []),
        f"{facts['periods']} periods, {facts['fallbacks']} without a solution; feedback "
        f"{facts['feedback_ms']:.2f} ms, preparation {facts['preparation_ms']:.1f} ms (medians); "
        f"{facts['missed']} took longer than the period of {1e3 * method.dt:g} ms",
        *([f"{choice}; the same again: --method predictive:{again}"] if choice else []),
        *(f"{name}: {values[-1]:.4g}" for name, values in log.parameters.items()),
        *([f"EXTRAPOLATION: {log.extrapolation}"] if log.extrapolation else []),
    ]
    write_output(output.as_json, facts, lines, out=output.out, export=viewer.export)


#: titles of a reference's columns: a name, and a unit in brackets, or after a space, stroke or underscore
_TITLE = re.compile(
    r"(?:(t|time)|([xyz])) *(?:\[(.*)\]|\((.*)\)|[ /_] *([mc]?m|[mun]?s))?", re.IGNORECASE | re.ASCII
)


def parsed_reference(text: str) -> Any:
    """Return a reference by its text, or from a CSV file with the columns t (or time), x, y and perhaps z.

    Units in titles, such as `x [mm]`, are those of recordings; without one, they are s and m. Without z, and
    where a cell is empty, the coordinate is free.
    """
    from knode_cosserat.control import table
    from knode_cosserat.control.references import ReferenceFormatError, parse_reference

    if not text.endswith(".csv"):
        return parse_reference(text)
    from knode_cosserat.recordings.findings import RecordingError
    from knode_cosserat.recordings.formats.csv_table import read_csv
    from knode_cosserat.recordings.table import columns_of

    if reason := size_excess(Path(text)):
        raise ReferenceFormatError(f"{text}: {reason}")
    try:
        if not (data := Path(text).read_bytes()).strip():
            raise ReferenceFormatError(f"{text} is empty; allowed is a table of t, x, y and perhaps z")
        found = read_csv(data)
        if found.findings:  # a line of units, or comments between the rows
            what = "allowed is one line of titles, then numbers"
            raise ReferenceFormatError(f"{text}: {found.findings[0].message}; {what}")
        places: dict[str, tuple[int, float]] = {}
        for place, title in enumerate(found.numbers.columns):
            if (known := _named(text, str(title))) is None:
                continue
            if known[0] in places:
                raise ReferenceFormatError(f"{text} has several columns for {known[0]}; allowed is one")
            places[known[0]] = place, known[1]
        missing = [name for name in "txy" if name not in places]
        if missing:
            raise ReferenceFormatError(
                f"{text} has no column {missing[0]}; a reference has t or time, x, y and perhaps z, with or "
                "without units: t [s], x [mm]"
            )
        rows: Any = np.full((len(found.numbers), 4), np.nan)
        for k, name in enumerate("txyz"):
            if name in places:
                place, factor = places[name]
                rows[:, k] = factor * columns_of(found.numbers, [place])[:, 0]
    except RecordingError as error:
        raise ReferenceFormatError(f"{text}: {error}") from None
    return table(rows[:, 0], rows[:, 1:])


def _named(path: str, title: str) -> tuple[str, float] | None:
    """Return the name of a reference's column, t, x, y or z, and the factor to s or m; None for others."""
    from knode_cosserat.control.references import ReferenceFormatError
    from knode_cosserat.recordings.config import POSITION_UNITS, TIME_UNITS
    from knode_cosserat.recordings.quantities import known_unit

    match = _TITLE.fullmatch(title.strip())
    if match is None:
        return None
    time, axis, *spellings = match.groups()
    units = TIME_UNITS if time else POSITION_UNITS
    unit = next((it.strip() for it in spellings if it), "s" if time else "m")
    unit = unit if unit in units else known_unit(unit)
    if unit not in units:
        raise ReferenceFormatError(
            f"{path}: the column {title!r} has an unknown unit; allowed is {', '.join(units)}"
        )
    return ("t" if time else axis.lower()), units[unit]
