"""The guide for contributors on the site: CONTRIBUTING.md below its title."""

from __future__ import annotations

from tools.site.source import ROOT


def page() -> str:
    """Return CONTRIBUTING.md without its title, with links from the folder docs."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    _, body = text.split("\n", 1)
    return body.replace("](docs/", "](").strip()
