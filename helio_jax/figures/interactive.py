"""Interactive figures of the report: maps, surface, profiles, as plotly JSON. The only module that imports plotly.

Maps are in the beam frame; surface and profiles at the points' own positions with gaps at jumps, as in `panel`. The
page (`report`) sets the colours of text, grid and background. Reads no files and computes no scores.
"""

import html
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.figures.plot_data import (
    REASON_COLORS,
    apex_pixel,
    multiple_fraction,
    observed_counts,
    profile_band,
    profile_line,
    profile_place,
    residual_rms,
    robust_range,
    surface_cells,
    symmetric_range,
)
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import REASONS, Reconstruction
from helio_jax.scores.metrics import Truth, height_error

MAX_MAP_VALUES = 1_300_000
"""Values of all maps together; larger maps are thinned (keeps the page under 15 MB with plotly.js)."""
MAX_SURFACE_POINTS = 24_000
"""Points of the 3-D surface; a larger raster is thinned."""


@dataclass(frozen=True)
class Group:
    """One section of the report: title, note, and figures (plotly's `data` and `layout`)."""

    title: str
    note: str
    figures: list[dict[str, Any]]


def plotly_script() -> str:
    """Return plotly.js, safe to put between script tags."""
    from plotly.offline import get_plotlyjs

    return get_plotlyjs().replace("</script", "<\\/script")


def figure_json(figure: Mapping[str, Any]) -> str:
    """Return a figure as JSON, arrays as base64 (plotly's typed arrays)."""
    import plotly.graph_objects as go

    return str(go.Figure(data=figure["data"], layout=figure["layout"]).to_json(validate=False))


def _stack_groups(stack: MicrographStack, step: int) -> list[Group]:
    names, unit = stack.instrument.detector_names, html.escape(stack.unit)
    images = zip(names, observed_counts(stack), strict=True)
    maps = [_map(stack.x, stack.y, image, step, name, unit, "Greys_r") for name, image in images]
    groups = [Group("Micrographs", "Hover for position and counts; drag to zoom.", maps)]
    multiple = multiple_fraction(stack)
    if multiple is not None:
        pairs = zip(names, multiple, strict=True)
        maps = [_map(stack.x, stack.y, m, step, name, "of counts", "Magma") for name, m in pairs]
        groups.append(Group("Multiple scattering", "Fraction of counts scattered more than once.", maps))
    return groups


def report_groups(stack: MicrographStack | None, rec: Reconstruction, truth: Truth | None) -> list[Group]:
    """Make all interactive figures of a report, in reading order.

    Raises:
        InputFileError, GuardError: the truth does not fit the reconstruction (see `height_error`).
    """
    error, level = (None, 0.0) if truth is None else height_error(rec, truth)
    n_values = 6 * rec.height.size + (0 if stack is None else 2 * stack.counts.size)
    step = max(1, int(np.ceil(np.sqrt(n_values / MAX_MAP_VALUES))))
    groups = [] if stack is None else _stack_groups(stack, step)
    x, y, height = rec.raster_x, rec.raster_y, rec.height - level
    maps = [_map(x, y, height, step, "height", "um")]
    if error is not None:
        maps.append(_map(x, y, error, step, "error: reconstructed - true", "um", "RdBu_r", symmetric_range(error)))
    if rec.height_std is not None:
        maps.append(_map(x, y, rec.height_std, step, "standard deviation", "um", "Magma"))
    groups.append(Group("Height", "In the beam frame: one pixel per beam position.", maps))
    surface = _surface(rec.replace(height=height))
    groups.append(Group("Surface", "True to scale; drag to rotate; gaps are not seen by the beam.", [surface]))
    profiles = [_profile(rec, truth, level, along) for along in ("x", "y")]
    groups.append(Group("Profiles", "Through the apex, at the surface points' own positions.", profiles))
    maps = [_validity(rec, step)]
    if rec.residuals is not None:
        maps.append(_map(x, y, residual_rms(rec.residuals), step, "residuals (RMS)", "std", "Magma"))
    maps.append(_map(x, y, rec.albedo, step, "albedo", "(flat = 1)", "Greys_r"))
    groups.append(
        Group("Validity and residuals", "Why pixels are not valid; (data - model) / standard deviation.", maps)
    )
    if step > 1:
        thinned = f" Maps are thinned: 1 of {step} x {step} pixels; the data file holds all."
        groups = [
            Group(g.title, g.note + thinned, g.figures) if g.title not in ("Surface", "Profiles") else g for g in groups
        ]
    return groups


