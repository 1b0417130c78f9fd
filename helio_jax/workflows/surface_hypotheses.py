"""Surfaces as the tracer takes them: meshes of what a fit knows, with hypotheses for what it does not.

A fit knows the heights of an image. Its mesh needs two things more, each in two hypotheses whose difference is an
unknown of the fit: where the side stands that the beam does not see (`HiddenSide`), and how the sample goes on beyond a
free border (`CONTINUATIONS`).
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from helio_jax.arrays import pitch, substrate_level
from helio_jax.errors import GuardError, PredictionError
from helio_jax.forward.surface import slopes_of_normal
from helio_jax.instrument import Instrument
from helio_jax.scene.body import Body
from helio_jax.scene.border import continue_border, extend_border
from helio_jax.scene.hidden_side import is_foot, occluded_vertices, undercut_vertices, with_cavities
from helio_jax.scene.midpoints import first_of_halves, with_midpoints
from helio_jax.scene.scattering import COSINE_LAW, Term
from helio_jax.scene.surfaces import surface_body
from helio_jax.scene.wall_grid import Grid, has_level_rims, wall_links, with_upright_walls
from helio_jax.trace import masks
from helio_jax.trace.denoise import SMOOTH_NORMALS, smooth_along_surface, surface_width
from helio_jax.trace.guided import trace_multiple
from helio_jax.trace.intersect import Hits, Intersector
from helio_jax.trace.run import make_experiment
from helio_jax.trace.settings import TraceSettings

LIFT = {"multiple": 0.01, "masks": 0.1}
"""How far off the surface multiply scattered atoms start, and rays that test whether a detector is masked [pitches].
Atoms that start off it see what stands around lower by as much: 0.1 made the multiple scattering about a pyramid of 4.7
pixels' height 5 % too low. Rays to a detector are few directions, which a noisy neighbour could block."""
MAX_SMOOTHING_STEP = 0.5
"""Mean heights that differ from a pixel's by more than this many pitches are not of its facet."""
CONTINUATIONS = "level", "relief"
"""How the surface goes on beyond a free border: `extend_border`, `continue_border`."""
CONTINUED = 0.5
"""Share of the image by which relief goes on beyond each border."""


class HiddenSide(NamedTuple):
    """Two places at which the side that the beam does not see may stand.

    Attributes:
        places: where the foot is. `is_share`: share of the way from the sheet along the beam to the vertical below the
            rim; else by how much the side leans inwards from that vertical: run over height.
        shares: of the two predictions in what is expected.
        deviation: one standard deviation, in units of the difference between the first and the second prediction.
        has_walls: whether the rims are those of walls, not limbs of round bodies.
        is_share: see `places`.
    """

    places: tuple[float, ...]
    shares: tuple[float, ...]
    deviation: float
    has_walls: bool = False
    is_share: bool = False


LIMB = HiddenSide((0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)), (0.5, 0.5), 0.5, is_share=True)
"""Behind the limb of a round body an oblique beam leaves any side between its sheet and the vertical below the limb:
the nodes of Gauss's rule for a share of which nothing is known. Mean and deviation are exact where the signal is
linear."""
WALL = HiddenSide((0.0, 0.4), (1.0, 0.0), -1.0, has_walls=True)
"""Below a level rim a wall is expected to be vertical; one standard deviation from that it leans over its foot by 0.4
of its height, as that of a mushroom or a re-entrant block does. A beam along the normal sees no wall."""
UNDERSIDE = WALL._replace(has_walls=False)
"""The same below the limb of a round body for a beam along the normal."""


