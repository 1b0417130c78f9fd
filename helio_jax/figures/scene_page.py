"""Page of a scene before any tracing: sample, beam and plate in 3-D, the sample close up, plan view and side view.

The sample is drawn as it is seen from above: one height per point of a grid (`SampleSurface`), so that overhanging
parts do not show. Everything is in the sample frame, with the beam at the centre of the scan.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.figures import canvas
from helio_jax.figures.instrument_views import color_of, draw_plan, draw_side, shown_ellipse
from helio_jax.figures.plot_data import robust_range
from helio_jax.figures.sheet import Sheet
from helio_jax.figures.summary import summarise
from helio_jax.figures.text_box import LINE, wrap_rows, write_rows
from helio_jax.figures.wording import length_unit, short
from helio_jax.instrument import Instrument
from helio_jax.scene.scene import Scene

_WIDTH = 10.0
_BEAM, _FIELD = "#111111", "#cc3311"
_SIZES = (10, 8.5, 8)
_LOW_RELIEF = 0.08
"""Heights that span less than this share of the field are drawn larger, and the title says by what factor."""


@dataclass(frozen=True)
class SampleSurface:
    """The sample as seen from above.

    Attributes:
        x, y: grid in the sample frame [um].
        height: highest point of the sample [y, x], um; NaN where there is none.
        field: smallest and largest beam position of the scan (x0, x1, y0, y1) [um].
        section: positions along the beam's azimuth through the centre of the scan, and heights there [um].
        hit: where the beam at the centre of the scan meets the sample (x, y, z) [um]; None: it misses.
    """

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    field: tuple[float, float, float, float]
    section: tuple[np.ndarray, np.ndarray]
    hit: tuple[float, float, float] | None

    @property
    def center(self) -> tuple[float, float]:
        """Centre of the scan (x, y) [um]."""
        x0, x1, y0, y1 = self.field
        return 0.5 * (x0 + x1), 0.5 * (y0 + y1)


def draw_scene(scene: Scene, instrument: Instrument, surface: SampleSurface) -> canvas.Figure:
    """Draw a scene: in 3-D with plate and beam, the sample alone, the plate from above, a section along the beam.

    Args:
        scene: for the words.
        instrument: of the view that is drawn.
        surface: of the sample in that view.
    """
    rows = wrap_rows(summarise(scene), _WIDTH - 1.0)
    square = np.arange(2.0)
    half = Sheet.map_height(square, square, 0.5 * _WIDTH)
    page = Sheet(_WIDTH, [half + 0.2, half, LINE * len(rows)], heading=f"Scene {short(scene.name, 60)}")
    _draw_whole(page.add_wide(0, 0, 2, projection="3d"), instrument, surface)
    _draw_close(page.add_wide(0, 1, 2, projection="3d"), surface)
    draw_plan(page.add(1, 0, 2), instrument)
    phi = math.radians(instrument.beam.azimuth_deg)
    along = np.array([math.cos(phi), math.sin(phi)])
    middle = float(along @ surface.center)
    hit = None if surface.hit is None else (float(along @ surface.hit[:2]), surface.hit[2])
    draw_side(page.add(1, 1, 2), instrument, surface.section, middle, hit)
    write_rows(page.add(2, 0, 1), rows)
    return page.figure


def _draw_whole(ax: Any, instrument: Instrument, surface: SampleSurface) -> None:
    """Draw sample, plate with apertures and beam, true to scale [mm]."""
    d = instrument.sample_distance
    dx, dy, _ = instrument.sample_origin(*surface.center)
    height = surface.height
    _plot_surface(ax, 1e-3 * surface.x, 1e-3 * surface.y, 1e-3 * height)
    rims = []
    for k, detector in enumerate(instrument.detector):
        if (ellipse := shown_ellipse(detector, instrument.working_distance)) is None:
            continue
        x, y = 1e-3 * (ellipse.rim(64)[0] + [dx, dy]).T
        canvas.fill_level(ax, x, y, 1e-3 * d, color=color_of(k), alpha=0.75, zorder=5)
        ax.text(
            x.mean(),
            y.mean(),
            1.06e-3 * d,
            short(detector.name, 16),
            ha="center",
            va="bottom",
            fontsize=_SIZES[2],
            zorder=8,
        )
        rims.append(np.column_stack([x, y]))
    pinhole = 1e-3 * (instrument.pinhole_center[:2] + [dx, dy])
    spot = 1e-3 * np.array(surface.center)
    corners = 1e-3 * np.array([[surface.x[0], surface.y[0]], [surface.x[-1], surface.y[-1]]])
    points = np.concatenate([*rims, pinhole[None], spot[None], corners])
    low, high = points.min(0), points.max(0)
    margin = 0.08 * (high - low).max()
    (x0, y0), (x1, y1) = low - margin, high + margin
    plate = np.array([x0, x1, x1, x0]), np.array([y0, y0, y1, y1])
    canvas.fill_level(ax, *plate, 1e-3 * d, color="#9a9aa0", alpha=0.18, zorder=4)
    end = (*spot, 0.0) if surface.hit is None else tuple(1e-3 * v for v in surface.hit)
    ax.plot(*zip((*pinhole, 1e-3 * d), end, strict=True), color=_BEAM, lw=1.8, zorder=3)
    ax.plot([pinhole[0]], [pinhole[1]], [1e-3 * d], "o", color=_BEAM, ms=5, mfc="white", zorder=6)
    _draw_field(ax, surface, 1e-3)
    spans = (x1 - x0, y1 - y0, 1e-3 * d)
    _frame(ax, (x0, x1), (y0, y1), (min(0.0, 1e-3 * float(np.nanmin(height))), 1e-3 * d), spans, "mm")
    canvas.label_axes(ax, "Sample, beam and plate, true to scale", "x (mm)", "y (mm)", _SIZES)


def _draw_close(ax: Any, surface: SampleSurface) -> None:
    """Draw the sample alone; low relief is drawn larger."""
    size, unit = length_unit(float(np.ptp(surface.x)))
    unit = "µm" if unit == "um" else unit
    x, y, z = surface.x / size, surface.y / size, surface.height / size
    low, high = (float(v) for v in (np.nanmin(z), np.nanmax(z))) if np.isfinite(z).any() else (0.0, 0.0)
    width = max(np.ptp(x), np.ptp(y))
    flat = (high - low) < 1e-9 * width
    factor = 1.0
    if not flat and (high - low) < _LOW_RELIEF * width:
        factor = float(f"{0.2 * width / (high - low):.1g}")
    _plot_surface(ax, x, y, z)
    _draw_field(ax, surface, 1.0 / size)
    depth = 0.1 * width if flat else high - low
    bottom = low - 0.05 * width if flat else low
    spans = (float(np.ptp(x)), float(np.ptp(y)), factor * depth)
    _frame(ax, (x[0], x[-1]), (y[0], y[-1]), (bottom, bottom + depth), spans, unit)
    drawn = "true to scale" if factor == 1.0 else f"heights × {factor:g}"
    canvas.label_axes(ax, f"Sample, {drawn}; scanned field in red", f"x ({unit})", f"y ({unit})", _SIZES)


def _plot_surface(ax: Any, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> None:
    """Draw a shaded surface coloured by height."""
    low, high = robust_range(z, 0.0)
    colors = canvas.colored(np.nan_to_num(z, nan=low), (low, high))
    grid = np.meshgrid(x, y)
    ax.plot_surface(*grid, z, facecolors=colors, rstride=1, cstride=1, linewidth=0, antialiased=False, zorder=1)


def _draw_field(ax: Any, surface: SampleSurface, scale: float) -> None:
    """Draw the outline of the scanned field on the substrate."""
    x0, x1, y0, y1 = (scale * v for v in surface.field)
    ax.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], 0.0, color=_FIELD, lw=1.4, zorder=2)


def _frame(ax: Any, x: Any, y: Any, z: Any, spans: tuple[float, float, float], unit: str) -> None:
    """Set limits and the shape of the box, and label the vertical axis."""
    ax.set_xlim(*x)
    ax.set_ylim(*y)
    ax.set_zlim(*z)
    ax.set_box_aspect(spans, zoom=0.86)
    ax.computed_zorder = False  # the order of drawing is given: the plate lies above the sample
    ax.view_init(elev=24, azim=-58)
    ax.xaxis.labelpad = ax.yaxis.labelpad = 7
    ax.set_zlabel(f"height ({unit})", fontsize=_SIZES[1])
    ax.locator_params(nbins=5)
    ax.locator_params(axis="z", nbins=5 if spans[2] > 0.5 * max(spans) else 2)