def _compact(image: np.ndarray) -> np.ndarray:
    """Convert an image to the smallest exact type: whole numbers below 65536 to uint16, others to float32."""
    if np.all(np.isfinite(image)) and np.all(image == np.round(image)) and image.min() >= 0 and image.max() < 65536:
        return image.astype(np.uint16)
    return image.astype(np.float32)


def _layout(title: str, **more: Any) -> dict[str, Any]:
    """Return the layout that all figures share; the page sets the colours of text and lines."""
    return {
        "template": "none",
        "title": {"text": html.escape(title), "font": {"size": 14}, "x": 0.02},
        "margin": {"l": 75, "r": 10, "t": 40, "b": 45},
        **more,
    }


def _map(
    x: np.ndarray,
    y: np.ndarray,
    image: np.ndarray,
    step: int,
    title: str,
    unit: str,
    colors: str = "Viridis",
    limits: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Draw one image over its beam positions; missing pixels stay empty."""
    low, high = limits or robust_range(image)
    scale = {"Greys_r": [[0, "#000000"], [1, "#ffffff"]]}.get(colors, colors)
    unit = unit.replace("um", "µm")
    trace = {
        "type": "heatmap",
        "x": np.round(x[::step], 2),
        "y": np.round(y[::step], 2),
        "z": _compact(image[::step, ::step]),
        "zmin": low,
        "zmax": high,
        "colorscale": scale,
        "hoverongaps": False,
        "hovertemplate": f"X %{{x:.1f}} µm<br>Y %{{y:.1f}} µm<br><b>%{{z:.4~g}}</b> {unit}<extra></extra>",
        "colorbar": {"title": {"text": unit, "side": "right"}, "thickness": 12, "outlinewidth": 0},
    }
    axes = {
        "xaxis": {"title": {"text": "beam position X (µm)"}},
        "yaxis": {"title": {"text": "beam position Y (µm)", "standoff": 6}, "scaleanchor": "x"},
    }
    axes = {name: {**axis, "constrain": "domain", "showgrid": False} for name, axis in axes.items()}
    return {"data": [trace], "layout": _layout(title, **axes)}


def _validity(rec: Reconstruction, step: int) -> dict[str, Any]:
    """Draw the map of reasons, one colour each, named in the colour bar."""
    n = len(REASONS)
    figure = _map(rec.raster_x, rec.raster_y, rec.reason.astype(float), step, "validity", "")
    trace = figure["data"][0]
    edges = [[(k + side) / n, color] for k, color in enumerate(REASON_COLORS) for side in (0, 1)]
    share = [100 * float(np.mean(rec.reason == k)) for k in range(n)]
    trace |= {"zmin": -0.5, "zmax": n - 0.5, "colorscale": edges}
    names = [
        textwrap.fill(f"{name}: {s:.1f} %", 14).replace("\n", "<br>") for name, s in zip(REASONS, share, strict=True)
    ]
    trace["colorbar"] = {"tickvals": list(range(n)), "ticktext": names, "thickness": 12, "outlinewidth": 0}
    trace["hovertemplate"] = "X %{x:.1f} µm<br>Y %{y:.1f} µm<br>reason %{z}<extra></extra>"
    return figure


def _surface(rec: Reconstruction) -> dict[str, Any]:
    """Draw the surface as triangles at the points' own positions; a thinned cell with a gap in it is skipped."""
    step = max(1, int(np.ceil(np.sqrt(rec.height.size / MAX_SURFACE_POINTS))))
    rows, columns = (np.arange(0, n, step) for n in rec.height.shape)
    corner = (rows[:, None], columns[None, :])
    number = np.arange(rows.size * columns.size).reshape(rows.size, columns.size)
    pieces = surface_cells(rec)[: rows[-1], : columns[-1]]
    whole = pieces.reshape(rows.size - 1, step, columns.size - 1, step).all((1, 3))
    a, b, c, d = (
        number[i, j][whole]
        for i, j in (
            (slice(None, -1), slice(None, -1)),
            (slice(None, -1), slice(1, None)),
            (slice(1, None), slice(1, None)),
            (slice(1, None), slice(None, -1)),
        )
    )
    used, faces = np.unique(np.stack([[a, a], [b, c], [c, d]]).reshape(3, -1), return_inverse=True)
    faces = faces.reshape(3, -1).astype(np.int32)
    points = [v[corner].ravel()[used].astype(np.float32) for v in (rec.x, rec.y, rec.height)]
    trace = {
        "type": "mesh3d",
        **dict(zip("xyz", points, strict=True)),
        **dict(zip("ijk", faces, strict=True)),
        "intensity": points[2],
        "colorscale": "Viridis",
        "lighting": {"ambient": 0.55, "diffuse": 0.7, "specular": 0.1, "roughness": 0.9},
        "lightposition": {"x": -20000, "y": 20000, "z": 30000},
        "hovertemplate": "x %{x:.1f} µm<br>y %{y:.1f} µm<br><b>z %{z:.1f} µm</b><extra></extra>",
        "colorbar": {"title": {"text": "µm", "side": "right"}, "thickness": 12, "outlinewidth": 0},
    }
    axis = {"backgroundcolor": "rgba(0,0,0,0)", "gridcolor": "#999999", "zeroline": False}
    scene = {f"{v}axis": {**axis, "title": {"text": f"{v} (µm)"}} for v in "xyz"}
    scene["zaxis"]["nticks"] = 4
    scene |= {
        "aspectmode": "data",
        "camera": {"eye": {"x": -1.2, "y": -1.45, "z": 1.0}, "center": {"x": 0, "y": 0, "z": -0.2}},
    }
    return {"data": [trace], "layout": _layout("", scene=scene)}


def _profile(rec: Reconstruction, truth: Truth | None, level: float, along: str) -> dict[str, Any]:
    """Draw the heights along one raster line through the apex: truth, reconstruction and its error band."""
    pixel = apex_pixel(rec.height if truth is None else truth.height)
    height = rec.height - level

    def line(height: np.ndarray, name: str, color: str, width: float) -> dict[str, Any]:
        at, z, cut = profile_line(rec, height, along, pixel)
        at, z = (np.round(np.insert(v, cut, np.nan), 2).astype(np.float32) for v in (at, z))
        style = {"type": "scatter", "mode": "lines", "line": {"color": color, "width": width}}
        hover = f"{along} %{{x:.1f}} µm<br><b>%{{y:.1f}} µm</b><extra>{name}</extra>"
        return {**style, "x": at, "y": z, "name": name, "hovertemplate": hover}

    traces = [] if truth is None else [line(truth.height, "truth", "#999999", 4.0)]
    if rec.height_std is not None:
        band = dict(zip("xy", (v.astype(np.float32) for v in profile_band(rec, height, along, pixel)), strict=True))
        style = {"type": "scatter", "mode": "lines", "fill": "toself", "fillcolor": "rgba(68,119,170,0.35)"}
        traces.append({**style, **band, "line": {"width": 0}, "name": "± 1 std", "hoverinfo": "skip"})
    traces.append(line(height, "reconstruction", "#4b8fd0", 1.8))
    axes = {"xaxis": {"title": {"text": f"{along} (µm)"}}, "yaxis": {"title": {"text": "height (µm)"}}}
    legend = {"x": 0.01, "y": 0.99, "bgcolor": "rgba(0,0,0,0)"}
    return {
        "data": traces,
        "layout": _layout(f"along {along}, {profile_place(rec, along, pixel)}", **axes, legend=legend),
    }
