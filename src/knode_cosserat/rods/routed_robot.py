"""A robot with tendons routed through holes in its ribs, with friction.

`tendon_parts` has the tendons' equations, `tendon_friction` friction and vibration, `rib_spacing` the
softening between ribs, and `relaxation` that of the material.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.anchors import EarlyAnchors
from knode_cosserat.rods.load_cells import LoadCells
from knode_cosserat.rods.parameters import ParameterError, choice, parameter, slot
from knode_cosserat.rods.parts import Contribution, RodPoint
from knode_cosserat.rods.reels import Reels
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.rib_spacing import RibSpacing
from knode_cosserat.rods.routing import OffsetPaths, RoutedPaths, Routing
from knode_cosserat.rods.tendon_friction import TendonFriction, Vibration
from knode_cosserat.rods.tendon_parts import ReeledTendons, RoutedTendons, tension
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.rods.trained_range import TrainedRange


class RoutedTendonRobot(TendonRod):
    """A round rod with routed tendons beside it that bend it, with friction along them.

    Without friction and vibration (the defaults) damping is its only internal variable. Tendons are at
    `tendon_offset` and `tendon_angles`, or follow `routing`.
    """

    routing: tuple[Routing, ...] | None = slot(
        "where the tendons run; by default straight, at their offset and angles", Routing, many=True,
        default=None,
    )  # fmt: skip
    tendon_twist: Any = parameter(
        "rad", "angle by which the tendons turn about the rod from base to tip; by default they are straight",
        low=-10.0, high=10.0, default=None,
    )  # fmt: skip
    drive: str = choice(
        "what is given of the tendons: their tension, or what reels take in", ("tension", "reel"), "tension"
    )
    tendon_compliance: Any = parameter(
        "m/N",
        "C, how much a tendon gives by its tension, if a reel drives it",
        low=0.0,
        high=1.0,
        default=0.0,
    )
    reels: Reels | None = slot(
        "motors whose angles, or lengths, are the controls of the reels; none: one length for each tendon",
        Reels, default=None,
    )  # fmt: skip
    friction: TendonFriction | None = slot(
        "friction of the tendons; none: they slide freely", TendonFriction, default=None
    )
    vibration: Vibration | None = slot(
        "loss of friction where high tensions make the robot shake; none: it does not",
        Vibration,
        default=None,
    )
    rib_spacing: RibSpacing | None = slot(
        "softening by tendons that are straight between ribs; none: they are bent as the rod is", RibSpacing,
        default=None,
    )  # fmt: skip
    relaxation: Relaxation | None = slot(
        "relaxation of the material, a Maxwell branch; none: it does not creep", Relaxation, default=None
    )
    anchors: EarlyAnchors | None = slot(
        "where tendons are anchored before the tip; none: at the tip, or where `routing` ends", EarlyAnchors,
        default=None,
    )  # fmt: skip
    load_cells: LoadCells | None = slot(
        "what measured tensions have to be corrected by; none: controls are tensions", LoadCells, default=None
    )

    trained: TrainedRange | None = slot(
        "range of the recordings that it was identified from; outside it extrapolates", TrainedRange,
        default=None,
    )  # fmt: skip

    def __check_init__(self) -> None:
        if isinstance(self.routing, tuple) and not self.routing:
            raise ParameterError("routing is []; allowed is one or more, one for each tendon")
        if self.reels is None:
            return
        if self.drive != "reel":
            raise ParameterError(f"reels are given, and drive is {self.drive}; allowed is reel")
        if self.reels.tendon_count != self.tendon_count:
            raise ParameterError(
                f"reels have {self.reels.tendon_count} tendons; the robot has {self.tendon_count}"
            )

    @classmethod
    def like(cls, robot: TendonRod, **changes: Any) -> Self:
        """Return a robot with the rod of another, and with tendons at the same places.

        Raises:
            ParameterError: a change that is not allowed.
        """
        if not isinstance(robot, TendonRod):
            raise ParameterError(f"robot is a {type(robot).__name__}; allowed is a tendon-driven robot")
        same = {field.name: getattr(robot, field.name) for field in dataclasses.fields(TendonRod)}
        return cls(**same).replace(**changes)

    # parts

    @property
    def tendons(self) -> RoutedTendons:
        """Tendons with their drive."""
        count, ends = self.tendon_count, self.tendon_ends
        if self.drive == "reel":
            return ReeledTendons(count, ends, None, self.tendon_compliance, self.reels)
        return RoutedTendons(count, ends, self.load_cells)

    def list_parts(self) -> dict[str, Contribution]:
        """Return the parts that are present, in order."""
        names = ("friction", "vibration", "rib_spacing", "relaxation", "anchors")
        present = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return present | super().list_parts()

    @property
    def paths(self) -> OffsetPaths | RoutedPaths:
        """Paths of the tendons."""
        if self.routing is not None:
            return RoutedPaths(self.routing, self.length)
        return OffsetPaths(self.tendon_offset, self.tendon_angles, self.tendon_twist, self.length)

    # action of the tendons

    @property
    def routings(self) -> tuple[Routing, ...]:
        """Routings of the tendons."""
        return self.paths.routings

    @property
    def moment_arm(self) -> float:
        """Largest distance (m) of a tendon from the axis at the base."""
        return float(np.linalg.norm(np.asarray(self.routes_at(0.0)[0]), axis=-1).max())

    def bending_directions(self, s: Any) -> Float[Any, "c 3"]:
        """Return eᵢ: the direction of u in which each tendon bends the rod at s, material frame."""
        return self.paths.directions(s)

    def tension_at(self, s: Any, y: Float[Any, " y"], control: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return τ (N) at s: reduced by friction, and zero beyond a tendon's end."""
        return tension(RodPoint(self, s, None, y, None, control))

    def taken_in(self, control: Float[Any, " c"]) -> Float[Any, " tendons"]:
        """Return dᵢ (m), the length of each tendon that the reels have taken in."""
        tendons: Any = self.parts["tendons"]
        return tendons.taken_in(control[: tendons.control_fields[0].size])
