"""Figure of steps: the mask bands on every micrograph, and the levels of the patches with the heights of the steps."""

import math

import numpy as np

from helio_jax.figures.canvas import COUNT_MAP, HEIGHT_MAP, Axes, Figure, draw_image, label_axes, line, new_figure
from helio_jax.figures.plot_data import observed_counts, robust_range
from helio_jax.inverse.step_records import BandRow, Step, Steps
from helio_jax.micrograph import MicrographStack

_INCH = 4.6
_USED, _BOUND, _OTHER = "#44dd44", "#ff9900", "#bbbbbb"


def step_panel(stack: MicrographStack, found: Steps) -> Figure:
    """Draw every micrograph with the edges and bands of its detector, and the levels of the patches.

    Args:
        stack: micrographs.
        found: their steps; green: the height is used; orange: a lower bound; grey: no wall.
    """
    names, counts = stack.instrument.detector_names, observed_counts(stack)
    figure = new_figure((len(names) + 1) * _INCH, _INCH)
    axes = figure.subplots(1, len(names) + 1, squeeze=False, sharex=True, sharey=True)[0]
    steps = {s.number: s for s in found.steps}
    for ax, name, image in zip(axes, names, counts, strict=False):
        draw_image(ax, stack.x, stack.y, image, COUNT_MAP, robust_range(image, 0.5))
        label_axes(ax, f"{name}: mask bands", "beam position X (µm)")
        for band in (b for b in found.bands if b.detector == name):
            _draw_band(ax, steps[band.step], band)
    level = np.ma.masked_invalid(found.level)
    shown = draw_image(axes[-1], stack.x, stack.y, level, HEIGHT_MAP, robust_range(level.compressed(), 0.0))
    label_axes(axes[-1], "level of the patches (white: not determined)", "beam position X (µm)")
    figure.colorbar(shown, ax=axes[-1], shrink=0.8, label="µm")
    for step in found.steps:
        _draw_step(axes[-1], step)
    handles = [line(c, t) for c, t in ((_USED, "step"), (_BOUND, "lower bound"), (_OTHER, "not a wall"))]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8)
    return figure


def _color(is_used: bool, is_bound: bool) -> str:
    return _USED if is_used else _BOUND if is_bound else _OTHER


def _point(place: np.ndarray) -> tuple[float, float]:
    return float(place[0]), float(place[1])


def _draw_step(ax: Axes, step: Step) -> None:
    """Draw an edge with its height beside it."""
    color = _color(step.is_used, step.is_lower_bound)
    ax.plot(*zip(step.start, step.end, strict=True), "-", color=color, lw=1.6)
    if not math.isfinite(step.height_um):
        return
    sign = "≥ " if step.is_lower_bound else ""
    text = f"{step.number}: {sign}{step.height_um:.1f} ± {step.height_std_um:.1f}"
    middle = _point(0.5 * np.add(step.start, step.end))
    style = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.7}
    ax.annotate(text, middle, ha="center", va="center", fontsize=7, bbox=style)


def _draw_band(ax: Axes, step: Step, band: BandRow) -> None:
    """Draw the outline of a band, with its length."""
    color = _color(step.is_used and not band.is_lower_bound and band.note == "", band.is_lower_bound)
    angle = math.radians(band.runs_deg)
    shift = band.length_um * np.array([math.cos(angle), math.sin(angle)])
    start, end = np.array(step.start), np.array(step.end)
    ax.plot(*np.stack([start, end, end + shift, start + shift, start]).T, "-", color=color, lw=0.9)
    ax.annotate(f"{band.length_um:.0f}", _point(0.5 * (start + end + shift)), color=color, fontsize=7, ha="center")
