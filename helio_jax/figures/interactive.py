"""Interactive figures of the report: maps, surface, profiles, as plotly JSON. The only module that imports plotly.

Maps are in the beam frame; the surface at the points' own positions with gaps at jumps, profiles in the sample frame,
as in `panel`. The page (`report`) sets the colours of text, grid and background. Reads no files and computes no scores.
"""

import html
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.figures import canvas
from helio_jax.figures.plot_data import (
    DETECTOR_COLORS,
    REASON_COLORS,
    Profile,
    highest_valid,
    multiple_fraction,
    observed_counts,
    robust_range,
    surface_cells,
    symmetric_range,
)
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.validity import REASONS

MAX_HEIGHT_VALUES = 130_000
"""Values of the height map; a larger one is thinned."""
MAX_MAP_VALUES = 170_000
"""Values of all other maps together; larger maps are thinned (keeps the page under 8 MB with plotly.js)."""
MAX_SURFACE_POINTS = 16_000
"""Points of the 3-D surface; a larger raster is thinned."""
MAX_CONTOUR_POINTS = 20_000
"""Points of all contour lines; those of a rougher surface are not drawn."""
_ACCENT, _TOP = "#4b8fd0", "#ee3377"


@dataclass(frozen=True)
class Picture:
    """One figure of the report.

    Attributes:
        figure: plotly's `data` and `layout`.
        alt: what it shows, for those who cannot see it.
        kind: "plot", "half" (lines) or "wide": its size on the page.
    """

    figure: dict[str, Any]
    alt: str
    kind: str = "plot"


def plotly_script() -> str:
    """Return plotly.js, safe to put between script tags."""
    from plotly.offline import get_plotlyjs

    return get_plotlyjs().replace("</script", "<\\/script")


def figure_json(figure: Mapping[str, Any]) -> str:
    """Return a figure as JSON, arrays as base64 (plotly's typed arrays)."""
    import plotly.graph_objects as go

    return str(go.Figure(data=figure["data"], layout=figure["layout"]).to_json(validate=False))


def thinning_of(n_values: int, most: int) -> int:
    """Return the smallest step at which every step-th row and column leave at most `most` of `n_values` values."""
    return max(1, int(np.ceil(np.sqrt(n_values / most))))


def micrograph_maps(stack: MicrographStack, step: int) -> list[Picture]:
    """Draw the micrographs."""
    images = zip(stack.instrument.detector_names, observed_counts(stack), strict=True)
    return [
        image_map(stack.x, stack.y, image, f"micrograph {n}", stack.unit, "Greys_r", step=step) for n, image in images
    ]


def multiple_maps(stack: MicrographStack, step: int) -> list[Picture]:
    """Draw the fraction of counts that scattered more than once; nothing where orders are unknown."""
    found = multiple_fraction(stack)
    pairs = [] if found is None else zip(stack.instrument.detector_names, found, strict=True)
    return [image_map(stack.x, stack.y, m, f"multiple, {n}", "of counts", "Magma", step=step) for n, m in pairs]


