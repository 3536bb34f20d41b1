import os
import re
import stat

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import array_shapes, arrays

import knode_cosserat as kc
from knode_cosserat import controls
from knode_cosserat.controls import Controls, ControlsError

DT = 0.05
HEADER = "time [s],tension_1 [N],tension_2 [N]\n"


def fails(*parts):
    """A `ControlsError` of one line that has all the parts, in order."""
    return pytest.raises(ControlsError, match=r"^(?!.*\n).*" + ".*".join(map(re.escape, parts)))


def written(tmp_path, text):
    path = tmp_path / "tensions.csv"
    path.write_text(text, encoding="utf-8")
    return path


# signals


@pytest.mark.parametrize("period", [0.5, 1.0, 1.5])
def test_sine_is_the_papers(period):
    tensions = controls.sine(period, 100, DT, sampled="end")
    for i in range(1, 101):
        for k in range(4):
            expected = 6 + np.sin(2 * np.pi * i * 0.05 / period + k * np.pi / 2)
            assert tensions[i - 1, k] == pytest.approx(expected, abs=1e-13)


@given(st.integers(1, 8), st.floats(0.1, 10), st.floats(1, 50), st.floats(0, 1), st.integers(1, 50))
def test_sine_of_any_number_of_tendons(tendons, period, base, part, steps):
    tensions = controls.sine(period, steps, DT, base=base, amplitude=part * base, tendons=tendons)
    assert tensions.shape == (steps, tendons)
    assert np.all(np.abs(tensions - base) <= part * base + 1e-12 * base)
    if tendons > 1:
        assert tensions.mean(axis=1) == pytest.approx(base)


def test_step_is_the_papers():
    tensions = controls.step(1.5, 100, DT, sampled="end")
    assert np.all(tensions[:, 1:3] == 5.0)
    # t = i dt >= 1.5 from i = 30 on, which is row 29
    assert np.all(tensions[:29] == 5.0)
    assert np.all(tensions[29:, [0, 3]] == 6.5)


@given(st.integers(1, 400), st.sampled_from([0.1, 0.05, 0.02, 0.01, 1 / 30, 1e-3, 0.007]))
def test_step_does_not_depend_on_rounding(first, dt):
    for sampled, row in (("end", first - 1), ("middle", first)):
        raised = controls.step(1.0, 401, dt, at=first * dt, sampled=sampled)[:, 0] > 5.0
        assert np.argmax(raised) == row
        assert raised[row:].all()


def test_step_of_other_tendons():
    tensions = controls.step(-2.0, 4, 0.5, base=3.0, at=1.0, tendons=[1], count=3)
    # held from 1 s on, which is row 2
    assert tensions.tolist() == [[3, 3, 3], [3, 3, 3], [3, 1, 3], [3, 1, 3]]


@pytest.mark.parametrize("signal", [controls.step, controls.ramp])
@pytest.mark.parametrize(("count", "named"), [(1, [0]), (2, [0, 1]), (3, [0, 2]), (4, [0, 3]), (6, [0, 5])])
def test_the_first_and_the_last_tendon_are_named_by_default(signal, count, named):
    tensions = signal(2.0, 60, DT, count=count)
    assert np.flatnonzero(np.ptp(tensions, axis=0)).tolist() == named
    word = "step:2" if signal is controls.step else "ramp:2"
    assert np.array_equal(controls.parse(word, 60, DT, count), tensions)


def test_ramp():
    tensions = controls.ramp(2.0, 8, 0.5, start=1.0, end=3.0, tendons=(2,), sampled="end")
    assert tensions[:, 2] == pytest.approx([5, 5, 5.5, 6, 6.5, 7, 7, 7])
    assert np.all(tensions[:, [0, 1, 3]] == 5.0)
    assert controls.ramp(2.0, 8, 0.5, sampled="end")[:, 0] == pytest.approx(5 + np.arange(1, 9) / 4)


