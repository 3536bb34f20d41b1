"""Every piece of code in README and docs: Python and commands run, and print what is said there.

The blocks of a page share their names and their folder, in order. Python after `<!-- test: long -->`, and all
of it that follows on the page, is run by `make test-all` only.
"""

import itertools
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer
import typer.testing

import knode_cosserat as kc
from examples import your_own_robot
from knode_cosserat.cli import app
from knode_cosserat.recordings.virtual import record_virtual
from studies.__main__ import app as studies

ROOT = Path(__file__).parents[1]
PAGES = {
    page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8")
    for page in (ROOT / "README.md", ROOT / "hardware" / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
}
BLOCK = re.compile(r"(<!-- test: long -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LONG = "<!-- test: long -->"
#: pages whose code takes long as a whole: recordings are made and learned from, or many programs compiled
LONG_PAGES = (
    "README.md", "docs/control.md", "docs/optimal-design.md", "docs/environments.md", "docs/estimation.md",
    "docs/gallery.md", "docs/hardware.md", "docs/kinematics.md", "docs/identification.md",
    "docs/tutorials/fit.md", "docs/tutorials/control.md", "docs/tutorials/gradients.md",
    "docs/tutorials/several-rods.md", "docs/tutorials/simulate.md", "docs/two-sections.md",
    "docs/which-function.md", "docs/your-own-robot.md",
)  # fmt: skip
#: of these, pages that CI runs too
SAMPLES = ("README.md", "docs/tutorials/fit.md", "docs/tutorials/simulate.md", "docs/which-function.md")
#: pages whose commands are cheap enough for `make test`, those that take minutes, and those whose commands
#: print what the block that follows shows
QUICK_SHELL = (
    "docs/first-ten-minutes.md", "docs/glossary.md", "docs/how-it-works.md", "docs/install.md",
    "docs/robot-file.md", "docs/robots.md", "docs/solver.md",
)  # fmt: skip
LONG_SHELL = ("docs/simulated-recordings.md",)
SHOWN = ("docs/first-ten-minutes.md",)
#: parts of commands that are not run here, and why
NOT_RUN = {
    "git clone": "needs a network",
    "pip install": "is an installation",
    "apt-get": "is an installation",
    "robot-parts": "needs an installation of build123d",
    "make demo": "makes an environment; tests/test_cli.py runs the program",
    "make bench": "measures for long",
    "knode-cosserat identify": "takes minutes; tests/identification and tests/test_real_robots.py run it",
    "--minutes": "takes minutes; tests/identification runs it",
    "fit examples/": "takes minutes; tests/test_real_robots.py runs it",
    "evaluate learned": "follows the fit above it",
    "python -m tools.budget": "make lint runs it",
    "python -m benchmarks": "measures for long, or needs installations of other simulators",
    "python -m studies": "takes minutes to hours; tests/studies runs the parts",
    "python examples/": "tests/test_examples.py and tests/test_your_own_robot.py run it",
    "roscore": "needs an installation of ROS",
    "rosbag": "needs an installation of ROS",
    "ros1": "needs an installation of ROS",
    "--live": "runs until Ctrl-C; tests/viewer runs it",
    "observations_controlled": "needs recordings of others from the network",
    "v6_": "needs recordings of others from the network",
    "pressure_arm_t": "needs recordings of others from the network",
}


def blocks(page, language):
    """Line, text and length mark of the blocks of a language."""
    text = PAGES[page]
    for found in BLOCK.finditer(text):
        if found[2] == language:
            yield text.count("\n", 0, found.start(3)) + 1, found[3], bool(found[1])


def with_code(long):
    """Pages that have Python, long or not."""
    first = {page: next(blocks(page, "python"), None) for page in PAGES}
    if long:
        return [page for page in first if first[page] and (page in LONG_PAGES or LONG in PAGES[page])]
    return [page for page in first if first[page] and not first[page][2] and page not in LONG_PAGES]


def run(page, long, printed):
    """Run a page's Python; line numbers in errors are the page's. A number after a `print` is printed."""
    names = {"__name__": "__docs__"}
    for line, code, is_long in blocks(page, "python"):
        if is_long and not long:
            break
        exec(compile("\n" * (line - 1) + code, ROOT / page, "exec"), names)  # our own documentation
        output = printed().out
        for said in re.findall(r"^ *print\(.*\)  # (.*\d.*)$", code, re.MULTILINE):
            assert said.rstrip("…") in output, f"{page}, in the block from line {line} on: {output}"
    return names


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with what pages name: the examples and the tests' results are beside it."""
    monkeypatch.chdir(tmp_path)
    # these show until somebody closes them: here it is enough that there is something to show
    monkeypatch.setattr(
        "knode_cosserat.view", lambda scene, **more: kc.viewer.export_scene(scene, "s.html", **more)
    )
    monkeypatch.setattr("knode_cosserat.viewer.view_live", lambda robot: kc.solvers.Stepper(robot, 0.05))
    monkeypatch.setattr("knode_cosserat.viewer.control_live", lambda controller, plant: plant.tip())
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    return tmp_path


def prepare(page, folder):
    """The recordings that a page has the reader make, or bring."""
    if page == "docs/estimation.md":
        record_virtual("x.bag", "sine:1.0", seconds=6.0, seed=1)
    if page in ("docs/identification.md", "docs/recordings.md"):
        signals = {
            "sine_1p0": "sine:1.0",
            "sine_3p0": "sine:3.0",
            "rand_0": "random:0",
            "sine_2p0": "sine:2.0",
        }
        for seed, (name, signal) in enumerate(signals.items()):
            record_virtual(f"{name}.bag", signal, seconds=4.0, seed=seed)
    if page == "docs/your-own-robot.md":
        (folder / "afternoon").mkdir()
        for name, signal in your_own_robot.SIGNALS.items():
            your_own_robot.record(folder / "afternoon" / f"{name}.csv", signal, 6.0)


@pytest.mark.slow
@pytest.mark.parametrize("page", with_code(long=False))
def test_its_python_runs(page, folder, capsys):
    assert run(page, False, capsys.readouterr)


@pytest.mark.campaign
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.sample] if page in SAMPLES else [])
        for page in with_code(long=True)
    ],
)
def test_its_long_python_runs(page, folder, capsys):
    prepare(page, folder)
    assert run(page, True, capsys.readouterr)


