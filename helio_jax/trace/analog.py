"""Fused kernel of the tracer for samples whose materials all scatter by the cosine law, or adsorb.

Between two Embree calls each atom is tallied or re-emitted and written as the next ray in one loop over memory, in
place. The result equals that of the general loop (`transport`) bit for bit; `transport` handles other laws, scattering
plates and installations without Embree in separate steps.
"""

import numpy as np

from helio_jax.kernel import kernel
from helio_jax.trace.direct import aperture_ahead
from helio_jax.trace.experiment import Experiment, Paths
from helio_jax.trace.intersect import MISS, Hits, resolve_hit
from helio_jax.trace.laws import leaves_surface
from helio_jax.trace.lobes import cosine_direction
from helio_jax.trace.next_event import add_next_event
from helio_jax.trace.source import bounce_number, first_bounce_shift, shifted
from helio_jax.trace.tally import DETECTED, ESCAPED, LOST, STOPPED, Tally

_CHUNK = 128
"""Hits resolved together, so that the processor loads several triangles at a time."""


@kernel
def flight_outcome(event, is_last, origins, directions, i, surface, is_back, x, y, plate_z, shapes):
    """Return the fate of atom `i` after a flight (`tally.FATES`, or -1: it scatters) and its detector, or -1.

    `x`, `y` is the plate's origin in the sample frame for this pixel. Atoms directly from the source hit no detector.
    """
    if surface != MISS:
        if is_back:
            return LOST, -1
        return (STOPPED if is_last else -1), -1
    if event > 0:
        k, _ = aperture_ahead(origins, directions, i, x, y, plate_z, shapes)
        if k >= 0:
            return DETECTED, k
    return ESCAPED, -1


@kernel
def _emit(point, normal, surface, i, a, b, restart, origin, direction, skip, m):
    """Draw the atom that leaves point `i` by the cosine law; write it to row `m`."""
    direction[m, 0], direction[m, 1], direction[m, 2] = cosine_direction(normal[i, 0], normal[i, 1], normal[i, 2], a, b)
    skip[m] = -1 if surface[i] >= 0 else -2 - surface[i]
    lift = restart if surface[i] >= 0 else 0.0
    for c in range(3):
        origin[m, c] = point[i, c] + lift * normal[i, c]


