"""Input that nobody means: numbers that are none, times that are none, texts that are commands, no home."""

import os
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path

import jax
import numpy as np
import pytest
import typer.testing

import knode_cosserat as kc
from knode_cosserat import view
from knode_cosserat._files.writing import ABANDONED, replacing
from knode_cosserat._files.yaml_text import MOST_CHARACTERS, YAMLTextError, mapping_of
from knode_cosserat._numbers import real_array
from knode_cosserat.cli import app
from knode_cosserat.cli.output import printable
from tools.attack import attacked, good_files

ROBOT = kc.load_robot("delrin-tendon-robot")
TENSIONS = np.full((3, 4), 5.0)


# numbers


@pytest.mark.parametrize(
    ("values", "why"),
    [
        (TENSIONS > 1.0, "they are true or false"),
        (TENSIONS.astype(str), "they are text"),
        (TENSIONS + 1j, "they are complex"),
        (TENSIONS.astype("datetime64[s]"), "they are dates"),
        (np.ma.masked_greater(np.arange(12.0).reshape(3, 4), 9.0), "2 of them are masked"),
        ([[5.0, "5", 5.0, None]], "one of them is '5'"),
    ],
)
def test_what_is_no_number_is_not_taken_as_one(values, why):
    with pytest.raises(ValueError, match="controls are not numbers"):
        kc.simulate(ROBOT, values, 0.05)
    with pytest.raises((ValueError, TypeError), match=why):
        real_array(values)


def test_a_masked_array_without_masked_values_is_an_array():
    assert np.array_equal(real_array(np.ma.array(TENSIONS)), TENSIONS)


@pytest.mark.parametrize("dt", [5e-324, 10**400, -1.0, 0, np.nan, True, "0.05", 1e9])
def test_time_steps_that_are_none(dt):
    with pytest.raises(ValueError, match=r"^dt is .*; allowed is a (positive )?number"):
        kc.simulate(ROBOT, TENSIONS, dt)


@pytest.mark.parametrize("dt", ["5e-324", "1" + "0" * 400, "nan", "-1"])
def test_the_command_says_it_in_one_line(dt):
    words = ["simulate", "delrin-tendon-robot", "--tension", "5,5,5,5", "--steps", "3", "--dt", dt]
    found = typer.testing.CliRunner().invoke(app, words)
    assert found.exit_code == 2 and found.stderr.startswith("error: ") and found.stderr.count("\n") == 1


# texts


def test_aliases_that_repeat_each_other_are_counted_before_they_are_written_out():
    bomb = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
        f"{later}: &{later} [{', '.join(['*' + earlier] * 9)}]\n"
        for earlier, later in zip("abcdefghijk", "bcdefghijkl", strict=True)
    )
    with pytest.raises(YAMLTextError, match=r"with its aliases it has .* values; allowed are 200000"):
        mapping_of(bomb, "a")
    with pytest.raises(YAMLTextError, match="with its aliases it has inf values"):
        mapping_of("a: &a [*a]\n", "a")
    with pytest.raises(YAMLTextError, match=f"allowed are {MOST_CHARACTERS}"):
        mapping_of("a: " + "x" * MOST_CHARACTERS, "a")
    assert mapping_of("a: &a {b: 1}\nc: *a\n", "a") == {"a": {"b": 1}, "c": {"b": 1}}


def test_a_terminals_commands_are_printed_as_text():
    assert printable("tip\x1b[2J\x07 ²\tx") == "tip\\x1b[2J\\x07 ²\tx"
    words = ["info", "no\x1b[31mrobot.yaml"]
    found = typer.testing.CliRunner().invoke(app, words)
    assert found.exit_code == 2 and "\x1b" not in found.stderr


# files


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    pytest.importorskip("pyarrow")
    return folder, good_files(folder)


