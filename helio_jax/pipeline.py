"""The main job: the only module that joins the stages. Everything here is also public as `helio_jax.NAME`."""

import json
import math
import os
import platform
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from helio_jax.checkpoint import Keeper, Shard
from helio_jax.config import SceneFile, load_scene
from helio_jax.errors import ResumeError, SceneError
from helio_jax.evaluate.before_after import save_before_after
from helio_jax.evaluate.figures import panel, save_figure
from helio_jax.evaluate.metrics import Region, Scores, Truth, evaluate_height
from helio_jax.evaluate.metrics import fit_center as fit_sphere_center
from helio_jax.evaluate.report import write_report
from helio_jax.formats.hdf5 import read, write
from helio_jax.formats.parts import Parts
from helio_jax.formats.safe import atomic_path
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.predict import make_predictor
from helio_jax.prepare.calibrate import CalibrateSettings, calibrate_on_border
from helio_jax.prepare.noise import add_noise
from helio_jax.provenance import package_version, with_provenance
from helio_jax.reconstruct.formfactor import SpotGeometry
from helio_jax.reconstruct.model import Prediction
from helio_jax.reconstruct.settings import ReconstructSettings
from helio_jax.reconstruct.solve import reconstruct_stack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.shapes import SpheresSample
from helio_jax.scene.surfaces import first_hit_spheres, flat_body
from helio_jax.trace.intersect import MISS, Intersector
from helio_jax.trace.run import first_hits, make_experiment, trace_pixels
from helio_jax.trace.scan import Crew, trace_scene
from helio_jax.trace.settings import TraceSettings

DEFAULT_CREW = Crew()
"""Threads of this process, one per CPU."""
Stage = Callable[[str], Any]
"""Called with the name of each stage; a context manager that yields its progress callback."""
SUBSTRATE_RATIO = 1.35
"""Where a scene does not say: the substrate begins at this many radii of the scored region."""


def _silent(label: str) -> Any:
    return nullcontext()


def simulate(scene: SceneFile, *, progress: Callable[[int, int], None] | None = None, **trace: Any) -> MicrographStack:
    """Trace a scene's micrographs: expected counts, or analog ones with `estimator="analog"`.

    Args:
        scene: from `load_scene`.
        progress: called with (pixels done, pixels in all).
        trace: settings of table [trace] that replace the scene's, e.g. rays=2000, seed=1.

    Raises:
        SceneError: an unknown or impossible setting.
        GuardError: ray book-keeping failed.
    """
    return trace_scene(scene, _changed(scene.trace, trace), progress)


@dataclass(frozen=True)
class SimulateOptions:
    """How `simulate_file` goes about it; the counts depend on `noise` alone.

    Attributes:
        noise: add the scene's counting noise and background, if its table [noise] is enabled.
        crew: who runs the units of work.
        shard: "i/N": run the i-th of N shares only; who finishes last writes the file.
        restart: discard what an unfinished run left.
        progress: called with (pixels done, pixels in all).
        say: called with messages.
    """

    noise: bool = False
    crew: Crew = DEFAULT_CREW
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
) -> MicrographStack | None:
    """Trace a scene's micrographs into a file; finished units are kept in OUTPUT.parts until it is written.

    Where such parts are found, the run goes on from there.

    Args:
        scene_path: of the scene file.
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
    o, overrides = options, overrides or {}
    scene = load_scene(scene_path, overrides)
    parts = Parts(Path(output))
    shard = Shard.parse(o.shard) if o.shard else None
    command = {
        "verb": verb,
        "scene": str(Path(scene_path).resolve()),
        "overrides": overrides,
        "noise": o.noise,
        "crew": asdict(o.crew),
    }
    keeper = Keeper(parts, command, o.crew, shard, o.restart, o.say)
    stack = keeper.trace(scene, scene.trace, o.progress)
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
        if output.is_file():
            parts.remove()  # what is left when a process is killed while it cleans up
            say(f"{output} is complete: nothing to resume")
            return []
        raise ResumeError(f"there is no unfinished run of {output}: {parts.folder} does not exist; start it anew")
    try:
        c = parts.manifest()["command"]
        scene, crew = Path(c["scene"]), Crew(**c["crew"])
        is_run, overrides, noise = c["verb"] == "run", dict(c["overrides"]), bool(c["noise"])
    except (KeyError, TypeError, ValueError) as e:
        raise ResumeError(f"{parts.folder}/manifest.json is damaged ({e!r}): remove the folder, start anew") from None
    if not scene.is_file():
        raise ResumeError(f"the scene {scene} of {parts.folder} is gone: put it back, or remove the folder")
    if is_run:
        return list(run(scene, output.parent, overrides=overrides, stage=stage, crew=crew, say=say).files.values())
    with stage("tracing") as progress:
        options = SimulateOptions(noise=noise, crew=crew, progress=progress, say=say)
        simulate_file(scene, output, overrides=overrides, options=options)
    return [output]


def _changed(settings, changes: dict[str, Any]):
    """Return settings with some values replaced, checked again."""
    try:
        return type(settings).model_validate(settings.model_dump() | changes)
    except ValidationError as e:
        problems = "; ".join(f"{'.'.join(map(str, p['loc']))}: {p['msg']}" for p in e.errors())
        raise SceneError(f"setting not accepted: {problems}") from None


def record(scene: SceneFile, stack: MicrographStack) -> MicrographStack:
    """Return the stack as the scene's experiment would record it: with counting noise, if the scene asks for it."""
    return add_noise(stack, scene.noise) if scene.noise.enabled and stack.noise == "expected" else stack


