"""Why a height should not be trusted: too few images, masks, a depth jump, or a region whose level nothing fixes.

The limits that make up the rule of `is_valid` are those of `validity`.
"""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import binary_erosion, uniform_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from helio_jax.arrays import typical_signals
from helio_jax.forward.surface import along
from helio_jax.inverse.edges import ranked, trapezoid_gap
from helio_jax.inverse.linear import MIN_IMAGES, signal_of
from helio_jax.micrograph import MicrographStack
from helio_jax.validity import EXPLAINED, FACET_IMAGES, FLOATING, MAX_CONTRADICTED_REGION, REASONS

MASK_LIMIT = 0.1
"""A datum darker than this share of the detector's flat signal counts as masked."""
JOINED = 0.25
"""Edges with less weight than this are cut; a pixel with such an edge is at a depth jump, unless the jump is small."""
SMALLEST_JUMP = 0.1
"""Misfit of a cut edge, in pitches, below which it is no depth jump: noise cuts one edge in some hundreds."""
TRUSTED = 0.5
"""A pixel with a datum of less robust weight than this is not explained by the model."""
_LARGEST = 25.0
"""A datum counts with this square at most."""
VEILED = 5.0
"""A datum whose assumed deviation is this many times that of its counts is not informative of a facet."""
MIN_REGION = 16
"""Smaller regions are part of the jump that surrounds them [pixels]."""
CORE = 2
"""Pixels of a region that are nearer to its outline do not tell whether the data contradict it."""
_FEW, _MASKED, _JUMP, _FLOATING = (REASONS.index(r) for r in (REASONS[1], REASONS[2], REASONS[3], "floating"))


def reasons_from_data(stack: MicrographStack, min_images: int = MIN_IMAGES) -> np.ndarray:
    """Find why a pixel is not valid, from the data alone (index into REASONS) [y, x].

    Args:
        stack: the images.
        min_images: of a pixel that is solved: one for each of its unknowns.
    """
    reason = np.zeros(stack.shape[1:], np.uint8)
    signal, _ = signal_of(stack)
    flat = typical_signals(signal)[:, None, None]
    n_images = stack.is_observed.sum(0)
    n_dark = np.sum(np.nan_to_num(signal, nan=np.inf) < MASK_LIMIT * flat, axis=0)
    reason[n_images - n_dark < FACET_IMAGES] = _MASKED
    reason[n_images < min_images] = _FEW
    return reason


def regions(joined_x: np.ndarray, joined_y: np.ndarray) -> np.ndarray:
    """Number the region of every pixel [y, x]: pixels joined by joined edges; the largest region is 0.

    Args:
        joined_x, joined_y: weight left to the edges [y, x - 1], [y - 1, x].
    """
    shape = (joined_x.shape[0], joined_y.shape[1])
    pixel = np.arange(shape[0] * shape[1]).reshape(shape)
    is_joined = joined_y >= JOINED, joined_x >= JOINED
    start, end = (
        np.concatenate([ends[kept] for ends, kept in zip(side, is_joined, strict=True)])
        for side in zip(along(pixel, 0), along(pixel, 1), strict=True)
    )
    graph = coo_matrix((np.ones(start.size), (start, end)), shape=(pixel.size, pixel.size))
    return ranked(connected_components(graph, directed=False)[1]).reshape(shape)


def _parted(region: np.ndarray) -> np.ndarray:
    """List the numbers of regions, from `regions` [y, x], but for the largest and those below `MIN_REGION`."""
    return np.flatnonzero(np.bincount(region.ravel()) >= MIN_REGION)[1:]


def floating(
    height: np.ndarray,
    samples: np.ndarray,
    region: np.ndarray,
    common_modes: np.ndarray | None = None,
    steps: Mapping[int, tuple[float, np.ndarray]] | None = None,
) -> np.ndarray:
    """Return True where a region's level relative to the largest region is not fixed by the data [y, x].

    So are heights whose common-mode errors, by an instrument far from the stated one or by a fit that has not
    converged, are a large share of all relief, relative to most others.

    Args:
        height: [y, x], um.
        samples: posterior deviations [sample, y, x], um.
        region: from `regions` [y, x].
        common_modes: as in `Posterior` [error, y, x], um.
        steps: known steps between a region and the largest one, by number: height, and the weights that measure it
            (`Anchors.known_steps`). A region whose step is known is fixed there: what its slopes add, which are
            uncertain with a free border, they add within a region, too.
    """
    flags = np.zeros(height.shape, bool)
    if common_modes is not None:
        relative = np.sqrt(((common_modes - np.median(common_modes, (1, 2), keepdims=True)) ** 2).sum(0))
        flags |= relative > FLOATING * np.subtract(*np.quantile(height, (0.99, 0.01)))
    substrate = region == 0
    for number in _parted(region):
        inside = region == number
        step = abs(float(np.median(height[inside]) - np.median(height[substrate])))
        spread = float(np.std(samples[:, inside].mean(1) - samples[:, substrate].mean(1)))
        is_floating = spread > FLOATING * step
        if steps and number in steps:
            known, weight = steps[number]
            is_floating &= float(np.std(np.tensordot(samples, weight, 2))) > FLOATING * known
        flags |= inside & is_floating
    return flags


