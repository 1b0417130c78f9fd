"""What a surface does beyond direct single scattering, for the fit: the tracer and the horizon march joined.

`make_predictor` gives the callable that `reconstruct` asks for. Masks come from the horizon march, which takes what
lies behind a rim for a sheet along the beam; where the surface has walls they come from rays to its mesh, for the march
makes stairs of walls. Multiple scattering is traced (or computed by radiosity).

Where the hidden side stands is one unknown of the fit: both terms are predicted at two places of it (`HiddenSide`).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np

from helio_jax.arrays import pitch, substrate_level
from helio_jax.errors import GuardError, PredictionError, SceneError
from helio_jax.forward.laws import Law
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.radiosity import plan_radiosity
from helio_jax.forward.render import Corrections, masking_corrections, radiosity_corrections, single_scattering
from helio_jax.forward.surface import Surface, slopes_of_normal
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack
from helio_jax.scene.body import Body
from helio_jax.scene.border import continue_border, extend_border
from helio_jax.scene.hidden_side import is_foot, occluded_vertices, undercut_vertices, with_cavities
from helio_jax.scene.scattering import COSINE_LAW, Term
from helio_jax.scene.surfaces import surface_body
from helio_jax.scene.wall_grid import Grid, has_level_rims, with_upright_walls
from helio_jax.trace import masks
from helio_jax.trace.denoise import SMOOTH_NORMALS, passes_for, smooth_along_surface, surface_width
from helio_jax.trace.intersect import Hits, Intersector
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import MAX_BRANCHES, TraceSettings

RAYS = 8
"""Paths per pixel and branch."""
SMOOTH_PATHS = 40
"""The traced image is averaged over neighbours until this many paths count in every pixel."""
MAX_SMOOTHING_STEP = 0.5
"""Mean heights that differ from a pixel's by more than this many pitches are not of its facet."""
MAX_BURIED = {"horizon": 0.05, "rays": 0.3}
"""Largest share of atoms that may start below a neighbouring facet of a reconstructed (noisy) surface: for a fit, and
for the test of a result, which is to be traced even where it is bad."""
CONTINUATIONS = "level", "relief"
"""How the surface goes on beyond a free border: `extend_border`, `continue_border`."""
CONTINUED = 0.5
"""Share of the image by which relief goes on beyond each border."""
LIFT_PIXELS = 0.1
"""How far off a reconstructed (noisy) surface the multiply scattered atoms start [pixels]."""


class HiddenSide(NamedTuple):
    """Two places at which the side that the beam does not see may stand.

    Attributes:
        places: where the foot is; `is_below_limb`: shares of the way from the beam's sheet to the vertical below the
            rim; else the run from that vertical under the rim, over the height.
        shares: of the two predictions in what is expected.
        deviation: one standard deviation, in units of the difference between the first and the second prediction.
        has_walls: whether the rims are those of walls, not limbs of round bodies.
        is_below_limb: see `places`.
    """

    places: tuple[float, ...]
    shares: tuple[float, ...]
    deviation: float
    has_walls: bool = False
    is_below_limb: bool = False


