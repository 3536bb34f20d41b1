"""The measured figures, from the file that `make bench` writes."""

from __future__ import annotations

import json

from benchmarks.run import table
from tools.site.source import ROOT

RESULTS = ROOT / "benchmarks" / "results.json"


def page() -> str:
    """Return the table of all figures, the machine, and the times of single cases."""
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    steps = found["steps"]
    kinds = [kind for kind in steps if "ratio" in steps[kind]]
    against = "\n".join(
        f"| {kind} | {1e3 * steps[kind]['package']:.1f} | {1e3 * steps[kind]['transcription']:.0f} "
        f"| {steps[kind]['ratio']:.0f} |"
        for kind in kinds
    )
    return (
        f"Measured on {found['machine']}.\n\n{table(found)}\n\n"
        "## Comparison with fsolve, by case\n\n"
        "| controls | this package [ms] | fsolve [ms] | ratio |\n| --- | --- | --- | --- |\n" + against
    )
