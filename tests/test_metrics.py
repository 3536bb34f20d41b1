from dataclasses import dataclass

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from knode_cosserat.metrics import dtw_distance, node_error, pose_mse, rotation_rmse, tip_dtw, tip_rmse


@dataclass
class Poses:
    position: np.ndarray
    quaternion: np.ndarray


def straight(rows=5, nodes=4, length=1.0):
    position = np.zeros((rows, nodes, 3))
    position[:, :, 2] = np.linspace(0, length, nodes)
    quaternion = np.zeros((rows, nodes, 4))
    quaternion[:, :, 0] = 1
    return Poses(position, quaternion)


def wiggling(rows=6, nodes=4, seed=0):
    rng = np.random.default_rng(seed)
    return Poses(rng.normal(size=(rows, nodes, 3)), rng.normal(size=(rows, nodes, 4)))


def dtw_cell_by_cell(a, b):
    table = np.full((len(a) + 1, len(b) + 1), np.inf)
    table[0, 0] = 0
    for i in range(len(a)):
        for j in range(len(b)):
            cheapest = min(table[i, j], table[i, j + 1], table[i + 1, j])
            table[i + 1, j + 1] = np.abs(a[i] - b[j]).sum() + cheapest
    return table[-1, -1]


def paths(max_rows=12):
    numbers = st.floats(-10, 10, allow_subnormal=False)
    return st.integers(1, max_rows).flatmap(lambda rows: arrays(float, (rows, 3), elements=numbers))


@given(paths(), paths())
def test_dtw_is_exact(a, b):
    assert dtw_distance(a, b) == pytest.approx(dtw_cell_by_cell(a, b), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (60, 37), (37, 60), (50, 50)])
def test_dtw_is_exact_on_longer_random_walks(shape):
    rng = np.random.default_rng(1)
    a, b = (rng.normal(size=(rows, 3)).cumsum(axis=0) for rows in shape)
    assert dtw_distance(a, b) == pytest.approx(dtw_cell_by_cell(a, b), rel=1e-12)


def test_dtw_of_a_triangle_and_a_taller_one():
    # On the way up and down the shared values match at no cost; the taller one's 6, 7, 8, 7, 6 must all fall
    # on the lower one's peak, 5.
    low = np.zeros((11, 3))
    low[:, 0] = 5 - np.abs(np.arange(-5, 6))
    tall = np.zeros((17, 3))
    tall[:, 0] = 8 - np.abs(np.arange(-8, 9))
    assert dtw_distance(low, tall) == 1 + 2 + 3 + 2 + 1


def test_dtw_of_shifted_ramps():
    # A ramp of unit steps shifted by two: matching equal heights leaves two points at each end unpaired.
    ramp = np.outer(np.arange(10.0), [0, 1, 0])
    assert dtw_distance(ramp, ramp + np.array([0, 2, 0])) == 2 + 1 + 1 + 2


@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.zeros((4, 1)), np.zeros(3), np.zeros((2, 4, 3))])
def test_dtw_rejects_other_shapes(bad):
    with pytest.raises(ValueError, match=r"second path has shape .* must be \(T, 3\)"):
        dtw_distance(np.zeros((2, 3)), bad)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_dtw_names_the_first_invalid_row(value):
    path = np.zeros((5, 3))
    path[3:, 1] = value
    with pytest.raises(ValueError, match="first path has invalid states from row 3 on"):
        dtw_distance(path, np.zeros((2, 3)))


def test_tip_dtw_reads_last_nodes_and_takes_different_rows_and_nodes():
    a, b = wiggling(rows=6, nodes=4), wiggling(rows=9, nodes=3, seed=1)
    assert tip_dtw(a, b) == dtw_distance(a.position[:, 3], b.position[:, 2])


@pytest.mark.parametrize("metric", [tip_dtw, pose_mse, rotation_rmse, tip_rmse])
def test_equal_histories_have_no_error(metric):
    assert metric(wiggling(), wiggling()) == 0


