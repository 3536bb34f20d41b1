"""Files of exported models, and their templates."""

from __future__ import annotations

import dataclasses
import importlib.resources
import string
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from knode_cosserat.errors import KnodeCosseratError


class ExportError(KnodeCosseratError, ValueError):
    """A model, or an option, that cannot be exported."""

    code = "export"


@dataclasses.dataclass(frozen=True)
class Exported:
    """Files of an exported model.

    Attributes:
        name: prefix of all its names.
        folder: where the files are.
        files: their names.
        object_size: size of the object file (bytes), of which `data_size` are the model's numbers.
        values: sizes and places by the names that the templates of the files use.
    """

    name: str
    folder: Path
    files: tuple[str, ...]
    object_size: int
    data_size: int
    values: Mapping[str, str] = dataclasses.field(repr=False, compare=False)

    def __str__(self) -> str:
        files = ", ".join(self.files)
        size = f"{self.object_size / 1e3:.0f} kB, of which {self.data_size / 1e3:.0f} kB are numbers"
        return f"{self.folder}: {files}\nmachine code: {size}"


def filled(source: str, values: Mapping[str, Any]) -> str:
    """Return a template, with its names replaced by values."""
    text = importlib.resources.files(__package__).joinpath("templates", source).read_text(encoding="utf-8")
    return string.Template(text).substitute(values)