@pytest.mark.parametrize("dt", [0.5, 0.1])
def test_what_is_held_is_the_signal_on_average(dt):
    """Integrals of the held rows against those of the signals, in closed form."""
    steps = round(3.0 / dt)
    line, wave = controls.ramp(2.0, steps, dt, end=3.0), controls.sine(4.0, steps, dt, tendons=1)
    jump = controls.step(2.0, steps, dt, at=1.0)
    assert dt * np.sum(line[:, 0] - 5.0) == pytest.approx(2.0 * 3.0 / 2.0)
    assert dt * np.sum(jump[:, 0] - 5.0) == pytest.approx(2.0 * 2.0)
    # the middle rule multiplies the integral of a sine by x / sin x
    x = np.pi * dt / 4.0
    assert dt * np.sum(wave - 6.0) == pytest.approx(4.0 / (2.0 * np.pi) * x / np.sin(x))
    late = controls.ramp(2.0, steps, dt, end=3.0, sampled="end")
    assert dt * np.sum(late[:, 0] - line[:, 0]) == pytest.approx(2.0 * dt / 2.0)


def test_other_times_of_a_step_are_refused():
    with fails("sampled is 'start'", '"middle" or "end"'):
        controls.sine(1.0, 10, DT, sampled="start")


def test_random_is_uniform_and_repeatable():
    tensions = controls.random(4000, seed=3)
    assert tensions.shape == (4000, 4)
    assert tensions.min() >= 5.0
    assert tensions.max() <= 10.0
    assert tensions.mean(axis=0) == pytest.approx(7.5, abs=0.1)
    assert tensions.std(axis=0) == pytest.approx(5 / np.sqrt(12), abs=0.05)
    assert np.array_equal(tensions, controls.random(4000, seed=3))
    assert not np.array_equal(tensions, controls.random(4000, seed=4))
    assert np.array_equal(tensions, 5 + 5 * np.random.default_rng(3).random((4000, 4)))


def test_random_holds_its_draws():
    tensions = controls.random(10, seed=1, hold=4, tendons=2)
    assert tensions.shape == (10, 2)
    for rows in (slice(0, 4), slice(4, 8), slice(8, 10)):
        assert np.all(tensions[rows] == tensions[rows.start])
    assert len(np.unique(tensions)) == 6


def test_constant():
    assert np.array_equal(controls.constant(5, 3), np.full((3, 4), 5.0))
    assert controls.constant(0.0, 2, tendons=3).shape == (2, 3)


@pytest.mark.parametrize(
    ("make", "parts"),
    [
        (lambda: controls.sine(0.0, 10, DT), ["period is 0.0", "above 0"]),
        (lambda: controls.sine(-1.5, 10, DT), ["period is -1.5", "above 0"]),
        (lambda: controls.sine(np.nan, 10, DT), ["period is nan"]),
        (lambda: controls.sine("1.5", 10, DT), ["period is '1.5'"]),
        (lambda: controls.sine(1e-320, 10, DT), ["period is 1e-320", "above 2.1"]),
        (lambda: controls.sine(1.5, 0, DT), ["steps is 0", "whole number from 1 on"]),
        (lambda: controls.sine(1.5, 10.0, DT), ["steps is 10.0", "whole number"]),
        (lambda: controls.sine(1.5, 10, 0.0), ["dt is 0.0", "above 0"]),
        (lambda: controls.sine(1.5, 10, DT, base=np.inf), ["base is inf", "finite"]),
        (lambda: controls.sine(1.5, 10, DT, amplitude=7.0), ["sine: a tension is -", "allowed is 0 or more"]),
        (lambda: controls.sine(1.5, 10, DT, tendons=0), ["tendons is 0"]),
        (lambda: controls.step(-6.0, 50, DT), ["step: a tension is -1 N"]),
        (lambda: controls.step("a", 50, DT), ["height is 'a'"]),
        (lambda: controls.step(1.0, 50, DT, at=np.nan), ["at is nan"]),
        (lambda: controls.step(1.0, 50, DT, tendons=(1, 4)), ["step: tendons is (1, 4)", "0 to 3"]),
        (lambda: controls.ramp(1.0, 50, DT, start=2.0, end=2.0), ["ramp: end is 2.0 s", "2.0 s"]),
        (lambda: controls.ramp(-9.0, 50, DT), ["ramp: a tension is -4 N"]),
        (lambda: controls.random(5, low=3.0, high=2.0), ["random: high is 2.0 N", "3.0 N"]),
        (lambda: controls.random(5, low=-3.0, high=-2.0), ["random: a tension is -"]),
        (lambda: controls.random(5, seed=-1), ["seed is -1", "from 0 on"]),
        (lambda: controls.random(5, hold=0), ["hold is 0"]),
        (lambda: controls.constant(-1.0, 5), ["constant: a tension is -1 N"]),
        (lambda: controls.constant(True, 5), ["tension is True"]),
    ],
)
def test_impossible_signals(make, parts):
    with fails(*parts):
        make()


