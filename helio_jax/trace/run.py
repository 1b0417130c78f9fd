"""Trace a scene: cut the scan into blocks of pixels, trace them on threads, put the tallies in order.

A block is a pure function of the experiment and its pixels, and the blocks are joined in scan order, so the
result is bitwise the same for any number of worker threads.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from helio_jax.errors import GuardError, SceneError
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack
from helio_jax.scene.body import COSINE, Body
from helio_jax.scene.scattering import COSINE_LAW, Term
from helio_jax.scene.scene import Scene
from helio_jax.trace.direct import ApertureTable
from helio_jax.trace.intersect import MISS, Hits, Intersector
from helio_jax.trace.lawtable import LawTable, check_lattices, is_cosine, make_law_table
from helio_jax.trace.masks import axis_rays, hidden_form_factor, is_shadowed
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.source import Sampling
from helio_jax.trace.tally import FATES, LOST, Tally
from helio_jax.trace.transport import Experiment, trace_block

RAYS_PER_BLOCK = 65536
"""Rays traced together: Embree is fastest with about 64k neighbouring rays."""
N_REPLICATES = 8
"""Independent shifts of the low-discrepancy points, from whose spread the standard error is taken."""
MAX_LOST = 1e-4
"""Largest share of lost rays that is tolerated."""

Progress = Callable[[int, int], None]
"""Called with (blocks done, blocks in all)."""


def make_experiment(
    body: Body | Intersector,
    instrument: Instrument,
    settings: TraceSettings,
    laws: Mapping[str, tuple[Term, ...]] | None = None,
) -> Experiment:
    """Prepare the shared state of a run. The expected estimator rounds the rays up to a multiple of 8.

    Args:
        body: the sample.
        instrument: beam, plate and detectors.
        settings: rays, estimator, seed.
        laws: scattering law of each of the body's materials; "cosine" need not be given.

    Raises:
        SceneError: a material has no law, or a lattice stands upright on a face.
    """
    is_expected = settings.estimator == "expected"
    n_replicates = N_REPLICATES if is_expected else 0
    n_rays = -(-settings.rays // N_REPLICATES) * N_REPLICATES if is_expected else settings.rays
    intersector = body if isinstance(body, Intersector) else Intersector(body)
    return Experiment(
        intersector=intersector,
        instrument=instrument,
        apertures=ApertureTable(instrument),
        sampling=Sampling.make(n_rays, settings.branches if is_expected else 1, n_replicates, settings.seed),
        n_orders=settings.n_orders,
        max_events=settings.max_events,
        is_expected=is_expected,
        laws=_law_table(intersector, {COSINE: COSINE_LAW} | dict(laws or {})),
    )


def _law_table(intersector: Intersector, laws: Mapping[str, tuple[Term, ...]]) -> LawTable | None:
    """Return the laws in the order of the body's materials; None where all are the cosine law."""
    names = intersector.materials
    if missing := [name for name in names if name not in laws]:
        raise SceneError(f"material {missing[0]!r} has no law: add the table [material.{missing[0]}] to the scene")
    found = [laws[name] for name in names]
    if all(map(is_cosine, found)):
        return None
    check_lattices(found, names, intersector.normals, intersector.material_of(np.arange(len(intersector.normals))))
    return make_law_table(found)


def _ordered(pool: ThreadPoolExecutor, jobs: Iterator[Callable[[], Tally]], n_ahead: int) -> Iterator[Tally]:
    """Run jobs on the pool, yield their results in order, keep at most `n_ahead` in flight."""
    waiting: list[Future[Tally]] = []
    try:
        for job in jobs:
            waiting.append(pool.submit(job))
            if len(waiting) >= n_ahead:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        for future in waiting:
            future.cancel()


