"""Figure of directions by masks: data, the outlines that the fit has found in them, and residuals."""

from pathlib import Path

import numpy as np

from helio_jax.calibration.mask_directions import MaskFit
from helio_jax.figures import canvas
from helio_jax.figures.plot_data import robust_range

_LIMIT = 6.0
"""Limit of the residuals' colours [standard deviations]."""
_SHARES = 0.1, 0.5, 0.9
"""Visible shares of the aperture whose contours are drawn."""


def save_mask_directions(fit: MaskFit, path: Path) -> None:
    """Save one row per scan and detector: as read with outlines of ball and mask, model, residuals.

    Args:
        fit: of the directions.
        path: of the PNG.
    """
    names = fit.instrument.detector_names
    rows = [(i, k) for i in range(len(fit.scans)) for k in range(len(names))]
    fig = canvas.new_figure(13.0, 3.6 * len(rows) + 0.6)
    for axes, (i, k) in zip(fig.subplots(len(rows), 3, squeeze=False), rows, strict=True):
        scan, residual, visible = fit.scans[i], fit.residuals[i][k], fit.visible[i][k]
        x, y = (np.asarray(a) for a in (scan.model.raster.x, scan.model.raster.y))
        read = np.where(scan.is_used[k], scan.counts[k], np.nan)
        limits, (polar, azimuth) = robust_range(read), np.degrees(fit.directions[k])
        title = f"{scan.name}, {names[k]}: as read, ball, mask ({', '.join(f'{s:.0%}' for s in _SHARES)} visible)"
        images = (
            (read, canvas.COUNT_MAP, limits, title),
            (fit.expected[i][k], canvas.COUNT_MAP, limits, f"model: polar {polar:.1f}, azimuth {azimuth:.1f} deg"),
            (residual, canvas.ERROR_MAP, (-_LIMIT, _LIMIT), "residuals [standard deviations]"),
        )
        for ax, (image, colors, span, text) in zip(axes, images, strict=True):
            shown = canvas.draw_image(ax, x, y, np.ma.masked_invalid(image), colors, span)
            fig.colorbar(shown, ax=ax, shrink=0.8)
            ax.set_title(text, fontsize=8, loc="left")
        is_ball = np.isnan(visible)
        axes[0].contour(x, y, is_ball.astype(float), [0.5], colors="white", linewidths=0.8)
        if np.nanmin(visible) < _SHARES[-1]:
            shown = np.ma.masked_invalid(visible)
            axes[0].contour(x, y, shown, _SHARES, colors="cyan", linewidths=0.8, linestyles=["-", "--", ":"])
    fig.suptitle("directions of the apertures by the outlines of ball and masks", fontsize=10)
    canvas.save_figure(fig, path)
