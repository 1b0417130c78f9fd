"""Drawings of an instrument: plan view of the plate from above (lab frame), side view along the beam.

Both are true to scale. Azimuths count counter-clockwise from +x, so that an aperture of azimuth 90 deg lies at +y, the
top of the plan view. Conventions: docs/conventions.md.
"""

import math
from typing import Any

import numpy as np

from helio_jax.detector import Aperture, Detector, cone_ellipse
from helio_jax.figures import canvas
from helio_jax.figures.plot_data import DETECTOR_COLORS
from helio_jax.figures.wording import angle, length, short, typeset
from helio_jax.instrument import Instrument

_PLATE, _BEAM, _QUIET = "#e9e9ea", "#111111", "#666666"
_SIZES = (10, 8.5, 8)
_FEW = 6
"""Up to so many detectors, polar angle and azimuth stand on each aperture."""
_MANY = 12
"""With more detectors each aperture has its number in the order of the detectors instead of its name."""
_NAME = 16
"""Letters of a name that are drawn."""
_FARTHEST = math.radians(55.0)
"""Cones at infinity are drawn at most this far from the plate normal."""


def color_of(k: int) -> str:
    """Return the colour of a detector, the same on every page."""
    return DETECTOR_COLORS[k % len(DETECTOR_COLORS)]


def shown_ellipse(detector: Detector, distance: float) -> Aperture | None:
    """Return the ellipse on the plate that stands for a detector; None: a part of the plate's mesh.

    Of a cone at infinity it is the section with the plate, drawn closer in where it lies beyond 55 deg.
    """
    opening = detector.opening(distance)
    if opening is None or isinstance(opening, Aperture):
        return opening
    polar, azimuth = detector.aim(distance) or (0.0, 0.0)
    half = min(opening.half_angle, math.radians(15.0))
    return cone_ellipse(min(polar, _FARTHEST - half), azimuth, half, distance)


def draw_plan(ax: canvas.Axes, instrument: Instrument) -> None:
    """Draw plate, apertures, pinhole, beam and nominal spot as seen from above, in the lab frame [mm]."""
    w, n = instrument.working_distance, len(instrument.detector)
    shown = {k: e for k, d in enumerate(instrument.detector) if (e := shown_ellipse(d, w)) is not None}
    rims = {k: 1e-3 * ellipse.rim(96)[0] for k, ellipse in shown.items()}
    pinhole = 1e-3 * instrument.pinhole_center[:2]
    marks = np.concatenate([*rims.values(), pinhole[None], np.zeros((1, 2))])
    half = _frame(ax, marks)
    for k, rim in rims.items():
        name = short(instrument.detector[k].name, _NAME) if n <= _MANY else f"{k + 1}"
        _draw_aperture(ax, instrument.detector[k], name, w, rim, color_of(k), half, has_angles=n <= _FEW)
    _draw_beam_from_above(ax, instrument, pinhole, half)
    if instrument.plate.kind == "scattering":
        ax.plot(*_outline(instrument).T, color=_QUIET, lw=1.0)
    _draw_axes(ax, half, marks)
    ax.set_facecolor(_PLATE)
    if hidden := [d.name for k, d in enumerate(instrument.detector) if k not in shown]:
        text = f"parts of the plate's mesh, not drawn: {', '.join(hidden)}"
        ax.text(0.5, 0.99, text, transform=ax.transAxes, ha="center", va="top", fontsize=_SIZES[2])
    canvas.label_axes(ax, "Plate from above (lab frame)", "x (mm)", "y (mm)", _SIZES)


def _draw_aperture(
    ax: canvas.Axes,
    detector: Detector,
    name: str,
    distance: float,
    rim: np.ndarray,
    color: str,
    half: float,
    *,
    has_angles: bool,
) -> None:
    """Draw an aperture from its rim [n, 2], mm, with its name and angles on it, or below it where it is small."""
    ax.fill(rim[:, 0], rim[:, 1], facecolor="white", lw=0)
    ax.fill(rim[:, 0], rim[:, 1], facecolor=color, alpha=0.45, lw=0)
    closed = np.vstack([rim, rim[:1]])
    dashes = "--" if detector.at_infinity else "-"
    ax.plot(closed[:, 0], closed[:, 1], color=color, lw=1.6, ls=dashes, gid=detector.name)
    x, y = 0.5 * (rim.min(0) + rim.max(0))
    ax.plot([0.0, x], [0.0, y], color=_QUIET, lw=0.8, ls=":", zorder=0)
    polar, azimuth = detector.aim(distance) or (0.0, 0.0)
    words = f"polar {angle(polar)}\nazimuth {angle(azimuth)}" + "\nat infinity" * bool(detector.at_infinity)
    label = f"{name}\n{typeset(words)}" if has_angles else name
    is_small = has_angles and min(np.ptp(rim, axis=0)) < 0.3 * half
    place = (x, rim[:, 1].min() - 0.02 * half, "top") if is_small else (x, y, "center")
    ax.text(place[0], place[1], label, ha="center", va=place[2], fontsize=_SIZES[2], linespacing=1.25)


