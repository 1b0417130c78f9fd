"""Step heights from mask bands: edges, one band per detector, the steps, and the patches between them.

`find_steps` needs no reconstruction: a band's length is the step's height times the tangent of the detector's direction
plus the beam's (`wall_signal`), whatever gain, offset and scattering law are. Bands of several detectors at an edge
must agree. A fit may start from the levels and be checked against the bands. Valid where both sides of a vertical wall
are level; elsewhere nothing is stated. NumPy.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2 as chi_square

from helio_jax.arguments import checked
from helio_jax.arrays import pitch
from helio_jax.detector import Aperture, Cone
from helio_jax.errors import SceneError
from helio_jax.inverse.band_fit import Band, disturbance, fit_band, kind_of, place_edge
from helio_jax.inverse.dash_steps import find_low_steps
from helio_jax.inverse.edge_place import Images, abruptness, band_coordinates, lay_edge
from helio_jax.inverse.mask_edges import (
    SHADED,
    Edge,
    SignalLevels,
    edge_points,
    find_levels,
    is_on,
    straight_edges,
    variance_of,
)
from helio_jax.inverse.mask_patches import find_patches, likeness, sides_of, solve_levels
from helio_jax.inverse.patch_outlines import with_outlines_moved
from helio_jax.inverse.step_records import BandRow, Patch, Step, Steps, border_shares
from helio_jax.inverse.wall_signal import Opening, WallSignal, opening_of, wall_signal
from helio_jax.micrograph import MicrographStack

MIN_WALL = 0.7
"""Least probability that the signal falls abruptly, for a wall."""
CERTAIN_WALL = 0.9
"""The same where the height is not determined, but the edge may part patches."""
_MISFIT = 4.0
"""Mean square residual above which a band is not explained by a wall."""
_MODEL_STD = 0.004
"""Standard deviation of heights from what the model of a wall neglects, as a fraction."""
_PLACE_STD = 0.03
"""Standard deviation of the edge's place beside the gap between lit and dark pixels [pixels]."""
_SMALLEST = 8
"""Smallest raster [pixels]."""
_SPLIT = 0.2
"""Share of the border from which on a patch may be the substrate."""


@dataclass(frozen=True)
class Scan:
    """A stack as the steps below see it."""

    images: Images
    openings: tuple[Aperture | Cone, ...]
    stack: MicrographStack
    beam_shift: np.ndarray

    def seen_from(self, height: float) -> list[Opening]:
        """Return the directions to all detectors from a level [um]."""
        return [opening_of(o, self.stack.instrument, height) for o in self.openings]

    def directions(self, openings: Sequence[Opening]) -> np.ndarray:
        """Return v of every detector [detector, 2]."""
        return np.stack([o.mean + self.beam_shift for o in openings])


def spot_std(stack: MicrographStack) -> float:
    """Compute the standard deviation of the beam's spot along one axis, across the beam [um]."""
    beam = stack.instrument.beam
    reach = stack.instrument.sample_distance / math.cos(math.radians(beam.incidence_deg))
    size = 1e-3 * beam.source_size_mrad * reach
    size = {"uniform": 0.5 * size, "gaussian": size}.get(beam.source, 0.0)
    return math.hypot(size, 0.5 * beam.pinhole_radius_um)


