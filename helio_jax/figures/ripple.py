"""Figure of a ripple: heights, slopes along the wave vector, and the spectra of heights and micrographs."""

from collections.abc import Mapping, Sequence

import numpy as np

from helio_jax.figures import canvas
from helio_jax.figures.plot_data import robust_range, symmetric_range
from helio_jax.measure.ripple import Ripple
from helio_jax.measure.spectrum import Spectrum
from helio_jax.reconstruction import Reconstruction

_INCH = 3.6
_HIGHEST = 15.0
"""Ratio of power to noise floor at which the colours end."""
_LINE = "#33bbee"


def ripple_panel(
    rec: Reconstruction,
    along: np.ndarray,
    regions: Sequence[np.ndarray],
    ripple: Ripple,
    spectra: Mapping[str, Spectrum],
) -> canvas.Figure:
    """Draw heights with the regions' outlines, the slopes along the wave, and every spectrum with the wave vector.

    Args:
        rec: heights.
        along: slopes along the wave vector without trend, 0 outside the regions [y, x].
        regions: True inside [y, x].
        ripple: the fitted wave.
        spectra: by title; white outlines enclose the searched wave vectors.
    """
    n = 2 + len(spectra)
    figure = canvas.new_figure(n * _INCH, 1.12 * _INCH)
    axes = figure.subplots(1, n)
    x, y = rec.raster_x, rec.raster_y
    inside = np.any(regions, axis=0)
    height = np.ma.masked_array(rec.height, ~rec.has_relief)
    canvas.draw_image(axes[0], x, y, height, canvas.HEIGHT_MAP, robust_range(height.compressed(), 1.0))
    for region in regions:
        axes[0].contour(x, y, region.astype(float), [0.5], colors=_LINE, linewidths=1.0)
    slopes = np.ma.masked_array(along, ~inside)
    canvas.draw_image(axes[1], x, y, slopes, canvas.COUNT_MAP, symmetric_range(along[inside]))
    rows, columns = np.nonzero(inside)
    axes[1].set_xlim(x[columns.min()], x[columns.max()])
    axes[1].set_ylim(y[rows.min()], y[rows.max()])
    canvas.label_axes(axes[0], "height and regions", "beam position X (µm)", "beam position Y (µm)")
    canvas.label_axes(axes[1], "slope along the wave", "beam position X (µm)")
    for ax, (title, spectrum) in zip(axes[2:], spectra.items(), strict=True):
        kx, ky = 1e3 * spectrum.kx, 1e3 * spectrum.ky
        style = {"extent": (kx[0], kx[-1], ky[0], ky[-1]), "interpolation": None, "aspect": "equal"}
        shown = canvas.draw_image(ax, kx, ky, spectrum.ratio, canvas.FRACTION_MAP, (0.0, _HIGHEST), **style)
        ax.contour(kx, ky, spectrum.is_searched.astype(float), [0.5], colors="white", linewidths=0.6)
        for sign in (1, -1):
            ax.plot(*(sign * 1e3 * k for k in ripple.raster_k), "o", mfc="none", mec=_LINE, ms=14, mew=1.2)
        canvas.label_axes(ax, f"spectrum: {title}", "wave number (1/mm)")
    figure.colorbar(shown, ax=axes[-1], shrink=0.8, label="power / noise floor")
    r = ripple
    figure.suptitle(
        f"wavelength {r.wavelength_um:.1f} ± {r.wavelength_std_um:.1f} µm, amplitude {r.amplitude:.3f} ± "
        f"{r.amplitude_std:.3f} µm, peak {r.peak_over_floor:.1f} × floor",
        fontsize=10,
    )
    return figure