def calibrate(stack: MicrographStack, settings: CalibrateSettings | None = None, **changes: Any) -> MicrographStack:
    """Bring a measured stack into units of the beam by its flat border (`prepare.calibrate`).

    Args:
        stack: measured counts.
        settings: table [calibrate]; default: its defaults.
        changes: settings that replace those, e.g. drift=False.

    Raises:
        SceneError: the stack is calibrated already, or its beam is known (simulated).
        GuardError: a detector has no signal.
    """
    if stack.n_rays is not None:
        raise SceneError(
            f"{stack.name}: this stack is in units of a known beam ({stack.n_rays:g} atoms): it is simulated or "
            "calibrated already; calibrate the imported file itself"
        )
    flat = SpotGeometry(stack.instrument).form_factor(np.zeros(1))[:, 2, 0]
    return calibrate_on_border(stack, flat, _changed(settings or CalibrateSettings(), changes))


def calibrate_file(path: str | Path, output: str | Path, **changes: Any) -> MicrographStack:
    """Calibrate the stack of a file into another one, with a picture of before and after beside it (.png)."""
    found = read(path)
    if isinstance(found, Reconstruction):
        raise SceneError(f"{path} holds a height map: give the file of its micrographs")
    before = found.only() if isinstance(found, MicrographSet) else found
    after = calibrate(before, **changes)
    write(after, output)
    save_before_after(before, after, Path(output).with_suffix(".png"))
    return after


def _with_priors(settings: ReconstructSettings, stack: MicrographStack, changes: dict[str, Any]) -> dict[str, Any]:
    """Return changes of the settings, those added that the stack's calibration asks for and nobody has given."""
    given = dict(changes.get("refine", {}))
    priors = stack.provenance.get("calibrate", {}).get("priors", {})
    asked = {key: value for key, value in priors.items() if key not in settings.refine.model_fields_set}
    if not asked and not given:
        return changes
    return changes | {"refine": settings.refine.model_dump() | asked | given}


def reconstruct(
    stack: MicrographStack | MicrographSet,
    method: str | None = None,
    *,
    settings: ReconstructSettings | None = None,
    report: Callable[[int, int, str], None] | None = None,
    **changes: Any,
) -> Reconstruction:
    """Turn micrographs into heights.

    Args:
        stack: three or more images on one raster.
        method: "linear", "nearfield" or "refine"; default: the settings' own.
        settings: table [reconstruct]; default: its defaults.
        report: called before each round of the refinement with (round, rounds, what is known).
        changes: settings that replace those, e.g. integrator="dct_poisson".

    Raises:
        GuardError: too few images.
        InputFileError: a set of several scans, which must be aligned first.
    """
    one = stack.only() if isinstance(stack, MicrographSet) else stack
    if one.noise == "measured" and one.n_rays is None:
        one = calibrate(one)
    wanted = changes | ({"method": method} if method else {})
    settings = settings or ReconstructSettings()
    chosen = _changed(settings, _with_priors(settings, one, wanted))
    refine = chosen.refine

    def make_predict(n_rays: int) -> Callable[[np.ndarray, np.ndarray], Prediction]:
        return make_predictor(one, n_rays, refine.substrate_um, multiple=refine.multiple)

    rec = reconstruct_stack(one, chosen, make_predict, report)
    others = [f"{name} ({kind})" for name, kind in one.provenance.get("materials", {}).items() if kind != "cosine"]
    if not others:
        return rec
    return replace(rec, status=f"{rec.status}; NOT the cosine law, which heights assume, holds for {', '.join(others)}")