# files


@settings(max_examples=30)
@given(
    arrays(float, array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=8), elements=st.floats(0, 1e6)),
    st.floats(1e-4, 10),
)
def test_files_come_back_to_the_last_bit(tmp_path_factory, tensions, dt):
    path = tmp_path_factory.mktemp("controls") / "tensions.csv"
    controls.save(path, tensions, dt)
    for again in (controls.load(path), controls.load(path, dt)):
        assert isinstance(again, Controls)
        assert np.array_equal(again.tensions, tensions)
        assert again.dt == dt


def test_the_files_layout(tmp_path):
    path = tmp_path / "tensions.csv"
    controls.save(path, [[5.0, 6.5], [5.25, 7.0]], 0.1)
    assert path.read_text() == HEADER + "0.0,5.0,6.5\n0.1,5.25,7.0\n"


def test_grams_force_and_column_order(tmp_path):
    path = written(tmp_path, "\ufefftension_2 [gf], time [s] ,tension_1[ N ]\n500,0,1\n\n1000,0.1,2\n")
    tensions, dt = controls.load(path)
    assert tensions == pytest.approx(np.array([[1.0, 4.905], [2.0, 9.81]]))
    assert dt == 0.1


def test_sampling_holds_each_row_until_the_next(tmp_path):
    path = written(tmp_path, HEADER + "100.00,1,2\n100.07,3,4\n100.2,5,6\n")
    tensions, dt = controls.load(path, 0.05)
    assert dt == 0.05
    assert tensions[:, 0].tolist() == [1, 1, 3, 3, 5]
    assert controls.load(path, 0.3).tensions.tolist() == [[1, 2]]


