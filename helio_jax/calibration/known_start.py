"""Where a known object lies on the raster: a search on few pixels, from which the fit starts."""

from dataclasses import replace

import numpy as np

from helio_jax.arrays import robust_std
from helio_jax.calibration.known_model import Multiple, no_multiple, probability
from helio_jax.calibration.known_scan import KnownScan, Layout, expected_counts, linear_start, stride_for, thinned
from helio_jax.calibration.unknowns import KnownShapeSettings, instrument_unknowns, object_unknowns
from helio_jax.instrument import Instrument

PIXELS = 31
"""Pixels along the longer side of the thinned raster."""
REACH, SIDES = 0.45, (7, 5, 5, 5)
"""Reach of the first search over the width of the image; points along each axis of all searches."""


def _find_place(
    scan: KnownScan,
    base: np.ndarray,
    multiple: Multiple,
    reach: np.ndarray,
    settings: KnownShapeSettings,
) -> tuple[np.ndarray, float]:
    """Find where the object lies by a search about the place in `base`, read-out fitted, all else of `base` held.

    Args:
        scan: the data.
        base: unknowns of the scan.
        multiple: multiple scattering.
        reach: of the search along x and y, um; 0: not searched.
        settings: priors of the read-out.

    Returns:
        The place (x, y) [um], and the misfit there.
    """
    inverse = np.where(scan.is_used, 1.0 / scan.sigma, 0.0)
    index = len(base) - len(scan.own)

    def misfit(place: np.ndarray) -> float:
        at = base.copy()
        at[index : index + 2] = place
        image = probability(scan.model, at, multiple)
        residual = (scan.counts - expected_counts(scan, linear_start(scan, image, inverse, settings), image)) * inverse
        scale = 3.0 * float(robust_std(residual[scan.is_used]))
        return float(np.sum(np.log1p((residual / scale) ** 2)) + residual.size * 2.0 * np.log(scale))

    place = base[index : index + 2].copy()
    best = misfit(place)
    for stage, side in enumerate(SIDES):
        steps, width = np.linspace(-1.0, 1.0, side), reach * 0.4**stage
        grid = [place + width * [a, b] for a in steps for b in (steps if width[1] else [0.0])]
        found = [misfit(p) for p in grid]
        i = int(np.argmin(found))
        if found[i] < best:
            best, place = found[i], grid[i]
    return place, best


def started(
    stated: Instrument, scan: KnownScan, settings: KnownShapeSettings, stack_reach: float
) -> tuple[KnownScan, float]:
    """Put the object where a search finds it; of several shapes take the best."""
    found = []
    for known in scan.known.starts():
        trial = replace(scan, known=known, own=object_unknowns(known, stack_reach, settings))
        layout = Layout(instrument_unknowns(stated, settings), [trial])
        coarse = thinned(trial, stride_for(trial, PIXELS))
        base, is_ball = layout.start[0], known.kind == "ball"
        reach = 2.0 * REACH * stack_reach * np.array([1.0, float(is_ball)])
        nothing = no_multiple(coarse.model, base, layout.free[0])
        place, misfit = _find_place(coarse, base, nothing, reach, settings)
        own = [u._replace(stated=float(p)) for u, p in zip(trial.own[:2], place, strict=True)] + trial.own[2:]
        found.append((replace(trial, own=own), misfit))
    return min(found, key=lambda entry: entry[1])