def true_height(scene: SceneFile, rec: Reconstruction) -> Truth:
    """Return the true first hit of the beam axis for every pixel of a reconstruction's raster.

    Raises:
        SceneError: the beam misses the sample in some pixel.
    """
    grid_x, grid_y = np.meshgrid(rec.raster_x, rec.raster_y)
    hits = first_hits(Intersector(scene.build_body()), scene.instrument, grid_x.ravel(), grid_y.ravel())
    n_missed = int(np.sum(hits.surface == MISS))
    if n_missed:
        raise SceneError(f"the beam misses the sample in {n_missed} pixels: enlarge sample.size_um or shrink the scan")
    height = hits.point[:, 2].reshape(grid_x.shape)
    return Truth(height, hits.normal.reshape(*grid_x.shape, 3), _region(scene, float(height.max())))


def _region(scene: SceneFile, top: float) -> Region | None:
    """Return the scored region of a scene's table [truth], or None where it names none."""
    t = scene.truth
    if t.region_radius_um is None:
        return None
    return Region(
        center=t.region_center_um,
        radius=t.region_radius_um,
        substrate_radius=t.substrate_radius_um or SUBSTRATE_RATIO * t.region_radius_um,
        height=t.height_um or top,
    )


def load_truth(path: str | Path, rec: Reconstruction, *, fit_center: bool = False) -> Truth:
    """Return the truth of a scene file, or of another reconstruction on the same raster.

    Args:
        path: scene (.toml) or height map (.h5).
        rec: what will be scored.
        fit_center: for a scene of one sphere: fit its position first, as for measured data (DATA.md).

    Raises:
        SceneError: `fit_center` without a scene of one sphere and a scored region.
    """
    if Path(path).suffix == ".h5":
        other = read(path)
        if not isinstance(other, Reconstruction):
            raise SceneError(f"{path}: the truth must be a scene or a height map, got {type(other).__name__}")
        return Truth(other.height, other.normals)
    scene = load_scene(path)
    return _fitted_truth(path, scene, rec) if fit_center else true_height(scene, rec)


