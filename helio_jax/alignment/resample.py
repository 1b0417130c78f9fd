"""Interpolation of images, and resampling of several rotated scans onto one raster: a stack ready for the heights.

Cubic splines. Interpolated neighbours share noise, so a pixel keeps the variance of the raw pixels times the ratio of
the pixels' areas: the information of a region is that of its readings. The change of the image within the error of the
alignment is added to the variance.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from helio_jax.alignment.rigid import Rigid
from helio_jax.arrays import pitch
from helio_jax.campaign import MAX_LAW_STD, CampaignLaw
from helio_jax.detector import MAX_NAME
from helio_jax.errors import GuardError, InputFileError
from helio_jax.geometry_prior import errors_in_common, geometry_covariance
from helio_jax.instrument import MAX_DETECTORS, Detector, Instrument, Uncertainty
from helio_jax.micrograph import OF_ONE_SCAN, Calibration, MicrographSet, MicrographStack, ScanAlignment

MAX_PIXELS = 4_000_000
"""Largest common raster."""
LAWS_DIFFER = 3.0
"""Difference of two scattering laws from which on they are not of one sample [standard deviations]."""
SAME_ERRORS = 0.02
"""Tables [covariance] agree to this share of the variances: they are rounded."""
SAME_PLACE = 0.01
"""Apertures nearer to one another are the same [um]."""
_MARCH = 0.5
"""Step of the search for what shadows a point [pixels]."""


def smooth(image: np.ndarray, is_known: np.ndarray, sigma: float) -> np.ndarray:
    """Smooth an image by a Gaussian [pixels] over its known pixels; unknown pixels are filled from these."""
    weight = ndimage.gaussian_filter(is_known.astype(float), max(sigma, 1e-9))
    total = ndimage.gaussian_filter(np.where(is_known, image, 0.0), max(sigma, 1e-9))
    level = float(np.mean(image[is_known])) if is_known.any() else 0.0
    return np.where(weight > 1e-6, total / np.maximum(weight, 1e-6), level)


class SplineImage(NamedTuple):
    """An image as cubic splines, to be interpolated anywhere.

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
    def of(cls, image: np.ndarray, known: np.ndarray, x: np.ndarray, y: np.ndarray) -> "SplineImage":
        """Compute the splines; unknown pixels are filled from their neighbours and stay unknown."""
        filled = image if known.all() else np.where(known, image, smooth(image, known, 1.0))
        return cls(np.asarray(ndimage.spline_filter(filled, order=3, mode="nearest")), known, x, y)

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate at points [..., 2], um; also True where all pixels around a point are known."""
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
    """Compute the beam positions x, y of the common frame, with the first scan's pitch and phase.

    Args:
        stacks: the scans.
        motions: of each.
        field: "reference": the first scan's own raster; "union": the union of all fields.

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


def joined_instrument(stacks: tuple[MicrographStack, ...], motions: tuple[Rigid, ...]) -> Instrument:
    """Combine the apertures and laws of all scans in one instrument, each rotated back by its sample's rotation.

    Where a scan's beam is oblique, each detector keeps the beam of its scan, and the raster sees the sample straight
    down (`Instrument.has_several_beams`). Where the geometry is uncertain, its errors are the same in all scans
    (`errors_in_common`).
    """
    detectors, names = [], _joined_names(stacks)
    beams = [s.instrument.beam for s in stacks]
    is_oblique = any(b.incidence_deg for b in beams)
    for stack, motion in zip(stacks, motions, strict=True):
        back = Rigid(-motion.rotation, (0.0, 0.0))
        beam, turn = stack.instrument.beam, math.degrees(motion.rotation)
        of_scan = (beam.incidence_deg, math.remainder(beam.azimuth_deg - turn, 360.0)) if is_oblique else None
        for detector, aperture in zip(stack.instrument.detector, stack.instrument.apertures(), strict=True):
            center = back.apply(np.asarray(aperture.center))
            rotation = math.degrees(aperture.rotation - motion.rotation)
            detectors.append(
                Detector(
                    name=names[len(detectors)],
                    center_um=(float(center[0]), float(center[1])),
                    axes_um=(2 * aperture.semi_axes[0], 2 * aperture.semi_axes[1]),
                    rotation_deg=math.remainder(rotation, 360.0),
                    channel=detector.channel,
                    beam_deg=of_scan,
                )
            )
    beam = beams[0].changed(incidence_deg=0.0, azimuth_deg=0.0) if is_oblique else beams[0]
    instruments = [s.instrument for s in stacks]
    update = {
        "beam": beam,
        "detector": tuple(detectors),
        "law": _joined_law(stacks),
        "uncertainty": _joined_uncertainty(instruments),
        "covariance": errors_in_common(instruments, _plates(instruments), names),
    }
    return stacks[0].instrument.model_copy(update=update)


