"""Figure of a study: a score against every varied setting."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from helio_jax.figures.canvas import new_figure, save_figure


def save_sweep(rows: Sequence[Mapping[str, Any]], keys: Sequence[str], score: str, title: str, path: Path) -> None:
    """Save one plot per varied setting as a PNG; values that are not numbers are numbered in their order.

    Args:
        rows: one per point; rows without the score are skipped.
        keys: varied columns.
        score: column on the vertical axis.
        title: of the figure.
        path: of the PNG.
    """
    known = [row for row in rows if isinstance(row.get(score), (int, float))]
    if not known:
        return
    fig = new_figure(4.0 * len(keys), 3.5)
    axes = fig.subplots(1, len(keys), squeeze=False)[0]
    for ax, key in zip(axes, keys, strict=True):
        values = [row[key] for row in known]
        if not all(isinstance(v, (int, float)) for v in values):
            texts = list(dict.fromkeys(map(str, values)))
            ax.set_xticks(range(len(texts)), texts, rotation=30, ha="right")
            values = [texts.index(str(v)) for v in values]
        ax.plot(values, [row[score] for row in known], "o")
        ax.set_xlabel(key)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel(score)
    fig.suptitle(title)
    save_figure(fig, path)
