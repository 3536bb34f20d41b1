"""Table of the quantities that drive a robot in a recording, from the table in the code."""

from __future__ import annotations

from knode_cosserat.recordings.quantities import QUANTITIES


def page() -> str:
    """Return the table in Markdown."""
    rows = [
        "| key | units | plausible, in the first unit | recognised columns, such as | controls |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, quantity in QUANTITIES.items():
        words = [
            word.replace("^", "").replace("$", "").replace("?", "").replace("(winkel)", "winkel")
            for word in quantity.words.pattern.split("|")
        ]
        units = ", ".join(f"`{unit}`" for unit in quantity.units)
        size = "any" if quantity.low == 0.0 else f"{quantity.low:g} to {quantity.high:g}"
        shown = ", ".join(words[:3])
        rows.append(
            f"| `{name}` | {units} | {size} | {shown} | {', '.join(quantity.controls) or 'with a `gain`'} |"
        )
    return "\n".join(rows)
