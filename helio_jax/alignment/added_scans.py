"""Scans of one sample in one orientation, added up: counts and dwell times add, pixel by pixel.

A further scan of a raster, or a list of positions on it (what `helio next` proposes), so becomes part of one stack
whose pixels have dwell times of their own (`MicrographStack.dwell_map`). Knows no heights and no noise model.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from helio_jax.arguments import checked
from helio_jax.arrays import as_float_array, pitch
from helio_jax.errors import InputFileError
from helio_jax.micrograph import OF_ONE_SCAN, MicrographStack

OFF_RASTER = 0.01
"""Positions of a list may be off the raster's by this share of its pitch."""
_SAME_TURN = 1e-6
"""Rotations that differ by less are the same [rad]."""


def is_same_orientation(first: MicrographStack, other: MicrographStack) -> bool:
    """Whether two scans see the sample from the same side: one instrument, one rotation of the sample."""
    turn = abs(math.remainder(first.sample_rotation - other.sample_rotation, math.tau))
    return first.instrument == other.instrument and turn < _SAME_TURN


@checked
def add_scans(first: MicrographStack, *others: MicrographStack) -> MicrographStack:
    """Add scans of one orientation: the mean of their counts, weighted by dwell time, and the sum of their dwell times.

    Source: the sum of independent Poisson counts is Poisson; the weighted mean is that sum over its time.

    Args:
        first: a raster; its beam positions, dwell time and number of beam atoms are those of the result.
        others: of the same instrument and rotation, on the same raster or lists of positions on it, with known dwell
            times; a position that occurs twice is counted twice.

    Returns:
        A stack with `dwell_map`. Where one has no variance, or no background, the result has none. Scattering orders,
        masks and other parts of simulated counts are dropped.

    Raises:
        InputFileError: other instruments, rotations, units or kinds of noise, an unknown dwell time, numbers of beam
            atoms that do not fit the dwell times, positions off the raster, scans that are joined.

    Example:
        >>> hx.add_scans(stack, stack).counts
    """
    for other in others:
        _check(first, other)
    on_raster = [part for stack in (first, *others) for part in _parts(first, stack)]
    seconds = np.stack([part[0] for part in on_raster])  # [part, detector, y, x]
    total = seconds.sum(0)
    known = np.where(total > 0.0, total, 1.0)

    def mean(number: int, power: int) -> np.ndarray | None:
        """Add arrays weighted by a power of the dwell times."""
        images = [part[number] for part in on_raster]
        if any(image is None for image in images):
            return None
        added = sum(t**power * np.nan_to_num(image) for t, image in zip(seconds, images, strict=True))
        return np.where(total > 0.0, added / known**power, np.nan)

    counts, variance, background = mean(1, 1), mean(2, 2), mean(3, 1)
    if background is not None:
        background = np.where(total > 0.0, background, 0.0)
    dropped = dict.fromkeys(OF_ONE_SCAN)
    return first.replace(
        counts=counts,
        variance=variance,
        background=background,
        is_observed=total > 0.0,
        dwell_map=total.max(0),
        provenance={"added": [dict(s.provenance) for s in (first, *others)]},
        **dropped,
    )


def add_by_orientation(stacks: Sequence[MicrographStack], *, only_lists: bool = False) -> tuple[MicrographStack, ...]:
    """Add all scans that see the sample from the same side; one stack of every orientation, in the order given.

    Args:
        stacks: rasters, and lists of positions on them; a list at a rotation without a raster is put on the beam
            positions of the first raster of its instrument, of which the rest is not observed.
        only_lists: add lists of positions only; rasters of one orientation stay scans of their own.

    Raises:
        InputFileError: a list of positions without a raster of its instrument; as `add_scans`.
    """
    rasters = [s for s in stacks if s.positions is None]
    out: list[list[MicrographStack]] = []
    for stack in [*rasters, *(s for s in stacks if s.positions is not None)]:
        same = [group for group in out if is_same_orientation(group[0], stack)]
        if same and not (only_lists and stack.positions is None):
            same[0].append(stack)
        elif stack.positions is None:
            out.append([stack])
        else:
            out.append([_empty_raster(stack, rasters), stack])
    return tuple(add_scans(*group) if len(group) > 1 else group[0] for group in out)


