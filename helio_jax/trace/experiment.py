"""What a block of work is given, and what is known of the atoms in flight: the nouns of the tracer."""

from dataclasses import dataclass, fields

import numpy as np

from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.trace.direct import ApertureTable
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.lawtable import LawTable
from helio_jax.trace.meshplate import MeshPlate
from helio_jax.trace.plate import PLATE, PlateTable
from helio_jax.trace.source import Sampling, Source


@dataclass(frozen=True)
class Experiment:
    """Everything a block of work needs, shared read-only between threads.

    No `laws`: cosine everywhere. No `plate`: a transparent one. `effusive`: the same with the effusive beam, if any.
    """

    intersector: Intersector
    instrument: Instrument
    apertures: ApertureTable
    source: Source
    sampling: Sampling
    n_orders: int
    max_events: int
    is_expected: bool
    laws: LawTable | None = None
    plate: PlateTable | MeshPlate | None = None
    effusive: "Experiment | None" = None

    def is_plain(self, event: int) -> bool:
        """Whether all that is done after the scattering with `event` events before it is what `analog` does in one go.

        That is so on Embree for the cosine law and no scattering plate, and, of the expected estimator, where atoms
        that fly on need not tell what is hidden (`next_event`).
        """
        if self.laws is not None or self.plate is not None or not self.intersector.has_embree:
            return False
        gap = self.instrument.sample_distance - float(self.intersector.high[2])
        n_hits = self.sampling.n_branches if event == 0 else 1
        return not self.is_expected or n_hits * self.apertures.largest_weight(gap) <= 1.0

    def material_of(self, surface: np.ndarray) -> np.ndarray:
        """Return the number of each hit surface's law (`Hits.surface`, no misses) [n]."""
        if self.plate is None:
            return self.intersector.material_of(surface)
        out, is_sample = np.full(surface.shape, self.plate.material), surface != PLATE
        out[is_sample] = self.intersector.material_of(surface[is_sample])
        return out


@dataclass
class Paths:
    """Rays in flight: start [n, 3], direction [n, 3], pixel in block, path in pixel, sphere to skip [n].

    `target` holds the two random numbers of the next aperture point [n, 2], `density` that of the lobes in this
    direction (laws.scatter_atoms) [n], `normal` that of the sample left (zero: pinhole or plate) [n, 3], `order` how
    often the sample scattered them, `met_plate` whether the plate did [n].
    """

    origin: np.ndarray
    direction: np.ndarray
    pixel: np.ndarray
    path: np.ndarray
    target: np.ndarray
    skip: np.ndarray
    density: np.ndarray
    normal: np.ndarray
    order: np.ndarray
    met_plate: np.ndarray

    def take(self, keep: np.ndarray) -> "Paths":
        """Return some of the rays."""
        return Paths(*(getattr(self, field.name)[keep] for field in fields(self)))


@kernel
def lift_off(point, normal, surface, restart):
    """Move points on triangles off the surface; return new origins and the sphere each ray must skip."""
    origin, skip = point.copy(), np.empty(point.shape[0], np.int32)
    for i in range(point.shape[0]):
        if surface[i] >= 0:
            skip[i] = -1
            for a in range(3):
                origin[i, a] += restart * normal[i, a]
        else:
            skip[i] = -2 - surface[i]
    return origin, skip
