"""Rigid motions between scans of a sample that was rotated between them: a rotation and a shift, no scale.

Convention: the `Rigid` of a view takes a point of the common frame [um] to the beam position of that view that shows
the same point of the sample, s = R(rotation) r + shift. A sample rotated by +a has the rotation +a, and in the common
frame its apertures are rotated by -a (docs/conventions.md). Normal incidence only, where heights move no pixel.
"""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Rigid:
    """s = R(rotation) r + shift, counter-clockwise rotation [rad], shift (x, y) [um]."""

    rotation: float
    shift: tuple[float, float]

    @property
    def matrix(self) -> np.ndarray:
        """The rotation matrix [2, 2]."""
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return np.array([[c, -s], [s, c]])

    @property
    def rotation_deg(self) -> float:
        """The rotation, -180 to 180 [deg]."""
        return math.degrees(math.remainder(self.rotation, math.tau))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Move points [..., 2]."""
        return np.asarray(points) @ self.matrix.T + np.asarray(self.shift)

    def inverse(self) -> "Rigid":
        """Compute the inverse motion."""
        back = -np.asarray(self.shift) @ self.matrix  # -R^T t
        return Rigid(-self.rotation, (float(back[0]), float(back[1])))

    def after(self, first: "Rigid") -> "Rigid":
        """Compose: `first`, then this motion."""
        x, y = self.apply(np.asarray(first.shift))
        return Rigid(self.rotation + first.rotation, (float(x), float(y)))


def rotation_about(center: np.ndarray, rotation: float, move: np.ndarray) -> Rigid:
    """Rotate by `rotation` [rad] about `center`, then shift by `move` (x, y) [um]."""
    shift = np.asarray(center) + np.asarray(move) - Rigid(rotation, (0.0, 0.0)).apply(np.asarray(center))
    return Rigid(rotation, (float(shift[0]), float(shift[1])))


def fit_rigid(source: np.ndarray, target: np.ndarray) -> Rigid:
    """Fit the rigid motion from points to points by least squares; no reflection.

    Args:
        source, target: two or more points [n, 2], um, not all in one place.

    Source: Kabsch, Acta Cryst. A 32 (1976) 922; in the plane the angle is closed-form.
    """
    a, b = source - source.mean(0), target - target.mean(0)
    angle = math.atan2(float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(np.sum(a * b)))
    shift = target.mean(0) - Rigid(angle, (0.0, 0.0)).apply(source.mean(0))
    return Rigid(angle, (float(shift[0]), float(shift[1])))


def separation(a: Rigid, b: Rigid, points: np.ndarray) -> float:
    """Compute the rms distance between the images of points [n, 2] under two motions [um]."""
    return float(np.sqrt(np.mean(np.sum((a.apply(points) - b.apply(points)) ** 2, -1))))
