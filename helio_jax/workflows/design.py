"""Design the apertures of an instrument: layouts that know the heights of samples best and mask little of them.

What it takes: a scene with the instrument to be improved on and a sample; other scenes whose samples count, too; table
[design]. What it gives: layouts of a few numbers of apertures, each a local minimum of the heights' expected variance
(`inverse/criterion.py`) and of the masked area, ranked and compared with the scene's layout on the same samples.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from helio_jax.arguments import checked
from helio_jax.detector import Detector
from helio_jax.errors import SceneError
from helio_jax.forward.optics import Optics
from helio_jax.forward.optics import Raster as BeamPositions
from helio_jax.forward.surface import Surface, slopes_of_normal
from helio_jax.instrument import Instrument
from helio_jax.inverse.criterion import Case, pose_case
from helio_jax.inverse.layout_objective import Assessment, Goal, Limits, Ties, keeps_limits, room_of, room_slope_of
from helio_jax.planning.design_settings import DesignSettings
from helio_jax.planning.search import minimise
from helio_jax.planning.starts import (
    Pattern,
    Ranges,
    free_pattern,
    paired,
    paired_pattern,
    random_layout,
    ring,
)
from helio_jax.scene.scan import Raster
from helio_jax.workflows.design_result import Design, Proposal, distinct, kept, with_best
from helio_jax.workflows.plan import substrate_albedo
from helio_jax.workflows.scene_file import SceneFile
from helio_jax.workflows.truth import true_surface

LEAST_MASKED = 1e-3
"""Masked share of the scene's layout below which masked areas count in units of this."""
MIN_SIDE = 5
"""Least pixels along the shorter side of an assessed raster."""
TRIES = 4000
"""Draws of random layouts in which one that keeps the walls must be found."""
BATCH = 200
"""Of these, so many are drawn at a time."""

_OF_DETECTOR = "gain", "background_per_pixel"


