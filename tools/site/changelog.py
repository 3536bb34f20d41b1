"""The changelog on the site: the versions of CHANGELOG.md, and a table of the released ones."""

from __future__ import annotations

import re

from tools.site.source import ROOT

HEADING = re.compile(r"^## \[([^\]]+)\](?:[ \t]*[-–][ \t]*(\S+))?.*$", re.MULTILINE)


def versions(text: str) -> list[tuple[str, str]]:
    """Return the name and the date of each version in a changelog; an unreleased one has no date."""
    return [(found[1], found[2] or "") for found in HEADING.finditer(text)]


def page() -> str:
    """Return a table of released versions with their dates, then every version's changes."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    found = versions(text)
    if not found:
        raise LookupError("CHANGELOG.md has no version; expected headings such as '## [Unreleased]'")
    released = [each for each in found if each[0].lower() != "unreleased"]
    rows = "\n".join(f"| {version} | {date} |" for version, date in released)
    table = f"| version | released |\n| --- | --- |\n{rows}" if rows else "No version has been released yet."
    body = HEADING.sub(_heading, text[text.index("\n## [") :])
    # the links are relative to the repository; a page is in docs/
    body = body.replace("](docs/", "](")
    # definitions of version links at the end are not needed
    body = re.sub(r"^\[[^\]]+\]: \S+$", "", body, flags=re.MULTILINE)
    return f"{table}\n\n{body.strip()}"


def _heading(found: re.Match[str]) -> str:
    return f"## {found[1]}, {found[2]}" if found[2] else f"## {found[1]}"
