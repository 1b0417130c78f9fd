"""Random numbers of the tracer: a counter-based generator and Sobol points.

Each random number is a pure function of (seed, pixel, ray, event), so results do not depend on how the work is divided
among threads or machines. Philox 4x64-10: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11; tested
word for word against NumPy's Philox (tests/physics/test_tracer.py).
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from scipy.stats import qmc

from helio_jax.kernel import kernel

N_BEAM_DIMENSIONS = 6
"""Low-discrepancy dimensions of a beam ray: pinhole 2, source angle 2, first aperture point 2."""

_M0, _M1 = np.uint64(0xD2E7470EE14C6C93), np.uint64(0xCA5A826395121157)
_W0, _W1 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBB67AE8584CAA73B)
_11 = np.uint64(11)
_TO_UNIT = 2.0**-53


@intrinsic
def _multiply_high(_context, a, b):
    """Compute the high 64 bits of the 128-bit product in one machine instruction."""

    def generate(_context, builder, _signature, arguments):
        wide = ir.IntType(128)
        x, y = (builder.zext(argument, wide) for argument in arguments)
        return builder.trunc(builder.lshr(builder.mul(x, y), ir.Constant(wide, 64)), ir.IntType(64))

    return types.uint64(a, b), generate


@kernel
def philox(key0, key1, c0, c1, c2, c3):
    """Compute four uniform numbers in [0, 1) for one key and counter (all uint64)."""
    for i in range(10):
        if i:
            key0 += _W0
            key1 += _W1
        h0, l0 = _multiply_high(_M0, c0), _M0 * c0  # type: ignore[call-arg]  # numba gives the context
        h1, l1 = _multiply_high(_M1, c2), _M1 * c2  # type: ignore[call-arg]
        c0, c1, c2, c3 = h1 ^ c1 ^ key0, l1, h0 ^ c3 ^ key1, l0
    return (
        (c0 >> _11) * _TO_UNIT,
        (c1 >> _11) * _TO_UNIT,
        (c2 >> _11) * _TO_UNIT,
        (c3 >> _11) * _TO_UNIT,
    )


def low_discrepancy_points(n_points: int, n_dimensions: int) -> np.ndarray:
    """Compute the first Sobol points in the unit cube [n_points, n_dimensions], unscrambled.

    Each pixel and replicate shifts them by its own random vector modulo 1 (Cranley-Patterson rotation, SIAM
    J. Numer. Anal. 13 (1976) 904), so estimates are unbiased.
    """
    n_bits = max(int(n_points - 1).bit_length(), 1)
    return qmc.Sobol(n_dimensions, scramble=False).random_base2(n_bits)[:n_points]
