"""The command that looks at the installation."""

from __future__ import annotations

import typer

from knode_cosserat.cli.arguments import Json
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import tell


@app.command(epilog=examples("doctor", "doctor --json"))
def doctor(as_json: Json = False) -> None:
    """Say what is installed and where it runs, and test it: versions, devices, cache, precision.

    The exit status is 1 if something is wrong.
    """
    import knode_cosserat as kc

    found = kc.doctor()
    tell(as_json, found.to_dict(), str(found).splitlines())
    raise typer.Exit(0 if found.well else 1)
