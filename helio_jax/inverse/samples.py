"""Samples of the heights, whatever their method: how far rasters are thinned for them, and errors of all as one."""

import numpy as np


def thinning(shape: tuple[int, ...], max_pixels: int) -> int:
    """Compute the least power of two by which to thin rows and columns of a raster (y, x) to at most `max_pixels`."""
    stride = 1
    while (shape[0] // stride) * (shape[1] // stride) > max_pixels:
        stride *= 2
    return stride


def on_raster(fields: np.ndarray, shape: tuple[int, ...], stride: int) -> np.ndarray:
    """Resample fields [..., y, x] of every `stride`-th pixel to the full raster, by the nearest pixel."""
    row, column = (
        np.minimum(np.rint(np.arange(n) / stride).astype(int), m - 1)
        for n, m in zip(shape, fields.shape[-2:], strict=True)
    )
    return fields[..., row[:, None], column]


def add_common_mode(samples: np.ndarray, error: np.ndarray, seed: int) -> np.ndarray:
    """Add a fully correlated error with a standard-normal amplitude to samples [sample, y, x].

    Args:
        samples: of the heights [sample, y, x], um.
        error: [y, x], um.
        seed: of the amplitudes; independent errors have different ones.
    """
    amplitude = np.random.default_rng(seed).standard_normal(len(samples))
    amplitude /= np.sqrt(np.mean(amplitude**2))
    return samples + amplitude[:, None, None] * error
