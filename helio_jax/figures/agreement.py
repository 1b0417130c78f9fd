"""Figures of a simulation against a measurement: data, model, residuals, and the evidence for each effect."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from helio_jax.figures import canvas
from helio_jax.micrograph import MicrographStack
from helio_jax.scores.agreement import Agreement

RESIDUAL_LIMIT = 6.0
"""Limit of the residuals' colours and histogram [standard errors]."""


def save_agreement(stack: MicrographStack, found: Agreement, contrast: Mapping[str, np.ndarray], path: Path) -> None:
    """Save one row per detector: measured counts, normalised simulation, residuals and their histogram.

    Args:
        stack: the measurement.
        found: the fitted simulation.
        contrast: by cause, as a fraction of the substrate's signal [detector].
        path: of the PNG.
    """
    n = stack.shape[0]
    fig = canvas.new_figure(14.0, 3.3 * n + 0.8)
    grid = fig.subplots(n, 4, squeeze=False, width_ratios=[1, 1, 1, 0.8])
    for k, axes in enumerate(grid):
        low, high = np.nanpercentile(np.where(stack.is_observed[k], stack.counts[k], np.nan), (0.2, 99.8))
        images = (
            (stack.counts[k], canvas.COUNT_MAP, (low, high)),
            (found.model[k], canvas.COUNT_MAP, (low, high)),
            (found.residuals[k], canvas.ERROR_MAP, (-RESIDUAL_LIMIT, RESIDUAL_LIMIT)),
        )
        for ax, (image, cmap, limits) in zip(axes, images, strict=False):
            fig.colorbar(canvas.draw_image(ax, stack.x, stack.y, image, cmap, limits), ax=ax, shrink=0.8)
        axes[0].set_title(f"{found.detectors[k]}: measured [{stack.unit}]")
        axes[1].set_title(f"simulated x {found.gain[k]:.3g} + {found.offset[k]:.4g}")
        axes[2].set_title(f"residuals [standard errors], chi2/pixel {found.chi2[k]:.2f}")
        axes[0].set_ylabel("y [um]")
        _draw_histogram(axes[3], found.residuals[k])
        causes = "\n".join(f"{name}: {100 * values[k]:.1f} %" for name, values in contrast.items())
        axes[3].set_title(f"contrast over the substrate's signal\n{causes}", fontsize=8)
    for ax in grid[-1][:3]:
        ax.set_xlabel("x [um]")
    fig.suptitle(f"{stack.name}: {found.verdict()}", fontsize=10)
    canvas.save_figure(fig, path)


def _draw_histogram(ax: canvas.Axes, residuals: np.ndarray) -> None:
    """Draw the histogram of the residuals and the standard normal density."""
    edges = np.linspace(-RESIDUAL_LIMIT, RESIDUAL_LIMIT, 61)
    known = residuals[np.isfinite(residuals)]
    ax.hist(np.clip(known, edges[0], edges[-1]), edges.tolist(), density=True, color="0.7")
    ax.plot(edges, np.exp(-0.5 * edges**2) / np.sqrt(2.0 * np.pi), "k", lw=1)
    ax.set_xlabel("residual [standard errors]")


def save_effects(rows: Sequence[tuple[str, float, float]], level: float, path: Path) -> None:
    """Save bars of each effect's evidence, and the height reconstructed after its subtraction.

    Args:
        rows: name, change of the Bayesian information criterion, height [um]; NaN where not known.
        level: height by the usual model [um].
        path: of the PNG.
    """
    names, bic, height = zip(*rows, strict=True)
    place = np.arange(len(rows))[::-1]
    fig = canvas.new_figure(12.0, 0.35 * len(rows) + 1.5)
    left, right = fig.subplots(1, 2, sharey=True)
    left.barh(place, bic, color=["#4477aa" if b < 0 else "#ee6677" for b in bic])
    left.set_xscale("symlog", linthresh=10.0)
    left.set_xlabel("change of the BIC (< -10: strong evidence for the effect)")
    right.plot(height, place, "ko")
    right.axvline(level, color="0.6", lw=1)
    right.set_xlabel("height by nearfield after subtraction of the effect [um]")
    left.set_yticks(place, names)
    for ax in (left, right):
        ax.grid(alpha=0.3)
    canvas.save_figure(fig, path)