def _frame(ax: canvas.Axes, points: np.ndarray) -> float:
    """Set square limits around points [n, 2] with a margin; return half their side [mm]."""
    low, high = points.min(0), points.max(0)
    room = 0.22 * float((high - low).max())  # for the words beside the spot
    low, high = np.minimum(low, -room), np.maximum(high, room)
    center, half = 0.5 * (low + high), 0.63 * float((high - low).max()) or 1.0
    ax.set_xlim(center[0] - half, center[0] + half)
    ax.set_ylim(center[1] - half, center[1] + half)
    ax.set_aspect("equal", anchor="NW")
    ax.locator_params(nbins=6)
    return half


def _draw_beam_from_above(ax: canvas.Axes, instrument: Instrument, pinhole: np.ndarray, half: float) -> None:
    """Draw pinhole, spot and the beam's direction of travel."""
    spot: dict[str, Any] = {"color": _BEAM, "fontsize": _SIZES[2], "textcoords": "offset points"}
    ax.plot(0.0, 0.0, "+", color=_BEAM, ms=9, mew=1.4)
    if np.hypot(*pinhole) < 1e-6 * half:
        ax.plot(*pinhole, "o", color=_BEAM, ms=9, mfc="none", mew=1.2)
        ax.annotate("beam, downwards", (0.0, 0.0), (0, -9), ha="center", va="top", **spot)
        return
    arrow = {"arrowstyle": "-|>", "color": _BEAM, "lw": 1.6, "shrinkA": 0, "shrinkB": 3}
    ax.annotate("", (0.0, 0.0), tuple(pinhole), arrowprops=arrow)
    ax.plot(*pinhole, "o", color=_BEAM, ms=5, mfc="white", mew=1.3)
    across = 1 if abs(pinhole[0]) >= abs(pinhole[1]) else 0  # labels stand beside the beam, not on it
    ax.annotate("pinhole", tuple(pinhole), (0, 7) if across else (9, 0), ha="center" if across else "left", **spot)
    middle, turn = 0.5 * pinhole, math.degrees(math.atan2(-pinhole[1], -pinhole[0]))
    turn = turn if -90.0 < turn <= 90.0 else turn - 180.0
    style = {**spot, "rotation": turn, "rotation_mode": "anchor"}
    ax.annotate("beam", tuple(middle), (0, 0), ha="center", va="bottom", xycoords="data", **style)
    beside = {"ha": "center", "va": "top"} if across else {"ha": "left", "va": "center"}
    ax.annotate("spot", (0.0, 0.0), (0, -7) if across else (9, 0), **beside, **spot)


def _outline(instrument: Instrument) -> np.ndarray:
    """Return the closed outline of a flat scattering plate [n, 2], mm."""
    (x, y), (a, b) = instrument.plate.outline
    if instrument.plate.radius_um is not None:
        s = np.linspace(0.0, 2.0 * np.pi, 181)
        return 1e-3 * np.column_stack([x + a * np.cos(s), y + b * np.sin(s)])
    return 1e-3 * np.array([[x - a, y - b], [x + a, y - b], [x + a, y + b], [x - a, y + b], [x - a, y - b]])


def _draw_axes(ax: canvas.Axes, half: float, marks: np.ndarray) -> None:
    """Draw arrows of +x and +y in the corner that is farthest from everything drawn at `marks` [n, 2]."""
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    corners = [(x, y) for x in (x1 - 0.3 * half, x0 + 0.3 * half) for y in (y0 + 0.3 * half, y1 - 0.3 * half)]
    x, y = max(corners, key=lambda c: np.hypot(*(marks - c).T).min()) - np.array([0.15 * half, 0.15 * half])
    for name, end in (("+x", (x + 0.3 * half, y)), ("+y", (x, y + 0.3 * half))):
        ax.annotate("", end, (x, y), arrowprops={"arrowstyle": "-|>", "color": _QUIET, "shrinkA": 0, "shrinkB": 0})
        style: dict[str, Any] = {"va": "center", "ha": "left"} if name == "+x" else {"va": "bottom", "ha": "center"}
        ax.text(end[0], end[1], name, color=_QUIET, fontsize=_SIZES[2], **style)