def _joined_names(stacks: Sequence[MicrographStack]) -> list[str]:
    """Name the detectors of joined scans by scan and detector, each name once and of at most `MAX_NAME` characters."""
    parts = [(number, stack.name, d.name) for number, stack in enumerate(stacks, 1) for d in stack.instrument.detector]
    for names in (
        [f"{scan} {detector}" for _, scan, detector in parts],
        [f"{f'{number} {scan}'[: MAX_NAME // 2 - 1]} {detector[: MAX_NAME // 2]}" for number, scan, detector in parts],
    ):
        if len(set(names)) == len(names) and max(map(len, names)) <= MAX_NAME:
            return names
    return [f"{number} {at}" for at, (number, _, _) in enumerate(parts, 1)]


def _plates(instruments: Sequence[Instrument]) -> list[tuple[int, list[int]]]:
    """Find the scans by one plate: those whose apertures are in the same places, in any order, or a part of them.

    Returns:
        For every instrument the number of the first one with all apertures of its plate, and which of its apertures
        each own one is.
    """
    centers = [np.array([a.center for a in instrument.apertures()]) for instrument in instruments]
    numbers = sorted(range(len(centers)), key=lambda k: -len(centers[k]))
    plates: dict[int, tuple[int, list[int]]] = {}
    for number in numbers:
        whole = (k for k, (plate, _) in plates.items() if k == plate)
        matched = ((k, _matched(centers[number], centers[k])) for k in whole)
        own = number, list(range(len(centers[number])))
        plates[number] = next(((k, same) for k, same in matched if same is not None), own)
    return [plates[number] for number in range(len(instruments))]


def _matched(here: np.ndarray, there: np.ndarray) -> list[int] | None:
    """Find the place among others [aperture, 2] that each of some places is; None: some are not among them."""
    apart = np.abs(here[:, None] - there).max(axis=2)
    same = np.argmin(apart, axis=1)
    is_matched = np.all(apart.min(axis=1) < SAME_PLACE) and len(set(same.tolist())) == len(same)
    return same.tolist() if is_matched else None


def _joined_uncertainty(instruments: Sequence[Instrument]) -> Uncertainty:
    """Return the uncertainty of joined scans: of everything that of the scan which knows least."""
    stated = [instrument.uncertainty.model_dump() for instrument in instruments]
    return Uncertainty(**{name: max(each[name] for each in stated) for name in stated[0]})


def _check_uncertainties(stacks: Sequence[MicrographStack]) -> None:
    """Refuse scans by one plate that state different errors of it; raises as `check_joinable`."""
    instruments = [s.instrument for s in stacks]
    tables = [_stated_covariance(instrument) for instrument in instruments]
    for number, (stack, (first, apertures)) in enumerate(zip(stacks, _plates(instruments), strict=True)):
        of_part = [0, *(1 + 2 * a + k for a in apertures for k in (0, 1))]
        whole, own = tables[first][np.ix_(of_part, of_part)], tables[number]
        unit = np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
        for what, is_same in (
            ("[uncertainty]", instruments[first].uncertainty == instruments[number].uncertainty),
            ("[covariance]", bool(np.all(np.abs(whole - own) <= SAME_ERRORS * unit))),
        ):
            if not is_same:
                raise InputFileError(
                    f"{stack.name!r} and {stacks[first].name!r} are scans by one pinhole plate, whose errors they "
                    f"share, but their tables {what} differ: give the tables [uncertainty] and [covariance] of one of "
                    "their instrument files to both (where one has fewer detectors: without the rows and columns of "
                    "the others), and import them anew"
                )


def _stated_covariance(instrument: Instrument) -> np.ndarray:
    """Compute what the table [covariance] of an instrument states of distance and directions; 0 without the table."""
    if instrument.covariance is None:
        return np.zeros((1 + 2 * len(instrument.detector),) * 2)
    return geometry_covariance(instrument, instrument.covariance)


def check_joinable(stacks: Sequence[MicrographStack]) -> None:
    """Refuse scans whose counts have no common unit.

    Raises:
        InputFileError: some are calibrated in another way than others, or state scattering laws that disagree or that
            determine the exponent too badly; scans by one plate differ in [uncertainty] or [covariance]; or they have
            more detectors in all than an instrument may have.
    """
    n_detectors = sum(len(s.instrument.detector) for s in stacks)
    if n_detectors > MAX_DETECTORS:
        raise InputFileError(
            f"scans that are joined have {n_detectors} detectors in all, the limit is {MAX_DETECTORS}: join fewer scans"
        )
    kinds = {None if c is None else (c.method, c.without_multiple) for c in (s.calibration for s in stacks)}
    if len(kinds) > 1:
        names = ", ".join(f"{s.name}: {'none' if s.calibration is None else s.calibration.method}" for s in stacks)
        raise InputFileError(
            f"scans that are joined must be calibrated alike, got {names}: calibrate all imported files alike (helio "
            "calibrate); simulated and measured scans cannot be joined"
        )
    _check_uncertainties(stacks)
    _joined_law(stacks)


