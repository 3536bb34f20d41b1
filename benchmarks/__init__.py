"""Speed, measured as ratios within one run: `python -m benchmarks.run` (or `make bench`)."""

import os

# what is measured is final code, not the quick code of a first call, unless a case says so
os.environ.setdefault("KNODE_COSSERAT_CODE", "final")
