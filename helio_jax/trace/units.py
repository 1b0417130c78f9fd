"""Units of work: ranges of neighbouring pixels, traced independently.

`trace_unit` computes a `UnitResult` from a `Job` and a range of pixels. It is a pure function of both: threads,
processes, other machines and later runs give the same bits on CPUs of one instruction set, which every result names.
`scan` runs the units.
"""

import functools
import platform
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from helio_jax.errors import ResumeError
from helio_jax.scene.body import Body
from helio_jax.trace.converge import trace_to_target
from helio_jax.trace.experiment import Experiment
from helio_jax.trace.intersect import MISS
from helio_jax.trace.job import Job, Unit, differences, instruction_set
from helio_jax.trace.masks import is_shadowed, masked_form_factor
from helio_jax.trace.run import check_rays, first_hits, make_experiment, pixels_per_block
from helio_jax.trace.tally import FATES, Estimate
from helio_jax.trace.transport import trace_block

Piece = tuple[str, Any]
"""Result of one task of a unit: "maps" with two arrays, or "beam" or "effusive" with an `Estimate`."""


@dataclass(frozen=True)
class UnitResult:
    """Result of a unit: integer counts for `analog`, else expected counts per beam ray.

    Attributes:
        by_order: counts by scattering order [order, detector, pixels].
        by_order_variance: of their means [order, detector, pixels]; the orders of one path are correlated.
        total, variance: sum of all orders and the variance of its mean [detector, pixels].
        plate: part of `total` that a scattering plate has scattered [detector, pixels]; empty without one.
        effuse, effuse_variance: counts from the effusive beam and their variance [detector, pixels]; empty without one.
        fates, effuse_fates: rays per fate (`FATES`) of the beam and the effusive beam, summed over the pixels [4].
        masked: masked share of each aperture [detector, pixels]; empty without maps.
        shadowed: 1 where the beam cannot reach the topmost point [pixels]; empty without maps.
        cpu: instruction set of the CPU used.
    """

    by_order: np.ndarray
    by_order_variance: np.ndarray
    total: np.ndarray
    variance: np.ndarray
    plate: np.ndarray
    effuse: np.ndarray
    effuse_variance: np.ndarray
    effuse_fates: np.ndarray
    fates: np.ndarray
    masked: np.ndarray
    shadowed: np.ndarray
    cpu: str

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the attributes by name, for storage."""
        return {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], job: Job, unit: Unit) -> "UnitResult":
        """Undo `arrays`.

        Raises:
            ValueError: an array is missing, or has another shape or type than a result of this unit.
        """
        shapes = result_shapes(job, unit.stop - unit.start)
        if set(arrays) != {*shapes, "cpu"}:
            raise ValueError(f"it must hold {', '.join(shapes)} and cpu, it holds {', '.join(arrays) or 'nothing'}")
        for name, shape in shapes.items():
            a = arrays[name]
            if a.shape != shape or a.dtype.kind not in "if" or not np.all(np.isfinite(a)):
                raise ValueError(f"{name} must be finite numbers of shape {shape}, got {a.dtype} of shape {a.shape}")
        return cls(**{name: arrays[name] for name in shapes}, cpu=str(arrays["cpu"]))


def result_shapes(job: Job, n_pixels: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of a `UnitResult` of `n_pixels` pixels."""
    n_detectors, n_maps = len(job.scene.detector), n_pixels if job.settings.maps else 0
    return {
        "by_order": (job.settings.n_orders, n_detectors, n_pixels),
        "by_order_variance": (job.settings.n_orders, n_detectors, n_pixels),
        "total": (n_detectors, n_pixels),
        "variance": (n_detectors, n_pixels),
        "plate": (n_detectors, n_pixels if job.scene.plate.is_scattering else 0),
        "effuse": (n_detectors, n_pixels if job.scene.beam.effusive else 0),
        "effuse_variance": (n_detectors, n_pixels if job.scene.beam.effusive else 0),
        "effuse_fates": (len(FATES),),
        "fates": (len(FATES),),
        "masked": (n_detectors, n_maps),
        "shadowed": (n_maps,),
    }


def view_experiment(job: Job, body: Body, number: int) -> Experiment:
    """Prepare the state shared by all units of one view of a job."""
    view, scene = job.views[number], job.scene
    read = scene.read_laws(), scene.read_rays(), scene.read_plate()
    return make_experiment(view.rotated_body(body), view.instrument, job.settings, *read)


