"""Beam: start points and directions of the atoms of each pixel (numba), and their random numbers.

Source models: `uniform` within a cone (theta = theta_max sqrt(u)), `gaussian` (theta = sigma sqrt(-2 ln(1 - u)))
and `pencil` (parallel) about the beam axis; `effusive` (cos(theta) = (1 - u)^(1/(n + 1)), which is cos^n per steradian)
about the plate normal; all from a disc-shaped pinhole in the plate's plane. `rays` draws from a list by weight.
"""

from dataclasses import dataclass

import numpy as np

from helio_jax.detector import axis_frame
from helio_jax.errors import SceneError
from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.trace.random import N_BEAM_DIMENSIONS, low_discrepancy_points, philox

PILOT = 1 << 62
"""Offset of the pixel numbers, which key the random numbers, for a pilot run: its numbers are others than the run's."""
_MODELS = {"pencil": 0, "uniform": 1, "gaussian": 2, "effusive": 3, "rays": 4}
_SHIFT_STREAM, _RAY_STREAM, _BOUNCE_STREAM, _BRANCH_STREAM = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)


@dataclass(frozen=True)
class Sampling:
    """Numbers of rays and point sets of a pixel.

    Attributes:
        n_rays: beam rays per pixel.
        n_branches: paths re-emitted at the first scattering point of each beam ray.
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

    @property
    def per_replicate(self) -> int:
        """Paths per replicate; 0: the rays are independent."""
        return self.n_rays * self.n_branches // self.n_replicates if self.n_replicates else 0

    @classmethod
    def make(cls, n_rays: int, n_branches: int, n_replicates: int, seed: int) -> "Sampling":
        """Prepare the point sets; `n_rays` must be a multiple of `n_replicates`."""
        if n_replicates and n_rays % n_replicates:
            raise ValueError(f"n_rays must be a multiple of {n_replicates}, got {n_rays}")
        n = n_rays // n_replicates if n_replicates else 1
        points = low_discrepancy_points(n, N_BEAM_DIMENSIONS)
        return cls(n_rays, n_branches, n_replicates, seed, points, low_discrepancy_points(n * n_branches, 2))


@dataclass(frozen=True)
class Source:
    """Distribution of atoms in the plate's plane.

    Attributes:
        model: number in `_MODELS`.
        size: angular size [rad], or exponent of an effusive beam.
        frame: axes of the directions, the last one along the source's axis [3, 3].
        radius: of the pinhole [um].
        rays: position [um], unit direction and normalised cumulative weight of given rays [n, 7].
    """

    model: int
    size: float
    frame: np.ndarray
    radius: float
    rays: np.ndarray

    @classmethod
    def beam(cls, instrument: Instrument, rays: np.ndarray | None = None) -> "Source":
        """Make the source of an instrument's beam.

        Args:
            instrument: with the beam.
            rays: position [um], unit direction and weight of the rays of a beam of kind "rays" [n, 7].

        Raises:
            SceneError: `rays` is missing.
        """
        beam = instrument.beam
        if beam.source == "rays" and rays is None:
            raise SceneError(f"beam.file: the rays of {beam.file} are not loaded: trace from the scene file")
        given = np.zeros((0, 7)) if rays is None else np.column_stack([rays[:, :6], np.cumsum(rays[:, 6])])
        given[:, 6] /= given[-1, 6] if len(given) else 1.0
        size, frame = beam.source_size_mrad * 1e-3, axis_frame(instrument.beam_direction)
        return cls(_MODELS[beam.source], size, frame, beam.pinhole_radius_um, given)

    @classmethod
    def effusive(cls, instrument: Instrument, exponent: float) -> "Source":
        """Make the source of an instrument's effusive beam."""
        frame = axis_frame(np.array([0.0, 0.0, -1.0]))
        return cls(_MODELS["effusive"], exponent, frame, instrument.beam.pinhole_radius_um, np.zeros((0, 7)))