@given(st.integers(2, 60), st.integers(1, 5), st.sampled_from([0.1, 0.05, 1 / 30, 0.007]), st.floats(0, 1e6))
def test_sampling_does_not_depend_on_rounding(rows, finer, dt, start):
    path = controls.Path("unused")
    time = start + np.arange(rows) * dt * finer
    held = np.arange(rows, dtype=float)[:, None]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(controls, "_read", lambda _: (time, held))
        sampled = controls.load(path, dt).tensions[:, 0]
    assert np.array_equal(sampled, np.arange((rows - 1) * finer + 1) // finer)


def test_a_file_with_rounded_times_is_uniform(tmp_path):
    rows = "".join(f"{i / 30:.5f},{i},0\n" for i in range(31))
    assert controls.load(written(tmp_path, HEADER + rows)).dt == pytest.approx(1 / 30, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["the file is empty", "time [s],tension_1 [N]"]),
        ("\n \n", ["the file is empty"]),
        (HEADER, ["no rows"]),
        ("time [s],tension_1\n0,1\n", ["line 1: the column 'tension_1' has no unit", "[N] or [gf]"]),
        ("time,tension_1 [N]\n0,1\n", ["line 1: the column 'time' has no unit", "[s]"]),
        ("time [s],tension_1 []\n0,1\n", ["line 1: the column 'tension_1 []' has no unit"]),
        ("time [s],tension_1 [lbf]\n0,1\n", ["line 1", "has the unit 'lbf'", "[N] or [gf]"]),
        ("time [ms],tension_1 [N]\n0,1\n", ["line 1", "has the unit 'ms'", "allowed is [s]"]),
        ("time [s],force [N]\n0,1\n", ["line 1: the column 'force [N]' is unknown", "tension_1 [N]"]),
        ("time [s];tension_1 [N]\n0;1\n", ["line 1: the column 'time [s];tension_1 [N]' is unknown"]),
        ("tension_1 [N],tension_2 [N]\n0,1\n", ["line 1: the columns are tension_1 [N], tension_2 [N]"]),
        ("time [s],tension_1 [N],tension_1 [N]\n0,1,2\n", ["line 1: the columns are", "once each"]),
        ("time [s],tension_1 [N],tension_3 [N]\n0,1,2\n", ["line 1: the columns are", "without a gap"]),
        ("time [s]\n0\n", ["line 1: the columns are time [s]"]),
        (HEADER + "0,1,2\n0.1,1,a2\n", ["line 3: tension_2 [N] is 'a2'", "finite number"]),
        (HEADER + "0,1,2\n\n0.1,,2\n", ["line 4: tension_1 [N] is ''"]),
        (HEADER + "0,1,nan\n0.1,1,2\n", ["line 2: tension_2 [N] is 'nan'"]),
        (HEADER + "0,1,inf\n0.1,1,2\n", ["line 2: tension_2 [N] is 'inf'"]),
        (HEADER + "nan,1,2\n0.1,1,2\n", ["line 2: time [s] is 'nan'"]),
        (HEADER + "0,1,-2\n0.1,1,2\n", ["line 2: tension_2 [N] is '-2'", "0 or more"]),
        (HEADER + "0,1,2\n0.1,1\n", ["line 3 has 2 cells", "allowed is 3"]),
        (HEADER + "0,1,2\n0.1,1,2\n0.1,1,2\n", ["line 4: time is 0.1 s", "after 0.1 s"]),
        (HEADER + "0,1,2\n0.1,1,2\n0.05,1,2\n", ["line 4: time is 0.05 s"]),
        (HEADER + "0,1,2\n0.1,1,2\n0.3,1,2\n", ["the time step varies from 0.1 to 0.2 s", "give dt"]),
        (HEADER + "0,1,2\n", ["one row", "give dt"]),
        ('time [s],"tension_1 [N]\n0,1\n', ["line 2", "is unknown"]),
    ],
)
def test_files_that_are_not_right(tmp_path, text, parts):
    path = written(tmp_path, text)
    with fails(str(path), *parts):
        controls.load(path)


def test_files_that_cannot_be_read(tmp_path):
    with fails("nothing.csv: no such file"):
        controls.load(tmp_path / "nothing.csv")
    with fails(str(tmp_path), "cannot be read"):
        controls.load(tmp_path)
    path = tmp_path / "binary.csv"
    path.write_bytes(b"\x89HDF\xff\xfe")
    with fails("binary.csv: not a CSV text file"):
        controls.load(path)
    with fails("dt is 0"):
        controls.load(path, 0)
    path = written(tmp_path, HEADER + "0,1,2\n1,1,2\n")
    with fails("tensions.csv: dt is 1e-300", "the file's 1 s are at most 100000000"):
        controls.load(path, 1e-300)


def test_what_cannot_be_saved(tmp_path):
    with fails("shape (3,)"):
        controls.save(tmp_path / "a.csv", [1.0, 2.0, 3.0], DT)
    with fails("a.csv: a tension is nan"):
        controls.save(tmp_path / "a.csv", [[1.0, np.nan]], DT)
    with fails("dt is -1"):
        controls.save(tmp_path / "a.csv", [[1.0]], -1)
    with fails("cannot be written"):
        controls.save(tmp_path / "no" / "a.csv", [[1.0]], DT)


def full(*_):
    raise OSError(28, "No space left on device")


def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.csv"
    controls.save(path, [[1.0, 2.0]], DT)
    before = path.read_bytes()
    monkeypatch.setattr(os, "fsync", full)
    with fails("a.csv: cannot be written: No space left on device"):
        controls.save(path, [[3.0, 4.0]], DT)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.csv"]


