"""Signal across a straight vertical wall, as the raster shows it: mask, lit wall, and scattering between wall and foot.

The wall parts an upper from a lower level; n is its horizontal unit normal towards the lower side, h its height, u the
distance along n, in the raster, from the image of the upper edge. A point of height z is displaced by z t in the
raster (t: the beam shift). With tau(a) = (x, y) / z of the direction from the lower level to a point a of the aperture
and q(a) = -tau(a) . n:

* t . n < 0: the beam sees the wall, between u = 0 (upper edge) and u = -h t . n (foot);
* t . n > 0: the wall shadows the lower level, which begins at the distance h t . n from the foot, at u = 0;
* the lower level at the distance d = u + h t . n from the foot is masked from the part of the aperture with q > d / h.

Where q > max(t . n, 0) in the whole aperture, the mean length of the mask band along n is -h v . n with v = mean(tau) +
t, so that along v it is h |v| at any orientation. Multiple scattering is that of an infinitely long wall: radiosity of
the cosine law in two dimensions, an approximation that the fit may scale.

Source: own derivation; form factor of perpendicular strips: Howell, A Catalog of Radiation Heat Transfer Configuration
Factors, B-3. tests/inverse/test_mask_bands.py.
"""

from dataclasses import dataclass

import numpy as np

from helio_jax.detector import Aperture, Cone, axis_frame
from helio_jax.instrument import Instrument

_RINGS, _SPOKES = 8, 24
"""Points of an aperture: equal areas on rings and spokes."""
_NODES = 60
"""Nodes of the radiosity on each of wall and lower level."""
_REACH = 30.0
"""Largest distance from the foot on the lower level [heights of the wall]."""


@dataclass(frozen=True)
class Opening:
    """Directions to the points of one aperture, seen from a level.

    Attributes:
        tau: x / z, y / z of the direction to each point [point, 2].
        weight: fraction of the direct signal of the level that goes there (cosine law) [point]; sums to 1.
    """

    tau: np.ndarray
    weight: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Mean direction [2]."""
        return self.weight @ self.tau


def opening_of(aperture: Aperture | Cone, instrument: Instrument, height: float) -> Opening:
    """Compute the directions to an aperture from the illuminated point of a level `height` above the substrate [um]."""
    if isinstance(aperture, Cone):
        return _cone_opening(aperture)
    r = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)[:, None]
    s = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    cos, sin = np.cos(aperture.rotation), np.sin(aperture.rotation)
    a, b = (r * np.cos(s)).ravel() * aperture.semi_axes[0], (r * np.sin(s)).ravel() * aperture.semi_axes[1]
    points = np.stack([cos * a - sin * b, sin * a + cos * b], -1) + aperture.center
    x, y, z = instrument.spot_position(height)
    tau = (points - [x, y]) / (instrument.working_distance - z)
    weight = (1.0 + np.sum(tau**2, -1)) ** -2.0
    return Opening(tau, weight / weight.sum())


def _cone_opening(cone: Cone) -> Opening:
    """Compute the directions of a cone at infinity."""
    cos = 1.0 - (1.0 - np.cos(cone.half_angle)) * (np.arange(_RINGS) + 0.5)[:, None] / _RINGS
    s = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    sin = np.sqrt(1.0 - cos**2)
    local = np.stack([(sin * np.cos(s)).ravel(), (sin * np.sin(s)).ravel(), (cos + 0.0 * s).ravel()], -1)
    direction = local @ axis_frame(np.array(cone.axis))
    up = np.maximum(direction[:, 2], 1e-6)
    return Opening(direction[:, :2] / up[:, None], up / up.sum())


@dataclass(frozen=True)
class WallSignal:
    """Signal across a wall of one detector, in that of the lower level far away; lengths in heights of the wall.

    Attributes:
        q: -tau . n of the points of the aperture, ascending [point].
        below: fraction of the aperture with smaller q [point].
        shift: t . n.
        node, scattered, wall_node, wall_scattered: multiple scattering on the lower level by distance from the foot, on
            the wall by height above the foot, at nodes.
        wall_direct: direct signal of the wall.
        slant: cosine of the angle between n and -v, and between n and -t (0 for a beam along the plate normal).
    """

    q: np.ndarray
    below: np.ndarray
    shift: float
    node: np.ndarray
    scattered: np.ndarray
    wall_node: np.ndarray
    wall_scattered: np.ndarray
    wall_direct: float
    slant: tuple[float, float]

    @property
    def weight(self) -> np.ndarray:
        """Fraction of the level's direct signal that goes to each point of `q`."""
        return np.diff(self.below, prepend=0.0)

    @property
    def strip(self) -> float:
        """Width of the wall's image along n; 0 where the beam does not see it."""
        return max(-self.shift, 0.0)

    @property
    def dark_share(self) -> float:
        """Fraction of the aperture from which the foot of the wall, and the wall itself, are masked."""
        return 1.0 - float(np.interp(max(self.shift, 0.0), self.q, self.below, 0.0, 1.0))

    @property
    def length(self) -> float:
        """Mean length of the dark band along n, the wall's image included."""
        return self.strip + float(self.weight @ np.maximum(self.q - max(self.shift, 0.0), 0.0))

    def masked(self, d: np.ndarray) -> np.ndarray:
        """Return the masked fraction of the aperture at distances from the foot."""
        return 1.0 - np.interp(d, self.q, self.below, 0.0, 1.0)

    def on_level(self, d: np.ndarray) -> np.ndarray:
        """Return multiple scattering on the lower level at distances from the foot."""
        return np.interp(d, self.node, self.scattered)

    def on_wall(self, z: np.ndarray) -> np.ndarray:
        """Return multiple scattering on the wall at heights above its foot."""
        return np.interp(z, self.wall_node, self.wall_scattered)