LIMB = HiddenSide((0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)), (0.5, 0.5), 0.5, is_below_limb=True)
"""Behind the limb of a round body an oblique beam leaves any side between its sheet and the vertical below the limb:
the nodes of Gauss's rule for a share of which nothing is known. Mean and deviation are exact where the signal is
linear."""
WALL = HiddenSide((0.0, 0.4), (1.0, 0.0), -1.0, has_walls=True)
"""Below a level rim a wall is expected to be vertical; one standard deviation from that it leans over its foot by 0.4
of its height, as that of a mushroom or a re-entrant block does. A beam along the normal sees no wall."""
UNDERSIDE = WALL._replace(has_walls=False)
"""The same below the limb of a round body for a beam along the normal."""


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
    difference is one more unknown of the fit. `masks_by` rays, masks are traced on the mesh instead of computed by the
    horizon march, for a test of the result that shares neither with the fit.

    Seeds are fixed, so that successive predictions differ by the surface, not by noise. All of the sample scatters by
    the law that a prediction is given; a scattering plate is part of what is traced, by the cosine law. Radiosity knows
    the cosine law only.

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
    def prepared(given: str) -> tuple[Optics, list[tuple[_Raster, list[int]]]]:
        instrument = Instrument.model_validate_json(given).idealised()
        reach = half + _surroundings(instrument) if substrate_um is None else max(0.5 * substrate_um, 1.001 * half)
        about = *np.meshgrid(stack.x, stack.y), LIFT_PIXELS * min(dx, dy), reach, border == "flat"
        rasters = [(_Raster(i, instrument.beam_shift, *about), list(of_beam)) for i, of_beam in instrument.by_beam()]
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
        terms = COSINE_LAW if law is None else law.terms()
        found = [trace_beam(raster, *smooth, surface, normals, optics, albedo, terms) for raster, _ in rasters]
        return found[0] if len(found) == 1 else _joined(found, [of_beam for _, of_beam in rasters])

    def trace_beam(
        raster: _Raster,
        smooth: np.ndarray,
        smooth_normals: np.ndarray,
        surface: Surface,
        normals: np.ndarray,
        optics: Optics,
        albedo: np.ndarray | None,
        law: tuple[Term, ...],
    ) -> Corrections:
        """Trace the images of one beam; arguments as those of `predict`, and the denoised heights and normals."""
        height = surface.height
        hidden = raster.hidden_side(smooth, smooth_normals)
        either_way = [raster.sides(smooth, smooth_normals, hidden, way) for way in raster.continuations]
        sides, n_traced = either_way[0], n_beams * len(either_way) * len(either_way[0])
        branches = min(max(1, round(n_rays / height.size / RAYS / n_traced)), MAX_BRANCHES)
        settings = TraceSettings(rays=RAYS, branches=branches, n_orders=2, seed=seed, workers=workers)
        passes, limit = passes_for(RAYS * branches, SMOOTH_PATHS), MAX_BURIED[masks_by]
        images = np.array(
            [
                [raster.smoothed(s.multiple(settings, limit, albedo, law), smooth, smooth_normals, passes) for s in way]
                for way in either_way
            ]
        )
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
            either = [m - single_scattering(f, normal) for m, f in zip(traced, masked, strict=True)]
            occluded = hidden.deviation * np.subtract(*either)
        masks, found = (np.tensordot(expected, np.array(images), 1) for images in (masked, traced))
        return Corrections(masks, found, occluded, smooth_normals, surroundings)

    return predict


def _joined(parts: list[Corrections], detectors: list[list[int]]) -> Corrections:
    """Join the corrections of several beams, whose detectors these are; seen straight down nothing is occluded."""
    order = np.argsort(np.concatenate(detectors))
    masked, multiple = (np.concatenate([getattr(p, name) for p in parts])[order] for name in ("masked", "multiple"))
    surroundings = [p.surroundings for p in parts if p.surroundings is not None]
    around = np.concatenate(surroundings)[order] if surroundings else None
    return Corrections(masked, multiple, None, parts[0].normals, around)


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


@dataclass(frozen=True)
class SurfaceHypothesis:
    """A surface whose hidden side stands at one place: a point for every pixel, and the mesh through them.

    `beam_x`, `beam_y` are the beam positions at which the points are illuminated [y, x], um; `pixel` numbers the pixels
    to which the points of the mesh's grid belong; `has_walls`: whether the mesh has walls between pixels.
    """

    raster: "_Raster"
    beam_x: np.ndarray
    beam_y: np.ndarray
    points: Hits
    body: Body
    pixel: np.ndarray
    intersector: Intersector
    has_walls: bool

    def multiple(
        self,
        settings: TraceSettings,
        max_buried: float,
        albedo: np.ndarray | None = None,
        law: tuple[Term, ...] = COSINE_LAW,
    ) -> np.ndarray:
        """Trace the multiple scattering [detector, y, x], per albedo of the own pixel; default: albedo 1 everywhere."""
        r = self.raster
        if albedo is None and law is COSINE_LAW:
            intersector, laws, own = self.intersector, {}, 1.0
        else:
            intersector, laws, own = self._with_materials(np.ones(r.x.shape) if albedo is None else albedo, law)
        experiment = make_experiment(intersector, r.instrument, settings, laws)
        x, y = self.beam_x.ravel(), self.beam_y.ravel()
        try:
            tally = trace_pixels(experiment, x, y, settings.workers, first=self.points, max_lost=max_buried)
        except GuardError as e:
            found = str(e).split(";")[0]
            raise PredictionError(
                f"the surface of the fit is too rough or steep to trace multiple scattering from ({found}): check "
                "background and gains, or use method = 'nearfield'"
            ) from e
        return tally.probability()[0][1].reshape(-1, *r.x.shape) / own

    def _with_materials(
        self, albedo: np.ndarray, law: tuple[Term, ...]
    ) -> tuple[Intersector, dict[str, tuple[Term, ...]], float]:
        """Give all faces a law, and the albedo [y, x] of their first point of the grid; beyond it, that of its corner.

        Relative albedos above 1 count as 1: no material reflects more atoms than it receives.

        Returns:
            The surface, its laws, and the albedo of the face that all paths are taken to start from.
        """
        on_grid = np.minimum(albedo, 1.0).ravel()[self.pixel.ravel()]
        levels, index = np.unique(on_grid, return_inverse=True)
        names = tuple(f"albedo {i}" for i in range(levels.size))
        first = self.body.faces.min(axis=1)
        material = np.where(first < on_grid.size, index[np.minimum(first, on_grid.size - 1)], index[0])
        body = replace(self.body, materials=names, face_material=material)
        intersector = Intersector(body)
        start = int(intersector.material_of(np.zeros(1, np.int32))[0])
        laws = {
            name: tuple(replace(term, share=term.share * float(a)) for term in law)
            for name, a in zip(names, levels, strict=True)
        }
        return intersector, laws, float(levels[start])

    def masked(self, is_wanted: np.ndarray) -> np.ndarray:
        """Compute the masked vector form factor [detector, 3, y, x] where it is wanted [y, x], elsewhere 0."""
        r, p = self.raster, self.points.take(is_wanted.ravel())
        offset = np.stack(r.instrument.sample_origin(self.beam_x[is_wanted], self.beam_y[is_wanted])[:2], -1)
        found, _ = masks.masked_form_factor(self.intersector, r.instrument, p.point, p.normal, p.surface, offset)
        out = np.zeros((len(found), 3, *is_wanted.shape))
        out[:, :, is_wanted] = np.moveaxis(found, -1, 1)
        return out


