"""Trace a whole scan: run its units on threads, processes or a cluster, and put their results together.

`Executor` says who runs the units; all run the same code, so the counts do not depend on it. Nothing is stored here:
`checkpoint` keeps finished units on disk.
"""

import math
import os
import signal
import threading
from collections.abc import Generator
from concurrent import futures
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from multiprocessing import connection, get_context, parent_process
from typing import Any

import numpy as np

from helio_jax.errors import MissingDependencyError, SceneError, StoppedRun
from helio_jax.micrograph import Micrographs, MicrographSet, MicrographStack
from helio_jax.scene.body import Body
from helio_jax.scene.scan import PositionList
from helio_jax.scene.scene import Scene
from helio_jax.trace.experiment import Experiment
from helio_jax.trace.job import Job, Unit
from helio_jax.trace.run import Progress, check_rays, effusive_settings, in_order, n_cpus, paths_of
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.tally import FATES, Estimate
from helio_jax.trace.units import UnitResult, experiment_of, join_pieces, tasks, trace_unit

MAX_DEATHS = 3
"""Times that worker processes may die without any unit finished in between."""
MAX_SENT = 1024
"""Units sent to a cluster at a time."""
CONNECT_SECONDS = 10
"""How long a scheduler may take to answer [s]."""
Results = Generator[tuple[Unit, UnitResult], None, None]
"""Units with their results, as they finish; close it to stop the work."""


@dataclass(frozen=True)
class Executor:
    """Who runs the units of a job: threads of this process unless told otherwise.

    Attributes:
        workers: threads or processes; default: one per CPU that this process may use.
        processes: run worker processes instead of threads. They import the main module again: a script that calls
            this needs `if __name__ == "__main__":`.
        scheduler: address of a dask scheduler, whose workers run the units.
    """

    workers: int | None = None
    processes: bool = False
    scheduler: str | None = None

    def run(self, job: Job, units: list[Unit], body: Body, progress: Progress | None = None) -> Results:
        """Yield every unit with its result as it finishes.

        Raises:
            StoppedRun: workers died or were lost again and again.
            MissingDependencyError: dask.distributed is not installed.
            SceneError: no scheduler answers at the address.
        """
        if self.scheduler:
            results = _on_cluster(self.scheduler, job, units)
        elif self.processes:
            results = _on_processes(self.workers or n_cpus(), job, units)
        else:
            return _on_threads(self.workers or n_cpus(), job, units, body, progress)
        return _watched(results, job.n_pixels, sum(u.stop - u.start for u in units), progress)


def _watched(results: Results, n_pixels: int, n_todo: int, progress: Progress | None) -> Results:
    """Report every finished unit."""
    done = n_pixels - n_todo
    with closing(results):
        for unit, unit_result in results:
            done += unit.stop - unit.start
            if progress:
                progress(done, n_pixels)
            yield unit, unit_result


def _on_threads(workers: int, job: Job, units: list[Unit], body: Body, progress: Progress | None) -> Results:
    """Run the pieces of all units on threads, in order, so that all CPUs work on one or two units at a time."""

    @lru_cache(maxsize=2)  # work is begun on the next view before the last one is finished
    def prepared(number: int) -> Experiment:
        return experiment_of(job, body, number)

    def tasks_of(unit: Unit) -> list:
        return tasks(prepared(job.view_number(unit)), job, unit)

    done = job.n_pixels - sum(unit.stop - unit.start for unit in units)
    with closing(in_order(workers, (task for unit in units for task in tasks_of(unit)))) as results:
        for unit in units:
            pieces = []
            for piece in islice(results, len(tasks_of(unit))):
                pieces.append(piece)
                done += piece.total_mean.shape[1] if isinstance(piece, Estimate) else 0
                if progress:
                    progress(done, job.n_pixels)
            yield unit, join_pieces(prepared(job.view_number(unit)), pieces)


