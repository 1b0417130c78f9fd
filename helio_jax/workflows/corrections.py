"""What a surface does beyond direct single scattering, for the fit: the tracer and the horizon march joined.

`make_predictor` gives the callable that `reconstruct` asks for. Masks come from the horizon march, which takes what
lies behind a rim for a sheet along the beam; where the surface has walls they come from rays to its mesh, for the march
makes stairs of walls. Multiple scattering is traced (or computed by radiosity).

Where the hidden side stands is one unknown of the fit: both terms are predicted at two places of it (`HiddenSide`).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Literal

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.errors import SceneError
from helio_jax.forward.laws import Law, numbers_by_law
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.radiosity import plan_radiosity
from helio_jax.forward.render import Corrections, masking_corrections, radiosity_corrections, single_scattering
from helio_jax.forward.surface import Surface, slopes_of_normal
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack
from helio_jax.scene.scattering import COSINE_LAW
from helio_jax.trace.denoise import passes_for
from helio_jax.trace.guided import LEAST_PER_PIXEL
from helio_jax.workflows.surface_hypotheses import LIMB, ScanRaster

DEGREE: Literal[1, 2] = 2
"""Degree of the polynomials that smooth the traced image."""
SMOOTH_PATHS = 40
"""The traced image is averaged over neighbours until this many plain paths count in every pixel."""
MAX_BURIED = {"horizon": 0.05, "rays": 0.3}
"""Largest share of atoms that may start below a neighbouring facet of a reconstructed (noisy) surface: for a fit, and
for the test of a result, which is to be traced even where it is bad."""


def make_predictor(
    stack: MicrographStack,
    n_rays: int,
    substrate_um: float | None = None,
    seed: int = 7,
    workers: int | None = None,
    multiple: Literal["traced", "radiosity"] = "traced",
    border: Literal["flat", "free"] = "flat",
    masks_by: Literal["horizon", "rays"] = "horizon",
) -> Callable[..., Corrections]:
    """Return a function that predicts masks and multiple scattering of a surface, by the stack's or another instrument.

    Multiple scattering is traced from the given points, with their normals, or computed by radiosity, which uses
    neither `n_rays` nor `seed` and knows of the occluded side only the sheet along the beam.

    The surface is continued to a square of side `substrate_um`, or as far beyond each border as `_surroundings` says:
    with a `flat` border by the flat z = 0, tilted if a prediction is given its slopes (in radiosity never); with a
    `free` one in both ways of `scene/border.py` (in radiosity by the flat, too). Their mean is expected, and half their
    difference is one more unknown of the fit. `masks_by` rays, all masks are traced on the mesh, for a test of the
    result; a fit computes them by the horizon march, but shares those of the mesh where the surface has walls.

    Seeds are fixed, so that predictions on nearly the same surface have nearly the same noise. All of the sample
    scatters by the law that a prediction is given; a scattering plate is part of what is traced, by the cosine law.
    Radiosity knows the cosine law only.

    Images of several beams are predicted beam by beam on the same surface, with masks by rays.

    Raises:
        SceneError: radiosity is asked for below a scattering plate or for several beams, which it does not know.
    """
    if stack.instrument.has_several_beams:
        masks_by = "rays"
    if multiple == "radiosity" and stack.instrument.plate.is_scattering:
        raise SceneError(
            "reconstruct.refine.multiple = 'radiosity': it knows nothing of what a scattering plate sends back: "
            "set it to 'traced'"
        )
    dx, dy = pitch(stack.x), pitch(stack.y)
    half = max(np.abs(stack.x).max(), np.abs(stack.y).max())
    n_beams = len(stack.instrument.by_beam())

    @lru_cache(maxsize=1)
    def prepared(given: str) -> tuple[Optics, list[tuple[ScanRaster, list[int]]]]:
        instrument = Instrument.model_validate_json(given).idealised()
        reach = half + _surroundings(instrument)
        if substrate_um is not None:
            reach = max(0.5 * substrate_um, half + 2.0 * max(dx, dy))
        about = *np.meshgrid(stack.x, stack.y), reach, border == "flat"
        rasters = [(ScanRaster(i, instrument.beam_shift, *about), list(of_beam)) for i, of_beam in instrument.by_beam()]
        return Optics.of(instrument), rasters

    def predict(
        height: np.ndarray,
        normals: np.ndarray,
        instrument: Instrument = stack.instrument,
        *,
        albedo: np.ndarray | None = None,
        law: Law | None = None,
        tilt: tuple[float, float] = (0.0, 0.0),
    ) -> Corrections:
        optics, rasters = prepared(instrument.model_dump_json())
        rasters = [(replace(raster, tilt=tilt), of_beam) for raster, of_beam in rasters]
        surface = Surface(height, *slopes_of_normal(normals, instrument.beam_shift)[:2])
        if multiple == "radiosity":
            plan = plan_radiosity(height, normals, optics, Raster.of(stack), substrate_um=2.0 * rasters[0][0].reach)
            found = radiosity_corrections(surface, optics, Raster.of(stack), plan)
            return found if albedo is None else Corrections(found.masked, _mean(albedo) * found.multiple)
        smooth = rasters[0][0].denoised(height, normals)
        found = [trace_beam(raster, *smooth, surface, normals, optics, albedo, law) for raster, _ in rasters]
        return found[0] if len(found) == 1 else _joined(found, [of_beam for _, of_beam in rasters])

    def trace_beam(
        raster: ScanRaster,
        smooth: np.ndarray,
        smooth_normals: np.ndarray,
        surface: Surface,
        normals: np.ndarray,
        optics: Optics,
        albedo: np.ndarray | None,
        law: Law | None,
    ) -> Corrections:
        """Trace the images of one beam; arguments as those of `predict`, and the denoised heights and normals."""
        height = surface.height
        hidden = raster.hidden_side(smooth, smooth_normals)
        either_way = [raster.sides(smooth, smooth_normals, hidden, way) for way in raster.continuations]
        sides, n_traced = either_way[0], n_beams * len(either_way) * len(either_way[0])
        n_paths = round(n_rays / n_traced)
        passes, limit = (
            passes_for(max(n_paths / height.size, LEAST_PER_PIXEL), SMOOTH_PATHS, DEGREE),
            MAX_BURIED[masks_by],
        )
        terms = COSINE_LAW if law is None else law.terms()
        multiple = [[s.multiple(n_paths, seed, limit, albedo, terms, workers) for s in way] for way in either_way]
        images = np.array(
            [[raster.smoothed(m, smooth, smooth_normals, passes, degree=DEGREE) for m in way] for way in multiple]
        )
        images = np.maximum(images, 0.0)  # a polynomial falls below 0 beside a steep fall to it
        expected = np.array(hidden.shares if len(sides) > 1 else (1.0,))
        traced, surroundings = images.mean(0), None
        if len(images) > 1:
            surroundings = 0.5 * np.tensordot(expected, images[1] - images[0], 1)
        if masks_by == "rays":
            masked = [side.masked(np.ones(height.shape, bool)) for side in sides]
        else:
            by_march = masking_corrections(surface, optics, Raster.of(stack)).masked
            is_masked = np.any(by_march != 0.0, axis=(0, 1))
            if sides[0].has_walls:
                masked = [side.masked(is_masked) for side in sides]
            elif len(sides) == 1:
                masked = [by_march]
            else:
                sheet = raster.side(smooth, smooth_normals, LIMB, 0.0).masked(is_masked)
                masked = [by_march + side.masked(is_masked) - sheet for side in sides]
        occluded = None
        if len(sides) > 1:
            normal = np.moveaxis(normals, -1, 0)
            single = [numbers_by_law(law, single_scattering(f, normal), optics, height, normal) for f in masked]
            either = [m - s for m, s in zip(traced, single, strict=True)]
            occluded = hidden.deviation * np.subtract(*either)
        masks, found = (np.tensordot(expected, np.array(of_sides), 1) for of_sides in (masked, traced))
        return Corrections(masks, found, occluded, smooth_normals, surroundings)

    return predict


def _joined(parts: list[Corrections], detectors: list[list[int]]) -> Corrections:
    """Join the corrections of several beams on one surface, whose detectors these are.

    What one beam predicts (`occluded`, `surroundings`) and another does not is 0 for the other.
    """
    order = np.argsort(np.concatenate(detectors))

    def joined(images: list[np.ndarray | None]) -> np.ndarray | None:
        if all(image is None for image in images):
            return None
        filled = [np.zeros_like(p.multiple) if i is None else i for i, p in zip(images, parts, strict=True)]
        return np.concatenate(filled)[order]

    names = "masked", "multiple", "occluded", "surroundings"
    found = {name: joined([getattr(part, name) for part in parts]) for name in names}
    return Corrections(normals=parts[0].normals, **found)


def _mean(albedo: np.ndarray) -> float:
    """Compute the mean albedo of what scatters again, for radiosity, which knows no other."""
    return float(np.mean(np.minimum(albedo, 1.0)))


def _surroundings(instrument: Instrument) -> float:
    """Compute how far beyond the image the substrate scatters into the detectors [um].

    A steep facet sees little of the distant substrate, but the substrate below the outermost aperture, which it faces,
    scatters strongly towards it: the substrate must extend beyond that by the plate's distance. Of the multiple
    scattering of 55 degree flanks below an aperture at 46 degrees, below 0.2 % come from farther out; 4.5 % are missing
    without that margin (tests/physics).
    """
    outermost = max(math.hypot(*a.center) + max(a.semi_axes) for a in instrument.apertures())
    return outermost + instrument.sample_distance