@dataclass(frozen=True)
class _Raster:
    """Beam positions and surroundings of a scan.

    Attributes:
        instrument: of the scan, of one beam.
        view_shift: beam shift along which the raster sees the surface, of the scan's own beam or, where several scans
            are joined, of another one.
        x, y: positions on the raster [y, x], um.
        lift: how far off the surface the points are put, um.
        reach: half the side of the square that the surroundings fill, um.
        has_flat_surroundings: whether they are flat, z = 0 in the middle of the raster; else the border is continued
            to the substrate.
        tilt: slopes of flat surroundings along x and y of the raster.
    """

    instrument: Instrument
    view_shift: tuple[float, float]
    x: np.ndarray
    y: np.ndarray
    lift: float
    reach: float
    has_flat_surroundings: bool
    tilt: tuple[float, float] = (0.0, 0.0)

    @property
    def flat_surroundings(self) -> dict[str, Any]:
        """Arguments of `surface_body` for flat surroundings: slopes and level in the sample frame, not the beam's."""
        along = 1.0 - sum(slope * shift for slope, shift in zip(self.tilt, self.view_shift, strict=True))
        tilt = self.tilt[0] / along, self.tilt[1] / along
        level = -tilt[0] * float(np.mean(self.x)) - tilt[1] * float(np.mean(self.y))
        return {"reach": self.reach, "level": level, "beam_shift": self.view_shift, "tilt": tilt}

    @property
    def continuations(self) -> tuple[str, ...]:
        """Ways in which the surface may go on beyond the image."""
        return CONTINUATIONS[:1] if self.has_flat_surroundings else CONTINUATIONS

    def side(
        self, height: np.ndarray, normals: np.ndarray, hidden: HiddenSide, place: float, way: str = "level"
    ) -> SurfaceHypothesis:
        """Make the surface with its hidden side at a place, continued in one of `CONTINUATIONS`.

        Walls are half-way between the pixels, unless most of what is occluded lies behind round bodies.
        """
        shift, normal = self.view_shift, normals.reshape(-1, 3)
        seen = at = self.surface(self.x, self.y, height)
        behind = self.moved(at, normals, hidden, place)
        substrate = self.flat_surroundings
        if not self.has_flat_surroundings:
            level, substrate = substrate_level(height), {}
            if way == "relief":
                at, behind = self.continued(at, behind, level)
            at, behind = (extend_border(*points, level, self.reach) for points in (at, behind))
        pixel = self.pixels(at[0].shape)
        n_points = at[0].size
        if hidden.has_walls:
            at, behind, number = with_upright_walls(at, behind, shift)
            pixel = pixel[number]
        body = with_cavities(surface_body(*at, **substrate), at, behind)
        point = np.stack(seen, -1).reshape(-1, 3) + self.lift * normal
        beam_x, beam_y = (
            at + (own - view) * height
            for at, own, view in zip((self.x, self.y), self.instrument.beam_shift, shift, strict=True)
        )
        has_walls, hits = at[0].size > n_points, Hits.on_mesh(point, normal)
        return SurfaceHypothesis(self, beam_x, beam_y, hits, body, pixel, Intersector(body), has_walls)

    def hidden_side(self, height: np.ndarray, normals: np.ndarray) -> HiddenSide:
        """Decide whether walls or round bodies hide a part of the surface from the beam."""
        if has_level_rims(height, normals, self.is_occluded(height)):
            return WALL
        return LIMB if any(self.view_shift) else UNDERSIDE

    def moved(self, at: Grid, normals: np.ndarray, hidden: HiddenSide, place: float) -> Grid:
        """Put the hidden side of a grid at a place (`HiddenSide.places`)."""
        if hidden.is_below_limb:
            return occluded_vertices(*at, normals, self.view_shift, place)
        below_rim = occluded_vertices(*at, normals, self.view_shift, 1.0)
        under = undercut_vertices(*at, place, self.view_shift)
        x, y, z = (rim + new - old for rim, new, old in zip(below_rim, under, at, strict=True))
        return x, y, z

    @property
    def pitches(self) -> tuple[float, float]:
        """Pitch along x and y, um."""
        return pitch(self.x[0]), pitch(self.y[:, 0])

    def pixels(self, shape: tuple[int, ...]) -> np.ndarray:
        """Number the pixels of the image; in a grid with more points around it, the nearest one's of each [point]."""
        return np.pad(np.arange(self.x.size).reshape(self.x.shape), (shape[0] - len(self.x)) // 2, mode="edge").ravel()

    def smoothed(
        self,
        images: np.ndarray,
        height: np.ndarray,
        normals: np.ndarray,
        passes: int = 1,
        width: float = SMOOTH_NORMALS,
    ) -> np.ndarray:
        """Smooth images [image, y, x] along a surface of heights [y, x], um, and unit normals [y, x, 3]."""
        points = np.stack(self.surface(self.x, self.y, height), -1)
        return smooth_along_surface(images, normals, points, max(self.pitches), passes, width)

    def denoised(self, height: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Average heights [y, x], um, and unit normals [y, x, 3] over neighbours on the same facet.

        Noise makes facets see one another: on a flat that would add half a per cent of its signal. Where the mean
        height differs by more than `MAX_SMOOTHING_STEP`, neighbours are at another level, and the height stays.
        """
        fields = np.concatenate([np.moveaxis(normals, -1, 0), height[None]])
        mean = self.smoothed(fields, height, normals, width=surface_width(normals))
        smooth = np.moveaxis(mean[:3], 0, -1)
        smooth /= np.linalg.norm(smooth, axis=-1, keepdims=True)
        is_near = np.abs(mean[3] - height) < MAX_SMOOTHING_STEP * min(self.pitches)
        return np.where(is_near, mean[3], height), smooth

    def surface(self, x: np.ndarray, y: np.ndarray, height: np.ndarray) -> Grid:
        """Compute the surface points of heights [y, x] that are seen at positions x, y of the raster [um]."""
        return x - height * self.view_shift[0], y - height * self.view_shift[1], height

    def continued(self, at: Grid, behind: Grid, level: float) -> tuple[Grid, Grid]:
        """Continue a grid's relief beyond the image; the occluded side of what is added stays on the beam's sheet."""
        n = int(CONTINUED * min(self.x.shape))
        dx, dy = self.pitches
        x, y = np.meshgrid(
            *(p[0] + step * np.arange(-n, p.size + n) for p, step in ((self.x[0], dx), (self.y[:, 0], dy)))
        )
        z = continue_border(at[2], (dy, dx), level, n)
        wide = self.surface(x, y, z)
        moved = wide[0].copy(), wide[1].copy(), z.copy()
        for field, inner in zip(moved, behind, strict=True):
            field[n:-n, n:-n] = inner
        return wide, moved

    def sides(
        self, height: np.ndarray, normals: np.ndarray, hidden: HiddenSide, way: str = "level"
    ) -> list[SurfaceHypothesis]:
        """Make the surface with its hidden side at both places; a single one if the beam sees all of it."""
        places = hidden.places if self.is_occluded(height).any() else hidden.places[:1]
        return [self.side(height, normals, hidden, place, way) for place in places]

    def is_occluded(self, height: np.ndarray) -> np.ndarray:
        """Find the pixels at the foot of a side that the beam does not see [y, x]."""
        return is_foot(height, self.view_shift, self.pitches[::-1])
