"""Figure of a list of positions with dwell times: heights, dwell times of every scan, standard deviations after it."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from helio_jax.figures.canvas import new_figure, save_figure
from helio_jax.figures.maps import draw_map

_MAP = "viridis"


class DwellMap(NamedTuple):
    """Dwell times of one scan: title, x and y [um], dwell times [y, x], s; 0: not visited."""

    title: str
    x: np.ndarray
    y: np.ndarray
    dwell: np.ndarray


def save_dwell(
    x: np.ndarray,
    y: np.ndarray,
    height: np.ndarray,
    std: tuple[np.ndarray, np.ndarray],
    region_um: tuple[float, float, float, float],
    scans: Sequence[DwellMap],
    title: str,
    path: Path,
) -> None:
    """Save heights with the region's outline, the dwell map of every scan, and the standard deviations that follow.

    Contours of the heights are drawn over dwell maps on the raster of the heights.

    Args:
        x, y: of the heights [um].
        height: [y, x], um.
        std: standard deviation of every height so far, and after the list [y, x], um.
        region_um: low and high x, low and high y of the region.
        scans: dwell maps.
        title: of the figure.
        path: of the figure (.png, .pdf, .svg).
    """
    n = len(scans) + 2
    fig = new_figure(4.6 * n, 4.4)
    axes = fig.subplots(1, n, squeeze=False)[0]
    draw_map(axes[0], x, y, height, "heights, and the region", "um")
    x0, x1, y0, y1 = region_um
    axes[0].plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color="white", linewidth=1.5)
    for ax, scan in zip(axes[1:-1], scans, strict=True):
        visited = np.where(scan.dwell > 0.0, scan.dwell, np.nan)
        draw_map(ax, scan.x, scan.y, visited, scan.title, "dwell time (s)", cmap=_MAP)
        if scan.dwell.shape == height.shape and np.array_equal(scan.x, x) and np.ptp(height) > 0.0:
            ax.contour(x, y, height, levels=6, colors="black", linewidths=0.6)
    ratio = std[1] / np.maximum(std[0], 1e-300)
    draw_map(axes[-1], x, y, ratio, "standard deviation after over before", "", cmap=_MAP)
    fig.suptitle(title)
    save_figure(fig, path)
