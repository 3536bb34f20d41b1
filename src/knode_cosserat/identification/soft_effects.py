"""Effects of soft arms with pressure chambers: the hyperelastic law of their material."""

from __future__ import annotations

from typing import Any

from knode_cosserat.estimation.parameters import Number, PossibleEffect
from knode_cosserat.identification.effects import Usual, register
from knode_cosserat.rods.chambers import Chambers, Hyperelastic
from knode_cosserat.rods.rod import SlenderRod


@register(order=3, of=SlenderRod)
def soft_effects(nominal: SlenderRod, usual: Usual) -> list[PossibleEffect]:
    """Return the effect of a hyperelastic material, if the rod has chambers and states no such law."""
    kinds = [type(part) for part in nominal.effects]
    if Chambers not in kinds or Hyperelastic in kinds:
        return []
    last = f"effects.{len(kinds)}"
    share = Number(f"{last}.share", "", 0.0, 1.0, 0.0, 3.0, begin=0.3)
    second = Number(f"{last}.second", "", 0.0, 0.5, 0.0, 100.0, begin=0.1, shape=True)
    return [PossibleEffect("hyperelastic", (share, second), part=_hyperelastic)]


def _hyperelastic(robot: Any) -> Any:
    return robot.replace(effects=(*robot.effects, Hyperelastic(share=0.0)))
