"""Figures for papers: micrographs, heights, errors, profiles. The door to matplotlib.

Maps are drawn in the beam frame (one pixel per beam position, origin lower); relief and profiles at the surface
points' own positions, so that shapes are true and shadows show as gaps. Uses `matplotlib.figure.Figure` only: no
pyplot, no display, no global state. Interactive figures: report.py.
"""

import io
import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.errors import SceneError
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import REASONS, Reconstruction
from helio_jax.scores.metrics import Scores, Truth, height_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEIGHT_MAP, COUNT_MAP, FRACTION_MAP, ERROR_MAP = "viridis", "gray", "magma", "RdBu_r"
REASON_COLORS = ("#d9d9d9", "#4477aa", "#ee6677", "#ccbb44", "#222222", "#aa3377")
"""One colour per entry of `REASONS` (Tol's bright scheme, distinct for the colour-blind)."""
PANEL_SCORES = (
    "recovered_height", "rms_region", "rms_image", "rms_valid", "ring_error", "shape_error", "slope_rms",
    "coverage_1", "coverage_2", "valid_fraction", "level_um", "H_um",
)  # fmt: skip
WIDTH = 12.6
"""Width of the panel [inch]."""
_MISSING = "#e8b4b8"
_LONGEST_EDGE = 6.0


def surface_cells(rec: Reconstruction) -> np.ndarray:
    """Return True for the raster cells (between 2 x 2 pixels) that are one piece of surface [y-1, x-1].

    A cell is cut where a height is missing or where an edge, between the surface points' own positions, is longer
    than 6 pitches: the gap of a shadow, or a high step up.

    Source: own choice; 6 pitches is a slope of 83 % of the shadow limit, sphere A's shadow gap is 11 pitches.
    """
    x, y = rec.x, rec.y
    along = np.hypot(np.diff(x, axis=1), np.diff(y, axis=1)) / pitch(rec.raster_x)
    up = np.hypot(np.diff(x, axis=0), np.diff(y, axis=0)) / pitch(rec.raster_y)
    along, up = along <= _LONGEST_EDGE, up <= _LONGEST_EDGE  # False where a height is NaN
    return along[:-1] & along[1:] & up[:, :-1] & up[:, 1:] & np.isfinite(rec.height[1:, 1:] + rec.height[:-1, :-1])


def apex_pixel(height: np.ndarray) -> tuple[int, int]:
    """Return (row, column) of the pixel farthest above or below the median height; NaN pixels are left out."""
    away = np.abs(height - np.nanmedian(height)) if np.isfinite(height).any() else np.zeros(height.shape)
    row, column = np.unravel_index(np.argmax(np.where(np.isfinite(away), away, -1.0)), height.shape)
    return int(row), int(column)


def robust_range(values: np.ndarray, percent: float = 0.2) -> tuple[float, float]:
    """Return the range of the finite values without `percent` at either end; (0, 1) where there is none."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [percent, 100 - percent]) if finite.size else (0.0, 1.0)
    return (float(low), float(high)) if high > low else (float(low) - 0.5, float(low) + 0.5)


def symmetric_range(values: np.ndarray) -> tuple[float, float]:
    """Return (-m, m) that holds 99.6 % of the values, for diverging colours."""
    m = max(map(abs, robust_range(values)))
    return -m, m


def observed_counts(stack: MicrographStack) -> np.ndarray:
    """Return the counts, NaN where none was recorded [detector, y, x]."""
    return np.where(stack.is_observed, stack.counts, np.nan)


def multiple_fraction(stack: MicrographStack) -> np.ndarray | None:
    """Return the fraction of the sample's counts of order 2 and above [detector, y, x]; None if orders are unknown."""
    if stack.by_order is None or stack.multiple is None:
        return None
    total = stack.by_order.sum(0)
    return np.divide(stack.multiple, total, out=np.full_like(total, np.nan), where=total > 0)