def scan_of(stack: MicrographStack) -> tuple[Scan, SignalLevels]:
    """Prepare a stack for the measurement of steps; arguments and errors as `find_steps`."""
    n_detectors, ny, nx = stack.shape
    if stack.instrument.has_several_beams:
        raise SceneError("steps are measured in scans of one beam, got several: measure them in each scan by itself")
    if stack.positions is not None or min(ny, nx) < _SMALLEST:
        raise SceneError(f"steps need a raster of {_SMALLEST} x {_SMALLEST} pixels or more, got {ny} x {nx}")
    openings = tuple(o for o in stack.instrument.openings() if o is not None)
    if len(openings) < n_detectors:
        raise SceneError("steps need detectors that are apertures or cones, not parts of the plate's mesh")
    signal = np.where(stack.is_observed, stack.signal, np.nan)
    variance = variance_of(signal, stack.variance)
    levels = find_levels(signal, variance, stack.background is not None)
    side = math.sqrt(pitch(stack.x) * pitch(stack.y))
    place = np.stack(np.meshgrid(stack.x, stack.y), -1)
    least = 1e-6 * np.maximum(levels.lit, 0.0)[:, None, None] ** 2
    images = Images(
        signal, np.maximum(variance, least), place, levels.lit, levels.floor, levels.floor_std, side, spot_std(stack)
    )
    return Scan(images, openings, stack, np.array(stack.instrument.beam_shift)), levels


@checked
def find_steps(stack: MicrographStack) -> Steps:
    """Find the steps of a surface in its micrographs and measure their heights.

    Args:
        stack: micrographs of a raster, simulated or measured, of an instrument with apertures in a flat plate.

    Raises:
        SceneError: the images are no raster or of several beams, or the plate is a mesh.

    Example:
        >>> hx.find_steps(stack).steps
    """
    scan, levels = scan_of(stack)
    images, side = scan.images, scan.images.side
    edges = _laid(_found(scan, levels), scan)
    tried = ((edge, measure_edge(0, edge, scan, 0.0)) for edge in edges)
    shown = [(edge, m) for edge, m in tried if m.bands]
    low = _low(scan, [m for _, m in shown])
    shown = [(edge, m) for edge, m in shown if m.step.is_used or not any(is_on(m.edge, o.edge, side) for o in low)]
    edges, n = [edge for edge, _ in shown], len(shown)
    measured = [m.numbered(i) for i, m in enumerate([*(m for _, m in shown), *low], 1)]
    patch = _patches(measured, images, levels)
    result = _joined(measured, patch, scan, levels)
    # once more with the directions as seen from the lower level of each step, above most of the border
    ground = result.ground.level_um if math.isfinite(result.ground.level_um) else 0.0
    heights = [result.patches[s.below].level_um - ground for s in result.steps[:n]]
    moved = [z if math.isfinite(z) else 0.0 for z in heights]
    if any(abs(z) > 1e-3 * stack.instrument.sample_distance for z in moved):
        again = [measure_edge(i, e, scan, z) for i, (e, z) in enumerate(zip(edges, moved, strict=True), 1)]
        result = _joined([*again, *measured[n:]], patch, scan, levels)
    return result


def _found(scan: Scan, levels: SignalLevels) -> list[Edge]:
    """Find the edges at which bands begin, over all detectors and in each alone.

    A band narrower than a pixel shows steps of the raster, whose normals turn those of another detector's points.
    """
    stack, points, normals, numbers = scan.stack, [], [], []
    for k, v in enumerate(scan.directions(scan.seen_from(0.0))):
        fraction = np.where(levels.is_shaded[k] | ~(levels.fraction[k] < SHADED), levels.fraction[k], 1.0)
        at, normal = edge_points(fraction, stack.x, stack.y, v)
        points.append(at)
        normals.append(normal)
        numbers.append(np.full(len(at), k))
    side = scan.images.side
    together = straight_edges(np.concatenate(points), np.concatenate(normals), np.concatenate(numbers), side)
    of_detector = [one for one in zip(points, normals, numbers, strict=True) if len(one[0])]
    alone = of_detector if len(of_detector) > 1 else []
    return [*together, *(edge for one in alone for edge in straight_edges(*one, side))]


def _laid(edges: list[Edge], scan: Scan) -> list[tuple[Edge, float]]:
    """Lay the edges between the pixels, and drop those that lie on a longer one."""
    openings = scan.seen_from(0.0)
    v, out = scan.directions(openings), []
    for edge in sorted(edges, key=lambda e: -e.length):
        for _ in range(2):  # which detectors show a band depends on the edge's direction
            signals = [wall_signal(o, tuple(scan.beam_shift), edge.normal) for o in openings]
            dark = [k for k, s in enumerate(signals) if kind_of(s) == "dark"]
            laid = lay_edge(edge, scan.images, dark, v) if dark else None
            if laid is None:
                break
            edge = replace(laid[0], detectors=tuple(dark))
        if laid is None:
            continue
        if not any(is_on(edge, other, scan.images.side) for other, _ in out):
            out.append((edge, laid[1]))
    return out


