"""How many CPUs this process may use."""

import os


def n_cpus() -> int:
    """Return the number of CPUs that this process may use, e.g. those that a batch system allocated."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
