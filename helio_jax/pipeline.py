"""The main job: the only module that joins the stages. Everything here is also public as `helio_jax.NAME`."""

import json
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from helio_jax.arrays import pitch
from helio_jax.config import SceneFile, load_scene, resolved
from helio_jax.errors import SceneError
from helio_jax.evaluate.figures import panel, save_figure
from helio_jax.evaluate.metrics import Region, Scores, Truth, evaluate_height
from helio_jax.evaluate.metrics import fit_center as fit_sphere_center
from helio_jax.evaluate.report import write_report
from helio_jax.formats.hdf5 import read, write
from helio_jax.formats.safe import atomic_path
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.prepare.calibrate import CalibrateSettings, calibrate_on_border
from helio_jax.prepare.noise import add_noise
from helio_jax.reconstruct.beamframe import slopes_of_normal
from helio_jax.reconstruct.formfactor import SpotGeometry
from helio_jax.reconstruct.indirect import Radiosity
from helio_jax.reconstruct.model import Prediction
from helio_jax.reconstruct.settings import ReconstructSettings
from helio_jax.reconstruct.solve import reconstruct_stack
from helio_jax.reconstruct.visibility import hidden_form_factor, hidden_response
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.shapes import SpheresSample
from helio_jax.scene.surfaces import behind_rims, first_hit_spheres, flat_body, surface_body
from helio_jax.trace.intersect import MISS, Hits, Intersector
from helio_jax.trace.run import first_hits, make_experiment, trace_pixels, trace_scene
from helio_jax.trace.settings import TraceSettings

SUBSTRATE_RATIO = 1.35
"""Where a scene does not say: the substrate begins at this many radii of the scored region."""
SMOOTH_PIXELS = 1.0
"""Gaussian width over which the traced multiple scattering is averaged [pixels] ..."""
SMOOTH_BEND = 0.2
"""... and the difference of unit normals at which a neighbour counts less."""
_SMOOTH_RIDGE = 0.1
"""Draws the local planes to be level where few neighbours are alike, in weights of the pixel itself."""
MAX_BURIED = 0.05
"""Largest share of atoms that may start below a neighbouring facet of a reconstructed (noisy) surface."""
LIFT_PIXELS = 0.1
"""How far off a reconstructed (noisy) surface the multiply scattered atoms start [pixels]."""


def simulate(scene: SceneFile, *, progress: Callable[[int, int], None] | None = None, **trace: Any) -> MicrographStack:
    """Trace a scene's micrographs: expected counts, or analog ones with `estimator="analog"`.

    Args:
        scene: from `load_scene`.
        progress: called with (blocks done, blocks in all).
        trace: settings of table [trace] that replace the scene's, e.g. rays=2000, seed=1.

    Raises:
        SceneError: an unknown or impossible setting.
        GuardError: ray book-keeping failed.
    """
    return trace_scene(scene, _changed(scene.trace, trace), progress)


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


def make_predictor(
    stack: MicrographStack,
    n_rays: int,
    substrate_um: float | None = None,
    seed: int = 7,
    workers: int | None = None,
    multiple: Literal["traced", "radiosity"] = "traced",
) -> Callable[[np.ndarray, np.ndarray], Prediction]:
    """Return a function that predicts what a surface does beyond direct single scattering.

    Multiple scattering is traced from the given points, with their normals, or computed by radiosity, which uses
    neither `n_rays` nor `seed`; masks come from the horizon march.

    The surface is continued by a flat at z = 0 of side `substrate_um`, or for half an image size beyond each border.
    Seeds are fixed, so that successive predictions differ by the surface, not by noise.
    """
    instrument = stack.instrument
    geometry, dx, dy = SpotGeometry(instrument), pitch(stack.x), pitch(stack.y)
    size = max(np.ptp(stack.x), np.ptp(stack.y))
    border = max(np.abs(stack.x).max(), np.abs(stack.y).max())
    reach = border + 0.5 * size if substrate_um is None else max(0.5 * substrate_um, 1.001 * border)
    if multiple == "radiosity":
        scatter = Radiosity(geometry, stack.x, stack.y, 2.0 * reach)
    else:
        scatter = _make_tracer(stack, n_rays, reach, seed, workers)

    def predict(height: np.ndarray, normals: np.ndarray) -> Prediction:
        a, b, _ = slopes_of_normal(normals, instrument.beam_shift)
        about = (geometry, dx, dy)
        hidden = np.asarray(hidden_form_factor(height, a, b, *about))
        return Prediction(
            scatter(height, normals),
            hidden,
            lambda change: np.asarray(hidden_response(height, a, b, *about, change)),
        )

    return predict


