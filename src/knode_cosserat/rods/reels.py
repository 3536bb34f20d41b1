"""Motor-driven reels: lengths of tendon that they take in, from the motors' angles."""

from __future__ import annotations

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parameters import ParameterError, parameter
from knode_cosserat.rods.parts import Part


class Reels(Part):
    """Reels of a robot whose controls are motors' angles, or lengths, instead of tensions.

    A motor at the angle φ has wound up the length R (φ - φ₀) of each of its tendons. It has let out the same
    length of the tendons on the other side of its reel: an antagonistic pair has one motor. Tendon i, at the
    motor m on the side σ = ±1, is taken in by

        dᵢ = σ R_m (φ_m - φ₀_m) + tᵢ

    tᵢ is the length taken in at the motors' zeros: its pretension, or its slack if negative. `compliance` is
    that of springs in series with the tendons.
    """

    kind: ClassVar[str] = "reels"

    motors: Any = parameter(
        "", "motor of each tendon, from 1 on; negative if its angle lets the tendon out", shape="list",
        low=-1e3, high=1e3,
    )  # fmt: skip
    radius: Any = parameter(
        "m", "R of each motor's reel; without it controls are lengths in m", shape="list", low=1e-6, high=1.0,
        default=None,
    )  # fmt: skip
    zero: Any = parameter(
        "rad", "φ₀, angle of each motor at which its reel has taken in nothing", shape="list", low=-1e3,
        high=1e3, default=None,
    )  # fmt: skip
    taken_in: Any = parameter(
        "m", "t, length of each tendon that is taken in at the motors' zeros", shape="list", low=-1.0,
        high=1.0, default=None,
    )  # fmt: skip
    compliance: Any = parameter(
        "m/N", "of a spring in series with each tendon", shape="list", low=0.0, high=1.0, default=None
    )

    def __check_init__(self) -> None:
        super().__check_init__()
        if isinstance(self.motors, jax.core.Tracer):
            return
        motors = np.abs(np.asarray(self.motors))
        count = int(motors.max())
        if not np.array_equal(np.unique(motors), np.arange(1, count + 1)):
            given = np.asarray(self.motors).tolist()
            raise ParameterError(
                f"Reels: motors is {given}; allowed is one whole number for each tendon, that of its motor "
                "from 1 on, negative on the side that lets out"
            )
        if self.radius is None and self.zero is None and count != len(motors):
            raise ParameterError("Reels: radius is missing; it is required where tendons share a motor")
        sizes = {"radius": count, "zero": count, "taken_in": len(motors), "compliance": len(motors)}
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and np.shape(value)[-1:] != (size,):
                raise ParameterError(
                    f"Reels: {name} has {np.size(value)} numbers; allowed is {size}, one for each "
                    f"{'motor' if name in ('radius', 'zero') else 'tendon'}"
                )

    @property
    def tendon_count(self) -> int:
        """Number of tendons."""
        return int(np.shape(self.motors)[-1])

    def motor_count(self, tendons: int) -> int:
        """Return the number of motors, which equals the number of controls."""
        for value in (self.radius, self.zero):
            if value is not None:
                return int(np.shape(value)[-1])
        return tendons

    def lengths(self, control: Float[Any, " motors"]) -> Float[Any, " tendons"]:
        """Return the length of each tendon that the reels have taken in (m)."""
        turned = jnp.asarray(control)
        if self.zero is not None:
            turned = turned - self.zero
        if self.radius is not None:
            turned = turned * self.radius
        motors = jnp.asarray(self.motors)
        numbers = np.arange(1.0, turned.shape[-1] + 1.0)
        sides = jnp.where(jnp.abs(motors)[:, None] == numbers, jnp.sign(motors)[:, None], 0.0)
        taken_in = jnp.sum(sides * turned, axis=1)
        return taken_in if self.taken_in is None else taken_in + jnp.asarray(self.taken_in)
