"""The program itself: its name, how it fails, its help."""

from __future__ import annotations

import logging
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.solvers.result import SimulationError

if TYPE_CHECKING:
    from collections.abc import Sequence

PROGRAM = "knode-cosserat"
#: errors that the user can fix; any other is a bug, and keeps its traceback
_EXPECTED = (KnodeCosseratError, ValueError, OSError, ImportError, MemoryError, OverflowError)


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


def _app(**options: Any) -> typer.Typer:
    return typer.Typer(
        add_completion=options.pop("add_completion", False),
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"]},
        **options,
    )


app = _app(cls=_Program, add_completion=True)
#: the commands under `study`
studies = _app(help="Rerun a study of the paper.")


def main() -> None:
    """The program `knode-cosserat`."""
    app()


def examples(*commands: str) -> str:
    """The end of a help text; the mark keeps its lines as they are."""
    title = "Example:" if len(commands) == 1 else "Examples:"
    return "\n".join(["\b", title, *(f"  {PROGRAM} {command}" for command in commands)])


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import PackageNotFoundError, version

        try:
            number = version(PROGRAM)
        except PackageNotFoundError:
            number = "(version unknown: run from a checkout that is not installed)"
        typer.echo(f"{PROGRAM} {number}")
        raise typer.Exit


@app.callback(epilog=examples("simulate delrin-tendon-robot --controls sine:1.5 --steps 100 --out truth.nc"))
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", "-v", help="Tell on stderr what goes on inside: recovered steps, fits."),
    ] = False,
) -> None:
    """Simulate tendon-driven Cosserat-rod robots, and learn what the physics misses.

    Units are SI: m, s, N, Pa, rad.
    """
    if verbose:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("%(name)s: %(message)s"))
        logger = logging.getLogger("knode_cosserat")
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
