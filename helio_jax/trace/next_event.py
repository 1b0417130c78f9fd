"""Expected estimator: probability of flying directly from a scattering point to each detector (next-event estimation).

For the cosine law this is the closed-form form factor minus the masked part, without variance where nothing masks the
aperture. The masked part is estimated by a shadow ray to a random point of the aperture or, for apertures so wide that
this has the larger variance, by the re-emitted atoms that are blocked (maximum heuristic). Lobes use both techniques,
weighted by the balance heuristic (Veach and Guibas, SIGGRAPH 1995). So neither a narrow lobe nor a wide aperture gives
heavy tails. Exact directions (mirrors) are estimated by detected atoms only.
"""

import numpy as np

from helio_jax.kernel import kernel
from helio_jax.trace.direct import aim, aperture_ahead, area_factors, disc_point, form_factor, is_inside
from helio_jax.trace.experiment import Experiment, Paths, lift_off
from helio_jax.trace.intersect import MISS, Hits
from helio_jax.trace.laws import cosine_shares, lobe_density
from helio_jax.trace.plate import PLATE
from helio_jax.trace.source import Sampling
from helio_jax.trace.tally import Tally


def _path_data(s: Sampling, paths: Paths, n_branches: int, tally: Tally) -> tuple[np.ndarray, ...]:
    """Return pixel, order, met_plate, replicate and weight of each path, for `n_branches` paths per beam ray."""
    replicate = paths.path // (s.n_rays * n_branches // s.n_replicates)
    weight = tally.weights[paths.pixel, paths.path] if tally.weights.size else np.ones(len(replicate))
    return paths.pixel, paths.order, paths.met_plate, replicate, weight


@kernel
def _aimed_weight(n_hits, square, cosine_surface, cosine_plate, area):
    """Compute the detection probability in the point-detector approximation if aiming is used, else 0.

    Aiming is not used where the `n_hits` re-emitted atoms have less variance. The sign is that of `cosine_surface`.
    """
    weight = area * cosine_surface * cosine_plate / square / np.pi
    return weight if n_hits * abs(weight) <= 1.0 else 0.0


@kernel
def _aim(k, n_hits, point, normal, pixel, offset, plate_z, target, shapes, area):
    """Aim at a random point of detector `k`: direction, weight of the point, whether it is above the horizon."""
    n = point.shape[0]
    direction, weight, is_open = np.empty((n, 3)), np.empty(n), np.empty(n, np.bool_)
    for i in range(n):
        u, v = disc_point(target[i, 0], target[i, 1])
        x, y = offset[pixel[i], 0], offset[pixel[i], 1]
        dx, dy, dz, r2, is_own = aim(k, u, v, point, i, x, y, plate_z, shapes)
        r = np.sqrt(r2)
        direction[i, 0], direction[i, 1], direction[i, 2] = dx / r, dy / r, dz / r
        cosine = (normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz) / r
        square, flat = area_factors(k, r2, dz / r, shapes)
        weight[i] = _aimed_weight(n_hits, square, cosine, flat, area[k])
        is_open[i] = cosine > 0.0 and is_own
    return direction, weight, is_open


@kernel
def _add(value, k, i, order, paths, sums):
    """Add the contribution of path `i` to detector `k` and scattering order `order`.

    `paths`: pixel, order, met_plate, replicate, weight [n]; `sums`: `Tally.sums`, `Tally.plate_sums`.
    """
    pixel, _, met_plate, replicate, weight = paths
    by_order, plate = sums
    r, p = replicate[i], pixel[i]
    value *= weight[i]
    by_order[min(order, by_order.shape[0]) - 1, r, k, p] += value
    if met_plate[i]:
        plate[r, k, p] += value


@kernel
def _score(k, share, cosine, point, normal, paths, offset, plate_z, weight, is_open, shapes, rims, sums):
    """Add P = n . Phi - (masked part), times the share of cosine atoms, for each scattering point."""
    pixel, order, _, _, _ = paths
    for i in range(point.shape[0]):
        if cosine[i] == 0.0:
            continue
        p = pixel[i]
        fx, fy, fz = form_factor(
            point[i, 0] - offset[p, 0], point[i, 1] - offset[p, 1], plate_z - point[i, 2], k, shapes, rims
        )
        value = normal[i, 0] * fx + normal[i, 1] * fy + normal[i, 2] * fz
        if not is_open[i]:
            value -= weight[i]
        _add(value * share * cosine[i], k, i, order[i] + 1, paths, sums)


@kernel
def _balance(density, n_hits, square, cosine, area):
    """Compute the balance heuristic: density / (density of aiming + n_hits density)."""
    return 1.0 / n_hits if density == np.inf else density / (square / (area * cosine) + n_hits * density)


@kernel
def _score_lobes(
    k, share, n_hits, table, material, incoming, point, normal, paths, direction, is_open, plate_z, shapes, area, sums
):
    """Add the contribution of the lobes at each scattering point to the point aimed at."""
    order = paths[1]
    for i in range(point.shape[0]):
        if is_open[i]:
            density = lobe_density(table, material[i], incoming[i], normal[i], direction[i])
            r = (plate_z - point[i, 2]) / direction[i, 2]
            square, flat = area_factors(k, r * r, direction[i, 2], shapes)
            value = _balance(density, n_hits, square, flat, area[k]) if density > 0.0 else 0.0
            _add(share * value, k, i, order[i] + 1, paths, sums)