def height_map(rec: Reconstruction) -> tuple[Picture, float | None]:
    """Draw the heights with contours, invalid ones grey; return the distance of the contours [um], None: none."""
    step = thinning_of(rec.height.size, MAX_HEIGHT_VALUES)
    x, y = rec.raster_x[::step], rec.raster_y[::step]
    known = np.where(rec.is_valid, rec.height, np.nan)
    limits = robust_range(known if rec.is_valid.any() else rec.height)
    picture = image_map(rec.raster_x, rec.raster_y, rec.height, "height", "um", limits=limits, step=step)
    figure, apart = picture.figure, None
    grey = [[0.0, "rgba(160,160,160,0)"], [1.0, "rgba(160,160,160,0.75)"]]
    cover = {"type": "heatmap", "x": np.round(x, 2), "y": np.round(y, 2), "hoverinfo": "skip", "showscale": False}
    invalid = (~rec.is_valid[::step, ::step]).astype(np.uint8)
    figure["data"].append({**cover, "z": invalid, "zmin": 0, "zmax": 1, "colorscale": grey})
    coarse = slice(None, None, thinning_of(rec.height.size, 20_000))
    shown = known[coarse, coarse]
    if min(shown.shape) > 1 and np.unique(shown[np.isfinite(shown)]).size > 1:
        apart, lines = canvas.contour_lines(rec.raster_x[coarse], rec.raster_y[coarse], shown)
        if 0 < sum(map(len, lines)) <= MAX_CONTOUR_POINTS:
            points = np.concatenate([part for line in lines for part in (line, [[np.nan, np.nan]])]).astype(np.float32)
            style = {"color": "rgba(255,255,255,0.75)", "width": 1}
            line = {"type": "scatter", "mode": "lines", "line": style, "hoverinfo": "skip", "showlegend": False}
            figure["data"].append({**line, "x": points[:, 0], "y": points[:, 1]})
        else:
            apart = None
    alt = picture.alt
    if (top := highest_valid(rec)) is not None:
        place = rec.raster_x[top[1]], rec.raster_y[top[0]]
        mark = {"symbol": "cross-thin", "size": 13, "line": {"color": _TOP, "width": 3}}
        shape = {"type": "scatter", "mode": "markers", "marker": mark, "hoverinfo": "skip", "showlegend": False}
        figure["data"].append({**shape, "x": [float(place[0])], "y": [float(place[1])]})
        alt += f"; highest valid point at X = {place[0]:.0f} um, Y = {place[1]:.0f} um"
    return Picture(figure, alt), apart


def image_map(
    x: np.ndarray,
    y: np.ndarray,
    image: np.ndarray,
    title: str,
    unit: str,
    colors: str = "Viridis",
    limits: tuple[float, float] | None = None,
    step: int = 1,
) -> Picture:
    """Draw one image [y, x] over its beam positions, every `step`-th pixel; missing pixels stay empty."""
    low, high = limits or robust_range(image)
    scale = {"Greys_r": [[0, "#000000"], [1, "#ffffff"]]}.get(colors, colors)
    shown = html.escape(unit.replace("um", "µm"))
    trace = {
        "type": "heatmap",
        "x": np.round(x[::step], 2),
        "y": np.round(y[::step], 2),
        "z": _compact(image[::step, ::step]),
        "zmin": low,
        "zmax": high,
        "colorscale": scale,
        "hoverongaps": False,
        "hovertemplate": f"X %{{x:.1f}} µm<br>Y %{{y:.1f}} µm<br><b>%{{z:.5~g}}</b> {shown}<extra></extra>",
        "colorbar": {"title": {"text": shown, "side": "right"}, "thickness": 12, "outlinewidth": 0},
    }
    axes = {
        "xaxis": {"title": {"text": "beam position X (µm)"}},
        "yaxis": {"title": {"text": "beam position Y (µm)", "standoff": 6}, "scaleanchor": "x"},
    }
    axes = {name: {**axis, "constrain": "domain", "showgrid": False} for name, axis in axes.items()}
    alt = f"map of {title}: {image.shape[1]} x {image.shape[0]} pixels, colours from {low:.4g} to {high:.4g} {unit}"
    return Picture({"data": [trace], "layout": _layout(title, **axes)}, alt)


def error_map(rec: Reconstruction, error: np.ndarray, step: int) -> Picture:
    """Draw the difference from the truth [y, x], um."""
    style = {"colors": "RdBu_r", "limits": symmetric_range(error), "step": step}
    return image_map(rec.raster_x, rec.raster_y, error, "error: reconstructed - true", "um", **style)


def residual_maps(rec: Reconstruction, residuals: np.ndarray, step: int) -> list[Picture]:
    """Draw the residuals of each detector [detector, y, x], in standard deviations."""
    style = {"colors": "RdBu_r", "limits": (-5.0, 5.0), "step": step}
    pairs = zip(rec.instrument.detector_names, residuals, strict=True)
    return [image_map(rec.raster_x, rec.raster_y, image, f"residuals {name}", "s.d.", **style) for name, image in pairs]


