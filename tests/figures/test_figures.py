import dataclasses
import io
import sys

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat import figures
from knode_cosserat.control import LoopLog
from knode_cosserat.figures.style import PALETTE
from knode_cosserat.metrics import dtw_distance

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
    "distance of the tips [m]",
}


@pytest.fixture(scope="module")
def trajectory():
    robot = kc.load_robot("delrin-tendon-robot")
    return kc.simulate(robot, kc.controls.sine(period=0.5, steps=16, dt=0.05), 0.05)


@pytest.fixture(scope="module")
def recording(trajectory):
    rng = np.random.default_rng(0)
    tip = np.asarray(trajectory.tip_position) + rng.normal(0.0, 0.05, trajectory.tip_position.shape)
    return kc.recordings.Measurements(
        time=7.0 + np.asarray(trajectory.time),
        control=np.asarray(trajectory.held_tension),
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
        "shape": figures.shape(trajectory),
        "tip": figures.tips({"one": trajectory, "other": recording}),
        "path": figures.path({"one": trajectory, "wanted": recording}),
        "side": figures.shape(trajectory, view="xz", columns=2),
        "error": figures.error(trajectory, {"other": trajectory[:]}),
        "tensions": figures.tensions(trajectory),
        "overview": figures.overview(trajectory),
        "recording": figures.prediction_against_measurement(trajectory, recording),
    }


def windows():
    """Figures that pyplot shows; other tests may have opened some."""
    return sys.modules["matplotlib.pyplot"].get_fignums() if "matplotlib.pyplot" in sys.modules else []


def test_every_figure_is_drawn_without_a_warning_and_no_window_is_needed(trajectory, recording):
    before = windows()
    for figure in every_figure(trajectory, recording).values():
        assert drawn(figure).startswith(b"\x89PNG")
    assert windows() == before


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
        assert bars == (1 if name in ("shape", "side", "overview") else 0)


def test_the_rods_are_the_trajectorys(trajectory):
    axes = figures.shape(trajectory, count=5).axes[0]
    *rods, path, base = axes.get_lines()
    position = np.asarray(trajectory.position)
    for rod, row in zip(rods, [0, 4, 8, 12, 16], strict=True):
        np.testing.assert_array_equal(np.array(rod.get_data_3d()).T, position[row])
    assert len({rod.get_color() for rod in rods}) == 5
    np.testing.assert_array_equal(np.array(path.get_data_3d()).T, position[:, -1])
    np.testing.assert_array_equal(np.array(base.get_data_3d()).T, position[0, :1])


def test_a_metre_is_as_long_in_every_direction(trajectory):
    axes = figures.shape(trajectory).axes[0]
    lengths = [high - low for low, high in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    box = np.asarray(axes._box_aspect)
    np.testing.assert_allclose(box / box.max(), np.array(lengths) / max(lengths), rtol=1e-9)
    position = np.asarray(trajectory.position).reshape(-1, 3)
    for axis, (low, high) in enumerate((axes.get_xlim(), axes.get_ylim(), axes.get_zlim())):
        assert low <= position[:, axis].min() and position[:, axis].max() <= high


def test_tip_paths_are_overlaid_by_label(trajectory, recording):
    figure = figures.tips({"one": trajectory, "other": recording})
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
        np.testing.assert_array_equal(values, np.asarray(trajectory.held_tension)[:-1, k])
        np.testing.assert_array_equal(edges, trajectory.time)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        f"tension {k}" for k in range(1, 5)
    ]


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

    assert labels(recording)[0] == "measured on a simulated robot"
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
        figures.shape(broken[9:])


def test_what_cannot_be_drawn_is_said(trajectory, recording):
    batch = dataclasses.replace(
        trajectory, **{name: getattr(trajectory, name)[None] for name in ("y", "z", "control", "result")}
    )
    for draw in (figures.shape, figures.tensions, figures.overview, lambda it: figures.tips({"": it})):
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


# style


def written(figure, kind):
    file = io.BytesIO()
    figure.savefig(file, format=kind)
    return file.getvalue()


def test_fonts_are_part_of_a_pdf_and_none_is_needed_for_an_svg(trajectory):
    figure = figures.tensions(trajectory)
    document = written(figure, "pdf")
    assert b"/Type3" not in document
    assert b"/FontFile2" in document
    assert b"<text" not in written(figure, "svg")


