"""Command that checks the installation: doctor."""

from __future__ import annotations

import typer

from knode_cosserat.cli.arguments import Json
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app


@app.command()
def doctor(as_json: Json = False) -> None:
    """Check the installation with a short simulation.

    Prints versions, devices, cache and precision. The exit status is 1 if a check fails.

    Examples:
        doctor
        doctor --json
    """
    from knode_cosserat.diagnosis import doctor as check

    diagnosis = check()
    write_output(as_json, diagnosis.to_dict(), str(diagnosis).splitlines())
    raise typer.Exit(0 if diagnosis.well else 1)