@checked
def design(
    scene: SceneFile,
    *,
    samples: Sequence[SceneFile] = (),
    settings: DesignSettings | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Design:
    """Search layouts of apertures by the expected variance of the heights and the masked area; rank them.

    Valid for plates with elliptical apertures, the cosine law and surfaces that the fit can express, as `hx.fisher`,
    whose priors hold: table [reconstruct], with a flat border. Searches find local minima: more starts may find better
    ones. The plate is taken to be thin: channels through a thick one cut off part of what their apertures see.

    Args:
        scene: with the instrument to compare with, its beam and plate, and the first sample.
        samples: scenes whose samples count, too, each with its raster, counts and distance below the nominal spot.
        settings: replaces the scene's table [design].
        say: called with a message for each search.

    Raises:
        SceneError: no raster at one distance, a free border, apertures that are no ellipses in a flat plate, limits
            that no layout keeps.

    Example:
        >>> found = hx.design(scene, samples=[hx.load_scene("pyramid")])
        >>> found.proposals[0].variance_ratio, found.proposals[0].angles_deg
        >>> found.write("layouts")

    Source: A-optimality: Pukelsheim, Optimal Design of Experiments (2006), sec. 6.5; the bound as in `hx.fisher`.
    """
    settings, scenes = settings or scene.design, [scene, *samples]
    instrument, incidence = scene.instrument, scene.beam.incidence_deg
    own = _layout_of(instrument)
    area = settings.total_area_um2 or float(sum(np.pi * np.prod(a.semi_axes) for a in instrument.apertures()))
    say(f"posing {len(scenes)} samples for the scene's layout")
    goal_of_scene = _goal(scenes, scene, instrument, settings)
    reference = goal_of_scene.assess_optics(Optics.of(instrument))
    found: list[Proposal] = []
    for tried in settings.incidences_deg or (incidence,):
        for n in settings.apertures:
            is_of_scene = (n, tried) == (len(scene.detector), incidence)
            goal = goal_of_scene
            if not is_of_scene:
                say(f"posing {len(scenes)} samples for {n} apertures, incidence {tried:g} deg")
                even = ring(n, 0.0, _ranges(settings, instrument.working_distance))
                posed = _instrument_of(scene, tried, _still(even, area, instrument), np.zeros(0))
                goal = _goal(scenes, scene, posed, settings)
            search = _Search(scene, settings, goal, reference, n, tried, area, own if is_of_scene else None)
            found += search.proposals(say)
    room = room_of(_still(own, area, instrument), np.zeros(0), goal_of_scene.beam_shift, _limits(settings))
    wall = 1e3 * float(room.min()) + settings.wall_um
    base = _assessed(reference, reference, instrument, "scene", 0.0, "as given", wall)
    first, *others = with_best([base, *distinct(found)])
    return Design(scene.name, tuple(s.name for s in scenes), first, kept(others, settings.keep), tuple(others), area)


def _goal(scenes: Sequence[SceneFile], scene: SceneFile, instrument: Instrument, settings: DesignSettings) -> Goal:
    cases, drops = zip(*(_case(s, scene, instrument, settings) for s in scenes), strict=True)
    return Goal(tuple(cases), tuple(drops))


def _ties(base: np.ndarray, matrix: np.ndarray, area: float, instrument: Instrument) -> Ties:
    return Ties(base, matrix, area, instrument.working_distance)


def _still(layout: np.ndarray, area: float, instrument: Instrument) -> Ties:
    """Make a layout without unknowns."""
    return _ties(layout, np.zeros((len(layout), 0)), area, instrument)


def _limits(s: DesignSettings) -> Limits:
    edge = math.inf if s.plate_radius_um is None else s.plate_radius_um
    return Limits(*(np.asarray(v) for v in (s.wall_um, s.pinhole_clearance_um, edge, s.plate_thickness_um)))


def _ranges(s: DesignSettings, working_distance: float) -> Ranges:
    low, high = s.working_distance_um or (working_distance, working_distance)
    half, (least, most) = 0.5 * math.log(s.area_ratio), np.radians(s.polar_deg)
    distances = math.log(low / working_distance), math.log(high / working_distance)
    return Ranges((float(least), float(most)), (-half, half), distances)


def _instrument_of(scene: SceneFile, incidence_deg: float, ties: Ties, x: np.ndarray, drop: float = 0.0) -> Instrument:
    """Make the instrument of a layout, apertures by azimuth, the substrate `drop` below the nominal spot [um]."""
    (w, center, semi_axes, azimuth), detectors = ties.ellipses(x), []
    for k, i in enumerate(np.argsort(np.mod(azimuth, 2.0 * np.pi), kind="stable"), 1):
        ellipse = {
            "center_um": tuple(center[i].tolist()),
            "axes_um": tuple((2.0 * semi_axes[i]).tolist()),
            "rotation_deg": math.degrees(math.remainder(float(azimuth[i]), 2.0 * math.pi)),
        }
        detectors.append(Detector(name=f"d{k}", **ellipse))
    plate = scene.plate.model_copy(update={"working_distance_um": w, "sample_distance_um": w + drop})
    beam = scene.beam.changed(incidence_deg=incidence_deg)
    return Instrument(beam=beam, plate=plate, uncertainty=scene.uncertainty, detector=tuple(detectors))


def _case(sample: SceneFile, scene: SceneFile, instrument: Instrument, settings: DesignSettings) -> tuple[Case, float]:
    """Pose the sample of a scene for an instrument; return how far its substrate lies below the nominal spot, too [um].

    Raises:
        SceneError: its scan is no raster at one distance and rotation.
    """
    scan, noise = sample.scan, sample.noise
    if not isinstance(scan, Raster) or scan.sample_distances_um or scan.rotations_deg:
        raise SceneError(
            f"{sample.name}: a design needs a raster at one distance and rotation: set scan.kind = 'raster', no "
            "sample_distances_um, no rotations_deg"
        )
    drop = sample.instrument.sample_distance - sample.instrument.working_distance
    zoom = max(scan.nx, scan.ny) / settings.pixels
    size = {"nx": max(MIN_SIDE, round(scan.nx / zoom)), "ny": max(MIN_SIDE, round(scan.ny / zoom))}
    placed = instrument.at_distance(instrument.working_distance + drop)
    tables = {key: getattr(placed, key) for key in ("beam", "plate", "detector")}
    coarse = sample.model_copy(update={**tables, "scan": scan.changed(**size, pixel_size_um=scan.pixel_size_um * zoom)})
    x, y = coarse.positions()
    truth, optics = true_surface(coarse, x, y), Optics.of(placed)
    assert truth.normals is not None  # of a scene
    surface = Surface(truth.height, *slopes_of_normal(truth.normals, np.asarray(optics.beam_shift))[:2])
    gain, background = (float(np.mean(noise.per_detector(k, len(sample.detector)))) for k in _OF_DETECTOR)
    dose = scan.atoms_per_pixel * gain * substrate_albedo(sample)
    known = {"uncertainty": scene.uncertainty, "settings": sample.reconstruct, "background": background}
    return pose_case(surface, optics, BeamPositions(x, y), dose, **known), drop


@dataclass(frozen=True)
class _Search:
    """Searches for one number of apertures and one incidence; `own`: the scene's layout, where it has that number."""

    scene: SceneFile
    settings: DesignSettings
    goal: Goal
    reference: Assessment
    n: int
    incidence_deg: float
    area: float
    own: np.ndarray | None

    def proposals(self, say: Callable[[str], None]) -> Iterator[Proposal]:
        """Yield what the searches end at.

        Raises:
            SceneError: no start keeps the limits.
        """
        starts = list(self._starts())
        if not starts:
            raise SceneError(
                f"no layout of {self.n} apertures of {self.area:.4g} um^2 in all keeps walls of "
                f"{self.settings.wall_um:g} um between polar angles of {list(self.settings.polar_deg)} deg: reduce "
                "design.total_area_um2, design.wall_um or design.pinhole_clearance_um, or widen design.polar_deg"
            )
        at_start = [self.goal.assess(self._ties(pattern), x) for pattern, x in starts]
        masked_of_scene = max(float(np.mean(self.reference.masked)), LEAST_MASKED)
        for weight in self.settings.masked_weights:
            per_share = weight / masked_of_scene
            values = np.array([np.mean(np.log(a.variance) + per_share * a.masked) for a in at_start])
            for number in self._chosen(values, [pattern for pattern, _ in starts]):
                pattern, x = starts[number]
                ties = self._ties(pattern)
                end = minimise(
                    partial(self.goal.value_and_slope, ties, per_share), x, (pattern.low, pattern.high),
                    partial(self._room, ties), partial(self._room_slope, ties), self.settings.steps,
                )  # fmt: skip
                found = self.goal.assess(ties, end.x)
                wall = 1e3 * end.least_room + self.settings.wall_um
                instrument = _instrument_of(self.scene, self.incidence_deg, ties, end.x, self.goal.drops[0])
                proposal = _assessed(found, self.reference, instrument, pattern.kind, weight, end.status, wall)
                say(
                    f"{self.n} apertures, {pattern.kind}, weight {weight:g}: variance {proposal.variance_ratio:.3f} of "
                    f"the scene's, {100 * proposal.masked:.2f} % masked; {end.n_steps} steps, {end.status}"
                )
                yield proposal

    def _chosen(self, values: np.ndarray, patterns: list[Pattern]) -> list[int]:
        """Choose the starts from which is searched: the best free ones and the best symmetric pairs."""
        order = [int(i) for i in np.argsort(values, kind="stable")]
        free = [i for i in order if patterns[i].kind == "free"]
        return free[: self.settings.starts] + [i for i in order if patterns[i].kind == "pairs"][:1]

    def _ties(self, pattern: Pattern) -> Ties:
        return _ties(pattern.base, pattern.matrix, self.area, self.scene.instrument)

    def _room(self, ties: Ties, x: np.ndarray) -> np.ndarray:
        return room_of(ties, x, self.goal.beam_shift, _limits(self.settings))

    def _room_slope(self, ties: Ties, x: np.ndarray) -> np.ndarray:
        return room_slope_of(ties, x, self.goal.beam_shift, _limits(self.settings))

    def _starts(self) -> Iterator[tuple[Pattern, np.ndarray]]:
        """Yield starts that keep the limits: the scene's layout, symmetric pairs, rings, random layouts."""
        ranges, n = _ranges(self.settings, self.scene.instrument.working_distance), self.n
        azimuth = math.radians(self.scene.beam.azimuth_deg)
        free = free_pattern(n, ranges)
        layouts = [ring(n, azimuth + turn, ranges) for turn in (0.0, math.pi / n)]
        if self.own is not None:
            layouts.append(self.own)
        candidates = [(free, free.unknowns_of(layout)) for layout in layouts]
        for single in (0.0, math.pi) if n % 2 else (0.0,):
            pattern = paired_pattern(n, azimuth, single, ranges)
            candidates.append((pattern, paired(n, pattern, single, ranges)))
        yield from (c for c in candidates if self._keeps(*c))
        rng, n_found = np.random.default_rng([self.settings.seed, n]), 0
        for _ in range(TRIES // BATCH):
            drawn = np.array([free.unknowns_of(random_layout(n, ranges, rng)) for _ in range(BATCH)])
            is_kept = keeps_limits(self._ties(free), drawn, self.goal.beam_shift, _limits(self.settings))
            for x in drawn[is_kept][: self.settings.starts - n_found]:
                yield free, x
                n_found += 1

    def _keeps(self, pattern: Pattern, x: np.ndarray) -> bool:
        return bool(self._room(self._ties(pattern), x).min() >= 0.0)


def _layout_of(instrument: Instrument) -> np.ndarray:
    """Return polar angles, azimuths and logarithms of the areas over their mean of an instrument's apertures."""
    apertures, w = instrument.apertures(), instrument.working_distance
    center = np.array([a.center for a in apertures])
    area = np.array([np.prod(a.semi_axes) for a in apertures])
    polar = np.arctan2(np.hypot(*center.T), w)
    return np.concatenate([polar, np.arctan2(center[:, 1], center[:, 0]), np.log(area / area.mean()), np.zeros(1)])


def _assessed(
    found: Assessment, reference: Assessment, instrument: Instrument, kind: str, weight: float, status: str, wall: float
) -> Proposal:
    """Make the record of a layout."""
    ratios, masked, of_scene = found.variance / reference.variance, np.mean(found.masked), np.mean(reference.masked)
    return Proposal(
        instrument, kind, weight, status, float(np.exp(0.5 * np.mean(np.log(found.variance)))),
        float(np.exp(np.mean(np.log(ratios)))), tuple(map(float, ratios)), float(masked),
        float(masked / of_scene) if of_scene > 0.0 else None,
        float(np.mean(found.counts / reference.counts)), wall,
    )  # fmt: skip
