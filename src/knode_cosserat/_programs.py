"""Bounded memory for the compiled programs of a process.

JAX keeps every program that a process has compiled: one for each class of robot, node count, scheme and batch
size. Each object of machine code has its own memory maps, some 500 for `simulate`. Linux allows 65,530 maps a
process, and LLVM aborts the process at that limit. This module counts programs and maps after each
compilation, and releases all programs before the limit. A program that is needed again is traced again and
read from the cache on disk.

JAX has no public way to release one program, so all are released together, the user's included.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import threading
from collections.abc import Callable
from pathlib import Path

import jax

log = logging.getLogger(__name__)

#: JAX's event after each program that was compiled or read from disk
COMPILED = "/jax/core/compile/backend_compile_duration"
MAPS, MAPS_LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
#: Linux's default; where the limit is higher, the memory of the programs (60 kB a map) is the tighter bound
DEFAULT_LIMIT = 65_530
#: share of the limit at which programs are released
SHARE = 0.5
#: large programs at which all are released, for systems without memory maps and programs of few maps;
#: a robot of another shape needs two (28 MB) for `simulate`
LARGE_PROGRAMS = 128
#: compile times from this (s) belong to a large program; operations outside `jit` take 0.01 to 0.02 s
LONG = 0.05
#: most memory maps expected of a large and of a small program (measured: 1,060 for a gradient through
#: `simulate`, 470 for the time loop, 2 to 20 for operations outside `jit`)
LARGE_MAPS, SMALL_MAPS = 2_000, 40


def memory_maps() -> int:
    """Return the number of memory maps of this process, or 0 if the system does not report it."""
    try:
        return MAPS.read_bytes().count(b"\n")
    except OSError:
        return 0


def default_maps() -> int:
    """Return the memory maps at which programs are released.

    $KNODE_COSSERAT_MEMORY_MAPS, or half of the system's limit, but never more than half of Linux's default.
    """
    chosen = os.environ.get("KNODE_COSSERAT_MEMORY_MAPS", "")
    if chosen:
        if not chosen.isdecimal() or int(chosen) < 1:
            raise ValueError(f"KNODE_COSSERAT_MEMORY_MAPS must be a positive integer (got {chosen!r})")
        return int(chosen)
    try:
        limit = min(int(MAPS_LIMIT.read_text()), DEFAULT_LIMIT)
    except (OSError, ValueError):
        limit = DEFAULT_LIMIT
    return int(SHARE * limit)


class ProgramBudget:
    """Releases all compiled programs when there are too many of them, or too many memory maps.

    It listens to JAX's compile events and therefore sees every program: the package's, the user's, and those
    compiled in threads. Calls of compiled programs have no extra cost. A program that runs in another thread
    stays alive until it returns.
    """

    def __init__(self, maps: int, programs: int = LARGE_PROGRAMS, count: Callable[[], int] = memory_maps):
        """Start with a budget of memory maps, as `count` returns them, and of large programs."""
        self.releases = 0
        self._maps, self._programs, self._count = maps, programs, count
        self._threshold = maps
        #: large programs since the last release; maps at the last count, and maps that may have been added
        self._large = self._counted = self._added = 0
        self._lock = threading.Lock()

    def compiled(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        """Record a compile event, and release all programs if the budget is spent."""
        # the lock is taken while another thread releases, and by finalizers that compile during a release
        if event != COMPILED or not self._lock.acquire(blocking=False):
            return
        try:
            large = duration_secs >= LONG
            self._large += large
            self._added += LARGE_MAPS if large else SMALL_MAPS
            if self._is_spent():
                self._release()
        finally:
            self._lock.release()

    def _is_spent(self) -> bool:
        if self._large >= self._programs:
            return True
        if self._counted + self._added < self._threshold:
            return False
        # counting takes about 3 µs a map, so the file is read only when the budget may be spent
        self._counted, self._added = self._count(), 0
        return self._counted >= self._threshold

    def _release(self) -> None:
        jax.clear_caches()
        gc.collect()
        _return_memory()
        self.releases += 1
        before, self._counted = self._counted, self._count()
        self._large = self._added = 0
        # maps of other origin cannot be released: leave room, or every program would release all before it
        self._threshold = max(self._maps, self._counted + self._maps // 2)
        log.info("compiled programs released: %d memory maps before, now %d", before, self._counted)


def _return_memory() -> None:
    """Return freed memory to the system, where the C library does so on request (glibc)."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, TypeError, AttributeError):
        return
    trim(0)


def limit_programs() -> ProgramBudget:
    """Limit the compiled programs of this process."""
    budget = ProgramBudget(default_maps())
    jax.monitoring.register_event_duration_secs_listener(budget.compiled)
    return budget
