"""JAX's persistent compilation cache for the command line.

XLA's compilation takes a third of the time of a small fit. Compiled code is specific to a kind of processor, so each
kind has its own folder. JAX's variables JAX_COMPILATION_CACHE_DIR, JAX_COMPILATION_CACHE_MAX_SIZE (bytes) and
JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS have precedence; an empty folder name disables the cache.
"""

import hashlib
import os
import platform
from pathlib import Path

from platformdirs import user_cache_path

_FOLDER = "JAX_COMPILATION_CACHE_DIR"
_MAX_BYTES = 500_000_000
_LEAST_SECONDS = 0.2
"""Code that compiles in less time is not cached."""


def keep_compiled() -> Path | None:
    """Set JAX's cache folder, before JAX is imported, and return it.

    Returns None if the user has set a folder, or if the user's cache folder is not writable.
    """
    if _FOLDER in os.environ:
        return None
    folder = user_cache_path("helio_jax") / "jax" / _processor()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):
        return None
    os.environ[_FOLDER] = str(folder)
    os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(_MAX_BYTES))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(_LEAST_SECONDS))
    return folder


def _processor() -> str:
    """Return a name for the architecture and instruction set of this processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        able = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        able = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(able.encode()).hexdigest()[:12]}"
