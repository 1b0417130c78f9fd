"""Underside of a flat scattering plate (numba).

The sample lies below the plate, so a ray can hit the plate only after it has missed the sample. Apertures and pinhole
are holes. The plate masks no aperture: seen from the sample it is not in front of them, and seen from the plate itself
they lie in its plane.
"""

from typing import NamedTuple

import numpy as np

from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.trace.direct import ApertureTable, aperture_ahead
from helio_jax.trace.intersect import MISS, Hits

PLATE = np.int32(2**31 - 1)
"""`Hits.surface` of a point on the plate."""
FACING_DOWN = np.array([0.0, 0.0, -1.0])
"""The plate's normal."""


class PlateTable(NamedTuple):
    """A flat scattering plate for the kernels (lab frame, um).

    Attributes:
        z: height above the substrate.
        is_disc: whether the outline is a disc, else a rectangle.
        center, half: centre and half extents of the outline [2].
        pinhole: x, y and radius of the pinhole [3].
        material: index among the laws.
    """

    z: float
    is_disc: bool
    center: np.ndarray
    half: np.ndarray
    pinhole: np.ndarray
    material: int

    @classmethod
    def of(cls, instrument: Instrument, material: int) -> "PlateTable":
        """Return the scattering plate of an instrument."""
        center, half = (np.array(pair) for pair in instrument.plate.outline)
        pinhole = np.array([*instrument.pinhole_center[:2], instrument.beam.pinhole_radius_um])
        return cls(instrument.sample_distance, instrument.plate.radius_um is not None, center, half, pinhole, material)

    def catch(
        self, hits: Hits, origin: np.ndarray, direction: np.ndarray, pixel: np.ndarray, offset: np.ndarray,
        apertures: ApertureTable,
    ) -> None:  # fmt: skip
        """Enter hits of the plate into `hits` for rays that missed the sample.

        Args:
            hits: of all rays with the sample [n]; updated in place.
            origin, direction: of the rays, sample frame [n, 3] [um].
            pixel: of each ray [n].
            offset: the plate's origin in the sample frame for each pixel [pixels, 2] [um].
            apertures: the holes.
        """
        _catch(self, origin, direction, pixel, offset, apertures.shapes, hits.point, hits.normal, hits.surface)


@kernel
def is_solid(plate, x, y):
    """Whether the plate point (x, y), lab frame, is within the outline and outside the pinhole."""
    p, q = (x - plate.center[0]) / plate.half[0], (y - plate.center[1]) / plate.half[1]
    is_within = p * p + q * q <= 1.0 if plate.is_disc else max(abs(p), abs(q)) <= 1.0
    dx, dy = x - plate.pinhole[0], y - plate.pinhole[1]
    return is_within and dx * dx + dy * dy > plate.pinhole[2] ** 2


@kernel
def _catch(plate, origin, direction, pixel, offset, shapes, point, normal, surface):
    for i in range(origin.shape[0]):
        if surface[i] != MISS or direction[i, 2] <= 0.0:
            continue
        x, y = offset[pixel[i], 0], offset[pixel[i], 1]
        k, r = aperture_ahead(origin, direction, i, x, y, plate.z, shapes)
        px, py = origin[i, 0] + r * direction[i, 0], origin[i, 1] + r * direction[i, 1]
        if k < 0 and is_solid(plate, px - x, py - y):
            surface[i] = PLATE
            point[i, 0], point[i, 1], point[i, 2] = px, py, plate.z
            normal[i, 0], normal[i, 1], normal[i, 2] = 0.0, 0.0, -1.0
