"""Pictures of a simulation against a measurement: data, model and residuals, and what each effect would change."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from helio_jax.figures.panel import COUNT_MAP, ERROR_MAP, raster_style, save_figure
from helio_jax.micrograph import MicrographStack
from helio_jax.scores.agreement import Agreement

RESIDUAL_LIMIT = 6.0
"""Colours of the residuals end at this many standard errors."""


def save_agreement(stack: MicrographStack, found: Agreement, contrast: Mapping[str, np.ndarray], path: Path) -> None:
    """Save one row per detector: measured counts, the normalised simulation, residuals and their histogram.

    Args:
        stack: what was measured.
        found: how far the simulation agrees.
        contrast: by cause, as a share of the flat's signal [detector].
        path: of the PNG.
    """
    from matplotlib.figure import Figure

    n = stack.shape[0]
    fig = Figure(figsize=(14.0, 3.3 * n + 0.8), layout="constrained")
    grid = fig.subplots(n, 4, squeeze=False, width_ratios=[1, 1, 1, 0.8])
    style = raster_style(stack.x, stack.y)
    for k, axes in enumerate(grid):
        low, high = np.nanpercentile(np.where(stack.is_observed[k], stack.counts[k], np.nan), (0.2, 99.8))
        pictures = (stack.counts[k], COUNT_MAP, low, high), (found.model[k], COUNT_MAP, low, high)
        pictures += ((found.residuals[k], ERROR_MAP, -RESIDUAL_LIMIT, RESIDUAL_LIMIT),)
        for ax, (image, colors, lo, hi) in zip(axes, pictures, strict=False):
            drawn = ax.imshow(image, cmap=colors, vmin=lo, vmax=hi, **style)
            fig.colorbar(drawn, ax=ax, shrink=0.8)
        causes = "\n".join(f"{name}: {100 * values[k]:.1f} %" for name, values in contrast.items())
        axes[0].set_title(f"{found.detectors[k]}: measured [{stack.unit}]")
        axes[1].set_title(f"simulated x {found.gain[k]:.3g} + {found.offset[k]:.4g}")
        axes[2].set_title(f"residuals [standard errors], chi2/pixel {found.chi2[k]:.2f}")
        axes[0].set_ylabel("y [um]")
        _histogram(axes[3], found.residuals[k])
        axes[3].set_title(f"contrast, share of the flat's signal\n{causes}", fontsize=8)
    for ax in grid[-1][:3]:
        ax.set_xlabel("x [um]")
    fig.suptitle(f"{stack.name}: {found.verdict()}", fontsize=10)
    save_figure(fig, path)


def _histogram(ax, residuals: np.ndarray) -> None:
    """Draw residuals beside the standard normal that they would follow."""
    edges = np.linspace(-RESIDUAL_LIMIT, RESIDUAL_LIMIT, 61)
    known = residuals[np.isfinite(residuals)]
    ax.hist(np.clip(known, edges[0], edges[-1]), edges, density=True, color="0.7")
    ax.plot(edges, np.exp(-0.5 * edges**2) / np.sqrt(2.0 * np.pi), "k", lw=1)
    ax.set_xlabel("residual [standard errors]")


def save_effects(rows: Sequence[tuple[str, float, float]], level: float, path: Path) -> None:
    """Save bars of what each effect does to the evidence, and the height that is left without it.

    Args:
        rows: name, change of the Bayesian information criterion, height [um]; NaN where not known.
        level: height of the usual model [um].
        path: of the PNG.
    """
    from matplotlib.figure import Figure

    names, bic, height = zip(*rows, strict=True)
    place = np.arange(len(rows))[::-1]
    fig = Figure(figsize=(12.0, 0.35 * len(rows) + 1.5), layout="constrained")
    left, right = fig.subplots(1, 2, sharey=True)
    left.barh(place, bic, color=["#4477aa" if b < 0 else "#ee6677" for b in bic])
    left.set_xscale("symlog", linthresh=10.0)
    left.set_xlabel("change of the BIC (< -10: strong evidence for the effect)")
    right.plot(height, place, "ko")
    right.axvline(level, color="0.6", lw=1)
    right.set_xlabel("height by nearfield, effect taken away [um]")
    left.set_yticks(place, names)
    for ax in (left, right):
        ax.grid(alpha=0.3)
    save_figure(fig, path)
