"""Controllers of the tip's position by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from knode_cosserat.control.baselines.iterative import ILQR
from knode_cosserat.control.baselines.koopman import KoopmanController
from knode_cosserat.control.baselines.lqr import LQR
from knode_cosserat.control.baselines.sampling import MPPI
from knode_cosserat.control.baselines.tip_feedback import PID, KinematicController
from knode_cosserat.control.commands import Controller, ControlLimits
from knode_cosserat.control.predictive import PredictiveController
from knode_cosserat.estimation.adapted import Adapted
from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.outputs import Output, TipPosition
from knode_cosserat.rods.system import System

#: controllers with an observer, which may adapt parameters
WITH_OBSERVER: dict[str, Callable[..., Controller]] = {
    "predictive": PredictiveController, "ilqr": ILQR, "mppi": MPPI,
}  # fmt: skip
#: names of all controllers
NAMES = (*WITH_OBSERVER, "lqr", "koopman", "kinematic", "pid")


def controller_named(
    name: str, robot: System, dt: float, limits: ControlLimits, adapt: Sequence[Adapted | str] = (),
    measured: Output | None = None,
) -> Controller:  # fmt: skip
    """Return a controller of the tip's position with its default settings.

    Args:
        name: one of `NAMES`.
        robot: the model.
        dt: period (s).
        limits: limits of the controls.
        adapt: parameters that are adapted, by a controller with an observer.
        measured: the measurement of an observer, with its noise; None: the tip's position. The noise of an
            identified model's measurement includes the error of its predictions.

    Raises:
        ValueError: an unknown name, or parameters for a controller that adapts none.
        SimulationError: the model has no equilibrium that the controller needs.
    """
    if name not in NAMES:
        raise ValueError(f"there is no controller {name!r}; there are {', '.join(NAMES)}")
    if adapt and name not in WITH_OBSERVER:
        raise ValueError(
            f"the controller {name!r} adapts no parameters; those with an observer do: "
            f"{', '.join(WITH_OBSERVER)}"
        )
    target = TipPosition()
    if name in WITH_OBSERVER:
        observer = KalmanObserver(robot, dt, target if measured is None else measured, adapt=adapt)
        return WITH_OBSERVER[name](observer, target, limits)
    if name == "lqr":
        return LQR(robot, dt, target, limits)
    if name == "koopman":
        return KoopmanController(robot, dt, target, limits)
    return (PID if name == "pid" else KinematicController)(robot, dt, limits)
