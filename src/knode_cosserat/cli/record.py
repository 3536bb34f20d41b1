"""Command that records a simulated robot: record-virtual."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from knode_cosserat.cli.arguments import Json, NetCDF, require_trajectory_name, require_writable
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app, examples
from knode_cosserat.recordings.formats import written_suffixes


@app.command(
    epilog=examples(
        "record-virtual sine:1.0 --out x.bag",
        "record-virtual step:4.4 --out step.bag --seconds 12 --states truth.nc",
        "record-virtual random:0 --out random.bag --seed 3 --swap 9",
        "record-virtual sine:3.0 --out x.bag --imperfections 7 --truth true-robot.yaml",
    )
)
def record_virtual(
    signal: Annotated[
        str,
        typer.Argument(
            metavar="CONTROLS",
            help="Commanded tensions: sine:PERIOD (s), step:HEIGHT (N, after 2 s) or random:SEED, around the "
            "paper's rest tension; or any controls of `simulate`, after 1 s of rest.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help=f"Write this recording: {', '.join(written_suffixes())}.",
        ),
    ],
    seconds: Annotated[float, typer.Option(metavar="S", help="Duration (s).")] = 16.0,
    seed: Annotated[
        int,
        typer.Option(metavar="N", min=0, help="Random seed of sensor noise and body mounting."),
    ] = 0,
    swap: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time when a tracked body swaps axes (s).", show_default="never"),
    ] = None,
    imperfections: Annotated[
        int | None,
        typer.Option(
            metavar="SEED",
            min=0,
            max=2**32 - 1,
            help="Record the paper's robot with random imperfections (friction, sleeve, load-cell errors, …) "
            "instead; equal seeds give equal robots.",
            show_default="the virtual robot",
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the robot with --imperfections to this YAML file."),
    ] = None,
    states: Annotated[Path | None, NetCDF] = None,
    as_json: Json = False,
) -> None:
    """Record a simulated robot as a bag or table.

    The recording has the format of the paper's robot. The simulation includes effects that models do not
    have: tendon friction, ribs with masses, a sleeve, motor lag and sensor noise. --states writes the true
    states. With --imperfections the robot is the paper's with random effects that `identify` can find.
    """
    require_trajectory_name(states)
    for path in (out, states, truth):
        require_writable(path)
    if truth and imperfections is None:
        raise typer.BadParameter("--truth needs --imperfections SEED: it writes that robot")
    import knode_cosserat as kc
    from knode_cosserat.identification.imperfections import drawn_robot
    from knode_cosserat.recordings.virtual import Sensors
    from knode_cosserat.recordings.virtual import record_virtual as record

    _require_motion(signal, seconds)
    began = perf_counter()
    drawn = None if imperfections is None else drawn_robot(imperfections)
    motion = record(
        out, signal, seconds, seed, Sensors(swap=swap), robot=None if drawn is None else drawn.robot
    )
    elapsed = perf_counter() - began
    facts: dict[str, Any] = {
        "signal": signal, "seconds": seconds, "seed": seed, "swap": swap, "simulated": True,
    }  # fmt: skip
    lines = [f"recorded {seconds:g} s of {signal} (simulated) in {elapsed:.1f} s"]
    written = {"out": out} | ({"states": states} if states or as_json else {})
    if states:
        motion.save(states)
    if drawn is not None:
        facts["imperfections"] = dict(drawn.values)
        lines.append(f"effects of the robot: {', '.join(drawn.effects)}")
    if drawn is not None and truth is not None:
        kc.save_robot(drawn.robot, truth)
        written["truth"] = truth
    write_output(as_json, facts | {"computing_time": round(elapsed, 2)}, lines, **written)


def _require_motion(signal: str, seconds: float) -> None:
    """Raise `ValueError` if the recording ends before the signal begins."""
    from knode_cosserat.recordings.virtual import BEFORE_STEP, RESTING

    begin = BEFORE_STEP if signal.startswith("step") else RESTING
    if 0.0 < seconds <= begin and not signal.startswith("constant"):
        raise ValueError(
            f"--seconds must be above {begin:g}, when the signal {signal} begins (got {seconds:g})"
        )
