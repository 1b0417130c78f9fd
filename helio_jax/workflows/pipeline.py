"""The main job: simulate, calibrate, align, reconstruct, score, report."""

import json
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from helio_jax.alignment.align import AlignSettings, align_scans
from helio_jax.arguments import checked
from helio_jax.calibration.noise import add_noise
from helio_jax.errors import GuardError, ResumeError, SceneError
from helio_jax.figures.before_after import save_before_after
from helio_jax.figures.canvas import save_figure
from helio_jax.figures.panel import panel
from helio_jax.figures.report import Measured, write_report
from helio_jax.formats.hdf5 import read_stack, write
from helio_jax.formats.parts import Parts
from helio_jax.formats.points import read_points
from helio_jax.formats.safe import atomic_path, check_outputs, files_within, make_folder
from helio_jax.inverse.mask_steps import find_steps
from helio_jax.measure.facets import Facets, find_facets
from helio_jax.micrograph import Micrographs, MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction, end_if_interrupted
from helio_jax.scores.metrics import Scores, Truth, evaluate_height
from helio_jax.trace.scan import Executor, trace_scene
from helio_jax.workflows.checkpoint import CheckpointedRun, Shard, is_finished
from helio_jax.workflows.heights import calibrate, reconstruct, reconstruct_scans
from helio_jax.workflows.provenance import with_provenance
from helio_jax.workflows.scene_file import SceneFile, files_read, load_scene
from helio_jax.workflows.shipped import locate
from helio_jax.workflows.truth import odd_height, true_height

DEFAULT_EXECUTOR = Executor()
"""Threads of this process, one per CPU."""
MAX_FACET_PIXELS = 60_000
"""Pixels of a height map whose facets a report measures unasked: 2 s."""
Stage = Callable[[str], Any]
"""Called with the name of each stage; a context manager that yields its progress callback."""
RUN_FILES = {
    "micrographs": "micrographs.h5",
    "height map": "height.h5",
    "scores": "scores.json",
    "report": "report.html",
    "panel": "report.png",
}
"""What `run` writes in its folder."""


def _silent(label: str) -> Any:
    return nullcontext()


@checked
def simulate(scene: SceneFile, *, progress: Callable[[int, int], None] | None = None, **trace: Any) -> Micrographs:
    """Trace a scene's micrographs: expected counts, or analog ones with `estimator="analog"`.

    A stack, or a set of stacks where the scan has several views (distances, rotations). Its history has the scene, so
    that `helio rerun` can repeat it.

    Args:
        scene: from `load_scene`.
        progress: called with (pixels done, pixels in all).
        trace: settings of table [trace] that replace the scene's, e.g. rays=2000, seed=1.

    Raises:
        SceneError: an unknown or impossible setting.
        GuardError: ray book-keeping failed.

    Example:
        >>> hx.simulate(hx.load_scene("sphere_a"), rays=16).counts
    """
    scene = scene.model_copy(update={"trace": scene.trace.changed(**trace)})
    return with_provenance(trace_scene(scene, scene.trace, progress), scene, "", "")


@dataclass(frozen=True)
class SimulateOptions:
    """How `simulate_file` goes about it; the counts depend on `noise` alone.

    Attributes:
        noise: add the scene's counting noise and background, if its table [noise] is enabled.
        executor: who runs the units of work.
        shard: "i/N": run the i-th of N shares only; who finishes last writes the file.
        restart: discard what an unfinished run left.
        progress: called with (pixels done, pixels in all).
        say: called with messages.
    """

    noise: bool = False
    executor: Executor = DEFAULT_EXECUTOR
    shard: str | None = None
    restart: bool = False
    progress: Callable[[int, int], None] | None = None
    say: Callable[[str], None] = lambda text: None


def simulate_file(
    scene_path: str | Path,
    output: str | Path,
    *,
    overrides: dict[str, Any] | None = None,
    options: SimulateOptions = SimulateOptions(),
    verb: str = "simulate",
) -> Micrographs | None:
    """Trace a scene's micrographs into a file; finished units are kept in OUTPUT.parts until it is written.

    Where such parts are found, the run goes on from there.

    Args:
        scene_path: of the scene file, or the name of a shipped one.
        output: of the HDF5 file.
        overrides: settings that win over the scene, dotted keys.
        options: noise, workers, shards.
        verb: the command that `resume` gives again: "simulate", or "run" where that is what was asked for.

    Returns:
        The micrographs; None where other shards are still missing.

    Raises:
        ResumeError: the parts found are of another scene, surface, seed or version.
        InterruptedRun, StoppedRun: Ctrl-C, SIGTERM or lost workers; the message says how to go on.
        GuardError: ray book-keeping failed.
    """
    o, overrides, scene_path = options, overrides or {}, locate(scene_path)
    check_outputs(files_read(scene_path, "the scene", overrides), [("output", Path(output))])
    scene = load_scene(scene_path, overrides)
    parts = Parts(Path(output))
    shard = Shard.parse(o.shard) if o.shard else None
    command = {
        "verb": verb,
        "scene": str(scene_path.resolve()),
        "overrides": overrides,
        "noise": o.noise,
        "executor": asdict(o.executor),
    }
    checkpointed_run = CheckpointedRun(parts, command, o.executor, shard, o.restart, o.say)
    stack = checkpointed_run.trace(scene, scene.trace, o.progress)
    if stack is None:
        return None
    stack = with_provenance(record(scene, stack) if o.noise else stack, scene, scene_path)
    parts.finish(lambda path: write(stack, path))
    return stack


