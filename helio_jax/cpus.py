"""How many CPUs this process may use, and how much memory it has used."""

import os
import sys


def n_cpus() -> int:
    """Return the number of CPUs that this process may use, e.g. those that a batch system allocated."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_memory_gb() -> float | None:
    """Return the most memory that this process has had [GB]; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
