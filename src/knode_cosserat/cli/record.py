"""The command that records a virtual robot."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from knode_cosserat.cli.arguments import Json, NetCDF, require_writable
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import tell


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
            help="sine:PERIOD, step:HEIGHT or random:SEED about the paper's rest tension, or other controls "
            "as `simulate` takes them.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="Write this bag (.bag, .mcap, .db3) or table (.csv, .parquet)."),
    ],
    seconds: Annotated[float, typer.Option(metavar="S", help="How long, in s.")] = 16.0,
    seed: Annotated[
        int, typer.Option(metavar="N", min=0, help="Seed of the noise and of how bodies are turned.")
    ] = 0,
    swap: Annotated[
        float | None,
        typer.Option(metavar="S", help="When a body swaps its axes, in s.", show_default="never"),
    ] = None,
    imperfections: Annotated[
        int | None,
        typer.Option(
            metavar="SEED",
            min=0,
            max=2**32 - 1,
            help="Record the paper's robot with random imperfections, drawn from what `identify` can find.",
            show_default="the virtual robot",
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the robot with its imperfections to this YAML file."),
    ] = None,
    states: Annotated[Path | None, NetCDF] = None,
    as_json: Json = False,
) -> None:
    """Record a virtual robot: a bag as of the paper's robot, without one.

    The robot is simulated, with what models do not know: friction of the tendons, ribs with masses, a sleeve,
    motors with a lag, and sensors with noise. `--states` keeps what it truly did. With `--imperfections` it
    is the paper's robot with effects such as friction, load cells that are off or a sleeve; recordings with
    the same SEED are of the same robot.
    """
    for path in (out, states, truth):
        require_writable(path)
    if truth and imperfections is None:
        raise typer.BadParameter("--truth needs --imperfections SEED: it is that robot")
    import knode_cosserat as kc
    from knode_cosserat.recordings.virtual import Sensors
    from knode_cosserat.recordings.virtual import record_virtual as record
    from knode_cosserat.studies.virtual_robots import drawn_robot

    began = perf_counter()
    drawn = None if imperfections is None else drawn_robot(imperfections)
    motion = record(
        out, signal, seconds, seed, Sensors(swap=swap), robot=None if drawn is None else drawn.robot
    )
    elapsed = perf_counter() - began
    facts: dict[str, Any] = {
        "signal": signal, "seconds": seconds, "seed": seed, "swap": swap, "simulated": True,
    }  # fmt: skip
    lines = [f"{seconds:g} s of {signal}, simulated, in {elapsed:.1f} s"]
    written = {"out": out} | ({"states": states} if states or as_json else {})
    if states:
        motion.save(states)
    if drawn is not None:
        facts["imperfections"] = dict(drawn.values)
        lines.append(f"a robot with {', '.join(drawn.effects)}")
    if drawn is not None and truth is not None:
        kc.save_robot(drawn.robot, truth)
        written["truth"] = truth
    tell(as_json, facts | {"computing_time": round(elapsed, 2)}, lines, **written)