@checked
def add_positions(
    first: MicrographStack,
    xy_um: np.ndarray,
    dwell_s: np.ndarray,
    counts: np.ndarray,
    rotation_deg: float | None = None,
) -> MicrographStack:
    """Add what was recorded at a list of positions to a scan, e.g. at those that `hx.next_scan` proposes.

    The noise of the new counts is taken from the first scan: that of the same pixel, or, at another rotation, the
    median of each detector's, for the dwell time of the position.

    Args:
        first: a raster with known dwell time.
        xy_um: beam positions (x, y) on it [position, 2], um.
        dwell_s: counting times [position], s.
        counts: as recorded in these times, background included, in the units of the scan [detector, position].
        rotation_deg: of the sample [deg]; default: the scan's.

    Returns:
        The sum; or, at another rotation, a scan of its own on the same raster, observed at these positions only.

    Raises:
        InputFileError: arrays that do not fit, as `add_scans`.

    Example:
        >>> both = hx.add_positions(first, found.xy, found.dwell, counts)
        >>> rec = hx.reconstruct(both)
    """
    error, n = InputFileError, np.size(dwell_s)
    xy, seconds = as_float_array("xy_um", xy_um, (n, 2), error), as_float_array("dwell_s", dwell_s, (n,), error)
    recorded = as_float_array("counts", counts, (first.shape[0], n), error)
    if not n or not np.all(np.isfinite(seconds) & (seconds > 0.0)):
        raise error(
            f"dwell_s must hold one finite time > 0 s or more, got {n}: leave out positions that were not counted"
        )
    times = first.dwell_times
    if not first.dwell or times is None:
        raise error(f"{first.name}: states no dwell time: set it (MicrographStack.dwell)")
    turn = first.sample_rotation if rotation_deg is None else math.radians(rotation_deg)
    made = first.replace(
        **dict.fromkeys((*OF_ONE_SCAN, "is_observed", "variance")),
        counts=(recorded * first.dwell / seconds)[:, None],
        x=np.arange(float(n)),
        y=np.zeros(1),
        positions=xy,
        dwell_map=seconds[None],
        background=None if first.background is None else np.zeros((first.shape[0], 1, n)),
        sample_rotation=turn,
        name=f"{first.name}, listed",
        provenance={},
    )
    row, column = _pixels(first, made)
    changes: dict[str, Any] = {}
    is_same = is_same_orientation(first, made)
    if first.background is not None:
        level = first.background if first.background.ndim == 3 else first.background[:, None, None]
        changes["background"] = np.broadcast_to(level, first.shape)[:, row, column][:, None]
    if first.variance is not None:
        known = np.where(first.is_observed & (times > 0.0), first.variance * times, np.nan)
        usual = np.nanmedian(known, axis=(1, 2))[:, None]
        own = known[:, row, column] if is_same else np.broadcast_to(usual, (first.shape[0], n))
        changes["variance"] = (np.where(np.isfinite(own), own, usual) / seconds)[:, None]
    return add_by_orientation([first, made.replace(**changes)], only_lists=True)[-1]


def _empty_raster(stack: MicrographStack, rasters: Sequence[MicrographStack]) -> MicrographStack:
    """Make a raster for a list of positions at a rotation that has none, with nothing observed."""
    of_instrument = [r for r in rasters if r.instrument == stack.instrument]
    if not of_instrument:
        raise InputFileError(
            f"{stack.name}: is a list of positions: give a raster of the same instrument, too, on whose beam positions "
            "they lie"
        )
    first = of_instrument[0]
    dropped = dict.fromkeys(OF_ONE_SCAN)
    return first.replace(
        counts=np.full(first.shape, np.nan),
        is_observed=np.zeros(first.shape, bool),
        dwell_map=np.zeros(first.shape[1:]),
        sample_rotation=stack.sample_rotation,
        name=stack.name,
        provenance={},
        **dropped,
    )


