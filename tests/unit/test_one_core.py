"""On a single core, as a cluster may give it to a job."""

import os
import subprocess
import sys

import pytest

CODE = """
import os
os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[0]})
import helio_jax.forward.compiling
print(os.environ["NPROC"])
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system does not bind processes to cores")
@pytest.mark.parametrize(("stated", "used"), [(None, "2"), ("3", "3")])
def test_xla_has_two_threads(stated, used):
    """One thread more than cores, unless stated; with one, `helio run sphere_a` stood still at its first masks."""
    environment = {name: value for name, value in os.environ.items() if name != "NPROC"}
    environment |= {} if stated is None else {"NPROC": stated}
    command = [sys.executable, "-c", CODE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True, env=environment)
    assert done.stdout.strip() == used