@kernel
def _emit_all(
    event, point, normal, surface, restart, pixel, path, ids, seed, n_branches, bounces, per_replicate, leaving, stopped
):
    """Return the atoms re-emitted at the points: origin, direction, pixel, path and sphere to skip [n].

    `leaving`: see `Experiment`. Adsorbed atoms are added to `stopped` [pixels].
    """
    n = pixel.size * n_branches
    origin, direction = np.empty((n, 3)), np.empty((n, 3))
    of_pixel, of_path, skip = np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int32)
    m, a, b = 0, 0.0, 0.0
    is_stratified = event == 0 and per_replicate > 0
    for i in range(pixel.size):
        if is_stratified:
            shift_a, shift_b, _, _ = first_bounce_shift(seed, ids[pixel[i]], path[i] * n_branches // per_replicate)
        for branch in range(n_branches):
            of_pixel[m], of_path[m] = pixel[i], path[i] * n_branches + branch
            if leaving.size and not leaves_surface(leaving[surface[i]], seed, ids[pixel[i]], of_path[m], event):
                stopped[pixel[i]] += 1
                continue
            if is_stratified:
                a, b = shifted(shift_a, shift_b, bounces, of_path[m] % per_replicate)
            else:
                a, b, _, _ = bounce_number(seed, ids[pixel[i]], of_path[m], event)
            _emit(point, normal, surface, i, a, b, restart, origin, direction, skip, m)
            m += 1
    return origin[:m], direction[:m], of_pixel[:m], of_path[:m], skip[:m]


@kernel
def _advance(
    event,
    is_last,
    found,
    atoms,
    o32,
    d32,
    geometry,
    offset,
    plate_z,
    shapes,
    ids,
    seed,
    leaving,
    fates,
    hits,
    weights,
    lost,
    scattered,
):
    """Tally the atoms that end, re-emit the others in place; return the numbers re-emitted and scattered.

    `found`: triangle and barycentric u, v. `atoms`: origin, direction, pixel, path, skip. `leaving`: see `Experiment`.
    `scattered`: points, normals, surfaces, pixels and paths of the scattering, adsorbed atoms included, and two random
    numbers of each path's next aperture point; length 0 if not needed.
    """
    face, u, v = found
    origin, direction, pixel, path, skip = atoms
    facets, spheres, restart, middle, inverse_size = geometry
    points, normals, surfaces, pixels, paths, targets = scattered
    point, normal = np.empty((_CHUNK, 3)), np.empty((_CHUNK, 3))
    surface, is_back = np.empty(_CHUNK, np.int64), np.empty(_CHUNK, np.bool_)
    m = n_scattered = 0
    for start in range(0, face.size, _CHUNK):
        stop = min(start + _CHUNK, face.size)
        for i in range(start, stop):
            j = i - start
            surface[j], is_back[j] = resolve_hit(
                origin, direction, i, skip[i], face[i], u[i], v[i], facets, spheres, point, normal, j
            )
        for i in range(start, stop):
            j, p, own = i - start, pixel[i], path[i]
            fate, k = flight_outcome(
                event, is_last, origin, direction, i, surface[j], is_back[j], offset[p, 0], offset[p, 1], plate_z,
                shapes,
            )  # fmt: skip
            if fate >= 0:
                fates[fate, p] += 1
                if fate == LOST:
                    lost[p] += weights[p, own] if weights.size else 1.0
                if k >= 0:
                    hits[min(event, hits.shape[0]) - 1, k, p] += 1
                continue
            if points.shape[0]:
                s = n_scattered
                surfaces[s], pixels[s], paths[s] = surface[j], p, own
                _, _, targets[s, 0], targets[s, 1] = bounce_number(seed, ids[p], own, event - 1)
                for c in range(3):
                    points[s, c], normals[s, c] = point[j, c], normal[j, c]
            n_scattered += 1
            if leaving.size and not leaves_surface(leaving[surface[j]], seed, ids[p], own, event):
                fates[STOPPED, p] += 1
                continue
            a, b, _, _ = bounce_number(seed, ids[p], own, event)
            pixel[m], path[m] = p, own
            _emit(point, normal, surface, j, a, b, restart, origin, direction, skip, m)
            for c in range(3):
                o32[m, c] = np.float32((origin[m, c] - middle[c]) * inverse_size)
                d32[m, c] = np.float32(direction[m, c])
            m += 1
    return m, n_scattered


def trace_fused(
    e: Experiment, event: int, ids: np.ndarray, hits: Hits, paths: Paths, offset: np.ndarray, tally: Tally
) -> None:
    """Scatter atoms after `event` events and trace them until all have ended.

    Valid where `Experiment.can_fuse(event)`. Gives the tally of `transport.scatter` and further flights, bit for bit;
    the first scattering is fused too because `scatter` repeats all arrays for the branches (30 % of the time).

    Raises:
        GuardError: a ray is not finite or not of unit direction.
    """
    s, sample = e.sampling, e.intersector
    atoms = _emit_all(
        event, hits.point, hits.normal, hits.surface, sample.restart, paths.pixel, paths.path, ids, s.seed,
        s.n_branches if event == 0 else 1, s.bounces, s.per_replicate, e.leaving, tally.fates[STOPPED],
    )  # fmt: skip
    o32, d32 = sample.scaled(*atoms[:2])
    n = len(o32)
    kept = n if e.is_expected else 0
    of_each = (np.empty(kept, dtype) for dtype in (np.int32, np.int32, np.int64))
    scattered = np.empty((kept, 3)), np.empty((kept, 3)), *of_each, np.empty((kept, 2))
    geometry = sample.facets, sample.spheres, sample.restart, sample.center, 1.0 / sample.half_size
    for flight in range(event + 1, e.max_events + 1):
        found = sample.shoot(o32[:n], d32[:n])
        n, n_scattered = _advance(
            flight, flight >= e.max_events, found, atoms, o32, d32, geometry, offset, e.instrument.sample_distance,
            e.apertures.shapes, ids, s.seed, e.leaving, tally.fates, tally.hits, tally.weights, tally.lost, scattered,
        )  # fmt: skip
        if e.is_expected and n_scattered:
            points, normals, surfaces, *paths_of = (a[:n_scattered] for a in scattered)
            reached = Hits(points, normals, surfaces, np.zeros(n_scattered, bool))
            add_next_event(e, flight, ids, tally, reached, _cosine_paths(flight, *paths_of), offset)
        if n == 0:
            break


def _cosine_paths(event: int, pixel: np.ndarray, path: np.ndarray, target: np.ndarray) -> Paths:
    """Return the `Paths` that `next_event` needs of cosine-law atoms after `event` scatterings."""
    n = len(pixel)
    order, met_plate = np.full(n, event, np.int32), np.zeros(n, bool)
    none, vectors = np.zeros(n), np.zeros((n, 3))
    return Paths(vectors, vectors, pixel, path, target, pixel, none, vectors, order, met_plate)
