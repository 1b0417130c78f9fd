"""The beam: where the atoms of each pixel start and in which direction (numba), and their first random numbers.

Source models: `uniform` within a cone (theta = theta_max sqrt(u)), `gaussian` (theta = sigma sqrt(-2 ln(1 - u)))
and `pencil` (parallel), all from a disc-shaped pinhole in the plate plane. Directions are drawn about
the beam axis. Knows nothing of the sample.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from helio_jax.instrument import Instrument
from helio_jax.trace.random import N_BEAM_DIMENSIONS, low_discrepancy_points, philox

_MODELS = {"pencil": 0, "uniform": 1, "gaussian": 2}
_SHIFT_STREAM, _RAY_STREAM, _BOUNCE_STREAM, _BRANCH_STREAM = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)


@dataclass(frozen=True)
class Sampling:
    """How the rays of a pixel are drawn.

    Attributes:
        n_rays: beam rays per pixel.
        n_branches: paths that leave the first scattering point of every beam ray.
        n_replicates: independently shifted copies of the low-discrepancy points; 0: independent random rays.
        seed: key of the generator.
        points: low-discrepancy points of the beam ray and its first aperture point [n_rays / n_replicates, 6].
        bounces: low-discrepancy points of the first bounces [n_rays n_branches / n_replicates, 2].
    """

    n_rays: int
    n_branches: int
    n_replicates: int
    seed: int
    points: np.ndarray
    bounces: np.ndarray

    @classmethod
    def make(cls, n_rays: int, n_branches: int, n_replicates: int, seed: int) -> "Sampling":
        """Prepare the point sets; `n_rays` must be a multiple of `n_replicates`."""
        if n_replicates and n_rays % n_replicates:
            raise ValueError(f"n_rays must be a multiple of {n_replicates}, got {n_rays}")
        n = n_rays // n_replicates if n_replicates else 1
        points = low_discrepancy_points(n, N_BEAM_DIMENSIONS)
        return cls(n_rays, n_branches, n_replicates, seed, points, low_discrepancy_points(n * n_branches, 2))


@njit(cache=True, nogil=True)
def beam_numbers(pixels, n_rays, n_replicates, points, seed):
    """Return the random numbers of every beam ray [pixels * rays, 6], rays of a pixel together.

    Columns: pinhole 2, source angle 2, first aperture point 2.
    """
    out = np.empty((pixels.size * n_rays, N_BEAM_DIMENSIONS))
    key, zero, one = np.uint64(seed), np.uint64(0), np.uint64(1)
    n_points = points.shape[0] if n_replicates else 1
    for row in range(out.shape[0]):
        pixel, ray = np.uint64(pixels[row // n_rays]), row % n_rays
        if n_replicates == 0 or ray % n_points == 0:
            stream = _SHIFT_STREAM if n_replicates else _RAY_STREAM
            a, b, c, d = philox(key, stream, pixel, np.uint64(ray), zero, zero)
            e, f, _, _ = philox(key, stream, pixel, np.uint64(ray), one, zero)
            shift = (a, b, c, d, e, f)
        for j in range(N_BEAM_DIMENSIONS):
            value = shift[j] + (points[ray % n_points, j] if n_replicates else 0.0)
            out[row, j] = value - 1.0 if value >= 1.0 else value
    return out


@njit(cache=True, nogil=True)
def bounce_number(seed, pixel_id, path, event):
    """Return four random numbers of one path of a pixel for the bounce after `event`."""
    key, zero = np.uint64(seed), np.uint64(0)
    return philox(key, _BOUNCE_STREAM, np.uint64(pixel_id), np.uint64(path), np.uint64(event), zero)


@njit(cache=True, nogil=True)
def bounce_numbers(pixel_ids, path, paths_per_replicate, bounces, event, seed, is_low_discrepancy):
    """Return two random numbers per path for the bounce after `event`, and two for the next aperture point [n, 4].

    `path` counts the paths of a pixel (beam ray times branch); the first bounce (event 0) is low-discrepancy.
    """
    out = np.empty((path.size, 4))
    key, zero = np.uint64(seed), np.uint64(0)
    for i in range(path.size):
        a, b, c, d = bounce_number(seed, pixel_ids[i], path[i], event)
        if event == 0 and is_low_discrepancy:
            pixel = np.uint64(pixel_ids[i])
            replicate, point = path[i] // paths_per_replicate, path[i] % paths_per_replicate
            a, b, _, _ = philox(key, _BRANCH_STREAM, pixel, np.uint64(replicate), zero, zero)
            a, b = a + bounces[point, 0], b + bounces[point, 1]
            a, b = a - 1.0 if a >= 1.0 else a, b - 1.0 if b >= 1.0 else b
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = a, b, c, d
    return out


@njit(cache=True, nogil=True)
def _launch(numbers, x, y, n_rays, pinhole, frame, radius, model, size, origins, directions):
    for i in range(numbers.shape[0]):
        p = i // n_rays
        r, angle = radius * np.sqrt(numbers[i, 0]), 2.0 * np.pi * numbers[i, 1]
        origins[i, 0] = pinhole[0] + x[p] + r * np.cos(angle)
        origins[i, 1] = pinhole[1] + y[p] + r * np.sin(angle)
        origins[i, 2] = pinhole[2]
        if model == 0:
            theta = 0.0
        elif model == 1:
            theta = size * np.sqrt(numbers[i, 2])
        else:
            theta = size * np.sqrt(-2.0 * np.log(1.0 - numbers[i, 2]))
        turn = 2.0 * np.pi * numbers[i, 3]
        s, c = np.sin(theta), np.cos(theta)
        for a in range(3):
            directions[i, a] = s * np.cos(turn) * frame[0, a] + s * np.sin(turn) * frame[1, a] + c * frame[2, a]


def axis_frame(axis: np.ndarray) -> np.ndarray:
    """Return an orthonormal frame [3, 3] whose last row is the unit vector `axis`."""
    side = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    first = np.cross(side, axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])


def launch_rays(
    instrument: Instrument, x: np.ndarray, y: np.ndarray, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return origins [um] and unit directions of the rays, sample frame, both [pixels * rays, 3].

    Args:
        instrument: beam and plate.
        x, y: beam position of each pixel [pixels], um.
        numbers: from `beam_numbers`, rays of one pixel together.
    """
    beam = instrument.beam
    dx, dy, dz = instrument.sample_origin(0.0, 0.0)
    pinhole = instrument.pinhole_center + np.array([dx, dy, dz])
    origins, directions = np.empty((len(numbers), 3)), np.empty((len(numbers), 3))
    _launch(
        numbers,
        np.ascontiguousarray(x, float),
        np.ascontiguousarray(y, float),
        len(numbers) // len(x),
        pinhole,
        axis_frame(instrument.beam_direction),
        beam.pinhole_radius_um,
        _MODELS[beam.source],
        beam.source_size_mrad * 1e-3,
        origins,
        directions,
    )
    return origins, directions


def spot_radius(instrument: Instrument) -> float:
    """Return the radius of the beam on the reference plane, across the beam [um] (Gaussian: one sigma)."""
    beam = instrument.beam
    length = instrument.sample_distance / math.cos(math.radians(beam.incidence_deg))
    size = 0.0 if beam.source == "pencil" else beam.source_size_mrad * 1e-3
    return beam.pinhole_radius_um + length * math.tan(size)
