"""Record single atoms: point of the last scattering, final direction, scattering order, fate and detector.

Uses the random numbers of `transport`, so the atoms recorded here are those that an analog simulation counts
(tests/physics/test_follow.py). Slower than the tracer, for inspecting a pixel or a surface's angular distribution.
Transparent plates only.
"""

from dataclasses import dataclass

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.kernel import kernel
from helio_jax.scene.scene import Scene
from helio_jax.trace.analog import flight_outcome
from helio_jax.trace.experiment import Experiment
from helio_jax.trace.run import make_experiment
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.tally import DETECTED, ESCAPED, FATES, STOPPED
from helio_jax.trace.transport import launch_paths, scatter

MAX_ATOMS = 5_000_000
"""Limit of recorded atoms."""


@dataclass(frozen=True)
class Atoms:
    """Final states of single atoms (sample frame).

    Attributes:
        pixel: number of each atom's pixel, row by row [n].
        point: last scattering point, or start in the pinhole if unscattered [n, 3] [um].
        direction: unit vector of the last flight; of an adsorbed atom, the flight that ended there [n, 3].
        plate_point: (x, y) of that line in the plate's plane, lab frame [n, 2] [um]; NaN for downward flight.
        order: number of scatterings [n].
        fate: index into `tally.FATES` [n].
        detector: index of the detector hit, -1 for none [n].
    """

    pixel: np.ndarray
    point: np.ndarray
    direction: np.ndarray
    plate_point: np.ndarray
    order: np.ndarray
    fate: np.ndarray
    detector: np.ndarray

    def columns(self) -> dict[str, np.ndarray]:
        """Return the attributes as named columns [n], fates as words."""
        names = {"pixel": self.pixel}
        names |= {f"{a}_um": self.point[:, i] for i, a in enumerate("xyz")}
        names |= {f"direction_{a}": self.direction[:, i] for i, a in enumerate("xyz")}
        names |= {f"plate_{a}_um": self.plate_point[:, i] for i, a in enumerate("xy")}
        return names | {"order": self.order, "fate": np.array(FATES)[self.fate], "detector": self.detector}

    def directions(self, n_theta: int = 45, n_phi: int = 72) -> dict[str, np.ndarray]:
        """Compute the histogram of directions of the atoms that left the sample upwards, as named columns.

        Bins are equal steps of theta (from the plate normal, 0 to 90 deg) and phi (counter-clockwise from +x). The
        density per steradian is normalised to all scattered atoms; its standard error assumes Poisson counts.
        """
        has_left = np.isin(self.fate, (DETECTED, ESCAPED)) & (self.order > 0) & (self.direction[:, 2] > 0)
        x, y, z = self.direction[has_left].T
        theta, phi = np.arccos(np.minimum(z, 1.0)), np.mod(np.arctan2(y, x), 2 * np.pi)
        edges = np.linspace(0.0, np.pi / 2, n_theta + 1), np.linspace(0.0, 2 * np.pi, n_phi + 1)
        counts = np.histogram2d(theta, phi, edges)[0]
        solid_angle = -np.diff(np.cos(edges[0]))[:, None] * np.diff(edges[1])
        n = max(1, int(np.sum(self.order > 0)))
        middle = [np.degrees(0.5 * (e[1:] + e[:-1])) for e in edges]
        theta_deg, phi_deg = np.meshgrid(*middle, indexing="ij")
        columns = {"theta_deg": theta_deg, "phi_deg": phi_deg, "solid_angle_sr": solid_angle, "counts": counts}
        columns["density_per_sr"] = counts / (n * solid_angle)
        columns["std_error"] = np.sqrt(counts) / (n * solid_angle)
        return {name: column.ravel() for name, column in columns.items()}


