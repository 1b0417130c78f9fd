"""Figure of a calibration by known shapes: data, model and residuals of every detector."""

from pathlib import Path

import numpy as np

from helio_jax.calibration.known_report import robust_chi_square
from helio_jax.calibration.known_shape import KnownFit
from helio_jax.figures import canvas
from helio_jax.figures.plot_data import robust_range

_LIMIT = 6.0
"""Limit of the residuals' colours [standard deviations]."""


def save_known_shape(fit: KnownFit, path: Path) -> None:
    """Save one row per scan and detector: as read, model, residuals, residuals against the distance to the object.

    Args:
        fit: of the instrument.
        path: of the PNG.
    """
    rows = [(i, k) for i in range(len(fit.scans)) for k in range(len(fit.instrument.detector))]
    fig = canvas.new_figure(15.0, 3.4 * len(rows) + 0.6)
    for axes, (i, k) in zip(fig.subplots(len(rows), 4, squeeze=False), rows, strict=True):
        scan, residual = fit.scans[i], fit.residuals[i][k]
        x, y = (np.asarray(a) for a in (scan.model.raster.x, scan.model.raster.y))
        read = np.where(scan.is_used[k], scan.counts[k], np.nan)
        limits = robust_range(read)
        images = (
            (read, canvas.COUNT_MAP, limits, f"{scan.name}, {fit.instrument.detector_names[k]}: as read"),
            (fit.expected[i][k], canvas.COUNT_MAP, limits, "model"),
            (residual, canvas.ERROR_MAP, (-_LIMIT, _LIMIT), "residuals [standard deviations]"),
        )
        for ax, (image, colors, span, title) in zip(axes, images, strict=False):
            shown = canvas.draw_image(ax, x, y, np.ma.masked_invalid(image), colors, span)
            fig.colorbar(shown, ax=ax, shrink=0.8)
            ax.set_title(title, fontsize=9, loc="left")
        _draw_profile(axes[3], fit.seen[i].distance, residual)
    fig.suptitle(f"robust chi-square {robust_chi_square(fit):.2f} per pixel", fontsize=10)
    canvas.save_figure(fig, path)


def _draw_profile(ax: canvas.Axes, distance: np.ndarray, residual: np.ndarray) -> None:
    """Draw the mean residual in bins of the distance from the object's axis or edge, with its standard error."""
    known = np.isfinite(residual)
    edges = np.linspace(distance[known].min(), distance[known].max(), 41)
    bins = np.digitize(distance[known], edges[1:-1])
    n = np.maximum(np.bincount(bins, minlength=40), 1)
    mean = np.bincount(bins, residual[known], minlength=40) / n
    ax.errorbar(0.5 * (edges[1:] + edges[:-1]), mean, 1.0 / np.sqrt(n), fmt=".", ms=4, lw=0.8)
    ax.axhline(0.0, color="0.6", lw=0.8)
    ax.set_xlabel("distance from the object's axis or edge [um]")
    ax.set_title("mean residual", fontsize=9, loc="left")
    ax.grid(alpha=0.3)
