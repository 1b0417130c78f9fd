"""Errors of a photometric height map that its misfit to the data shows: what error bars from noise alone leave out.

A map is traced (`verdict`). Where the traced micrographs deviate from the data by more than noise, slopes are wrong by
what that implies, and heights by what accumulates along the path from the reference. Regions that only contradicted
pixels join to the rest are tested as floating. The map itself stays as it is: signs of systematic errors are taken as
unknown. What the misfit does to the integration, patch by patch, is `bootstrap`'s matter.
"""

import numpy as np
from scipy import ndimage
from scipy.ndimage import uniform_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from helio_jax.arrays import border_mask
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import slopes_of_normal
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.edges import neighbour_links, ranked
from helio_jax.inverse.quality import MIN_REGION, floating
from helio_jax.inverse.samples import add_common_modes
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.verdict import Misfit, expected_chi_square
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import REASONS, Reconstruction

MAX_SLOPE_ERROR = 4.0
"""Largest error of a slope, as in the prior of slopes (`linear`): a misfit of a facet that grazes the beam implies
any."""
SEED = 12
"""Of the amplitudes of the common-mode error."""
_FLOATING = REASONS.index("floating")


def slope_errors(misfit: Misfit, optics: Optics) -> np.ndarray:
    """Compute the size of the slope error that the misfit of each pixel implies [y, x].

    The weighted least-squares change of albedo times normal, about the normals of the heights and albedo 1.

    Source: as `linear.solve_linear`: Woodham, Opt. Eng. 19 (1980) 139.
    """
    weight = np.nan_to_num(1.0 / misfit.std)
    design = np.moveaxis(weight[:, None] * misfit.form_factor, (0, 1), (-2, -1))
    data = np.moveaxis(weight * np.nan_to_num(-misfit.difference), 0, -1)
    changed = misfit.normals + np.einsum("yxik,yxk->yxi", np.linalg.pinv(design), data)
    changed /= np.maximum(np.linalg.norm(changed, axis=-1, keepdims=True), 1e-12)
    before, after = (np.stack(slopes_of_normal(n, optics.beam_shift)[:2]) for n in (misfit.normals, changed))
    return np.hypot(*np.clip(after - before, -MAX_SLOPE_ERROR, MAX_SLOPE_ERROR))


def excess_slope_errors(errors: np.ndarray, chi_square: np.ndarray, expected: float) -> np.ndarray:
    """Compute the part of slope errors beyond noise, root mean square of a pixel and its neighbours [y, x].

    Of a mean square misfit of chi-square, noise makes the expected part.

    Args:
        errors: from `slope_errors` [y, x].
        chi_square: of a pixel and its neighbours [y, x].
        expected: chi-square of a right map.
    """
    share = np.maximum(1.0 - expected / np.maximum(chi_square, 1e-12), 0.0)
    mean = np.maximum(uniform_filter(errors**2, 3, mode="nearest"), 0.0)  # its running sums leave rounding errors
    return np.sqrt(mean * share)


def accumulated(
    slope_error: np.ndarray, raster: Raster, is_reference: np.ndarray, anchors: Anchors | None = None
) -> np.ndarray:
    """Compute the height error that slope errors add up to along the best path from the reference [y, x], um.

    Systematic slope errors of neighbours have one sign: they add up. Of all paths over the raster, to the eight
    neighbours, the one with the least sum counts, for heights are known as well as along it.

    Args:
        slope_error: [y, x].
        raster: of the scan.
        is_reference: where the error is 0 [y, x]; somewhere at least.
        anchors: what fixes heights of pixels relative to one another, whatever lies between.

    Source: shortest paths: Dijkstra, Numer. Math. 1 (1959) 269; that errors accumulate along them: own derivation,
        benchmarks/families.py.
    """
    start, end, way = neighbour_links((slope_error.shape[0], slope_error.shape[1]))
    length = np.array([raster.dx, raster.dy, np.hypot(raster.dx, raster.dy)], float)[way]
    error = slope_error.ravel()
    least = 1e-12 * length  # a stored zero is no edge
    cost = 0.5 * (error[start] + error[end]) * length + least
    for weight in () if anchors is None else anchors.weight:
        sides = [np.flatnonzero(weight > 0), np.flatnonzero(weight < 0)]
        if all(side.size for side in sides):  # a known difference of heights, of those pixels that are right
            tied = np.concatenate([side[error[side] <= np.median(error[side])] for side in sides])
            start, end = np.append(start, np.full(tied.size - 1, tied[0])), np.append(end, tied[1:])
            cost = np.append(cost, np.full(tied.size - 1, 1e-12 * raster.dx))
    graph = coo_matrix((cost, (start, end)), shape=(error.size,) * 2)
    found = dijkstra(graph.tocsr(), directed=False, indices=np.flatnonzero(is_reference.ravel()), min_only=True)
    return found.reshape(slope_error.shape)