def residual_rms(residuals: np.ndarray) -> np.ndarray:
    """Return the root mean square over the detectors that have data [y, x]; NaN where none has."""
    has_data = np.isfinite(residuals)
    total, n = np.where(has_data, residuals, 0.0), has_data.sum(0)
    return np.sqrt(np.divide((total**2).sum(0), n, out=np.full(n.shape, np.nan), where=n > 0))


def profile_line(
    rec: Reconstruction, height: np.ndarray, along: str, pixel: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return one raster line of `height` through `pixel`, at the surface points' own positions.

    Returns:
        Positions along "x" or "y" [um], heights [um], and the indices before which the beam leaves a gap.
    """
    line = (pixel[0], slice(None)) if along == "x" else (slice(None), pixel[1])
    points = rec.instrument.surface_position(rec.raster_x[None, :], rec.raster_y[:, None], height)
    at = points[0 if along == "x" else 1] + np.zeros_like(height)
    step = pitch(rec.raster_x if along == "x" else rec.raster_y)
    return at[line], height[line], np.flatnonzero(np.abs(np.diff(at[line])) > _LONGEST_EDGE * step) + 1


def profile_band(
    rec: Reconstruction, height: np.ndarray, along: str, pixel: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the outline (positions, heights) [um] of height +- height_std along one raster line; no missing points."""
    assert rec.height_std is not None  # callers check
    low, high = (profile_line(rec, height + s * rec.height_std, along, pixel) for s in (-1, 1))
    use = np.isfinite(low[1]) & np.isfinite(high[1])
    return tuple(np.concatenate([low[k][use], high[k][use][::-1]]) for k in (0, 1))  # type: ignore[return-value]


def raster_style(x: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """Return how `imshow` draws pixels [y, x] about their beam positions, um, unsmoothed, y upwards."""
    half_x, half_y = 0.5 * pitch(x), 0.5 * pitch(y)
    extent = (x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y)
    return {"origin": "lower", "interpolation": "nearest", "extent": extent}


def _label_axes(ax: "Axes", title: str, xlabel: str, ylabel: str) -> None:
    ax.set_title(title, fontsize=10, loc="left")
    ax.set_xlabel(xlabel, fontsize=8.5)
    ax.set_ylabel(ylabel, fontsize=8.5)
    ax.tick_params(labelsize=8, direction="out", length=3)


def _draw_map(ax: "Axes", x: np.ndarray, y: np.ndarray, image: np.ndarray, title: str, unit: str, **style: Any) -> None:
    """Draw one image [y, x] over its beam positions, to scale, with a colour bar; missing pixels in pink."""
    from matplotlib import colormaps

    low, high = style.get("limits") or robust_range(image)
    shown = ax.imshow(
        np.ma.masked_invalid(image),
        cmap=colormaps[style.get("cmap", COUNT_MAP)].with_extremes(bad=_MISSING),
        vmin=low,
        vmax=high,
        aspect="equal",
        **raster_style(x, y),
    )
    finite = image[np.isfinite(image)]
    below, above = (finite.min() < low, finite.max() > high) if finite.size else (False, False)
    extend = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    place = ax.inset_axes((1.03, 0.0, 0.04, 1.0))
    bar = ax.figure.colorbar(shown, cax=place, extendfrac=0.025, extend=extend[bool(below), bool(above)])
    bar.set_label(unit, fontsize=8.5)
    bar.ax.tick_params(labelsize=8, length=3)
    ax.locator_params(nbins=5)
    _label_axes(ax, title, "beam position X (µm)", "beam position Y (µm)")


def _draw_relief(ax: "Axes", rec: Reconstruction) -> None:
    """Draw the surface from above at its own x, y, lit from the upper left, shadows and jumps left out."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize

    light = np.array([-0.5, 0.5, 0.9])
    shade = np.clip(rec.normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
    rgb = colormaps[HEIGHT_MAP](Normalize(*robust_range(rec.height))(np.nan_to_num(rec.height)))[..., :3]
    rgb = np.clip(rgb * (0.35 + 0.85 * np.nan_to_num(shade))[..., None], 0, 1)
    mean = 0.25 * (rgb[1:, 1:] + rgb[1:, :-1] + rgb[:-1, 1:] + rgb[:-1, :-1])
    cells = np.concatenate([mean, surface_cells(rec)[..., None]], -1)
    is_hole = ~np.isfinite(rec.height)
    corner_x = np.where(is_hole, np.broadcast_to(rec.raster_x, rec.height.shape), rec.x)
    corner_y = np.where(is_hole, np.broadcast_to(rec.raster_y[:, None], rec.height.shape), rec.y)
    ax.pcolormesh(corner_x, corner_y, cells, rasterized=True, linewidth=0, antialiased=False)
    ax.set_aspect("equal")
    ax.set_facecolor("white")
    ax.locator_params(nbins=5)
    _label_axes(ax, "Shaded relief (gaps: not seen by the beam)", "x (µm)", "y (µm)")


def _draw_profile(ax: "Axes", rec: Reconstruction, truth: Truth | None, level: float, along: str) -> None:
    """Draw the heights of one raster line through the apex, at the surface points' own positions.

    Gaps that the beam does not see are dotted.
    """
    row, column = pixel = apex_pixel(rec.height if truth is None else truth.height)

    def draw(height: np.ndarray, label: str, **style: Any) -> None:
        at, z, cut = profile_line(rec, height, along, pixel)
        ax.plot(np.insert(at, cut, np.nan), np.insert(z, cut, np.nan), label=label, **style)
        for k in cut:
            ax.plot(at[k - 1 : k + 1], z[k - 1 : k + 1], **{**style, "lw": 0.8, "ls": ":"})

    height = rec.height - level
    if truth is not None:
        draw(truth.height, "truth", color="#222222", lw=2.2, alpha=0.45)
    if rec.height_std is not None:
        outline_x, outline_z = profile_band(rec, height, along, pixel)
        ax.fill(outline_x, outline_z, color="#4477aa", alpha=0.3, lw=0, label="± 1 std")
    draw(height, "reconstruction", color="#4477aa", lw=1.2)
    at = f"Y = {rec.raster_y[row]:.0f}" if along == "x" else f"X = {rec.raster_x[column]:.0f}"
    _label_axes(ax, f"Profile along {along} through the apex, {at} µm", f"{along} (µm)", "height (µm)")
    ax.grid(color="#dddddd", lw=0.5)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.margins(x=0.01, y=0.08)
    ax.legend(fontsize=8, frameon=False, loc="best")


def _draw_validity(ax: "Axes", rec: Reconstruction) -> None:
    """Draw why pixels are not valid, with the share of each reason."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    style = raster_style(rec.raster_x, rec.raster_y)
    colors = ListedColormap(list(REASON_COLORS))
    low, high = -0.5, len(REASONS) - 0.5
    ax.imshow(rec.reason, cmap=colors, vmin=low, vmax=high, **style)
    share = [float(np.mean(rec.reason == k)) for k in range(len(REASONS))]
    keys = [
        Patch(
            facecolor=REASON_COLORS[k],
            edgecolor="#888888",
            lw=0.5,
            label=f"{textwrap.fill(REASONS[k], 11)}\n{100 * s:.1f} %",
        )
        for k, s in enumerate(share)
        if s > 0
    ]
    ax.locator_params(nbins=5)
    _label_axes(ax, "Validity", "beam position X (µm)", "beam position Y (µm)")
    ax.legend(
        handles=keys,
        fontsize=8,
        frameon=False,
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        labelspacing=1.0,
        handlelength=1.2,
    )


def _draw_numbers(ax: "Axes", rec: Reconstruction, scores: Scores | None) -> None:
    """Write the headline numbers as a table."""
    ax.set_axis_off()
    ax.set_title("Numbers", fontsize=10, loc="left")
    valid = float(np.mean(rec.is_valid & np.isfinite(rec.height)))
    rows = scores.as_table(PANEL_SCORES) if scores is not None else [("valid pixels", f"{100 * valid:.1f}", "%")]
    beam = rec.instrument.beam
    rows = [
        ("method", rec.method, ""),
        ("incidence angle", f"{beam.incidence_deg:g}", "deg"),
        ("detectors", str(len(rec.instrument.detector)), ""),
        *rows,
    ]
    step = 1.0 / 16.0
    for k, (label, value, unit) in enumerate(rows):
        text = {"transform": ax.transAxes, "fontsize": 8.5, "va": "top"}
        ax.text(0.0, 1.0 - k * step, label, color="#444444", **text)
        ax.text(1.03, 1.0 - k * step, value, ha="right", color="#000000", **text)
        ax.text(1.06, 1.0 - k * step, unit.replace("um", "µm").replace("deg", "°"), color="#444444", **text)


class _Sheet:
    """A figure filled row by row; every box is placed in inches, so that maps line up and nothing overlaps."""

    left, right, head, foot = 0.75, 0.9, 0.4, 0.55

    def __init__(self, width: float, heights: list[float]) -> None:
        from matplotlib.figure import Figure

        self.width, self.heights = width, [h + self.head + self.foot for h in heights]
        self.figure = Figure(figsize=(width, sum(self.heights)), facecolor="white")

    def add(self, row: int, column: int, n_columns: int) -> "Axes":
        """Add axes in one of `n_columns` cells of a row, with room for labels and a colour bar."""
        cell, total = self.width / n_columns, sum(self.heights)
        bottom = total - sum(self.heights[: row + 1]) + self.foot
        size = ((cell - self.left - self.right) / self.width, (self.heights[row] - self.head - self.foot) / total)
        return self.figure.add_axes(((column * cell + self.left) / self.width, bottom / total, *size), anchor="NW")

    @classmethod
    def map_height(cls, x: np.ndarray, y: np.ndarray, cell: float) -> float:
        """Return the height [inch] that lets a map fill a cell's width, within sensible limits."""
        ratio = (np.ptp(y) + pitch(y)) / (np.ptp(x) + pitch(x))
        return float(np.clip((cell - cls.left - cls.right) * ratio, 0.6, 6.0))


def _extra_maps(rec: Reconstruction, error: np.ndarray | None) -> list[tuple[np.ndarray, str, str, dict[str, Any]]]:
    """Return (image, title, unit, style) of the maps known for this reconstruction, the most telling first."""
    out: list[tuple[np.ndarray, str, str, dict[str, Any]]] = []
    if error is not None:
        style = {"cmap": ERROR_MAP, "limits": symmetric_range(error)}
        out.append((error, "Height error (ours - true)", "error (µm)", style))
    if rec.height_std is not None:
        out.append((rec.height_std, "Standard deviation of height", "std (µm)", {"cmap": FRACTION_MAP}))
    if rec.residuals is not None:
        out.append((residual_rms(rec.residuals), "Residuals, RMS over detectors", "std", {"cmap": FRACTION_MAP}))
    return [*out, (rec.albedo, "Albedo", "albedo (flat = 1)", {})]


def panel(
    stack: MicrographStack | None, rec: Reconstruction, truth: Truth | None = None, scores: Scores | None = None
) -> "Figure":
    """Draw one panel for a paper: micrographs, height and error maps, relief, profiles, validity, numbers.

    Args:
        stack: the micrographs (any number of detectors), or None to leave them out.
        rec: the reconstruction.
        truth: true heights on the same raster; gives the error map and the truth in the profiles.
        scores: numbers to print, from `evaluate_height`.

    Returns:
        The figure; save it with `save_figure`.

    Raises:
        InputFileError, GuardError: the truth does not fit the reconstruction (see `height_error`).
    """
    error, level = (None, 0.0) if truth is None else height_error(rec, truth)
    x, y = rec.raster_x, rec.raster_y
    n = 0 if stack is None else stack.shape[0]
    per_row = 4 if n == 4 else 3
    top = -(-n // per_row)
    tall = _Sheet.map_height(x, y, WIDTH / 3)
    sheet = _Sheet(WIDTH, [_Sheet.map_height(x, y, WIDTH / per_row)] * top + [tall, max(tall, 2.8), 2.3])
    if stack is not None:
        for k, (name, image) in enumerate(zip(stack.instrument.detector_names, observed_counts(stack), strict=True)):
            ax = sheet.add(k // per_row, k % per_row, per_row)
            _draw_map(ax, stack.x, stack.y, image, f"Micrograph {name}", f"{stack.unit} per pixel")
    levelled = rec.replace(height=rec.height - level)
    _draw_map(sheet.add(top, 0, 3), x, y, levelled.height, "Height", "height (µm)", cmap=HEIGHT_MAP)
    _draw_relief(sheet.add(top, 1, 3), levelled)
    for (row, column), extra in zip(((top, 2), (top + 1, 1)), _extra_maps(rec, error), strict=False):
        _draw_map(sheet.add(row, column, 3), x, y, extra[0], extra[1], extra[2], **extra[3])
    _draw_validity(sheet.add(top + 1, 0, 3), rec)
    _draw_numbers(sheet.add(top + 1, 2, 3), rec, scores)
    _draw_profile(sheet.add(top + 2, 0, 2), rec, truth, level, "x")
    _draw_profile(sheet.add(top + 2, 1, 2), rec, truth, level, "y")
    return sheet.figure


def micrograph_panel(stack: MicrographStack) -> "Figure":
    """Draw the images of one scan: counts and, where known, multiple scattering, masked fraction and shadow.

    Any number of detectors; one column each, one row per kind of map.
    """
    n = stack.shape[0]
    kinds: list[tuple[str, np.ndarray, str, dict[str, Any]]] = [
        ("Micrograph", observed_counts(stack), f"{stack.unit} per pixel", {})
    ]
    multiple = multiple_fraction(stack)
    if multiple is not None:
        style = {"cmap": FRACTION_MAP, "limits": (0.0, robust_range(multiple, 0.5)[1])}
        kinds.append(("Multiple scattering", multiple, "fraction of counts", style))
    if stack.masked is not None:
        style = {"cmap": FRACTION_MAP, "limits": (0.0, 1.0)}
        kinds.append(("Masked", stack.masked, "fraction of aperture", style))
    if stack.shadowed is not None:
        style = {"cmap": FRACTION_MAP, "limits": (0.0, 1.0)}
        kinds.append(("Shadowed", stack.shadowed[None], "fraction", style))
    cell = max(4.0, WIDTH / n) if n > 3 else WIDTH / 3
    sheet = _Sheet(cell * n, [_Sheet.map_height(stack.x, stack.y, cell)] * len(kinds))
    for i, (title, images, unit, style) in enumerate(kinds):
        for k, image in enumerate(images):
            name = "" if len(images) != n or title == "Shadowed" else f" {stack.instrument.detector_names[k]}"
            _draw_map(sheet.add(i, k, n), stack.x, stack.y, image, title + name, unit, **style)
    return sheet.figure


def figure_png(fig: "Figure", *, dpi: float = 150.0) -> bytes:
    """Return the figure as PNG bytes, drawn without a display."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def save_figure(fig: "Figure", path: str | Path, *, dpi: float = 150.0, formats: Sequence[str] = ("png", "pdf", "svg")):
    """Write the figure by suffix, atomically (temporary file, then replace).

    Raises:
        SceneError: the suffix is none of `formats`, or the file cannot be written.
    """
    path = Path(path)
    kind = path.suffix.lower().lstrip(".")
    if kind not in formats:
        raise SceneError(f"{path}: a figure's suffix must be one of {', '.join(formats)}, got {kind or 'none'!r}")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        fig.savefig(part, format=kind, dpi=dpi)
        os.replace(part, path)
    except OSError as e:
        raise SceneError(f"cannot write {path}: {e.strerror or e}; check the folder, rights and space") from None
    finally:
        part.unlink(missing_ok=True)
