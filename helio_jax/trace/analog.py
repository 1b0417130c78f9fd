"""The tracer's inner loop: one kernel per flight for atoms that all leave by the cosine law.

Between two Embree calls every atom is landed, tallied, re-emitted and written as the next ray in one pass over memory,
in place: rays that end make room for those that go on. It gives the same bits as the general loop (transport), which
does the same in separate steps for other laws, for scattering plates and where Embree is not installed.
"""

from collections.abc import Callable

import numpy as np

from helio_jax.kernel import kernel
from helio_jax.trace.direct import ApertureTable, aperture_ahead
from helio_jax.trace.intersect import MISS, Hits, Intersector, resolve_hit
from helio_jax.trace.lobes import cosine_direction
from helio_jax.trace.source import Sampling, bounce_number, first_bounce_shift, shifted
from helio_jax.trace.tally import DETECTED, ESCAPED, LOST, STOPPED, Tally

Flying = tuple[np.ndarray, ...]
"""Atoms in flight: origin [n, 3] um, direction [n, 3], pixel, path and sphere to skip [n]."""
Score = Callable[[int, Hits, np.ndarray, np.ndarray, np.ndarray], None]
"""Called with the events so far, where atoms scatter next, their pixel, path and two random numbers [n, 2]."""

_CHUNK = 128
"""Hits that are looked up together, so that the processor waits for several triangles at a time."""