def contradicted_regions(is_contradicted: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Mark regions that their data contradict as a whole: in more than `MAX_CONTRADICTED_REGION` of their core [y, x].

    Beside a wall the data deviate by where it stands. The core of a region lies `CORE` pixels and more within; one of
    fewer than `MIN_REGION` pixels tells nothing. The largest region is not tested: it is most of the map.

    Args:
        is_contradicted: pixels whose data contradict the map [y, x].
        region: from `regions` [y, x].
    """
    flags = np.zeros(region.shape, bool)
    for number in _parted(region):
        inside = region == number
        core = np.asarray(binary_erosion(inside, np.ones((3, 3)), iterations=CORE), bool)
        if core.sum() >= MIN_REGION and np.mean(is_contradicted[core]) > MAX_CONTRADICTED_REGION:
            flags |= inside
    return flags


def depth_jumps(height: np.ndarray, slope: np.ndarray, joined: np.ndarray, pitch: float, axis: int) -> np.ndarray:
    """Return True for edges along an axis (0: y, 1: x) that are cut and part heights by more than `SMALLEST_JUMP`.

    Args:
        height, slope: heights, um, and slopes along the axis [y, x].
        joined: weight left to the edges.
        pitch: um.
    """
    return (joined < JOINED) & (np.abs(trapezoid_gap(height, slope, pitch, axis)) > SMALLEST_JUMP)


def squares(residuals: np.ndarray) -> np.ndarray:
    """Compute squares of residuals, limited so that a few do not dominate; 0 where there is none."""
    return np.minimum(np.nan_to_num(residuals) ** 2, _LARGEST)


def half_chi_square(residuals: np.ndarray) -> float:
    """Compute half the sum of the limited squares of residuals: the misfit by which surfaces are compared."""
    return 0.5 * float(np.sum(squares(residuals)))


def ill_explained(residuals: np.ndarray, is_observed: np.ndarray) -> np.ndarray:
    """Return True where the fit contradicts the images of a pixel and its neighbours together [y, x].

    Heights that a wrong surface bends to, as beside a wall that nobody found, are stated as precise as others; no
    datum need be far off alone. Data that were not observed, or lie outside, count as explained to one deviation.

    Args:
        residuals: of the fit, in standard deviations [detector, y, x].
        is_observed: whether there is a datum [detector, y, x].
    """
    square = np.where(is_observed, squares(residuals), 1.0).mean(0)
    around = uniform_filter(square, 3, mode="constant", cval=1.0)
    return around > EXPLAINED * max(1.0, float(np.median(around)))


def n_informative(model_share: np.ndarray, is_observed: np.ndarray) -> np.ndarray:
    """Count the informative data of every pixel's facet [y, x].

    Args:
        model_share: share of the prediction's assumed error in the variance of each datum [detector, y, x].
        is_observed: whether there is a datum [detector, y, x].
    """
    return np.sum(is_observed & (model_share < 1.0 - VEILED**-2), axis=0)


def reasons_from_fit(
    reason: np.ndarray,
    is_explained: np.ndarray,
    n_informative: np.ndarray,
    jump_x: np.ndarray,
    jump_y: np.ndarray,
    is_floating: np.ndarray,
) -> np.ndarray:
    """Add what the fit knows to the reasons from the data [y, x].

    A facet has two slopes: with fewer than two data that tell of it, it is masked.

    Args:
        reason: from `reasons_from_data` [y, x].
        is_explained: whether the model explains the pixel's data [y, x].
        n_informative: from `n_informative` [y, x].
        jump_x, jump_y: from `depth_jumps` [y, x - 1], [y - 1, x].
        is_floating: from `floating` [y, x].
    """
    at_jump = np.zeros(reason.shape, bool)
    for jump, axis in ((jump_x, 1), (jump_y, 0)):
        for end in along(at_jump, axis):
            end |= jump
    out = reason.copy()
    out[(out == 0) & (at_jump | ~is_explained)] = _JUMP
    out[(out == 0) & (n_informative < FACET_IMAGES)] = _MASKED
    out[(out == 0) & is_floating] = _FLOATING
    return out
