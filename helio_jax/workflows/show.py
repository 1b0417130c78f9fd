"""Pictures of whatever the program reads: micrographs, height maps, instruments, scenes (before any tracing).

The functions behind `hx.show`, `stack.plot()`, `rec.plot()`, `scene.plot()` and `helio show`.
"""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.figures import canvas
from helio_jax.figures.height_page import draw_height_map, draw_reconstruction
from helio_jax.figures.instrument_page import draw_instrument
from helio_jax.figures.micrograph_page import draw_micrographs
from helio_jax.figures.scene_page import SampleSurface, draw_scene
from helio_jax.formats.safe import check_outputs
from helio_jax.heightmap import HeightMap
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.scene import Scene
from helio_jax.scene.views import View
from helio_jax.trace.intersect import MISS, Intersector
from helio_jax.trace.run import first_hits
from helio_jax.workflows.any_file import read_any
from helio_jax.workflows.shipped import locate

_GRID = 101
"""Points per side of the drawn surface of a sample."""
_AROUND = 0.15
"""Width of the sample that is drawn around the scanned field, in fields."""


def draw(what: Any, *, common_scale: bool = False, view: int = 0) -> canvas.Figure:
    """Draw a record: micrographs, a height map, an instrument, or a scene before any tracing.

    Args:
        what: MicrographStack, MicrographSet, Reconstruction, HeightMap, Instrument or Scene.
        common_scale: micrographs: one grey scale for all images.
        view: scene: which view of the scan, from 0.

    Returns:
        A matplotlib Figure; a notebook shows it.

    Raises:
        SceneError: anything else, or a view that the scan does not have.
        InputFileError: a file of the scene's sample is missing or wrong.
    """
    if isinstance(what, (MicrographStack, MicrographSet)):
        return draw_micrographs(what, common_scale=common_scale)
    if isinstance(what, Reconstruction):
        return draw_reconstruction(what)
    if isinstance(what, HeightMap):
        return draw_height_map(what)
    if isinstance(what, Scene):
        views = what.views()
        if not 0 <= view < len(views):
            raise SceneError(f"view must be 0 to {len(views) - 1}, got {view}")
        return draw_scene(what, views[view].instrument, sample_surface(what, views[view]))
    if isinstance(what, Instrument):
        return draw_instrument(what)
    raise SceneError(
        f"nothing can be drawn of a {type(what).__name__}: give micrographs, a height map, an instrument or a scene"
    )


def show(
    what: Any,
    output: str | os.PathLike | None = None,
    *,
    window: bool = False,
    instrument: str | os.PathLike | None = None,
    common_scale: bool = False,
    view: int = 0,
    overrides: Mapping[str, Any] | None = None,
) -> canvas.Figure:
    """Draw a record or a file; write the picture, open a window, or return the figure for a notebook.

    Example:
        >>> hx.show("sphere_a")
        >>> hx.show(stack, "stack.png")

    Args:
        what: a record (see `draw`), the path of a file of one, or the name of a scene or instrument of `helio scenes`.
        output: picture to write (.png, .pdf, .svg).
        window: open a window, and return when it is closed.
        instrument: file or name of an instrument for a .mat file, which lacks its own.
        common_scale: micrographs: one grey scale for all images.
        view: scene: which view of the scan, from 0.
        overrides: file of a scene or an instrument: values that override it, dotted keys.

    Raises:
        SceneError: nothing can be drawn of it, an unknown name, or the picture cannot be written.
        InputFileError: the file is missing, damaged or of an unknown kind.
        MissingDependencyError: `window` without a display.
    """
    if window:
        canvas.check_display("helio show --window", "write a picture: -o FILE.png")
    if isinstance(what, (str, os.PathLike)):
        path = locate(what)
        if output is not None:
            check_outputs([("file", path)], [("-o", Path(output))])
        what = read_any(path, instrument, overrides)
    figure = draw(what, common_scale=common_scale, view=view)
    if output is not None:
        canvas.save_figure(figure, Path(output))
    if window:
        canvas.open_window(figure)
    return figure


def sample_surface(scene: Scene, view: View) -> SampleSurface:
    """Find the sample as seen from above around the scanned field, and its section along the beam's azimuth.

    Args:
        scene: whose sample is built.
        view: whose distance and rotation are taken.

    Raises:
        InputFileError, SceneError: see `Scene.build_body`, `View.rotated_body`.
    """
    body = view.rotated_body(scene.build_body())
    points = scene.points(np.arange(math.prod(scene.image_shape)))
    (x0, x1), (y0, y1) = ((float(p.min()), float(p.max())) for p in points)
    margin = (_AROUND * max(x1 - x0, y1 - y0)) or 0.5 * view.instrument.working_distance * _AROUND
    x, y = np.linspace(x0 - margin, x1 + margin, _GRID), np.linspace(y0 - margin, y1 + margin, _GRID)
    engine = Intersector(body)
    top = body.max_height
    height = heights_from_above(engine, top, *np.meshgrid(x, y))
    phi = math.radians(view.instrument.beam.azimuth_deg)
    reach = view.instrument.sample_distance + float(np.hypot(x[-1] - x[0], y[-1] - y[0]))
    steps = np.linspace(-1.0, 1.0, 2001) * reach
    center = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    section = heights_from_above(engine, top, center[0] + steps * math.cos(phi), center[1] + steps * math.sin(phi))
    along = steps + center[0] * math.cos(phi) + center[1] * math.sin(phi)
    first = first_hits(engine, view.instrument, *(np.array([c]) for c in center))
    hit = None if first.surface[0] == MISS else tuple(first.point[0].tolist())
    return SampleSurface(x, y, height, (x0, x1, y0, y1), (along, section), hit)


def heights_from_above(engine: Intersector, top: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute the highest point of a body, which ends at `top`, at positions x, y of any shape [um]; NaN beside it."""
    n = x.size
    origins = np.column_stack([x.ravel(), y.ravel(), np.full(n, top + 1.0)])
    down = np.tile([0.0, 0.0, -1.0], (n, 1))
    hits = engine.nearest(origins, down, np.full(n, -1, np.int32))
    return np.where(hits.surface == MISS, np.nan, hits.point[:, 2]).reshape(x.shape)