@kernel
def _score_hits(share, n_hits, density, origin, direction, paths, surface, offset, plate_z, shapes, area, sums):
    """Add the atoms of lobes that hit a detector."""
    pixel, order, _, _, _ = paths
    for i in range(origin.shape[0]):
        if density[i] > 0.0 and surface[i] == MISS:
            p = pixel[i]
            k, r = aperture_ahead(origin, direction, i, offset[p, 0], offset[p, 1], plate_z, shapes)
            if k >= 0:
                square, flat = area_factors(k, r * r, direction[i, 2], shapes)
                value = _balance(density[i], n_hits, square, flat, area[k])
                _add(share * n_hits * value, k, i, order[i], paths, sums)


@kernel
def _subtract_masked(
    share, n_hits, density, normal, origin, direction, paths, surface, offset, plate_z, shapes, area, sums
):
    """Subtract the masked part of wide detectors, which `_score` leaves out: blocked cosine atoms flying towards them.

    The mirror image of an atom's direction at its surface estimates the parts of the detectors below the horizon.
    """
    pixel, order, _, _, _ = paths
    for i in range(origin.shape[0]):
        if density[i] != 0.0:
            continue
        n, d = normal[i], direction[i]
        cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
        for sign in (1.0, -1.0):
            dx, dy, dz = d[0], d[1], d[2]
            if sign < 0.0:
                dx, dy, dz = dx - 2.0 * cosine * n[0], dy - 2.0 * cosine * n[1], dz - 2.0 * cosine * n[2]
            is_masked = sign < 0.0 or surface[i] != MISS
            if dz <= 0.0 or cosine <= 0.0:
                continue
            r = (plate_z - origin[i, 2]) / dz
            x = origin[i, 0] - offset[pixel[i], 0] + r * dx
            y = origin[i, 1] - offset[pixel[i], 1] + r * dy
            for k in range(shapes.shape[0]):
                if is_inside(x, y, dx, dy, dz, k, shapes):
                    square, flat = area_factors(k, r * r, dz, shapes)
                    if is_masked and _aimed_weight(n_hits, square, cosine, flat, area[k]) == 0.0:
                        _add(-sign * share, k, i, order[i], paths, sums)
                    is_masked = True  # where detectors overlap, the first one counts


def add_next_event(e: Experiment, event: int, ids: np.ndarray, tally: Tally, hits: Hits, paths: Paths, offset):
    """Add the next-event estimate of each scattering point on the sample for each detector to `tally`."""
    if e.plate is not None and (on_plate := hits.surface == PLATE).any():
        hits, paths = hits.take(~on_plate), paths.take(~on_plate)
    table, plate_z, n_branches = e.apertures, e.instrument.sample_distance, 1 if event == 0 else e.sampling.n_branches
    point, normal, n_hits = hits.point, hits.normal, e.sampling.n_branches if event == 0 else 1
    path_data, sums = _path_data(e.sampling, paths, n_branches, tally), (tally.sums, tally.plate_sums)
    origin, skip = lift_off(point, normal, hits.surface, e.intersector.restart)
    cosine = np.ones(len(point))
    if e.laws is not None:
        material = e.material_of(hits.surface)
        key = (ids[paths.pixel], paths.path, event, e.sampling.seed)
        cosine = cosine_shares(e.laws, material, paths.direction, normal, *key)
    for k in range(len(table)):
        direction, weight, is_open = _aim(
            k, n_hits, point, normal, paths.pixel, offset, plate_z, paths.target, table.shapes, table.area
        )
        todo = np.flatnonzero(is_open)
        is_open[todo] = ~e.intersector.is_occluded(origin[todo], direction[todo], skip[todo])
        _score(
            k, 1.0 / n_branches, cosine, point, normal, path_data, offset, plate_z, weight, is_open, table.shapes,
            table.rims, sums,
        )  # fmt: skip
        if e.laws is not None and e.leaving is None:
            _score_lobes(
                k, 1.0 / n_branches, n_hits, e.laws, material, paths.direction, point, normal, path_data, direction,
                is_open, plate_z, table.shapes, table.area, sums,
            )  # fmt: skip


def add_hits(e: Experiment, event: int, tally: Tally, surface: np.ndarray, paths: Paths, offset) -> None:
    """Add the estimates by re-emitted atoms after `event` events: hits of lobes, and the masked part."""
    n_branches, table = e.sampling.n_branches, e.apertures
    weight = 1.0 / n_branches, n_branches if event == 1 else 1
    path_data, sums = _path_data(e.sampling, paths, n_branches, tally), (tally.sums, tally.plate_sums)
    flight = paths.origin, paths.direction, path_data, surface
    plate = offset, e.instrument.sample_distance, table.shapes, table.area
    _subtract_masked(*weight, paths.density, paths.normal, *flight, *plate, sums)
    if e.laws is not None:
        _score_hits(*weight, paths.density, *flight, *plate, sums)
