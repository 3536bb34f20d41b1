"""What MkDocs calls while it builds the site: pages are made of the code and the results that they speak of.

A block with the language `source` holds paths of objects, and becomes their source. A comment such as
`<!-- site: api -->` becomes what is made for it. Equations between `$$` become MathML. Links to
elsewhere are listed beside the site, in external-links.txt. Whatever cannot be made ends the build; so does
a page that would load something from elsewhere.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

import knode_cosserat as kc
from tools.site import (
    api,
    changelog,
    contributing,
    equations,
    examples,
    notebooks,
    source,
)

#: pages that others write: without them the site is whole
OPTIONAL = ("viewer.md", "notebooks.md")
FENCE = re.compile(r"^```source\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"^<!-- site: ([a-z-]+)((?: [a-z_]+)*) -->$", re.MULTILINE)
LOADED = re.compile(r'<(?:script|img|link|iframe|source)[^>]+(?:src|href)="((?:https?:)?//[^"]+)')
LINKED = re.compile(r'<a[^>]+href="(https?://[^"]+)"')
LINKS: dict[str, set[str]] = {}
MADE = {
    "api": api.page,
    "changelog": changelog.page,
    "contributing": contributing.page,
    "examples": examples.page,
    "notebook": notebooks.page,
}


def on_config(config: Any) -> Any:
    """Leave out of the navigation what is not there."""
    there = Path(config.docs_dir)
    config.nav = without([name for name in OPTIONAL if not (there / name).exists()], config.nav)
    return config


def without(names: list[str], nav: Any) -> Any:
    """A navigation without some pages."""
    if isinstance(nav, list):
        return [without(names, entry) for entry in nav if not _is_one(entry, names)]
    if isinstance(nav, dict):
        return {title: without(names, entry) for title, entry in nav.items()}
    return nav


def _is_one(entry: Any, names: list[str]) -> bool:
    return entry in names or (isinstance(entry, dict) and all(page in names for page in entry.values()))


def on_files(files: Any, config: Any) -> Any:
    """The schema of robot files, at a place that does not change, and a page for each public name."""
    text = json.dumps(kc.robots.robot_schema(), indent=2, ensure_ascii=False) + "\n"
    files.append(File.generated(config, "robot.schema.json", content=text))
    for name, content in api.pages(Path(config.docs_dir, "api")).items():
        files.append(File.generated(config, f"api/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Fill a page in. What the guide says is to be found before the reference."""
    if page.file.src_uri.startswith("api/"):
        page.meta["search"] = {"boost": 0.5}
    try:
        markdown = FENCE.sub(lambda block: source.blocks(block[1].split()), markdown)
        markdown = COMMENT.sub(lambda comment: MADE[comment[1]](*comment[2].split()), markdown)
        return equations.rendered(markdown)
    except (LookupError, ValueError, OSError) as error:
        raise PluginError(f"{page.file.src_uri}: {error}") from error


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """The site is to work where there is no network."""
    loaded = LOADED.findall(output)
    if loaded:
        raise PluginError(f"{page.file.src_uri} would load {', '.join(loaded)}")
    for link in LINKED.findall(output):
        LINKS.setdefault(link, set()).add(page.file.src_uri)
    return output


def on_post_build(config: Any) -> None:
    """List the links to elsewhere: nothing here looks whether they still lead anywhere."""
    lines = [f"{link}  {' '.join(sorted(pages))}" for link, pages in sorted(LINKS.items())]
    Path(config.site_dir, "..", "external-links.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
