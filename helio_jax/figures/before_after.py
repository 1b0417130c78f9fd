"""Figure of a calibration: every detector's image as read, what was subtracted, and the calibrated image."""

from pathlib import Path

import numpy as np

from helio_jax.figures.canvas import COUNT_MAP, draw_image, new_figure, save_figure
from helio_jax.figures.plot_data import observed_counts, robust_range
from helio_jax.micrograph import MicrographStack


def save_before_after(before: MicrographStack, after: MicrographStack, path: Path) -> None:
    """Save one row per detector as a PNG: as read, subtracted, calibrated, and the mean of each scan line's ends.

    Args:
        before: as read, in counts.
        after: calibrated; its provenance holds the gain, background and substrate's reading.
        path: of the PNG.
    """
    record = after.provenance["calibrate"]
    read, calibrated = observed_counts(before), observed_counts(after)
    fig = new_figure(15.0, 3.7 * len(read))
    axes = fig.subplots(len(read), 4, squeeze=False)
    slow = 1 if before.fast_axis == "x" else 2
    for k, (row, name) in enumerate(zip(axes, before.instrument.detector_names, strict=True)):
        signal = calibrated[k] * record["gain"][k]
        flat = record["flat"][k] - record["background"][k]
        titles = f"{name}: as read (counts)", "subtracted (counts)", "calibrated (substrate = 1)"
        for ax, image, title in zip(row, (read[k], read[k] - signal, signal / flat), titles, strict=False):
            limits = robust_range(image)
            shown = draw_image(ax, before.x, before.y, np.ma.masked_invalid(image), COUNT_MAP, limits)
            fig.colorbar(shown, ax=ax, shrink=0.8)
            ax.set_title(title, fontsize=10, loc="left")
        width = max(1, round(record["settings"]["border_fraction"] * read.shape[3 - slow]))
        for image, label in ((read[k] - record["background"][k], "as read"), (signal, "calibrated")):
            lines = image if slow == 1 else image.T
            ends = np.concatenate([lines[:, :width], lines[:, -width:]], axis=1)
            row[3].plot(np.nanmean(ends, axis=1) / flat, label=label)
        row[3].set_title("ends of the scan lines / substrate", fontsize=10, loc="left")
        row[3].set_xlabel("scan line (slow axis)")
        row[3].legend()
        row[3].grid(alpha=0.3)
    save_figure(fig, path)