def _slant(a: np.ndarray, normal: np.ndarray) -> float:
    """Return the cosine of the angle between a unit vector and -a; 0 where a is 0."""
    return -float(a @ normal) / max(float(np.hypot(a[0], a[1])), 1e-12)


def wall_signal(opening: Opening, beam_shift: tuple[float, float], normal: np.ndarray) -> WallSignal:
    """Compute the signal across a wall for one detector.

    Args:
        opening: of the detector, from the lower level.
        beam_shift: `Instrument.beam_shift`.
        normal: horizontal unit normal of the wall, towards the lower side [2].
    """
    q = -opening.tau @ normal
    order = np.argsort(q)
    below = np.cumsum(opening.weight[order])
    q = q[order]
    # distances from the foot and heights above it at the middles of cells
    ends = np.concatenate([[0.0], np.geomspace(0.01, _REACH, _NODES)])
    d, width = 0.5 * (ends[1:] + ends[:-1]), np.diff(ends)
    z, tall = (np.arange(_NODES) + 0.5) / _NODES, 1.0 / _NODES
    kernel = 0.5 * d[:, None] * z / (d[:, None] ** 2 + z**2) ** 1.5
    direct = np.interp(d, q, below, 0.0, 1.0)
    # on the wall the cosine at the surface is tau . n instead of 1
    wall_direct = float(opening.weight @ np.maximum(opening.tau @ normal, 0.0))
    to_wall, to_level = kernel * tall, (kernel * width[:, None]).T
    first = np.concatenate([direct, np.full(_NODES, wall_direct)])
    exchange = np.block([[np.zeros((_NODES, _NODES)), to_wall], [to_level, np.zeros((_NODES, _NODES))]])
    more = np.linalg.solve(np.eye(2 * _NODES) - exchange, first) - first
    shift = float(np.dot(beam_shift, normal))
    slants = _slant(opening.mean + beam_shift, normal), _slant(np.array(beam_shift), normal)
    return WallSignal(q, below, shift, d, more[:_NODES], z, more[_NODES:], wall_direct, slants)