def test_pose_mse_of_a_constant_offset():
    moved = straight()
    moved.position += [0.1, -0.2, 0.3]
    assert pose_mse(moved, straight()) == pytest.approx(1000 * (0.01 + 0.04 + 0.09) / 6)


@pytest.mark.parametrize("axis", "xyz")
def test_pose_mse_of_a_constant_rotation(axis):
    turned = straight()
    turned.quaternion[:] = Rotation.from_euler(axis, 0.3).as_quat(scalar_first=True)
    assert pose_mse(turned, straight()) == pytest.approx(1000 * 0.3**2 / 6)


@pytest.mark.parametrize("angle", [0.3, 1.7, 3.0])
def test_rotation_rmse_is_the_angle_about_any_axis(angle):
    """Also beyond a right angle, where Euler angles jump."""
    for seed in range(5):
        moved, axis = wiggling(seed=seed), np.random.default_rng(seed).normal(size=3)
        turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        before = Rotation.from_quat(moved.quaternion.reshape(-1, 4), scalar_first=True)
        moved.quaternion = -2.0 * (turn * before).as_quat(scalar_first=True).reshape(6, 4, 4)
        assert rotation_rmse(moved, wiggling(seed=seed)) == pytest.approx(angle, abs=1e-9)


def test_rotation_rmse_does_not_depend_on_the_global_frame():
    """Two histories seen from a turned frame: the paper's metric changes, the angle does not."""
    both = wiggling(), wiggling(seed=1)
    angle, paper = rotation_rmse(*both), pose_mse(*both)
    turn = Rotation.from_euler("x", 1.2)
    for each in both:
        seen = turn * Rotation.from_quat(each.quaternion.reshape(-1, 4), scalar_first=True)
        each.quaternion = seen.as_quat(scalar_first=True).reshape(6, 4, 4)
        each.position = turn.apply(each.position.reshape(-1, 3)).reshape(6, 4, 3)
    assert rotation_rmse(*both) == pytest.approx(angle, rel=1e-12)
    assert pose_mse(*both) != pytest.approx(paper, rel=0.01)


def test_rotation_rmse_averages_squares_over_rows_and_nodes():
    moved = straight(rows=5, nodes=4)
    moved.quaternion[2, 1] = Rotation.from_rotvec([0.0, 0.6, 0.0]).as_quat(scalar_first=True)
    assert rotation_rmse(moved, straight(rows=5, nodes=4)) == pytest.approx(0.6 / np.sqrt(20.0))


def test_pose_mse_order_of_the_angles():
    # Extrinsic: about axes that do not move, by 0.4 about z first, then 0.3 about y, then 0.2 about x.
    angles = 0.4, 0.3, 0.2
    about_z, about_y, about_x = (
        Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
        for angle, axis in zip(angles, (2, 1, 0), strict=True)
    )
    turned = straight()
    rotation = Rotation.from_matrix(about_x @ about_y @ about_z)
    turned.quaternion[:] = rotation.as_quat(scalar_first=True)
    assert pose_mse(turned, straight()) == pytest.approx(1000 * (0.4**2 + 0.3**2 + 0.2**2) / 6)


def test_pose_mse_ignores_length_and_sign_of_quaternions():
    scaled = wiggling()
    scaled.quaternion = -2.5 * scaled.quaternion
    assert pose_mse(scaled, wiggling()) == pytest.approx(0, abs=1e-20)


def test_pose_mse_averages_over_rows_and_nodes():
    moved = straight(rows=5, nodes=4)
    moved.position[2, 1, 0] += 0.6
    assert pose_mse(moved, straight(rows=5, nodes=4)) == pytest.approx(1000 * 0.36 / (5 * 4 * 6))


def test_tip_rmse_and_node_error():
    moved = straight(rows=4, nodes=3)
    moved.position[:, 1] += [0.3, 0.4, 0]
    moved.position[0, 2] += [0, 0, 2.0]
    np.testing.assert_allclose(node_error(moved, straight(rows=4, nodes=3)), [0, 0.5, 1.0])
    assert tip_rmse(moved, straight(rows=4, nodes=3)) == pytest.approx(1.0)


