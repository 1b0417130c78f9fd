"""Pictures read at other places, and several turned scans brought onto one raster: a stack ready for the heights.

Cubic interpolation. The variance stays honest where neighbours come to share noise: a pixel keeps the variance of the
raw ones, scaled by the ratio of the pixels' areas, so that the information in a region is what was recorded there; and
what the picture would change by within the alignment's own error is added.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from helio_jax.alignment.rigid import Rigid
from helio_jax.arrays import pitch
from helio_jax.errors import GuardError
from helio_jax.instrument import Detector, Instrument
from helio_jax.micrograph import MicrographSet, MicrographStack

MAX_PIXELS = 4_000_000
"""Largest common raster."""


def smooth(image: np.ndarray, is_known: np.ndarray, sigma: float) -> np.ndarray:
    """Return a picture smoothed by a Gaussian [pixels] over its known pixels; unknown ones are filled from these."""
    weight = ndimage.gaussian_filter(is_known.astype(float), max(sigma, 1e-9))
    total = ndimage.gaussian_filter(np.where(is_known, image, 0.0), max(sigma, 1e-9))
    level = float(np.mean(image[is_known])) if is_known.any() else 0.0
    return np.where(weight > 1e-6, total / np.maximum(weight, 1e-6), level)


class Readable(NamedTuple):
    """A picture made ready to be read anywhere (cubic splines).

    Attributes:
        coefficients: of the splines [y, x].
        known: True where recorded [y, x].
        x, y: its beam positions [um].
    """

    coefficients: np.ndarray
    known: np.ndarray
    x: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray, known: np.ndarray, x: np.ndarray, y: np.ndarray) -> "Readable":
        """Prepare a picture; unknown pixels are filled from those around them, and not read."""
        filled = image if known.all() else np.where(known, image, smooth(image, known, 1.0))
        return cls(np.asarray(ndimage.spline_filter(filled, order=3, mode="nearest")), known, x, y)

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values at points [..., 2], um, and True where all pixels around a point are known."""
        at = np.stack([(points[..., 1] - self.y[0]) / pitch(self.y), (points[..., 0] - self.x[0]) / pitch(self.x)])
        values = ndimage.map_coordinates(self.coefficients, at, order=3, mode="nearest", prefilter=False)
        margin = 1e-6
        is_inside = [(c >= -margin) & (c <= n - 1 + margin) for c, n in zip(at, self.known.shape, strict=True)]
        seen = is_inside[0] & is_inside[1]
        if not self.known.all():
            seen &= ndimage.map_coordinates(self.known.astype(float), at, order=1, mode="nearest") > 1.0 - 1e-6
        return values, seen


