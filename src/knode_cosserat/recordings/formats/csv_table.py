"""Tables in CSV files: columns of numbers under titles, with metadata as comments before them.

The delimiter (`,`, `;` or tab) is that which divides the first lines into equally many cells. Where it is not
a comma, decimal commas are read. A file whose first line has numbers only has no titles: its columns are
called 1, 2, 3 and so on.
"""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from knode_cosserat._files import csv_rows
from knode_cosserat._files.reading import require_limit
from knode_cosserat._files.writing import replacing
from knode_cosserat.recordings import content
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register
from knode_cosserat.recordings.streams import Outgoing
from knode_cosserat.recordings.table import ALLOWED, Table, columns_and_metadata, numbered, numbers_of

if TYPE_CHECKING:
    import pandas as pd  # type: ignore[import-untyped]

#: delimiters of cells, and lines that they are recognised by
DELIMITERS, _SAMPLE = (",", ";", "\t"), 20
_POINT, _COMMA = r"[+-]?\d*\.?\d*(?:[eE][+-]?\d+)?", r"[+-]?\d*,?\d*(?:[eE][+-]?\d+)?"


def read_csv(data: bytes) -> Table:
    """Return a CSV file's metadata and its columns of numbers. The caller limits the number of bytes.

    Raises:
        RecordingError: the bytes are no table of numbers, or have too many lines or columns.
    """
    text = content.text_of(data)
    lines = content.lines_of(text)
    metadata, first = _comments(lines)
    delimiter = delimiter_of(lines[first : first + 10 * _SAMPLE])
    # a quoted cell can have line breaks, so that the header may not be one of the lines
    columns = 1 + max((line.count(delimiter) for line in itertools.islice(lines, first, None)), default=0)
    require_limit(columns, csv_rows.MOST_COLUMNS, "columns")
    table, about_units = _titled(cells_of(text, delimiter))
    return Table(metadata, numbers_of(table), (*_about_comments(lines, first), *about_units))


def delimiter_of(lines: Sequence[str]) -> str:
    """Return the delimiter that divides lines into most cells, equally many in each line."""
    sample = [line for line in lines if line.strip() and not line.startswith("#")][:_SAMPLE]
    counts = {
        delimiter: [len(row) for row in csv.reader(sample, delimiter=delimiter)] for delimiter in DELIMITERS
    }
    return max(
        DELIMITERS,
        key=lambda delimiter: (
            len(set(counts[delimiter])) == 1 < max(counts[delimiter]),
            *counts[delimiter][:1],
        ),
    )


def _comments(lines: Sequence[str]) -> tuple[dict[str, str], int]:
    """Return the metadata from the lines `# key: value` before the header, and the header's index."""
    metadata: dict[str, str] = {}
    for index, line in enumerate(lines):
        if line.strip() and not line.startswith("#"):
            return metadata, index
        key, colon, value = line.removeprefix("#").partition(":")
        if colon:
            metadata[key.strip()] = value.strip()
    return metadata, len(lines)


def _about_comments(lines: Sequence[str], header: int) -> tuple[Finding, ...]:
    """Return findings on text after a `#`, from the header on: nothing of it is read."""
    marked = [k for k in range(header, len(lines)) if "#" in lines[k]]
    whole = [k + 1 for k in marked if lines[k].startswith("#")]
    ends = [k + 1 for k in marked if not lines[k].startswith("#")]
    findings = []
    after = "with # after the header"
    if whole:
        what = f"{numbered(whole, f'line begins {after}', f'lines begin {after}')}; left out"
        findings.append(Finding("warning", "", what))
    if ends:
        what = f"{numbered(ends, 'line has a #', 'lines have a #')}; the text after it is left out"
        findings.append(Finding("warning", "", what))
    return tuple(findings)


def cells_of(text: str, delimiter: str) -> pd.DataFrame:
    """Return all cells as text, with decimal points."""
    import pandas as pd

    try:
        cells = pd.read_csv(
            io.StringIO(text), sep=delimiter, comment="#", header=None, dtype=str, skipinitialspace=True
        )
    except pd.errors.EmptyDataError:
        raise RecordingError(f"the file is empty; allowed is a header {ALLOWED}") from None
    except (pd.errors.ParserError, ValueError) as error:
        reason = (str(error).strip().splitlines() or ["it cannot be parsed"])[-1]
        raise RecordingError(f"not a CSV table: {reason}") from None
    if delimiter == ",":
        return cells
    has_point = (
        _are(cells[k].iloc[1:], _POINT) and cells[k].iloc[1:].str.contains(".", regex=False).any()
        for k in cells
    )
    # a comma beside decimal points separates thousands
    if not any(has_point):
        for k in cells:
            if _are(cells[k].iloc[1:], _COMMA):
                cells[k] = cells[k].where(
                    ~cells[k].str.fullmatch(_COMMA, na=False), cells[k].str.replace(",", ".")
                )
    return cells


def _are(cells: pd.Series, pattern: str) -> bool:
    """True if all cells of a column match a pattern of numbers; empty ones do."""
    return bool(cells.dropna().str.strip().str.fullmatch(pattern).all())


def _titled(cells: pd.DataFrame) -> tuple[pd.DataFrame, tuple[Finding, ...]]:
    """Return the rows under titles, without a line of units, and findings."""
    import pandas as pd

    is_number = [pd.to_numeric(cells.iloc[:2, k], errors="coerce").notna() for k in range(cells.shape[1])]
    findings: tuple[Finding, ...] = ()
    if all(column.iloc[0] for column in is_number):
        return cells.set_axis([str(k + 1) for k in range(cells.shape[1])], axis="columns"), findings
    titles, first = cells.iloc[0].fillna("").str.strip(), 1
    if len(cells) > 2 and not any(column.iloc[1] for column in is_number) and cells.iloc[1].notna().any():
        words = ", ".join(cells.iloc[1].fillna("").str.strip())
        what = f"the line after the titles has no numbers ({words:.200}); left out: its units are not used"
        findings, first = (Finding("warning", "", what),), 2
    table = cells.iloc[first:].set_axis(titles, axis="columns")
    # a delimiter at the end of each line makes a column of nothing
    table = table.loc[
        :, [bool(title) or bool(table.iloc[:, k].notna().any()) for k, title in enumerate(titles)]
    ]
    if table.empty:
        raise RecordingError("no rows after the header")
    return table, findings


def write_csv(path: Path, outgoing: Outgoing) -> None:
    """Write a recording as a CSV table, with its metadata as comments."""
    table, metadata = columns_and_metadata(outgoing)
    comments = "".join(f"# {key}: {value}\n" for key, value in metadata.items())
    with replacing(path) as temporary:
        temporary.write_text(comments + table.to_csv(index=False, lineterminator="\n"), encoding="utf-8")


register(
    RecordingFormat(
        "CSV table",
        recognise=lambda head: False,
        read=lambda path, wanted: read_csv(content.file_bytes(path, csv_rows.LARGEST_FILE)),
        suffixes=(".csv", ".csv.gz"),
        write=write_csv,
        written=(".csv",),
        is_fallback=True,
    )
)