def valid_regions(is_valid: np.ndarray) -> np.ndarray:
    """Number the regions of valid pixels, the largest 0; every other pixel is a region of its own [y, x]."""
    found, n_regions = ndimage.label(is_valid)  # type: ignore[misc]  # SciPy's stubs: an integer
    found[~is_valid] = n_regions + 1 + np.arange(np.sum(~is_valid))
    return ranked(found.ravel()).reshape(found.shape)


def path_error(
    rec: Reconstruction,
    misfit: Misfit,
    raster: Raster,
    expected: float,
    settings: ReconstructSettings,
    anchors: Anchors | None = None,
    off_substrate: np.ndarray | None = None,
) -> np.ndarray:
    """Compute the common-mode error by slopes that the data contradict, relative to the reference [y, x], um.

    The reference is the border where it is flat, but for what is `off_substrate` (`FitProblem`), else the largest valid
    region; the border's median is then 0. Slope errors of one sign add up to a bound; a uniform distribution within it
    has the deviation bound / sqrt(3).
    """
    assert rec.chi_square is not None
    errors = excess_slope_errors(slope_errors(misfit, Optics.of(rec.instrument)), rec.chi_square, expected)
    frame = border_mask(rec.height.shape, settings.border_fraction)
    if settings.border == "flat":
        if off_substrate is not None and (frame & ~off_substrate).any():
            frame &= ~off_substrate
        known = frame & rec.is_valid
        return accumulated(errors, raster, known if known.any() else frame, anchors) / np.sqrt(3.0)
    found = accumulated(errors, raster, valid_regions(rec.is_valid) == 0, anchors)
    return (found - np.median(found[frame])) / np.sqrt(3.0)


def with_path_error(
    rec: Reconstruction,
    misfit: Misfit,
    stack: MicrographStack,
    settings: ReconstructSettings,
    anchors: Anchors | None = None,
    off_substrate: np.ndarray | None = None,
) -> Reconstruction:
    """Widen the error bars of a tested map by `path_error`, as a common-mode error, and flag what then floats."""
    if rec.height_samples is None or rec.chi_square is None:
        return rec
    expected = expected_chi_square(stack, rec.instrument, rec.chi_square)
    error = path_error(rec, misfit, Raster.of(stack), expected, settings, anchors, off_substrate)
    samples = add_common_modes(rec.height_samples, [error], SEED)
    std = np.sqrt(np.mean(samples**2, axis=0))
    return flag_floating(rec.replace(height_samples=samples, height_std=std), anchors)


def flag_floating(rec: Reconstruction, known: Anchors | None = None) -> Reconstruction:
    """Mark regions whose level the data do not fix, and specks of valid pixels, as floating.

    A region that only invalid pixels join to the largest one is floating when its level is uncertain by more than a
    share of its step (`quality.floating`); one of a few pixels always is.
    """
    if rec.height_samples is None or not rec.is_valid.any():
        return rec
    region = valid_regions(rec.is_valid)
    is_speck = (np.bincount(region.ravel()) < MIN_REGION)[region] & (region > 0)
    steps = None if known is None else known.known_steps(region)
    is_floating = rec.is_valid & (is_speck | floating(rec.height, rec.height_samples, region, steps=steps))
    reason = np.where(is_floating, _FLOATING, rec.reason)
    return rec.replace(reason=reason, is_valid=reason == 0)
