import dataclasses
import io
import sys

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.evaluation import figures
from knode_cosserat.evaluation.metrics import dtw_distance

# beyond the package's own warnings: those of matplotlib about what it is asked to draw
pytestmark = pytest.mark.filterwarnings("error")

UNITS = {
    "x [m]",
    "y [m]",
    "z [m]",
    "tip x [m]",
    "tip y [m]",
    "tip z [m]",
    "time [s]",
    "tension [N]",
    "distance [m]",
}


@pytest.fixture(scope="module")
def trajectory():
    robot = kc.load_robot("delrin-tendon-robot")
    return kc.simulate(robot, kc.controls.sine(period=0.5, steps=16, dt=0.05), 0.05)


@pytest.fixture(scope="module")
def recording(trajectory):
    rng = np.random.default_rng(0)
    tip = np.asarray(trajectory.tip_position) + rng.normal(0.0, 0.05, trajectory.tip_position.shape)
    return kc.Measurements(
        time=7.0 + np.asarray(trajectory.time),
        tension=np.asarray(trajectory.tension),
        fractions=np.ones(1),
        position=tip[:, None],
        quaternion=np.full((len(tip), 1, 4), np.nan),
        measured=np.ones((len(tip), 1), dtype=bool),
        simulated=True,
        source="a test",
    )


def drawn(figure):
    """The figure's bytes: whatever is wrong with it shows when it is rendered."""
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def every_figure(trajectory, recording):
    return {
        "rods": figures.rod_shapes(trajectory),
        "tip": figures.tip_path({"one": trajectory, "other": recording}),
        "tensions": figures.tensions(trajectory),
        "overview": figures.overview(trajectory),
        "recording": figures.prediction_against_measurement(trajectory, recording),
    }


def test_every_figure_is_drawn_without_a_warning_and_no_window_is_needed(trajectory, recording):
    for figure in every_figure(trajectory, recording).values():
        assert drawn(figure).startswith(b"\x89PNG")
    if "matplotlib.pyplot" in sys.modules:
        assert not sys.modules["matplotlib.pyplot"].get_fignums()


def test_every_axis_says_what_it_shows_in_which_unit(trajectory, recording):
    for name, figure in every_figure(trajectory, recording).items():
        bars = 0
        for axes in figure.axes:
            if axes.get_label() == "<colorbar>":
                assert axes.get_ylabel() == "time [s]"
                bars += 1
                continue
            assert axes.get_ylabel() in UNITS, name
            # one below the other they share the last one's
            below = axes.get_shared_x_axes().get_siblings(axes)
            assert any(one.get_xlabel() in UNITS for one in below), name
            if hasattr(axes, "get_zlabel"):
                assert axes.get_zlabel() == "z [m]"
        assert bars == (1 if name in ("rods", "overview") else 0)


def test_the_rods_are_the_trajectorys(trajectory):
    axes = figures.rod_shapes(trajectory, count=5).axes[0]
    *rods, path, base = axes.get_lines()
    position = np.asarray(trajectory.position)
    for rod, row in zip(rods, [0, 4, 8, 12, 16], strict=True):
        np.testing.assert_array_equal(np.array(rod.get_data_3d()).T, position[row])
    assert len({rod.get_color() for rod in rods}) == 5
    np.testing.assert_array_equal(np.array(path.get_data_3d()).T, position[:, -1])
    np.testing.assert_array_equal(np.array(base.get_data_3d()).T, position[0, :1])


