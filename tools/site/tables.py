"""Write the tables of the documentation that are made of the code: python -m tools.site.tables

They are committed, so that they can be read without a site. On a page, a table stands between a comment
with its name and a comment with its end.
"""

from __future__ import annotations

import re

from tools.site import quantities, robot_file
from tools.site.source import ROOT

TABLES = {
    "quantities": quantities.page,
    "robot-kinds": robot_file.robots,
    "robot-loads": lambda: robot_file.parts(*robot_file.LOADS),
    "robot-tendons": lambda: robot_file.parts(*robot_file.TENDONS),
    "robot-parts": robot_file.parts,
}
TABLE = re.compile(r"^(<!-- table: ([a-z-]+) -->\n).*?^(<!-- end -->)$", re.MULTILINE | re.DOTALL)


def filled(text: str) -> str:
    """Return a page with its tables made anew."""
    return TABLE.sub(lambda found: f"{found[1]}\n{TABLES[found[2]]()}\n\n{found[3]}", text)


def main() -> None:
    """Write the pages whose tables are not those of the code."""
    for page in sorted((ROOT / "docs").rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        made = filled(text)
        if made != text:
            page.write_text(made, encoding="utf-8")
            print(page.relative_to(ROOT))


if __name__ == "__main__":
    main()
