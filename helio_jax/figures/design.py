"""Figure of a design: expected height error against masked area, coloured by the count rate."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from helio_jax.figures.canvas import new_figure, save_figure

_MARKERS = "osD^vP*Xhp"


class Point(NamedTuple):
    """A layout: label ("": one that is not kept), error of the heights [um], masked area [%], count rate over that of
    the scene's layout, number of apertures."""

    label: str
    height_std_um: float
    masked_percent: float
    count_ratio: float
    n_apertures: int


def save_pareto(points: Sequence[Point], title: str, path: Path) -> None:
    """Save the expected errors of layouts against their masked areas.

    Args:
        points: layouts; those with a label are large.
        title: of the figure.
        path: of the figure (.png, .pdf, .svg).
    """
    fig = new_figure(7.0, 4.8)
    ax = fig.add_subplot()
    rates = [p.count_ratio for p in points]
    numbers = sorted({p.n_apertures for p in points})
    drawn = None
    for number, marker in zip(numbers, _MARKERS, strict=False):
        own = [p for p in points if p.n_apertures == number]
        drawn = ax.scatter(
            [p.masked_percent for p in own], [p.height_std_um for p in own], c=[p.count_ratio for p in own],
            s=[60 if p.label else 18 for p in own], marker=marker, vmin=min(rates), vmax=max(rates) + 1e-9,
            cmap="viridis", edgecolors="black", linewidths=[0.8 if p.label else 0.2 for p in own],
            label=f"{number} apertures",
        )  # fmt: skip
    for p in points:
        if p.label:
            place = (p.masked_percent, p.height_std_um)
            ax.annotate(p.label, place, (6, 4), textcoords="offset points", fontsize=8)
    if drawn is not None:
        fig.colorbar(drawn, ax=ax, label="count rate over that of the scene's layout")
    ax.set_xlabel("masked area [%]")
    ax.set_ylabel("s.d. of the heights [um]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    fig.suptitle(title)
    save_figure(fig, path)
