"""What a learned model is compared with: learning without knowledge, and linear prediction in time."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.evaluation.metrics import PoseHistory, pose_mse, tip_dtw
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import History, Scales, System
from knode_cosserat.trajectory import Trajectory


class NoKnowledge(System):
    """A system that knows what its numbers are and what holds at its ends, and nothing else: y_s = 0, z = 0.

    With a residual on it everything is learned. Layouts, ends and rest are those of another system.
    """

    model: System

    def __init__(self, model: System):
        self.model = model
        self.nodes = model.nodes

    @property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """The model's."""
        return self.model.y_layout

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """The model's."""
        return self.model.z_layout

    @property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """The model's."""
        return self.model.control_layout

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """The model's."""
        return self.model.base_unknowns

    @property
    def mixed(self) -> bool:  # type: ignore[override]
        """Whatever the model's is: B is not known."""
        return False

    @property  # type: ignore[misc]
    def length(self) -> Any:
        """The model's (m)."""
        return self.model.length

    def derivatives(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Zeros."""
        return jnp.zeros(self.y_layout.size), jnp.zeros(self.z_layout.size)

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """The model's: where a simulation begins is no physics."""
        return self.model.rest(s)

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"], history: History) -> Float[Any, " y"]:
        """The model's."""
        return self.model.base(t, control, unknowns, history)

    def unknowns(self, y: Float[Any, " y"]) -> Float[Any, " k"]:
        """The model's."""
        return self.model.unknowns(y)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], history: History) -> Float[Any, " k"]:
        """The model's."""
        return self.model.tip(t, control, y, history)

    @property
    def tip_layout(self) -> Layout:
        """The model's."""
        return self.model.tip_layout

    def scales(self) -> Scales:
        """The model's."""
        return self.model.scales()

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """The model's, so that the network sees what it sees beside a knowledge."""
        return self.model.actuation(control)

    def positions(self, y: Any) -> Any:
        """The model's."""
        return self.model.positions(y)

    def quaternions(self, y: Any) -> Any:
        """The model's."""
        return self.model.quaternions(y)

    def replace(self, **changes: Any) -> Self:
        """A copy of which the model has other parameters (or nodes), by name."""
        return type(self)(self.model.replace(**changes))


class Poses(NamedTuple):
    """What the metrics compare: positions (T, N, 3) in m and quaternions (T, N, 4)."""

    position: np.ndarray
    quaternion: np.ndarray


def compared(prediction: PoseHistory | str, reference: PoseHistory | str) -> dict[str, Any]:
    """Both figures of a cell; None and the reason, if there is none of the two trajectories but a reason.

    The same if a prediction has grown beyond all numbers.
    """
    failed = next((each for each in (reference, prediction) if isinstance(each, str)), None)
    if failed is None and not np.all(np.isfinite(np.asarray(prediction.position))):  # type: ignore[union-attr]
        failed = "the prediction grows beyond all numbers"
    if failed is not None:
        return {"tip_dtw": None, "pose_mse": None, "failed": failed}
    measures = {"tip_dtw": tip_dtw, "pose_mse": pose_mse}
    return {name: measure(prediction, reference) for name, measure in measures.items()}  # type: ignore[arg-type]


class LinearPredictor(NamedTuple):
    """x' = A x + B f, from one row to the next: x is how far a state is from rest, f the actuation.

    A and B are found by dynamic mode decomposition with control (Proctor, Brunton & Kutz, SIAM J. Applied
    Dynamical Systems 15, 2016) of the numbers of all nodes, each field in its own unit of size.
    """

    system: System
    rest: Float[np.ndarray, " x"]
    scale: Float[np.ndarray, " x"]
    A: Float[np.ndarray, "x x"]
    B: Float[np.ndarray, "x a"]
    rank: int

    @property
    def growth(self) -> float:
        """By what the fastest of its motions grows from row to row, if left alone."""
        return float(np.max(np.abs(np.linalg.eigvals(self.A))))

    def __call__(self, tensions: Float[Any, "T c"]) -> Poses:
        """T rows from rest on under these controls, as the paper counts; they may grow beyond all numbers."""
        x = np.zeros_like(self.rest)
        rows = [x]
        with np.errstate(over="ignore", invalid="ignore"):
            for force in _forces(self.system, tensions)[:-1]:
                x = self.A @ x + self.B @ force
                rows.append(x)
            y = (self.rest + self.scale * np.array(rows)).reshape(len(rows), self.system.nodes, -1)
        return Poses(np.asarray(self.system.positions(y)), np.asarray(self.system.quaternions(y)))