def test_a_metre_is_as_long_in_every_direction(trajectory):
    axes = figures.rod_shapes(trajectory).axes[0]
    lengths = [high - low for low, high in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    box = np.asarray(axes._box_aspect)
    np.testing.assert_allclose(box / box.max(), np.array(lengths) / max(lengths), rtol=1e-9)
    position = np.asarray(trajectory.position).reshape(-1, 3)
    for axis, (low, high) in enumerate((axes.get_xlim(), axes.get_ylim(), axes.get_zlim())):
        assert low <= position[:, axis].min() and position[:, axis].max() <= high


def test_tip_paths_are_overlaid_by_label(trajectory, recording):
    figure = figures.tip_path({"one": trajectory, "other": recording})
    for axis, axes in enumerate(figure.axes):
        one, other = axes.get_lines()
        np.testing.assert_array_equal(one.get_xdata(), trajectory.time)
        np.testing.assert_array_equal(one.get_ydata(), np.asarray(trajectory.tip_position)[:, axis])
        np.testing.assert_array_equal(other.get_xdata(), recording.time)
        np.testing.assert_array_equal(other.get_ydata(), recording.tip_position[:, axis])
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["one", "other"]


def test_tensions_are_held_from_row_to_row(trajectory):
    axes = figures.tensions(trajectory).axes[0]
    for k, patch in enumerate(axes.patches):
        values, edges, _ = patch.get_data()
        np.testing.assert_array_equal(values, np.asarray(trajectory.tension)[1:, k])
        np.testing.assert_array_equal(edges, trajectory.time)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [f"tendon {k}" for k in range(1, 5)]


def test_a_prediction_stands_against_its_recording(trajectory, recording):
    figure = figures.prediction_against_measurement(trajectory, recording)
    *coordinates, distance, above = figure.axes
    predicted, measured = np.asarray(trajectory.tip_position), recording.tip_position
    for axis, axes in enumerate(coordinates):
        for line, tip in zip(axes.get_lines(), (measured, predicted), strict=True):
            np.testing.assert_array_equal(line.get_xdata(), recording.time)
            np.testing.assert_array_equal(line.get_ydata(), tip[:, axis])
    error = np.sqrt(((predicted - measured) ** 2).sum(axis=1))
    np.testing.assert_allclose(distance.get_lines()[0].get_ydata(), error, rtol=1e-12)
    for line, tip in zip(above.get_lines(), (measured, predicted), strict=True):
        np.testing.assert_array_equal(line.get_xydata(), tip[:, :2])
    assert above.get_aspect() == 1.0
    title = figure.get_suptitle()
    assert f"DTW {dtw_distance(predicted, measured):.2f} m over 17 rows" in title
    assert f"RMSE {100 * np.sqrt(np.mean(error**2)):.1f} cm" in title


def test_a_simulated_recording_is_called_one(trajectory, recording):
    def labels(recording):
        axes = figures.prediction_against_measurement(trajectory, recording).axes[0]
        return [text.get_text() for text in axes.get_legend().get_texts()]

    assert labels(recording)[0] == "measured on a simulated stand-in robot"
    assert labels(dataclasses.replace(recording, simulated=False))[0] == "measured on a robot"


def test_an_equilibrium_is_drawn_as_points():
    rest = kc.equilibrium(kc.load_robot("delrin-tendon-robot"), [6.0, 5.0, 5.0, 6.0])
    figure = figures.overview(rest)
    assert drawn(figure).startswith(b"\x89PNG")
    tip_y = figure.axes[2]
    assert tip_y.get_ylabel() == "tip y [m]"
    assert tip_y.get_lines()[0].get_marker() == "o"
    # symmetry keeps it at zero but for rounding, and that is not to fill the axis
    assert np.ptp(tip_y.get_ylim()) > 1e-3


def test_rows_that_were_not_solved_stay_empty(trajectory):
    y, result = np.array(trajectory.y), np.array(trajectory.result)
    y[9:], result[9:] = np.nan, kc.Result.NOT_REACHED
    broken = dataclasses.replace(trajectory, y=y, result=result)
    figure = figures.overview(broken, count=3)
    assert drawn(figure).startswith(b"\x89PNG")
    *rods, _, _ = figure.axes[0].get_lines()
    for rod, row in zip(rods, [0, 4, 8], strict=True):
        np.testing.assert_array_equal(np.array(rod.get_data_3d()).T, np.asarray(trajectory.position)[row])
    with pytest.raises(ValueError, match="no valid row"):
        figures.rod_shapes(broken[9:])


def test_what_cannot_be_drawn_is_said(trajectory, recording):
    batch = dataclasses.replace(
        trajectory, **{name: getattr(trajectory, name)[None] for name in ("y", "z", "control", "result")}
    )
    for draw in (
        figures.rod_shapes,
        figures.tensions,
        figures.overview,
        lambda it: figures.tip_path({"": it}),
    ):
        with pytest.raises(ValueError, match="a batch of 1 trajectories"):
            draw(batch)
    with pytest.raises(ValueError, match="the prediction has 16 rows and the recording 17"):
        figures.prediction_against_measurement(trajectory[1:], recording)


def test_without_matplotlib_it_says_what_to_install(trajectory, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install 'knode-cosserat\[viz\]'"):
        figures.tensions(trajectory)