@dataclass(frozen=True)
class MeasuredEdge:
    """An edge with its combined height and its bands; `jump`: a rough height, for finding the patches [um]."""

    edge: Edge
    step: Step
    bands: tuple[BandRow, ...]
    jump: float

    def numbered(self, number: int) -> "MeasuredEdge":
        """Return the edge with another number."""
        bands = tuple(replace(band, step=number) for band in self.bands)
        return replace(self, step=replace(self.step, number=number), bands=bands)


def _low(scan: Scan, measured: list[MeasuredEdge]) -> list[MeasuredEdge]:
    """Find the steps that dashes show, apart from those whose bands are measured."""
    used = [m for m in measured if m.step.is_used]
    names, explained = scan.stack.instrument.detector_names, _explained(used, scan)
    found = find_low_steps(scan.images, scan.seen_from(0.0), scan.beam_shift, names, explained)
    low = (MeasuredEdge(edge, step, bands, step.height_um) for edge, step, bands in found)
    return [m for m in low if not any(is_on(u.edge, m.edge, scan.images.side) for u in used)]


def measure_edge(number: int, edge: tuple[Edge, float], scan: Scan, level: float) -> MeasuredEdge:
    """Measure the bands at an edge and combine them.

    Args:
        number: of the step.
        edge: with the gap between lit and dark pixels [um].
        scan: data.
        level: of the lower side [um].
    """
    line, gap = edge
    images, names = scan.images, scan.stack.instrument.detector_names
    openings = scan.seen_from(level)
    v = scan.directions(openings)
    signals = [wall_signal(o, tuple(scan.beam_shift), line.normal) for o in openings]
    place_std = math.hypot(gap / math.sqrt(12.0), _PLACE_STD * images.side)
    bands = _bands(line, scan, signals, v)
    if bands:
        shift, place_std = place_edge(line, images, signals, v, scan.beam_shift, bands)
        line = replace(line, start=line.start + shift * line.normal, end=line.end + shift * line.normal)
        bands = _bands(line, scan, signals, v)
    rows, used, masks = [], [], []
    for k, band in bands.items():
        row = _row(number, names[k], band, line, v[k], place_std, images.side)
        if band.kind == "lit" and row.note == "" and all(_differ(row, mask) for mask in masks):
            row = replace(row, note="disagrees with the mask bands")
        if band.kind == "dark":
            masks += [row] if row.note == "" and not row.is_lower_bound else []
            row = replace(row, p_wall=abruptness(line, images, k, v[k], band.factor * band.height))
        rows.append(row)
        if row.note == "" and not row.is_lower_bound:
            used.append(band)
    step = _combined(number, line, rows, used, place_std)
    rough = max((band.height for band in bands.values() if band.kind == "dark"), default=0.0)
    return MeasuredEdge(line, step, tuple(rows), step.height_um if step.is_used else rough)


def _differ(a: BandRow, b: BandRow) -> bool:
    """Return whether two heights differ by more than 4 standard deviations."""
    return abs(a.height_um - b.height_um) > 4.0 * math.hypot(a.height_std_um, b.height_std_um)


