"""Samples of the heights, whatever their method: how far rasters are thinned for them, and errors of all as one."""

from collections.abc import Sequence

import numpy as np

from helio_jax.errors import SceneError

LEAST_SAMPLES = 2
"""Standard deviations of fewer samples mean nothing."""


def check_samples(n_samples: int) -> None:
    """Refuse too few samples for standard deviations.

    Raises:
        SceneError: fewer than `LEAST_SAMPLES`.
    """
    if n_samples < LEAST_SAMPLES:
        raise SceneError(f"n_samples is {n_samples}: standard deviations need {LEAST_SAMPLES} samples at least")


def thinning(shape: tuple[int, ...], max_pixels: int) -> int:
    """Compute the least power of two by which to thin rows and columns of a raster (y, x) to at most `max_pixels`."""
    stride = 1
    while (shape[0] // stride) * (shape[1] // stride) > max_pixels:
        stride *= 2
    return stride


def nearest_kept(n: int, stride: int) -> np.ndarray:
    """Return the nearest of every `stride`-th pixel, for each of `n` pixels in a row."""
    return np.minimum(np.rint(np.arange(n) / stride).astype(int), -(-n // stride) - 1)


def on_raster(fields: np.ndarray, shape: tuple[int, ...], stride: int) -> np.ndarray:
    """Resample fields [..., y, x] of every `stride`-th pixel to the full raster, by the nearest pixel."""
    row, column = (nearest_kept(n, stride) for n in shape)
    return fields[..., row[:, None], column]


def add_common_modes(samples: np.ndarray, errors: Sequence[np.ndarray], seed: int) -> np.ndarray:
    """Add fully correlated errors, each with a standard-normal amplitude, to samples [sample, y, x].

    The amplitudes have mean square 1 and, where there are as many samples as errors, no correlation: however few the
    samples, errors that are alike neither cancel nor add up by chance.

    Args:
        samples: of the heights [sample, y, x], um.
        errors: independent of one another, each [y, x], um.
        seed: of the amplitudes; independent errors of two calls need different ones.
    """
    drawn = np.random.default_rng(seed).standard_normal((len(errors), len(samples)))
    if len(samples) >= len(errors):
        orthogonal, triangle = np.linalg.qr(drawn.T)
        drawn = (orthogonal * np.sign(np.diag(triangle))).T
    drawn *= np.sqrt(len(samples)) / np.linalg.norm(drawn, axis=1, keepdims=True)
    return samples + np.einsum("es,eyx->syx", drawn, np.array(errors))