def follow_scene(scene: Scene, settings: TraceSettings, pixel: tuple[int, int] | None = None, view: int = 0) -> Atoms:
    """Record the atoms of one pixel of a scene, or of all pixels.

    Args:
        scene: beam, plate, detectors, sample and scan.
        settings: atoms per pixel (`rays`), seed and limit on events; the estimator is always analog.
        pixel: row and column; None: all pixels.
        view: number of the view, from 0.

    Raises:
        SceneError: no such pixel or view; more than `MAX_ATOMS` atoms; a scattering plate.
    """
    (ny, nx), views = scene.image_shape, scene.views()
    i, j = pixel or (0, 0)
    if not (0 <= i < ny and 0 <= j < nx):
        raise SceneError(f"pixel must be a row from 0 to {ny - 1} and a column from 0 to {nx - 1}, got {i} {j}")
    if not 0 <= view < len(views):
        raise SceneError(f"view must be 0 to {len(views) - 1}, got {view}")
    if scene.plate.kind != "transparent":
        raise SceneError(
            f"plate.kind = {scene.plate.kind!r}: single atoms can be recorded with a transparent plate only: set "
            "plate.kind = 'transparent' and leave out the plate's size and material"
        )
    inner = np.array([i * nx + j]) if pixel else np.arange(nx * ny)
    if inner.size * settings.rays > MAX_ATOMS:
        raise SceneError(
            f"at most {MAX_ATOMS} atoms can be recorded, got {inner.size} pixels of {settings.rays}: select one pixel "
            "or lower --rays"
        )
    analog = settings.model_copy(update={"estimator": "analog"})
    body = views[view].rotated_body(scene.build_body())
    experiment = make_experiment(body, views[view].instrument, analog, scene.read_laws(), scene.read_rays())
    return follow_atoms(experiment, inner + view * nx * ny, *scene.points(inner))


def follow_atoms(experiment: Experiment, ids: np.ndarray, x: np.ndarray, y: np.ndarray) -> Atoms:
    """Record all atoms of some pixels with an analog experiment (arguments as in `transport.trace_block`)."""
    e = experiment
    ids = np.ascontiguousarray(ids, np.int64)
    offset = np.stack(e.instrument.sample_origin(x, y)[:2], -1)
    paths = launch_paths(e, ids, x, y)
    n, pixel, point, direction = len(paths.path), paths.pixel, paths.origin.copy(), paths.direction.copy()
    order, fate, detector = np.zeros(n, np.int64), np.empty(n, np.int64), np.full(n, -1)
    for event in range(e.max_events + 1):
        atoms = paths.pixel * e.sampling.n_rays + paths.path
        direction[atoms] = paths.direction
        hits = e.intersector.nearest(paths.origin, paths.direction, paths.skip)
        fate[atoms], detector[atoms] = _outcomes(
            event, event >= e.max_events, paths.origin, paths.direction, hits.surface, hits.is_back,
            offset[paths.pixel], e.instrument.sample_distance, e.apertures.shapes,
        )  # fmt: skip
        is_scattered = fate[atoms] < 0
        if not is_scattered.any():
            break
        hits, paths, atoms = hits.take(is_scattered), paths.take(is_scattered), atoms[is_scattered]
        point[atoms], order[atoms] = hits.point, event + 1
        fate[atoms] = STOPPED  # of adsorbed atoms; the others get their fate after the next flight
        paths = scatter(e, event, ids, hits, paths, np.zeros(len(ids), np.int64))
    up = direction[:, 2] > 0
    r = (e.instrument.sample_distance - point[up, 2:]) / direction[up, 2:]
    plate_point = np.full((n, 2), np.nan)
    plate_point[up] = point[up, :2] + r * direction[up, :2] - offset[pixel[up]]
    return Atoms(ids[pixel], point, direction, plate_point, order, fate, detector)


@kernel
def _outcomes(event, is_last, origin, direction, surface, is_back, offset, plate_z, shapes):
    """Return fate (-1: it scatters) and detector of every atom after a flight [n]."""
    n = origin.shape[0]
    fate, detector = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        fate[i], detector[i] = flight_outcome(
            event, is_last, origin, direction, i, surface[i], is_back[i], offset[i, 0], offset[i, 1], plate_z, shapes,
        )  # fmt: skip
    return fate, detector
