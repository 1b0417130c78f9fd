"""Extrapolation of waves: a few plane waves, fitted to an image's heights and evaluated beyond it.

A wave that leaves the image goes on with its own length and height, however few of its periods the image shows. A
prediction from the autocorrelation (`border.predict_border`) lets it fade within an image's width: of a wave of one
and a half periods a third was left, and of the multiple scattering in its hollows an eighth was missing.
"""

import math

import numpy as np

MAX_WAVES = 4
"""Waves are added one by one up to this number."""
LEFT = 1e-3
"""No wave is added where less than this share of the heights' variance is left."""
_MIN_PERIODS = 0.6
"""Periods of the longest wave in the image: of less, only the slope is seen."""
_OVERSAMPLING = 4
"""Of the spectrum in which the strongest wave is looked for."""
_STEPS = 20
"""Largest number of Gauss-Newton steps."""
_MAX_STEP, _AT_REST = 0.3, 1e-4
"""Largest step of a wave vector, and the step at which it rests [periods in the image]."""


def continue_waves(z: np.ndarray, pixels: int) -> np.ndarray:
    """Continue heights by the plane waves that describe them best [y + 2 pixels, x + 2 pixels].

    Heights beyond the border stay within the range of those inside.

    Args:
        z: heights [y, x], um.
        pixels: to be added on every side.

    Source: strongest wave first, from the residual's spectrum: Hogbom, Astron. Astrophys. Suppl. 15 (1974) 417;
        amplitudes eliminated from the fit of the wave vectors: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413.
    """
    rows, columns = (np.arange(n) - 0.5 * (n - 1) for n in z.shape)
    x, y = (grid.ravel() for grid in np.meshgrid(columns, rows))
    waves, rest, variance = np.zeros((0, 2)), z - np.mean(z), float(np.var(z))
    amplitudes = np.array([np.mean(z)])
    while len(waves) < MAX_WAVES and np.var(rest) > LEFT * variance:
        waves = _fitted(np.vstack([waves, _strongest(rest)]), x, y, z.ravel())
        basis = _basis(waves, x, y)
        amplitudes = np.linalg.lstsq(basis, z.ravel(), rcond=None)[0]
        rest = z - (basis @ amplitudes).reshape(z.shape)
    ny, nx = (n + 2 * pixels for n in z.shape)
    x, y = (grid.ravel() for grid in np.meshgrid(*(np.arange(n) - 0.5 * (n - 1) for n in (nx, ny))))
    out = np.clip((_basis(waves, x, y) @ amplitudes).reshape(ny, nx), z.min(), z.max())
    out[pixels : ny - pixels, pixels : nx - pixels] = z
    return out


def _basis(waves: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Evaluate 1, cosines and sines at positions [position, 1 + 2 waves].

    Args:
        waves: wave vectors [wave, 2], cycles per pixel.
        x, y: positions [position], pixels.
    """
    phase = 2.0 * math.pi * (np.outer(x, waves[:, 0]) + np.outer(y, waves[:, 1]))
    return np.column_stack([np.ones(x.size), np.cos(phase), np.sin(phase)])


def _strongest(rest: np.ndarray) -> np.ndarray:
    """Find the wave vector [2], cycles per pixel, at the peak of a residual's power spectrum, windowed after Hann."""
    (ny, nx), size = rest.shape, [_OVERSAMPLING * n for n in rest.shape]
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in rest.shape))
    fy, fx = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])
    amplitude = np.where(np.hypot(fy * ny, fx * nx) < _MIN_PERIODS, 0.0, np.abs(np.fft.rfft2(rest * window, size)))
    row, column = np.unravel_index(np.argmax(amplitude), amplitude.shape)
    return np.array([fx[column], fy[row, 0]])


def _fitted(waves: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Fit wave vectors [wave, 2] to heights at positions [position] by least squares (Gauss-Newton)."""
    period = np.array([np.ptp(x) + 1.0, np.ptp(y) + 1.0])
    n = len(waves)
    for _ in range(_STEPS):
        basis = _basis(waves, x, y)
        amplitudes = np.linalg.lstsq(basis, z, rcond=None)[0]
        cosine, sine = amplitudes[1 : n + 1], amplitudes[n + 1 :]
        by_phase = 2.0 * math.pi * (basis[:, 1 : n + 1] * sine - basis[:, n + 1 :] * cosine)
        slopes = np.column_stack([basis, by_phase * x[:, None], by_phase * y[:, None]])
        step = np.linalg.lstsq(slopes, z - basis @ amplitudes, rcond=1e-6)[0][basis.shape[1] :].reshape(2, n).T
        waves = waves + np.clip(step, -_MAX_STEP / period, _MAX_STEP / period)
        if np.all(np.abs(step) < _AT_REST / period):
            break
    return waves