#: ranks that are tried
RANKS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24)
#: a row: e in a hundred
GROWTH = 1.01


def linear_predictor(system: System, trajectories: Sequence[Trajectory]) -> LinearPredictor:
    """The linear predictor of the rank that goes on best where it has not seen how.

    For each of `RANKS` it is fitted to the first two thirds of every trajectory, to be rolled out over all of
    it; the best is then fitted to everything. One that grows faster than `GROWTH` is taken only for want of
    another.

    Args:
        system: the robot, for its layout and its actuation only.
        trajectories: each from rest on, of 4 rows at least.

    Raises:
        ImportError: PyDMD is not installed, the extra `bench`.
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
    """The predictor of one rank; None if there are too few rows for it."""
    states = [np.asarray(trajectory.y) for trajectory in trajectories]
    rest, scale = states[0][0], np.ones_like(states[0][0])
    for field in system.y_layout.fields:
        away = np.concatenate([system.y_layout.get(each - rest, field.name) for each in states])
        size = float(np.sqrt(np.mean(np.square(away))))
        scale[:, system.y_layout.slice(field.name)] = size if size > 0.0 else 1.0
    scaled = [((each - rest) / scale).reshape(len(each), -1) for each in states]
    before = np.concatenate([each[:-1] for each in scaled]).T
    after = np.concatenate([each[1:] for each in scaled]).T
    # what acts between two rows is the second one's
    inputs = np.concatenate([_forces(system, each.control)[1:] for each in trajectories]).T
    # directions in which nothing ever pulls have no weight to be found
    pulled = np.abs(inputs).max(axis=1) > 0.0
    if rank + pulled.sum() > before.shape[1] and rank > 1:
        return None
    A, B = _decomposed(before, after, inputs[pulled], rank)
    full = np.zeros((len(A), len(inputs)))
    full[:, pulled] = B
    return LinearPredictor(system, rest.ravel(), scale.ravel(), A, full, rank)


def _forces(system: System, tensions: Any) -> np.ndarray:
    return np.asarray(jax.vmap(system.actuation)(np.asarray(tensions)))


def _misses(predictor: LinearPredictor, trajectory: Trajectory) -> float:
    """Mean square of the positions that a rollout misses; infinite if it grows beyond all numbers."""
    tensions = np.asarray(trajectory.control)
    predicted = predictor(np.concatenate([tensions[1:], tensions[-1:]])).position
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.mean(np.square(predicted - np.asarray(trajectory.position))))
    return error if np.isfinite(error) else np.inf


def _decomposed(before: Any, after: Any, inputs: Any, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """A and B of one rank, from pairs of states (x, pairs) and what acted between them (a, pairs)."""
    try:
        dmdc = importlib.import_module("pydmd.dmdc")
    except ImportError:
        raise ImportError("the linear predictor needs PyDMD: pip install 'knode-cosserat[bench]'") from None
    # pairs of several trajectories, where the class `DMDc` takes one sequence only
    operator = dmdc.DMDBUnknownOperator(svd_rank=rank, svd_rank_omega=rank + len(inputs), tlsq_rank=0)
    basis, B = operator.compute_operator(before, after, inputs)
    A = basis @ operator.as_numpy_array @ basis.T
    return np.real(A), np.real(B)
