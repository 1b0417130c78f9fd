"""The picture of a calibration: every detector's image as read, what was taken off or left out, and what is left."""

from pathlib import Path

import numpy as np

from helio_jax.figures.panel import observed_counts, raster_style, robust_range, save_figure
from helio_jax.micrograph import MicrographStack


def save_before_after(before: MicrographStack, after: MicrographStack, path: Path) -> None:
    """Save one row per detector as a PNG: as read, drift and background taken off, calibrated, spread of the border.

    Args:
        before: as read, in counts.
        after: calibrated; its provenance says how.
        path: of the PNG.
    """
    from matplotlib.figure import Figure

    record = after.provenance["calibrate"]
    read, left = observed_counts(before), observed_counts(after)
    fig = Figure(figsize=(15.0, 3.7 * len(read)), layout="constrained")
    axes = fig.subplots(len(read), 4, squeeze=False)
    style = raster_style(before.x, before.y)
    slow = 1 if before.fast_axis == "x" else 2
    for k, row in enumerate(axes):
        name = before.instrument.detector[k].name
        taken = read[k] - record["gain"][k] * left[k]
        flat = record["flat"][k] - record["background"][k]
        titles = f"{name}: as read (counts)", "taken off (counts)", "left (flat's signal = 1)"
        for ax, image, title in zip(row, (read[k], taken, left[k] * record["gain"][k] / flat), titles, strict=False):
            low, high = robust_range(image)
            shown = ax.imshow(np.ma.masked_invalid(image), vmin=low, vmax=high, cmap="gray", **style)
            fig.colorbar(shown, ax=ax, shrink=0.8)
            ax.set_title(title, fontsize=10, loc="left")
        width = max(1, round(record["settings"]["border_fraction"] * read.shape[3 - slow]))
        for image, label in ((read[k] - record["background"][k], "as read"), (left[k] * record["gain"][k], "left")):
            lines = image if slow == 1 else image.T
            ends = np.concatenate([lines[:, :width], lines[:, -width:]], axis=1)
            row[3].plot(np.nanmean(ends, axis=1) / flat, label=label)
        row[3].set_title("ends of the scan lines / flat", fontsize=10, loc="left")
        row[3].set_xlabel("scan line (slow axis)")
        row[3].legend()
        row[3].grid(alpha=0.3)
    save_figure(fig, path)
