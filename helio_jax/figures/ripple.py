"""Picture of a ripple: heights, slopes along the wave in the regions, and the spectra of heights and micrographs."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from helio_jax.figures.panel import raster_style, robust_range, symmetric_range
from helio_jax.measure.ripple import Ripple
from helio_jax.measure.spectrum import Spectrum
from helio_jax.reconstruction import Reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INCH = 3.6
_HIGHEST = 15.0
"""Ratio to the floor at which the colour ends."""
_LINE = "#33bbee"


def ripple_panel(
    rec: Reconstruction,
    along: np.ndarray,
    regions: Sequence[np.ndarray],
    ripple: Ripple,
    spectra: Mapping[str, Spectrum],
) -> "Figure":
    """Draw heights with the regions' outlines, the slopes along the wave, and every spectrum with the wave's vector.

    Args:
        rec: heights.
        along: slopes along the wave vector, without trend, 0 outside the regions [y, x].
        regions: True inside [y, x].
        ripple: what was found.
        spectra: by title; the wave vectors that were searched lie within the lines.
    """
    from matplotlib.figure import Figure

    n = 2 + len(spectra)
    figure = Figure(figsize=(n * _INCH, 1.12 * _INCH), facecolor="white", layout="constrained")
    axes = figure.subplots(1, n)
    x, y = rec.raster_x, rec.raster_y
    style = raster_style(x, y)
    inside = np.any(regions, axis=0)
    shown = np.ma.masked_array(rec.height, ~rec.has_relief)
    low, high = robust_range(shown.compressed(), 1.0)
    axes[0].imshow(shown, cmap="viridis", vmin=low, vmax=high, **style)
    for region in regions:
        axes[0].contour(x, y, region.astype(float), [0.5], colors=_LINE, linewidths=1.0)
    low, high = symmetric_range(along[inside])
    axes[1].imshow(np.ma.masked_array(along, ~inside), cmap="gray", vmin=low, vmax=high, **style)
    rows, columns = np.nonzero(inside)
    axes[1].set_xlim(x[columns.min()], x[columns.max()])
    axes[1].set_ylim(y[rows.min()], y[rows.max()])
    for ax, title in zip(axes, ("height and regions", "slope along the wave"), strict=False):
        ax.set_title(title, fontsize=9, loc="left")
        ax.set_xlabel("beam position X (µm)", fontsize=8)
    axes[0].set_ylabel("beam position Y (µm)", fontsize=8)
    for ax, (title, spectrum) in zip(axes[2:], spectra.items(), strict=True):
        kx, ky = 1e3 * spectrum.kx, 1e3 * spectrum.ky
        box = (kx[0], kx[-1], ky[0], ky[-1])
        picture = ax.imshow(
            spectrum.ratio, origin="lower", extent=box, cmap="magma", vmin=0.0, vmax=_HIGHEST, aspect="equal"
        )
        ax.contour(kx, ky, spectrum.is_searched.astype(float), [0.5], colors="white", linewidths=0.6)
        for sign in (1, -1):
            ax.plot(*(sign * 1e3 * k for k in ripple.raster_k), "o", mfc="none", mec=_LINE, ms=14, mew=1.2)
        ax.set_title(f"spectrum: {title}", fontsize=9, loc="left")
        ax.set_xlabel("wave number (1/mm)", fontsize=8)
    figure.colorbar(picture, ax=axes[-1], shrink=0.8, label="power over floor")
    for ax in axes:
        ax.tick_params(labelsize=7)
    r, unit = ripple, ripple.unit.replace("um", "µm")
    figure.suptitle(
        f"wavelength {r.wavelength_um:.1f} ± {r.wavelength_std_um:.1f} µm, amplitude {r.amplitude:.3f} ± "
        f"{r.amplitude_std:.3f} {unit}, peak {r.peak_over_floor:.1f} × floor",
        fontsize=10,
    )
    return figure
