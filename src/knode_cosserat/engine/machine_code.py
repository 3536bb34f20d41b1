"""Machine code of a process: quick code at once, and final code from another process; both kept on disk."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np

from knode_cosserat._jax import cache_directory
from knode_cosserat._program_cache import ProgramCache
from knode_cosserat.engine import generation

#: size of a text from which another process is started: smaller ones take less time than that
LARGE = 200_000
#: start of the names of quick code, which is kept until there is final code
QUICK = "quick-"
#: time (s) after which a process that generates final code has been killed
PATIENCE = 600.0


def stored(name: str) -> bytes | None:
    """Return what is stored on disk under a name; None if there is nothing, or no folder."""
    directory = cache_directory()
    with contextlib.suppress(OSError):
        return ProgramCache(directory).get(name) if directory else None
    return None


def store(name: str, content: bytes) -> None:
    """Store content on disk; not if the folder is full or read-only."""
    directory = cache_directory()
    with contextlib.suppress(OSError):
        if directory:
            ProgramCache(directory).put(name, content)


@functools.cache
def computer() -> str:
    """Return a description of this computer and its code generator."""
    features, version = llvm.get_host_cpu_features().flatten(), llvm.llvm_version_info
    return f"{llvm.get_default_triple()} {llvm.get_host_cpu_name()} {features} {version}"


def level_of_code() -> int:
    """Return the level of the code generator: final, unless `KNODE_COSSERAT_CODE` asks for quick code."""
    return generation.QUICK if os.environ.get("KNODE_COSSERAT_CODE") == "quick" else generation.FINAL


class MachineCode:
    """Exported functions of a module: pointers and whole numbers in, results in memory.

    Code of a large module is quick code first. Another process generates the final code meanwhile, which
    takes over between two calls; both compute the same bits, and know the same memory.
    """

    def __init__(self, name: str, kinds: Mapping[str, str], code: bytes, later: Any = None):
        """Link code that is stored under a name; the kinds of arguments are "p" and "n" (see `of`)."""
        self.name, self.kinds, self._later = name, kinds, later
        self._link(code)

    @classmethod
    def of(cls, text: str, kinds: Mapping[str, str]) -> MachineCode:
        """Return the code of a module: quick, final, or first one and then the other."""
        wanted, level = os.environ.get("KNODE_COSSERAT_CODE"), level_of_code()
        name = f"engine-{hashlib.sha256(f'{text}{computer()}{level}'.encode()).hexdigest()}"
        code, later = stored(name), None
        if code is None:
            if wanted not in ("quick", "final") and len(text) > LARGE:
                later = _generated_beside(text, name)
            code = generation.generate(text, generation.QUICK if later else level)
            store(f"{QUICK}{name}" if later else name, code)
        return cls(name, kinds, code, later)

    @classmethod
    def kept(cls, name: str, kinds: Mapping[str, str]) -> MachineCode | None:
        """Return code from disk: the final code or, while a process generates it, the quick code."""
        code, later = stored(name), None
        if code is None and (directory := cache_directory()) is not None:
            later = _Awaited(ProgramCache(directory).path(name))
            with contextlib.suppress(OSError):
                quick = ProgramCache(directory).path(f"{QUICK}{name}")
                code = stored(f"{QUICK}{name}") if time.time() - quick.stat().st_mtime < PATIENCE else None
        return None if code is None else cls(name, kinds, code, later)

    def _link(self, code: bytes) -> None:
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), generation.machine_of(generation.FINAL))
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        functions = {}
        for name, kinds in self.kinds.items():
            types = [ctypes.c_void_p if kind == "p" else ctypes.c_long for kind in kinds]
            function: Any = ctypes.CFUNCTYPE(None, *types)(engine.get_function_address(name))
            # machine code is valid while its engine lives
            function.engine, functions[name] = engine, function
        self._functions = functions

    def run(self, name: str, *operands: np.ndarray | int) -> None:
        """Run a function on arrays and whole numbers."""
        self[name](*(x.ctypes.data if isinstance(x, np.ndarray) else x for x in operands))

    def __getitem__(self, name: str) -> Any:
        """Return a function, for one call."""
        if self._later is not None and self._later.returncode is not None:
            self._later = None
            # none if the process was killed
            if (code := stored(self.name)) is not None:
                self._link(code)
        return self._functions[name]


class _Awaited:
    """The work of a process that another one has started."""

    def __init__(self, path: Path):
        self._path = path

    @property
    def returncode(self) -> int | None:
        """Zero when the work is done."""
        return 0 if self._path.exists() else None


def _generated_beside(text: str, name: str) -> Any:
    """Return a process that generates and stores the final code; None where there can be none."""
    directory, program = cache_directory(), sys.executable or ""
    if (
        directory is None
        or getattr(sys, "frozen", False)
        or "python" not in os.path.basename(program).lower()
    ):
        return None
    try:
        paths = [str(ProgramCache(directory).path(each)) for each in (name, f"{QUICK}{name}")]
        with tempfile.TemporaryFile("w+", dir=directory) as file:
            file.write(text)
            file.seek(0)
            process = subprocess.Popen(
                [program, "-P", generation.__file__, *paths],
                stdin=file,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))},
            )
        # waited for, or its entry would stay in the system's table
        threading.Thread(target=process.wait, daemon=True).start()
    except (OSError, RuntimeError):
        return None
    return process
