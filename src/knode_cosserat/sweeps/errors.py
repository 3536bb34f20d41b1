"""Error of sweeps."""

from __future__ import annotations

from knode_cosserat.errors import KnodeCosseratError


class SweepError(KnodeCosseratError, ValueError):
    """A sweep is not possible, or its folder cannot be read or written; the message is one line."""

    code = "sweep"
