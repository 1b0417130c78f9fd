"""The main job: the only module that joins the stages. Everything here is also public as `helio_jax.NAME`."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from helio_jax.arrays import pitch
from helio_jax.config import SceneFile
from helio_jax.errors import SceneError
from helio_jax.evaluate.metrics import Region, Scores, Truth, evaluate_height
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.prepare.noise import add_noise
from helio_jax.reconstruct.refine import Prediction
from helio_jax.reconstruct.settings import ReconstructSettings
from helio_jax.reconstruct.solve import reconstruct_stack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.surfaces import surface_body
from helio_jax.trace.intersect import MISS, Intersector
from helio_jax.trace.masks import hidden_form_factor
from helio_jax.trace.run import first_hits, make_experiment, trace_pixels, trace_scene
from helio_jax.trace.settings import TraceSettings

SMOOTH_PIXELS = 1.5
"""Gaussian width over which the traced multiple scattering is averaged before it is subtracted [pixels]."""
LIFT_PIXELS = 0.1
"""How far off a reconstructed (noisy) surface its view of the apertures is taken [pixels]."""


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
    from pydantic import ValidationError

    try:
        return type(settings).model_validate(settings.model_dump() | changes)
    except ValidationError as e:
        problems = "; ".join(f"{'.'.join(map(str, p['loc']))}: {p['msg']}" for p in e.errors())
        raise SceneError(f"setting not accepted: {problems}") from None


def record(scene: SceneFile, stack: MicrographStack) -> MicrographStack:
    """Return the stack as the scene's experiment would record it: with counting noise, if the scene asks for it."""
    return add_noise(stack, scene.noise) if scene.noise.enabled and stack.noise == "expected" else stack


def make_predictor(
    stack: MicrographStack, n_rays: int, seed: int = 7, workers: int | None = None
) -> Callable[[np.ndarray, np.ndarray], Prediction]:
    """Return a function that traces what a surface does beyond direct single scattering.

    The surface is continued by a flat at z = 0 for one image size beyond each border. Seeds are fixed, so that
    successive predictions differ by the surface, not by noise.
    """
    instrument = stack.instrument
    grid_x, grid_y = np.meshgrid(stack.x, stack.y)
    offset = np.stack(instrument.sample_origin(grid_x.ravel(), grid_y.ravel())[:2], -1)
    size = max(np.ptp(stack.x), np.ptp(stack.y))
    reach = max(np.abs(stack.x).max(), np.abs(stack.y).max()) + size
    lift = LIFT_PIXELS * min(pitch(stack.x), pitch(stack.y))
    settings = TraceSettings(rays=max(8, n_rays // grid_x.size), branches=8, n_orders=2, seed=seed, workers=workers)

    def predict(height: np.ndarray, normals: np.ndarray) -> Prediction:
        x, y = instrument.surface_position(grid_x, grid_y, height)
        body = surface_body(x, y, height, reach, level=0.0, beam_shift=instrument.beam_shift)
        experiment = make_experiment(body, instrument, settings)
        tally = trace_pixels(experiment, grid_x.ravel(), grid_y.ravel(), workers)
        multiple = tally.probability()[0][1].reshape(-1, *height.shape)
        normal = normals.reshape(-1, 3)
        point = np.stack([x, y, height], -1).reshape(-1, 3) + lift * normal
        triangle = np.zeros(len(point), np.int32)
        hidden, _ = hidden_form_factor(experiment.intersector, instrument, point, normal, triangle, offset)
        return Prediction(
            multiple=gaussian_filter(multiple, (0, SMOOTH_PIXELS, SMOOTH_PIXELS), mode="nearest"),
            hidden=np.moveaxis(hidden.reshape(-1, *height.shape, 3), -1, 1),
        )

    return predict


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
    wanted = changes | ({"method": method} if method else {})
    chosen = _changed(settings or ReconstructSettings(), wanted)
    predict = make_predictor(one, chosen.refine.rays) if chosen.method == "refine" else None
    return reconstruct_stack(one, chosen, predict, report)


def true_height(scene: SceneFile, rec: Reconstruction) -> Truth:
    """Return the true first hit of the beam axis for every pixel of a reconstruction's raster.

    Raises:
        SceneError: the beam misses the sample in some pixel.
    """
    instrument: Instrument = scene.instrument
    grid_x, grid_y = np.meshgrid(rec.raster_x, rec.raster_y)
    hits = first_hits(Intersector(scene.build_body()), instrument, grid_x.ravel(), grid_y.ravel())
    n_missed = int(np.sum(hits.surface == MISS))
    if n_missed:
        raise SceneError(f"the beam misses the sample in {n_missed} pixels: enlarge sample.size_um or shrink the scan")
    t = scene.truth
    region = None
    height = hits.point[:, 2].reshape(grid_x.shape)
    if t.region_radius_um is not None:
        region = Region(
            center=t.region_center_um,
            radius=t.region_radius_um,
            substrate_radius=t.substrate_radius_um or 1.35 * t.region_radius_um,
            height=t.height_um or float(height.max()),
        )
    return Truth(height=height, normals=hits.normal.reshape(*grid_x.shape, 3), region=region)


def evaluate(rec: Reconstruction, truth: Truth) -> Scores:
    """Score a reconstruction against the true heights of the same rays (DATA.md, "How we score spheres")."""
    return evaluate_height(rec, truth)