def unit_tasks(experiment: Experiment, job: Job, unit: Unit) -> list[Callable[[], Piece]]:
    """Return the independent tasks of a unit, for `join_pieces`: its maps and its blocks of rays."""
    out: list[Callable[[], Piece]] = list(_blocks(experiment, job, unit, _trace))
    if experiment.effusive is not None:
        out += _blocks(experiment.effusive, job, unit, _trace_effusive)
    maps = functools.partial(_maps, experiment, *job.pixels(unit.start, unit.stop)[1:])
    return [maps, *out] if job.settings.maps else out


def _blocks(experiment: Experiment, job: Job, unit: Unit, trace: Callable[..., Piece]) -> Iterator[Callable[[], Piece]]:
    """Yield the tasks that trace the blocks of rays of a unit."""
    size = pixels_per_block(experiment)
    for start in range(unit.start, unit.stop, size):
        yield functools.partial(trace, experiment, job, start, min(start + size, unit.stop))


def join_pieces(experiment: Experiment, pieces: list[Piece]) -> UnitResult:
    """Join the results of a unit's tasks, given in their order.

    Raises:
        GuardError: rays are unaccounted for.
    """
    maps, beam, effusive = ([piece for k, piece in pieces if k == kind] for kind in ("maps", "beam", "effusive"))
    e = Estimate.join(beam)
    effuse = Estimate.join(effusive or [e.take(slice(0))])
    fates, effuse_fates = e.fates.sum(1), effuse.fates.sum(1)
    check_rays(np.zeros_like(fates), e.n_unaccounted + effuse.n_unaccounted, 1)
    masked, shadowed = maps[0] if maps else (np.zeros((e.total_mean.shape[0], 0)), np.zeros(0))
    kept = slice(None) if experiment.plate is not None else slice(0)
    plate = e.plate_mean if experiment.is_expected else e.plate_hits.astype(float)
    others = effuse_fates, fates, masked, shadowed, instruction_set()
    if experiment.is_expected:
        effused = effuse.total_mean, effuse.total_variance
        return UnitResult(e.mean, e.variance, e.total_mean, e.total_variance, plate[:, kept], *effused, *others)
    hits, effused = e.hits.astype(float), effuse.hits.sum(0).astype(float)
    return UnitResult(hits, hits, hits.sum(0), hits.sum(0), plate[:, kept], effused, effused, *others)


def trace_unit(job: Job, unit: Unit) -> UnitResult:
    """Trace a unit from its description alone; the surface is built once per process.

    Raises:
        ResumeError: this process has another mesh file or another version than the sender of the job.
        GuardError: rays are unaccounted for.
    """
    with _LOCK:
        experiment = _prepared(job, job.view_number(unit))
    return join_pieces(experiment, [task() for task in unit_tasks(experiment, job, unit)])


_LOCK = threading.Lock()


@functools.lru_cache(maxsize=1)
def _prepared(job: Job, number: int) -> Experiment:
    body = job.scene.build_body()
    here = Job.of(job.scene, job.settings, body)
    if changes := differences(job.about, here.about, ("sender", f"worker on {platform.node()}")):
        raise ResumeError(
            "sender and worker differ: " + "; ".join(changes) + "; install the same version and put the same files on "
            "both machines"
        )
    return view_experiment(job, body, number)


def _trace(experiment: Experiment, job: Job, start: int, stop: int) -> Piece:
    if job.settings.has_target:
        return "beam", trace_to_target(experiment, job.settings, *job.pixels(start, stop))
    return "beam", trace_block(experiment, *job.pixels(start, stop)).estimate()


def _trace_effusive(experiment: Experiment, job: Job, start: int, stop: int) -> Piece:
    return "effusive", trace_block(experiment, *job.pixels(start, stop)).estimate()


def _maps(experiment: Experiment, x: np.ndarray, y: np.ndarray) -> Piece:
    """Compute the maps `masked` [detector, n] and `shadowed` [n]."""
    e = experiment
    hits = first_hits(e.intersector, e.instrument, x, y)
    found = np.flatnonzero((hits.surface != MISS) & ~hits.is_back)
    offset = np.stack(e.instrument.sample_origin(x, y)[:2], -1)[found]
    _, fraction = masked_form_factor(
        e.intersector, e.instrument, hits.point[found], hits.normal[found], hits.surface[found], offset
    )
    masked = np.zeros((len(fraction), len(x)))
    masked[:, found] = fraction
    return "maps", (masked, is_shadowed(e.intersector, e.instrument, x, y).astype(float))