def _parts(first: MicrographStack, stack: MicrographStack) -> list[tuple[np.ndarray, Any, Any, Any]]:
    """Bring a scan onto the first one's raster: seconds, counts, variance and background [detector, y, x].

    Counts are scaled to the first one's dwell time. A list of positions gives one part for each repeat of a position.
    """
    assert stack.dwell is not None and first.dwell is not None and stack.dwell_times is not None  # `_check`
    factor = first.dwell / stack.dwell
    seconds = np.where(stack.is_observed, stack.dwell_times, 0.0)
    background = stack.background
    if background is not None:
        background = factor * np.broadcast_to(
            background if background.ndim == 3 else background[:, None, None], stack.shape
        )
    variance = None if stack.variance is None else factor**2 * stack.variance
    images = seconds, factor * stack.counts, variance, background
    if stack.positions is None:
        return [images]
    row, column = _pixels(first, stack)
    repeat = _repeats(row * first.shape[2] + column)
    parts = []
    for number in range(int(repeat.max()) + 1):
        use = repeat == number
        placed = []
        for image in images:
            full = None if image is None else np.zeros(first.shape)
            if full is not None and image is not None:
                full[:, row[use], column[use]] = image[:, 0, use]
            placed.append(full)
        parts.append(tuple(placed))
    return parts


def _repeats(values: np.ndarray) -> np.ndarray:
    """Count how often every value [n] occurs before its place."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    out = np.empty(values.size, int)
    out[order] = np.arange(values.size) - np.repeat(starts, np.diff(np.append(starts, values.size)))
    return out


def _pixels(first: MicrographStack, stack: MicrographStack) -> tuple[np.ndarray, np.ndarray]:
    """Find rows and columns of listed positions on a raster [n].

    Raises:
        InputFileError: a position is not on it.
    """
    assert stack.positions is not None  # of the caller
    places = []
    for values, axis in zip(stack.positions.T, (first.x, first.y), strict=True):
        at = (values - axis[0]) / pitch(axis)
        nearest = np.rint(at).astype(int)
        wrong = (np.abs(at - nearest) > OFF_RASTER) | (nearest < 0) | (nearest >= axis.size)
        if wrong.any():
            x, y = stack.positions[np.argmax(wrong)]
            raise InputFileError(
                f"{stack.name}: positions must be pixels of {first.name}, to {OFF_RASTER:.0%} of its pitch, got "
                f"{int(wrong.sum())} others, the first at x = {x:g}, y = {y:g} um: leave them out"
            )
        places.append(nearest)
    return places[1], places[0]


def _check(first: MicrographStack, other: MicrographStack) -> None:
    """Refuse scans whose counts cannot be added."""
    both = f"{first.name} and {other.name} cannot be added"
    if first.positions is not None:
        raise InputFileError(f"{first.name}: is a list of positions: give a raster first, to which lists are added")
    if not is_same_orientation(first, other):
        raise InputFileError(
            f"{both}: instruments or rotations of the sample differ: reconstruct them as several scans of one surface"
        )
    names = ("unit", "noise", "calibration") + (("fast_axis",) if other.positions is None else ())
    for name in names:
        a, b = getattr(first, name), getattr(other, name)
        if a != b:
            raise InputFileError(f"{both}: {name} must be the same, got {a} and {b}: treat both scans alike first")
    for stack in (first, other):
        if not stack.dwell:
            raise InputFileError(
                f"{both}: {stack.name} states no dwell time: set it (MicrographStack.dwell, noise.dwell_s of a scene)"
            )
        if stack.parallax is not None or stack.alignment is not None:
            raise InputFileError(f"{both}: {stack.name} is aligned or joined already: add its scans before that")
    if other.positions is None and not _is_same_raster(first, other):
        raise InputFileError(f"{both}: their rasters differ: scan the same beam positions, or a list of some of them")
    if (first.n_rays is None) != (other.n_rays is None):
        raise InputFileError(f"{both}: beam atoms per pixel must be known for both or for none: calibrate both alike")
    if first.n_rays and other.n_rays:
        assert first.dwell and other.dwell
        rates = first.n_rays / first.dwell, other.n_rays / other.dwell
        if not math.isclose(*rates, rel_tol=1e-6):
            raise InputFileError(
                f"{both}: beam atoms per second must be the same, got {rates[0]:g} and {rates[1]:g}: correct dwell"
            )


def _is_same_raster(first: MicrographStack, other: MicrographStack) -> bool:
    """Whether two scans have the same beam positions."""
    return first.shape == other.shape and all(
        np.allclose(a, b, rtol=0.0, atol=OFF_RASTER * pitch(a)) for a, b in ((first.x, other.x), (first.y, other.y))
    )
