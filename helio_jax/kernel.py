"""The numba compiler options of all inner loops.

Division by zero gives infinity or NaN, as in NumPy. Numba's default, an exception, is up to ten times slower for small
functions in loops, because it adds reference counting of every array argument (aperture search of one atom: 120 ns
with it, 21 ns without).
"""

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")
"""Decorator: compile with numba, cache on disk, release the interpreter lock."""
