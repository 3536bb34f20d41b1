"""Run the attacks and print their tables: `python -m tools.attack [PART …] [--share 0.1] [--seed N]`.

Parts: files (20,000 damaged files), kills (200), disk (100 faults), cases (3,000 extreme robots), flood
(1,000 pages at the live server), long (10,000 simulations), live (a session of an hour). `make attack` runs
all but the last two within an hour; these take hours: `python -m tools.attack long live`.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from tools.attack import attacked, good_files
from tools.attack.table import Row, printed_row, printed_title

FILES, KILLS, FAULTS, CASES, SIMULATIONS, LIVE = 20_000, 200, 100, 3_000, 10_000, 3_600.0


def files(folder: Path, share: float, seed: int) -> list[Row]:
    """Read damaged files of all kinds."""
    readers, rows = good_files(folder), []
    count = max(1, round(share * FILES / len(readers)))
    for name, reader in readers.items():
        found = attacked(name, reader, folder, count, seed)
        said = f"{found.read} read, {found.longest:.2f} s at most"
        rows.append(Row(f"damaged {name}", count, found.refused, found.failures, said))
        printed_row(rows[-1])
    return rows


def kills(folder: Path, share: float, seed: int) -> list[Row]:
    """Kill processes that write."""
    from tools.attack.kills import killed

    return killed(folder, max(1, round(share * KILLS)), seed)


def disk(folder: Path, share: float, seed: int) -> list[Row]:
    """Let the disk fail while files are written."""
    from tools.attack.disk import faults

    return faults(folder, max(1, round(share * FAULTS)), seed)


def cases(folder: Path, share: float, seed: int) -> list[Row]:
    """Check extreme robots against an independent residual and a finer grid."""
    from tools.attack.cases import checked_cases

    return checked_cases(folder, max(1, round(share * CASES)), seed)


def flood(folder: Path, share: float, seed: int) -> list[Row]:
    """Flood the live server."""
    from tools.attack.flood import flooded

    return flooded(seconds=max(10.0, 60.0 * share))


def long(folder: Path, share: float, seed: int) -> list[Row]:
    """Run different simulations in this process."""
    from tools.attack.long_run import simulated

    return simulated(max(1, round(share * SIMULATIONS)))


def live(folder: Path, share: float, seed: int) -> list[Row]:
    """Run a live session."""
    from tools.attack.long_run import lived

    return lived(share * LIVE)


PARTS: dict[str, Callable[[Path, float, int], list[Row]]] = {
    "files": files,
    "kills": kills,
    "disk": disk,
    "cases": cases,
    "flood": flood,
    "long": long,
    "live": live,
}
#: parts that end within an hour together
USUAL = ("files", "kills", "disk", "cases", "flood")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run parts, the usual ones if none is named; the exit status is 1 if anything failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--share", type=float, default=1.0, help="share of the full numbers")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    parts = given.parts or USUAL
    unknown = sorted(set(parts) - set(PARTS))
    if unknown:
        parser.error(f"unknown part {unknown[0]!r}; parts are {', '.join(PARTS)}")
    folder = Path(tempfile.mkdtemp(prefix="attack-"))
    printed_title()
    rows = []
    for part in parts:
        own = folder / part
        own.mkdir()
        rows += PARTS[part](own, given.share, given.seed)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(f"\n{sum(row.tried for row in rows)} tried; largest memory: {largest} MB; files: {folder}")
    failures = [failure for row in rows for failure in row.failures]
    for each in failures:
        print(each)
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
