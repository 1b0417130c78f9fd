"""Rigid motions between scans of one sample that was turned between them: a rotation and a shift, no scale.

Convention: a view's `Rigid` takes a point of the common frame (um) to the beam position of that view where the same
point of the sample is seen, s = R(rotation) r + shift. A sample turned by +a therefore has the rotation +a, and in the
common frame its apertures are turned by -a (DESIGN.md section 1). Normal incidence only: there a height moves no pixel.
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

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return the images of points [..., 2]."""
        return np.asarray(points) @ self.matrix.T + np.asarray(self.shift)

    def inverse(self) -> "Rigid":
        """Return the motion that undoes this one."""
        back = -np.asarray(self.shift) @ self.matrix  # -R^T t
        return Rigid(-self.rotation, (float(back[0]), float(back[1])))

    def after(self, first: "Rigid") -> "Rigid":
        """Return the motion that does `first`, then this one."""
        x, y = self.apply(np.asarray(first.shift))
        return Rigid(self.rotation + first.rotation, (float(x), float(y)))


def about(center: np.ndarray, rotation: float, move: np.ndarray) -> Rigid:
    """Return the turn by `rotation` about `center`, then the shift by `move` (x, y) [um]."""
    shift = np.asarray(center) + np.asarray(move) - Rigid(rotation, (0.0, 0.0)).apply(np.asarray(center))
    return Rigid(rotation, (float(shift[0]), float(shift[1])))


def fit_rigid(source: np.ndarray, target: np.ndarray) -> Rigid:
    """Return the rigid motion that takes points to points with the least sum of squared distances; no reflection.

    Args:
        source, target: two or more points [n, 2], um, not all in one place.

    Source: Kabsch, Acta Cryst. A 32 (1976) 922; in the plane the angle is closed-form.
    """
    a, b = source - source.mean(0), target - target.mean(0)
    angle = math.atan2(float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(np.sum(a * b)))
    shift = target.mean(0) - Rigid(angle, (0.0, 0.0)).apply(source.mean(0))
    return Rigid(angle, (float(shift[0]), float(shift[1])))


def separation(a: Rigid, b: Rigid, points: np.ndarray) -> float:
    """Return the root mean square distance of where two motions take points [n, 2], um."""
    return float(np.sqrt(np.mean(np.sum((a.apply(points) - b.apply(points)) ** 2, -1))))