def resume(path: str | Path, *, stage: Stage = _silent, say: Callable[[str], None] = print) -> list[Path]:
    """Go on with an unfinished simulation (`path`: its file) or run (its folder); return the files written.

    Raises:
        ResumeError: there is nothing to go on with, or something changed since.
    """
    path = Path(path)
    output = path / "micrographs.h5" if path.is_dir() else path
    parts = Parts(output)
    if not parts.exist:
        if is_finished(output):
            parts.remove()  # a process was killed while it cleaned up
            say(f"{output} is complete: nothing to resume")
            return []
        raise ResumeError(f"there is no unfinished run of {output}: {parts.folder} does not exist; start it anew")
    try:
        c = parts.manifest()["command"]
        scene, executor = Path(c["scene"]), Executor(**c["executor"])
        is_run, overrides, noise = c["verb"] == "run", dict(c["overrides"]), bool(c["noise"])
    except (KeyError, TypeError, ValueError) as e:
        raise ResumeError(f"{parts.folder}/manifest.json is damaged ({e!r}): remove the folder, start anew") from None
    if not scene.is_file():
        raise ResumeError(f"the scene {scene} of {parts.folder} is gone: put it back, or remove the folder")
    if is_run:
        result = run(scene, output.parent, overrides=overrides, stage=stage, executor=executor, say=say)
        end_if_interrupted(result.status)
        return list(result.files.values())
    with stage("tracing") as progress:
        options = SimulateOptions(noise=noise, executor=executor, progress=progress, say=say)
        simulate_file(scene, output, overrides=overrides, options=options)
    return [output]


@checked
def record(scene: SceneFile, stack: Micrographs) -> Micrographs:
    """Return micrographs as the scene's experiment would record them: with counting noise, if the scene asks for it.

    Every view has noise of its own.
    """
    if isinstance(stack, MicrographSet):
        noise = (scene.noise.model_copy(update={"seed": scene.noise.seed + i}) for i in range(len(stack.stacks)))
        views = zip(stack.stacks, noise, strict=True)
        seen = (add_noise(s, n) if n.enabled and s.noise == "expected" else s for s, n in views)
        return replace(stack, stacks=tuple(seen))
    return add_noise(stack, scene.noise) if scene.noise.enabled and stack.noise == "expected" else stack


def calibrate_file(path: str | Path, output: str | Path, **changes: Any) -> MicrographStack:
    """Calibrate the stack of a file into another one, and save a picture of before and after beside it (.png)."""
    picture = Path(output).with_suffix(".png")
    check_outputs([("path", Path(path))], [("output", Path(output)), ("output: the .png beside it", picture)])
    before = read_stack(path)
    after = calibrate(before, **changes)
    write(after, output)
    save_before_after(before, after, picture)
    return after


def align(
    scans: MicrographSet, points: str | Path | None = None, **changes: Any
) -> tuple[MicrographStack, dict[str, tuple[float, float]]]:
    """Align scans of a rotated sample, by control points (a CSV file) or automatically.

    Returns:
        One stack, and the places of the control points in its frame [um] (empty without them).
    """
    picks = read_points(points) if points is not None else None
    stack, found = align_scans(scans, picks, AlignSettings().changed(**changes), str(points or ""))
    return stack, {} if found.points is None else found.points.places


@checked
def evaluate(rec: Reconstruction, truth: Truth) -> Scores:
    """Score a reconstruction against the true heights of the same rays (docs/results.md).

    Example:
        >>> hx.evaluate(rec, hx.true_height(scene, rec)).recovered_height
    """
    return evaluate_height(rec, truth)


def write_report_files(
    path: str | Path,
    stack: MicrographStack | None,
    rec: Reconstruction,
    truth: Truth | None,
    scores: Scores | None,
    *,
    title: str,
    panel_path: str | Path | None = None,
    with_steps: bool = False,
) -> Path:
    """Write the HTML report and the panel; return the panel's path.

    Args:
        path: of the report.
        stack, rec, truth, scores, title: as in `write_report`.
        panel_path: of the panel (.png, .pdf, .svg); default: a PNG beside the report.
        with_steps: also measure steps on the micrographs, which takes 10 to 40 s.
    """
    path = Path(path)
    panel_path = Path(panel_path) if panel_path else path.with_suffix(".png")
    save_figure(panel(stack, rec, truth, scores), panel_path)
    measured = Measured(_facets_of(rec), _steps_of(stack, with_steps))
    write_report(path, stack, rec, truth, scores, measured=measured, title=title)
    return panel_path


