"""Widths and figure of the beam's spot at several heights.

Points are positions along and across the beam's azimuth relative to the beam's axis [um], from the tracer.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from helio_jax.figures.canvas import FRACTION_MAP, draw_circle, new_figure, save_figure

SHARES = (0.5, 0.9)
"""Fractions of the atoms that the measured circles hold."""
_DRAWN = 0.995
"""Fraction of the atoms within the drawn field."""


def measure_spot(points: np.ndarray) -> dict[str, float]:
    """Measure the centre and widths of a spot.

    Args:
        points: along and across the beam [n, 2], um.

    Returns:
        Centre and standard deviation along and across, the full width at half maximum of a Gaussian of the same
        standard deviation, and the diameters of the circles about the centre that hold 50 % and 90 % [um].
    """
    center, std = points.mean(0), points.std(0)
    away = np.hypot(*(points - center).T)
    names = ("along", "across")
    widths = {"center": center, "std": std, "gaussian_fwhm": np.sqrt(8.0 * np.log(2.0)) * std}
    found = {f"{kind}_{n}_um": float(v) for kind, pair in widths.items() for n, v in zip(names, pair, strict=True)}
    return found | {f"diameter_{100 * share:.0f}_um": float(2.0 * np.quantile(away, share)) for share in SHARES}


def save_spots(points: np.ndarray, spots: Sequence[Mapping[str, float]], title: str, path: Path) -> None:
    """Save one image of the spot per height, above its profiles along and across the beam.

    Args:
        points: along and across the beam [height, n, 2], um.
        spots: "height_um" and the result of `measure_spot`, of every height.
        title: of the figure.
        path: of the figure.
    """
    fig = new_figure(3.4 * len(spots) + 0.4, 6.4)
    axes = fig.subplots(2, len(spots), squeeze=False, height_ratios=(1.4, 1.0))
    reach = max(float(np.quantile(np.abs(p), _DRAWN)) for p in points) * 1.15 or 1e-3
    edges = np.linspace(-reach, reach, 65)
    for (top, bottom), p, spot in zip(axes.T, points, spots, strict=True):
        counts = np.histogram2d(*p.T, bins=[edges, edges])[0].T
        top.imshow(counts, origin="lower", extent=(-reach, reach, -reach, reach), cmap=FRACTION_MAP)
        center = spot["center_along_um"], spot["center_across_um"]
        draw_circle(top, center, 0.5 * spot["diameter_50_um"])
        top.set_title(f"{spot['height_um']:g} um above the substrate", fontsize=10)
        top.set_xlabel("along the beam [um]")
        for column, name in enumerate(("along", "across")):
            density = np.histogram(p[:, column], bins=edges)[0] / (len(p) * np.diff(edges))
            bottom.stairs(density, edges, label=f"{name}: std {spot[f'std_{name}_um']:.3g} um")
        bottom.set_xlabel("position [um]")
        bottom.set_title(
            f"half within {spot['diameter_50_um']:.3g} um, 90 % within {spot['diameter_90_um']:.3g} um", fontsize=9
        )
        bottom.legend(fontsize=8, loc="upper right")
        bottom.set_ylim(0.0, 1.35 * bottom.get_ylim()[1])
    axes[0, 0].set_ylabel("across the beam [um]")
    axes[1, 0].set_ylabel("density of atoms [1/um]")
    fig.suptitle(title)
    save_figure(fig, path)