@kernel
def beam_numbers(pixels, n_rays, n_replicates, points, seed):
    """Compute the random numbers of all beam rays [pixels * rays, 6], rays of a pixel together.

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


@kernel
def bounce_number(seed, pixel_id, path, event):
    """Compute four random numbers of one path of a pixel for the scattering after `event` events."""
    key, zero = np.uint64(seed), np.uint64(0)
    return philox(key, _BOUNCE_STREAM, np.uint64(pixel_id), np.uint64(path), np.uint64(event), zero)


@kernel
def first_bounce_shift(seed, pixel_id, replicate):
    """Compute four random shifts of one replicate of a pixel: of its first bounces 2, of their aperture points 2."""
    zero = np.uint64(0)
    return philox(np.uint64(seed), _BRANCH_STREAM, np.uint64(pixel_id), np.uint64(replicate), zero, zero)


@kernel
def shifted(a, b, points, i):
    """Return point number `i` of `points` [n, 2], shifted by (a, b) modulo 1."""
    a, b = a + points[i, 0], b + points[i, 1]
    return a - 1.0 if a >= 1.0 else a, b - 1.0 if b >= 1.0 else b


@kernel
def bounce_numbers(pixel_ids, path, per_replicate, bounces, event, seed):
    """Compute two random numbers per path for the scattering after `event` events, and two for the aperture [n, 4].

    `path` counts the paths of a pixel (beam ray times branch). The first scattering (event 0) is low-discrepancy if
    `per_replicate` (`Sampling.per_replicate`) is > 0.
    """
    out = np.empty((path.size, 4))
    for i in range(path.size):
        a, b, c, d = bounce_number(seed, pixel_ids[i], path[i], event)
        if event == 0 and per_replicate > 0:
            a, b, _, _ = first_bounce_shift(seed, pixel_ids[i], path[i] // per_replicate)
            a, b = shifted(a, b, bounces, path[i] % per_replicate)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = a, b, c, d
    return out


@kernel
def _launch(numbers, x, y, n_rays, pinhole, frame, radius, model, size, rays, origins, directions):
    for i in range(numbers.shape[0]):
        p = i // n_rays
        if model == 4:
            row = min(np.searchsorted(rays[:, 6], numbers[i, 0], side="right"), rays.shape[0] - 1)
            for a in range(3):
                origins[i, a], directions[i, a] = pinhole[a] + rays[row, a], rays[row, 3 + a]
            origins[i, 0] += x[p]
            origins[i, 1] += y[p]
            continue
        r, angle = radius * np.sqrt(numbers[i, 0]), 2.0 * np.pi * numbers[i, 1]
        origins[i, 0] = pinhole[0] + x[p] + r * np.cos(angle)
        origins[i, 1] = pinhole[1] + y[p] + r * np.sin(angle)
        origins[i, 2] = pinhole[2]
        if model == 0:
            theta = 0.0
        elif model == 1:
            theta = size * np.sqrt(numbers[i, 2])
        elif model == 3:
            theta = np.arccos((1.0 - numbers[i, 2]) ** (1.0 / (size + 1.0)))
        else:
            theta = size * np.sqrt(-2.0 * np.log(1.0 - numbers[i, 2]))
        turn = 2.0 * np.pi * numbers[i, 3]
        s, c = np.sin(theta), np.cos(theta)
        for a in range(3):
            directions[i, a] = s * np.cos(turn) * frame[0, a] + s * np.sin(turn) * frame[1, a] + c * frame[2, a]


def footprint(
    instrument: Instrument, heights: np.ndarray, n_rays: int, seed: int, rays: np.ndarray | None = None
) -> np.ndarray:
    """Compute the points where the beam's rays cross planes above the substrate [height, n, 2] [um].

    Points are relative to the beam axis in that plane: along the beam's azimuth, and across.

    Args:
        instrument: with the beam.
        heights: of the planes above the substrate [height] [um]; below the plate.
        n_rays: number of rays.
        seed: of the random numbers.
        rays: of a beam of kind "rays" [n, 7].
    """
    points = Sampling.make(n_rays, 1, 1, seed).points
    numbers = beam_numbers(np.zeros(1, np.int64), n_rays, 1, points, seed)
    origin, d = launch_rays(instrument, np.zeros(1), np.zeros(1), numbers, Source.beam(instrument, rays))
    axis, azimuth = np.array(instrument.beam_shift), np.radians(instrument.beam.azimuth_deg)
    c, s = np.cos(azimuth), np.sin(azimuth)
    h = np.asarray(heights, float)[:, None, None]
    flown = origin[:, :2] + (h - origin[:, 2:]) / d[:, 2:] * d[:, :2] + h * axis
    return flown @ np.array([[c, -s], [s, c]])


def launch_rays(
    instrument: Instrument, x: np.ndarray, y: np.ndarray, numbers: np.ndarray, source: Source | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Compute origins [um] and unit directions of the rays, sample frame, both [pixels * rays, 3].

    Args:
        instrument: beam and plate.
        x, y: beam position of each pixel [pixels] [um].
        numbers: from `beam_numbers`.
        source: default: the instrument's beam.
    """
    source = source or Source.beam(instrument)
    pinhole = instrument.pinhole_center + np.array(instrument.sample_origin(0.0, 0.0))
    origins, directions = np.empty((len(numbers), 3)), np.empty((len(numbers), 3))
    x, y = (np.ascontiguousarray(a, float) for a in (x, y))
    s, n_rays = source, len(numbers) // len(x)
    _launch(numbers, x, y, n_rays, pinhole, s.frame, s.radius, s.model, s.size, s.rays, origins, directions)
    return origins, directions
