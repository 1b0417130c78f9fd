"""The analog tracer's inner loop: one kernel per flight for atoms that all leave by the cosine law.

Between two Embree calls every atom is landed, tallied, re-emitted and written as the next ray in one pass over memory,
in place: rays that end make room for those that go on. It gives the same bits as the general loop (transport), which
does the same in separate steps for other laws, for the expected estimator and where Embree is not installed.
"""

import numpy as np

from helio_jax.kernel import kernel
from helio_jax.trace.direct import ApertureTable, aperture_ahead
from helio_jax.trace.intersect import MISS, Intersector, resolve_hit
from helio_jax.trace.lobes import cosine_direction
from helio_jax.trace.source import bounce_number
from helio_jax.trace.tally import DETECTED, ESCAPED, LOST, STOPPED, Tally

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
def _fly_on(
    event, is_last, face, u, v, origin, direction, pixel, path, skip, o32, d32, facets, spheres, restart, middle,
    inverse_size, offset, plate_z, shapes, ids, seed, fates, hits,
):  # fmt: skip
    """Land all atoms in flight, tally those that end, send the others on in place; return how many go on."""
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
    intersector: Intersector,
    apertures: ApertureTable,
    plate_z: float,
    max_events: int,
    seed: int,
    ids: np.ndarray,
    offset: np.ndarray,
    flying: tuple[np.ndarray, ...],
    tally: Tally,
) -> None:
    """Follow atoms that have left their first scattering point until all have ended; add them to the tally.

    Args:
        intersector: the sample, on Embree.
        apertures, plate_z: of the plate, um.
        max_events: flights after which an atom is stopped.
        seed, ids: key of the random numbers, and the number of each pixel in the scan [pixels].
        offset: the plate's origin in the sample frame for every pixel [pixels, 2], um.
        flying: origin [n, 3] um, direction [n, 3], pixel, path and sphere to skip of every atom [n]; overwritten.
        tally: of these pixels.

    Raises:
        GuardError: a ray is not finite or has no unit direction.
    """
    origin, direction, pixel, path, skip = flying
    o32, d32 = intersector.scaled(origin, direction)
    n = len(origin)
    for event in range(1, max_events + 1):
        face, u, v = intersector.shoot(o32[:n], d32[:n])
        n = _fly_on(
            event, event >= max_events, face, u, v, origin, direction, pixel, path, skip, o32, d32, intersector.facets,
            intersector.spheres, intersector.restart, intersector.center, 1.0 / intersector.half_size, offset, plate_z,
            apertures.shapes, ids, seed, tally.fates, tally.hits,
        )  # fmt: skip
        if n == 0:
            break
