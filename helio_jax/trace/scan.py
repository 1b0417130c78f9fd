"""Trace a whole scan: run its units on threads, processes or a cluster and join the results.

All kinds of `Executor` run the same code, so the counts do not depend on it. Results stay in memory;
`workflows.checkpoint` stores finished units on disk.
"""

import os
import signal
import threading
from collections.abc import Generator, Iterator
from concurrent import futures
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from multiprocessing import connection, get_context, parent_process
from typing import Any

import numpy as np

from helio_jax.cpus import n_cpus
from helio_jax.errors import MissingDependencyError, SceneError, StoppedRun
from helio_jax.micrograph import Micrographs, MicrographSet, MicrographStack
from helio_jax.scene.body import Body
from helio_jax.scene.scan import PositionList
from helio_jax.scene.scene import Scene
from helio_jax.trace.experiment import Experiment
from helio_jax.trace.job import Job, Unit
from helio_jax.trace.run import Progress, check_rays, in_order
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.tally import FATES
from helio_jax.trace.units import UnitResult, join_pieces, result_shapes, trace_unit, unit_tasks, view_experiment

MAX_DEATHS = 3
"""Consecutive deaths of worker processes without a finished unit that stop the run."""
MAX_SENT = 1024
"""Limit of units submitted to a cluster at a time."""
CONNECT_SECONDS = 10
"""Time limit for the connection to a scheduler [s]."""
Results = Generator[tuple[Unit, UnitResult], None, None]
"""Yields units with their results as they finish; closing it stops the work."""


@dataclass(frozen=True)
class Executor:
    """Runs the units of a job, by default on threads of this process.

    Attributes:
        workers: number of threads or processes; default: one per CPU that this process may use.
        processes: use worker processes instead of threads. They import the main module: a calling script needs
            `if __name__ == "__main__":`.
        scheduler: address of a dask scheduler whose workers run the units.
    """

    workers: int | None = None
    processes: bool = False
    scheduler: str | None = None

    def run(self, job: Job, units: list[Unit], body: Body, progress: Progress | None = None) -> Results:
        """Yield each unit with its result as it finishes.

        Raises:
            StoppedRun: workers died or were lost repeatedly.
            MissingDependencyError: dask.distributed is not installed.
            SceneError: no scheduler answers at the address.
        """
        if self.scheduler:
            results = _on_cluster(self.scheduler, job, units)
        elif self.processes:
            results = _on_processes(self.workers or n_cpus(), job, units)
        else:
            return _on_threads(self.workers or n_cpus(), job, units, body, progress)
        return _with_progress(results, job.n_pixels, sum(u.stop - u.start for u in units), progress)


def _with_progress(results: Results, n_pixels: int, n_todo: int, progress: Progress | None) -> Results:
    """Call `progress` after each unit."""
    done = n_pixels - n_todo
    with closing(results):
        for unit, unit_result in results:
            done += unit.stop - unit.start
            if progress:
                progress(done, n_pixels)
            yield unit, unit_result


def _on_threads(workers: int, job: Job, units: list[Unit], body: Body, progress: Progress | None) -> Results:
    """Run the tasks of all units on threads, in order, so that all CPUs work on one or two units at a time."""

    @lru_cache(maxsize=2)  # tasks of the next view start before the last view is finished
    def prepared(number: int) -> Experiment:
        return view_experiment(job, body, number)

    def tasks_of(unit: Unit) -> list:
        return unit_tasks(prepared(job.view_number(unit)), job, unit)

    done = job.n_pixels - sum(unit.stop - unit.start for unit in units)
    with closing(in_order(workers, (task for unit in units for task in tasks_of(unit)))) as results:
        for unit in units:
            pieces = []
            for piece in islice(results, len(tasks_of(unit))):
                pieces.append(piece)
                done += piece[1].total_mean.shape[1] if piece[0] == "beam" else 0
                if progress:
                    progress(done, job.n_pixels)
            yield unit, join_pieces(prepared(job.view_number(unit)), pieces)


def _on_processes(workers: int, job: Job, units: list[Unit]) -> Results:
    """Run units on spawned processes; dead processes are replaced and their units repeated."""
    left = {unit.number: unit for unit in units}
    n_deaths = 0
    while left:
        n_before = len(left)
        pool = ProcessPoolExecutor(min(workers, n_before), get_context("spawn"), _begin_worker)
        try:
            with _ended(pool), closing(_submit(pool, workers + 1, job, list(left.values()))) as results:
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


