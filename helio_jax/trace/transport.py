"""Follow the atoms of a block of pixels from the pinhole to a detector or out of the scene.

All rays of a block fly in step: flight e starts after e events, each a scattering on the sample, which raises the
path's order, or on the plate, which does not. Every path is walked as nature does it (re-emission by the law of the
surface hit) and tallied in exact integers; the `expected` estimator adds, at every scattering, the probability of going
straight to each detector (next-event estimation). For atoms of the cosine law that is the closed-form form factor minus
the hidden part; it has no variance where nothing hides the aperture. The hidden part is estimated by a shadow ray to a
random point of the aperture or, where an aperture is so wide that this has the larger variance, by the atoms that fly
on and do not get there (maximum heuristic); what lobes send by both at once, weighted by the balance heuristic (Veach
and Guibas, SIGGRAPH 1995). So neither a narrow lobe nor a wide aperture makes heavy tails. Exact directions (mirrors)
are estimated by the atoms that hit alone.
"""

from dataclasses import dataclass, fields

import numpy as np

from helio_jax.instrument import Instrument
from helio_jax.kernel import kernel
from helio_jax.trace.analog import fly_to_the_end, land, leave
from helio_jax.trace.direct import ApertureTable, aperture_ahead, disc_point, form_factor, is_inside, spread, toward
from helio_jax.trace.intersect import MISS, Hits, Intersector
from helio_jax.trace.laws import cosine_shares, lobe_density, scatter_atoms
from helio_jax.trace.lawtable import LawTable
from helio_jax.trace.lobes import cosine_direction
from helio_jax.trace.meshplate import MeshPlate, count_caught
from helio_jax.trace.plate import PLATE, PlateTable
from helio_jax.trace.source import Sampling, Source, beam_numbers, bounce_numbers, launch_rays
from helio_jax.trace.tally import STOPPED, Tally


@dataclass(frozen=True)
class Experiment:
    """Everything a block of work needs, shared read-only between threads.

    No `laws`: cosine everywhere. No `plate`: a transparent one. `effusive`: the same with the effusive beam, if any.
    """

    intersector: Intersector
    instrument: Instrument
    apertures: ApertureTable
    source: Source
    sampling: Sampling
    n_orders: int
    max_events: int
    is_expected: bool
    laws: LawTable | None = None
    plate: PlateTable | MeshPlate | None = None
    effusive: "Experiment | None" = None

    def is_plain(self, event: int) -> bool:
        """Whether all that is done after the scattering with `event` events before it is what `analog` does in one go.

        That is so on Embree for the cosine law and no scattering plate, and, of the expected estimator, where atoms
        that fly on need not tell what is hidden (`_aimed_weight`).
        """
        if self.laws is not None or self.plate is not None or not self.intersector.has_embree:
            return False
        gap = self.instrument.sample_distance - float(self.intersector.high[2])
        n_hits = self.sampling.n_branches if event == 0 else 1
        return not self.is_expected or n_hits * self.apertures.largest_weight(gap) <= 1.0

    def material_of(self, surface: np.ndarray) -> np.ndarray:
        """Return the number of each hit surface's law (`Hits.surface`, no misses) [n]."""
        if self.plate is None:
            return self.intersector.material_of(surface)
        out, is_sample = np.full(surface.shape, self.plate.material), surface != PLATE
        out[is_sample] = self.intersector.material_of(surface[is_sample])
        return out


@dataclass
class _Paths:
    """Rays in flight: start [n, 3], direction [n, 3], pixel in block, path in pixel, sphere to skip [n].

    `target` holds the two random numbers of the next aperture point [n, 2], `density` that of the lobes in this
    direction (laws.scatter_atoms) [n], `normal` that of the sample left (zero: pinhole or plate) [n, 3], `order` how
    often the sample scattered them, `met_plate` whether the plate did [n].
    """

    origin: np.ndarray
    direction: np.ndarray
    pixel: np.ndarray
    path: np.ndarray
    target: np.ndarray
    skip: np.ndarray
    density: np.ndarray
    normal: np.ndarray
    order: np.ndarray
    met_plate: np.ndarray

    def take(self, keep: np.ndarray) -> "_Paths":
        """Return some of the rays."""
        return _Paths(*(getattr(self, field.name)[keep] for field in fields(self)))