def test_a_file_keeps_its_permissions_and_what_killed_writes_left_is_removed(tmp_path):
    path = tmp_path / "it.txt"
    path.write_text("old")
    path.chmod(0o600)
    old, young, other = (
        tmp_path / f".{name}.tmp" for name in ("it.txt.0123456789ab", "it.txt.ba9876543210", "mine.txt.x")
    )
    for each in (old, young, other):
        each.write_text("half")
    before = old.stat().st_mtime - ABANDONED - 10.0
    os.utime(old, (before, before))
    os.utime(other, (before, before))
    with replacing(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o600
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted([young.name, other.name, "it.txt"])


def test_a_figure_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    figure = kc.figures.path({"a": np.eye(2)})
    path = tmp_path / "it.png"
    figure.savefig(path)
    before = path.read_bytes()

    def full(self, content):
        with self.open("wb") as file:
            file.write(content[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        figure.savefig(path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "trajectory.nc",
        "robot.yaml",
        "recording.yaml",
        "controls.csv",
        "table.csv",
        "bag.bag",
        "bag.mcap",
        "bag.db3",
    ],
)
def test_damaged_files_are_read_or_refused_in_one_line(name, good):
    folder, readers = good
    found = attacked(name, readers[name], folder, 60, seed=3)
    assert not found.failures and found.read + found.refused == 60 and found.refused > 5


# processes


def test_a_user_without_a_home_can_import_it():
    """As in a container that runs under a number without an entry in the user database."""
    script = """
import os, pwd
os.environ.pop("HOME", None)
def unknown(number):
    raise KeyError(number)
pwd.getpwuid = unknown
import knode_cosserat
print(knode_cosserat._jax.cache_directory())
"""
    kept = {k: v for k, v in os.environ.items() if k not in ("KNODE_COSSERAT_CACHE", "XDG_CACHE_HOME")}
    done = subprocess.run([sys.executable, "-c", script], env=kept, capture_output=True, text=True)
    assert done.stdout.strip() == "None", done.stderr


def test_the_page_is_for_those_who_call_it_by_its_name():
    moved = kc.simulate(ROBOT, TENSIONS, 0.05)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    opened = threading.Event()
    thread = threading.Thread(
        target=view, args=(moved,), kwargs={"port": port, "open_browser": lambda _: opened.set()}, daemon=True
    )
    thread.start()
    assert opened.wait(30.0)

    def status(host):
        request = urllib.request.Request(f"http://127.0.0.1:{port}/", headers={"Host": host})
        try:
            with urllib.request.urlopen(request, timeout=10.0) as answer:
                return answer.status
        except urllib.error.HTTPError as error:
            return error.code

    assert [status(f"127.0.0.1:{port}"), status(f"localhost:{port}")] == [200, 200]
    assert status("evil.example") == 421
    with socket.create_connection(("127.0.0.1", port)) as raw:
        raw.sendall(f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\nHost: evil.example\r\n\r\n".encode())
        assert b" 421 " in raw.recv(100)


# equations


def test_a_rod_that_is_stiff_in_one_direction_bends_in_the_other():
    """The natural units are those of one axis; a small residual in them is no solution by itself."""
    stiff = [
        kc.equilibrium(ROBOT.replace(bending_stiffness=order), [8.0, 5.0, 5.0, 5.0])
        for order in ([5e5, 5e-3, 4e-3], [5e-3, 5e5, 4e-3])
    ]
    one, other = (np.asarray(each.tip_position[0]) for each in stiff)
    assert np.linalg.norm(one[:2]) > 0.3
    np.testing.assert_allclose(one, other[[1, 0, 2]], rtol=0, atol=1e-6)


def test_rows_of_an_undamped_rod_do_not_depend_on_how_many_follow():
    undamped = ROBOT.replace(bending_damping=0.0)
    control = np.tile([8.0, 5.0, 5.0, 5.0], (12, 1))
    whole = kc.simulate(undamped, control, 1e-3)
    for count in (2, 3, 7):
        part = kc.simulate(undamped, control[:count], 1e-3)
        np.testing.assert_allclose(part.tip_position, whole.tip_position[: count + 1], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_rows_of_an_undamped_rod_are_the_same_under_jit_and_step_by_step():
    undamped = ROBOT.replace(bending_damping=0.0)
    control = np.tile([8.0, 5.0, 5.0, 5.0], (12, 1))
    whole = kc.simulate(undamped, control, 1e-3)

    def tip_and_result(control):
        found = kc.simulate(undamped, control, 1e-3)
        return found.tip_position, found.result

    tip, result = jax.jit(tip_and_result)(control)
    np.testing.assert_allclose(tip, whole.tip_position, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(result, whole.result)
    stepper = kc.solvers.Stepper(undamped, 1e-3)
    steps = [stepper.step(each).tip_position[0] for each in control]
    np.testing.assert_allclose(steps, whole.tip_position[1:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
def test_output_that_a_terminal_cannot_show_is_escaped(encoding):
    done = subprocess.run(
        [sys.executable, "-m", "knode_cosserat.cli", "info", "delrin-tendon-robot"],
        env={**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"},
        capture_output=True,
    )
    assert done.returncode == 0 and done.stderr == b""
    assert b"tension_4" in done.stdout.decode(encoding).encode(encoding)
