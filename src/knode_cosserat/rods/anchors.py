"""Tendons that are anchored before the tip."""

from __future__ import annotations

from typing import Any, ClassVar

from knode_cosserat.rods.parameters import parameter, place
from knode_cosserat.rods.parts import Part


class EarlyAnchors(Part):
    """A place with early anchors: beyond it each tendon keeps a part of its tension, 0 if anchored there."""

    kind: ClassVar[str] = "early-anchors"

    at: float = place("where tendons are anchored")
    share: Any = parameter(
        "", "part of each tendon's tension beyond that place", shape="list", low=-1.0, high=2.0,
        default=(1.0, 1.0, 1.0, 1.0),
    )  # fmt: skip