def test_figures_are_as_wide_as_columns(trajectory):
    for columns, inches in ((1, 3.5), (2, 7.16)):
        for figure in (
            figures.shape(trajectory, columns=columns),
            figures.path(trajectory, columns=columns),
            figures.tips(trajectory, columns=columns),
            figures.states(trajectory, columns=columns),
            figures.tensions(trajectory, columns=columns),
        ):
            assert figure.get_figwidth() == inches
    with pytest.raises(ValueError, match="columns is 3; allowed is 1 or 2"):
        figures.tips(trajectory, columns=3)


def test_the_users_settings_neither_change_a_figure_nor_are_changed(trajectory):
    import matplotlib

    plain = written(figures.tensions(trajectory), "png")
    with matplotlib.rc_context({"font.size": 20, "axes.grid": False, "savefig.dpi": 30}):
        before = dict(matplotlib.rcParams)
        assert written(figures.tensions(trajectory), "png") == plain
        assert dict(matplotlib.rcParams) == before


def test_the_colour_blind_can_tell_lines_apart():
    """Simulated deuteranopia and protanopia (Vienot, Brettel & Mollon 1999): colours stay apart."""
    from matplotlib.colors import to_rgb

    colours = np.array([to_rgb(colour) for colour in PALETTE])
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    green_blind = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
    red_blind = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
    for seen in (linear @ green_blind.T, linear @ red_blind.T):
        apart = np.linalg.norm(seen[:, None] - seen[None], axis=2) + np.eye(len(seen))
        assert apart.min() > 0.1


# what is drawn


def test_states_are_those_of_one_node(trajectory):
    figure = figures.states({"a": trajectory, "b": trajectory}, ("q", "u"), node=3)
    for axes, name, unit in zip(figure.axes, ("q", "u"), ("m/s", "1/m"), strict=True):
        assert axes.get_ylabel() == f"{name} [{unit}]" and axes.get_xlabel() == "time [s]"
        values = np.asarray(trajectory.part(name))[:, 3]
        for k, line in enumerate(axes.get_lines()):
            np.testing.assert_array_equal(line.get_ydata(), values[:, k % 3])
            assert line.get_color() == PALETTE[k % 3]
    with pytest.raises(KeyError, match="no field 'nothing'"):
        figures.states(trajectory, ("nothing",))
    with pytest.raises(ValueError, match="node is 10; the trajectory has 10 nodes"):
        figures.states(trajectory, node=10)


def test_the_error_is_the_distance_of_the_tips(trajectory, recording):
    figure = figures.error(trajectory, {"other": dataclasses.replace(recording, time=trajectory.time)})
    distance = np.linalg.norm(recording.tip_position - np.asarray(trajectory.tip_position), axis=1)
    np.testing.assert_allclose(figure.axes[0].get_lines()[0].get_ydata(), distance, rtol=1e-12)
    assert figure.axes[0].get_yscale() == "log"
    with pytest.raises(ValueError, match="'other' has 16 rows and the truth 17"):
        figures.error(trajectory, {"other": trajectory[1:]})


def test_seen_from_the_side_a_metre_is_as_long_up_as_across(trajectory):
    axes = figures.shape(trajectory, view="xz", count=3).axes[0]
    assert axes.get_aspect() == 1.0
    position = np.asarray(trajectory.position)
    np.testing.assert_array_equal(axes.get_lines()[1].get_xydata(), position[8][:, [0, 2]])
    with pytest.raises(ValueError, match=r"view is 'zx'; allowed is xyz, xy, xz, yz"):
        figures.shape(trajectory, view="zx")


def at_rest(rod, moved=0.0):
    """One row of a rod as it rests, moved along x: nothing is solved."""
    y, z = (
        np.stack([np.asarray(rod.rest(s)[k]) for s in rod.length * np.linspace(0, 1, rod.nodes)])
        for k in (0, 1)
    )
    y[:, 0] += moved
    row = np.zeros(1, dtype=int)
    return kc.Trajectory(
        rod, None, np.zeros(1), y[None], z[None], np.zeros((1, rod.control_layout.size)), row, 0.0 * row, row
    )


