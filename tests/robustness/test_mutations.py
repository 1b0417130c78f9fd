"""Damaged files of every kind end in our errors (mutations.py)."""

import sys

import pytest
from mutations import try_mutations

N = 2000


@pytest.mark.skipif(sys.platform != "linux", reason="memory limits and /proc")
def test_mutated_files_are_refused(tmp_path):
    """Untyped errors, crashes, hangs of more than 5 s and more than 1 GiB: 0 of 2000, seeds fixed.

    Catches a reader whose own exceptions reach the user, and numbers of a file that are trusted as sizes. Both verdicts
    must occur often: mutations that break every file, or none, would test nothing.
    """
    found = try_mutations(tmp_path, N)
    assert found.faults == []
    assert found.n_undamaged["refused"] == 1  # MATLAB 7.3
    assert found.verdicts["read"] > 0.02 * N and found.verdicts["refused"] > 0.3 * N