@kernel
def _settle(
    event, max_events, n_branches, origin, direction, pixel, order, met_plate, surface, is_back, offset, plate_z,
    shapes, fates, hits, plate_hits,
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
        fate, k = land(
            event, event >= max_events, origin, direction, i, surface[i], is_back[i], offset[p, 0], offset[p, 1],
            plate_z, shapes,
        )  # fmt: skip
        if fate < 0:
            keep[m] = i
            m += 1
        else:
            fates[fate, p] += share
            if k >= 0:
                hits[min(order[i], hits.shape[0]) - 1, k, p] += 1
                if met_plate[i]:
                    plate_hits[k, p] += 1
    return keep[:m]


@kernel
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


@kernel
def _aimed_weight(n_hits, square, cosine_surface, cosine_plate, area):
    """Return the chance that an atom goes to a detector as small as a point and `area` large, if aiming may tell it.

    It is 0 where `n_hits` atoms that fly on tell it with less variance. Signed as the cosine at the surface.
    """
    weight = area * cosine_surface * cosine_plate / square / np.pi
    return weight if n_hits * abs(weight) <= 1.0 else 0.0


@kernel
def _aim(k, n_hits, point, normal, pixel, offset, plate_z, target, shapes, area):
    """Aim at a random point of detector `k`: direction, weight of that point, and whether it can count at all."""
    n = point.shape[0]
    direction, weight, is_open = np.empty((n, 3)), np.empty(n), np.empty(n, np.bool_)
    for i in range(n):
        u, v = disc_point(target[i, 0], target[i, 1])
        x, y = offset[pixel[i], 0], offset[pixel[i], 1]
        dx, dy, dz, r2, is_own = toward(k, u, v, point, i, x, y, plate_z, shapes)
        r = np.sqrt(r2)
        direction[i, 0], direction[i, 1], direction[i, 2] = dx / r, dy / r, dz / r
        cosine = (normal[i, 0] * dx + normal[i, 1] * dy + normal[i, 2] * dz) / r
        square, flat = spread(k, r2, dz / r, shapes)
        weight[i] = _aimed_weight(n_hits, square, cosine, flat, area[k])
        is_open[i] = cosine > 0.0 and is_own
    return direction, weight, is_open


@kernel
def _add(value, k, i, order, met_plate, replicate, pixel, sums, plate_sums):
    """Add what detector `k` catches of path `i`, scattered `order` times."""
    r, p = replicate[i], pixel[i]
    sums[min(order, sums.shape[0]) - 1, r, k, p] += value
    if met_plate[i]:
        plate_sums[r, k, p] += value


@kernel
def _score(
    k, share, cosine, point, normal, pixel, order, met_plate, replicate, offset, plate_z, weight, is_open, shapes,
    rims, sums, plate_sums,
):  # fmt: skip
    """Add P = n . Phi - (hidden part), times the share of cosine atoms, of every vertex to its pixel and replicate."""
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
        value *= share * cosine[i]
        _add(value, k, i, order[i] + 1, met_plate, replicate, pixel, sums, plate_sums)


@kernel
def _balance(density, n_hits, square, cosine, area):
    """Return density / (density of aiming + n density of hitting): the balance heuristic of both estimates."""
    return 1.0 / n_hits if density == np.inf else density / (square / (area * cosine) + n_hits * density)


@kernel
def _score_lobes(
    k, share, n_hits, table, material, incoming, point, normal, pixel, order, met_plate, replicate, direction, is_open,
    plate_z, shapes, area, sums, plate_sums,
):  # fmt: skip
    """Add what the lobes of every vertex send to where it aims at."""
    for i in range(point.shape[0]):
        if is_open[i]:
            density = lobe_density(table, material[i], incoming[i], normal[i], direction[i])
            r = (plate_z - point[i, 2]) / direction[i, 2]
            square, flat = spread(k, r * r, direction[i, 2], shapes)
            value = _balance(density, n_hits, square, flat, area[k]) if density > 0.0 else 0.0
            _add(share * value, k, i, order[i] + 1, met_plate, replicate, pixel, sums, plate_sums)


@kernel
def _score_hits(
    share, n_hits, density, origin, direction, pixel, order, met_plate, replicate, surface, offset, plate_z, shapes,
    area, sums, plate_sums,
):  # fmt: skip
    """Add the lobes' atoms that hit a detector."""
    for i in range(origin.shape[0]):
        if density[i] > 0.0 and surface[i] == MISS:
            p = pixel[i]
            k, r = aperture_ahead(origin, direction, i, offset[p, 0], offset[p, 1], plate_z, shapes)
            if k >= 0:
                square, flat = spread(k, r * r, direction[i, 2], shapes)
                value = _balance(density[i], n_hits, square, flat, area[k])
                _add(share * n_hits * value, k, i, order[i], met_plate, replicate, pixel, sums, plate_sums)


@kernel
def _subtract_hidden(
    share, n_hits, density, normal, origin, direction, pixel, order, met_plate, replicate, surface, offset, plate_z,
    shapes, area, sums, plate_sums,
):  # fmt: skip
    """Subtract the wide detectors that cosine atoms do not reach though they fly towards them: what `_score` left.

    The mirror image of an atom's direction below the surface it leaves tells of the parts below the horizon there.
    """
    for i in range(origin.shape[0]):
        if density[i] != 0.0:
            continue
        n, d = normal[i], direction[i]
        cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
        for sign in (1.0, -1.0):
            dx, dy, dz = d[0], d[1], d[2]
            if sign < 0.0:
                dx, dy, dz = dx - 2.0 * cosine * n[0], dy - 2.0 * cosine * n[1], dz - 2.0 * cosine * n[2]
            is_hidden = sign < 0.0 or surface[i] != MISS
            if dz <= 0.0 or cosine <= 0.0:
                continue
            r = (plate_z - origin[i, 2]) / dz
            x = origin[i, 0] - offset[pixel[i], 0] + r * dx
            y = origin[i, 1] - offset[pixel[i], 1] + r * dy
            for k in range(shapes.shape[0]):
                if is_inside(x, y, dx, dy, dz, k, shapes):
                    square, flat = spread(k, r * r, dz, shapes)
                    if is_hidden and _aimed_weight(n_hits, square, cosine, flat, area[k]) == 0.0:
                        _add(-sign * share, k, i, order[i], met_plate, replicate, pixel, sums, plate_sums)
                    is_hidden = True  # where detectors overlap, the first one has it


@kernel
def _bounce(normal, u):
    """Draw cosine-distributed directions about the normals [n, 3]."""
    out = np.empty(normal.shape)
    for i in range(normal.shape[0]):
        x, y, z = cosine_direction(normal[i, 0], normal[i, 1], normal[i, 2], u[i, 0], u[i, 1])
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
    return out


@kernel
def _history(surface, normal, order, met_plate):
    """Return what is kept of each path's past once this surface has scattered it: `normal`, `order`, `met_plate`."""
    normal, order, met_plate = normal.copy(), order.copy(), met_plate.copy()
    for i in range(surface.size):
        if surface[i] == PLATE:
            met_plate[i] = True
            normal[i] = 0.0
        else:
            order[i] += 1
    return normal, order, met_plate


def _replicate(s: Sampling, path: np.ndarray, n_branches: int) -> np.ndarray:
    """Return the replicate of each path, with one or several paths per beam ray."""
    return path // (s.n_rays * n_branches // s.n_replicates)


def _add_next_event(e: Experiment, event: int, ids: np.ndarray, tally: Tally, hits: Hits, paths: _Paths, offset):
    """Add the expected contribution of every vertex on the sample to every detector (the next-event estimate)."""
    if e.plate is not None and (on_plate := hits.surface == PLATE).any():
        hits, paths = hits.take(~on_plate), paths.take(~on_plate)
    table, plate_z, n_branches = e.apertures, e.instrument.sample_distance, 1 if event == 0 else e.sampling.n_branches
    point, normal, n_hits = hits.point, hits.normal, e.sampling.n_branches if event == 0 else 1
    whose = paths.pixel, paths.order, paths.met_plate, _replicate(e.sampling, paths.path, n_branches)
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
            k, 1.0 / n_branches, cosine, point, normal, *whose, offset, plate_z, weight, is_open, table.shapes,
            table.rims, tally.sums, tally.plate_sums,
        )  # fmt: skip
        if e.laws is not None:
            _score_lobes(
                k, 1.0 / n_branches, n_hits, e.laws, material, paths.direction, point, normal, *whose, direction,
                is_open, plate_z, table.shapes, table.area, tally.sums, tally.plate_sums,
            )  # fmt: skip


