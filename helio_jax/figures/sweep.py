"""Figure of a study: scores against what is varied."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.figures.canvas import Axes, label_axes, new_figure, save_figure
from helio_jax.figures.wording import typeset

_MOST_CURVES = 10
"""Of more curves than this nobody knows which is which: single points are drawn."""
_COLUMNS = 3
_LONG = 8
"""Texts on the horizontal axis that are longer than so many letters are slanted."""


def save_sweep(
    points: Sequence[Any], labels: Mapping[str, str], scores: Mapping[str, str], title: str, path: Path
) -> None:
    """Save a figure with a panel for each score, as PNG.

    On the horizontal axis is what takes the most different numbers, the first of them; each combination of the others
    is a curve. Where that gives too many curves, as for points at random, there is a panel for each varied value.

    Args:
        points: `workflows.study_table.Averaged`; standard deviations are drawn as bars.
        labels: of what is varied.
        scores: labels of the scores.
        title: of the figure.
        path: of the PNG.
    """
    points = [point for point in points if point.mean]
    if not points or not labels:
        return
    different = {key: len({repr(point.values[key]) for point in points}) for key in labels}
    is_number = {key: all(isinstance(point.values[key], (int, float)) for point in points) for key in labels}
    across = max(labels, key=lambda key: (is_number[key], different[key]))
    along = [key for key in labels if is_number[key] and _goes_along(points, key, across)]
    apart = [key for key in labels if different[key] > 1 and key not in (across, *along)]
    groups: dict[str, list[Any]] = {}
    for point in points:
        named = [_named(labels[key], point.values[key]) for key in apart]
        groups.setdefault(", ".join(named), []).append(point)
    if len(groups) > _MOST_CURVES:
        panels = [(key, score, {"": points}) for score in scores for key in labels if different[key] > 1]
    else:
        panels = [(across, score, groups) for score in scores]
    n_columns = 2 if len(panels) == 4 else min(len(panels), _COLUMNS)
    n_rows = -(-len(panels) // n_columns)
    fig = new_figure(4.6 * n_columns, 3.6 * n_rows)
    axes = fig.subplots(n_rows, n_columns, squeeze=False).ravel()
    for ax, (key, score, curves) in zip(axes, panels, strict=False):
        _draw(ax, key, score, curves, "o-" if is_number[key] and curves is groups else "o")
        label_axes(ax, typeset(scores[score]), typeset(labels[key]), sizes=(10, 9, 8))
        ax.grid(alpha=0.3)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    if len(groups) > 1 and panels[0][2] is groups:
        axes[0].legend(fontsize=8)
    fig.suptitle(typeset(title))
    save_figure(fig, path)


def _draw(ax: Axes, key: str, score: str, curves: Mapping[str, Sequence[Any]], style: str) -> None:
    """Draw a score against one varied value; values that are no numbers stand side by side."""
    everything = [point.values[key] for points in curves.values() for point in points]
    if is_number := all(isinstance(value, (int, float)) for value in everything):
        place = dict(zip(map(repr, everything), everything, strict=True))
        if _is_geometric(everything):
            ax.set_xscale("log")
            ticks = sorted(set(everything))
            ax.set_xticks(ticks, [f"{value:g}" for value in ticks])
            ax.set_xticks([], minor=True)
    else:
        texts = list(dict.fromkeys(map(str, everything)))
        place = {repr(value): texts.index(str(value)) for value in everything}
        long = {"rotation": 20, "ha": "right"} if max(map(len, texts)) > _LONG else {}
        ax.set_xticks(range(len(texts)), texts, **long)
        ax.set_xlim(-0.5, len(texts) - 0.5)
    drawn: list[float] = []
    for name, points in curves.items():
        known = [point for point in points if score in point.mean]
        if is_number:
            known.sort(key=lambda point: point.values[key])
        mean = [point.mean[score] for point in known]
        std = [point.std[score] or 0.0 for point in known]
        ax.errorbar([place[repr(p.values[key])] for p in known], mean, std, fmt=style, ms=4, capsize=2, label=name)
        drawn += mean
    if drawn and 0.0 <= min(drawn) < 0.5 * max(drawn):  # not where all is about 100 %
        ax.set_ylim(bottom=0.0)


def _goes_along(points: Sequence[Any], key: str, across: str) -> bool:
    """Whether a varied number only rises or only falls with another one, as in lists side by side: no curves apart."""
    places, values = np.array(sorted({(point.values[across], point.values[key]) for point in points}), float).T
    steps = np.diff(values)
    return len(np.unique(places)) == len(places) and (bool(np.all(steps >= 0)) or bool(np.all(steps <= 0)))


def _named(label: str, value: Any) -> str:
    """Name a value in the legend: texts stand for themselves."""
    return (
        value if isinstance(value, str) else f"{label}: {value:g}" if isinstance(value, float) else f"{label}: {value}"
    )


def _is_geometric(values: Sequence[float]) -> bool:
    """Whether numbers are spaced by factors rather than by differences."""
    ordered = np.unique(np.asarray(values, float))
    if ordered.size < 3 or ordered[0] <= 0.0 or ordered[-1] < 5.0 * ordered[0]:
        return False
    steps, factors = np.diff(ordered), np.diff(np.log(ordered))
    return float(factors.max() / factors.min()) < float(steps.max() / steps.min())
