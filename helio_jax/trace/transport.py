"""Trace the atoms of a block of pixels from the pinhole to a detector or out of the scene.

All rays of a block advance together: flight e starts after e events. An event is a scattering on the sample, which
raises the path's order, or on the plate, which does not. Each path is an analog random walk (re-emission by the law of
the surface hit), tallied in integers. The `expected` estimator adds at every scattering point the probability of
flying directly to each detector (`next_event`).
"""

import numpy as np

from helio_jax.kernel import kernel
from helio_jax.trace.analog import flight_outcome, trace_fused
from helio_jax.trace.experiment import Experiment, Paths, lift_off
from helio_jax.trace.intersect import Hits
from helio_jax.trace.laws import scatter_atoms
from helio_jax.trace.lobes import cosine_direction
from helio_jax.trace.meshplate import count_caught
from helio_jax.trace.next_event import add_hits, add_next_event
from helio_jax.trace.plate import PLATE
from helio_jax.trace.source import beam_numbers, bounce_numbers, launch_rays
from helio_jax.trace.tally import LOST, STOPPED, Tally


@kernel
def _tally_flight(
    event, max_events, n_branches, origin, direction, pixel, path, order, met_plate, surface, is_back, offset, plate_z,
    shapes, fates, hits, plate_hits, weights, lost,
):  # fmt: skip
    """Tally the rays that end after this flight; return the indices of those that scatter.

    A beam ray (event 0) counts as all of its branches.
    """
    n = origin.shape[0]
    keep = np.empty(n, np.int64)
    m = 0
    share = n_branches if event == 0 else 1
    for i in range(n):
        p = pixel[i]
        fate, k = flight_outcome(
            event, event >= max_events, origin, direction, i, surface[i], is_back[i], offset[p, 0], offset[p, 1],
            plate_z, shapes,
        )  # fmt: skip
        if fate < 0:
            keep[m] = i
            m += 1
        else:
            fates[fate, p] += share
            if fate == LOST:
                lost[p] += weights[p, path[i]] if weights.size else share
            if k >= 0:
                hits[min(order[i], hits.shape[0]) - 1, k, p] += 1
                if met_plate[i]:
                    plate_hits[k, p] += 1
    return keep[:m]


@kernel
def _bounce(normal, u):
    """Draw cosine-distributed directions about the normals [n, 3]."""
    out = np.empty(normal.shape)
    for i in range(normal.shape[0]):
        x, y, z = cosine_direction(normal[i, 0], normal[i, 1], normal[i, 2], u[i, 0], u[i, 1])
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
    return out


