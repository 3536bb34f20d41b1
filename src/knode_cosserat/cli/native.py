"""Command that writes models for other programs: export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NamedTuple

from knode_cosserat.cli.arguments import Json, Model, Space, argument
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app


class _ExportOptions(NamedTuple):
    """Settings of an exported model.

    Options:
        dt (--dt S): Time step (s).
        target (--target CPU): Computer on which it runs: native (this one), x86-64 (any), x86-64-v3 (AVX2),
            x86-64-v4 (AVX-512) or aarch64, all with Linux.
        name (--name NAME): Prefix of all names in the code. Default: the name of the folder.
        time (--time SCHEME): Time scheme: sdirk2, bdf1, bdf2, bdf-alpha or trapezoidal.
        horizon (--horizon N): Most steps of one prediction with tangents.
        fmi (--fmi VERSION): Version of FMI of an FMU: 3.0 (default) or 2.0.
    """

    dt: float
    target: str = "native"
    name: str | None = None
    time: str = "sdirk2"
    space: Space = "lobatto2"
    horizon: int = 20
    fmi: str | None = None


@app.command()
def export(
    model: Model,
    folder: Annotated[Path, argument("FOLDER", "Folder for the files, or a path that ends in .fmu.")],
    options: _ExportOptions,
    as_json: Json = False,
) -> None:
    """Write a robot or a model as C code that runs without Python.

    The folder gets a header, a source file, an object file, CMakeLists.txt and two examples. A path that ends
    in .fmu becomes a functional mock-up unit for co-simulation; this takes a C compiler.

    Examples:
        export delrin-tendon-robot arm --dt 0.02
        export fitted-model arm --dt 0.002 --target aarch64 --nodes 21
        export delrin-tendon-robot arm.fmu --dt 0.02 --fmi 2.0
    """
    import knode_cosserat as kc

    found = kc.export(model.load(), folder, **options._asdict())
    facts = {
        "robot": model.robot, "name": found.name, "folder": str(found.folder), "files": list(found.files),
        "object_size": found.object_size, "data_size": found.data_size,
    }  # fmt: skip
    lines = [str(found)]
    if found.files != (folder.name,):
        lines += [f"next: cd {found.folder} && cc example.c {found.name}.c {found.name}.o -lm -o example"]
    write_output(as_json, facts, lines)