def _add_hits(e: Experiment, event: int, tally: Tally, surface: np.ndarray, paths: _Paths, offset) -> None:
    """Add what the atoms that fly on after `event` events tell: lobes' hits, and what is hidden."""
    n_branches, table = e.sampling.n_branches, e.apertures
    weight = 1.0 / n_branches, n_branches if event == 1 else 1
    whose = paths.pixel, paths.order, paths.met_plate, _replicate(e.sampling, paths.path, n_branches)
    flight = paths.origin, paths.direction, *whose, surface
    plate = offset, e.instrument.sample_distance, table.shapes, table.area
    _subtract_hidden(*weight, paths.density, paths.normal, *flight, *plate, tally.sums, tally.plate_sums)
    if e.laws is not None:
        _score_hits(*weight, paths.density, *flight, *plate, tally.sums, tally.plate_sums)


def _launch_paths(e: Experiment, ids: np.ndarray, x: np.ndarray, y: np.ndarray) -> _Paths:
    """Return the beam rays of a block of pixels."""
    s = e.sampling
    numbers = beam_numbers(ids, s.n_rays, s.n_replicates, s.points, s.seed)
    origin, direction = launch_rays(e.instrument, x, y, numbers, e.source)
    flying = np.arange(len(numbers))
    pixel, path = (flying // s.n_rays).astype(np.int32), (flying % s.n_rays).astype(np.int64)
    n = flying.size
    skip, density, normal = np.full(n, -1, np.int32), np.zeros(n), np.zeros((n, 3))
    history = np.zeros(n, np.int32), np.zeros(n, bool)
    return _Paths(origin, direction, pixel, path, numbers[:, 4:].copy(), skip, density, normal, *history)


def _scatter(e: Experiment, event: int, ids: np.ndarray, hits: Hits, paths: _Paths, stopped: np.ndarray) -> _Paths:
    """Return the rays that leave the scattering points, several from each after the beam's first hit.

    Atoms that stick are added to `stopped` [pixels].
    """
    s = e.sampling
    if event == 0 and s.n_branches > 1:
        index = np.repeat(np.arange(len(paths.path)), s.n_branches)
        hits, paths = hits.take(index), paths.take(index)
        paths.path = paths.path * s.n_branches + np.tile(np.arange(s.n_branches), index.size // s.n_branches)
    path, pixel = paths.path, paths.pixel
    u = bounce_numbers(ids[pixel], path, s.per_replicate, s.bounces, event, s.seed, s.n_replicates > 0)
    origin, skip = lift_off(hits.point, hits.normal, hits.surface, e.intersector.restart)
    history = _history(hits.surface, hits.normal, paths.order, paths.met_plate)
    if e.laws is None:
        direction, density, leaves = _bounce(hits.normal, u), np.zeros(len(path)), None
    else:
        material, key = e.material_of(hits.surface), (ids[pixel], path, event, s.seed, e.is_expected)
        direction, density, leaves = scatter_atoms(e.laws, material, paths.direction, hits.normal, u, *key)
        stopped += np.bincount(pixel[~leaves], minlength=stopped.size)
    out = _Paths(origin, direction, pixel, path, u[:, 2:].copy(), skip, density, *history)
    return out if leaves is None or leaves.all() else out.take(leaves)


def _fly_plainly(e: Experiment, event: int, ids: np.ndarray, hits: Hits, paths: _Paths, offset, tally: Tally) -> None:
    """Do all that follows the scattering with `event` events before it (`Experiment.is_plain`)."""

    def score(event: int, hits: Hits, pixel: np.ndarray, path: np.ndarray, target: np.ndarray) -> None:
        n = len(pixel)
        order, met_plate = np.full(n, event, np.int32), np.zeros(n, bool)
        none, vectors = np.zeros(n), np.zeros((n, 3))  # what plain atoms need not remember
        paths = _Paths(vectors, vectors, pixel, path, target, pixel, none, vectors, order, met_plate)
        _add_next_event(e, event, ids, tally, hits, paths, offset)

    flying = leave(event, hits, e.intersector.restart, paths.pixel, paths.path, ids, e.sampling)
    plate = e.apertures, e.instrument.sample_distance
    fly_to_the_end(
        event + 1, e.intersector, *plate, e.max_events, e.sampling.seed, ids, offset, flying, tally,
        score if e.is_expected else None,
    )  # fmt: skip


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
        e.n_orders, len(table), len(pixel_ids), s.n_replicates if e.is_expected else 0, s.n_rays, s.n_branches
    )
    ids = np.ascontiguousarray(pixel_ids, np.int64)
    offset = np.stack(e.instrument.sample_origin(x, y)[:2], -1)
    paths = _launch_paths(e, ids, x, y)
    for event in range(e.max_events + 1):
        if event == 0 and first is not None:
            hits = first.take(paths.pixel)
        else:
            hits = e.intersector.nearest(paths.origin, paths.direction, paths.skip)
        if e.plate is not None and event > 0:
            caught = e.plate.catch(hits, paths.origin, paths.direction, paths.pixel, offset, table)
            if caught is not None and (ends := caught >= 0).any():
                count_caught(tally, caught[ends], paths.pixel[ends], paths.order[ends], paths.met_plate[ends])
                hits, paths = hits.take(~ends), paths.take(~ends)
        keep = _settle(
            event, e.max_events, s.n_branches, paths.origin, paths.direction, paths.pixel, paths.order, paths.met_plate,
            hits.surface, hits.is_back, offset, e.instrument.sample_distance, table.shapes, tally.fates, tally.hits,
            tally.plate_hits,
        )  # fmt: skip
        if e.is_expected and event > 0:
            _add_hits(e, event, tally, hits.surface, paths, offset)
        if not keep.size:
            break
        hits, paths = hits.take(keep), paths.take(keep)
        if e.is_expected:
            _add_next_event(e, event, ids, tally, hits, paths, offset)
        if e.is_plain(event):
            _fly_plainly(e, event, ids, hits, paths, offset, tally)
            break
        paths = _scatter(e, event, ids, hits, paths, tally.fates[STOPPED])
    return tally
