"""Follow the atoms of a block of pixels from the pinhole to a detector or out of the scene.

All rays of a block fly in step: flight e starts after e scatterings, so the scattering order is the same for
the whole batch. Every path is walked as nature does it (cosine re-emission, no absorption) and tallied in exact
integers; the `expected` estimator adds, at every scattering, the probability of going straight to each
detector (next-event estimation): the closed-form form factor minus the hidden part, which one shadow ray to a
random point of the aperture estimates. That sum has no variance where nothing hides the aperture.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from helio_jax.instrument import Instrument
from helio_jax.trace.direct import ApertureTable, aperture_point, find_aperture, form_factor
from helio_jax.trace.intersect import Hits, Intersector
from helio_jax.trace.source import Sampling, beam_numbers, bounce_numbers, launch_rays
from helio_jax.trace.tally import DETECTED, ESCAPED, LOST, STOPPED, Tally


@dataclass(frozen=True)
class Experiment:
    """Everything a block of work needs, shared read-only between threads."""

    intersector: Intersector
    instrument: Instrument
    apertures: ApertureTable
    sampling: Sampling
    n_orders: int
    max_events: int
    is_expected: bool


@dataclass
class _Paths:
    """Rays in flight: start [n, 3], direction [n, 3], pixel in block, path in pixel, sphere to skip [n].

    `target` holds the two random numbers of the next aperture point [n, 2].
    """

    origin: np.ndarray
    direction: np.ndarray
    pixel: np.ndarray
    path: np.ndarray
    target: np.ndarray
    skip: np.ndarray

    def take(self, keep: np.ndarray) -> "_Paths":
        """Return some of the rays."""
        columns = (self.origin, self.direction, self.pixel, self.path, self.target, self.skip)
        return _Paths(*(column[keep] for column in columns))


@njit(cache=True, nogil=True)
def _settle(
    event, max_events, n_branches, origin, direction, pixel, point, surface, is_back, offset, plate_z,
    center, semi_axes, cos_sin, fates, hits,
):  # fmt: skip
    """Tally the rays that end after this flight; return the indices of those that scatter.

    A beam ray (event 0) stands for all of its branches.
    """
    n = origin.shape[0]
    keep = np.empty(n, np.int64)
    m = 0
    share = n_branches if event == 0 else 1
    for i in range(n):
        p = pixel[i]
        if surface[i] == -1:
            k = -1
            if event > 0 and direction[i, 2] > 0.0:
                s = (plate_z - origin[i, 2]) / direction[i, 2]
                x = origin[i, 0] + s * direction[i, 0] - offset[p, 0]
                y = origin[i, 1] + s * direction[i, 1] - offset[p, 1]
                k = find_aperture(x, y, center, semi_axes, cos_sin)
            if k >= 0:
                fates[DETECTED, p] += 1
                hits[min(event, hits.shape[0]) - 1, k, p] += 1
            else:
                fates[ESCAPED, p] += share
        elif is_back[i]:
            fates[LOST, p] += share
        elif event >= max_events:
            fates[STOPPED, p] += share
        else:
            keep[m] = i
            m += 1
    return keep[:m]


@njit(cache=True, nogil=True)
def lift_off(point, normal, surface, restart):
    """Move points on triangles off the surface; return new origins and the sphere each ray must skip."""
    origin, skip = point.copy(), np.empty(point.shape[0], np.int32)
    for i in range(point.shape[0]):
        if surface[i] >= 0:
            skip[i] = -1
            for a in range(3):
                origin[i, a] += restart * normal[i, a]
        else:
            skip[i] = -2 - surface[i]
    return origin, skip


@njit(cache=True, nogil=True)
def _aim(k, point, normal, pixel, offset, plate_z, target, center, semi_axes, cos_sin, area):
    """Aim at a random point of aperture `k`: direction, weight of that point, and whether it can count at all."""
    n = point.shape[0]
    direction, weight, is_open = np.empty((n, 3)), np.empty(n), np.empty(n, np.bool_)
    for i in range(n):
        x, y = aperture_point(target[i, 0], target[i, 1], k, center, semi_axes, cos_sin)
        dx = x + offset[pixel[i], 0] - point[i, 0]
        dy = y + offset[pixel[i], 1] - point[i, 1]
        dz = plate_z - point[i, 2]
        r2 = dx * dx + dy * dy + dz * dz
        r = np.sqrt(r2)
        direction[i, 0], direction[i, 1], direction[i, 2] = dx / r, dy / r, dz / r
        cos_surface = (normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz) / r
        weight[i] = area[k] * cos_surface * dz / r / r2 / np.pi
        is_open[i] = cos_surface > 0.0 and find_aperture(x, y, center, semi_axes, cos_sin) == k
    return direction, weight, is_open


@njit(cache=True, nogil=True)
def _score(
    k, share, point, normal, pixel, replicate, offset, plate_z, weight, is_open, semi_axes, rims, sums
):  # fmt: skip
    """Add P = n . Phi - (hidden part) of every vertex to its pixel and replicate."""
    for i in range(point.shape[0]):
        p = pixel[i]
        fx, fy, fz = form_factor(
            point[i, 0] - offset[p, 0], point[i, 1] - offset[p, 1], plate_z - point[i, 2], k, semi_axes, rims
        )
        value = normal[i, 0] * fx + normal[i, 1] * fy + normal[i, 2] * fz
        if not is_open[i]:
            value -= weight[i]
        sums[replicate[i], k, p] += share * value


@njit(cache=True, nogil=True)
def _bounce(normal, u):
    """Draw cosine-distributed directions about the normals [n, 3] (Malley's method)."""
    out = np.empty(normal.shape)
    for i in range(normal.shape[0]):
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        # Duff et al., J. Comput. Graph. Tech. 6 (2017) 1: a frame about any unit vector
        sign = 1.0 if nz >= 0.0 else -1.0
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        r, angle = np.sqrt(u[i, 0]), 2.0 * np.pi * u[i, 1]
        s, t, c = r * np.cos(angle), r * np.sin(angle), np.sqrt(1.0 - u[i, 0])
        x = s * (1.0 + sign * nx * nx * a) + t * b + c * nx
        y = s * sign * b + t * (sign + ny * ny * a) + c * ny
        z = -s * sign * nx - t * ny + c * nz
        length = np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x / length, y / length, z / length
    return out


def _add_next_event(e: Experiment, event, sums, point, normal, surface, paths: _Paths, offset) -> None:
    """Add the expected contribution of every vertex to every detector (the next-event estimate)."""
    table, plate_z, sampling = e.apertures, e.instrument.sample_distance, e.sampling
    n_branches = 1 if event == 0 else sampling.n_branches
    replicate = paths.path // (sampling.n_rays * n_branches // sampling.n_replicates)
    shape = (table.center, table.semi_axes, table.cos_sin)
    origin, skip = lift_off(point, normal, surface, e.intersector.restart)
    for k in range(len(table.center)):
        direction, weight, is_open = _aim(
            k, point, normal, paths.pixel, offset, plate_z, paths.target, *shape, table.area
        )
        todo = np.flatnonzero(is_open)
        is_open[todo] = ~e.intersector.is_occluded(origin[todo], direction[todo], skip[todo])
        _score(
            k, 1.0 / n_branches, point, normal, paths.pixel, replicate, offset, plate_z, weight, is_open,
            table.semi_axes, table.rims, sums,
        )  # fmt: skip


def _launch_paths(e: Experiment, ids: np.ndarray, x: np.ndarray, y: np.ndarray) -> _Paths:
    """Return the beam rays of a block of pixels."""
    s = e.sampling
    numbers = beam_numbers(ids, s.n_rays, s.n_replicates, s.points, s.seed)
    origin, direction = launch_rays(e.instrument, x, y, numbers)
    flying = np.arange(len(numbers))
    pixel, path = (flying // s.n_rays).astype(np.int32), (flying % s.n_rays).astype(np.int64)
    return _Paths(origin, direction, pixel, path, numbers[:, 4:].copy(), np.full(flying.size, -1, np.int32))


def _scatter(e: Experiment, event: int, ids: np.ndarray, point, normal, surface, pixel, path) -> _Paths:
    """Return the rays that leave the scattering points, several from each after the beam's first hit."""
    s = e.sampling
    if event == 0 and s.n_branches > 1:
        point, normal, surface, pixel = (np.repeat(a, s.n_branches, 0) for a in (point, normal, surface, pixel))
        path = (path[:, None] * s.n_branches + np.arange(s.n_branches)).ravel()
    per_replicate = s.n_rays * s.n_branches // s.n_replicates if s.n_replicates else 1
    u = bounce_numbers(ids[pixel], path, per_replicate, s.bounces, event, s.seed, s.n_replicates > 0)
    origin, skip = lift_off(point, normal, surface, e.intersector.restart)
    return _Paths(origin, _bounce(normal, u), pixel, path, u[:, 2:].copy(), skip)


def trace_block(
    experiment: Experiment, pixel_ids: np.ndarray, x: np.ndarray, y: np.ndarray, first: Hits | None = None
) -> Tally:
    """Trace all rays of some pixels; a pure function of its arguments.

    Args:
        experiment: sample, instrument and settings.
        pixel_ids: number of each pixel in the scan, the key of its random numbers [pixels].
        x, y: beam positions [pixels], um.
        first: where all beam rays of a pixel meet the sample [pixels], where that is known; default: traced.
    """
    e, s, table = experiment, experiment.sampling, experiment.apertures
    tally = Tally.zeros(
        e.n_orders, len(table.center), len(pixel_ids), s.n_replicates if e.is_expected else 0, s.n_rays, s.n_branches
    )
    ids = np.ascontiguousarray(pixel_ids, np.int64)
    offset = np.stack(e.instrument.sample_origin(x, y)[:2], -1)
    paths = _launch_paths(e, ids, x, y)
    for event in range(e.max_events + 1):
        if event == 0 and first is not None:
            hits = first.take(paths.pixel)
        else:
            hits = e.intersector.nearest(paths.origin, paths.direction, paths.skip)
        keep = _settle(
            event, e.max_events, s.n_branches, paths.origin, paths.direction, paths.pixel, hits.point, hits.surface,
            hits.is_back, offset, e.instrument.sample_distance, table.center, table.semi_axes, table.cos_sin,
            tally.fates, tally.hits,
        )  # fmt: skip
        if not keep.size:
            break
        point, normal, surface = hits.point[keep], hits.normal[keep], hits.surface[keep]
        paths = paths.take(keep)
        if e.is_expected:
            sums = tally.sums[min(event, e.n_orders - 1)]
            _add_next_event(e, event, sums, point, normal, surface, paths, offset)
        paths = _scatter(e, event, ids, point, normal, surface, paths.pixel, paths.path)
    return tally
