"""Records of the tracer: the shared state of a run (`Experiment`) and the atoms in flight (`Paths`)."""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.trace.direct import ApertureTable
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.lawtable import LawTable, diffuse_shares
from helio_jax.trace.meshplate import MeshPlate
from helio_jax.trace.plate import PLATE, PlateTable
from helio_jax.trace.source import Sampling, Source


@dataclass(frozen=True)
class Experiment:
    """State shared read-only by all blocks of a run.

    `laws` None: cosine law everywhere. `plate` None: transparent plate. `effusive`: the same experiment with the
    effusive beam as source, if there is one.
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

    @cached_property
    def leaving(self) -> np.ndarray | None:
        """Share of the atoms that leave each surface by the cosine law (`Intersector.by_surface`); empty: all.

        None where some leave by lobes.
        """
        if self.laws is None:
            return np.empty(0)
        shares = None if self.plate is not None else diffuse_shares(self.laws)
        return None if shares is None else self.intersector.by_surface(shares)

    def can_fuse(self, event: int) -> bool:
        """Whether `analog.trace_fused` applies from the scattering after `event` events on.

        True with Embree, no other laws than the cosine law, of albedos up to 1, and no scattering plate; with the
        expected estimator, also only where no re-emitted atoms are needed to estimate the masked part (`next_event`).
        """
        if self.leaving is None or self.plate is not None or not self.intersector.has_embree:
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
    """Atoms in flight.

    Attributes:
        origin, direction: of the rays [n, 3].
        pixel, path: index of the pixel in the block, number of the path in the pixel [n].
        target: two random numbers of the next aperture point [n, 2].
        skip: sphere that the ray starts from, or -1 [n].
        density: of the lobes in this direction (`laws.scatter_atoms`) [n].
        normal: of the sample at the start; zero for pinhole or plate [n, 3].
        order: number of scatterings on the sample [n].
        met_plate: whether the plate has scattered the atom [n].
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
