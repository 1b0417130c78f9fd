"""What JAX compiles, kept between runs of the command line: a second fit of an instrument and raster starts at once.

A third of the time of a small fit is XLA's compilation. Compiled code is of one kind of processor, so each has a folder
of its own. JAX's variables JAX_COMPILATION_CACHE_DIR, JAX_COMPILATION_CACHE_MAX_SIZE (bytes) and
JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS win; an empty folder name keeps nothing.
"""

import hashlib
import os
import platform
from pathlib import Path

from platformdirs import user_cache_path

_FOLDER = "JAX_COMPILATION_CACHE_DIR"
_MAX_BYTES = 500_000_000
_LEAST_SECONDS = 0.2
"""What compiles in less is not kept."""


def keep_compiled() -> Path | None:
    """Tell JAX, before it is imported, where to keep what it compiles; return that folder, or None.

    None where the user has named a folder himself, or where the user's folder for caches cannot be written to.
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
    """Return a name for this kind of processor and what it can do."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        able = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        able = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(able.encode()).hexdigest()[:12]}"
