"""Attacks on the package: damaged files, kills, disk faults, extreme robots, floods and long runs.

`make attack`, or `python -m tools.attack [PART …]`; each part prints what was tried, refused and failed.
"""

from tools.attack.files import attacked, good_files

__all__ = ["attacked", "good_files"]