def draw_side(
    ax: canvas.Axes,
    instrument: Instrument,
    profile: tuple[np.ndarray, np.ndarray] | None = None,
    center: float = 0.0,
    hit: tuple[float, float] | None = None,
) -> None:
    """Draw plate, beam and substrate in the plane of the beam [mm]; apertures are projected onto it.

    Args:
        ax: axes to draw in.
        instrument: to draw.
        profile: positions along the beam's azimuth and heights of the sample [um], or None: a flat substrate.
        center: position along the azimuth where the beam's axis meets the substrate [um]; 0 without a sample.
        hit: position along the azimuth and height where the beam meets the sample [um]; None: the substrate.
    """
    d, w = instrument.sample_distance, instrument.working_distance
    phi = math.radians(instrument.beam.azimuth_deg)
    along = np.array([math.cos(phi), math.sin(phi)])
    shift = center - float(along @ np.array(instrument.spot_position(0.0)[:2]))
    pinhole = float(along @ instrument.pinhole_center[:2]) + shift
    spans: dict[tuple[float, float], list[int]] = {}
    for k, detector in enumerate(instrument.detector):
        if (ellipse := shown_ellipse(detector, w)) is not None:
            s = ellipse.rim(96)[0] @ along + shift
            spans.setdefault((round(float(s.min()), 3), round(float(s.max()), 3)), []).append(k)
    ends = np.array([pinhole, center, *(s for span in spans for s in span)])
    low, high = ends.min() - 0.15 * d, ends.max() + 0.15 * d
    ax.plot([1e-3 * low, 1e-3 * high], [1e-3 * d] * 2, color="#8a8a8e", lw=3, solid_capstyle="butt", zorder=1)
    for (s0, s1), members in spans.items():
        for j, k in enumerate(members):  # detectors at one place are drawn above one another
            height = 1e-3 * d * (1.0 + 0.018 * j)
            ax.plot([1e-3 * s0, 1e-3 * s1], [height] * 2, color=color_of(k), lw=5, solid_capstyle="butt", zorder=2)
        if len(instrument.detector) > _MANY:
            continue  # the names would cover one another
        names = ",\n".join(short(instrument.detector_names[k], _NAME) for k in members[:3])
        more = f"\n+{len(members) - 3}" if len(members) > 3 else ""
        ax.annotate(
            names + more, (0.5e-3 * (s0 + s1), 1e-3 * d), (0, 6 + 3 * len(members)), textcoords="offset points",
            ha="center", va="bottom", fontsize=_SIZES[2],
        )  # fmt: skip
    _draw_sample(ax, profile, low, high)
    arrow = {"arrowstyle": "-|>", "color": _BEAM, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
    end = 1e-3 * np.array((center, 0.0) if hit is None else hit)
    ax.plot([end[0], 1e-3 * center], [end[1], 0.0], color=_BEAM, lw=1.0, ls=":")
    ax.annotate("", tuple(end), (1e-3 * pinhole, 1e-3 * d), arrowprops=arrow)
    ax.plot(1e-3 * pinhole, 1e-3 * d, "o", color=_BEAM, ms=5, mfc="white", mew=1.3, zorder=3)
    words = f"beam, {instrument.beam.incidence_deg:g}° from the normal"
    middle = (0.5e-3 * (pinhole + center), 0.5e-3 * d)
    ax.annotate(
        words, middle, (8, 0), textcoords="offset points", ha="left", va="center", fontsize=_SIZES[2],
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.8},
    )  # fmt: skip
    measure = {"arrowstyle": "<->", "color": _QUIET, "lw": 0.9, "shrinkA": 0, "shrinkB": 0}
    right = 1e-3 * (high - 0.04 * d)
    ax.annotate("", (right, 0.0), (right, 1e-3 * d), arrowprops=measure)
    aimed = "" if w == d else f"\n(aimed at\n{typeset(length(w))})"
    ax.annotate(
        typeset(length(d)) + aimed, (right, 0.3e-3 * d), (-4, 0), textcoords="offset points", ha="right", va="center",
        fontsize=_SIZES[2], color=_QUIET,
    )  # fmt: skip
    ax.set_xlim(1e-3 * low, 1e-3 * high)
    ax.set_ylim(-1e-3 * max(0.08 * (high - low), 0.14 * d), 1e-3 * (d + 0.17 * (high - low)))
    ax.set_aspect("equal", anchor="NW")
    ax.locator_params(nbins=6)
    turned = f" (azimuth {instrument.beam.azimuth_deg:g}°)" if instrument.beam.azimuth_deg else ""
    axis = "x (mm)" if not instrument.beam.azimuth_deg else "along the beam's azimuth (mm)"
    canvas.label_axes(ax, f"Side view in the plane of the beam{turned}", axis, "height (mm)", _SIZES)


def _draw_sample(ax: canvas.Axes, profile: tuple[np.ndarray, np.ndarray] | None, low: float, high: float) -> None:
    """Draw the sample's section, or a flat substrate between `low` and `high` [um]."""
    at, z = (np.array([low, high]), np.zeros(2)) if profile is None else profile
    bottom = ax.get_ylim()[0] - 1e3
    ax.fill_between(1e-3 * at, 1e-3 * z, bottom, color="#b9b2a3", lw=0, zorder=0)
    ax.plot(1e-3 * at, 1e-3 * z, color="#5d5648", lw=1.2)