def validity_map(rec: Reconstruction, step: int) -> Picture:
    """Draw the map of reasons, one colour each, named in the colour bar."""
    figure = image_map(rec.raster_x, rec.raster_y, rec.reason, "validity", "", step=step).figure
    shown, there = rec.reason[::step, ::step], np.unique(rec.reason)
    names = [f"{REASONS[k]}: {100 * np.mean(rec.reason == k):.1f} %" for k in there]
    ticks = [textwrap.fill(name, 14).replace("\n", "<br>") for name in names]
    edges = [[(k + side) / there.size, REASON_COLORS[reason]] for k, reason in enumerate(there) for side in (0, 1)]
    figure["data"][0] |= {
        "z": np.searchsorted(there, shown).astype(np.uint8),
        "text": np.array(REASONS)[shown].tolist(),
        "zmin": -0.5,
        "zmax": there.size - 0.5,
        "colorscale": edges,
        "colorbar": {"tickvals": list(range(there.size)), "ticktext": ticks, "thickness": 12, "outlinewidth": 0},
        "hovertemplate": "X %{x:.1f} µm<br>Y %{y:.1f} µm<br><b>%{text}</b><extra></extra>",
    }
    return Picture(figure, "map of validity: " + ", ".join(names))


def surface(rec: Reconstruction) -> Picture:
    """Draw the surface as triangles at the points' own positions; a thinned cell with a gap in it is skipped."""
    step = thinning_of(rec.height.size, MAX_SURFACE_POINTS)
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
    faces = faces.reshape(3, -1).astype(np.uint16)
    points = [v[corner].ravel()[used].astype(np.float32) for v in (rec.x, rec.y, rec.height)]
    trace = {
        "type": "mesh3d",
        **dict(zip("xyz", points, strict=True)),
        **dict(zip("ijk", faces, strict=True)),
        "intensity": points[2],
        "colorscale": "Viridis",
        "lighting": {"ambient": 0.55, "diffuse": 0.7, "specular": 0.1, "roughness": 0.9},
        "lightposition": {"x": -20000, "y": 20000, "z": 30000},
        "hovertemplate": "x %{x:.1f} µm<br>y %{y:.1f} µm<br><b>z %{z:.5~g} µm</b><extra></extra>",
        "colorbar": {"title": {"text": "µm", "side": "right"}, "thickness": 12, "outlinewidth": 0},
    }
    axis = {"backgroundcolor": "rgba(0,0,0,0)", "gridcolor": "#999999", "zeroline": False}
    scene = {f"{v}axis": {**axis, "title": {"text": f"{v} (µm)"}} for v in "xyz"}
    scene["zaxis"]["nticks"] = 4
    scene |= {
        "aspectmode": "data",
        "camera": {"eye": {"x": -1.2, "y": -1.45, "z": 1.0}, "center": {"x": 0, "y": 0, "z": -0.2}},
    }
    alt = "the reconstructed surface in three dimensions, true to scale"
    return Picture({"data": [trace], "layout": _layout("", scene=scene)}, alt, "wide")