def test_a_link_stays_one_and_a_pipe_too(tmp_path):
    (tmp_path / "link.csv").symlink_to(tmp_path / "a.csv")
    controls.save(tmp_path / "link.csv", [[1.0, 2.0]], DT)
    assert (tmp_path / "link.csv").is_symlink() and (tmp_path / "a.csv").stat().st_size
    os.mkfifo(tmp_path / "pipe.csv")
    reader = os.open(tmp_path / "pipe.csv", os.O_RDONLY | os.O_NONBLOCK)
    try:
        controls.save(tmp_path / "pipe.csv", [[1.0, 2.0]], DT)
        assert os.read(reader, 10_000) == (tmp_path / "a.csv").read_bytes()
    finally:
        os.close(reader)
    assert stat.S_ISFIFO((tmp_path / "pipe.csv").stat().st_mode)


# the command line


@pytest.mark.parametrize(
    ("specification", "expected"),
    [
        ("sine:1.5", lambda: controls.sine(1.5, 40, DT)),
        ("sine:1.5,base=8,amplitude=2", lambda: controls.sine(1.5, 40, DT, base=8, amplitude=2)),
        ("step:1.5", lambda: controls.step(1.5, 40, DT)),
        ("step:2, at=0.5, tendons=2+3", lambda: controls.step(2, 40, DT, at=0.5, tendons=(1, 2))),
        ("ramp:2,tendons=2, 3,base=4", lambda: controls.ramp(2, 40, DT, base=4, tendons=(1, 2))),
        ("ramp:2", lambda: controls.ramp(2, 40, DT)),
        ("ramp:2,start=1,end=1.5", lambda: controls.ramp(2, 40, DT, start=1, end=1.5)),
        ("random:7", lambda: controls.random(40, seed=7)),
        ("random:7,low=1,high=2,hold=8", lambda: controls.random(40, seed=7, low=1, high=2, hold=8)),
        ("constant:5", lambda: controls.constant(5, 40)),
    ],
)
def test_specifications(specification, expected):
    assert np.array_equal(controls.parse(specification, 40, DT), expected())


@pytest.mark.parametrize("specification", ["sine:1", "step:1,at=0.1,tendons=1+3", "random:1", "constant:1"])
def test_specifications_for_three_tendons(specification):
    assert controls.parse(specification, 5, DT, 3).shape == (5, 3)


def test_a_file_as_specification(tmp_path):
    path = tmp_path / "tensions.csv"
    tensions = controls.random(20, seed=1)
    controls.save(path, tensions, DT)
    assert np.array_equal(controls.parse(str(path), None, DT), tensions)
    assert np.array_equal(controls.parse(str(path), 5, DT), tensions[:5])
    assert np.array_equal(controls.parse(str(path), None, 2 * DT), tensions[::2])
    with fails("there are 20 steps of 0.05 s; 21 are requested; allowed is up to 20"):
        controls.parse(str(path), 21, DT)
    with fails("there are 4 tendons; the robot has 3"):
        controls.parse(str(path), 5, DT, 3)


@pytest.mark.parametrize(
    ("specification", "parts"),
    [
        ("sin:1.5", ["'sin:1.5'", "no such signal or file", "sine:PERIOD", "did you mean sine:PERIOD?"]),
        ("nothing.csv", ["'nothing.csv'", "no such signal or file", "CSV file"]),
        ("", ["''", "no such signal or file"]),
        ("sine", ["'sine'", "period is missing", "such as sine:1.5"]),
        ("sine:fast", ["period is 'fast'", "a number"]),
        ("sine:0", ["'sine:0'", "period is 0.0", "above 0"]),
        ("sine:1.5,speed=2", ["'speed=2' is not understood", "base=…, amplitude=…"]),
        ("sine:1.5,base=5,base=6", ["'base=6' is not understood"]),
        ("constant:5,base=5", ["'base=5' is not understood", "nothing"]),
        ("random:1.5", ["seed is '1.5'", "a whole number"]),
        ("random:1,hold=x", ["hold is 'x'", "a whole number"]),
        ("step:1,tendons=a", ["tendons is 'a'", "tendons like 1,4"]),
        ("step:1,tendons=5", ["tendons is 5", "numbers from 1 to 4"]),
        ("step:1,tendons=0,1", ["tendons is 0,1", "numbers from 1 to 4, such as 1,4"]),
        ("step:1,2,tendons=1", ["'2' is not understood"]),
        ("constant:-1", ["'constant:-1'", "a tension is -1 N"]),
        ("constant:nan", ["tension is nan"]),
        ("x" * 5000, ["no such signal or file"]),
    ],
)
def test_specifications_that_are_not_right(specification, parts):
    with fails(*parts):
        controls.parse(specification, 10, DT)