def _joined_law(stacks: Sequence[MicrographStack]) -> CampaignLaw | None:
    """Return the scattering law of a sample by the scans that state one, as a weighted mean; None: none does.

    Scans that state the same law (to four digits) share its measurement, which counts once. The standard deviation is
    the weighted mean of theirs, for what samples differ by is common to all scans of one. Where the laws scatter by
    more, it is multiplied by the Birge ratio: the root of chi-square over the degrees of freedom.

    Raises:
        InputFileError: two differ by more than `LAWS_DIFFER` standard deviations, or m is known to no better than
            `MAX_LAW_STD` by all of them.
    """
    first_scan: dict[str, tuple[str, CampaignLaw]] = {}
    for stack in stacks:
        if (law := stack.instrument.law) is not None:
            first_scan.setdefault(f"{law.exponent:.4g} {law.std:.4g}", (stack.name, law))
    stated = list(first_scan.values())
    if not stated:
        return None
    for (one, a), (other, b) in itertools.combinations(stated, 2):
        if abs(a.exponent - b.exponent) > LAWS_DIFFER * math.hypot(a.std, b.std):
            raise InputFileError(
                f"scans that are joined must agree on the scattering law, got m = {a.exponent:g} +- {a.std:g} of "
                f"{one!r} and {b.exponent:g} +- {b.std:g} of {other!r}: correct or remove the tables [law] of their "
                f"instrument files (limit {LAWS_DIFFER:g} standard deviations)"
            )
    exponent, stds = np.array([(law.exponent, law.std) for _, law in stated]).T
    mean, own = (float(np.average(values, weights=stds**-2.0)) for values in (exponent, stds))
    birge = math.sqrt(float(np.sum(((exponent - mean) / stds) ** 2)) / max(len(stated) - 1, 1))
    std = own * max(1.0, birge)
    if std > MAX_LAW_STD:
        names = ", ".join(repr(name) for name, _ in stated)
        raise InputFileError(
            f"scans that are joined: the laws that they state determine m to +- {std:.2g} only (limit "
            f"{MAX_LAW_STD:g}): correct or remove the tables [law] of the instrument files of {names}"
        )
    return CampaignLaw(exponent=mean, std=std)


def _calibration(stacks: Sequence[MicrographStack]) -> Calibration | None:
    """Return the calibration of joined scans, with the widest priors and the warnings of all; None: they have none."""
    known = [stack.calibration for stack in stacks if stack.calibration is not None]
    if not known:
        return None
    warnings = tuple(dict.fromkeys(w for c in known for w in c.warnings))
    return replace(known[0], priors=_widest([c.priors for c in known]), warnings=warnings)


