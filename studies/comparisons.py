"""Baselines for learned models: learning without a nominal model, and linear prediction in time."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.metrics import PoseHistory, pose_mse, rotation_rmse, tip_dtw
from knode_cosserat.rods.aspects import Drawing, Ends, Observed
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory
from studies.report import MEASURES


def _of_model(name: str) -> Any:
    return property(lambda self: getattr(self.model, name), doc=f"The model's `{name}`.")


class NoKnowledge(System):
    """System without physics between its ends: y_s = 0, z = 0.

    A residual on it learns everything. Layouts, boundary conditions and rest come from another system: an
    initial state is not physics. The network has the same input as with a nominal model, its actuation.
    """

    model: System

    y_layout = _of_model("y_layout")
    z_layout = _of_model("z_layout")
    control_layout = _of_model("control_layout")
    base_unknowns = _of_model("base_unknowns")
    length = _of_model("length")
    rest = _of_model("rest")
    base = _of_model("base")
    tip = _of_model("tip")
    scales = _of_model("scales")

    def __init__(self, model: System):
        self.model = model
        self.nodes = model.nodes

    @property
    def mixed(self) -> bool:  # type: ignore[override]
        """False for every model: B is unknown."""
        return False

    def constitutive(self, s: Any, t: Any, y: Any, y_t: Any, control: Any) -> Float[Any, " z"]:
        """Return zeros for z."""
        return jnp.zeros(self.z_layout.size)

    def balance(self, s: Any, t: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any) -> Float[Any, " y"]:
        """Return zeros for y_s."""
        return jnp.zeros(self.y_layout.size)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with changed parameters (or nodes) of the model."""
        return type(self)(self.model.replace(**changes))


Ends.register(NoKnowledge, lambda system: Ends.of(system.model))
Drawing.register(NoKnowledge, lambda system: Drawing.of(system.model))
Observed.register(NoKnowledge, lambda system: Observed.of(system.model))


class NodePoses(NamedTuple):
    """Poses for the metrics: positions (T, N, 3) in m and quaternions (T, N, 4)."""

    position: np.ndarray
    quaternion: np.ndarray


def compared(prediction: PoseHistory | str, reference: PoseHistory | str) -> dict[str, Any]:
    """Return the metrics of a cell; None and the reason if a trajectory is replaced by a reason.

    A prediction that is not finite counts as failed too.
    """
    failed = next((each for each in (reference, prediction) if isinstance(each, str)), None)
    if failed is None and not np.all(np.isfinite(np.asarray(prediction.position))):  # type: ignore[union-attr]
        failed = "the prediction grows beyond all numbers"
    if failed is not None:
        return dict.fromkeys(MEASURES) | {"failed": failed}
    measures = (tip_dtw, pose_mse, rotation_rmse)
    return {measure.__name__: measure(prediction, reference) for measure in measures}  # type: ignore[arg-type]


class LinearPredictor(NamedTuple):
    """Linear predictor x' = A x + B f from row to row: x is the deviation from rest, f the actuation.

    A and B come from dynamic mode decomposition with control (Proctor, Brunton & Kutz, SIAM J. Applied
    Dynamical Systems 15, 2016) of the states of all nodes, with each field scaled by its size.
    """

    system: System
    rest: Float[np.ndarray, " x"]
    scale: Float[np.ndarray, " x"]
    A: Float[np.ndarray, "x x"]
    B: Float[np.ndarray, "x a"]
    rank: int

    @property
    def growth(self) -> float:
        """Spectral radius of A: the largest growth factor from row to row without actuation."""
        return float(np.max(np.abs(np.linalg.eigvals(self.A))))

    def __call__(self, tensions: Float[Any, "T c"]) -> NodePoses:
        """Return T rows from rest under these controls, as the paper counts; they may overflow."""
        x = np.zeros_like(self.rest)
        rows = [x]
        with np.errstate(over="ignore", invalid="ignore"):
            for force in _forces(self.system, tensions)[:-1]:
                x = self.A @ x + self.B @ force
                rows.append(x)
            y = (self.rest + self.scale * np.array(rows)).reshape(len(rows), self.system.nodes, -1)
        drawing = Drawing.of(self.system)
        return NodePoses(np.asarray(drawing.positions(y)), np.asarray(drawing.quaternions(y)))


