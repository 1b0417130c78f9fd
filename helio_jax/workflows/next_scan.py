"""Where to spend the next second: beam positions and dwell times that most reduce the variance of the heights.

What it takes: micrographs of the scans so far, whose heights are fitted here. What it gives: a list of positions within
a given time, of the present scans and of rotations that are offered, with the standard deviation of the heights that is
expected of it, and of the same time spent evenly. No truth is used: all follows from the fit.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import binary_closing

from helio_jax.alignment.added_scans import add_by_orientation
from helio_jax.alignment.resample import resample
from helio_jax.alignment.rigid import Rigid
from helio_jax.errors import SceneError
from helio_jax.formats.columns import write_columns
from helio_jax.inverse.dwell_information import N_PROBES, DwellInformation, RegionVariance
from helio_jax.inverse.further_images import with_further_images
from helio_jax.inverse.methods import warnings_of
from helio_jax.inverse.posterior import MAX_PIXELS
from helio_jax.inverse.samples import check_samples, thinning
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import OF_ONE_SCAN, Micrographs, MicrographSet, MicrographStack
from helio_jax.planning.dwell import Cost, DwellTimes, Groups, spend
from helio_jax.planning.positions import Positions, block_size, nearest_pixels, number_blocks, round_dwell
from helio_jax.workflows.heights import Report, calibrate, fit_scans

if TYPE_CHECKING:
    from helio_jax.inverse.fit import Fit

N_SAMPLES = 64
"""Samples of each posterior: standard deviations of a region are compared with the same random numbers."""
DWELL_STEP = 1e-3
"""Dwell times are whole multiples of this [s]."""
LEAST_DWELL = 0.02
"""Positions with less than this share of the even dwell time are left out."""
FAR = 5.0
"""Heights of the region whose standard deviation exceeds this multiple of the region's median do not count: walls and
floating parts, which hardly any counting determines, would else dominate the mean variance."""
NOISY = 0.1
"""Relative noise of a pixel's counts above which fits are not linear in it: in simulated loops (docs/next.md) the gain
was that expected with 200 counts per pixel, and none with 20."""
_SAME_DEG = 1e-3


@dataclass(frozen=True)
class Share:
    """What of the time one orientation of the sample gets.

    Attributes:
        rotation_deg: of the sample, as the files state it [deg].
        is_present: whether there is a scan at this rotation already.
        positions: number of positions to visit.
        seconds: counting time [s].
        share: of the counting time of all.
        shortest_s, longest_s: dwell times of its positions [s]; 0 without any.
    """

    rotation_deg: float
    is_present: bool
    positions: int
    seconds: float
    share: float
    shortest_s: float
    longest_s: float


@dataclass(frozen=True)
class NextScan:
    """Where to spend the next seconds.

    Attributes:
        name: of the first scan.
        seconds: that were offered [s].
        spent_s: that the list takes, counting, moves and rotations [s].
        region_um: low and high x, low and high y of the region, in the frame of the heights [um].
        region_pixels: number of its pixels that count.
        left_out: number of its pixels that do not: poorly determined ones (`FAR`).
        now_um: root mean square standard deviation of the region's heights so far [um].
        even_um: the same after the same time spent evenly on the present scans; None: that time does not allow for it.
        even_all_um: the same after that time spent evenly on all orientations; None: likewise, or none is offered.
        proposed_um: the same after the list.
        gap: by how much less the mean variance could be at most, on the visited blocks, relative.
        shares: of the orientations.
        rotations_deg: of every position [position], deg.
        xy: beam positions (x, y), in the coordinates of the file of that rotation [position, 2], um.
        dwell: dwell times [position], s.
        dwell_maps: of each orientation's raster [orientation][y, x], s.
        axes: x and y of these rasters [um].
        height: of the fit [y, x], um; height_axes: its x and y [um].
        std_now, std_proposed: standard deviation of every height so far, and after the list [y, x], um.
    """

    name: str
    seconds: float
    spent_s: float
    region_um: tuple[float, float, float, float]
    region_pixels: int
    left_out: int
    now_um: float
    even_um: float | None
    even_all_um: float | None
    proposed_um: float
    gap: float
    shares: tuple[Share, ...]
    rotations_deg: np.ndarray
    xy: np.ndarray
    dwell: np.ndarray
    dwell_maps: tuple[np.ndarray, ...]
    axes: tuple[tuple[np.ndarray, np.ndarray], ...]
    height: np.ndarray
    height_axes: tuple[np.ndarray, np.ndarray]
    std_now: np.ndarray
    std_proposed: np.ndarray

    @property
    def variance_ratio(self) -> float | None:
        """Mean variance after the list over that after the same time spent evenly, as expected; None: not possible."""
        return None if self.even_um is None else (self.proposed_um / self.even_um) ** 2

    def as_dict(self) -> dict[str, Any]:
        """Make a JSON-compatible record, without maps."""
        names = ("name", "seconds", "spent_s", "region_um", "region_pixels", "left_out", "now_um", "even_um")
        about = {name: getattr(self, name) for name in (*names, "even_all_um", "proposed_um", "gap")}
        more = {"variance_ratio": self.variance_ratio, "positions": int(self.dwell.size)}
        return about | more | {"shares": [asdict(s) for s in self.shares]}

    def write(self, path: str | Path) -> None:
        """Write the list of positions as CSV: rotation_deg, x_um, y_um, dwell_s, in scan order."""
        columns = {
            "rotation_deg": np.round(self.rotations_deg, 6),
            "x_um": np.round(self.xy[:, 0], 6),
            "y_um": np.round(self.xy[:, 1], 6),
            "dwell_s": np.round(self.dwell, 6),
        }
        write_columns(path, columns)


@dataclass(frozen=True)
class _Orientation:
    """One orientation of the sample: its scan, and how its pixels belong to those of the heights.

    Attributes:
        stack: of the scan so far, or one like it that is not recorded yet.
        images: which images of the fit's stack are of it.
        pixel: number of the scan's pixel that shows each height, -1: none [y, x].
        so_far: dwell times of the scan's pixels, 0 where not recorded [y, x], s.
        block: number of the block of every pixel of the scan, -1: not to be visited [y, x].
    """

    stack: MicrographStack
    images: slice
    pixel: np.ndarray
    so_far: np.ndarray
    block: np.ndarray

    @property
    def is_present(self) -> bool:
        """Whether anything is recorded."""
        return bool(self.so_far.any())

    @property
    def n_blocks(self) -> int:
        return int(self.block.max()) + 1

    def on_heights(self, dwell: np.ndarray) -> np.ndarray:
        """Return the dwell time of every height [y, x] for dwell times of the scan's pixels [y, x], s."""
        return np.where(self.pixel >= 0, dwell.ravel()[self.pixel], 0.0)

    def by_block(self, derivative: np.ndarray) -> np.ndarray:
        """Add derivatives by the dwell times of heights [detector, y, x] up to those by the blocks' [block]."""
        use = self.pixel >= 0
        of_pixel = np.bincount(self.pixel[use], derivative.sum(0)[use], minlength=self.block.size)
        inside = self.block.ravel() >= 0
        return np.bincount(self.block.ravel()[inside], of_pixel[inside], minlength=self.n_blocks)

    def extra(self, by_block: np.ndarray) -> np.ndarray:
        """Return dwell times of the scan's pixels [y, x] for dwell times of the blocks [block], s."""
        return np.where(self.block >= 0, by_block[self.block], 0.0)


