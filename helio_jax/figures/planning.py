"""Figure of a plan: expected error of the heights against the time of the acquisition."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from helio_jax.figures.canvas import new_figure, save_figure


class Curve(NamedTuple):
    """Candidates that differ in the dwell time: label, hours, errors of the heights [um]."""

    label: str
    hours: Sequence[float]
    errors_um: Sequence[float]


def save_plan(
    curves: Sequence[Curve], wanted_um: float | None, chosen: tuple[float, float] | None, title: str, path: Path
) -> None:
    """Save the errors of all candidates against their times.

    Args:
        curves: one line each.
        wanted_um: wanted error, a horizontal line.
        chosen: hours and error [um] of the chosen candidate, a star.
        title: of the figure.
        path: of the figure (.png, .pdf, .svg).
    """
    fig = new_figure(7.0, 4.5)
    ax = fig.add_subplot()
    for curve in curves:
        ax.loglog(curve.hours, curve.errors_um, "o-", label=curve.label)
    if wanted_um is not None:
        ax.axhline(wanted_um, color="gray", linestyle="--", label=f"wanted: {wanted_um:g} um")
    if chosen is not None:
        ax.plot(*chosen, "*", color="black", markersize=13, zorder=3, label="reaches it soonest")
    ax.set_xlabel("time of the acquisition [h]")
    ax.set_ylabel("s.d. of typical heights [um]")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
    ax.grid(which="both", alpha=0.3)
    ax.legend(fontsize=8)
    fig.suptitle(title)
    save_figure(fig, path)