def _make_tracer(
    stack: MicrographStack, n_rays: int, reach: float, seed: int, workers: int | None
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a function that traces a surface's multiple scattering; `reach`: half the side of the flat around, um."""
    instrument = stack.instrument
    grid_x, grid_y = np.meshgrid(stack.x, stack.y)
    lift = LIFT_PIXELS * min(pitch(stack.x), pitch(stack.y))
    branches = max(1, round(n_rays / grid_x.size / 8))
    settings = TraceSettings(rays=8, branches=branches, n_orders=2, seed=seed, workers=workers)

    def scatter(height: np.ndarray, normals: np.ndarray) -> np.ndarray:
        x, y = instrument.surface_position(grid_x, grid_y, height)
        sheet = behind_rims(x, y, height, normals, instrument.beam_shift)
        body = surface_body(*sheet, reach, level=0.0, beam_shift=instrument.beam_shift)
        experiment = make_experiment(body, instrument, settings)
        normal = normals.reshape(-1, 3)
        point = np.stack([x, y, height], -1).reshape(-1, 3) + lift * normal
        first = Hits.on_mesh(point, normal)
        tally = trace_pixels(experiment, grid_x.ravel(), grid_y.ravel(), workers, first=first, max_lost=MAX_BURIED)
        return smooth_along_surface(tally.probability()[0][1].reshape(-1, *height.shape), normals)

    return scatter


def smooth_along_surface(images: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return images [detector, y, x] smoothed over neighbours whose unit normals [y, x, 3] are alike.

    A plane is fitted to every pixel's neighbourhood with the weights of a joint bilateral filter: traced noise is
    averaged, the bend at a sphere's rim stays sharp, and so does the rise of multiple scattering towards it, which a
    mean over neighbours on one side would flatten. Source: weights: Petschnigg et al., ACM Trans. Graph. 23 (2004)
    664, eq. 3; local planes: Fan and Gijbels, Local Polynomial Modelling (1996), sec. 3.1.
    """
    reach = int(np.ceil(2.5 * SMOOTH_PIXELS))
    margin = ((reach, reach), (reach, reach), (0, 0))
    both = np.concatenate([np.moveaxis(images, 0, -1), normals], -1)
    around = np.pad(both, margin, mode="edge")
    ny, nx = images.shape[1:]
    matrix, right = np.zeros((ny, nx, 3, 3)), np.zeros((ny, nx, 3, len(images)))
    for i in range(-reach, reach + 1):
        for j in range(-reach, reach + 1):
            near = around[reach + i : reach + i + ny, reach + j : reach + j + nx]
            bend = ((near[..., -3:] - normals) ** 2).sum(-1) / SMOOTH_BEND**2
            weight = np.exp(-0.5 * ((i**2 + j**2) / SMOOTH_PIXELS**2 + bend))
            basis = np.array([1.0, i, j])
            matrix += weight[..., None, None] * np.outer(basis, basis)
            right += weight[..., None, None] * basis[:, None] * near[..., None, :-3]
    matrix += _SMOOTH_RIDGE * np.diag([0.0, 1.0, 1.0])
    return np.moveaxis(np.linalg.solve(matrix, right)[..., 0, :], -1, 0)


def calibrate(stack: MicrographStack, settings: CalibrateSettings | None = None) -> MicrographStack:
    """Bring a measured stack into units of the beam by its flat border (`prepare.calibrate`)."""
    flat = SpotGeometry(stack.instrument).form_factor(np.zeros(1))[:, 2, 0]
    return calibrate_on_border(stack, flat, settings or CalibrateSettings())


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
    chosen = _changed(settings or ReconstructSettings(), wanted)
    refine = chosen.refine

    def make_predict(n_rays: int) -> Callable[[np.ndarray, np.ndarray], Prediction]:
        return make_predictor(one, n_rays, refine.substrate_um, multiple=refine.multiple)

    return reconstruct_stack(one, chosen, make_predict, report)


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


def with_provenance(stack: MicrographStack, scene: SceneFile, scene_path: str | Path) -> MicrographStack:
    """Return the stack with what is needed to make it again: scene text, versions, commit, command line, time."""
    path = Path(scene_path)
    names = ("helio-jax", "numpy", "numba", "embreex", "jax", "optimistix", "trimesh")
    about = {
        "scene_file": path.name,
        "scene_text": path.read_text(encoding="utf-8"),
        "scene": resolved(scene),
        "versions": {name: package_version(name) for name in names},
        "git": git_commit(),
        "machine": {"processor": platform.machine(), "system": platform.system(), "cpus": os.cpu_count()},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    return stack.replace(provenance={**stack.provenance, **about})


def package_version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def git_commit() -> str:
    """Return the commit of the checkout that this package runs from, or "" outside one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""


def run(
    scene_path: str | Path,
    folder: str | Path | None = None,
    *,
    overrides: dict[str, Any] | None = None,
    stage: Callable[[str], Any] = lambda label: nullcontext(),
) -> RunResult:
    """Do the main job: simulate, reconstruct, score, report.

    Each file is written as soon as it is known, so that an interrupted run keeps what was finished.

    Args:
        scene_path: of the scene file.
        folder: where the files go; default helio-out/NAME.
        overrides: settings that win over the scene, dotted keys.
        stage: called with the name of each stage; a context manager that yields its progress callback.
    """
    scene = load_scene(scene_path, overrides)
    out = Path(folder) if folder else Path("helio-out") / scene.name
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise SceneError(f"output folder {out} cannot be made: {e.strerror}; choose another with -o") from None
    names = {
        "micrographs": "micrographs.h5",
        "height map": "height.h5",
        "report": "report.html",
        "scores": "scores.json",
    }
    files = {label: out / name for label, name in names.items()}
    with stage("simulating micrographs") as progress:
        stack = with_provenance(record(scene, simulate(scene, progress=progress)), scene, scene_path)
    write(stack, files["micrographs"])
    with stage("reconstructing heights") as progress:
        rec = reconstruct(stack, settings=scene.reconstruct, report=progress)
    write(rec, files["height map"])
    with stage("scoring and reporting"):
        truth = true_height(scene, rec)
        scores = evaluate(rec, truth)
        with atomic_path(files["scores"]) as part:
            part.write_text(json.dumps(scores.as_dict(), indent=1) + "\n", encoding="utf-8")
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