def default_folder(scene: SceneFile) -> Path:
    """Return where `run` writes if no folder is named."""
    return Path("helio-out") / scene.name


def _facets_of(rec: Reconstruction) -> Facets | str:
    """Find the facets for a report, or say why there are none."""
    if rec.height.size > MAX_FACET_PIXELS:
        return f"rasters of more than {MAX_FACET_PIXELS} pixels are measured on demand: helio measure --facets"
    try:
        return find_facets(rec)
    except GuardError as e:
        return str(e)


def _steps_of(stack: MicrographStack | None, is_wanted: bool) -> dict[str, Any] | str:
    """Find the steps for a report, or say why there are none."""
    if not is_wanted or stack is None:
        return "measured on demand in 10 to 40 s: helio report --stack FILE.h5 --steps"
    try:
        return find_steps(stack).as_dict()
    except SceneError as e:
        return str(e)


@dataclass(frozen=True)
class RunResult:
    """What `run` made: scores, and where the files are."""

    name: str
    method: str
    status: str
    trust: dict[str, Any]
    scores: Scores
    files: dict[str, Path]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible summary."""
        files = {key: str(path) for key, path in self.files.items()}
        return {
            "name": self.name,
            "method": self.method,
            "status": self.status,
            "trust": self.trust,
            **self.scores.as_dict(),
            "files": files,
        }


def _check_heights(scene: SceneFile, path: str | Path) -> None:
    """Refuse a scan from which no heights can be made."""
    scan = scene.scan
    if scan.kind != "raster" or len(scan.sample_distances_um) > 1:
        raise SceneError(
            f"{path}: heights come from rasters at one distance, scan.kind is {scan.kind!r} with "
            f"{max(1, len(scan.sample_distances_um))} distance(s): use helio simulate, which writes any scan"
        )
    if len(scan.rotations_deg) > 1 and (scan.rotate != "sample" or scan.about != "normal" or any(scan.axis_um)):
        raise SceneError(
            f"{path}: heights of several views need a sample that rotates about the plate normal at the raster's "
            'origin: set scan.rotate = "sample", scan.about = "normal", scan.axis_um = [0, 0], or use helio simulate'
        )


def run(
    scene_path: str | Path,
    folder: str | Path | None = None,
    *,
    overrides: dict[str, Any] | None = None,
    stage: Stage = _silent,
    executor: Executor = DEFAULT_EXECUTOR,
    restart: bool = False,
    report: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> RunResult:
    """Do the main job: simulate, reconstruct, score, report.

    Each file is written as soon as it is known, so that an interrupted run keeps what was finished.

    Args:
        scene_path: of the scene file, or the name of a shipped one.
        folder: where the files go; default helio-out/NAME.
        overrides: settings that win over the scene, dotted keys.
        stage: called with the name of each stage; a context manager that yields its progress callback.
        executor: who traces.
        restart: discard what an unfinished run left in the folder.
        report: write the HTML report and the PNG panel, too.
        say: called with messages.

    Raises:
        ResumeError: the folder holds an unfinished run of something else.
        InterruptedRun, StoppedRun: stopped while tracing; what was finished is kept.

    Example:
        >>> hx.run("sphere_a", "out", overrides={"scan.nx": 61}).scores
    """
    scene = load_scene(scene_path, overrides)
    _check_heights(scene, scene_path)
    scene.apertures()  # heights need them: an error before anything is traced
    out = Path(folder) if folder else default_folder(scene)
    names = {label: name for label, name in RUN_FILES.items() if report or label not in ("report", "panel")}
    check_outputs(files_read(scene_path, "the scene", overrides), files_within("-o", out, names.values()))
    files = {label: out / name for label, name in names.items()}
    make_folder(out)
    with stage("simulating micrographs") as progress:
        options = SimulateOptions(noise=True, executor=executor, restart=restart, progress=progress, say=say)
        stack = simulate_file(scene_path, files["micrographs"], overrides=overrides, options=options, verb="run")
    assert stack is not None  # no shards here
    with stage("reconstructing heights") as progress:
        how: dict[str, Any] = {"settings": scene.reconstruct, "report": progress, "workers": executor.workers}
        if isinstance(stack, MicrographSet):
            rec, joined = reconstruct_scans(stack, **how)
            stack = joined.stack
        else:
            rec = reconstruct(stack, **how)
    write(rec, files["height map"])
    with stage("scoring and reporting"):
        truth = true_height(scene, rec)
        if odd := odd_height(truth):
            say(f"warning: {odd}")
        scores = evaluate(rec, truth)
        with atomic_path(files["scores"]) as part:
            part.write_text(json.dumps(scores.as_dict(), indent=1) + "\n", encoding="utf-8")
        if report:
            title = f"{scene.name}: simulated, reconstructed, scored"
            write_report_files(files["report"], stack, rec, truth, scores, title=title)
    return RunResult(scene.name, rec.method, rec.status, rec.trust, scores, files)
