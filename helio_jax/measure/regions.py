"""Regions of a raster (rectangles and polygons in beam positions), and the check of the micrographs to measure on."""

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.micrograph import MicrographStack


def parse_region(text: str) -> np.ndarray:
    """Parse "X,Y X,Y ..." [um] to corners [n, 2]: two corners of a rectangle, or three and more of a polygon.

    Raises:
        SceneError: another form.
    """
    try:
        corners = np.array([[float(v) for v in pair.split(",")] for pair in text.split()])
    except ValueError:
        corners = np.empty((0, 0))
    if corners.ndim != 2 or len(corners) < 2 or corners.shape[1] != 2 or not np.isfinite(corners).all():
        raise SceneError(f'a region is "X,Y X,Y ...", two or more corners as beam positions in um, got {text!r}')
    if len(corners) == 2:
        (x0, y0), (x1, y1) = corners
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return corners


def inside_polygon(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Mark the raster positions within a polygon, True inside [y, x] (even-odd rule).

    Raises:
        SceneError: no pixel is inside.
    """
    grid_x, grid_y = np.meshgrid(x, y)
    inside = np.zeros(grid_x.shape, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            crosses = (grid_y >= min(y0, y1)) & (grid_y < max(y0, y1))
            inside ^= crosses & (grid_x < x0 + (grid_y - y0) * (x1 - x0) / (y1 - y0))
    if not inside.any():
        raise SceneError(
            f"region {corners.tolist()} um holds no pixel: the raster is x {x[0]:g} to {x[-1]:g}, y {y[0]:g} to "
            f"{y[-1]:g} um"
        )
    return inside


def check_micrographs(stack: MicrographStack, shape: tuple[int, ...] | None = None) -> None:
    """Check that micrographs are calibrated and, where `shape` is given, that they are on that raster (y, x).

    Raises:
        SceneError: they are not.
    """
    if stack.n_rays is None:
        raise SceneError(f"{stack.name}: its background is not known: use the file that helio calibrate wrote")
    if shape is not None and stack.shape[1:] != shape:
        raise SceneError(
            f"{stack.name} has {stack.shape[2]} x {stack.shape[1]} pixels, the height map {shape[1]} x {shape[0]}: "
            "use the micrographs that the height map was reconstructed from"
        )