def common_raster(
    stacks: tuple[MicrographStack, ...], motions: tuple[Rigid, ...], field: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the beam positions x, y of the common frame, of the first scan's pitch and phase.

    Args:
        stacks: the scans.
        motions: of each.
        field: "reference": the first scan's own raster; "union": all that any scan recorded.

    Raises:
        GuardError: the union needs more than 4 million pixels.
    """
    first = stacks[0]
    if field == "reference":
        return first.x, first.y
    corners = [
        m.inverse().apply(np.array([(x, y) for x in s.x[[0, -1]] for y in s.y[[0, -1]]]))
        for s, m in zip(stacks, motions, strict=True)
    ]
    low, high = np.min(np.concatenate(corners), 0), np.max(np.concatenate(corners), 0)
    axes = []
    for axis, least, most in zip((first.x, first.y), low, high, strict=True):
        step = pitch(axis)
        before, after = math.floor((axis[0] - least) / step), math.floor((most - axis[-1]) / step)
        axes.append(axis[0] + step * np.arange(-max(before, 0), axis.size + max(after, 0)))
    if axes[0].size * axes[1].size > MAX_PIXELS:
        raise GuardError(
            f"the union of the scans needs {axes[0].size} x {axes[1].size} pixels of {pitch(first.x):g} um, the limit "
            f"is {MAX_PIXELS}: use --set field=reference, or give the scan with the coarsest raster first"
        )
    return axes[0], axes[1]


def turned_instrument(stacks: tuple[MicrographStack, ...], motions: tuple[Rigid, ...]) -> Instrument:
    """Return the instrument whose apertures are those of all scans, each turned back by its sample's rotation."""
    detectors = []
    for stack, motion in zip(stacks, motions, strict=True):
        back = Rigid(-motion.rotation, (0.0, 0.0))
        for detector, aperture in zip(stack.instrument.detector, stack.instrument.apertures(), strict=True):
            center = back.apply(np.asarray(aperture.center))
            rotation = math.degrees(aperture.rotation - motion.rotation)
            detectors.append(
                Detector(
                    name=f"{stack.name} {detector.name}"[:64],
                    center_um=(float(center[0]), float(center[1])),
                    axes_um=(2 * aperture.semi_axes[0], 2 * aperture.semi_axes[1]),
                    rotation_deg=math.remainder(rotation, 360.0),
                    channel=detector.channel,
                )
            )
    return stacks[0].instrument.model_copy(update={"detector": tuple(detectors)})


def scan_times(stacks: tuple[MicrographStack, ...], motions: tuple[Rigid, ...]) -> list[list[float]]:
    """Return, for every image, a, b, c of its scan's time a x + b y + c at points of the common frame, -1 to 1.

    Time counts along the slow axis; which end is the earlier is not told, nor needed for a smooth drift.
    """
    told = []
    for stack, motion in zip(stacks, motions, strict=True):
        axis, slow = (1, stack.y) if stack.fast_axis == "x" else (0, stack.x)
        half, middle = max(0.5 * float(np.ptp(slow)), pitch(slow)), 0.5 * float(slow[0] + slow[-1])
        a, b = motion.matrix[axis] / half
        told += [[float(a), float(b), (motion.shift[axis] - middle) / half]] * len(stack.instrument.detector)
    return told


def resample(
    scans: MicrographSet,
    motions: tuple[Rigid, ...],
    field: str = "union",
    position_std: tuple[float, ...] | None = None,
) -> MicrographStack:
    """Bring all scans onto one raster of the common frame.

    Args:
        scans: normal incidence.
        motions: of each scan.
        field: see `common_raster`.
        position_std: error of each motion, standard deviation of a pixel's place per axis [um]; default 0.

    Returns:
        One stack; a detector per scan and aperture. Pixels outside a scan are not observed there.
    """
    x, y = common_raster(scans.stacks, motions, field)
    points = np.stack(np.meshgrid(x, y), -1)
    area = pitch(x) * pitch(y)
    counts, variance, observed, background = [], [], [], []
    has_variance = all(s.variance is not None for s in scans.stacks)
    has_background = all(s.background is not None for s in scans.stacks)
    for stack, motion, std in zip(scans.stacks, motions, position_std or (0.0,) * len(motions), strict=True):
        places = motion.apply(points)
        ratio = pitch(stack.x) * pitch(stack.y) / area
        blur = 0.5 * math.sqrt(max(1.0 / ratio - 1.0, 0.0))  # finer scans are averaged over a pixel, about
        for k, (image, known) in enumerate(zip(stack.counts, stack.is_observed, strict=True)):
            finer = smooth(image, known, blur) if blur > 0.1 else image
            value, is_seen = Readable.of(finer, known, stack.x, stack.y).at(places)
            counts.append(np.where(is_seen, value, np.nan))
            observed.append(is_seen)
            if has_variance:
                raw = Readable.of(stack.variance[k], known, stack.x, stack.y).at(places)[0]  # type: ignore[index]
                down, along = np.gradient(value, y, x)
                own = np.maximum(raw, float(np.min(stack.variance[k][known]))) * ratio  # type: ignore[index]
                variance.append(np.where(is_seen, own + (down**2 + along**2) * std**2, np.nan))
            if has_background:
                level = stack.background[k]  # type: ignore[index]
                flat = np.full(points.shape[:2], level) if np.ndim(level) == 0 else level
                background.append(
                    flat if np.ndim(level) == 0 else Readable.of(level, known, stack.x, stack.y).at(places)[0]
                )
    same = {s.n_rays for s in scans.stacks}
    first = scans.stacks[0]
    return MicrographStack(
        counts=np.stack(counts),
        x=x,
        y=y,
        instrument=turned_instrument(scans.stacks, motions),
        variance=np.stack(variance) if has_variance else None,
        is_observed=np.stack(observed),
        background=np.stack(background) if has_background else None,
        n_rays=first.n_rays if len(same) == 1 else None,
        dwell=first.dwell if len({s.dwell for s in scans.stacks}) == 1 else None,
        fast_axis=first.fast_axis,
        sample_rotation=first.sample_rotation,
        noise=first.noise,
        unit=first.unit,
        name=f"{first.name} and {len(scans.stacks) - 1} more",
        provenance={
            "scans": [dict(s.provenance) for s in scans.stacks],
            "scan_time": scan_times(scans.stacks, motions),
        },
    )
