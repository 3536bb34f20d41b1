"""The typer application: name, options of the program, help and error handling.

Other distributions add commands by entry points of the group `knode_cosserat.commands`: the command's name
and its typer application. They are imported when they are called, or listed in the help.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import io
import logging
import re
import sys
import traceback
import warnings
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from knode_cosserat.cli.output import printable
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.schemes.result import SimulationError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

PROGRAM = "knode-cosserat"
COMMANDS = "knode_cosserat.commands"
#: commands of other distributions of this project
OPTIONAL_COMMANDS = {"robot": "knode-cosserat-hardware", "robot-parts": "knode-cosserat-hardware"}
#: errors caused by the input; any other error is a defect of the package and shows its traceback
_EXPECTED = (KnodeCosseratError, ValueError, OSError, ImportError, MemoryError, OverflowError)

#: options that take several numbers
VECTOR_OPTIONS = frozenset(
    [
        "--tension",
        "--control",
        "--low",
        "--high",
        "--rate",
        "--masses",
        "--position",
        "--quaternion",
        "--seeds",
        "--set",
    ]
)
#: options that take NAME=VALUE pairs
_NAMED_OPTIONS = frozenset(["--control"])


class CommandGroup(TyperGroup):
    """Group of all commands. Errors and warnings are printed in one line on stderr."""

    #: name of the program in its help texts
    program = PROGRAM
    #: entry points of further commands
    plugins = COMMANDS

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands, those of other distributions last."""
        return [*super().list_commands(ctx), *(entry.name for entry in entry_points(group=self.plugins))]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; one of another distribution is imported only here."""
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            return command
        for entry in entry_points(group=self.plugins, name=cmd_name):
            command = typer.main.get_command(entry.load())
            command.name = cmd_name
            return command
        if cmd_name in OPTIONAL_COMMANDS:
            distribution = OPTIONAL_COMMANDS[cmd_name]
            raise ImportError(f"{cmd_name} needs {distribution}: pip install {distribution}")
        return None

    def main(
        self, args: Sequence[str] | None = None, prog_name: str | None = None, *_: Any, **extra: Any
    ) -> Any:
        """Run the command that the arguments name, and exit with its status."""
        args = list(sys.argv[1:] if args is None else args)
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _print_warning
                status = super().main(args or ["--help"], self.program, **{**extra, "standalone_mode": False})
        except typer.Abort:
            sys.exit(1)
        except Exception as error:
            parser_message = getattr(error, "format_message", None)
            if parser_message is None and not isinstance(error, _EXPECTED):
                raise
            text = parser_message() if parser_message else str(error)
            typer.echo("error: " + printable(" ".join(text.split())), err=True)
            sys.exit(1 if isinstance(error, SimulationError) else 2)
        sys.exit(status or 0)


class _VectorCommand(TyperCommand):
    """Command whose vector options accept separate words."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, joined_vectors(args))


class _App(typer.Typer):
    """Typer application with commands of class `_VectorCommand`, whose functions may have groups of options.

    The docstring of a command states its options and examples, that of a group (a named tuple) its options.
    """

    def command(self, *arguments: Any, **settings: Any) -> Any:
        def register(function: Callable[..., Any]) -> Any:
            stated = _sections(function)
            if stated["Examples"]:
                settings["epilog"] = examples(*stated["Examples"])
            command = _ungrouped(function)
            command.__doc__ = "\n".join(stated["Description"])
            return typer.Typer.command(self, *arguments, **{"cls": _VectorCommand, **settings})(command)

        return register


def _sections(stating: Callable[..., Any]) -> dict[str, list[str]]:
    """Return the lines of the description in a docstring, and the entries of its sections."""
    sections: dict[str, list[str]] = {"Description": [], "Options": [], "Examples": []}
    entries = sections["Description"]
    for line in inspect.cleandoc(stating.__doc__ or "").splitlines():
        if line.endswith(":") and line[:-1] in sections:
            entries = sections[line[:-1]]
        elif entries is sections["Description"]:
            entries.append(line)
        elif line.startswith(" " * 8):
            entries[-1] += f" {line.strip()}"
        elif line.strip():
            entries.append(line.strip())
    return sections


#: "rows (--rows N≥1): Number of rows. Default: all." is an option, and "robot (ROBOT): …" an argument
_ENTRY = re.compile(
    r"(?P<name>\w+) \((?P<option>--[\w-]+)? ?(?P<metavar>[^≥)]*)(≥(?P<least>\d+))?\): (?P<help>.*)"
)


def _options(stating: Callable[..., Any]) -> dict[str, Any]:
    """Return the options and arguments that a docstring states, by parameter."""
    options = {}
    for entry in _sections(stating)["Options"]:
        if not (match := _ENTRY.fullmatch(entry)):
            raise SyntaxError(f"{stating.__name__}: not an option: {entry}")
        words, _, default = match["help"].partition(" Default: ")
        settings: dict[str, Any] = {"metavar": match["metavar"] or None, "help": words}
        settings |= {"show_default": default.removesuffix(".")} if default else {}
        settings |= {"min": int(match["least"])} if match["least"] else {}
        option = match["option"]
        options[match["name"]] = typer.Option(option, **settings) if option else typer.Argument(**settings)
    return options


