"""Steps that dashes show, in the units and records of the steps that mask bands show (`mask_steps`)."""

import math
from collections.abc import Sequence

import numpy as np

from helio_jax.inverse.band_fit import LEAST_MASK, kind_of
from helio_jax.inverse.dash_lines import Line, find_dashes, find_line
from helio_jax.inverse.edge_place import Images
from helio_jax.inverse.low_steps import LowStep, Scan, fit_step
from helio_jax.inverse.mask_edges import Edge
from helio_jax.inverse.step_records import BandRow, Step
from helio_jax.inverse.wall_signal import Opening

MAX_LINES = 4
"""Lines that are looked for."""
MIN_SHARE = 0.5
"""Least share of its way through the image along which a line shows dashes."""
MAX_BAND = 1.5
"""Longest band of a low step: longer ones are those of `band_fit` [pixels]."""
MAX_BY_GLOW = 1.2
"""Highest step that is known by the glow of its foot alone, plus two standard deviations [pixels]: that of a higher one
reaches the pixels that show the signal of the lower side (`shadow_steps` finds it)."""
_BORDER = 3.0
"""Distance from the border within which a line ends there [pixels]."""
_BESIDE = 2.0
"""Dashes so near to a line are its own [pixels]."""


def find_low_steps(
    images: Images, openings: Sequence[Opening], beam_shift: np.ndarray, names: Sequence[str], is_explained: np.ndarray
) -> list[tuple[Edge, Step, tuple[BandRow, ...]]]:
    """Find the steps through the image whose mask bands are shorter than a pixel, or hidden, and measure them.

    Around the ends of a shorter one the surface joins both sides, and tells their heights; where it ends dashes do not.

    Args:
        images: data.
        openings: of the detectors, from the lower level.
        beam_shift: `Instrument.beam_shift` [2].
        names: of the detectors.
        is_explained: pixels in the bands of steps that are measured [detector, y, x].

    Returns:
        Edge, step, numbered 0, and bands, of each; heights and positions in um.
    """
    middle = images.place.mean((0, 1))
    place = (images.place - middle) / images.side
    signal = images.signal - images.floor[:, None, None]
    dashes = find_dashes(signal, images.variance, images.lit - images.floor, is_explained)
    v = np.stack([o.mean for o in openings]) + beam_shift
    scan, found = Scan(place, signal, images.variance, openings, beam_shift, images.spot / images.side), []
    for _ in range(MAX_LINES):
        ways = find_line(dashes, place, v, beam_shift)
        if not ways:
            break
        low = fit_step(ways, scan) if _share(ways[0], place) >= MIN_SHARE else None
        if low is not None and _is_through(low, place):
            found.append(_records(low, middle, images.side, names, v))
        dashes = dashes.without(_beside(ways[0] if low is None else low.line, place))
    return found


def _way(line: Line, place: np.ndarray) -> tuple[float, float]:
    """Return where a line enters and leaves the image, along it [pixels]."""
    w = (place @ line.along)[np.abs(place @ line.normal - line.offset) < 1.0]
    return (float(w.min()), float(w.max())) if w.size else (line.start, line.end)


def _share(line: Line, place: np.ndarray) -> float:
    """Return along which share of its way through the image a line shows dashes."""
    first, last = _way(line, place)
    return (line.end - line.start) / max(last - first, 1e-9)


def _is_through(low: LowStep, place: np.ndarray) -> bool:
    """Return whether a low step goes through the image, and is one."""
    first, last = _way(low.line, place)
    ends_there = low.line.start < first + _BORDER and low.line.end > last - _BORDER
    longest = max(s.length for s in low.signals)
    is_low = low.height * longest <= MAX_BAND if longest > LEAST_MASK else low.height + 2.0 * low.std <= MAX_BY_GLOW
    return ends_there and is_low


def _beside(line: Line, place: np.ndarray) -> np.ndarray:
    """Mark the pixels beside a line [y, x]."""
    u, w = place @ line.normal - line.offset, place @ line.along
    return (np.abs(u) < _BESIDE) & (w > line.start - _BESIDE) & (w < line.end + _BESIDE)


def _records(
    low: LowStep, middle: np.ndarray, side: float, names: Sequence[str], v: np.ndarray
) -> tuple[Edge, Step, tuple[BandRow, ...]]:
    """Turn a low step into records; lengths in um."""
    line, height = low.line, side * low.height
    std = math.hypot(side * low.std, low.shape_std * height)
    dark = tuple(k for k, s in enumerate(low.signals) if kind_of(s) == "dark")
    lengths = [s.length for s in low.signals]
    if not dark and max(lengths) > LEAST_MASK:
        dark = (int(np.argmax(lengths)),)
    start, end = (middle + side * (line.offset * line.normal + at * line.along) for at in (line.start, line.end))
    edge = Edge(start, end, dark)
    bands = []
    for k in dark:
        to_length = low.signals[k].length * float(np.hypot(*v[k])) / abs(float(v[k] @ edge.normal))
        bands.append(
            BandRow(
                step=0,
                detector=names[k],
                kind="dark",
                length_um=to_length * height,
                length_std_um=to_length * std,
                height_um=height,
                height_std_um=std,
                is_lower_bound=False,
                p_wall=1.0,
                runs_deg=math.degrees(math.atan2(-v[k][1], -v[k][0])),
                note="",
            )
        )
    along, normal = edge.along, edge.normal
    step = Step(
        number=0,
        start=(float(start[0]), float(start[1])),
        end=(float(end[0]), float(end[1])),
        direction_deg=(math.degrees(math.atan2(along[1], along[0])) + 90.0) % 180.0 - 90.0,
        falls_deg=math.degrees(math.atan2(normal[1], normal[0])),
        height_um=height,
        height_std_um=std,
        n_bands=len(bands),
        chi2=0.0,
        is_lower_bound=False,
        p_wall=1.0,
        above=0,
        below=0,
        note="",
    )
    return edge, step, tuple(bands)
