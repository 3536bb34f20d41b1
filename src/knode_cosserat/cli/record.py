"""Command that records a simulated robot: record-virtual."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, NamedTuple

import typer

from knode_cosserat.cli.arguments import (
    Json,
    NetCDF,
    argument,
    option,
    require_trajectory_name,
    require_writable,
)
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app, examples
from knode_cosserat.recordings.formats import written_suffixes


class _Motion(NamedTuple):
    """Motion of a virtual robot, and its noise."""

    signal: Annotated[
        str,
        argument(
            "CONTROLS",
            "Commanded tensions: sine:PERIOD (s), step:HEIGHT (N, after 2 s) or random:SEED, around the "
            "paper's rest tension; or any controls of `simulate`, after 1 s of rest.",
        ),
    ]
    seconds: Annotated[float, option("S", "Duration (s).")] = 16.0
    seed: Annotated[int, option("N", "Random seed of sensor noise and body mounting.", min=0)] = 0
    swap: Annotated[
        float | None, option("S", "Time when a tracked body swaps axes (s).", show_default="never")
    ] = None


class _Files(NamedTuple):
    """Files of a recording and of the truth."""

    out: Annotated[Path, option("FILE", f"Write this recording: {', '.join(written_suffixes())}.")]
    truth: Annotated[
        Path | None, option("FILE", "Write the robot with --imperfections to this YAML file.")
    ] = None
    states: Annotated[Path | None, NetCDF] = None


@app.command(
    epilog=examples(
        "record-virtual sine:1.0 --out x.bag",
        "record-virtual step:4.4 --out step.bag --seconds 12 --states truth.nc",
        "record-virtual random:0 --out random.bag --seed 3 --swap 9",
        "record-virtual sine:3.0 --out x.bag --imperfections 7 --truth true-robot.yaml",
    )
)
def record_virtual(
    motion: _Motion,
    files: _Files,
    imperfections: Annotated[
        int | None,
        option(
            "SEED",
            "Record the paper's robot with random imperfections (friction, sleeve, load-cell errors, …) "
            "instead; equal seeds give equal robots.",
            min=0,
            max=2**32 - 1,
            show_default="the virtual robot",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Record a simulated robot as a bag or table.

    The recording has the format of the paper's robot. The simulation includes effects that models do not
    have: tendon friction, ribs with masses, a sleeve, motor lag and sensor noise. --states writes the true
    states. With --imperfections the robot is the paper's with random effects that `identify` can find.
    """
    signal, seconds, seed, swap = motion
    out, truth, states = files
    require_trajectory_name(states)
    for path in (out, states, truth):
        require_writable(path)
    if truth and imperfections is None:
        raise typer.BadParameter("--truth needs --imperfections SEED: it writes that robot")
    import knode_cosserat as kc
    from knode_cosserat.identification.imperfections import drawn_robot
    from knode_cosserat.recordings import virtual

    begin = virtual.BEFORE_STEP if signal.startswith("step") else virtual.RESTING
    if 0.0 < seconds <= begin and not signal.startswith("constant"):
        raise ValueError(
            f"--seconds must be above {begin:g}, when the signal {signal} begins (got {seconds:g})"
        )
    began = perf_counter()
    drawn = None if imperfections is None else drawn_robot(imperfections)
    trajectory = virtual.record_virtual(
        out, signal, seconds, seed, virtual.Sensors(swap=swap), robot=None if drawn is None else drawn.robot
    )
    elapsed = perf_counter() - began
    facts: dict[str, Any] = {
        "signal": signal, "seconds": seconds, "seed": seed, "swap": swap, "simulated": True,
    }  # fmt: skip
    lines = [f"recorded {seconds:g} s of {signal} (simulated) in {elapsed:.1f} s"]
    written = {"out": out} | ({"states": states} if states or as_json else {})
    if states:
        trajectory.save(states)
    if drawn is not None:
        facts["imperfections"] = dict(drawn.values)
        lines.append(f"effects of the robot: {', '.join(drawn.effects)}")
    if drawn is not None and truth is not None:
        kc.save_robot(drawn.robot, truth)
        written["truth"] = truth
    write_output(as_json, facts | {"computing_time": round(elapsed, 2)}, lines, **written)