# commands


#: our programs, by what calls them
PROGRAMS = {"knode-cosserat": app, "python -m studies": studies}


def commands(text):
    """Lines of a shell that call our programs, as the program and a list of words."""
    for line in text.replace("\\\n", " ").splitlines():
        line = re.sub(r"\s+#.*", "", line.strip().removeprefix("$ "))
        for program in PROGRAMS:
            if line.startswith(f"{program} ") and "$" not in line and "--version" not in line:
                yield program, shlex.split(re.split(r"\s[>|]", line)[0].removeprefix(program))


def parsed(program, words, whole=True):
    """The command that some words name; fails on one, or an option, that does not exist."""
    command = typer.main.get_command(PROGRAMS[program])
    words = list(words)
    while hasattr(command, "get_command") and words and not words[0].startswith("-"):
        name = words.pop(0)
        command = command.get_command(None, name)
        assert command, f"there is no command {name}"
    if whole:
        command.make_context(command.name, words)
        return
    known = {
        option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)
    }
    unknown = [
        word for word in words if word.startswith("--") and word.split("=")[0] not in {*known, "--help"}
    ]
    assert not unknown, f"{command.name} has no {unknown[0]}"


COMMANDS = [
    pytest.param(program, words, id=f"{page}: {shlex.join(words)}"[:110])
    for page in PAGES
    for language in ("sh", "")
    for _, text, _ in blocks(page, language)
    for program, words in commands(text)
]


@pytest.mark.parametrize(("program", "words"), COMMANDS)
def test_a_command_parses(program, words, monkeypatch):
    monkeypatch.chdir(ROOT)
    parsed(program, words)


def test_commands_within_sentences_exist():
    found = [
        (page, program, name)
        for page, text in PAGES.items()
        for program in PROGRAMS
        for name in re.findall(rf"`{program} ([^`]+)`", BLOCK.sub("", text))
    ]
    assert {program for _, program, _ in found} == set(PROGRAMS) and len(found) > 10
    for page, program, name in found:
        words = name.replace("…", " ").replace("--version", "").split()
        try:
            parsed(program, words, whole=False)
        except AssertionError as error:
            raise AssertionError(f"{page}: {program} {name}: {error}") from None


def test_targets_and_programs_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for page, text in PAGES.items():
        for target in re.findall(r"^make ([a-z-]+)|`make ([a-z-]+)", text, re.MULTILINE):
            assert (target[0] or target[1]) in targets, f"{page}: make {target}"
        for program in re.findall(r"^(?:\$ )?python ([a-z_/]+\.py)", text, re.MULTILINE):
            assert (ROOT / program).is_file(), f"{page}: {program}"


def lasting(text):
    """What is printed, without the times that it took, rounding errors, and the order of what is as large."""
    text = re.sub(r"computed in [\d.]+ s|[\d.]+ s$", "…", text, flags=re.MULTILINE)
    return sorted(re.sub(r" *\d\.\d+e-(0[89]|[1-9]\d)", " 0", text).splitlines())