def next_scan(
    micrographs: Micrographs | Sequence[Micrographs],
    seconds: float,
    *,
    region_um: tuple[float, float, float, float] | None = None,
    rotations_deg: Sequence[float] = (),
    move_s: float = 0.0,
    change_s: float = 0.0,
    block: int | None = None,
    settings: ReconstructSettings | None = None,
    n_samples: int = N_SAMPLES,
    report: Report | None = None,
    workers: int | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> NextScan:
    """Find the beam positions and dwell times that most reduce the mean variance of a region's heights (A-optimal).

    Heights are fitted to the micrographs by `refine`; the variance follows from the fit to first order
    (`inverse.dwell_information`). Add what is recorded (`alignment.added_scans`) and ask again: the next list knows it.

    Args:
        micrographs: of the scans so far, with known dwell time; scans of one orientation are added up.
        seconds: time to spend, counting, moves and rotations [s].
        region_um: low and high x, low and high y of the region that counts, beam positions of the height map
            [um]; default: all of it.
        rotations_deg: further rotations of the sample that could be scanned, as the files state them [deg].
        move_s: time to reach a position, without counting [s].
        change_s: time to change to another rotation [s].
        block: side of the squares of pixels that share a dwell time; default: at most 1024 squares per scan.
        settings: table [reconstruct].
        n_samples: of each posterior from which standard deviations are taken, 2 at least.
        report: called before each iteration of the fit.
        workers: threads that trace.
        say: called with what is done.

    Raises:
        SceneError: an unknown dwell time, expected counts, aligned scans, a region without pixels, a time or block out
            of range, a rotation that is scanned already, too few samples.
        InputFileError, GuardError: as `hx.reconstruct_scans`; the scans cannot be added.

    Example:
        >>> found = hx.next_scan(stack, 600.0, region_um=(-200, 200, -200, 200))
        >>> found.proposed_um, found.even_um
        >>> found.write("positions.csv")

    Source: own derivation; A-optimal design: Pukelsheim, Optimal Design of Experiments (1993), ch. 6.
    """
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise SceneError(f"the time to spend must be a finite time > 0 s, got {seconds:g}: correct it")
    for name, value in (("time to move", move_s), ("time to change the rotation", change_s)):
        if not (math.isfinite(value) and value >= 0.0):
            raise SceneError(f"the {name} must be a finite time >= 0 s, got {value:g}: correct it")
    check_samples(n_samples)
    given = [micrographs] if isinstance(micrographs, (MicrographStack, MicrographSet)) else list(micrographs)
    present = tuple(map(_ready, add_by_orientation([s for one in given for s in one.stacks])))
    _check_rotations(present, rotations_deg)
    shape = present[0].shape[1:]
    region, bounds = _region(region_um, present[0])
    block_size((shape[0], shape[1]), block, thinning(shape, MAX_PIXELS))
    known = {"settings": settings, "report": report, "workers": workers}
    fit, stack, motions, predict = fit_scans(MicrographSet(present), joins=bool(rotations_deg), **known)
    further = [_like(present[0], a) for a in rotations_deg]
    if fit.is_interrupted:
        raise KeyboardInterrupt
    for text in warnings_of(fit):
        say(f"warning: {text}")
    noise = fit.problem.slope_noise
    if noise > NOISY:
        say(
            f"warning: the counts of a pixel are known to {noise:.0%} only (limit {NOISY:.0%}), where fits are no "
            "longer linear in the noise: expected gains may not come true; scan evenly once more before"
        )
    if further:
        say(f"expected images at {', '.join(f'{a:g}' for a in rotations_deg)} deg")
    orientations = _orientations(stack, present, further, motions, block)
    so_far = _on_images(orientations, [o.so_far for o in orientations])
    if further:
        joint = _joint(stack, present, further, motions)
        n_old, typical = len(fit.problem.signal), float(np.median(so_far[so_far > 0.0]))
        reference = np.concatenate([so_far[:n_old], np.full((len(so_far) - n_old, *so_far.shape[1:]), typical)])
        detector = np.tile(np.arange(present[0].shape[0]), len(further))
        problem, state = with_further_images(fit, joint, predict(joint), reference, detector)
        orientations = _seen(orientations, problem.is_observed, block)
    else:
        problem, state, reference = fit.problem, fit.state, so_far
    about = DwellInformation.of(problem, state, reference, so_far)
    return _Asking(about, orientations, region, seconds, move_s, change_s).answer(stack, fit, bounds, n_samples, say)


@dataclass(frozen=True)
class _Asking:
    """What is asked of a fit: a region, a time, what moving costs."""

    about: DwellInformation
    orientations: tuple[_Orientation, ...]
    region: np.ndarray
    seconds: float
    move: float
    change: float

    @property
    def groups(self) -> Groups:
        """The blocks of all orientations."""
        n = [np.bincount(o.block[o.block >= 0], minlength=o.n_blocks) for o in self.orientations]
        return Groups(np.concatenate(n), np.repeat(np.arange(len(n)), [b.size for b in n]))

    def dwell_maps(self, by_block: np.ndarray) -> list[np.ndarray]:
        """Return the dwell times of all scans' pixels [orientation][y, x], s."""
        ends = np.cumsum([o.n_blocks for o in self.orientations])
        parts = np.split(by_block, ends[:-1])
        return [o.extra(part) for o, part in zip(self.orientations, parts, strict=True)]

    def after(self, maps: Sequence[np.ndarray]) -> np.ndarray:
        """Return the dwell times of all data after further ones [detector, y, x], s."""
        return _on_images(self.orientations, [o.so_far + m for o, m in zip(self.orientations, maps, strict=True)])

    def even(self, *, has_further: bool = False) -> list[np.ndarray] | None:
        """Spend the time evenly on the present scans, or on further ones, too; None where moving takes all of it."""
        pixels = [o.so_far > 0.0 if o.is_present else has_further & (o.block >= 0) for o in self.orientations]
        n = sum(int(p.sum()) for p in pixels)
        changes = sum(bool(p.any()) for p in pixels) - 1
        counting = self.seconds - n * self.move - changes * self.change
        return [np.where(p, counting / n, 0.0) for p in pixels] if counting > 0.0 else None

    @property
    def nothing(self) -> list[np.ndarray]:
        """No further dwell time [orientation][y, x]."""
        return [np.zeros(o.block.shape) for o in self.orientations]

    def std(self, dwell: Sequence[np.ndarray], n_samples: int) -> np.ndarray:
        """Compute the standard deviation of every height after further dwell times [y, x], um."""
        return self.about.posterior(self.after(dwell), n_samples).height_std

    def spend(self) -> DwellTimes:
        """Find the dwell times of the blocks."""
        even = self.even()
        factor = 1.0 if even is None else self.about.edge_factor(self.about.thinned(self.after(even)))
        variance = RegionVariance(self.about, self.region, factor, N_PROBES)

        def of_blocks(by_block: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = variance(self.after(self.dwell_maps(by_block)))
            return value, np.concatenate([o.by_block(slope[o.images]) for o in self.orientations])

        return spend(of_blocks, self.groups, self.seconds, Cost(self.move, self.change))

    def listed(self, found: DwellTimes) -> list[np.ndarray]:
        """Return the dwell times of all scans' pixels without very short ones, in whole steps, within the time."""
        maps = self.dwell_maps(found.dwell)
        n_all = sum(int(np.sum(o.block >= 0)) for o in self.orientations)
        least = max(LEAST_DWELL * self.seconds / n_all, DWELL_STEP)
        kept = [np.where(m >= least, m, 0.0) for m in maps]
        total = sum(float(m.sum()) for m in kept)
        used = sum(int(np.count_nonzero(m)) for m in kept)
        changes = sum(bool(m.any()) and i > 0 for i, m in enumerate(kept))
        counting = self.seconds - used * self.move - changes * self.change
        if not total:
            raise SceneError(
                f"{self.seconds:g} s are too short for {n_all} positions of {DWELL_STEP:g} s or more: give more time"
            )
        return [round_dwell(m * counting / total, DWELL_STEP) for m in kept]

    def answer(
        self,
        stack: MicrographStack,
        fit: "Fit",
        bounds: tuple[float, float, float, float],
        n_samples: int,
        say: Callable[[str], None],
    ) -> NextScan:
        """Find the list, and what is expected of it."""
        now = self.std(self.nothing, n_samples)
        counts = self.region & (now <= FAR * np.median(now[self.region]))
        asking = replace(self, region=counts)
        say("finding the dwell times")
        found, even = asking.spend(), self.even()
        maps = self.listed(found)
        say("expected standard deviations")
        proposed = self.std(maps, n_samples)
        evenly = None if even is None else self.std(even, n_samples)
        even_all = None if all(o.is_present for o in self.orientations) else self.even(has_further=True)
        evenly_all = None if even_all is None else self.std(even_all, n_samples)
        axes = tuple((o.stack.x, o.stack.y) for o in self.orientations)
        positions = Positions.of(maps, axes, self.orientations[0].stack.fast_axis)
        turns = np.array([math.degrees(o.stack.sample_rotation) for o in self.orientations])
        counting = float(positions.dwell.sum())
        shares = []
        for number, (o, image) in enumerate(zip(self.orientations, maps, strict=True)):
            own = image[image > 0.0]
            spent = float(own.sum())
            ends = (float(own.min()), float(own.max())) if own.size else (0.0, 0.0)
            shares.append(Share(float(turns[number]), o.is_present, own.size, spent, spent / counting, *ends))

        def rms(values: np.ndarray) -> float:
            return float(np.sqrt(np.mean(values[counts] ** 2)))

        return NextScan(
            name=self.orientations[0].stack.name,
            seconds=self.seconds,
            spent_s=positions.seconds(self.move, self.change),
            region_um=bounds,
            region_pixels=int(counts.sum()),
            left_out=int((self.region & ~counts).sum()),
            now_um=rms(now),
            even_um=None if evenly is None else rms(evenly),
            even_all_um=None if evenly_all is None else rms(evenly_all),
            proposed_um=rms(proposed),
            gap=found.gap,
            shares=tuple(shares),
            rotations_deg=turns[positions.scan],
            xy=positions.xy,
            dwell=positions.dwell,
            dwell_maps=tuple(maps),
            axes=axes,
            height=fit.surface.height,
            height_axes=(stack.x, stack.y),
            std_now=now,
            std_proposed=proposed,
        )


def _ready(stack: MicrographStack) -> MicrographStack:
    """Calibrate a measured scan as `hx.reconstruct` does.

    Raises:
        SceneError: its dwell time is not known, it has no counting noise, or it holds aligned or joined scans.
    """
    if stack.noise == "expected":
        raise SceneError(
            f"{stack.name}: holds expected counts, which have no counting noise to reduce: simulate with --noise"
        )
    if stack.alignment is not None or stack.parallax is not None:
        raise SceneError(
            f"{stack.name}: holds several scans, aligned or joined, without the dwell times of each: give the scans"
        )
    if not stack.dwell:
        raise SceneError(
            f"{stack.name}: the dwell time that its counts belong to is not known: set noise.dwell_s in the scene, or "
            "give --dwell"
        )
    return calibrate(stack) if stack.noise == "measured" and stack.n_rays is None else stack


def _check_rotations(present: Sequence[MicrographStack], rotations_deg: Sequence[float]) -> None:
    """Refuse rotations that are not finite, or there already."""
    there = [math.degrees(s.sample_rotation) for s in present]
    for i, angle in enumerate(rotations_deg):
        if not math.isfinite(angle):
            raise SceneError(f"every rotation must be a finite angle, got {angle}: correct it")
        others = [*there, *rotations_deg[:i]]
        if any(abs(math.remainder(angle - other, 360.0)) < _SAME_DEG for other in others):
            raise SceneError(f"the rotation of {angle:g} deg is scanned already or given twice: remove it")


def _like(first: MicrographStack, rotation_deg: float) -> MicrographStack:
    """Make a scan like the first one at another rotation, not recorded yet: its counts only fill its place."""
    level = float(np.median(first.counts[first.is_observed]))
    filled = np.full(first.shape, level)
    dropped = dict.fromkeys((*OF_ONE_SCAN, "dwell_map"))
    return first.replace(
        counts=filled,
        variance=None if first.variance is None else np.full(first.shape, max(level, 1.0)),
        is_observed=np.ones(first.shape, bool),
        sample_rotation=math.radians(rotation_deg),
        name=f"{rotation_deg:g} deg",
        provenance={},
        **dropped,
    )


def _joint(
    stack: MicrographStack,
    present: Sequence[MicrographStack],
    further: Sequence[MicrographStack],
    motions: Sequence[Rigid],
) -> MicrographStack:
    """Bring present and further scans onto the raster of the heights; present images stay as they were fitted."""
    of_all = (*motions, *(Rigid(s.sample_rotation, (0.0, 0.0)) for s in further))
    joint = resample(
        MicrographSet((*present, *further)), of_all, "reference", (0.0,) * len(of_all), stack.parallax_height
    )
    n = stack.shape[0]
    images = {"counts": joint.counts, "is_observed": joint.is_observed, "variance": joint.variance}
    for name, image in images.items():
        if image is not None:
            image = image.copy()
            image[:n] = getattr(stack, name)
            images[name] = image
    return joint.replace(**images, n_rays=stack.n_rays, dwell=stack.dwell)


def _orientations(
    stack: MicrographStack,
    present: Sequence[MicrographStack],
    further: Sequence[MicrographStack],
    motions: Sequence[Rigid],
    block: int | None,
) -> tuple[_Orientation, ...]:
    """List present and further orientations; every pixel of their rasters that shows a height may be visited."""
    points, out, n_done = np.stack(np.meshgrid(stack.x, stack.y), -1), [], 0
    of_all = (*motions, *(Rigid(s.sample_rotation, (0.0, 0.0)) for s in further))
    for number, scan in enumerate((*present, *further)):
        if not of_all:  # the scan's own frame
            pixel = np.arange(points[..., 0].size).reshape(points.shape[:2])
        else:
            height = 0.0 if stack.parallax_height is None else stack.parallax_height[..., None]
            places = of_all[number].apply(points) + height * np.asarray(scan.instrument.beam_shift)
            pixel = nearest_pixels(places, scan.x, scan.y)
        images = slice(n_done, n_done + scan.shape[0])
        n_done = images.stop
        is_new = number >= len(present)
        times = scan.dwell_times
        assert times is not None  # `_ready`
        so_far = np.zeros(scan.shape[1:]) if is_new else times
        out.append(_with_blocks(scan, images, pixel, so_far, block, points.shape[:2]))
    return tuple(out)


def _with_blocks(
    scan: MicrographStack,
    images: slice,
    pixel: np.ndarray,
    so_far: np.ndarray,
    block: int | None,
    shape: tuple[int, ...],
) -> _Orientation:
    """Number the blocks of the pixels that show a height, without holes between them."""
    may_visit = np.zeros(scan.shape[1:], bool)
    may_visit.ravel()[pixel[pixel >= 0]] = True
    may_visit |= binary_closing(may_visit, np.ones((3, 3)))
    size = block_size((scan.shape[1], scan.shape[2]), block, thinning(shape, MAX_PIXELS))
    return _Orientation(scan, images, pixel, so_far, number_blocks(may_visit, size))


def _seen(orientations: Sequence[_Orientation], is_observed: np.ndarray, block: int | None) -> tuple[_Orientation, ...]:
    """Leave out pixels whose beam does not reach the surface that they are to show; `is_observed` [detector, y, x]."""
    out = []
    for o in orientations:
        pixel = np.where(is_observed[o.images].any(0), o.pixel, -1)
        if (pixel < 0).all():
            raise SceneError(
                f"no height is seen at a rotation of {math.degrees(o.stack.sample_rotation):g} deg: remove it"
            )
        out.append(_with_blocks(o.stack, o.images, pixel, o.so_far, block, pixel.shape))
    return tuple(out)


def _on_images(orientations: Sequence[_Orientation], dwell: Sequence[np.ndarray]) -> np.ndarray:
    """Return the dwell time of every datum [detector, y, x] for those of all scans' pixels [orientation][y, x], s."""
    parts = []
    for o, image in zip(orientations, dwell, strict=True):
        parts.append(np.broadcast_to(o.on_heights(image), (o.images.stop - o.images.start, *o.pixel.shape)))
    return np.concatenate(parts)


def _region(
    region_um: tuple[float, float, float, float] | None, stack: MicrographStack
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Return the pixels of a region [y, x], and its bounds [um].

    Raises:
        SceneError: it has no pixel.
    """
    bounds = tuple(float(v) for axis in (stack.x, stack.y) for v in (axis[0], axis[-1]))
    given = bounds if region_um is None else tuple(map(float, region_um))
    in_x, in_y = (stack.x >= given[0]) & (stack.x <= given[1]), (stack.y >= given[2]) & (stack.y <= given[3])
    inside = in_y[:, None] & in_x[None, :]
    if len(given) != 4 or not inside.any():
        shown = " ".join(f"{v:g}" for v in given)
        limits = f"x {bounds[0]:g} to {bounds[1]:g}, y {bounds[2]:g} to {bounds[3]:g} um"
        raise SceneError(
            f"the region X0 X1 Y0 Y1 must hold pixels of the height map ({limits}), got {shown}: correct it"
        )
    return inside, (given[0], given[1], given[2], given[3])
