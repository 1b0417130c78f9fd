"""On which part of a known scene every pixel lies, and which pixels about a ball's foot are left out. Pure NumPy."""

import numpy as np

from helio_jax.calibration.known_scan import KnownScan
from helio_jax.calibration.unknowns import KnownShapeSettings

OUTLINE = 0.6, 0.3, 0.15
"""Scale of the logistic function by which a pixel changes from object to substrate, over the pitch of a raster of at
most `FIRST_PIXELS` pixels a side: of each stage of a fit. A wide outline finds the object from farther away, a narrow
one places it better. `known_shape` narrows it when the fit has settled: before, it holds the object in a wrong place.
`mask_directions` narrows it round by round: to wait did not help there."""
BESIDE = 0.3
"""Data of a pixel that is closer to an outline than so many pitches (of a raster thinned to `FIRST_PIXELS`), or than
the present scale of the logistic function if that is larger, are left out: its masks and its multiple scattering
change too fast with the object's place for a linear step, and differ between the parts. They still tell on which
part it lies."""
NARROWEST = len(OUTLINE) - 1
"""Last stage of a fit."""
SETTLED = 1.0
"""A fit has settled when no unknown changes by more standard deviations in a round: then the outline is narrowed."""
CONVERGED = 0.1
"""A fit has converged when no unknown changes by more than this share of its standard deviation in a round."""


def near_foot(scan: KnownScan, own: dict[str, float], distance: np.ndarray, settings: KnownShapeSettings) -> np.ndarray:
    """Find the ring about the foot of a ball that is left out [y, x].

    Args:
        scan: the data.
        own: numbers of the object by their names [um].
        distance: of the pixels' surface points from the ball's axis [y, x], um.
        settings: with `leave_out_ring`.
    """
    if settings.leave_out_ring is None or scan.known.kind != "ball":
        return np.zeros(distance.shape, bool)
    low, high = settings.leave_out_ring
    foot = np.sqrt(max(own["height"] * (2.0 * own["radius"] - own["height"]), 0.0))
    return (distance > low * foot) & (distance < high * foot)


def membership(
    scan: KnownScan, used: np.ndarray, modelled: np.ndarray, log_share: np.ndarray, settings: KnownShapeSettings
) -> np.ndarray:
    """Compute the probability that a pixel lies on each part, by its data and by where the outline is [part, y, x].

    A detector that no part explains, as with dust, makes no difference: residuals count as in the fit, robustly.

    Args:
        scan: the data.
        used: which are used [detector, y, x].
        modelled: what each part would read [part, detector, y, x].
        log_share: logarithm of the share that each part takes of a pixel [part, y, x].
        settings: with the limit of the robust weights.

    Source: expectation step of a mixture: Dempster, Laird and Rubin, J. R. Stat. Soc. B 39 (1977) 1.
    """
    limit = settings.robust_limit
    loss = [
        np.sum(np.where(used, limit**2 * np.log1p(((scan.counts - image) / scan.sigma / limit) ** 2), 0.0), 0)
        for image in modelled
    ]
    weight = log_share - 0.5 * np.array(loss)
    weight = np.exp(weight - weight.max(0))
    return weight / weight.sum(0)


def beside_outline(log_share: np.ndarray, width: float, before: np.ndarray | None) -> np.ndarray:
    """Find the pixels that are closer to an outline than a distance [y, x].

    Args:
        log_share: logarithm of the share that each part takes of a pixel, at the widest outline [part, y, x].
        width: that distance, in the unit of `OUTLINE`.
        before: pixels that are listed again, in the last stage of a fit: else one may go in and out for ever [y, x].
    """
    is_beside = log_share.max(0) < -np.logaddexp(0.0, -width / OUTLINE[0])
    return is_beside if before is None else is_beside | before