#: candidate ranks
RANKS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24)
#: a row: e in a hundred
GROWTH = 1.01


def linear_predictor(system: System, trajectories: Sequence[Trajectory]) -> LinearPredictor:
    """Return the linear predictor of the rank with the best extrapolation.

    For each of `RANKS` a predictor is fitted to the first two thirds of every trajectory and rolled out over
    the whole. The best rank is then fitted to all data. A predictor that grows faster than `GROWTH` is used
    only if there is no other.

    Args:
        system: the robot; only its layout and actuation are used.
        trajectories: trajectories that begin at rest, with at least 4 rows each.

    Raises:
        ImportError: PyDMD is not installed, the extra `studies`.
    """
    parts = [trajectory[: -(-2 * len(trajectory.y) // 3)] for trajectory in trajectories]
    tried = []
    for rank in RANKS:
        found, earlier = _fitted(system, trajectories, rank), _fitted(system, parts, rank)
        if found is not None:
            error = np.inf if earlier is None else sum(_misses(earlier, each) for each in trajectories)
            tried.append((found.growth > GROWTH, error, rank, found))
    return min(tried, key=lambda each: each[:3])[-1]


def _fitted(system: System, trajectories: Sequence[Trajectory], rank: int) -> LinearPredictor | None:
    """Return the predictor of one rank; None if there are too few rows for it."""
    states = [np.asarray(trajectory.y) for trajectory in trajectories]
    rest, scale = states[0][0], np.ones_like(states[0][0])
    for field in system.y_layout.fields:
        away = np.concatenate([system.y_layout.get(each - rest, field.name) for each in states])
        size = float(np.sqrt(np.mean(np.square(away))))
        scale[:, system.y_layout.slice(field.name)] = size if size > 0.0 else 1.0
    scaled = [((each - rest) / scale).reshape(len(each), -1) for each in states]
    before = np.concatenate([each[:-1] for each in scaled]).T
    after = np.concatenate([each[1:] for each in scaled]).T
    # the second row of a pair has the control that acts between both
    inputs = np.concatenate([_forces(system, each.control)[1:] for each in trajectories]).T
    # directions without actuation have no identifiable weight
    pulled = np.abs(inputs).max(axis=1) > 0.0
    if rank + pulled.sum() > before.shape[1] and rank > 1:
        return None
    A, B = _decomposed(before, after, inputs[pulled], rank)
    full = np.zeros((len(A), len(inputs)))
    full[:, pulled] = B
    return LinearPredictor(system, rest.ravel(), scale.ravel(), A, full, rank)


def _forces(system: System, tensions: Any) -> np.ndarray:
    return np.asarray(jax.vmap(Observed.of(system).actuation)(np.asarray(tensions)))


def _misses(predictor: LinearPredictor, trajectory: Trajectory) -> float:
    """Return the mean squared position error of a rollout; infinite if it overflows."""
    tensions = np.asarray(trajectory.control)
    predicted = predictor(np.concatenate([tensions[1:], tensions[-1:]])).position
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.mean(np.square(predicted - np.asarray(trajectory.position))))
    return error if np.isfinite(error) else np.inf


def _decomposed(before: Any, after: Any, inputs: Any, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Return A and B of one rank, from pairs of states (x, pairs) and the actuation of each (a, pairs)."""
    try:
        dmdc = importlib.import_module("pydmd.dmdc")
    except ImportError:
        raise ImportError("the linear predictor needs PyDMD: pip install '.[studies]'") from None
    # pairs of several trajectories, where the class `DMDc` takes one sequence only
    operator = dmdc.DMDBUnknownOperator(svd_rank=rank, svd_rank_omega=rank + len(inputs), tlsq_rank=0)
    basis, B = operator.compute_operator(before, after, inputs)
    A = basis @ operator.as_numpy_array @ basis.T
    return np.real(A), np.real(B)