@kernel
def land(event, is_last, origins, directions, i, surface, is_back, x, y, plate_z, shapes):
    """Return what becomes of atom `i` after a flight (`tally.FATES`, or -1: it scatters), and its detector or -1.

    `x`, `y` is the plate's origin in the sample frame for this pixel; atoms straight from the source hit no detector.
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
def _leave(event, point, normal, surface, restart, pixel, path, ids, seed, n_branches, bounces, per_replicate):
    n = pixel.size * n_branches
    origin, direction = np.empty((n, 3)), np.empty((n, 3))
    of_pixel, of_path, skip = np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int32)
    m, a, b = 0, 0.0, 0.0
    for i in range(pixel.size):
        is_even = event == 0 and per_replicate > 0
        if is_even:
            shift_a, shift_b = first_bounce_shift(seed, ids[pixel[i]], path[i] * n_branches // per_replicate)
        lift = restart if surface[i] >= 0 else 0.0
        for branch in range(n_branches):
            of_pixel[m], of_path[m] = pixel[i], path[i] * n_branches + branch
            if is_even:
                a, b = shifted(shift_a, shift_b, bounces, of_path[m] % per_replicate)
            else:
                a, b, _, _ = bounce_number(seed, ids[pixel[i]], of_path[m], event)
            skip[m] = -1 if surface[i] >= 0 else -2 - surface[i]
            x, y, z = cosine_direction(normal[i, 0], normal[i, 1], normal[i, 2], a, b)
            direction[m, 0], direction[m, 1], direction[m, 2] = x, y, z
            for c in range(3):
                origin[m, c] = point[i, c] + lift * normal[i, c]
            m += 1
    return origin, direction, of_pixel, of_path, skip


def leave(
    event: int, hits: Hits, restart: float, pixel: np.ndarray, path: np.ndarray, ids: np.ndarray, sampling: Sampling
) -> Flying:
    """Return the atoms that leave the points where others came: as many as there are branches after the beam's first.

    Args:
        event: how many scatterings went before this one.
        hits: where they scatter [n].
        restart: distance off a triangle at which they start, um.
        pixel, path: of the atoms that come [n].
        ids: number of each pixel in the scan [pixels].
        sampling: seed, branches, points of the first bounces.
    """
    s, n_branches = sampling, sampling.n_branches if event == 0 else 1
    per_replicate = s.per_replicate if s.n_replicates else 0
    return _leave(
        event, hits.point, hits.normal, hits.surface, restart, pixel, path, ids, s.seed, n_branches, s.bounces,
        per_replicate,
    )  # fmt: skip


@kernel
def _fly_on(
    event, is_last, face, u, v, origin, direction, pixel, path, skip, o32, d32, facets, spheres, restart, middle,
    inverse_size, offset, plate_z, shapes, ids, seed, fates, hits, points, normals, surfaces,
    targets,
):  # fmt: skip
    """Land all atoms in flight, tally those that end, send the others on in place; return how many go on.

    Where `points`, `normals` and `surfaces` of the scattering and the two numbers of the path's next aperture point
    (`targets`) are as long as the flights, they are written, too.
    """
    point, normal = np.empty((_CHUNK, 3)), np.empty((_CHUNK, 3))
    surface, is_back = np.empty(_CHUNK, np.int64), np.empty(_CHUNK, np.bool_)
    m = 0
    for start in range(0, face.size, _CHUNK):
        stop = min(start + _CHUNK, face.size)
        for i in range(start, stop):
            j = i - start
            surface[j], is_back[j] = resolve_hit(
                origin, direction, i, skip[i], face[i], u[i], v[i], facets, spheres, point, normal, j
            )
        for i in range(start, stop):
            j, p = i - start, pixel[i]
            fate, k = land(
                event, is_last, origin, direction, i, surface[j], is_back[j], offset[p, 0], offset[p, 1], plate_z,
                shapes,
            )  # fmt: skip
            if fate >= 0:
                fates[fate, p] += 1
                if k >= 0:
                    hits[min(event, hits.shape[0]) - 1, k, p] += 1
                continue
            if points.shape[0]:
                surfaces[m] = surface[j]
                _, _, targets[m, 0], targets[m, 1] = bounce_number(seed, ids[p], path[i], event - 1)
                for c in range(3):
                    points[m, c], normals[m, c] = point[j, c], normal[j, c]
            a, b, _, _ = bounce_number(seed, ids[p], path[i], event)
            x, y, z = cosine_direction(normal[j, 0], normal[j, 1], normal[j, 2], a, b)
            pixel[m], path[m] = p, path[i]
            skip[m] = -1 if surface[j] >= 0 else -2 - surface[j]
            lift = restart if surface[j] >= 0 else 0.0
            direction[m, 0], direction[m, 1], direction[m, 2] = x, y, z
            for c in range(3):
                origin[m, c] = point[j, c] + lift * normal[j, c]
                o32[m, c] = np.float32((origin[m, c] - middle[c]) * inverse_size)
                d32[m, c] = np.float32(direction[m, c])
            m += 1
    return m


def fly_to_the_end(
    event: int,
    intersector: Intersector,
    apertures: ApertureTable,
    plate_z: float,
    max_events: int,
    seed: int,
    ids: np.ndarray,
    offset: np.ndarray,
    flying: Flying,
    tally: Tally,
    score: Score | None = None,
) -> None:
    """Follow atoms that have left a scattering point until all have ended; add them to the tally.

    Args:
        event: how many events lie behind them when they next meet something: 1 after the beam's first hit.
        intersector: the sample, on Embree.
        apertures, plate_z: of the plate, um.
        max_events: flights after which an atom is stopped.
        seed, ids: key of the random numbers, and the number of each pixel in the scan [pixels].
        offset: the plate's origin in the sample frame for every pixel [pixels, 2], um.
        flying: from `leave`; overwritten.
        tally: of these pixels.
        score: what else is to be done wherever atoms scatter.

    Raises:
        GuardError: a ray is not finite or has no unit direction.
    """
    origin, direction, pixel, path, skip = flying
    o32, d32 = intersector.scaled(origin, direction)
    n = len(origin)
    kept = n if score else 0
    points, normals, targets = np.empty((kept, 3)), np.empty((kept, 3)), np.empty((kept, 2))
    surfaces = np.empty(kept, np.int32)
    for now in range(event, max_events + 1):
        face, u, v = intersector.shoot(o32[:n], d32[:n])
        n = _fly_on(
            now, now >= max_events, face, u, v, origin, direction, pixel, path, skip, o32, d32, intersector.facets,
            intersector.spheres, intersector.restart, intersector.center, 1.0 / intersector.half_size, offset, plate_z,
            apertures.shapes, ids, seed, tally.fates, tally.hits, points, normals, surfaces, targets,
        )  # fmt: skip
        if n == 0:
            break
        if score:
            hits = Hits(points[:n], normals[:n], surfaces[:n], np.zeros(n, bool))
            score(now, hits, pixel[:n], path[:n], targets[:n])