def _bands(line: Edge, scan: Scan, signals: list[WallSignal], v: np.ndarray) -> dict[int, Band]:
    """Fit the bands of all detectors at an edge, masks first: the image of a wall is searched near their height."""
    images, shift = scan.images, scan.beam_shift
    dark = [k for k, s in enumerate(signals) if kind_of(s) == "dark"]
    lit = [k for k, s in enumerate(signals) if kind_of(s) == "lit"]

    def fits(k: int, starts: Sequence[float | None]) -> Band | None:
        """Fit from several first heights; return the best."""
        found = [fit_band(line, images, k, signals[k], v[k], shift, start) for start in starts]
        known = [band for band in found if band is not None]
        return min(known, key=lambda band: band.chi2 / band.n_data) if known else None

    first = {k: band for k in dark if (band := fits(k, [None])) is not None}
    out = {}
    for k, band in first.items():
        others = [b.height for n, b in first.items() if n != k and abs(b.height - band.height) > 0.1 * b.height]
        again = fits(k, others)
        is_better = again is not None and again.chi2 / again.n_data < band.chi2 / band.n_data
        out[k] = again if again is not None and is_better else band
    starts = [b.height for b in out.values()]
    return out | {k: band for k in lit if starts and (band := fits(k, starts)) is not None}


def _row(number: int, name: str, band: Band, edge: Edge, v: np.ndarray, place_std: float, side: float) -> BandRow:
    """Turn a fitted band into a row of the table."""
    end = math.hypot(place_std, band.end_std)
    std = math.sqrt(band.std**2 + (end / band.factor) ** 2 + (_MODEL_STD * band.height) ** 2)
    slant = abs(float(v @ edge.normal)) / float(np.hypot(*v)) if band.kind == "dark" else 1.0
    to_length = band.factor / slant
    runs = -v if band.kind == "dark" else edge.normal
    misfit = band.chi2 / max(band.n_data - 4, 1)
    disturbed = disturbance(band)
    is_bound = disturbed == "interrupted"
    height = band.height
    if is_bound:
        height, std = band.least, side / (math.sqrt(12.0) * band.factor)
    note = "no wall explains the signal" if misfit > _MISFIT else disturbed
    if is_bound:
        note = ""
    elif band.factor * band.height < 0.4 * side:
        note = "too short"
    return BandRow(
        step=number,
        detector=name,
        kind=band.kind,
        length_um=to_length * height,
        length_std_um=to_length * std,
        height_um=height,
        height_std_um=std,
        is_lower_bound=is_bound,
        p_wall=math.nan,
        runs_deg=math.degrees(math.atan2(runs[1], runs[0])),
        note=note,
    )


def _combined(number: int, edge: Edge, rows: list[BandRow], used: list[Band], place_std: float) -> Step:
    """Combine the bands of an edge; the place of the upper edge is common to them."""
    height, std, chi2, note = math.nan, math.nan, 0.0, ""
    p_wall = max((r.p_wall for r in rows if math.isfinite(r.p_wall)), default=0.0)
    is_bound = False
    if any(b.kind == "dark" for b in used):
        h = np.array([b.height for b in used])
        factor = np.array([b.factor for b in used])
        own = np.array([b.std**2 + (b.end_std / b.factor) ** 2 for b in used])
        cov = np.diag(own + (_MODEL_STD * h) ** 2) + place_std**2 / np.outer(factor, factor)
        weight = np.linalg.solve(cov, np.ones(len(h)))
        height, std = float(weight @ h / weight.sum()), float(1.0 / math.sqrt(weight.sum()))
        chi2 = float((h - height) @ np.linalg.solve(cov, h - height))
        dof = len(h) - 1
        if dof and chi2 > dof:
            std *= math.sqrt(chi2 / dof)
        if dof and chi_square.sf(chi2, dof) < 1e-6 and np.ptp(h) > 0.1 * height:
            note = "bands disagree"
    elif bounds := [r for r in rows if r.is_lower_bound]:
        best = max(bounds, key=lambda r: r.height_um - r.height_std_um)
        height, std, is_bound, note = best.height_um, best.height_std_um, True, "lower bound"
    else:
        note = "not determined"
    if p_wall < MIN_WALL:
        note = "curved"
    along, normal = edge.along, edge.normal
    return Step(
        number=number,
        start=(float(edge.start[0]), float(edge.start[1])),
        end=(float(edge.end[0]), float(edge.end[1])),
        direction_deg=(math.degrees(math.atan2(along[1], along[0])) + 90.0) % 180.0 - 90.0,
        falls_deg=math.degrees(math.atan2(normal[1], normal[0])),
        height_um=height,
        height_std_um=std,
        n_bands=len(used),
        chi2=chi2,
        is_lower_bound=is_bound,
        p_wall=p_wall,
        above=0,
        below=0,
        note=note,
    )


