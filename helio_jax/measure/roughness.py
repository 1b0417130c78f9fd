"""Surface texture parameters of ISO 25178-2, height profiles and steps. Heights in, numbers in um out.

Sa, Sq, Sz, Ssk, Sku refer to the least-squares plane of the region; Sdq and Sdr to the slopes of cells of four known
pixels.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from helio_jax.arrays import pitch
from helio_jax.errors import GuardError, SceneError
from helio_jax.reconstruction import Reconstruction


@dataclass(frozen=True)
class Roughness:
    """Areal height and hybrid parameters of ISO 25178-2.

    Attributes:
        Sa: arithmetical mean height, mean of |z| [um].
        Sq: root mean square height [um].
        Sz: maximum height, highest peak plus deepest pit [um].
        Ssk: skewness, mean of z^3 over Sq^3.
        Sku: kurtosis, mean of z^4 over Sq^4.
        Sdq: root mean square gradient.
        Sdr: developed interfacial area ratio: area of the surface over its projection, minus 1 [%].
        n_pixels: number of heights.
    """

    Sa: float
    Sq: float
    Sz: float
    Ssk: float
    Sku: float
    Sdq: float
    Sdr: float
    n_pixels: int


def measure_roughness(rec: Reconstruction, region: np.ndarray | None = None) -> Roughness:
    """Measure the texture of a region of a height map, levelled by its least-squares plane.

    Args:
        rec: heights; invalid pixels are excluded.
        region: True inside [y, x]; default: all valid pixels.

    Raises:
        GuardError: fewer than 16 valid pixels.
    """
    use = rec.is_valid & np.isfinite(rec.height) & (True if region is None else region)
    if use.sum() < 16:
        raise GuardError(f"roughness needs 16 or more valid pixels, got {int(use.sum())}")
    design = np.stack([rec.x[use], rec.y[use], np.ones(use.sum())], -1)
    plane = np.linalg.lstsq(design, rec.height[use], rcond=None)[0]
    z = rec.height - plane[0] * rec.x - plane[1] * rec.y - plane[2]
    v = z[use]
    sq = float(np.sqrt(np.mean(v**2)))
    p, q = _cell_slopes(rec, z, use)
    slope = p**2 + q**2
    n = slope.size
    return Roughness(
        Sa=float(np.mean(np.abs(v))),
        Sq=sq,
        Sz=float(v.max() - v.min()),
        Ssk=float(np.mean(v**3) / sq**3) if sq > 0 else math.nan,
        Sku=float(np.mean(v**4) / sq**4) if sq > 0 else math.nan,
        Sdq=float(np.sqrt(slope.mean())) if n else math.nan,
        Sdr=float(100.0 * np.mean(np.sqrt(1.0 + slope) - 1.0)) if n else math.nan,
        n_pixels=int(use.sum()),
    )


def _cell_slopes(rec: Reconstruction, z: np.ndarray, use: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute dz/dx, dz/dy in the middle of every cell of four known pixels; normal or oblique incidence."""
    whole = use[1:, 1:] & use[1:, :-1] & use[:-1, 1:] & use[:-1, :-1]
    along = 0.5 * (z[:-1, 1:] - z[:-1, :-1] + z[1:, 1:] - z[1:, :-1])[whole] / pitch(rec.raster_x)
    up = 0.5 * (z[1:, :-1] - z[:-1, :-1] + z[1:, 1:] - z[:-1, 1:])[whole] / pitch(rec.raster_y)
    tx, ty = rec.instrument.beam_shift
    det = 1.0 - tx * along - ty * up  # beam-frame slopes to the surface's own: x = X - h tx, y = Y - h ty
    return along / det, up / det


@dataclass(frozen=True)
class Profile:
    """Heights along a straight line: distance from its start [um], height [um] (NaN: unknown), deviation [um]."""

    distance: np.ndarray
    height: np.ndarray
    height_std: np.ndarray | None


def measure_profile(rec: Reconstruction, start: tuple[float, float], end: tuple[float, float]) -> Profile:
    """Interpolate heights bilinearly between two beam positions (x, y) [um], a pitch apart.

    Raises:
        SceneError: a point outside the raster, or equal points.
    """
    for name, (x, y) in (("start", start), ("end", end)):
        if not (rec.raster_x[0] <= x <= rec.raster_x[-1] and rec.raster_y[0] <= y <= rec.raster_y[-1]):
            raise SceneError(
                f"profile {name} ({x:g}, {y:g}) um must lie on the raster, x {rec.raster_x[0]:g} to "
                f"{rec.raster_x[-1]:g}, y {rec.raster_y[0]:g} to {rec.raster_y[-1]:g} um"
            )
    length = math.dist(start, end)
    if length == 0.0:
        raise SceneError(f"profile start and end must differ, got ({start[0]:g}, {start[1]:g}) um twice")
    n = max(math.ceil(length / min(pitch(rec.raster_x), pitch(rec.raster_y))) + 1, 2)
    share = np.linspace(0.0, 1.0, n)
    x, y = start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])
    at = np.stack([(y - rec.raster_y[0]) / pitch(rec.raster_y), (x - rec.raster_x[0]) / pitch(rec.raster_x)])
    read = lambda image: ndimage.map_coordinates(image, at, order=1, mode="nearest")  # noqa: E731
    known = rec.is_valid & np.isfinite(rec.height)
    is_known = read(known.astype(float)) > 1.0 - 1e-9
    height = np.where(is_known, read(np.where(known, rec.height, 0.0)), np.nan)
    std = None if rec.height_std is None else np.where(is_known, read(np.nan_to_num(rec.height_std)), np.nan)
    return Profile(share * length, height, std)


@dataclass(frozen=True)
class Step:
    """Height of a step [um], its standard deviation, its place along the profile [um], and the common slope."""

    height: float
    height_std: float
    position: float
    slope: float


_GAP = 0.1
"""Fraction of a profile's length that is excluded around a step. After ISO 5436-1, which excludes a third."""


def measure_step(profile: Profile) -> Step:
    """Fit two parallel lines to the sides of a profile's steepest place; their distance is the step.

    Raises:
        GuardError: fewer than 4 known heights on a side.
    """
    known = np.isfinite(profile.height)
    d, z = profile.distance[known], profile.height[known]
    if d.size < 8:
        raise GuardError(f"a step needs 8 or more known heights along the profile, got {d.size}")
    best, position = -1.0, 0.0
    for i in range(3, d.size - 3):
        jump = abs(np.median(z[i : i + 4]) - np.median(z[max(i - 4, 0) : i]))
        if jump > best:
            best, position = jump, 0.5 * (d[i - 1] + d[i])
    use = np.abs(d - position) > 0.5 * _GAP * (d[-1] - d[0])
    upper = (d > position) & use
    if upper.sum() < 4 or (use & ~upper).sum() < 4:
        raise GuardError("a step needs 4 or more known heights on either side: choose a longer profile")
    design = np.stack([np.ones(use.sum()), d[use] - position, upper[use].astype(float)], -1)
    found = np.linalg.lstsq(design, z[use], rcond=None)[0]
    misfit = z[use] - design @ found
    covariance = np.linalg.inv(design.T @ design) * np.sum(misfit**2) / max(use.sum() - 3, 1)
    return Step(float(found[2]), float(np.sqrt(covariance[2, 2])), float(position), float(found[1]))
