"""Whether an explicit scheme in arclength can carry the waves of a rod.

At time step dt a rod's waves grow or decay along it like exp(λs), the faster the smaller dt and the softer
the rod. Half of them decay. When one decays within a segment an explicit scheme makes it grow: the equations
are then solved, but what they describe is not the rod, and the motion blows up. The eigenvalues of ∂y_s/∂y
tell, and how much shorter the segments must be.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.settings import Settings

#: |λ| ds of a decaying wave that an explicit scheme carries safely
SAFE_DECAY = 1.0


def natural_time(system: System) -> float | None:
    """In what time (s) the system moves by its own length, by its natural units; None if they do not say."""
    layout = system.strand.y_layout
    if "p" not in layout.names or "q" not in layout.names:
        return None
    scale = np.asarray(system.strand.scales().y)
    return float(np.min(scale[..., layout.slice("p")] / scale[..., layout.slice("q")]))


@jax.jit
def _jacobians(problem: StepProblem, y: Any, history: Any) -> Any:
    def at_node(s: Any, y: Any, history: Any) -> Any:
        return jax.jacfwd(lambda y: problem.point_rates(s, y, history)[0])(y)

    return problem.at_nodes(at_node, y, history)


def decay_per_segment(
    system: System, settings: Settings, coefficients: Any, record: Any, control: Any
) -> float:
    """The largest |λ| ds among the decaying waves: how many times its own length the steepest decays by.

    Judged at one state (its record, nodes × x), as if the robot rested there.
    """
    c0 = np.asarray(coefficients, dtype=float)[0]
    record = np.asarray(record)
    nothing = np.zeros((0, 0, 0))
    problem = StepProblem(system, np.zeros(()), np.asarray(control), c0, nothing, settings.space)
    jacobians = np.asarray(_jacobians(problem, record[:, : system.y_layout.size], -c0 * record))
    if not np.all(np.isfinite(jacobians)):
        return 0.0
    z = np.linalg.eigvals(jacobians).ravel() * float(system.length) / (system.nodes - 1)
    return float(np.max(np.abs(z), initial=0.0, where=z.real < -0.3 * np.abs(z)))
