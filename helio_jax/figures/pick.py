"""Window to pick control points: the scans side by side, one click per point and scan.

Left click: place or move the current point in that scan. n, p: next, previous point. d: delete the current point in
the scan under the mouse. Wheel: zoom about the mouse. Closing the window ends the picking.
"""

from collections.abc import Callable
from typing import Any

from helio_jax.figures.canvas import COUNT_MAP, check_display, draw_image, new_figure, open_window
from helio_jax.micrograph import MicrographSet

Picks = dict[str, dict[str, tuple[float, float]]]
_ZOOM = 1.25
_COLOR, _CURRENT = "#33bbee", "#ee3377"


class Picker:
    """The picks, and the actions of clicks and keys on them; independent of the window."""

    def __init__(self, views: list[str], picks: Picks) -> None:
        """Start from given picks."""
        self.picks: Picks = {view: dict(picks.get(view, {})) for view in views}
        names = {point for named in self.picks.values() for point in named}
        self.points = sorted(names) or ["P1"]
        self.current = self.points[0]

    def put(self, view: str, x: float, y: float) -> None:
        """Place the current point in a view [um]."""
        self.picks[view][self.current] = (x, y)

    def delete(self, view: str) -> None:
        """Remove the current point from a view."""
        self.picks[view].pop(self.current, None)

    def step(self, by: int) -> None:
        """Go to the next or previous point; beyond the last one a new point begins."""
        at = self.points.index(self.current) + by
        if at >= len(self.points):
            number = len(self.points) + 1
            while f"P{number}" in self.points:
                number += 1
            self.points.append(f"P{number}")
        self.current = self.points[max(at, 0)]


def pick_points(scans: MicrographSet, picks: Picks, save: Callable[[Picks], None]) -> Picks:
    """Open a window, let the user click, and return the picks; `save` is called after every change.

    Raises:
        MissingDependencyError: no window can be opened here.
    """
    check_display("picking points", "write the CSV by hand: view,point,x_um,y_um")
    figure = new_figure(4.5 * len(scans.stacks), 5)
    axes = figure.subplots(1, len(scans.stacks), squeeze=False)[0]
    picker = Picker([s.name for s in scans.stacks], picks)
    view_of = {}
    for ax, stack in zip(axes, scans.stacks, strict=True):
        draw_image(ax, stack.x, stack.y, stack.counts[0], COUNT_MAP)
        view_of[ax] = stack.name
    marks: list[Any] = []

    def draw() -> None:
        for mark in marks:
            mark.remove()
        marks.clear()
        for ax, view in view_of.items():
            ax.set_title(view, fontsize=8)
            for point, (x, y) in picker.picks[view].items():
                color = _CURRENT if point == picker.current else _COLOR
                marks.extend(ax.plot(x, y, "+", color=color, ms=12, mew=1.5))
                marks.append(ax.annotate(point, (x, y), (4, 4), textcoords="offset points", color=color, fontsize=8))
        figure.suptitle(f"point {picker.current}: click it in each scan; n/p next/previous, d delete, wheel zoom")
        figure.canvas.draw_idle()

    def changed() -> None:
        save(picker.picks)
        draw()

    def on_click(event: Any) -> None:
        if event.button == 1 and event.inaxes in view_of and not figure.canvas.toolbar.mode:  # type: ignore[union-attr]
            picker.put(view_of[event.inaxes], float(event.xdata), float(event.ydata))
            changed()

    def on_key(event: Any) -> None:
        if event.key == "d" and event.inaxes in view_of:
            picker.delete(view_of[event.inaxes])
            changed()
        elif event.key in ("n", "p"):
            picker.step(1 if event.key == "n" else -1)
            draw()

    def on_wheel(event: Any) -> None:
        if event.inaxes in view_of:
            scale = 1 / _ZOOM if event.button == "up" else _ZOOM
            ax = event.inaxes
            ax.set_xlim([event.xdata + (v - event.xdata) * scale for v in ax.get_xlim()])
            ax.set_ylim([event.ydata + (v - event.ydata) * scale for v in ax.get_ylim()])
            draw()

    for name, handler in (("button_press", on_click), ("key_press", on_key), ("scroll", on_wheel)):
        figure.canvas.mpl_connect(f"{name}_event", handler)  # type: ignore[call-overload,arg-type]
    draw()
    open_window(figure)
    return picker.picks
