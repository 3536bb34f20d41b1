"""Every test runs with the annotated shapes of equations and solver checked at each call.

Not the public functions: they say themselves, in one line, what is wrong with their arguments.

Most of the time of the tests is compiling programs that run for milliseconds, so XLA is asked to spend less
on optimising machine code, and the engine uses its quick code, which computes the same bits. The long
campaigns run what users run, unless asked not to (`--quick`).
"""

import functools
import gc
import os
import sys

import pytest
from jaxtyping import install_import_hook

from tests import progress

EQUATIONS = ("rotation", "rods.loads", "rods.section")
SCHEMES = ("schemes.problem", "schemes.space", "schemes.time")

install_import_hook([f"knode_cosserat.{name}" for name in EQUATIONS + SCHEMES], "beartype.beartype")

#: quick to compile: no effort for fast machine code, and for one core each, for the tests keep all of them
#: busy; set before JAX is imported, and inherited by the programs that tests start
QUICK = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1"
)


def pytest_addoption(parser):
    parser.addoption("--quick", action="store_true", help="compile quickly rather than well")
    parser.addoption("--dearest", type=int, default=0, help="show the CPU time of so many files")
    parser.addoption("--write-costs", action="store_true", help="write the CPU time of each file")


def pytest_configure(config):
    quick = config.option.quick or "not campaign" in config.option.markexpr
    if quick:
        if "jax" in sys.modules:
            raise pytest.UsageError(
                "JAX was imported before its flags could be set, by a conftest.py or a plugin"
            )
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK}".strip()
        os.environ["KNODE_COSSERAT_CODE"] = "quick"
    progress.register(config)


def pytest_collection_finish():
    """Collect garbage less often, and share what JAX makes anew for each of thousands of small programs.

    Tracing makes many objects, and a tenth of its time was collections; what the tests' modules hold stays
    anyway, and is not looked at again. To load all operations of the compiler takes 5 ms a program.
    """
    from jax._src.interpreters import mlir  # after JAX has its flags

    mlir.make_ir_context = functools.cache(mlir.make_ir_context)
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


def pytest_sessionfinish():
    """Leave what is still there: pytest looks five times for garbage with finalizers, for seconds each."""
    gc.freeze()


def pytest_collection_modifyitems(config, items):
    if hasattr(config, "workerinput"):
        progress.sort_by_cost(items)
