"""Signal across a low wall that may slope, for one detector, tabulated for speed.

As `wall_signal`, with a wall that falls by its height h over a horizontal width w: the point at the distance u from the
upper edge in the raster lies, where it is the lower level, at the horizontal distance x = u + h (t . n) from the edge,
and is masked from the part of the aperture with q > x / h. The beam sees the wall between u = 0 and u = w - h (t . n).

An atom that leaves the lower level at x goes to the wall with the probability F = (1 - cos e) / 2, where e is the
elevation of the upper edge, tan e = h / x, and leaves it as one that the beam brings there. All further paths pass
between wall and level once more: they are those of a vertical wall in proportion to 1 - cos of the inclination, twice
the probability that an atom goes from the wall to the level.

An atom that leaves the wall goes to the level further away than where its depression is d with the probability
(cos(i - d) - cos i) / 2, i: inclination of the wall; the level sends it to the points of the aperture that are not
masked there. Further paths are those of a vertical wall in proportion to (1 - cos i)^2: they pass twice more.

Source: own derivation; tests/inverse/test_low_steps.py.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from helio_jax.inverse.wall_signal import Opening, WallSignal

_NODES = 256
"""Intervals of the tables."""
_WALL_NODES = 32
"""Intervals of the table of multiple scattering on a wall, by inclination and by height."""


class LowWall(NamedTuple):
    """Signal across a wall of one detector at evenly spaced arguments from 0 to 1.

    Attributes:
        masked: fraction of the aperture masked from the lower level, by horizontal distance from the upper edge.
        reach: distance from which on nothing is masked [heights]; unit of the arguments of `masked`.
        level: multiple scattering at the distance d from the foot of a vertical wall, less that of the paths that only
            the wall scatters, by d / (1 + d) [heights].
        wall: multiple scattering on a wall, by its inclination over 90 deg, and by height above the foot over its own.
        facet: direct signal of a wall, in that of the level, by its inclination over 90 deg.
        shift: t . n.
    """

    masked: np.ndarray
    reach: float
    level: np.ndarray
    wall: np.ndarray
    facet: np.ndarray
    shift: float

    @classmethod
    def of(cls, signal: WallSignal, opening: Opening, normal: np.ndarray) -> "LowWall":
        """Tabulate the signal of a vertical wall that falls along a normal [2]."""
        t = np.linspace(0.0, 1.0, _NODES + 1)
        reach = max(float(signal.q[-1]), 1e-6)
        tilt = 0.5 * np.pi * t[:, None]
        facet = np.maximum(np.cos(tilt) + np.sin(tilt) * (opening.tau @ normal), 0.0) @ opening.weight
        distance = t / np.maximum(1.0 - t, 1e-3)
        further = signal.on_level(distance) - _to_wall(distance, 1.0) * facet[-1]
        return cls(signal.masked(reach * t), reach, further, _on_wall(signal), facet, signal.shift)

    def profile(
        self, u: np.ndarray, height: np.ndarray, width: np.ndarray, scatter: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the signal, in that of the level, and where the wall is [..., pixel].

        Args:
            u: distance from the upper edge, in the raster [..., pixel].
            height, width: of the wall [..., 1]; in units of u.
            scatter: multiple scattering, over that of the cosine law [..., 1].
        """
        image = np.maximum(width - height * self.shift, 0.0)
        x, tilt = np.maximum(u + height * self.shift, 0.0), np.arctan2(height, width)
        inclination = tilt / (0.5 * np.pi)
        facet, more = _at(self.facet, inclination), 1.0 - np.cos(tilt)
        multiple = _to_wall(x, height) * facet + more * _at(self.level, x / (x + height))
        low = 1.0 - _at(self.masked, x / (height * self.reach)) + scatter * multiple
        above = 1.0 - u / np.maximum(image, 1e-9)
        wall = facet + scatter * _at_both(self.wall, inclination, above)
        is_wall = (u > 0.0) & (u < image)
        return np.where(u <= 0.0, 1.0, np.where(is_wall, wall, low)), is_wall


def _to_wall(x: np.ndarray, height: np.ndarray | float) -> np.ndarray:
    """Compute the probability that an atom goes from the lower level to a wall, x from its upper edge."""
    return 0.5 * (1.0 - x / np.hypot(x, height))


def _on_wall(signal: WallSignal) -> np.ndarray:
    """Tabulate multiple scattering on a wall, as `LowWall.wall` [inclination, height]."""
    t = np.linspace(0.0, 1.0, _WALL_NODES + 1)
    tilt, z = 0.5 * np.pi * t[:, None, None], np.maximum(t, 1e-6)[None, :, None]
    width = np.cos(tilt) / np.maximum(np.sin(tilt), 1e-6)
    beyond = np.maximum(signal.q - width, 0.0) + width * z
    depression = np.minimum(np.arctan2(z, beyond), tilt)
    first = 0.5 * (np.cos(tilt - depression) - np.cos(tilt)) @ signal.weight
    further = (1.0 - np.cos(tilt[..., 0])) ** 2 * (signal.on_wall(t) - first[-1])
    return first + further


def _at_both(table: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Interpolate a table of two evenly spaced arguments from 0 to 1; s and t are broadcast."""
    places = [a * (n - 1) for a, n in zip(np.broadcast_arrays(s, t), table.shape, strict=True)]
    return map_coordinates(table, places, order=1, mode="nearest")


def _at(table: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Interpolate a table of evenly spaced arguments from 0 to 1."""
    place = np.clip(t, 0.0, 1.0) * _NODES
    i = np.minimum(place.astype(np.intp), _NODES - 1)
    return table[i] + (place - i) * np.diff(table)[i]