def test_tip_rmse_takes_different_nodes():
    assert tip_rmse(straight(nodes=4, length=1.0), straight(nodes=9, length=1.5)) == pytest.approx(0.5)


@pytest.mark.parametrize("metric", [pose_mse, rotation_rmse, tip_rmse, node_error])
def test_rows_must_agree(metric):
    with pytest.raises(ValueError, match="prediction has 5 rows and reference has 6"):
        metric(straight(rows=5), straight(rows=6))


@pytest.mark.parametrize("metric", [pose_mse, rotation_rmse, node_error])
def test_nodes_must_agree(metric):
    with pytest.raises(ValueError, match="prediction has 4 nodes and reference has 3"):
        metric(straight(nodes=4), straight(nodes=3))


METRICS = [tip_dtw, pose_mse, rotation_rmse, tip_rmse, node_error]


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("field", ["position", "quaternion"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_invalid_states_are_named(metric, field, value):
    broken = straight(rows=50)
    getattr(broken, field)[37:, 2, 1] = value
    message = "prediction has invalid states from row 37 on; compare only the valid rows"
    with pytest.raises(ValueError, match=message):
        metric(broken, straight(rows=50))
    with pytest.raises(ValueError, match=message.replace("prediction", "reference")):
        metric(straight(rows=50), broken)


@pytest.mark.parametrize("metric", METRICS)
def test_zero_quaternions_are_invalid_states(metric):
    broken = straight()
    broken.quaternion[2, 1] = 0
    with pytest.raises(ValueError, match="invalid states from row 2 on"):
        metric(broken, straight())


@pytest.mark.parametrize("metric", METRICS)
def test_batches_must_be_indexed(metric):
    batch = Poses(np.zeros((7, 5, 4, 3)), np.ones((7, 5, 4, 4)))
    with pytest.raises(ValueError, match="a batch of 7 trajectories; index a single trajectory"):
        metric(batch, straight())


@pytest.mark.parametrize("metric", METRICS)
def test_quaternions_must_match_positions(metric):
    mixed = Poses(np.zeros((5, 4, 3)), np.ones((6, 4, 4)))
    with pytest.raises(ValueError, match=r"quaternion has shape \(6, 4, 4\).*must be \(5, 4, 4\)"):
        metric(mixed, straight())


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("shape", [(5, 3), (5, 4, 1), (0, 4, 3), (5, 0, 3)])
def test_positions_must_be_rows_of_nodes(metric, shape):
    with pytest.raises(ValueError, match=r"prediction\.position has shape .* must be \(T, N, 3\)"):
        metric(Poses(np.zeros(shape), np.zeros((*shape[:-1], 4))), straight())


@dataclass
class Positions:
    position: np.ndarray


@pytest.mark.parametrize("metric", [tip_dtw, tip_rmse, node_error])
@pytest.mark.parametrize("kept", [(0, 1), (0, 2), (1, 2)])
def test_a_planar_motion_has_the_errors_of_its_motion_in_space(metric, kept):
    a, b = wiggling(), wiggling(seed=1)
    flat = [Positions(each.position[..., kept]) for each in (a, b)]
    for each in (a, b):
        each.position[..., [axis for axis in range(3) if axis not in kept]] = 0.0
    np.testing.assert_allclose(metric(*flat), metric(a, b), rtol=1e-12)


@pytest.mark.parametrize("metric", [tip_dtw, tip_rmse, node_error])
def test_positions_without_orientations_are_enough(metric):
    a, b = wiggling(), wiggling(seed=1)
    np.testing.assert_allclose(metric(Positions(a.position), b), metric(a, b))


def test_what_a_planar_motion_lacks_is_named():
    flat = Positions(np.zeros((5, 4, 2)))
    with pytest.raises(ValueError, match=r"prediction has no orientations.*use node_error or tip_rmse"):
        pose_mse(flat, flat)
    with pytest.raises(ValueError, match="prediction has 2 coordinates and reference has 3"):
        tip_rmse(flat, straight())
    with pytest.raises(ValueError, match="the paths have 2 and 3 coordinates"):
        dtw_distance(np.zeros((4, 2)), np.zeros((4, 3)))