@pytest.mark.parametrize("dt", [0, -0.1, np.nan, np.inf])
@pytest.mark.parametrize("specification", ["constant:5", "random:0", "sine:1"])
def test_a_time_step_that_is_not_right(specification, dt):
    with fails(f"dt is {dt}", "above 0"):
        controls.parse(specification, 10, dt)


def test_a_signal_needs_a_number_of_steps():
    with fails("'sine:1.5'", "number of steps"):
        controls.parse("sine:1.5", None, DT)


@pytest.mark.parametrize(
    ("specification", "parts"),
    [
        ("step:1e5", ["the step starts at 1.5 s, after the end of the run (10 steps of 0.05 s: 0.5 s)",
                      "use 31 steps or more, or at=0"]),
        ("step:1,at=0.51", ["starts at 0.51 s", "use 11 steps or more"]),
        ("ramp:1,start=2", ["start is 2.0 s", "before the last step, 0.475 s", "use 41 steps"]),
        ("ramp:1,start=2,end=3", ["the ramp starts at 2 s", "use 41 steps or more, or start=0"]),
        ("sine:0.05", ["the sine has the same value at every time step", "period is 0.05 s"]),
    ],
)  # fmt: skip
def test_a_signal_without_effect_during_the_run_is_refused(specification, parts):
    with fails(f"'{specification}'", *parts):
        controls.parse(specification, 10, DT)


@pytest.mark.parametrize(
    ("specification", "steps"),
    [("step:1e5", 31), ("step:1,at=0.51", 11), ("ramp:1,start=2", 41), ("ramp:1,start=2,end=3", 41)],
)
def test_the_suggested_number_of_steps_is_the_least(specification, steps):
    assert np.ptp(controls.parse(specification, steps, DT), axis=0).max() > 0.0
    with fails("allowed" if specification == "ramp:1,start=2" else "after the end of the run"):
        controls.parse(specification, steps - 1, DT)


@pytest.mark.parametrize("specification", ["step:1,at=0", "step:0", "sine:1,amplitude=0", "random:0,hold=9"])
def test_a_constant_signal_may_be_intended(specification):
    assert controls.parse(specification, 9, DT).shape == (9, 4)


def test_functions_may_return_a_signal_without_effect():
    assert np.all(controls.step(1.0, 10, DT) == 5.0)


# controls by name

ROD = kc.robots.SlenderRod(
    length=0.5,
    radius=0.005,
    density=1000.0,
    youngs_modulus=2e7,
    base_end=kc.robots.ends.Driven(axes=("x", "z", "ry")),
)
NAMED = "time [s],base_z [m],base_ry [rad]\n"


