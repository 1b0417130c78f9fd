"""Pinhole plate from a mesh: atoms fly through its channels, scatter on its walls and are counted (numba).

The plate is fixed in the instrument's frame while the sample moves: a second `Intersector` traces rays shifted by each
pixel's offset. The plate lies at or above the plane of the pinhole and the sample below it, so an atom from below can
hit the plate only after it has missed the sample. Detectors are parts of the mesh, and ellipses at their own height,
whichever an atom hits first from either side; of two ellipses in one plane the first in the list. Analog only.
"""

import numpy as np

from helio_jax.detector import Aperture
from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.scene.body import Body
from helio_jax.trace.direct import ApertureTable
from helio_jax.trace.intersect import MISS, Hits, Intersector
from helio_jax.trace.plate import PLATE
from helio_jax.trace.tally import DETECTED, Tally


class MeshPlate:
    """Ray queries against a plate mesh; safe to share between threads.

    Args:
        body: from `scene.plates.read_plate`, plate frame [um].
        instrument: with the plate.
        material: number of the plate's material among the laws.
    """

    def __init__(self, body: Body, instrument: Instrument, material: int) -> None:
        self.z, self.material = instrument.sample_distance, material
        self._mesh = Intersector(body)
        parts = {d.part: k for k, d in reversed(list(enumerate(instrument.detector))) if d.part is not None}
        self._detector = np.array([parts.get(name, -1) for name in body.materials])
        ellipses = [
            (k, d.height_um or 0.0, *a.center, *a.semi_axes, np.cos(a.rotation), np.sin(a.rotation))
            for k, (d, a) in enumerate(zip(instrument.detector, instrument.openings(), strict=True))
            if isinstance(a, Aperture)
        ]
        self._ellipses = np.array(ellipses).reshape(-1, 8)

    @property
    def normals(self) -> np.ndarray:
        """Unit normals of the faces [m, 3]."""
        return self._mesh.normals

    def catch(
        self, hits: Hits, origin: np.ndarray, direction: np.ndarray, pixel: np.ndarray, offset: np.ndarray,
        apertures: ApertureTable,
    ) -> np.ndarray:  # fmt: skip
        """Enter hits of the plate into `hits`; return the detector that counts each ray, or -1 [n].

        Arguments as in `PlateTable.catch`; `apertures` is not used.
        """
        caught = np.full(len(origin), -1)
        todo = np.flatnonzero(((hits.surface == MISS) & (direction[:, 2] > 0.0)) | (origin[:, 2] > self.z))
        if not todo.size:
            return caught
        shift = np.column_stack([offset[pixel[todo]], np.full(todo.size, self.z)])
        start, ahead = origin[todo] - shift, direction[todo]
        found = self._mesh.nearest(start, ahead, np.full(todo.size, -1, np.int32))
        is_hit = found.surface != MISS
        counts = np.full(todo.size, -1)
        counts[is_hit] = self._detector[self._mesh.material_of(found.surface[is_hit])]
        caught[todo] = _first(start, ahead, found.point, is_hit, counts, self._ellipses)
        is_wall = is_hit & (caught[todo] < 0)
        wall = todo[is_wall]
        normal = found.normal[is_wall]
        hits.point[wall] = found.point[is_wall] + shift[is_wall] + self._mesh.restart * normal
        hits.normal[wall], hits.is_back[wall], hits.surface[wall] = normal, found.is_back[is_wall], PLATE
        return caught


@kernel
def _first(origin, direction, point, is_hit, counts, ellipses):
    """Return the detector that each ray hits first, or -1 where it hits a wall or nothing [n]."""
    out = np.empty(origin.shape[0], np.int64)
    for i in range(origin.shape[0]):
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        nearest, which = np.inf, -1
        if is_hit[i]:
            which = counts[i]
            nearest = (point[i, 0] - origin[i, 0]) * dx + (point[i, 1] - origin[i, 1]) * dy
            nearest += (point[i, 2] - origin[i, 2]) * dz
        for j in range(ellipses.shape[0]):
            t = (ellipses[j, 1] - origin[i, 2]) / dz if dz != 0.0 else -1.0
            if not 0.0 < t < nearest:
                continue
            x, y = origin[i, 0] + t * dx - ellipses[j, 2], origin[i, 1] + t * dy - ellipses[j, 3]
            c, s = ellipses[j, 6], ellipses[j, 7]
            p, q = (x * c + y * s) / ellipses[j, 4], (y * c - x * s) / ellipses[j, 5]
            if p * p + q * q <= 1.0:
                nearest, which = t, int(ellipses[j, 0])
        out[i] = which
    return out


def count_caught(tally: Tally, caught: np.ndarray, pixel: np.ndarray, order: np.ndarray, met_plate: np.ndarray) -> None:
    """Add detected atoms to the tally, given their detector, pixel, order and `met_plate` [n]."""
    n_orders = len(tally.hits)
    np.add.at(tally.hits, (np.minimum(order, n_orders) - 1, caught, pixel), 1)
    np.add.at(tally.fates[DETECTED], pixel, 1)
    np.add.at(tally.plate_hits, (caught[met_plate], pixel[met_plate]), 1)
