"""The modules of the package depend on each other in one direction, without cycles."""

import ast
import graphlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import knode_cosserat

ROOT = Path(knode_cosserat.__file__).parent

#: small modules that depend on each other only; the longest prefix of a name counts
BASE = (
    "_arguments _blas _files _jax _lazy _numbers _processes _program_cache _reprs _settings _units errors "
    "rotation"
)
#: packages and modules, each depends on those before it only; the empty name is `import knode_cosserat`
ORDER = (
    *(
        "io",
        "rods",
        "controls",
        "schemes",
        "engine",
        "part_check",
        "robots",
        "trajectory",
        "solvers",
        "metrics",
    ),
    *("estimation", "recordings", "statics", "control", "learning", "loading", "figures", "native"),
    *("identification", "viewer", "diagnosis", "sweeps", "envs", "mujoco", "", "cli", "__main__"),
)
LAYERS = (BASE.split(), *([name] for name in ORDER))
#: folders of the repository beside the package
REPOSITORY = ("knode_cosserat_hardware", "studies", "benchmarks", "examples", "tools", "tests")


def name_of(file: Path) -> str:
    """Return a module's name within the package; that of the package itself is empty."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name_of(file): file for file in sorted(ROOT.rglob("*.py"))}


def statements(node: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Yield imports that can run, within functions too; not those for a type checker only."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        yield from statements(child)


def imports(name: str) -> set[str]:
    """Return the modules of the package that a module imports."""
    found = set()
    for statement in statements(ast.parse(MODULES[name].read_text(encoding="utf-8"))):
        if isinstance(statement, ast.Import):
            found |= {alias.name for alias in statement.names}
        else:
            assert statement.level == 0, f"{name} has a relative import; write whole names"
            assert statement.module is not None
            for alias in statement.names:
                whole = f"{statement.module}.{alias.name}"
                found.add(whole if inside(whole) in MODULES else statement.module)
    return {inside(each) for each in found} & MODULES.keys() - {name}


def inside(name: str) -> str:
    """Return a name within the package; a name elsewhere has no module here."""
    whole = knode_cosserat.__name__
    return "" if name == whole else name.removeprefix(f"{whole}.") if name.startswith(f"{whole}.") else "?"


GRAPH = {name: imports(name) for name in MODULES}


def layer_of(name: str) -> int:
    """Return the index of a module's layer; -1 if it has none."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        for k, prefixes in enumerate(LAYERS):
            if ".".join(parts[:count]) in prefixes:
                return k
    return -1


def test_the_graph_is_that_of_the_package() -> None:
    assert len(GRAPH) > 200
    assert {"rods.system", "solvers.initial", "trajectory"} <= GRAPH["solvers.simulate"]
    assert "schemes.history" in GRAPH["engine.core"]
    assert "recordings.health" in GRAPH["recordings.recording"]  # within a function
    assert "_jax" in GRAPH[""]


def test_no_module_imports_itself_by_way_of_others() -> None:
    try:
        graphlib.TopologicalSorter(GRAPH).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"a cycle of imports: {' <- '.join(error.args[1])}")


def test_packages_depend_in_one_direction() -> None:
    nowhere = [name for name in GRAPH if layer_of(name) < 0]
    assert not nowhere, "modules in no layer; give them one"
    upwards = [
        f"{name} imports {other}"
        for name, others in GRAPH.items()
        for other in sorted(others)
        if layer_of(other) > layer_of(name)
    ]
    assert not upwards


def test_the_library_imports_no_study_and_no_benchmark() -> None:
    pattern = re.compile(rf"^\s*(?:from|import) (?:{'|'.join(REPOSITORY)})\b.*", re.MULTILINE)
    found = {name: pattern.findall(file.read_text(encoding="utf-8")) for name, file in MODULES.items()}
    assert not {name: lines for name, lines in found.items() if lines}


def test_physics_knows_no_time_scheme() -> None:
    words = re.compile(r"\bc0\b|history", re.IGNORECASE)
    found = {name: words.findall(MODULES[name].read_text()) for name in MODULES if name.startswith("rods")}
    assert not {name: each for name, each in found.items() if each}