def test_a_file_of_named_controls(tmp_path):
    path = written(tmp_path, "\ufeffbase_ry [rad], time [s] ,base_z [m]\n5,0,1\n\n 6,0.1, 2\n7,0.2,3\n")
    found = controls.parse(str(path), None, 0.1, ROD)
    assert found.tolist() == [[0, 1, 5], [0, 2, 6], [0, 3, 7]]
    assert np.array_equal(controls.parse(str(path), 2, 0.1, ROD), found[:2])
    assert controls.parse(str(path), 4, 0.05, ROD)[:, 1].tolist() == [1, 1, 2, 2]
    with fails("there are 3 steps of 0.1 s; 4 are requested; allowed is up to 3"):
        controls.parse(str(path), 4, 0.1, ROD)
    path = written(tmp_path, "time [s]\n0\n0.1\n")
    assert controls.parse(str(path), None, 0.1, ROD).tolist() == [[0, 0, 0]] * 2


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["the file is empty", "time [s],base_x [m],base_z [m],base_ry [rad]"]),
        (NAMED, ["no rows"]),
        (NAMED + "0,1,2,3\n0.1,1,2,3\n", ["line 2 has 4 cells", "allowed is 3, like the header"]),
        (NAMED + "0,1,2\n\n0.1,1,2,3\n", ["line 4 has 4 cells"]),
        (NAMED + "0,1,2\n0.1,1\n", ["line 3 has 2 cells"]),
        ("time [s],base_z [m], base_z [m]\n0,1,2\n", ["line 1: the columns are", "once each"]),
        ("time [s],base_z [m],base_z [m]\n0,1,2\n", ["line 1: the columns are", "once each"]),
        ("time [s],time [s] ,base_z [m]\n0,1,2\n", ["line 1: the columns are", "once each"]),
        ("time [s],base_z [mm]\n0,1\n", ["line 1: the columns are time [s], base_z [mm]", "base_z [m]"]),
        ("base_z [m]\n0\n", ["line 1: the columns are base_z [m]", "allowed is time [s]"]),
        (NAMED + "0,true,2\n0.1,false,2\n", ["line 2: base_z [m] is 'true'", "a finite number"]),
        (NAMED + "0,1,2\n0.1,,2\n", ["line 3: base_z [m] is ''"]),
        (NAMED + "0,1,nan\n", ["line 2: base_ry [rad] is 'nan'"]),
        (NAMED + "0,1,2\n0,1,2\n", ["line 3: time is 0.0 s"]),
    ],
)
def test_files_of_named_controls_that_are_not_right(tmp_path, text, parts):
    path = written(tmp_path, text)
    with fails(str(path), *parts):
        controls.parse(str(path), None, DT, ROD)


@pytest.mark.parametrize("file", [True, False])
@pytest.mark.parametrize(
    ("steps", "dt", "parts"),
    [
        (0, DT, ["steps is 0", "from 1 on"]),
        (-3, DT, ["steps is -3"]),
        (True, DT, ["steps is True"]),
        (2.0, DT, ["steps is 2.0", "a whole number"]),
        (2, 0, ["dt is 0", "above 0"]),
        (2, -0.1, ["dt is -0.1"]),
        (2, np.nan, ["dt is nan"]),
        (2, np.inf, ["dt is inf"]),
    ],
)
def test_steps_that_are_not_right(tmp_path, file, steps, dt, parts):
    path = written(tmp_path, NAMED + "0,1,2\n1,1,2\n")
    with fails(*parts):
        controls.parse(str(path) if file else "base_z=ramp:1", steps, dt, ROD)


def test_a_named_step_from_the_beginning_may_be_intended():
    assert controls.parse("base_z=step:1,at=2", 40, DT, ROD)[-1, 1] == 1.0
    assert np.all(controls.parse("base_z=step:1", 10, DT, ROD)[:, 1] == 1.0)


ROBOT = kc.load_robot("delrin-tendon-robot")


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("tension_4=ramp:2", {3: 2.0 * np.array([1, 3, 5, 7]) / 7}),
        (" tension_2 = 3 ; tension_1=step:1,at=0.1", {0: [0.0, 0.0, 1.0, 1.0], 1: [3.0] * 4}),
        ("tension=5", {k: [5.0] * 4 for k in range(4)}),
        ("tension_3=sine:0.2,base=2,amplitude=1", {2: 2.0 + np.sin(np.pi * (np.arange(4) + 0.5) / 2)}),
        ("none", {}),
    ],
)
def test_tendons_have_names_too_and_the_others_are_slack(word, expected):
    found = controls.parse(word, 4, 0.05, ROBOT)
    rows = np.zeros((4, 4))
    for column, values in expected.items():
        rows[:, column] = values
    np.testing.assert_allclose(found, rows, atol=1e-12)
    np.testing.assert_array_equal(controls.parse(word, 4, 0.05, ROBOT.control_layout), found)


@pytest.mark.parametrize(
    ("robot", "word", "plain"),
    [
        (ROD, "base_z=20mm;base_ry=180 deg", "base_z=0.02;base_ry=3.141592653589793"),
        (ROD, "base_z=ramp:20 mm,base=-1cm,end=150ms", "base_z=ramp:0.02,base=-0.01,end=0.15"),
        (ROD, "base_ry=sine:400ms,amplitude=10deg,phase=0.25rev",
         "base_ry=sine:0.4,amplitude=0.17453292519943295,phase=1.5707963267948966"),
        (ROBOT, "tension_2=500 gf", "tension_2=4.905"),
        (ROBOT, "step:100gf,base=5N,at=50ms", "step:0.981,base=5,at=0.05"),
    ],
)  # fmt: skip
def test_numbers_of_signals_may_have_units(robot, word, plain):
    found = controls.parse(word, 8, DT, robot)
    np.testing.assert_allclose(found, controls.parse(plain, 8, DT, robot), rtol=1e-14)