def launch_paths(e: Experiment, ids: np.ndarray, x: np.ndarray, y: np.ndarray) -> Paths:
    """Return the beam rays of a block of pixels."""
    s = e.sampling
    numbers = beam_numbers(ids, s.n_rays, s.n_replicates, s.points, s.seed)
    origin, direction = launch_rays(e.instrument, x, y, numbers, e.source)
    flying = np.arange(len(numbers))
    pixel, path = (flying // s.n_rays).astype(np.int32), (flying % s.n_rays).astype(np.int64)
    n = flying.size
    skip, density, normal = np.full(n, -1, np.int32), np.zeros(n), np.zeros((n, 3))
    history = np.zeros(n, np.int32), np.zeros(n, bool)
    return Paths(origin, direction, pixel, path, numbers[:, 4:].copy(), skip, density, normal, *history)


def scatter(
    e: Experiment,
    event: int,
    ids: np.ndarray,
    hits: Hits,
    paths: Paths,
    stopped: np.ndarray,
    u: np.ndarray | None = None,
) -> Paths:
    """Return the rays re-emitted at the scattering points, `n_branches` from each of the beam's first hits.

    Adsorbed atoms are added to `stopped` [pixels]. `u`: random numbers of the paths [n, 4]; default: `bounce_numbers`.
    """
    s = e.sampling
    if event == 0 and s.n_branches > 1:
        index = np.repeat(np.arange(len(paths.path)), s.n_branches)
        hits, paths = hits.take(index), paths.take(index)
        paths.path = paths.path * s.n_branches + np.tile(np.arange(s.n_branches), index.size // s.n_branches)
    path, pixel = paths.path, paths.pixel
    if u is None:
        u = bounce_numbers(ids[pixel], path, s.per_replicate, s.bounces, event, s.seed)
    origin, skip = lift_off(hits.point, hits.normal, hits.surface, e.intersector.restart)
    on_plate = hits.surface == PLATE
    normal = np.where(on_plate[:, None], 0.0, hits.normal)
    history = normal, paths.order + ~on_plate, paths.met_plate | on_plate
    if e.laws is None:
        direction, density, leaves = _bounce(hits.normal, u), np.zeros(len(path)), None
    else:
        material, key = e.material_of(hits.surface), (ids[pixel], path, event, s.seed, e.is_expected)
        direction, density, leaves = scatter_atoms(e.laws, material, paths.direction, hits.normal, u, *key)
        stopped += np.bincount(pixel[~leaves], minlength=stopped.size)
    out = Paths(origin, direction, pixel, path, u[:, 2:].copy(), skip, density, *history)
    return out if leaves is None or leaves.all() else out.take(leaves)


def trace_block(
    experiment: Experiment, pixel_ids: np.ndarray, x: np.ndarray, y: np.ndarray, first: Hits | None = None
) -> Tally:
    """Trace all rays of some pixels; a pure function of its arguments.

    Args:
        experiment: sample, instrument and settings.
        pixel_ids: number of each pixel in the scan, the key of its random numbers [pixels].
        x, y: beam positions [pixels] [um].
        first: known first hit of all beam rays of each pixel [pixels]; None: the beam is traced.
    """
    e, s = experiment, experiment.sampling
    tally = Tally.zeros(
        e.n_orders, len(e.apertures), len(pixel_ids), s.n_replicates if e.is_expected else 0, s.n_rays, s.n_branches
    )
    ids = np.ascontiguousarray(pixel_ids, np.int64)
    offset = np.stack(e.instrument.sample_origin(x, y)[:2], -1)
    follow(e, 0, ids, launch_paths(e, ids, x, y), offset, tally, first)
    return tally


def follow(
    e: Experiment,
    start: int,
    ids: np.ndarray,
    paths: Paths,
    offset: np.ndarray,
    tally: Tally,
    first: Hits | None = None,
) -> None:
    """Trace rays until all have ended, and tally the flights after more than `start` events, and their hits.

    With `first` [pixels], these are the hits of the first flight. `offset`: `Instrument.sample_origin` [pixels, 2].
    """
    table, n_branches = e.apertures, e.sampling.n_branches
    for event in range(start, e.max_events + 1):
        if event == start and first is not None:
            hits = first.take(paths.pixel)
        else:
            hits = e.intersector.nearest(paths.origin, paths.direction, paths.skip)
        if e.plate is not None and event > 0:
            caught = e.plate.catch(hits, paths.origin, paths.direction, paths.pixel, offset, table)
            if caught is not None and (ends := caught >= 0).any():
                count_caught(tally, caught[ends], paths.pixel[ends], paths.order[ends], paths.met_plate[ends])
                hits, paths = hits.take(~ends), paths.take(~ends)
        keep = _tally_flight(
            event, e.max_events, n_branches, paths.origin, paths.direction, paths.pixel, paths.path, paths.order,
            paths.met_plate, hits.surface, hits.is_back, offset, e.instrument.sample_distance, table.shapes,
            tally.fates, tally.hits, tally.plate_hits, tally.weights, tally.lost,
        )  # fmt: skip
        if e.is_expected and event > start:
            add_hits(e, event, tally, hits.surface, paths, offset)
        if not keep.size:
            break
        hits, paths = hits.take(keep), paths.take(keep)
        if e.is_expected:
            add_next_event(e, event, ids, tally, hits, paths, offset)
        if e.can_fuse(event):
            trace_fused(e, event, ids, hits, paths, offset, tally)
            break
        paths = scatter(e, event, ids, hits, paths, tally.fates[STOPPED])
