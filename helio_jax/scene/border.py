"""Extrapolation of a surface beyond its image, in two ways between which the truth may lie.

`extend_border`: the border falls to the substrate, a terrace continues level. An image often ends on a flank. The
surface beyond it is not imaged but scatters atoms into the image. Continued at the height of the border, it would lie
above the true substrate, nearer to the apertures, and scatter too much. `continue_border`: relief goes on as it is
inside, mirrored as that of a wall across the image (`mirror_border`), with the image's autocorrelation as that of a
rough surface (`predict_border`), or as plane waves (`continue_waves`): whichever would have predicted the image's own
margin best.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter1d, map_coordinates, median_filter

from helio_jax.scene.waves import continue_waves

MAX_TERRACE_SLOPE = 0.2
"""A terrace slopes outwards by less than this. Any other border falls with its own slope, by at least this slope.
A continuation at the height of each border pixel, errors of a fit included, kept the fit of a tall crystal from finding
its level (benchmarks/crystal.py)."""
MIN_TERRACE_HEIGHT = 0.5
"""A terrace is higher than this fraction of the relief."""
_SLOPE_PIXELS = 4
"""Pixels from the border over which its slope is measured."""
_MEDIAN_PIXELS = 9
"""Pixels along the border whose slopes are reduced to their median."""
_CONTOUR_PIXELS = 10
"""Pixels inwards over which the direction of contours is averaged, and twice the Gaussian width along the border."""
_MIN_COHERENCE, _MIN_CROSSING = 0.5, 0.3
"""Contours have a direction where the eigenvalues of the structure tensor differ by more than this share of their sum;
they cross the border where its sine exceeds this."""
_KNOWN_PIXELS = 31
"""Largest number of rows and columns from which a surface is predicted; a larger image is thinned."""
_NOISE = 0.01
"""Share of the variance of the heights that is taken for noise."""
_MARGIN = 8
"""The image's margin that has to be predicted from inside is this fraction of its shorter side; at least 2 pixels."""


