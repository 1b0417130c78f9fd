"""Rotation centre of a stage from two or more scans, and the windows that keep a region in view. Numbers in and out.

A point of the sample appears at the stage position S = c + R(a) p when the sample is rotated by a: c is the rotation
centre, the stage position at which the axis of rotation meets the beam, and p belongs to the point. Valid at normal
incidence, for stages whose linear axes carry or are carried by the rotation without play.
"""

from dataclasses import dataclass

import numpy as np

from helio_jax.errors import GuardError, InputFileError
from helio_jax.planning.coverage import rotation_matrices


@dataclass(frozen=True)
class RotationCenter:
    """The rotation centre of a stage.

    Attributes:
        center: stage position (x, y) [um].
        std: standard deviation of each of its coordinates, from the residuals [um]; NaN without degrees of freedom.
        residual: standard deviation of one coordinate of a point [um]; NaN without degrees of freedom.
        n_points: points that were used.
    """

    center: tuple[float, float]
    std: float
    residual: float
    n_points: int

    def windows(self, position: np.ndarray, rotation: float, rotations: np.ndarray) -> np.ndarray:
        """Compute the stage positions [view, 2], um, that show the same point of the sample at other rotations.

        Args:
            position: stage position (x, y) that shows the point at `rotation` [um].
            rotation: of the sample there [rad].
            rotations: wanted ones [view], rad.
        """
        turn = rotation_matrices(np.asarray(rotations) - rotation)
        return np.asarray(self.center) + turn @ (np.asarray(position) - np.asarray(self.center))


def find_rotation_center(positions: np.ndarray, rotations: np.ndarray) -> RotationCenter:
    """Fit the rotation centre to the stage positions at which points of the sample were seen, by least squares.

    Args:
        positions: stage position (x, y) of each point in each scan [view, point, 2], um; NaN where it was not seen.
        rotations: of the sample in each scan, counter-clockwise in the frame of the positions [view], rad.

    Raises:
        InputFileError: no point was seen at two rotations.
        GuardError: the points fit the opposite rotations better: the sign of the rotations is wrong.

    Source: own derivation: S = c + R p is linear in c and p; tests/unit/test_planning.py.
    """
    positions, rotations = np.asarray(positions, float), np.asarray(rotations, float)
    positions = positions[:, np.isfinite(positions[..., 0]).sum(0) >= 2]
    found, opposite = (_fit(positions, sign * rotations) for sign in (1.0, -1.0))
    if found is None:
        raise InputFileError(
            "a rotation centre needs one point of the sample or more that was seen at two rotations: give the same "
            "points in two scans of different rotation"
        )
    if opposite is not None and opposite.residual < 0.5 * found.residual - 1e-6:
        raise GuardError(
            f"the points leave residuals of {found.residual:.1f} um for the stated rotations, and "
            f"{opposite.residual:.1f} um for the opposite ones: reverse the sign of the rotations"
        )
    return found


def _fit(positions: np.ndarray, rotations: np.ndarray) -> RotationCenter | None:
    """Solve S = c + R p for the centre c and every p; None if that does not determine the centre."""
    n_points = positions.shape[1]
    turns = rotation_matrices(rotations)
    views, points = np.nonzero(np.isfinite(positions[..., 0]))
    design = np.zeros((len(views), 2, 2 + 2 * n_points))
    design[:, :, :2] = np.eye(2)
    for row, view, point in zip(design, views, points, strict=True):
        row[:, 2 + 2 * point : 4 + 2 * point] = turns[view]
    design, data = design.reshape(-1, 2 + 2 * n_points), positions[views, points].ravel()
    solution, _, rank, _ = np.linalg.lstsq(design, data, rcond=1e-8)
    if not n_points or rank < design.shape[1]:
        return None
    freedom = len(data) - design.shape[1]
    residual = float(np.sqrt(np.sum((data - design @ solution) ** 2) / freedom)) if freedom else float("nan")
    spread = np.linalg.inv(design.T @ design)[0, 0]  # equal for x and y: rotations mix them alike
    return RotationCenter(
        (float(solution[0]), float(solution[1])), float(np.sqrt(spread)) * residual, residual, n_points
    )