def test_signals_of_the_paper_are_still_for_all_tendons():
    for word in ("sine:0.2,base=8", "ramp:2,tendons=4", "7,5,5,7"):
        np.testing.assert_array_equal(controls.parse(word, 4, 0.05, ROBOT), kc.controls.parse(word, 4, 0.05))


REELS = kc.load_robot("delrin-routed-tendon-robot").replace(drive="reel")


@pytest.mark.parametrize(
    ("robot", "word", "parts"),
    [
        (ROBOT, "tension_5=ramp:2", ["the control 'tension_5' is unknown", "tension_1, tension_2"]),
        (ROBOT, "tension_1=sine:0.2", ["a tension is -0.7", "allowed is 0 or more"]),
        (ROBOT, "tension=5;tension_1=3", ["tension_1 is given already"]),
        (ROBOT, "tension_1=5,tension_2=3", ["the signal '5,tension_2=3' is unknown"]),
        (ROD, "base_z=sine:1e-320", ["'base_z=sine:1e-320'", "a value is nan", "finite"]),
        (ROD, "base_z=constant:1; base_ry=ramp:1e308,base=1e308", ["'base_ry=ramp:", "a value is inf"]),
        (ROD, "base_z=sine:0", ["period is 0.0"]),
        (ROD, "base_z=3 kPa", ["value is '3 kPa'", "kPa is no unit of a number in m"]),
        (ROD, "base_z=3 furlong", ["the unit 'furlong' is not known"]),
        (ROD, "base_z=sine:1 mm", ["period is '1 mm'", "mm is no unit of a number in s"]),
        (ROD, "base_z=step:1,at=nan", ["at is 'nan'", "a number"]),
        (ROD, "base_z=ramp:1; base_x=ramp:1;base_z=constant:2",
         ["'base_z=constant:2': base_z is given already, by 'base_z=ramp:1'", "each control once"]),
        (ROD, "base_z=step:1,at=2", ["the step starts at 2 s, after the end of the run", "use 40 steps"]),
        (ROD, "base_z=ramp:1,start=2", ["ramp: start is 2.0 s", "before the last step"]),
        (ROD, "base_z=sine:0.05", ["the sine has the same value at every time step"]),
        (REELS, "reel=ramp:0.01;reel_2=constant:0", ["reel_2 is given already, by"]),
        (REELS, "reel_2=constant:0;reel=ramp:0.01", ["reel_2 is given already, by"]),
    ],
)  # fmt: skip
def test_named_signals_that_are_not_right(robot, word, parts):
    with fails(*parts):
        controls.parse(word, 4, DT, robot)


@pytest.mark.parametrize(
    ("robot", "text", "expected"),
    [
        ("delrin-tendon-robot", "7 N, 500 gf, 5, 7", [7.0, 4.905, 5.0, 7.0]),
        ("three-chamber-arm", "constant:30 kPa, 0, 0.1bar", [3e4, 0.0, 1e4]),
        ("three-tube-robot", "180deg,-2 mm,0,0,0.25rev,0", [np.pi, -0.002, 0.0, 0.0, np.pi / 2, 0.0]),
    ],
)
def test_constant_controls_may_have_units(robot, text, expected):
    found = controls.parse(text, 2, 0.05, kc.load_robot(robot))
    np.testing.assert_allclose(found, [expected] * 2, rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("30 kPa,5,5,7", "kPa is no unit of a number in N"),
        ("7 N,5 N", "must be 4 finite numbers"),
        ("2026.csv", "no such signal or file"),
    ],
)
def test_constant_controls_with_other_units_are_refused(text, message):
    with pytest.raises(ControlsError, match=message):
        controls.parse(text, 2, 0.05, kc.load_robot("delrin-tendon-robot"))