def test_obstacles_are_where_they_are():
    rod = kc.load_robot("soft-slender-robot")
    cylinder = rod.surroundings[1]
    axes = figures.shape(at_rest(rod), view="xz").axes[0]
    (floor,) = (each.get_paths()[0].vertices for each in axes.collections if each.zorder == 0)
    assert floor[:, 1].max() == pytest.approx(0.0, abs=1e-9)  # the cylinder is beyond the rod's reach
    swept = at_rest(rod, 0.2)
    ball = figures.shape(swept, view="xz").axes[0].collections[-1].get_paths()[0].vertices
    distance = np.linalg.norm(ball - np.asarray(cylinder.point)[[0, 2]], axis=1)
    assert np.all(distance < cylinder.radius + 1e-3) and distance.max() > cylinder.radius - 1e-3


def test_a_batch_is_drawn_as_its_spread(trajectory):
    fields = ("y", "z", "control", "result", "residual", "iterations")
    batch = dataclasses.replace(
        trajectory, **{name: np.stack([np.asarray(getattr(trajectory, name))] * 3) for name in fields}
    )
    batch.y[0, ..., 0] += 0.1
    batch.y[2, ..., 0] -= 0.3
    axes = figures.spread(batch).axes[0]
    np.testing.assert_allclose(axes.get_lines()[0].get_ydata(), np.asarray(trajectory.tip_position)[:, 0])
    widest = axes.collections[0].get_paths()[0].vertices[:, 1]
    tip = np.asarray(trajectory.tip_position)[:, 0]
    assert widest.max() == pytest.approx(tip.max() + 0.1) and widest.min() == pytest.approx(tip.min() - 0.3)
    with pytest.raises(ValueError, match="allowed is a batch"):
        figures.spread(trajectory)


def test_curves_are_checked():
    figure = figures.curves([1, 2, 4], {"a": [1, 2, 3]}, "n", "error [m]", log="xy", marker="o")
    assert figure.axes[0].get_xscale() == figure.axes[0].get_yscale() == "log"
    for wrong, words in (({"a": [1, 2]}, r"shape \(2,\); x has 3"), ({}, "no curves")):
        with pytest.raises(ValueError, match=words):
            figures.curves([1, 2, 3], wrong, "", "")
    with pytest.raises(ValueError, match="log is 'z'"):
        figures.curves([1], {"a": [1]}, "", "", log="z")


def test_what_is_no_trajectory_is_said(trajectory):
    with pytest.raises(ValueError, match="no trajectories to draw"):
        figures.tips({})
    with pytest.raises(TypeError, match=r"trajectories 'a': int given; allowed is a trajectory"):
        figures.tips({"a": 1})
    with pytest.raises(ValueError, match=r"a path has shape \(3,\)"):
        figures.path({"a": [1.0, 2.0, 3.0]})
    with pytest.raises(ValueError, match="count is 0"):
        figures.shape(trajectory, count=0)


def test_a_notebook_shows_it(trajectory):
    assert figures.tensions(trajectory)._repr_png_().startswith(b"\x89PNG")


def log_of(layout, **more):
    """A log of two periods of zero controls."""
    none = np.zeros(2)
    return LoopLog(
        time=0.1 * np.arange(2),
        reference=np.zeros((2, 3)),
        measured=np.zeros((2, 3)),
        tip=np.full((2, 3), 1e-3),
        control=np.zeros((2, layout.size)),
        status=("optimal",) * 2,
        reason=("",) * 2,
        violation=none,
        feedback=none + 1e-3,
        preparation=none + 1e-3,
        parameters={},
        missed=0,
        **more,
    )


@pytest.mark.parametrize(
    ("robot", "title", "first", "last"),
    [
        ("delrin-tendon-robot", "tension [N]", "tension 1", "tension 4"),
        ("three-chamber-arm", "pressure [Pa]", "pressure 1", "pressure 3"),
        ("three-tube-robot", "control", "rotation 1 [rad]", "insertion 3 [m]"),
    ],
)
def test_controls_have_their_names_and_units(robot, title, first, last):
    layout = kc.load_robot(robot).control_layout
    for log, expected in (
        (log_of(layout, control_layout=layout), (title, first, last)),
        (log_of(layout), ("control", "1", str(layout.size))),
    ):
        axes = kc.figures.closed_loop(log).axes[2]
        names = [text.get_text() for text in axes.get_legend().get_texts()]
        assert (axes.get_ylabel(), names[0], names[-1]) == expected