def trace_pixels(
    experiment: Experiment,
    x: np.ndarray,
    y: np.ndarray,
    workers: int | None = None,
    progress: Progress | None = None,
    first: Hits | None = None,
    max_lost: float = MAX_LOST,
) -> Tally:
    """Trace the pixels at beam positions (x, y) [n], um, in this order.

    With `first` [n] the atoms start from these points of the sample, with these normals, instead of from the beam.

    Raises:
        GuardError: rays are unaccounted for, or a larger share than `max_lost` of them was lost.
    """
    size = max(1, RAYS_PER_BLOCK // (experiment.sampling.n_rays * experiment.sampling.n_branches))
    starts = range(0, len(x), size)
    workers = workers or os.cpu_count() or 1

    def job(start: int) -> Callable[[], Tally]:
        part = slice(start, start + size)
        ids = np.arange(len(x))[part]
        return lambda: trace_block(experiment, ids, x[part], y[part], first.take(part) if first else None)

    parts = []
    with ThreadPoolExecutor(workers) as pool:
        for tally in _ordered(pool, map(job, starts), 2 * workers):
            parts.append(tally)
            if progress:
                progress(len(parts), len(starts))
    tally = Tally.join(parts)
    _guard(tally, max_lost)
    return tally


def _guard(tally: Tally, max_lost: float) -> None:
    if tally.n_unaccounted:
        raise GuardError(f"{tally.n_unaccounted} rays are unaccounted for: please report it with the scene")
    launched = tally.n_launched * tally.fates.shape[1]
    lost = int(tally.fates[LOST].sum())
    if lost > max_lost * launched:
        raise GuardError(
            f"{lost} of {launched} rays ({lost / launched:.2%}, limit {max_lost:.2%}) met a surface from behind: the "
            "mesh has holes or inverted normals; repair it (helio validate SCENE shows where)"
        )


def first_hits(intersector: Intersector, instrument: Instrument, x: np.ndarray, y: np.ndarray) -> Hits:
    """Return where the beam axis first meets the sample, for beam positions (x, y) [n], um."""
    origin, direction = axis_rays(instrument, x, y)
    return intersector.nearest(origin, direction, np.full(len(x), -1, np.int32))


def _maps(experiment: Experiment, x: np.ndarray, y: np.ndarray, shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return the maps of cause `masked` [detector, y, x] and `shadowed` [y, x]."""
    e = experiment
    hits = first_hits(e.intersector, e.instrument, x, y)
    found = np.flatnonzero((hits.surface != MISS) & ~hits.is_back)
    offset = np.stack(e.instrument.sample_origin(x, y)[:2], -1)[found]
    _, fraction = hidden_form_factor(
        e.intersector, e.instrument, hits.point[found], hits.normal[found], hits.surface[found], offset
    )
    masked = np.zeros((len(fraction), len(x)))
    masked[:, found] = fraction
    shadow = is_shadowed(e.intersector, e.instrument, x, y)
    return {"masked": masked.reshape(-1, *shape), "shadowed": shadow.reshape(shape).astype(float)}


def trace_scene(
    scene: Scene, settings: TraceSettings, progress: Progress | None = None, body: Body | None = None
) -> MicrographStack:
    """Simulate the micrographs of a scene.

    The estimate of a nearly dark pixel may fall below zero by its own error; it is then set to 0, and the number of
    such pixels is recorded in the provenance (`trace_pixels` gives the unclipped tallies).

    The `expected` estimator gives the expected counts for `scene.scan.atoms_per_pixel` atoms and the variance of
    its own mean; `analog` gives the integer counts of `settings.rays` atoms and their Poisson variance.

    Args:
        scene: beam, plate, detectors, sample and scan.
        settings: rays, estimator, seed, workers.
        progress: called as blocks finish.
        body: the sample's surface, where it is known already (else `scene.sample` is built).

    Raises:
        GuardError: ray book-keeping failed.
    """
    instrument = scene.instrument
    body = scene.build_body() if body is None else body
    experiment = make_experiment(body, instrument, settings, scene.read_laws())
    x, y = scene.scan.positions(instrument.beam)
    grid_x, grid_y = (g.ravel() for g in np.meshgrid(x, y))
    tally = trace_pixels(experiment, grid_x, grid_y, settings.workers, progress)
    shape = (y.size, x.size)
    n_rays = float(scene.scan.atoms_per_pixel if experiment.is_expected else tally.n_rays)
    by_order, _ = tally.probability()
    total, variance = tally.total()
    n_negative = int(np.sum(total < 0))
    by_order, total = np.maximum(by_order, 0.0), np.maximum(total, 0.0)
    fates = {name: int(n) for name, n in zip(FATES, tally.fates.sum(1), strict=True)}
    stack = MicrographStack(
        counts=n_rays * total.reshape(-1, *shape),
        variance=n_rays**2 * variance.reshape(-1, *shape),
        by_order=n_rays * by_order.reshape(*by_order.shape[:2], *shape),
        x=x,
        y=y,
        instrument=instrument,
        n_rays=n_rays,
        noise="expected" if experiment.is_expected else "poisson",
        name=scene.name,
        provenance={
            "trace": settings.model_dump(mode="json"),
            "rays": {"launched": sum(fates.values()), **fates},
            "n_negative": n_negative,
        },
    )
    return stack.replace(**_maps(experiment, grid_x, grid_y, shape)) if settings.maps else stack