@dataclass(frozen=True)
class SurfaceHypothesis:
    """A surface whose hidden side stands at one place: a point for every pixel, and the mesh through them.

    `beam_x`, `beam_y` are the beam positions at which the points are illuminated [y, x], um; `pixel` numbers the pixels
    to which the points of the mesh's grid belong; `has_walls`: whether the mesh has walls between pixels.
    """

    raster: "ScanRaster"
    beam_x: np.ndarray
    beam_y: np.ndarray
    points: Hits
    body: Body
    pixel: np.ndarray
    intersector: Intersector
    has_walls: bool

    def multiple(
        self,
        n_paths: int,
        seed: int,
        max_buried: float,
        albedo: np.ndarray | None = None,
        law: tuple[Term, ...] = COSINE_LAW,
        workers: int | None = None,
    ) -> np.ndarray:
        """Trace the multiple scattering [detector, y, x], per albedo of the own pixel; default: albedo 1 everywhere.

        Args:
            n_paths: number of paths, over all pixels.
            seed: of the random numbers.
            max_buried: largest share of atoms that may start below a neighbouring facet.
            albedo: of the pixels [y, x].
            law: scattering law of all of the surface.
            workers: number of threads; default: one per CPU.

        Raises:
            PredictionError: more atoms start below a neighbouring facet.
        """
        r = self.raster
        if albedo is None and law is COSINE_LAW:
            intersector, laws, own = self.intersector, {}, 1.0
        else:
            intersector, laws, own = self._with_materials(np.ones(r.x.shape) if albedo is None else albedo, law)
        experiment = make_experiment(intersector, r.instrument, TraceSettings(seed=seed), laws)
        try:
            first = self._lifted("multiple")
            found = trace_multiple(experiment, first, self.beam_x, self.beam_y, n_paths, workers, max_buried)
        except GuardError as e:
            why = str(e).split(";")[0]
            raise PredictionError(
                f"the surface of the fit is too rough or steep to trace multiple scattering from ({why}): check "
                "background and gains, or use method = 'nearfield'"
            ) from e
        return found / own

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

    def _lifted(self, start_of: Literal["multiple", "masks"]) -> Hits:
        """Move the points off the surface by `LIFT`."""
        p = self.points
        return replace(p, point=p.point + LIFT[start_of] * min(self.raster.pitches) * p.normal)

    def masked(self, is_wanted: np.ndarray) -> np.ndarray:
        """Compute the masked vector form factor [detector, 3, y, x] where it is wanted [y, x], elsewhere 0."""
        r, p = self.raster, self._lifted("masks").take(is_wanted.ravel())
        offset = np.stack(r.instrument.sample_origin(self.beam_x[is_wanted], self.beam_y[is_wanted])[:2], -1)
        found, _ = masks.masked_form_factor(self.intersector, r.instrument, p.point, p.normal, p.surface, offset)
        out = np.zeros((len(found), 3, *is_wanted.shape))
        out[:, :, is_wanted] = np.moveaxis(found, -1, 1)
        return out


