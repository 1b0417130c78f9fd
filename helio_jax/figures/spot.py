"""The beam's spot: its widths, and a picture of it at several heights.

Points are positions along and across the beam's azimuth relative to the beam's axis, um, as the tracer gives them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from helio_jax.figures.panel import save_figure

SHARES = (0.5, 0.9)
"""Shares of the atoms whose circle is measured."""
_DRAWN = 0.995
"""Share of the atoms that the picture shows."""


def measure_spot(points: np.ndarray) -> dict[str, float]:
    """Return the widths of a spot.

    Args:
        points: along and across the beam [n, 2], um.

    Returns:
        Centre and standard deviation along and across, the full width at half maximum that a Gaussian of this
        standard deviation has, and the diameters of the circles about the centre that hold 50 % and 90 %, all in um.
    """
    center, std = points.mean(0), points.std(0)
    away = np.hypot(*(points - center).T)
    names = ("along", "across")
    found = {f"center_{name}_um": float(v) for name, v in zip(names, center, strict=True)}
    found |= {f"std_{name}_um": float(v) for name, v in zip(names, std, strict=True)}
    found |= {
        f"gaussian_fwhm_{name}_um": float(np.sqrt(8.0 * np.log(2.0)) * v) for name, v in zip(names, std, strict=True)
    }
    return found | {f"diameter_{100 * share:.0f}_um": float(2.0 * np.quantile(away, share)) for share in SHARES}


def save_spots(points: np.ndarray, spots: Sequence[Mapping[str, float]], title: str, path: Path) -> None:
    """Save one picture of the spot per height, above its profiles along and across the beam.

    Args:
        points: along and across the beam [height, n, 2], um.
        spots: "height_um" and what `measure_spot` gives, of every height.
        title: of the figure.
        path: of the figure.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    fig = Figure(figsize=(3.4 * len(spots) + 0.4, 6.4), layout="constrained")
    axes = fig.subplots(2, len(spots), squeeze=False, height_ratios=(1.4, 1.0))
    reach = max(float(np.quantile(np.abs(p), _DRAWN)) for p in points) * 1.15 or 1e-3
    edges = np.linspace(-reach, reach, 65)
    for (top, bottom), p, spot in zip(axes.T, points, spots, strict=True):
        counts = np.histogram2d(*p.T, bins=[edges, edges])[0].T
        top.imshow(counts, origin="lower", extent=(-reach, reach, -reach, reach), cmap="magma")
        center = spot["center_along_um"], spot["center_across_um"]
        top.add_patch(Circle(center, 0.5 * spot["diameter_50_um"], fill=False, color="white", lw=1.0))
        top.set_title(f"{spot['height_um']:g} um above the plane", fontsize=10)
        top.set_xlabel("along the beam [um]")
        for column, name in enumerate(("along", "across")):
            density = np.histogram(p[:, column], bins=edges)[0] / (len(p) * np.diff(edges))
            width = f"{name}: std {spot[f'std_{name}_um']:.3g} um"
            bottom.stairs(density, edges, label=width)
        bottom.set_xlabel("position [um]")
        bottom.set_title(
            f"half within {spot['diameter_50_um']:.3g} um, 90 % within {spot['diameter_90_um']:.3g} um", fontsize=9
        )
        bottom.legend(fontsize=8, loc="upper right")
        bottom.set_ylim(0.0, 1.35 * bottom.get_ylim()[1])
    axes[0, 0].set_ylabel("across the beam [um]")
    axes[1, 0].set_ylabel("share of the atoms per um")
    fig.suptitle(title)
    save_figure(fig, path)
