"""Trace pixels in blocks on threads.

A block is a pure function of the experiment and its pixels, and blocks are joined in order, so the result is bit for
bit the same for any number of threads. `scan` traces whole scans.
"""

from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from helio_jax.cpus import n_cpus
from helio_jax.errors import GuardError, SceneError
from helio_jax.instrument import Effusive, Instrument, Plate
from helio_jax.scene.body import COSINE, Body
from helio_jax.scene.scattering import COSINE_LAW, Term
from helio_jax.trace.direct import ApertureTable
from helio_jax.trace.experiment import Experiment
from helio_jax.trace.intersect import Hits, Intersector
from helio_jax.trace.lawtable import LawTable, check_lattices, is_cosine, make_law_table
from helio_jax.trace.meshplate import MeshPlate
from helio_jax.trace.plate import FACING_DOWN, PlateTable
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.source import Sampling, Source
from helio_jax.trace.tally import LOST, Estimate
from helio_jax.trace.transport import trace_block

RAYS_PER_BLOCK = 65536
"""Rays per block: Embree is fastest with about 64k neighbouring rays."""
N_REPLICATES = 8
"""Independent shifts of the low-discrepancy points; their spread gives the standard error."""
MAX_LOST = 1e-4
"""Limit of the share of lost rays."""

T = TypeVar("T")
Progress = Callable[[int, int], None]
"""Called with (pixels done, pixels in total)."""