def _patches(measured: list[MeasuredEdge], images: Images, levels: SignalLevels) -> np.ndarray:
    """Find the patches between the steps [y, x]."""
    walls = [m for m in measured if m.step.is_used or (m.step.p_wall > CERTAIN_WALL and m.jump > 0.0)]
    heights = np.array([m.jump for m in walls])
    alike = likeness(images.signal, images.variance, np.any(levels.is_dark, axis=0))
    patch = find_patches([m.edge for m in walls], heights, images.place, images.side, alike)
    return with_outlines_moved(patch, images.signal, images.variance, images.lit)


def _explained(measured: list[MeasuredEdge], scan: Scan) -> np.ndarray:
    """Return the pixels within the bands of the steps, and two pixels beside them [detector, y, x]."""
    images, names = scan.images, scan.stack.instrument.detector_names
    v = scan.directions(scan.seen_from(0.0))
    out = np.zeros(images.signal.shape, bool)
    for m in measured:
        for row in m.bands:
            if row.kind != "dark":
                continue
            k = names.index(row.detector)
            u, w = band_coordinates(m.edge, images, v[k])
            end = row.length_um * abs(float(v[k] @ m.edge.normal)) / float(np.hypot(*v[k]))
            beside = 2.0 * images.side
            room = 0.5 * m.edge.length + beside + 0.3 * np.maximum(u, 0.0)
            out[k] |= (u > -beside) & (u < 1.4 * end + beside) & (np.abs(w) < room)
    return out


def _joined(measured: list[MeasuredEdge], patch: np.ndarray, scan: Scan, levels: SignalLevels) -> Steps:
    """Solve for the levels of the patches."""
    images = scan.images
    steps = []
    # where two patches share the border, either may stand at the stated distance
    is_split = np.sum(border_shares(patch) > _SPLIT) > 1
    for m in measured:
        above, below = sides_of(m.edge, patch, images.place, images.side)
        step = replace(m.step, above=above, below=below)
        if above == below or is_split:  # the level from which the detectors are seen is not known
            range_of_error = step.height_um**2 / scan.stack.instrument.sample_distance
            unknown = range_of_error / (math.sqrt(3.0) if is_split else 2.0)
            step = replace(step, height_std_um=math.hypot(step.height_std_um, unknown))
        steps.append(step)
    n = int(patch.max()) + 1
    good = [s for s in steps if s.is_used]
    arrays = (np.array([getattr(s, name) for s in good]) for name in ("above", "below", "height_um", "height_std_um"))
    above, below, height, std = arrays
    found = solve_levels(n, above.astype(int), below.astype(int), height, std)
    unexplained = np.asarray(np.any(levels.is_dark & ~_explained(measured, scan), axis=0))
    patches = []
    for k in range(n):
        touching = [s for s in steps if k in (s.above, s.below) and s.above != s.below]
        patches.append(
            Patch(
                number=k,
                pixels=int(np.sum(patch == k)),
                level_um=float(found.level[k]),
                level_std_um=float(found.std[k]),
                n_steps=sum(s.is_used for s in touching),
                is_lower_bound=k > 0
                and not any(s.is_used for s in touching)
                and any(s.is_lower_bound for s in touching),
                unexplained=float(unexplained[patch == k].mean()),
            )
        )
    return Steps(
        steps=tuple(steps),
        bands=tuple(row for m in measured for row in m.bands),
        patches=tuple(patches),
        patch=patch,
        is_masked=levels.is_dark,
        p_masked=levels.probability,
        chi2=found.chi2,
        dof=found.dof,
    )