#: options whose value is written, and endings of files that are read
WRITTEN = ("--out", "--page", "--figure", "--picture", "--export", "--states", "--recording", "--plot")
READ = (".yaml", ".bag", ".csv", ".nc")


def shell(page):
    """Commands of each shell block of a page that are run, and the block that follows."""
    found = list(BLOCK.finditer(PAGES[page]))
    for block, following in itertools.zip_longest(found, found[1:]):
        if block[2] not in ("sh", "bash", "console"):
            continue
        # the lines of a loop are one command
        loop, done, rest = block[3].rpartition("\ndone\n")
        lines = (rest if done else block[3]).replace("\\\n", " ").splitlines()
        listed = [loop + done] * bool(done) + [
            re.sub(r"\s+#.*", "", line.strip().removeprefix("$ ")) for line in lines
        ]
        kept = [line for line in listed if line and not any(part in line for part in NOT_RUN)]
        if kept:
            yield kept, following[3] if following is not None and following[2] == "" else ""


def bring(page, words):
    """Make the files of the reader that a command reads: robots as the page shows them, short recordings."""
    inputs = [word for k, word in enumerate(words) if word.endswith(READ) and words[k - 1] not in WRITTEN]
    for name in inputs:
        path = Path(name)
        if path.exists() or (words[0] == "init" and name == inputs[0]):
            continue
        path.parent.mkdir(exist_ok=True)
        if name == "recording.yaml":
            recordings = [other for other in inputs if other.endswith(".csv")]
            assert invoke(app, ["inspect", recordings[0], "--out", name]).exit_code == 0
        elif name == "path.csv":
            path.write_text("t [s],x [mm],y [mm]\n0,0,0\n10,60,30\n", encoding="utf-8")
        elif name.endswith(".yaml"):
            shown = [text for _, text, _ in blocks(page, "yaml") if re.search("^kind: ", text, re.MULTILINE)]
            if shown:
                path.write_text(shown[0], encoding="utf-8")
            else:
                kc.save_robot(kc.load_robot("delrin-tendon-robot").replace(nodes=5), path)
        elif name.endswith(".nc"):
            kc.simulate(kc.load_robot("delrin-tendon-robot"), kc.controls.sine(0.5, 6, 0.05), 0.05).save(name)
        elif path.parent.name == "afternoon":
            your_own_robot.record(path, your_own_robot.SIGNALS[path.stem], 3.0)
        else:
            record_virtual(name, "sine:1.0", seconds=3.0)


def invoke(program, words):
    """The result of a command."""
    return typer.testing.CliRunner().invoke(program, words)


def shell_marks(page):
    if page in QUICK_SHELL:
        return []
    return [pytest.mark.campaign if page in LONG_SHELL else pytest.mark.slow]


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=shell_marks(page)) for page in PAGES if next(shell(page), None)],
)
def test_its_commands_run(page, folder):
    for lines, shown in shell(page):
        printed = ""
        for line in lines:
            ours = list(commands(line))
            for program, words in ours:
                bring(page, words)
                if words[0] == "init" and "--kind" not in words:  # nobody can be asked
                    words = [*words, "--kind", "tendons"]
                if words[0] == "view" and "--export" not in words:
                    words = [*words, "--export", "seen.html"]
                result = invoke(PROGRAMS[program], words)
                assert result.exit_code == 0, f"{line}: {result.output}"
                printed = result.stdout
            if not ours:
                typed = ["bash", "-ec", line]
                done = subprocess.run(typed, env=program_paths(), capture_output=True, text=True)
                assert done.returncode == 0, f"{line}: {done.stderr}"
        if shown and page in SHOWN:
            assert lasting(printed) == lasting(shown)


def program_paths():
    """The environment in which a shell finds this Python, and the modules of the repository."""
    beside = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return os.environ | {"PATH": beside, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"}


# tables of figures


def test_the_page_on_control_has_the_measured_figures():
    import json

    from benchmarks.control import RESULTS, table

    measured = table(json.loads((ROOT / RESULTS).read_text(encoding="utf-8")))
    for part in measured.split("\n\n"):
        assert part in PAGES["docs/control.md"]


def test_the_measured_figures_are_those_of_the_pages():
    import json

    from benchmarks.run import comparison, table

    found, matched = (
        json.loads((ROOT / "benchmarks" / name).read_text(encoding="utf-8"))
        for name in ("results.json", "matched.json")
    )
    assert comparison(found, matched) in PAGES["docs/performance.md"]
    assert table(found) in PAGES["docs/performance.md"]