def paths_of(settings: TraceSettings) -> tuple[int, int]:
    """Return beam rays per pixel (`expected`: rounded up to a multiple of `N_REPLICATES`) and paths per ray."""
    if settings.estimator == "analog":
        return settings.rays, 1
    return -(-settings.rays // N_REPLICATES) * N_REPLICATES, settings.branches


def make_experiment(
    body: Body | Intersector,
    instrument: Instrument,
    settings: TraceSettings,
    laws: Mapping[str, tuple[Term, ...]] | None = None,
    rays: np.ndarray | None = None,
    plate: Body | None = None,
) -> Experiment:
    """Prepare the shared state of a run.

    Args:
        body: the sample.
        instrument: beam, plate and detectors.
        settings: rays, estimator, seed.
        laws: scattering laws of the materials of body and plate; "cosine" is known.
        rays: position [um], direction and weight of the rays of a beam of kind "rays" [n, 7].
        plate: mesh of a plate of kind "mesh", plate frame.

    Raises:
        SceneError: a law, the beam's rays or the plate's mesh are missing; a lattice plane is nearly perpendicular to
            a face; or the expected estimator with a mesh plate.
    """
    intersector = body if isinstance(body, Intersector) else Intersector(body)
    solid = _plate_of(instrument, settings, plate, len(intersector.materials))
    experiment = Experiment(
        intersector=intersector,
        instrument=instrument,
        apertures=ApertureTable(instrument),
        source=Source.beam(instrument, rays),
        sampling=_sampling(settings, settings.seed),
        n_orders=settings.n_orders,
        max_events=settings.max_events,
        is_expected=settings.estimator == "expected",
        laws=_law_table(intersector, instrument.plate, solid, {COSINE: COSINE_LAW} | dict(laws or {})),
        plate=solid,
    )
    if (effusive := instrument.beam.effusive) is None:
        return experiment
    source = Source.effusive(instrument, effusive.exponent)
    sampling = _sampling(
        effusive_settings(settings, effusive), settings.seed - 2**63
    )  # differs from all seeds of beams, which are >= 0
    return replace(experiment, effusive=replace(experiment, source=source, sampling=sampling))


def effusive_settings(settings: TraceSettings, effusive: Effusive) -> TraceSettings:
    """Return the settings of the effusive beam: those of the beam with its own number of rays."""
    return settings.model_copy(update={"rays": effusive.rays})


def _sampling(settings: TraceSettings, seed: int) -> Sampling:
    return Sampling.make(*paths_of(settings), N_REPLICATES if settings.estimator == "expected" else 0, seed)


def _plate_of(
    instrument: Instrument, settings: TraceSettings, body: Body | None, material: int
) -> PlateTable | MeshPlate | None:
    """Return the scattering plate, if any; `material` is its index among the laws."""
    if not instrument.plate.is_scattering:
        return None
    if not instrument.plate.is_mesh:
        return PlateTable.of(instrument, material)
    if settings.estimator != "analog":
        raise SceneError(
            f"trace.estimator = {settings.estimator!r}: a plate of kind 'mesh' needs trace.estimator = 'analog'"
        )
    if body is None:
        raise SceneError(f"plate.file: the mesh {instrument.plate.file} is not loaded: trace from the scene file")
    return MeshPlate(body, instrument, material)


def _law_table(
    intersector: Intersector, plate: Plate, solid: PlateTable | MeshPlate | None, laws: Mapping[str, tuple[Term, ...]]
) -> LawTable | None:
    """Return the laws of the body's materials, then of a scattering plate; None if all are the cosine law."""
    names = (*intersector.materials, *((plate.material or COSINE,) if plate.is_scattering else ()))
    if missing := [name for name in names if name not in laws]:
        raise SceneError(f"material {missing[0]!r} has no law: add the table [material.{missing[0]}] to the scene")
    found = [laws[name] for name in names]
    if all(map(is_cosine, found)):
        return None
    above = solid.normals if isinstance(solid, MeshPlate) else FACING_DOWN[None]
    faces = intersector.material_of(np.arange(len(intersector.normals)))
    faces = np.append(faces, np.full(len(above), len(intersector.materials)))
    check_lattices(found, names, np.vstack([intersector.normals, above]), faces)
    return make_law_table(found)


def in_order(workers: int, tasks: Iterable[Callable[[], T]]) -> Generator[T, None, None]:
    """Run tasks on threads and yield their results in order.

    At most two per thread are submitted or unread; a single thread starts no task while the caller uses a result.
    """
    waiting: list[Future[T]] = []
    n_ahead = 2 * workers if workers > 1 else 1
    with ThreadPoolExecutor(workers) as pool:
        try:
            for task in tasks:
                waiting.append(pool.submit(task))
                if len(waiting) >= n_ahead:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            for future in waiting:
                future.cancel()


def pixels_per_block(experiment: Experiment) -> int:
    """Return the number of pixels per block."""
    return max(1, RAYS_PER_BLOCK // (experiment.sampling.n_rays * experiment.sampling.n_branches))


def by_blocks(experiment: Experiment, n_pixels: int, work: Callable[[slice], T], workers: int | None = None) -> list[T]:
    """Call `work` for every block of pixels, on threads; return its results in the order of the blocks.

    `workers`: number of threads; default: one per CPU.
    """
    size = pixels_per_block(experiment)
    tasks = (partial(work, slice(start, start + size)) for start in range(0, n_pixels, size))
    return list(in_order(workers or n_cpus(), tasks))


def trace_pixels(
    experiment: Experiment,
    x: np.ndarray,
    y: np.ndarray,
    workers: int | None = None,
    first: Hits | None = None,
    max_lost: float = MAX_LOST,
) -> Estimate:
    """Trace the pixels at beam positions (x, y) [n] [um], in this order.

    With `first` [n], the first scattering points and normals are these instead of the hits of the beam.

    Raises:
        GuardError: rays are unaccounted for, or a larger share than `max_lost` was lost.
    """
    ids = np.arange(len(x))

    def trace(part: slice) -> Estimate:
        hits = first.take(part) if first else None
        return trace_block(experiment, ids[part], x[part], y[part], hits).estimate()

    estimate = Estimate.join(by_blocks(experiment, len(x), trace, workers))
    check_rays(estimate.fates.sum(1), estimate.n_unaccounted, int(np.sum(estimate.fates)), max_lost)
    return estimate


def check_rays(fates: np.ndarray, n_unaccounted: int, n_launched: int, max_lost: float = MAX_LOST) -> None:
    """Check the rays per fate [4] of (a part of) a run with `n_launched` rays in total.

    Raises:
        GuardError: rays are unaccounted for, or a larger share than `max_lost` of all rays was lost.
    """
    if n_unaccounted:
        raise GuardError(f"{n_unaccounted} rays are unaccounted for: please report this with the scene")
    lost = int(fates[LOST])
    if lost > max_lost * n_launched:
        raise GuardError(
            f"{lost} of {n_launched} rays ({lost / n_launched:.2%}, limit {max_lost:.2%}) met a surface from behind: "
            "the mesh has holes or inverted normals (helio validate SCENE shows where): repair it, close small holes "
            "by sample.close_holes_um, or reverse it by sample.flip_normals; a sheet without thickness needs "
            "sample.two_sided"
        )


def first_hits(intersector: Intersector, instrument: Instrument, x: np.ndarray, y: np.ndarray) -> Hits:
    """Compute the first hits of the beam axis on the sample for beam positions (x, y) [n] [um]."""
    dx, dy, dz = instrument.sample_origin(x, y)
    origin = instrument.pinhole_center + np.stack([dx, dy, np.full_like(dx, dz)], -1)
    direction = np.broadcast_to(instrument.beam_direction, origin.shape).copy()
    return intersector.nearest(origin, direction, np.full(len(x), -1, np.int32))
