"""Online estimation: states and parameters of a moving robot from incomplete measurements."""

from knode_cosserat.estimation.boundary import BoundaryObserver
from knode_cosserat.estimation.observer import KalmanObserver, ObserverError, StateEstimate
from knode_cosserat.estimation.outputs import (
    BaseWrench,
    BendingAngles,
    BodyPoses,
    BodyPositions,
    Curvatures,
    Orientations,
    Output,
    TipPose,
    TipPosition,
)
from knode_cosserat.estimation.parameters import Adapted
from knode_cosserat.estimation.window import MovingHorizonObserver

__all__ = [
    "Adapted",
    "BaseWrench",
    "BendingAngles",
    "BodyPoses",
    "BodyPositions",
    "BoundaryObserver",
    "Curvatures",
    "KalmanObserver",
    "MovingHorizonObserver",
    "ObserverError",
    "Orientations",
    "Output",
    "StateEstimate",
    "TipPose",
    "TipPosition",
]
