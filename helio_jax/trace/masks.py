"""Masking and shadowing maps by ray tracing.

Deterministic: each aperture is sampled at fixed points (Vogel spiral, equal areas), so the maps are free of noise and
can be differenced. They give the micrographs' `masked` and `shadowed` maps and the masked form factor of the fit.
"""

import numpy as np

from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.trace.direct import ApertureTable, aim, area_factors
from helio_jax.trace.experiment import lift_off
from helio_jax.trace.intersect import MISS, Intersector


@kernel
def _sample_rays(k, sample, point, normal, offset, plate_z, shapes, area):
    """Return directions to one detector sample, vector weights cos(theta_d) r / (pi r^3) dA, and whether it counts."""
    n = point.shape[0]
    direction, weight, is_up = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, np.bool_)
    for i in range(n):
        x, y = offset[i, 0], offset[i, 1]
        dx, dy, dz, r2, is_own = aim(k, sample[0], sample[1], point, i, x, y, plate_z, shapes)
        r = np.sqrt(r2)
        direction[i, 0], direction[i, 1], direction[i, 2] = dx / r, dy / r, dz / r
        square, flat = area_factors(k, r2, dz / r, shapes)
        w = area * flat / square / np.pi
        for a in range(3):
            weight[i, a] = w * direction[i, a]
        is_up[i] = is_own and normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz > 0.0
    return direction, weight, is_up


def masked_form_factor(
    intersector: Intersector,
    instrument: Instrument,
    point: np.ndarray,
    normal: np.ndarray,
    surface: np.ndarray,
    offset: np.ndarray,
    n_samples: int = 48,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the masked part of each aperture's vector form factor at points of the sample.

    The detection probability of a point is n . (Phi - masked). The error falls as 1/n_samples; it is exactly 0 where
    the whole aperture is visible.

    Args:
        intersector: the sample.
        instrument: with the apertures.
        point: points on the sample, sample frame [n, 3] [um].
        normal: unit normals, outward [n, 3].
        surface: surface of each point (`Hits.surface`) [n].
        offset: lab-to-sample shift (x, y) of each point's pixel [n, 2] [um].
        n_samples: equal-area points per aperture (Vogel, Math. Biosci. 44 (1979) 179).

    Returns:
        Masked form factor [detector, n, 3] and masked fraction of the aperture's solid angle [detector, n].
    """
    table = ApertureTable(instrument)
    origin, skip = lift_off(point, normal, surface, intersector.restart)
    n_detectors, n = len(table), len(point)
    masked, fraction = np.zeros((n_detectors, n, 3)), np.zeros((n_detectors, n))
    i = np.arange(n_samples) + 0.5
    r, angle = np.sqrt(i / n_samples), np.pi * (3.0 - np.sqrt(5.0)) * i
    samples = np.stack([r * np.cos(angle), r * np.sin(angle)], -1)
    for k in range(n_detectors):
        solid_angle = np.zeros(n)
        for sample in samples:
            direction, weight, is_open = _sample_rays(
                k, sample, point, normal, offset, instrument.sample_distance, table.shapes,
                table.area[k] / n_samples,
            )  # fmt: skip
            todo = np.flatnonzero(is_open)
            is_open[todo] = ~intersector.is_occluded(origin[todo], direction[todo], skip[todo])
            size = np.linalg.norm(weight, axis=1)
            solid_angle += size
            masked[k, ~is_open] += weight[~is_open]
            fraction[k, ~is_open] += size[~is_open]
        fraction[k] /= solid_angle
    return masked, fraction


def is_shadowed(intersector: Intersector, instrument: Instrument, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether the beam cannot reach the topmost surface point at (x, y) [n].

    (x, y) [um] are positions on the sample, not beam positions. False where there is no surface.
    """
    top = intersector.high[2] + intersector.half_size
    down = np.stack([x, y, np.full_like(x, top)], -1)
    none = np.full(len(x), -1, np.int32)
    hits = intersector.nearest(down, np.broadcast_to([0.0, 0.0, -1.0], down.shape).copy(), none)
    origin, skip = lift_off(hits.point, hits.normal, hits.surface, intersector.restart)
    found = np.flatnonzero(hits.surface != MISS)
    to_source = np.broadcast_to(-instrument.beam_direction, origin.shape).copy()
    faces_away = hits.normal @ instrument.beam_direction >= 0
    shadow = np.zeros(len(x), bool)
    shadow[found] = faces_away[found] | intersector.is_occluded(origin[found], to_source[found], skip[found])
    return shadow
