import dataclasses
import io

import numpy as np
import pytest

import knode_cosserat as kc
from studies import figures

# beyond the package's own warnings: those of matplotlib about what it is asked to draw
pytestmark = pytest.mark.filterwarnings("error")

DT = 0.05


@pytest.fixture(scope="module")
def truth():
    robot = kc.load_robot("delrin-tendon-robot")
    return kc.simulate(robot, kc.controls.sine(period=0.5, steps=16, dt=DT), DT)


@pytest.fixture(scope="module")
def baseline():
    robot = kc.load_robot("delrin-tendon-robot").replace(length=0.4)
    return kc.simulate(robot, kc.controls.sine(period=0.5, steps=16, dt=DT), DT)


def drawn(figure):
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def shown_rows(rows, one, other):
    """Rows, and that of the largest distance of the tips."""
    apart = np.linalg.norm(np.asarray(one.tip_position) - other.tip_position, axis=1)
    return sorted({*rows, int(np.argmax(apart))})


def labels(figure):
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


def test_controls_are_drawn_one_below_the_other(truth, baseline):
    figure = figures.controls({"one": truth, "other": baseline})
    assert drawn(figure).startswith(b"\x89PNG")
    for axes, title in zip(figure.axes, ("one", "other"), strict=True):
        assert axes.get_title() == title
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("time [s]", "tension [N]")
        for k, patch in enumerate(axes.patches):
            np.testing.assert_array_equal(patch.get_data()[0], np.asarray(truth.held_tension)[:-1, k])
    assert labels(figure) == [f"tension {k}" for k in range(1, 5)]


def test_shapes_stand_beside_the_references(truth, baseline):
    figure = figures.shapes(truth, {"baseline": baseline, "best": truth}, count=3)
    assert drawn(figure).startswith(b"\x89PNG")
    assert labels(figure) == ["reference", "baseline", "best"]
    for axes, trajectory in zip(figure.axes, (baseline, truth), strict=True):
        lines = [np.array(line.get_data_3d()).T for line in axes.get_lines()]
        rows = shown_rows([0, 8, 16], truth, trajectory)
        references, true_tip, *own, tip = lines[: len(rows)], *lines[len(rows) :]
        for row, reference, shape in zip(rows, references, own, strict=True):
            np.testing.assert_array_equal(reference, np.asarray(truth.position)[row])
            np.testing.assert_array_equal(shape, np.asarray(trajectory.position)[row])
        np.testing.assert_array_equal(true_tip, truth.tip_position)
        np.testing.assert_array_equal(tip, trajectory.tip_position)
    # one scale for all panels, in which everything is to be seen
    limits = [(axes.get_xlim(), axes.get_ylim(), axes.get_zlim()) for axes in figure.axes]
    assert limits[0] == limits[1]
    for axis, (low, high) in enumerate(limits[0]):
        values = np.concatenate([truth.position, baseline.position])[..., axis]
        assert low <= values.min() and values.max() <= high


def test_tips_are_drawn_over_time_a_column_for_each_case(truth, baseline):
    cases = {"sine": (truth, {"baseline": baseline}), "step": (baseline, {"best": truth})}
    figure = figures.predicted_tips(cases)
    assert drawn(figure).startswith(b"\x89PNG")
    assert labels(figure) == ["reference", "baseline", "best"]
    grid = np.array(figure.axes).reshape(3, 2)
    for column, (title, one, other) in zip(
        grid.T, [("sine", truth, baseline), ("step", baseline, truth)], strict=True
    ):
        assert column[0].get_title() == title
        assert column[-1].get_xlabel() == "time [s]"
        for axis, axes in enumerate(column):
            assert axes.get_ylabel() == f"tip {'xyz'[axis]} [m]"
            for line, trajectory in zip(axes.get_lines(), (one, other), strict=True):
                np.testing.assert_array_equal(line.get_xdata(), trajectory.time)
                np.testing.assert_array_equal(line.get_ydata(), np.asarray(trajectory.tip_position)[:, axis])


def test_a_comparison_has_shapes_and_tips_of_all(truth, baseline):
    figure = kc.figures.compare(truth, {"baseline": baseline, "best": truth}, count=2)
    assert drawn(figure).startswith(b"\x89PNG")
    assert labels(figure) == ["reference", "baseline", "best"]
    shapes, *tips = figure.axes
    assert len(shapes.get_lines()) == 3 * (len(shown_rows([0, 16], truth, baseline)) + 1)
    for axis, axes in enumerate(tips):
        for line, trajectory in zip(axes.get_lines(), (truth, baseline, truth), strict=True):
            np.testing.assert_array_equal(line.get_ydata(), np.asarray(trajectory.tip_position)[:, axis])


def test_losses_have_a_band_over_their_seeds():
    rng = np.random.default_rng(0)
    runs = {name: 10.0 ** rng.uniform(-6, -1, (5, 20)) for name in ("length", "stiffness")}
    figure = figures.losses({name: list(values) for name, values in runs.items()})
    assert drawn(figure).startswith(b"\x89PNG")
    (axes,) = figure.axes
    assert axes.get_yscale() == "log"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("epoch", "loss")
    assert labels(figure) == list(runs)
    for line, band, values in zip(axes.get_lines(), axes.collections, runs.values(), strict=True):
        np.testing.assert_array_equal(line.get_xdata(), np.arange(1, 21))
        np.testing.assert_allclose(line.get_ydata(), np.median(values, axis=0))
        points = band.get_paths()[0].vertices
        for epoch in range(1, 21):
            column = points[points[:, 0] == epoch][:, 1]
            assert column.min() == values[:, epoch - 1].min()
            assert column.max() == values[:, epoch - 1].max()


def test_what_cannot_be_drawn_is_said(truth):
    batch = dataclasses.replace(
        truth, **{name: getattr(truth, name)[None] for name in ("y", "z", "control", "result")}
    )
    for draw in (
        lambda: figures.controls({}),
        lambda: figures.shapes(truth, {}),
        lambda: figures.predicted_tips({}),
        lambda: kc.figures.compare(truth, {}),
        lambda: figures.losses({}),
    ):
        with pytest.raises(ValueError, match="there is nothing to draw"):
            draw()
    for draw in (
        lambda: figures.controls({"": batch}),
        lambda: figures.shapes(truth, {"": batch}),
        lambda: figures.predicted_tips({"": (truth, {"": batch})}),
    ):
        with pytest.raises(ValueError, match="a batch of 1 trajectories"):
            draw()
