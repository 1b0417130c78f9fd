"""Field of view after rotation: which pixels of the first scan the scans of a rotated sample see. Numbers in and out.

Every scan has the same window. A sample rotated by +a shows the point r of its first scan at s = R(a) r + shift.
"""

import numpy as np

from helio_jax.arrays import pitch


def rotation_matrices(angles: np.ndarray) -> np.ndarray:
    """Compute counter-clockwise rotations [view, 2, 2] by angles [view], rad."""
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def shifts_about(axis: tuple[float, float], angles: np.ndarray) -> np.ndarray:
    """Compute the shifts [view, 2], um, of rotations by `angles` [view], rad, about one point of the window."""
    return np.asarray(axis) - rotation_matrices(angles) @ np.asarray(axis)


def scans_per_pixel(x: np.ndarray, y: np.ndarray, angles: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Count the scans that see each pixel of the first scan [y, x].

    A pixel is seen where its centre lies in the window, which reaches half a pixel beyond the outer beam positions.

    Args:
        x, y: beam positions of the window [x], [y], um, equally spaced.
        angles: rotation of the sample in each scan [view], rad.
        shifts: see above [view, 2], um.

    Source: own derivation; centred squares rotated in equal steps leave a regular polygon, tests/unit/test_planning.py.
    """
    points = np.stack(np.meshgrid(x, y), -1)
    seen = np.einsum("vij,yxj->vyxi", rotation_matrices(np.asarray(angles)), points) + np.asarray(shifts)[:, None, None]
    inside = [
        abs(seen[..., i] - 0.5 * (axis[0] + axis[-1])) <= 0.5 * (np.ptp(axis) + abs(pitch(axis))) + 1e-9 * np.ptp(axis)
        for i, axis in enumerate((x, y))
    ]
    return np.sum(inside[0] & inside[1], axis=0)