def extend_border(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, level: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Add two rings of points to a grid [y + 4, x + 4]: the foot of the border on the substrate, and the far end.

    A terrace continues at its own height.

    Args:
        x, y, z: positions [y, x], um; x increases with the column and y with the row.
        level: height of the substrate, um.
        reach: half the side of the square that the substrate fills, um.
    """
    terrace = level + MIN_TERRACE_HEIGHT * (float(np.max(z)) - level)
    x, y, z = _extend_columns(x, y, z, level, terrace, reach)
    y, x, z = (field.T for field in _extend_columns(y.T, x.T, z.T, level, terrace, reach))
    return x, y, z


def _extend_columns(
    across: np.ndarray, along: np.ndarray, z: np.ndarray, level: float, terrace: float, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Add two columns on either side; `across` increases with the column, terraces are higher than `terrace`."""
    pitch = float(np.ptp(across) / (across.shape[1] - 1))
    fields, inward = (across, along, z), min(_SLOPE_PIXELS, across.shape[1] - 1)
    for side in (-1, 1):
        edge, inner = (0, inward) if side < 0 else (-1, -1 - inward)
        at, height = fields[0][:, edge], fields[2][:, edge]
        slope = _falling_slope(height, fields[2][:, inner], np.maximum(side * (at - fields[0][:, inner]), pitch), level)
        far = max(reach, float(np.max(side * at)) + 2.0 * pitch)
        run = np.abs(height - level) / np.maximum(slope, MAX_TERRACE_SLOPE)
        distance = np.clip(run, pitch, 0.5 * (far - side * at))
        beyond = np.where((slope < MAX_TERRACE_SLOPE) & (height > terrace), height, level)
        rings = (at + side * distance, np.full_like(at, side * far)), (fields[1][:, edge],) * 2, (beyond, beyond)
        fields = tuple(
            np.column_stack([*ring[::-1], field] if side < 0 else [field, *ring])
            for field, ring in zip(fields, rings, strict=True)
        )
    return fields  # type: ignore[return-value]


def continue_border(z: np.ndarray, pitch: tuple[float, float], level: float, pixels: int) -> np.ndarray:
    """Continue relief beyond the border by so many pixels, as it is inside [y + 2 pixels, x + 2 pixels].

    Args:
        z: heights [y, x], um.
        pitch: dy, dx of the raster, um.
        level: height of the substrate, um.
        pixels: fewer than there are rows and columns.
    """

    def mirrored(heights: np.ndarray, n: int) -> np.ndarray:
        return mirror_border(heights, pitch, level, n)

    margin = min(z.shape) // _MARGIN
    if margin < 2:
        return mirrored(z, pixels)
    inside, ways = z[margin:-margin, margin:-margin], (mirrored, predict_border, continue_waves)
    return min(ways, key=lambda way: float(np.mean((way(inside, margin) - z) ** 2)))(z, pixels)


def predict_border(z: np.ndarray, pixels: int) -> np.ndarray:
    """Continue heights as a stationary random surface of the image's autocorrelation [y + 2 pixels, x + 2 pixels].

    Heights beyond the border are the best linear prediction from those inside, within their range: they fall to
    the mean height over the relief's correlation length.

    Args:
        z: heights [y, x], um.
        pixels: to be added on every side.

    Source: Wiener, Extrapolation, Interpolation, and Smoothing of Stationary Time Series (1949); kriging.
    """
    mean, (ny, nx) = float(np.mean(z)), z.shape
    spectrum = np.abs(np.fft.rfft2(z - mean, (2 * ny, 2 * nx))) ** 2
    correlation = np.fft.irfft2(spectrum, (2 * ny, 2 * nx))  # biased: positive definite, 0 beyond the image's size
    if correlation[0, 0] <= 0.0:
        return np.pad(z, pixels, mode="edge")
    correlation = correlation / correlation[0, 0]
    stride = -(-max(z.shape) // _KNOWN_PIXELS)

    def between(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Compute the correlation of points of a grid with those known [point, known]."""
        of_rows = np.subtract.outer(rows, known_rows)[:, None, :, None]
        of_columns = np.subtract.outer(columns, known_columns)[None, :, None, :]
        found = np.where(
            (np.abs(of_rows) < ny) & (np.abs(of_columns) < nx),
            correlation[of_rows % (2 * ny), of_columns % (2 * nx)],
            0.0,
        )
        return found.reshape(rows.size * columns.size, -1)

    known_rows, known_columns = np.arange(0, ny, stride), np.arange(0, nx, stride)
    inside = between(known_rows, known_columns) + _NOISE * np.eye(known_rows.size * known_columns.size)
    weight = cho_solve(cho_factor(inside), (z - mean)[::stride, ::stride].ravel())
    rows, columns = (np.arange(-pixels, n + pixels + stride, stride) for n in z.shape)
    coarse = np.stack([between(rows[i : i + 1], columns) @ weight for i in range(rows.size)])
    at = np.meshgrid(*(np.arange(n + 2 * pixels) / stride for n in z.shape), indexing="ij")
    out = np.clip(mean + map_coordinates(coarse, at, order=1, mode="nearest"), z.min(), z.max())
    out[pixels : pixels + ny, pixels : pixels + nx] = z
    return out


def mirror_border(z: np.ndarray, pitch: tuple[float, float], level: float, pixels: int) -> np.ndarray:
    """Continue heights beyond the border by so many pixels, as they are inside [y + 2 pixels, x + 2 pixels].

    Each point beyond the border takes the height of a point as far inside: where contours run across the border, the
    one on the same contour, so that waves, steps and walls go on straight; elsewhere its mirror image, but a flank
    falls to the substrate.

    Args:
        z: heights [y, x], um.
        pitch: dy, dx of the raster, um.
        level: height of the substrate, um.
        pixels: fewer than there are rows and columns.
    """
    wide = _mirror_columns(z, pitch[1], pitch[0], level, pixels)
    return _mirror_columns(wide.T, pitch[0], pitch[1], level, pixels).T


def _mirror_columns(z: np.ndarray, dx: float, dy: float, level: float, pixels: int) -> np.ndarray:
    """Add columns on either side."""
    inward, steps = min(_SLOPE_PIXELS, z.shape[1] - 1), np.arange(1, pixels + 1)
    beyond = []
    for outwards in (z[:, ::-1], z):  # as if the border were on the right
        height = outwards[:, -1]
        slope = _falling_slope(height, outwards[:, -1 - inward], np.full(len(z), inward * dx), level)
        along = _contour(outwards, dx, dy)
        row = np.arange(len(z))[:, None] - 2.0 * (dx / dy) * along[:, None] * steps
        found = map_coordinates(outwards, np.broadcast_arrays(row, z.shape[1] - 1 - steps), order=1, mode="nearest")
        fall = np.maximum(height[:, None] - slope[:, None] * dx * steps, level)
        is_flank = (slope > MAX_TERRACE_SLOPE) & (height > level) & (along == 0.0)
        beyond.append(np.where(is_flank[:, None], np.minimum(found, fall), found))
    return np.column_stack([beyond[0][:, ::-1], z, beyond[1]])


def _contour(z: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """Compute y per x along the contours at the right border [y]; 0 where none crosses it.

    From the structure tensor, averaged over `_CONTOUR_PIXELS` inwards and along the border.
    """
    gy, gx = np.gradient(z[:, -_CONTOUR_PIXELS:], dy, dx)
    xx, xy, yy = (gaussian_filter1d(f.mean(1), 0.5 * _CONTOUR_PIXELS) for f in (gx * gx, gx * gy, gy * gy))
    steepest = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    coherence = np.hypot(xx - yy, 2.0 * xy) / np.maximum(xx + yy, np.finfo(float).tiny)
    across, along = -np.sin(steepest), np.cos(steepest)
    crosses = (coherence > _MIN_COHERENCE) & (np.abs(across) > _MIN_CROSSING)
    return np.where(crosses, along / np.where(crosses, across, 1.0), 0.0)


def _falling_slope(border: np.ndarray, inner: np.ndarray, distance: np.ndarray, level: float) -> np.ndarray:
    """Compute the slopes by which a border falls outwards to the substrate [pixel].

    Args:
        border, inner: heights at the border and further inside [pixel], um.
        distance: between them [pixel], um.
        level: height of the substrate, um.
    """
    slope = median_filter((inner - border) / distance, _MEDIAN_PIXELS, mode="nearest")
    return slope * np.sign(border - level)