def _fitted_truth(path: str | Path, scene: SceneFile, rec: Reconstruction) -> Truth:
    """Return the truth of a scene's sphere, moved to where it fits the reconstruction best."""
    sample, region = scene.sample, _region(scene, 0.0)
    if not isinstance(sample, SpheresSample) or len(sample.spheres) != 1 or region is None:
        raise SceneError(f"{path}: fitting a centre needs a scene with one sphere and truth.region_radius_um")
    grid_x, grid_y = np.meshgrid(rec.raster_x, rec.raster_y)
    (_, _, z, radius), shift = sample.sphere_array[0], rec.instrument.beam_shift

    def sphere_at(x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
        return first_hit_spheres(grid_x, grid_y, np.array([[x, y, z, radius]]), shift)

    found = fit_sphere_center(rec, lambda x, y: sphere_at(x, y)[0], region)
    return Truth(*sphere_at(*found.center), found)


def evaluate(rec: Reconstruction, truth: Truth) -> Scores:
    """Score a reconstruction against the true heights of the same rays (DATA.md, "How we score spheres")."""
    return evaluate_height(rec, truth)


def write_report_files(
    path: str | Path,
    stack: MicrographStack | None,
    rec: Reconstruction,
    truth: Truth | None,
    scores: Scores | None,
    *,
    title: str,
) -> Path:
    """Write the HTML report and the PNG panel beside it; return the panel's path."""
    path = Path(path)
    panel_path = path.with_suffix(".png")
    save_figure(panel(stack, rec, truth, scores), panel_path)
    write_report(path, stack, rec, truth, scores, panel_png=panel_path, title=title)
    return panel_path


@dataclass(frozen=True)
class RunResult:
    """What `run` made: scores, and where the files are."""

    name: str
    method: str
    status: str
    scores: Scores
    files: dict[str, Path]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible summary."""
        files = {key: str(path) for key, path in self.files.items()}
        return {
            "name": self.name,
            "method": self.method,
            "status": self.status,
            **self.scores.as_dict(),
            "files": files,
        }


def run(
    scene_path: str | Path,
    folder: str | Path | None = None,
    *,
    overrides: dict[str, Any] | None = None,
    stage: Stage = _silent,
    crew: Crew = DEFAULT_CREW,
    restart: bool = False,
    report: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> RunResult:
    """Do the main job: simulate, reconstruct, score, report.

    Each file is written as soon as it is known, so that an interrupted run keeps what was finished.

    Args:
        scene_path: of the scene file.
        folder: where the files go; default helio-out/NAME.
        overrides: settings that win over the scene, dotted keys.
        stage: called with the name of each stage; a context manager that yields its progress callback.
        crew: who traces.
        restart: discard what an unfinished run left in the folder.
        report: write the HTML report and the PNG panel, too.
        say: called with messages.

    Raises:
        ResumeError: the folder holds an unfinished run of something else.
        InterruptedRun, StoppedRun: stopped while tracing; what was finished is kept.
    """
    scene = load_scene(scene_path, overrides)
    out = Path(folder) if folder else Path("helio-out") / scene.name
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise SceneError(f"output folder {out} cannot be made: {e.strerror}; choose another with -o") from None
    names = {"micrographs": "micrographs.h5", "height map": "height.h5", "scores": "scores.json"}
    names |= {"report": "report.html"} if report else {}
    files = {label: out / name for label, name in names.items()}
    with stage("simulating micrographs") as progress:
        options = SimulateOptions(noise=True, crew=crew, restart=restart, progress=progress, say=say)
        stack = simulate_file(scene_path, files["micrographs"], overrides=overrides, options=options, verb="run")
    assert stack is not None  # no shards here
    with stage("reconstructing heights") as progress:
        rec = reconstruct(stack, settings=scene.reconstruct, report=progress)
    write(rec, files["height map"])
    with stage("scoring and reporting"):
        truth = true_height(scene, rec)
        scores = evaluate(rec, truth)
        with atomic_path(files["scores"]) as part:
            part.write_text(json.dumps(scores.as_dict(), indent=1) + "\n", encoding="utf-8")
        if report:
            title = f"{scene.name}: simulated, reconstructed, scored"
            files["panel"] = write_report_files(files["report"], stack, rec, truth, scores, title=title)
    return RunResult(scene.name, rec.method, rec.status, scores, files)


def diagnose() -> dict[str, Any]:
    """Return versions and the outcome of a small trace, for `helio doctor`; `ok` says whether all is well."""
    import jax

    names = ("helio-jax", "numpy", "scipy", "numba", "embreex", "jax", "optimistix", "trimesh", "h5py", "plotly")
    found: dict[str, Any] = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    found |= {name: package_version(name) for name in names}
    found |= {"cpus": os.cpu_count(), "jax devices": ", ".join(str(d) for d in jax.devices())}
    intersector = Intersector(flat_body(2000.0))
    found["ray engine"] = "embree" if intersector.has_embree else "exhaustive (slow: embreex is not installed)"
    detector = Detector(name="test", polar_deg=45.0, half_angle_deg=10.0)
    instrument = Instrument(plate=Plate(working_distance_um=4000.0), detector=(detector,))
    experiment = make_experiment(flat_body(2000.0), instrument, TraceSettings(rays=8, n_orders=1))
    traced = float(trace_pixels(experiment, np.zeros(1), np.zeros(1)).total()[0][0, 0])
    exact = math.sin(math.radians(10.0)) ** 2 * math.cos(math.radians(45.0))
    found["small trace"] = f"P = {traced:.9f}, closed form {exact:.9f}"
    found["ok"] = bool(abs(traced / exact - 1.0) < 1e-4)
    return found