def _ungrouped(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that has the fields of its groups of options as parameters, as Typer needs them.

    A group is a parameter whose type is a named tuple: its fields are options of the command.
    """
    parameters: list[inspect.Parameter] = []
    groups: dict[str, Any] = {}

    def add(name: str, default: Any, hint: Any, options: Mapping[str, Any]) -> None:
        hint = Annotated[hint, options[name]] if name in options else hint
        parameters.append(
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)
        )

    own = _options(function)
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        group: Any = parameter.annotation
        if not hasattr(group, "_fields"):
            add(name, parameter.default, group, own)
            continue
        groups[name], stated = group, _options(group)
        for field, hint in get_type_hints(group, include_extras=True).items():
            add(field, group._field_defaults.get(field, inspect.Parameter.empty), hint, stated)

    def command(**values: Any) -> Any:
        grouped = {name: group(*map(values.pop, group._fields)) for name, group in groups.items()}
        return function(**values, **grouped)

    functools.update_wrapper(command, function, updated=())
    command.__dict__.pop("__wrapped__", None)
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def joined_vectors(args: Sequence[str]) -> list[str]:
    """Return the arguments with the numbers after a vector option joined by commas.

    `--tension 7 5 5 7` becomes `--tension 7,5,5,7`, so that separate words are accepted as well.
    """
    joined: list[str] = []
    rest = list(args)
    while rest:
        word = rest.pop(0)
        option, equals, _ = word.partition("=")
        if option in VECTOR_OPTIONS and (equals or rest):
            values = [] if equals else [rest.pop(0)]
            first = values[0] if values else word
            while rest and _continues(option, first, rest[0]):
                values.append(rest.pop(0))
            joined += [",".join([word, *values])] if equals else [word, ",".join(values)]
        else:
            joined.append(word)
    return joined


def _continues(option: str, first: str, word: str) -> bool:
    """True if a word belongs to the vector that begins with `first`."""
    if option in _NAMED_OPTIONS and "=" in first and re.match(r"[A-Za-z_]\w*=", word):
        return True
    return _is_number(first.rpartition("=")[2].strip("[(,;")) and _is_number(word.strip("[](),;"))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _print_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    typer.echo("warning: " + printable(" ".join(str(message).split())), err=True)


def command_group(**options: Any) -> typer.Typer:
    """Return a typer application in the style of this program."""
    return _App(
        add_completion=options.pop("add_completion", False),
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"], "max_content_width": 100},
        **options,
    )


app = command_group(cls=CommandGroup, add_completion=True)


def main(application: typer.Typer = app) -> None:
    """Run the program `knode-cosserat`, or another one of the same make."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that has no "²" shows \xb2
            stream.reconfigure(errors="backslashreplace")
    application()


def examples(*commands: str, program: str = PROGRAM) -> str:
    """Return the examples at the end of a help text. The first character keeps the line breaks."""
    title = "Example:" if len(commands) == 1 else "Examples:"
    return "\n".join(["\b", title, *(f"  {program} {command}" for command in commands)])


Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", help="Log details on stderr, such as recovered time steps and fitting progress."
    ),
]


def import_file(path: Path) -> None:
    """Import a Python file, so that the program knows the loads, schemes and others that it defines.

    Its folder joins the end of the module path: it may import its neighbours, and worker processes find it.

    Raises:
        ImportError: there is no such file, its name is that of another module, or its code fails.
    """
    path = path.absolute()
    if path.suffix != ".py" or not path.is_file():
        raise ImportError(f"{path} is not a Python file; allowed for --import is a file such as my_loads.py")
    sys.path.append(str(path.parent))
    spec = importlib.util.find_spec(path.stem)
    if spec is None or spec.origin is None or not path.samefile(spec.origin):
        raise ImportError(f"{path} has the name of the module {path.stem}; allowed is a name of its own")
    try:
        importlib.import_module(path.stem)
    except Exception as error:
        lines = [it.lineno for it in traceback.extract_tb(error.__traceback__) if it.filename == spec.origin]
        place = f"{path}, line {lines[-1]}" if lines else str(path)
        raise ImportError(f"{place}: {type(error).__name__}: {error}") from error


def log_details(*packages: str) -> None:
    """Log the details of some packages on stderr."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(name)s: %(message)s"))
    for package in packages:
        logger = logging.getLogger(package)
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)


def _version(requested: bool) -> None:
    if requested:
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
    verbose: Verbose = False,
    imported: Annotated[
        list[Path] | None,
        typer.Option(
            "--import",
            metavar="FILE.py",
            help="Run this Python file first: the command then knows its loads, schemes, effects, controllers"
            " and formats by their names. May be repeated.",
        ),
    ] = None,
) -> None:
    """Simulate Cosserat-rod robots, learn residual models and identify parameters.

    Units are SI: m, s, kg, N, Pa, rad. Vectors are numbers separated by commas or spaces: 7,5,5,7.
    """
    if verbose:
        log_details("knode_cosserat")
    for path in imported or ():
        import_file(path)


@app.command(
    "study", hidden=True, context_settings={"ignore_unknown_options": True, "allow_extra_args": True}
)
def study() -> None:
    """Point to the studies."""
    raise ValueError("studies are part of the repository: git clone it, and there python -m studies NAME")
