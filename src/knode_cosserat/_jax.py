"""JAX configuration of this package: double precision, cache on disk."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path

import jax

from knode_cosserat._program_cache import install


def machine_name() -> str:
    """Return a short name of the CPU model: a program compiled for one may be illegal on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        described = "".join(sorted({line for line in lines if line.startswith(("model name", "flags"))}))
    except OSError:
        described = f"{platform.machine()} {platform.processor()}"
    return hashlib.sha256(described.encode()).hexdigest()[:12]


def cache_directory() -> Path | None:
    """Return the directory of compiled programs: $KNODE_COSSERAT_CACHE, or the user's cache directory.

    None for a user without a home: a directory that others may write to is no place for machine code.
    """
    chosen, given = os.environ.get("KNODE_COSSERAT_CACHE"), os.environ.get("XDG_CACHE_HOME")
    if chosen:
        return Path(chosen) / machine_name()
    try:
        home = Path(given) if given else Path.home() / ".cache"
    except RuntimeError:  # neither $HOME nor an entry in the user database, as in some containers
        return None
    return home / "knode-cosserat" / machine_name()


def configure() -> None:
    """Configure JAX once, on import. A cache directory that the user set for JAX is not changed."""
    jax.config.update("jax_enable_x64", True)
    directory = cache_directory()
    if directory is not None and getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        install(directory)
        jax.config.update("jax_compilation_cache_dir", str(directory))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


configure()
