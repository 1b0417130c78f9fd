"""Checkpoints of long simulations: each finished unit is stored on disk, so that a killed run can be resumed.

Joins the tracer's units (`trace.scan`) and their storage (`formats.parts`). A run of a single unit stores nothing. A
run resumes only if scene, settings, surface and program are unchanged (`Job.about`); units are pure functions of these,
so a resumed run equals an undisturbed one bit for bit.
"""

import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.cpus import peak_memory_gb
from helio_jax.errors import GuardError, InputFileError, InterruptedRun, ResumeError, SceneError, StoppedRun
from helio_jax.formats.hdf5 import describe
from helio_jax.formats.parts import Parts
from helio_jax.micrograph import Micrographs
from helio_jax.scene.scene import Scene
from helio_jax.trace.job import Job, Unit, differences
from helio_jax.trace.run import Progress
from helio_jax.trace.scan import Executor, ScanResult
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.units import UnitResult

FORMAT = 2
"""Version of the manifest."""
LONG_PIXELS = 50_000
"""Runs of more pixels state their size and the memory that they take."""
COPIES = 3.1
"""Memory of a run over that of its images: results, what is made of them and what is written. Measured at 1 and 2
million pixels: 3.1, 3.0."""


@dataclass(frozen=True)
class Shard:
    """Share of one of several independent processes: units `number`, `number` + `of`, ... (counted from 1)."""

    number: int
    of: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Parse e.g. "2/8", the second of eight.

        Raises:
            SceneError: another form, or out of range.
        """
        found = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
        number, of = (int(found[1]), int(found[2])) if found else (0, 0)
        if not 1 <= number <= of:
            raise SceneError(f"--shard must be i/N with i from 1 to N, e.g. 2/8, got {text!r}")
        return cls(number, of)


def _memory_text(scan_result: ScanResult) -> str:
    """State how much memory a run will take, beside what its worker processes take."""
    images = sum(array.nbytes for array in scan_result.arrays.values()) / 1e9
    now = peak_memory_gb()
    return "" if now is None else f", about {now + COPIES * images:.1f} GB of memory"


@dataclass(frozen=True)
class CheckpointedRun:
    """Simulation of a scene that stores finished units.

    Attributes:
        parts: storage of finished units.
        command: what `helio resume` needs to repeat the command (JSON-compatible).
        executor: runs the units.
        shard: run this share only; None: all units.
        restart: discard units of an earlier run.
        say: called with messages.
    """

    parts: Parts
    command: dict[str, Any]
    executor: Executor
    shard: Shard | None = None
    restart: bool = False
    say: Callable[[str], None] = lambda text: None

    def trace(self, scene: Scene, settings: TraceSettings, progress: Progress | None = None) -> Micrographs | None:
        """Return the micrographs, or None while other shards are unfinished. The caller removes the parts.

        Raises:
            ResumeError: the parts belong to another scene, other settings or another version.
            InterruptedRun, StoppedRun: Ctrl-C, SIGTERM or lost workers; finished units are kept.
            GuardError: rays are unaccounted for, or too many were lost.
        """
        body = scene.build_body()
        job = Job.of(scene, settings, body)
        units, scan_result = job.units(), ScanResult(job)
        own = units[self.shard.number - 1 :: self.shard.of] if self.shard else units
        self._begin(job, len(units))
        if job.n_pixels > LONG_PIXELS:
            self.say(f"{job.n_pixels:,} pixels in {len(units)} units of work{_memory_text(scan_result)}")
        try:
            with _sigterm_raises():
                todo = list(self._not_loaded(job, own, scan_result))
                with closing(self.executor.run(job, todo, body, progress)) as results:
                    for unit, unit_result in results:
                        if self.parts.exist:
                            self.parts.save(unit.number, unit_result.arrays() | {"job": _label(job, unit)})
                        scan_result.put(unit, unit_result)
                return self._complete(job, units, scan_result)
        except (KeyboardInterrupt, StoppedRun) as e:
            raise self._stopped(e, units) from None
        except GuardError:
            self._remove_own()
            raise
        finally:
            if not any(self.parts.has(unit.number) for unit in units):
                self._remove_own()

    def _remove_own(self) -> None:
        """Remove the folder of parts, unless other shards use it."""
        if self.shard is None:
            self.parts.remove()

    def _begin(self, job: Job, n_units: int) -> None:
        """Make the folder of parts, or check that an existing one belongs to this job."""
        parts = self.parts
        if self.restart and self.shard:
            raise SceneError(f"--restart would discard units of other shards: remove {parts.folder} before they start")
        if self.restart:
            parts.remove()
        if not parts.exist and n_units == 1 and self.shard is None:
            return
        about = parts.manifest().get("about") if parts.exist else job.about
        if changes := differences(about, job.about, ("then", "now")):
            raise ResumeError(
                f"{parts.folder} holds an unfinished run that differs:\n  " + "\n  ".join(changes) + "\nundo these "
                "changes to resume it; repeat the command (simulate, run) with --restart to discard it; or choose "
                "another output"
            )
        if not parts.exist or self.shard is None:  # the latest command is the one to resume
            parts.begin({"format": FORMAT, "command": self.command, "about": job.about, "n_units": n_units})

    def _not_loaded(self, job: Job, units: list[Unit], scan_result: ScanResult) -> Iterator[Unit]:
        """Load stored results into `scan_result`; yield the units that are missing or damaged."""
        n_loaded = 0
        for unit in units:
            try:
                scan_result.put(unit, self._load(job, unit))
                n_loaded += 1
            except InputFileError as e:
                if self.parts.has(unit.number):
                    self.say(f"{e}: it is computed again")
                yield unit
        if n_loaded:
            self.say(f"resuming: {n_loaded} of {len(units)} units are finished")

    def _load(self, job: Job, unit: Unit) -> UnitResult:
        """Load the stored result of a unit."""
        arrays = self.parts.load(unit.number)
        try:
            if str(arrays.pop("job", None)) != str(_label(job, unit)):
                raise ValueError("it belongs to another run")
            return UnitResult.from_arrays(arrays, job, unit)
        except ValueError as e:
            raise InputFileError(f"{self.parts.path(unit.number)} is damaged ({e})") from None

    def _complete(self, job: Job, units: list[Unit], scan_result: ScanResult) -> Micrographs | None:
        """Return the micrographs when all shards are finished, to one process only."""
        if self.shard is not None:
            n_there = sum(self.parts.has(unit.number) for unit in units)
            own = f"{self.shard.number}/{self.shard.of}"
            mine = f"shard {own} is finished"
            if n_there < len(units):
                self.say(f"{mine}; {n_there} of all {len(units)} units are finished")
                return None
            if not self.parts.claim(own):
                other = self.parts.claimed_by()
                how = f": if it was killed, repeat it or run `helio resume {self.parts.output}`" if other else ""
                self.say(f"{mine}, as are all others; shard {other or 'i/N'} writes {self.parts.output}{how}")
                return None
            for unit in units:
                if unit.number in scan_result.missing:
                    scan_result.put(unit, self._load(job, unit))
        return scan_result.micrographs()

    def _stopped(self, e: BaseException, units: list[Unit]) -> Exception:
        """Make the error that states what is kept and how to resume."""
        kind = StoppedRun if isinstance(e, (StoppedRun, _Terminated)) else InterruptedRun
        why = str(e) or ("stopped by SIGTERM" if kind is StoppedRun else "interrupted")
        n_kept = sum(self.parts.has(unit.number) for unit in units)
        if n_kept == 0 and self.shard is None:
            return kind(f"{why}; no unit of work was finished, nothing is kept")
        how = "the same command" if self.shard else f"`helio resume {self.parts.output}`"
        return kind(f"{why}; {n_kept} of {len(units)} units are kept in {self.parts.folder}: {how} resumes")


def _label(job: Job, unit: Unit) -> np.ndarray:
    """Return the label by which a part is recognised as a unit of this job."""
    return np.array(f"{job.key} {unit.start} {unit.stop}")


def is_finished(output: Path) -> bool:
    """Whether `output` is a complete file of micrographs; False if there is no file.

    Raises:
        ResumeError: the file is empty, damaged or of another kind.
    """
    if not output.is_file():
        return False
    try:
        kind = describe(output)["kind"]
    except InputFileError as e:
        raise ResumeError(f"{e}; there are no parts to resume from: remove it and start again") from None
    if not kind.startswith("micrograph"):
        raise ResumeError(f"{output} holds a {kind}: name a file of micrographs")
    return True


class _Terminated(KeyboardInterrupt):
    """SIGTERM, e.g. at the time limit of a batch system."""


@contextmanager
def _sigterm_raises() -> Iterator[None]:
    """Let SIGTERM raise `_Terminated` in the block, as Ctrl-C raises KeyboardInterrupt."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: object) -> None:
        raise _Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before or signal.SIG_DFL)
