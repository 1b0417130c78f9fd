"""Page of micrographs for a first look: each image with its aperture, counts and scale bar, and the plate beside them.

Images are drawn over their beam positions in the sample frame. Each frame has the colour of the aperture in the plan
view.
"""

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.figures import canvas
from helio_jax.figures.image_numbers import ImageNumbers, image_numbers
from helio_jax.figures.instrument_views import color_of, draw_plan
from helio_jax.figures.maps import draw_map
from helio_jax.figures.plot_data import observed_counts, robust_range
from helio_jax.figures.scale_bar import draw_scale_bar
from helio_jax.figures.sheet import Sheet
from helio_jax.figures.summary import KINDS, aims
from helio_jax.figures.wording import UNITS, amount, angle, count_unit, lengths, short, typeset
from helio_jax.micrograph import Micrographs, MicrographStack

MAX_IMAGES = 23
"""Images of one page; of a larger set the first ones are drawn."""
_CELL = 4.3
"""Width of a cell [inch]."""
_NARROW = 0.15
"""A narrower map has no room for a scale bar and for more than two numbers on its short side."""
_LINE = 2.2
"""Height of the curve of a line of positions [inch]."""


def draw_micrographs(micrographs: Micrographs, *, common_scale: bool = False) -> canvas.Figure:
    """Draw all images of a stack or set, and the plan view of the (first) instrument.

    Args:
        micrographs: to draw; of more than 23 images the first ones.
        common_scale: one grey scale for all images, to compare counts; default: one for each, to see the sample.
    """
    images = [(stack, k) for stack in micrographs.stacks for k in range(stack.shape[0])]
    drawn = images[:MAX_IMAGES]
    n_cells, is_one = len(drawn) + 1, len(micrographs.stacks) == 1
    n_columns = min(n_cells, 2 if n_cells <= 4 else 3 if n_cells <= 9 else 4)
    first = micrographs.stacks[0]
    is_line = first.shape[1] == 1
    rows = [_LINE if is_line else Sheet.map_height(first.x, first.y, _CELL)] * -(-n_cells // n_columns)
    square = np.arange(2.0)
    rows[-1] = max(rows[-1], Sheet.map_height(square, square, _CELL))  # the plan view
    heading = _heading(micrographs, len(drawn), len(images))
    page = Sheet(_CELL * n_columns, rows, title_lines=2 if is_one else 3, heading=heading)
    limits = robust_range(np.concatenate([observed_counts(s)[k].ravel() for s, k in drawn])) if common_scale else None
    numbers = {id(stack): image_numbers(stack) for stack in micrographs.stacks}
    for cell, (stack, k) in enumerate(drawn):
        ax = page.add(cell // n_columns, cell % n_columns, n_columns)
        title = _title(stack, k, numbers[id(stack)][k], is_one=is_one)
        image = observed_counts(stack)[k]
        if is_line:
            _draw_line(ax, stack, k, title)
        else:
            low, high = limits or robust_range(image)
            size, unit = count_unit(high, stack.unit)
            scaled = (low / size, high / size)
            per = " per pixel" if stack.unit in UNITS else ""
            draw_map(ax, stack.x, stack.y, image / size, title, unit + per, limits=scaled)
            ratio = np.ptp(ax.get_ylim()) / np.ptp(ax.get_xlim())
            if min(ratio, 1.0 / ratio) < _NARROW:
                ax.locator_params(axis="y" if ratio < 1.0 else "x", nbins=1)
            else:
                draw_scale_bar(ax)
        for spine in ax.spines.values():
            spine.set(color=color_of(k), linewidth=2.5)
    draw_plan(page.add(len(rows) - 1, len(drawn) % n_columns, n_columns), first.instrument)
    return page.figure


def _heading(micrographs: Micrographs, n_drawn: int, n_images: int) -> str:
    first = micrographs.stacks[0]
    name = short(first.name, 30) if len(micrographs.stacks) == 1 else f"{len(micrographs.stacks)} scans"
    size = f"{first.shape[2]} x {first.shape[1]} pixels of {lengths(pitch(first.x), pitch(first.y))}"
    size = size if first.positions is None else f"{len(first.positions)} positions"
    more = f", the first {n_drawn} of {n_images} images" if n_images > n_drawn else ""
    return typeset(f"{name}: {KINDS[first.noise]}, {size}{more}")


def _title(stack: MicrographStack, k: int, found: ImageNumbers, *, is_one: bool) -> str:
    """Write scan, name and place of the aperture, mean counts and SNR, a line each."""
    unit = stack.unit if stack.unit in UNITS else ""
    scan = "" if is_one else f"{short(stack.name, 24)}, sample at {angle(stack.sample_rotation)}\n"
    quality = ""
    if found.snr is not None:
        quality = f" · SNR {found.snr:.3g}" + (" if counted" if stack.noise == "expected" else "")
    elif found.noise is not None:
        quality = f" · noise {amount(found.noise, unit)}"
    aperture = f"{short(stack.instrument.detector_names[k], 16)}: {aims(stack.instrument)[k]}"
    return typeset(f"{scan}{aperture}\nmean {amount(found.mean, unit)}{quality}")


def _draw_line(ax: canvas.Axes, stack: MicrographStack, k: int, title: str) -> None:
    """Draw the counts of a line of positions as a curve."""
    ax.plot(stack.x, observed_counts(stack)[k, 0], ".-", color=color_of(k), lw=1.2)
    ax.grid(color="#dddddd", lw=0.5)
    what = "position number" if stack.positions is not None else "beam position X (µm)"
    canvas.label_axes(ax, title, what, f"{stack.unit} per pixel", (10, 8.5, 8))