def profile_plot(cut: Profile) -> Picture:
    """Draw the heights along a line of the sample frame, with the band of one standard deviation."""
    along = cut.along

    def line(z: np.ndarray, name: str, color: str, width: float) -> dict[str, Any]:
        hover = f"{along} %{{x:.1f}} µm<br><b>%{{y:.5~g}} µm</b><extra>{name}</extra>"
        style = {"mode": "lines", "line": {"color": color, "width": width}, "hovertemplate": hover}
        return {"type": "scatter", "x": at, "y": z.astype(np.float32), "name": name, **style}

    at = cut.at.astype(np.float32)
    traces = [] if cut.truth is None else [line(cut.truth, "truth", "#999999", 4.0)]
    if cut.height_std is not None:
        edge = {"type": "scatter", "mode": "lines", "line": {"width": 0}, "hoverinfo": "skip"}
        for run in _runs(np.isfinite(cut.height) & np.isfinite(cut.height_std)):
            low, high = (cut.height[run] + s * cut.height_std[run] for s in (-1, 1))
            outline = np.concatenate([at[run], at[run][::-1]]), np.concatenate([low, high[::-1]]).astype(np.float32)
            fill = {"fill": "toself", "fillcolor": "rgba(68,119,170,0.35)", "name": "± 1 s.d.", "legendgroup": "band"}
            is_first = all(t["name"] != "± 1 s.d." for t in traces)
            traces.append({**edge, **fill, "x": outline[0], "y": outline[1], "showlegend": is_first})
    traces.append(line(cut.height, "reconstruction", _ACCENT, 1.8))
    layout = _lines_layout(f"along {along}, {cut.place}", f"{along} (µm), sample frame", "height (µm)")
    low, high = np.nanmin(cut.height), np.nanmax(cut.height)
    alt = (
        f"profile along {along} at {cut.place} through the highest valid point: heights from {low:.4g} to {high:.4g} um"
    )
    return Picture({"data": traces, "layout": layout}, alt, "half")


def convergence_plot(changes: Sequence[float], tolerance: float | None) -> Picture:
    """Draw the change of the heights in every iteration [um], and the limit below which a fit has converged."""
    number = list(range(1, len(changes) + 1))
    hover = "iteration %{x}<br><b>%{y:.3~g} µm</b><extra></extra>"
    line = {"type": "scatter", "mode": "lines+markers", "line": {"color": _ACCENT}, "hovertemplate": hover}
    traces: list[dict[str, Any]] = [{**line, "x": number, "y": list(changes), "name": "change"}]
    if tolerance is not None:
        style = {"color": "#999999", "dash": "dash"}
        ends = [0.5, len(changes) + 0.5]
        traces.append(
            {"type": "scatter", "mode": "lines", "line": style, "x": ends, "y": [tolerance] * 2, "name": "limit"}
        )
    layout = _lines_layout("convergence of the fit", "iteration", "RMS change of the heights (µm)")
    layout["xaxis"]["dtick"] = max(1, len(changes) // 8)
    layout["yaxis"]["type"] = "log"
    said = ", ".join(f"{change:.3g}" for change in changes)
    return Picture({"data": traces, "layout": layout}, f"changes of the heights by iteration: {said} um", "half")


def bar_plot(title: str, names: Sequence[str], values: Sequence[float], unit: str) -> Picture:
    """Draw one bar for each name, horizontally."""
    shown = [html.escape(name) for name in names]
    hover = "%{y}<br><b>%{x:.3~g}</b><extra></extra>"
    bars = {"type": "bar", "orientation": "h", "x": list(values), "y": shown, "hovertemplate": hover}
    layout = _lines_layout(title, unit.replace("um", "µm"), "")
    layout["margin"]["l"] = 150
    layout["yaxis"]["autorange"] = "reversed"
    alt = f"{title}: " + ", ".join(f"{name} {value:.3g} {unit}" for name, value in zip(names, values, strict=True))
    return Picture({"data": [{**bars, "marker": {"color": DETECTOR_COLORS[0]}}], "layout": layout}, alt, "half")


def _runs(is_known: np.ndarray) -> list[slice]:
    """Return the stretches of a line that are True."""
    edge = np.flatnonzero(np.diff(np.concatenate([[0], is_known.astype(int), [0]])))
    return [slice(int(a), int(b)) for a, b in edge.reshape(-1, 2)]


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


def _lines_layout(title: str, x: str, y: str) -> dict[str, Any]:
    """Return the layout of curves."""
    axes = {"xaxis": {"title": {"text": x}}, "yaxis": {"title": {"text": y}}}
    legend = {"orientation": "h", "x": 0, "y": -0.22, "yanchor": "top", "bgcolor": "rgba(0,0,0,0)"}
    layout = _layout(title, **axes, legend=legend)
    return layout | {"margin": {"l": 75, "r": 10, "t": 40, "b": 90}}