@dataclass(frozen=True)
class ScanRaster:
    """Beam positions and surroundings of a scan.

    Attributes:
        instrument: of the scan, of one beam.
        view_shift: beam shift along which the raster sees the surface, of the scan's own beam or, where several scans
            are joined, of another one.
        x, y: positions on the raster [y, x], um.
        reach: half the side of the square that the surroundings fill, um.
        has_flat_surroundings: whether they are flat, z = 0 in the middle of the raster; else the border is continued
            to the substrate.
        tilt: slopes of flat surroundings along x and y of the raster.
    """

    instrument: Instrument
    view_shift: tuple[float, float]
    x: np.ndarray
    y: np.ndarray
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

        Where no pixel of it is hidden from the beam and none stands on a wall, the mesh has points between the pixels,
        too (`with_midpoints`), in either continuation. Walls are half-way between the pixels, unless most of what is
        occluded lies behind round bodies.
        """
        shift, normal = self.view_shift, normals.reshape(-1, 3)
        seen = at = self.surface(self.x, self.y, height)
        behind = self.with_hidden_side(at, normals, hidden, place)
        substrate = self.flat_surroundings
        if self.has_flat_surroundings:
            at, behind = self.with_foot(at), self.with_foot(behind)
        else:
            level, substrate = substrate_level(height), {}
            if not any(parts.any() for parts in wall_links(self.x, self.y, height)):
                hidden = hidden._replace(has_walls=False)  # of what is beyond the image no wall is known
            if way == "relief":
                at, behind = self.continued(at, behind, level)
            at, behind = (extend_border(*points, level, self.reach) for points in (at, behind))
        pixel = self.pixels(at[0].shape)
        n_points = at[0].size
        if hidden.has_walls:
            at, behind, number = with_upright_walls(at, behind, shift)
            pixel = pixel[number]
        has_walls = at[0].size > n_points
        if not has_walls and not self.is_occluded(height).any():
            rows, columns = map(first_of_halves, at[0].shape)
            pixel = pixel.reshape(at[0].shape)[np.ix_(rows, columns)].ravel()
            at = behind = with_midpoints(at, *self.slopes(normals, at[0].shape), self.pitches, shift)
        body = with_cavities(surface_body(*at, **substrate), at, behind)
        beam_x, beam_y = (
            at + (own - view) * height
            for at, own, view in zip((self.x, self.y), self.instrument.beam_shift, shift, strict=True)
        )
        hits = Hits.on_mesh(np.stack(seen, -1).reshape(-1, 3), normal)
        return SurfaceHypothesis(self, beam_x, beam_y, hits, body, pixel, Intersector(body), has_walls)

    def slopes(self, normals: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Compute the slopes along the raster of unit normals [y, x, 3], NaN around the image in a larger grid."""
        around = (shape[0] - len(self.x)) // 2
        slopes = slopes_of_normal(normals, self.view_shift)[:2]
        a, b = (np.pad(np.asarray(slope), around, constant_values=np.nan) for slope in slopes)
        return a, b

    def hidden_side(self, height: np.ndarray, normals: np.ndarray) -> HiddenSide:
        """Decide whether walls or round bodies hide a part of the surface from the beam."""
        if has_level_rims(height, normals, self.is_occluded(height)):
            return WALL
        return LIMB if any(self.view_shift) else UNDERSIDE

    def with_hidden_side(self, at: Grid, normals: np.ndarray, hidden: HiddenSide, place: float) -> Grid:
        """Put the hidden side of a grid at a place (`HiddenSide.places`)."""
        if hidden.is_share:
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
        degree: Literal[1, 2] = 1,
    ) -> np.ndarray:
        """Smooth images [image, y, x] along a surface of heights [y, x], um, and unit normals [y, x, 3]."""
        points = np.stack(self.surface(self.x, self.y, height), -1)
        return smooth_along_surface(images, normals, points, max(self.pitches), passes, width, degree)

    def denoised(self, height: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Average heights [y, x], um, and unit normals [y, x, 3] over neighbours on the same facet.

        Noise makes facets see one another: on a flat that would add half a per cent of its signal. Where the mean
        height differs by more than `MAX_SMOOTHING_STEP`, neighbours are at another level, and the height stays.
        """
        substrate = self.tilt[0] * self.x + self.tilt[1] * self.y
        fields = np.concatenate([np.moveaxis(normals, -1, 0), (height - substrate)[None]])
        mean = self.smoothed(fields, height, normals, width=surface_width(normals))
        smooth = np.moveaxis(mean[:3], 0, -1)
        smooth /= np.linalg.norm(smooth, axis=-1, keepdims=True)
        mean_height = mean[3] + substrate
        is_near = np.abs(mean_height - height) < MAX_SMOOTHING_STEP * min(self.pitches)
        return np.where(is_near, mean_height, height), smooth

    def surface(self, x: np.ndarray, y: np.ndarray, height: np.ndarray) -> Grid:
        """Compute the surface points of heights [y, x] that are seen at positions x, y of the raster [um]."""
        return x - height * self.view_shift[0], y - height * self.view_shift[1], height

    def with_foot(self, grid: Grid) -> Grid:
        """Add a ring of points one pitch outside a grid, on the flat surroundings [y + 2, x + 2].

        Atoms start from the points of the image: at its border they would start from the rim of a vertical sheet.
        """
        x, y = (np.pad(position, 1, mode="reflect", reflect_type="odd") for position in (self.x, self.y))
        about = self.flat_surroundings
        slope, shift = np.asarray(about["tilt"]), np.asarray(self.view_shift)
        level = (about["level"] + slope[0] * x + slope[1] * y) / (1.0 + slope @ shift)
        ring = self.surface(x, y, level)
        for around, field in zip(ring, grid, strict=True):
            around[1:-1, 1:-1] = field
        return ring

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