def _widest(priors: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the largest of what several calibrations state of each setting.

    Settings that are lists, the limits of a fit's solves, are those of the first that states them.
    """
    stated: dict[str, Any] = {}
    for name, value in (item for each in priors for item in each.items()):
        is_list = isinstance(value, (list, tuple))
        stated[name] = stated.get(name, value) if is_list else max(value, stated.get(name, value))
    return stated


def is_lit(height: np.ndarray, x: np.ndarray, y: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Find the points of a surface that a beam reaches [y, x]; pixels beside a shadow count as shadowed.

    Args:
        height: above the substrate [y, x], um; beyond the image there is nothing in the way.
        x, y: axes of the sample frame [um].
        shift: the beam's displacement (x, y) per um of depth.
    """
    tan, steps = float(np.hypot(*shift)), np.array([pitch(y), pitch(x)])
    rows, columns = np.mgrid[: height.shape[0], : height.shape[1]].astype(float)
    is_shadowed = np.zeros(height.shape, bool)
    if tan:
        step = _MARCH * float(steps.min())
        back = -np.array([shift[1], shift[0]]) / tan * step / steps  # pixels, towards where the beam comes from
        for n in range(1, math.ceil(tan * float(np.ptp(height)) / step) + 1):
            at = np.stack([rows + n * back[0], columns + n * back[1]])
            there = ndimage.map_coordinates(height, at, order=1, mode="constant", cval=-np.inf)
            is_shadowed |= there > height + n * step / tan
    return ~np.asarray(ndimage.binary_dilation(is_shadowed, np.ones((3, 3))), bool)


def scan_times(
    stacks: tuple[MicrographStack, ...], motions: tuple[Rigid, ...]
) -> tuple[tuple[float, float, float], ...]:
    """Compute `ScanAlignment.time_planes`: for every image the time of its scan at points of the common frame.

    Time runs along the slow axis. Files do not state its sense, which a smooth drift does not need.
    """
    planes = []
    for stack, motion in zip(stacks, motions, strict=True):
        axis, slow = (1, stack.y) if stack.fast_axis == "x" else (0, stack.x)
        half, middle = max(0.5 * float(np.ptp(slow)), pitch(slow)), 0.5 * float(slow[0] + slow[-1])
        a, b = motion.matrix[axis] / half
        planes += [(float(a), float(b), (motion.shift[axis] - middle) / half)] * len(stack.instrument.detector)
    return tuple(planes)


def resample(
    scans: MicrographSet,
    motions: tuple[Rigid, ...],
    field: str = "union",
    position_std: tuple[float, ...] | None = None,
    height: np.ndarray | None = None,
) -> MicrographStack:
    """Resample all scans onto one raster of the common frame.

    The point of height z is in a scan where its beam meets that point: moved by z tan(incidence) along its azimuth.

    Args:
        scans: of one plate at one distance.
        motions: of each scan.
        field: see `common_raster`.
        position_std: error of each motion, standard deviation of a pixel's place per axis [um]; default 0.
        height: of the surface on that raster [y, x], um; needed where a beam is oblique.

    Returns:
        One stack; a detector per scan and aperture. Points outside a scan or in its shadow are not observed there.

    Raises:
        GuardError: too many pixels.
        InputFileError: `check_joinable`.
    """
    check_joinable(scans.stacks)
    x, y = common_raster(scans.stacks, motions, field)
    points = np.stack(np.meshgrid(x, y), -1)
    area = pitch(x) * pitch(y)
    counts, variance, observed, background, parallax = [], [], [], [], []
    has_variance = all(s.variance is not None for s in scans.stacks)
    has_background = all(s.background is not None for s in scans.stacks)
    for stack, motion, std in zip(scans.stacks, motions, position_std or (0.0,) * len(motions), strict=True):
        places = motion.apply(points)
        shift, is_reached = np.asarray(stack.instrument.beam_shift), True
        if height is not None:
            places = places + height[..., None] * shift
            is_reached = is_lit(height, x, y, shift @ motion.matrix)
        ratio = pitch(stack.x) * pitch(stack.y) / area
        blur = 0.5 * math.sqrt(max(1.0 / ratio - 1.0, 0.0))  # finer scans are averaged over a pixel, about
        for k, (image, known) in enumerate(zip(stack.counts, stack.is_observed, strict=True)):
            finer = smooth(image, known, blur) if blur > 0.1 else image
            splines = SplineImage.of(finer, known, stack.x, stack.y)
            value, is_seen = splines.at(places)
            is_seen &= is_reached
            if height is not None:
                # um of height that move a place half a pixel
                step = 0.5 * pitch(stack.x) / max(float(np.hypot(*shift)), 1e-9)
                ahead, behind = (splines.at(places + sign * step * shift)[0] for sign in (1.0, -1.0))
                parallax.append(np.where(is_seen, (ahead - behind) / (2.0 * step), 0.0))
            counts.append(np.where(is_seen, value, np.nan))
            observed.append(is_seen)
            if has_variance:
                raw = SplineImage.of(stack.variance[k], known, stack.x, stack.y).at(places)[0]  # type: ignore[index]
                down, along = np.gradient(value, y, x)
                own = np.maximum(raw, float(np.min(stack.variance[k][known]))) * ratio  # type: ignore[index]
                variance.append(np.where(is_seen, own + (down**2 + along**2) * std**2, np.nan))
            if has_background:
                level = np.broadcast_to(stack.background[k], image.shape)  # type: ignore[index]
                background.append(SplineImage.of(level, known, stack.x, stack.y).at(places)[0])
    first = scans.stacks[0]
    dropped = dict.fromkeys((*OF_ONE_SCAN, "dwell_map"))
    return first.replace(
        counts=np.stack(counts),
        x=x,
        y=y,
        instrument=joined_instrument(scans.stacks, motions),
        variance=np.stack(variance) if has_variance else None,
        is_observed=np.stack(observed),
        background=np.stack(background) if has_background else None,
        parallax=None if height is None else np.stack(parallax),
        parallax_height=height,
        n_rays=first.n_rays if len({s.n_rays for s in scans.stacks}) == 1 else None,
        calibration=_calibration(scans.stacks),
        dwell=first.dwell if len({s.dwell for s in scans.stacks}) == 1 else None,
        name=f"{first.name} and {len(scans.stacks) - 1} more",
        alignment=ScanAlignment(scan_times(scans.stacks, motions)),
        provenance={"scans": [dict(s.provenance) for s in scans.stacks]},
        **dropped,
    )
