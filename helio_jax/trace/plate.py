"""The underside of a flat scattering plate: where atoms that come up from the sample meet it (numba).

The sample lies wholly below the plate, so a ray meets the plate only after it has missed the sample. The apertures and
the pinhole are holes: an atom there goes on as if there were no plate. Nothing is hidden by the plate: apertures seen
from the sample have nothing of it in front, and from the plate itself, in whose plane they lie, they are not seen.
"""

from typing import NamedTuple

import numpy as np

from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.trace.direct import ApertureTable, aperture_ahead
from helio_jax.trace.intersect import MISS, Hits

PLATE = np.int32(2**31 - 1)
"""`Hits.surface` of an atom on the plate."""
FACING_DOWN = np.array([0.0, 0.0, -1.0])
"""The plate's normal."""


class PlateTable(NamedTuple):
    """A scattering plate as numbers for the kernel (lab x, y; z above the sample's plane; um).

    Attributes:
        z: of the plate.
        is_disc: whether the outline is a disc, else a rectangle.
        center, half: middle and half extents of the outline [2].
        pinhole: x, y and radius of the pinhole [3].
        material: its number among the laws.
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
        """Put the plate into `hits` where rays that missed the sample meet it.

        Args:
            hits: of all rays [n]; overwritten.
            origin, direction: of the rays [n, 3], sample frame, um.
            pixel: of each ray [n].
            offset: the plate's origin in the sample frame for every pixel [pixels, 2], um.
            apertures: its holes.
        """
        _catch(self, origin, direction, pixel, offset, apertures.shapes, hits.point, hits.normal, hits.surface)


@kernel
def is_solid(plate, x, y):
    """Whether the plate point (x, y), lab frame, lies within the outline and not in the pinhole."""
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
