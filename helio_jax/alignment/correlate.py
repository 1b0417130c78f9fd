"""Normalised cross-correlation of two pictures of which parts are missing, for every shift at once (FFT).

Both pictures are centred and scaled over the overlap of each shift, so gain, offset and missing borders do not bias the
peak. Source: Padfield, IEEE Trans. Image Process. 21 (2012) 2706, eqs. 5-13.
"""

from typing import NamedTuple

import numpy as np
from scipy import fft


class Peaks(NamedTuple):
    """The best shift and the next best one.

    Attributes:
        shift: (rows, columns) from a point of the fixed picture to the same point of the moving one.
        height: correlation there.
        rival: highest correlation farther than `apart` pixels from it.
    """

    shift: tuple[int, int]
    height: float
    rival: float


def correlate_masked(
    fixed: np.ndarray, is_fixed: np.ndarray, moving: np.ndarray, is_moving: np.ndarray, reach: int, overlap: float = 0.3
) -> np.ndarray:
    """Correlate fixed(r) with moving(r + u) for shifts u up to `reach` pixels each way.

    Args:
        fixed, moving: pictures of one shape [y, x].
        is_fixed, is_moving: True where they are known.
        reach: largest shift per axis [pixels].
        overlap: fraction of the largest overlap below which a shift is not considered.

    Returns:
        Correlations [2 reach + 1, 2 reach + 1], index (reach, reach) being no shift; -1 where not considered.
    """
    shape = [int(fft.next_fast_len(n + reach, real=True) or n + reach) for n in fixed.shape]
    a, b = np.where(is_fixed, fixed, 0.0), np.where(is_moving, moving, 0.0)
    a, b = a - a.sum() / max(is_fixed.sum(), 1) * is_fixed, b - b.sum() / max(is_moving.sum(), 1) * is_moving
    first = [np.conj(np.asarray(fft.rfft2(v, shape))) for v in (is_fixed.astype(float), a, a * a)]
    second = [fft.rfft2(v, shape) for v in (is_moving.astype(float), b, b * b)]

    def lagged(i: int, j: int) -> np.ndarray:
        full = np.asarray(fft.irfft2(first[i] * second[j], shape))
        lags = np.arange(-reach, reach + 1)
        return full[np.ix_(lags % shape[0], lags % shape[1])]

    n = np.round(lagged(0, 0))
    safe = np.maximum(n, 1.0)
    sum_a, sum_b = lagged(1, 0), lagged(0, 1)
    spread_a = np.maximum(lagged(2, 0) - sum_a**2 / safe, 0.0)
    spread_b = np.maximum(lagged(0, 2) - sum_b**2 / safe, 0.0)
    floor = 1e-9 * np.sqrt(max(spread_a.max(), 1e-300) * max(spread_b.max(), 1e-300))
    scale = np.sqrt(spread_a * spread_b)
    ncc = (lagged(1, 1) - sum_a * sum_b / safe) / np.maximum(scale, floor)
    return np.where((n >= overlap * n.max()) & (scale > floor), np.clip(ncc, -1.0, 1.0), -1.0)


def find_peak(ncc: np.ndarray, apart: float) -> Peaks:
    """Find the highest correlation, its shift, and the highest one farther than `apart` pixels from it."""
    reach = ncc.shape[0] // 2
    row, column = np.unravel_index(np.argmax(ncc), ncc.shape)
    rows, columns = np.indices(ncc.shape)
    is_far = np.hypot(rows - row, columns - column) > apart
    rival = float(ncc[is_far].max()) if is_far.any() else -1.0
    return Peaks((int(row) - reach, int(column) - reach), float(ncc[row, column]), rival)
