"""How the inner loops are compiled (numba): the one place that says so.

Division by zero gives infinity or NaN as in NumPy. Python's way, an exception, is numba's default and costs a factor
of ten where small functions are called in loops: what may raise has to count the references of every array passed to
it (an atom's search for its aperture: 120 ns with it, 21 ns without).
"""

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")
"""Decorator of a function that numba compiles: kept on disk, free of the interpreter's lock."""
