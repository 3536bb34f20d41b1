"""Every piece of code in README and docs: Python runs, commands parse, and they print what is said there.

The blocks of a page share their names, in order. A block after `<!-- test: long -->`, and all that follows it
on its page, are run by `make test-all` only.
"""

import re
import shlex
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
#: pages whose commands are cheap enough to be run, and checked by what the page says they print
RUN = ("docs/first-ten-minutes.md",)


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


@pytest.mark.parametrize("page", RUN)
def test_commands_print_what_the_page_shows(page, folder):
    shell = [(found[2], found[3]) for found in BLOCK.finditer(PAGES[page])]
    for k, (language, text) in enumerate(shell):
        if language != "sh":
            continue
        printed = ""
        for program, words in commands(text):
            result = typer.testing.CliRunner().invoke(PROGRAMS[program], words)
            assert result.exit_code == 0, result.output
            printed = result.stdout
        if k + 1 < len(shell) and shell[k + 1][0] == "":
            assert lasting(printed) == lasting(shell[k + 1][1])


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