def _on_processes(workers: int, job: Job, units: list[Unit]) -> Results:
    """Run units on spawned processes; those that die are replaced, and what they were at is done again."""
    left = {unit.number: unit for unit in units}
    n_deaths = 0
    while left:
        n_before = len(left)
        pool = ProcessPoolExecutor(min(workers, n_before), get_context("spawn"), _begin_worker)
        try:
            with pool, closing(_submit(pool, workers + 1, job, list(left.values()))) as results:
                for unit, unit_result in results:
                    del left[unit.number]
                    yield unit, unit_result
        except futures.BrokenExecutor:
            n_deaths = n_deaths + 1 if len(left) == n_before else 1
            if n_deaths == MAX_DEATHS:
                raise StoppedRun(
                    f"worker processes died {MAX_DEATHS} times without finishing a unit (killed, or out of memory?): "
                    f"use fewer than {workers} workers or more memory"
                ) from None


def _begin_worker() -> None:
    """Leave Ctrl-C to the process that started this one, and end when that one ends, however it does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()

    def watch() -> None:
        connection.wait([parent.sentinel])  # type: ignore[union-attr]
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _on_cluster(address: str, job: Job, units: list[Unit]) -> Results:
    """Run units on the workers of a dask scheduler, which repeats what a lost worker was at."""
    try:
        from distributed import Client, KilledWorker
    except ImportError:
        raise MissingDependencyError("a scheduler needs dask: pip install 'helio-jax[dask]'") from None
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as e:
        raise SceneError(
            f"no dask scheduler answers at {address!r} within {CONNECT_SECONDS} s ({e}): start one with `dask "
            "scheduler`, and workers with `dask worker`"
        ) from None
    with client:
        try:
            with closing(_submit(client.get_executor(), MAX_SENT, job, units)) as results:
                yield from results
        except (KilledWorker, futures.CancelledError, OSError) as e:
            raise StoppedRun(
                f"the cluster lost the work ({type(e).__name__}: {e}): look at its workers' logs"
            ) from None


def _submit(pool: futures.Executor, n_ahead: int, job: Job, units: list[Unit]) -> Results:
    """Yield units with their results as a pool finishes them; at most `n_ahead` are submitted at a time."""
    todo, waiting = iter(units), {}
    try:
        while True:
            for unit in islice(todo, n_ahead - len(waiting)):
                waiting[pool.submit(trace_unit, job, unit)] = unit
            if not waiting:
                return
            done, _ = futures.wait(waiting, return_when=futures.FIRST_COMPLETED)
            for future in sorted(done, key=lambda f: f.exception() is not None):  # keep what was finished
                yield waiting[future], future.result()
                del waiting[future]
    finally:
        for future in waiting:
            future.cancel()


class ScanResult:
    """The micrographs of a job, filled unit by unit."""

    def __init__(self, job: Job) -> None:
        n, n_detectors = job.n_pixels, len(job.scene.detector)
        n_maps = n if job.settings.maps else 0
        self.job = job
        self.by_order = np.zeros((job.settings.n_orders, n_detectors, n))
        self.total, self.variance = np.zeros((n_detectors, n)), np.zeros((n_detectors, n))
        self.plate = np.zeros((n_detectors, n if job.scene.plate.is_scattering else 0))
        effusive = job.scene.beam.effusive
        self.effuse = np.zeros((n_detectors, n if effusive else 0))
        self.masked, self.shadowed = np.zeros((n_detectors, n_maps)), np.zeros(n_maps)
        self.fates, self.effuse_fates = np.zeros(len(FATES), np.int64), np.zeros(len(FATES), np.int64)
        self.cpus: set[str] = set()
        self.missing = {unit.number for unit in job.units()}
        self.n_launched = job.n_pixels * math.prod(paths_of(job.settings))
        self.n_effused = (
            job.n_pixels * math.prod(paths_of(effusive_settings(job.settings, effusive))) if effusive else 0
        )

    def put(self, unit: Unit, unit_result: UnitResult) -> None:
        """Store the result of a unit at the pixels of the unit.

        Raises:
            GuardError: more rays were lost so far than the whole scan may lose.
        """
        part = slice(unit.start, unit.stop)
        for name in ("by_order", "total", "variance", "plate", "effuse", "masked", "shadowed"):
            if getattr(self, name).size:
                getattr(self, name)[..., part] = getattr(unit_result, name)
        self.fates += unit_result.fates
        self.effuse_fates += unit_result.effuse_fates
        self.cpus.add(unit_result.cpu)
        self.missing.remove(unit.number)
        check_rays(self.fates, 0, max(self.n_launched, int(self.fates.sum())))
        check_rays(self.effuse_fates, 0, self.n_effused)

    def micrographs(self) -> Micrographs:
        """Return the micrographs, a set of stacks where there are several views. All units must have been put.

        The estimate of a nearly dark pixel may fall below zero by its own error; it is then set to 0, and the number
        of such pixels is recorded in the provenance (`trace_pixels` gives the unclipped values).
        """
        if self.missing:
            raise ValueError(f"units {sorted(self.missing)} are missing")
        n, n_views = self.job.n_view_pixels, len(self.job.views)
        fates, effuse_fates = (
            {"launched": int(f.sum()), **{name: int(n) for name, n in zip(FATES, f, strict=True)}}
            for f in (self.fates, self.effuse_fates)
        )
        note = {"note": "traced on CPUs of several kinds: equal in the mean, not in the last bits"}
        about: dict[str, Any] = {
            "rays": fates,
            **({"effusive_rays": effuse_fates} if self.job.scene.beam.effusive else {}),
            "job": self.job.key,
            "cpu": sorted(self.cpus),
            **(note if len(self.cpus) > 1 else {}),
        }
        if self.job.settings.has_target:
            about["rays_per_pixel"] = fates["launched"] / self.job.settings.branches / self.job.n_pixels
        stacks = tuple(self._stack_of(i, slice(i * n, (i + 1) * n)) for i in range(n_views))
        if n_views == 1:
            return stacks[0].replace(provenance={**stacks[0].provenance, **about})
        return MicrographSet(stacks, about)

    def _stack_of(self, number: int, pixels: slice) -> MicrographStack:
        """Return the micrographs of one view."""
        scene, settings, view = self.job.scene, self.job.settings, self.job.views[number]
        is_expected = settings.estimator == "expected"
        scale = float(scene.scan.atoms_per_pixel) if is_expected else 1.0
        effusive = scene.beam.effusive
        effused = float(effusive.atoms_per_pixel) if is_expected and effusive else 1.0
        n_negative = int(np.sum(self.total[:, pixels] < 0))
        missed = {}
        if settings.target_error is not None:
            limit = settings.target_error * self.total[:, pixels]
            missed["n_above_target"] = int(np.sum(np.any(np.sqrt(self.variance[:, pixels]) > limit, axis=0)))
        images: dict[str, Any] = {}
        for name, array, factor in (
            ("by_order", self.by_order, scale),
            ("counts", self.total, scale),
            ("variance", self.variance, scale**2),
            ("plate", self.plate, scale),
            ("effuse", self.effuse, effused),
        ):
            if not array.size:
                continue
            images[name] = array[..., pixels]
            np.maximum(images[name], 0.0, out=images[name])
            images[name] *= factor
        images |= {"masked": self.masked[:, pixels], "shadowed": self.shadowed[pixels]} if settings.maps else {}
        x, y = scene.positions()
        is_list = isinstance(scene.scan, PositionList)
        return MicrographStack(
            **{name: a.reshape(*a.shape[:-1], y.size, x.size) for name, a in images.items()},
            x=x,
            y=y,
            positions=np.stack(scene.points(np.arange(x.size)), -1) if is_list else None,
            instrument=view.instrument,
            sample_rotation=view.sample_rotation,
            n_rays=scale if is_expected else float(settings.rays),
            noise="expected" if is_expected else "poisson",
            name=f"{scene.name}, {view.label}" if len(self.job.views) > 1 else scene.name,
            provenance={
                "trace": settings.model_dump(mode="json"),
                "n_negative": n_negative,
                **missed,
                "materials": {name: law.kind for name, law in scene.used_materials.items()},
                **({"view": view.description} if view.description else {}),
            },
        )


def trace_scene(
    scene: Scene, settings: TraceSettings, progress: Progress | None = None, body: Body | None = None
) -> Micrographs:
    """Simulate the micrographs of a scene in memory, on threads: a stack, or a set where the scan has several views.

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
    body = scene.build_body() if body is None else body
    job = Job.of(scene, settings, body)
    scan_result = ScanResult(job)
    with closing(Executor(settings.workers).run(job, job.units(), body, progress)) as results:
        for unit, unit_result in results:
            scan_result.put(unit, unit_result)
    return scan_result.micrographs()