@contextmanager
def _ended(pool: ProcessPoolExecutor) -> Iterator[None]:
    """End the workers of a pool on the way out: when they are done, or at once after an error or an interrupt.

    However often Ctrl-C is pressed: a pool that is left alone keeps the program from ending.
    """
    is_done = False
    try:
        yield
        is_done = True
    finally:
        with _interrupts_held():
            workers = list((pool._processes or {}).values())
            pool.shutdown(wait=is_done, cancel_futures=True)
            for worker in workers if not is_done else ():
                worker.terminate()
                worker.join()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Let Ctrl-C wait until the block has ended; processes that start within never heed it."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_worker() -> None:
    """Ignore Ctrl-C, which the parent process handles, and exit when the parent process ends for any reason."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()

    def watch() -> None:
        connection.wait([parent.sentinel])  # type: ignore[union-attr]
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _on_cluster(address: str, job: Job, units: list[Unit]) -> Results:
    """Run units on the workers of a dask scheduler, which repeats the units of lost workers."""
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
                f"the cluster lost the work ({type(e).__name__}: {e}): see the logs of its workers"
            ) from None


def _submit(pool: futures.Executor, n_ahead: int, job: Job, units: list[Unit]) -> Results:
    """Yield units with their results as a pool finishes them; at most `n_ahead` are submitted at a time."""
    todo, waiting = iter(units), {}
    try:
        while True:
            for unit in islice(todo, n_ahead - len(waiting)):
                with _interrupts_held():  # starts workers
                    waiting[pool.submit(trace_unit, job, unit)] = unit
            if not waiting:
                return
            done, _ = futures.wait(waiting, return_when=futures.FIRST_COMPLETED)
            for future in sorted(done, key=lambda f: f.exception() is not None):  # finished units first
                yield waiting[future], future.result()
                del waiting[future]
    finally:
        for future in waiting:
            future.cancel()


class ScanResult:
    """Result of a whole scan, filled unit by unit."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.arrays = {name: np.zeros(shape) for name, shape in result_shapes(job, job.n_pixels).items()}
        self.cpus: set[str] = set()
        self.missing = {unit.number for unit in job.units()}
        self.n_launched = {
            name: job.n_pixels * n for name, n in zip(("fates", "effuse_fates"), job.paths_per_pixel, strict=True)
        }

    def put(self, unit: Unit, unit_result: UnitResult) -> None:
        """Store the result of a unit at the pixels of the unit.

        Raises:
            GuardError: the units so far have lost more rays than allowed in the whole scan.
        """
        for name, array in self.arrays.items():
            if name in self.n_launched:
                array += getattr(unit_result, name)
            else:
                array[..., unit.start : unit.stop] = getattr(unit_result, name)
        self.cpus.add(unit_result.cpu)
        self.missing.remove(unit.number)
        for name, n in self.n_launched.items():
            check_rays(self.arrays[name], 0, max(n, int(self.arrays[name].sum())))

    def micrographs(self) -> Micrographs:
        """Return the micrographs of the complete scan: a stack, or a set of stacks for several views.

        An estimate in a nearly dark pixel may be negative within its error. It is set to 0, and the number of such
        pixels is recorded in the provenance (`trace_pixels` gives the original values).

        Raises:
            ValueError: units are missing.
        """
        if self.missing:
            raise ValueError(f"units {sorted(self.missing)} are missing")
        job, n = self.job, self.job.n_view_pixels
        fates, effuse_fates = (
            {"launched": int(f.sum()), **{name: int(n) for name, n in zip(FATES, f, strict=True)}}
            for f in (self.arrays["fates"], self.arrays["effuse_fates"])
        )
        about: dict[str, Any] = {"rays": fates}
        if job.scene.beam.effusive:
            about["effusive_rays"] = effuse_fates
        about |= {"job": job.key, "cpu": sorted(self.cpus)}
        if len(self.cpus) > 1:
            about["note"] = "traced on CPUs of several kinds: equal in the mean, not in the last bits"
        if job.settings.has_target:
            about["rays_per_pixel"] = fates["launched"] / job.settings.branches / job.n_pixels
        stacks = tuple(self._stack_of(i, slice(i * n, (i + 1) * n)) for i in range(len(job.views)))
        if len(stacks) == 1:
            return stacks[0].replace(provenance={**stacks[0].provenance, **about})
        return MicrographSet(stacks, about)

    def _stack_of(self, number: int, pixels: slice) -> MicrographStack:
        """Return the micrographs of one view."""
        scene, settings, view = self.job.scene, self.job.settings, self.job.views[number]
        is_expected = settings.estimator == "expected"
        scale = float(scene.scan.atoms_per_pixel) if is_expected else 1.0
        effusive = scene.beam.effusive
        effused = float(effusive.atoms_per_pixel) if is_expected and effusive else 1.0
        total, variance = (self.arrays[name][:, pixels] for name in ("total", "variance"))
        about = {"trace": settings.model_dump(mode="json"), "n_negative": int(np.sum(total < 0))}
        if settings.target_error is not None:
            is_above = np.sqrt(variance) > settings.target_error * total
            about["n_above_target"] = int(np.sum(np.any(is_above, axis=0)))
        if view.description:
            about["view"] = view.description
        images: dict[str, Any] = {}
        for name, array_name, factor in (
            ("by_order", "by_order", scale),
            ("by_order_variance", "by_order_variance", scale**2),
            ("counts", "total", scale),
            ("variance", "variance", scale**2),
            ("plate", "plate", scale),
            ("effuse", "effuse", effused),
            ("effuse_variance", "effuse_variance", effused**2),
        ):
            array = self.arrays[array_name]
            if array.size:
                images[name] = array[..., pixels]  # scaled in place, to save memory
                np.maximum(images[name], 0.0, out=images[name])
                images[name] *= factor
        if settings.maps:
            images |= {"masked": self.arrays["masked"][:, pixels], "shadowed": self.arrays["shadowed"][pixels]}
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
            materials={name: law.kind for name, law in scene.used_materials.items()},
            provenance=about,
        )


def trace_scene(
    scene: Scene, settings: TraceSettings, progress: Progress | None = None, body: Body | None = None
) -> Micrographs:
    """Simulate the micrographs of a scene in memory, on threads: a stack, or a set for a scan with several views.

    The `expected` estimator gives expected counts for `scene.scan.atoms_per_pixel` atoms and the variance of their
    mean; `analog` gives integer counts of `settings.rays` atoms and their Poisson variance.

    Args:
        scene: beam, plate, detectors, sample and scan.
        settings: rays, estimator, seed, workers.
        progress: called after each block.
        body: the sample's surface; default: built from `scene.sample`.

    Raises:
        GuardError: rays are unaccounted for, or too many were lost.
    """
    body = scene.build_body() if body is None else body
    job = Job.of(scene, settings, body)
    scan_result = ScanResult(job)
    with closing(Executor(settings.workers).run(job, job.units(), body, progress)) as results:
        for unit, unit_result in results:
            scan_result.put(unit, unit_result)
    return scan_result.micrographs()
