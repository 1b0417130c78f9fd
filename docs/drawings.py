"""Draw the pictures of docs/conventions.md: `python docs/drawings.py`.

Places come from the program's own instrument, so that a drawing and the code cannot disagree.
"""

import math
from pathlib import Path

from helio_jax.instrument import Instrument
from helio_jax.workflows.scene_file import load_instrument

HERE = Path(__file__).resolve().parent
BEAM, DETECTOR, SAMPLE, BODY, PLATE, INK = "#c0392b", "#1f6fb4", "#8d8d8d", "#e4e4e4", "#444444", "#222222"
HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"
  font-family="sans-serif" font-size="15">
<defs><marker id="arrow" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7"
  orient="auto-start-reverse"><path d="M0 1 L10 5 L0 9 z" fill="context-stroke"/></marker></defs>
<rect width="{width}" height="{height}" rx="8" fill="#ffffff"/>
"""
Point = tuple[float, float]


class Drawing:
    """A drawing in micrometres, up is up; `scale` in pixels per um, the point `origin` [um] is at the lower left."""

    def __init__(self, width: int, height: int, scale: float, origin: Point) -> None:
        self.height, self.scale, self.origin = height, scale, origin
        self.parts = [HEAD.format(width=width, height=height)]

    def at(self, p: Point) -> str:
        """Return a point in pixels."""
        return f"{(p[0] - self.origin[0]) * self.scale:.1f} {self.height - (p[1] - self.origin[1]) * self.scale:.1f}"

    def path(self, *points: Point, color: str = INK, width: float = 1.5, fill: str = "none", more: str = "") -> None:
        """Draw a line through points."""
        way = " L".join(map(self.at, points))
        self.parts.append(f'<path d="M{way}" stroke="{color}" stroke-width="{width:g}" fill="{fill}" {more}/>\n')

    def arrow(self, a: Point, b: Point, color: str = INK, width: float = 1.5, both: bool = False) -> None:
        """Draw an arrow, or a dimension with two heads."""
        start = 'marker-start="url(#arrow)"' if both else ""
        self.path(a, b, color=color, width=width, more=f'{start} marker-end="url(#arrow)"')

    def dashed(self, *points: Point, color: str = INK) -> None:
        """Draw a thin dashed line."""
        self.path(*points, color=color, width=1, more='stroke-dasharray="5 4"')

    def arc(self, center: Point, radius: float, start_deg: float, end_deg: float, color: str = INK) -> None:
        """Draw an arc with an arrow at its end; angles counter-clockwise from the right."""
        angles = [math.radians(start_deg + (end_deg - start_deg) * i / 24) for i in range(25)]
        points = [(center[0] + radius * math.cos(a), center[1] + radius * math.sin(a)) for a in angles]
        self.path(*points, color=color, more='marker-end="url(#arrow)"')

    def ellipse(self, center: Point, semi_axes: Point, rotation: float, color: str) -> None:
        """Draw a filled ellipse; rotation of the first axis counter-clockwise [rad]."""
        x, y = self.at(center).split()
        a, b = (s * self.scale for s in semi_axes)
        turn = f'transform="rotate({-math.degrees(rotation):.1f} {x} {y})"'
        shape = f'cx="{x}" cy="{y}" rx="{a:.1f}" ry="{b:.1f}" {turn}'
        self.parts.append(f'<ellipse {shape} fill="{color}" fill-opacity="0.25" stroke="{color}"/>\n')

    def text(self, p: Point, words: str, color: str = INK, anchor: str = "middle") -> None:
        """Write words."""
        x, y = self.at(p).split()
        self.parts.append(f'<text x="{x}" y="{y}" fill="{color}" text-anchor="{anchor}">{words}</text>\n')

    def axes(self, p: Point, names: tuple[str, str], length: float) -> None:
        """Draw two axes."""
        right, up = (p[0] + length, p[1]), (p[0], p[1] + length)
        self.arrow(p, right)
        self.arrow(p, up)
        gap = 16 / self.scale
        self.text((right[0] + gap, right[1] - 5 / self.scale), names[0])
        self.text((up[0], up[1] + 0.6 * gap), names[1])

    def svg(self) -> str:
        """Return the file."""
        return "".join([*self.parts, "</svg>\n"])


def side(instrument: Instrument) -> str:
    """Section in the plane of the beam: lab frame, sample frame, angles, distances."""
    w, d, t = instrument.working_distance, instrument.sample_distance, math.radians(instrument.beam.incidence_deg)
    pinhole, hole = -w * math.tan(t), instrument.apertures()[0]
    low, high = hole.center[0] - hole.semi_axes[0], hole.center[0] + hole.semi_axes[0]
    polar = math.atan2(hole.center[0], w)
    ground, hit = w - d, (d - w) * math.tan(t)
    out = Drawing(860, 500, 0.078, (-5400.0, -1450.0))
    for a, b in ((-4300.0, pinhole - 60), (pinhole + 60, low), (high, 3900.0)):
        out.path((a, w), (b, w), color=PLATE, width=5)
    below = ground - 250.0
    out.path((-4300.0, ground), (3900.0, ground), (3900.0, below), (-4300.0, below), color=SAMPLE, fill=BODY)
    out.dashed((0.0, ground), (0.0, w))
    out.path((0.0, 0.0), (low, w), (high, w), (0.0, 0.0), color=DETECTOR, width=1, fill="#1f6fb422")
    out.dashed((0.0, 0.0), (hole.center[0], w), color=DETECTOR)
    out.arrow((pinhole - 0.2 * w * math.tan(t), 1.2 * w), (hit, ground), color=BEAM, width=2.5)
    out.arc((0.0, 0.0), 0.42 * w, 90.0, 90.0 + math.degrees(t), color=BEAM)
    out.text((-650.0, 0.45 * w), "t", BEAM)
    out.arc((0.0, 0.0), 0.55 * w, 90.0, 90.0 - math.degrees(polar), color=DETECTOR)
    out.text((1550.0, 0.45 * w), "polar angle", DETECTOR, "start")
    out.path((-50.0, 0.0), (50.0, 0.0), width=6)
    out.text((-150.0, -260.0), "nominal spot = origin of the lab frame", anchor="end")
    out.text((hit + 150.0, ground + 110.0), "beam position (X, Y)", BEAM, "start")
    out.text((pinhole - 300.0, w + 150.0), "pinhole", anchor="end")
    out.text((hole.center[0], w + 150.0), "aperture", DETECTOR)
    out.text((3900.0, w + 150.0), "plate", PLATE, "end")
    out.text((3850.0, ground - 180.0), "substrate: z = 0 of the sample frame", INK, "end")
    out.arrow((-4100.0, 0.0), (-4100.0, w - 40), both=True)
    out.dashed((-4300.0, 0.0), (0.0, 0.0))
    out.text((-4020.0, 0.42 * w), "W: working distance", anchor="start")
    out.arrow((-4700.0, ground), (-4700.0, w), both=True)
    out.text((-4780.0, 0.42 * w), "D", anchor="end")
    out.axes((3000.0, 500.0), ("x", "z"), 600.0)
    return out.svg()


def top(instrument: Instrument) -> str:
    """Plate seen from above: apertures, azimuths, raster."""
    pinhole = -instrument.working_distance * math.tan(math.radians(instrument.beam.incidence_deg))
    out = Drawing(860, 520, 0.078, (-4000.0, -3300.0))
    for detector, hole in zip(instrument.detector, instrument.apertures(), strict=True):
        out.ellipse(hole.center, hole.semi_axes, hole.rotation, DETECTOR)
        out.text((hole.center[0], hole.center[1] - 60.0), detector.name, DETECTOR)
    out.dashed((0.0, 0.0), (1500.0, 0.0))
    left = instrument.apertures()[[d.name for d in instrument.detector].index("left")].center
    out.dashed((0.0, 0.0), left, color=DETECTOR)
    out.arc((0.0, 0.0), 900.0, 0.0, math.degrees(math.atan2(left[1], left[0])), color=DETECTOR)
    out.text((640.0, 830.0), "azimuth +120 deg", DETECTOR, "start")
    out.arrow((pinhole, 0.0), (0.0, 0.0), color=BEAM, width=2.5)
    out.path((pinhole - 40, 0.0), (pinhole + 40, 0.0), color=BEAM, width=6)
    out.text((pinhole, -260.0), "pinhole", BEAM)
    out.text((0.5 * pinhole, 120.0), "the atoms travel", BEAM)
    out.text((0.0, -260.0), "nominal spot")
    out.axes((-3400.0, -2600.0), ("x", "y"), 700.0)
    corner, step = (3900.0, -1200.0), 480.0
    for i in range(6):
        out.path((corner[0] + i * step, corner[1]), (corner[0] + i * step, corner[1] + 5 * step), color=SAMPLE, width=1)
        out.path((corner[0], corner[1] + i * step), (corner[0] + 5 * step, corner[1] + i * step), color=SAMPLE, width=1)
    out.text((corner[0] + 2.5 * step, corner[1] + 5.3 * step), "counts[detector, row, column]")
    out.arrow((corner[0], corner[1] - 200.0), (corner[0] + 5 * step, corner[1] - 200.0))
    out.text((corner[0] + 2.5 * step, corner[1] - 480.0), "column: x grows")
    out.arrow((corner[0] + 5.4 * step, corner[1]), (corner[0] + 5.4 * step, corner[1] + 5 * step))
    out.text((corner[0] + 5.2 * step, corner[1] - 1000.0), "row: y grows, the first row is the lowest", anchor="end")
    return out.svg()


def raster(instrument: Instrument) -> str:
    """Surface point of height h, and the pixel in which an oblique beam shows it."""
    t, h, radius = math.radians(instrument.beam.incidence_deg), 700.0, 1000.0
    place = -250.0
    seen = place + h * math.tan(t)
    out = Drawing(860, 380, 0.26, (-1650.0, -330.0))
    sink = h - math.sqrt(radius**2 - place**2)
    foot = math.asin(-sink / radius)
    angles = [foot + (math.pi - 2 * foot) * i / 90 for i in range(91)]
    ball = [(radius * math.cos(a), sink + radius * math.sin(a)) for a in angles]
    ground = ((-1600.0, 0.0), (-1600.0, -120.0), (1600.0, -120.0), (1600.0, 0.0))
    out.path(*ground, *ball, ground[0], color=SAMPLE, fill=BODY)
    out.arrow((place - 370.0 * math.tan(t), h + 370.0), (place, h), color=BEAM, width=2.5)
    out.dashed((place, h), (seen, 0.0), color=BEAM)
    out.dashed((place, h), (place, 0.0))
    out.arrow((place - 40.0, 0.0), (place - 40.0, h), both=True)
    out.text((place - 80.0, 0.45 * h), "h", anchor="end")
    out.arrow((place, -60.0), (seen, -60.0), both=True)
    out.text((seen + 30.0, -90.0), "h tan t", anchor="start")
    out.text((seen + 30.0, 25.0), "X: pixel that shows the point", BEAM, "start")
    out.text((place - 90.0, -90.0), "x = X - h tan t: where the point is", anchor="end")
    out.axes((1250.0, 650.0), ("x", "z"), 160.0)
    return out.svg()


def masks(instrument: Instrument) -> str:
    """A block: the shadow of the beam on one side, the mask of a detector on the other."""
    t, h = math.radians(instrument.beam.incidence_deg), 600.0
    hole = instrument.apertures()[0]
    polar = math.atan2(hole.center[0], instrument.working_distance)
    out = Drawing(860, 400, 0.26, (-1650.0, -330.0))
    ground = ((-1600.0, 0.0), (-1600.0, -120.0), (1600.0, -120.0), (1600.0, 0.0))
    block = ((300.0, 0.0), (300.0, h), (-300.0, h), (-300.0, 0.0))
    out.path(*ground, *block, ground[0], color=SAMPLE, fill=BODY)
    shadow, mask = 300.0 + h * math.tan(t), -300.0 - h * math.tan(polar)
    out.arrow((300.0 - 400.0 * math.tan(t), h + 400.0), (shadow, 0.0), color=BEAM, width=2.5)
    out.path((300.0, 0.0), (shadow, 0.0), color=BEAM, width=6)
    out.arrow((mask, 0.0), (-300.0 + 400.0 * math.tan(polar), h + 400.0), color=DETECTOR, width=2.5)
    out.path((mask, 0.0), (-300.0, 0.0), color=DETECTOR, width=6)
    out.text((shadow + 40.0, 90.0), "shadowed: the beam does not", BEAM, "start")
    out.text((shadow + 40.0, 25.0), "reach it; length h tan t", BEAM, "start")
    out.text((mask - 40.0, 90.0), "masked: this detector does not", DETECTOR, "end")
    out.text((mask - 40.0, 25.0), "see it; length h tan(polar angle)", DETECTOR, "end")
    out.arrow((0.0, 0.0), (0.0, h), both=True)
    out.text((40.0, 0.45 * h), "h", anchor="start")
    out.text((-160.0, h + 330.0), "to the detector", DETECTOR, "end")
    out.text((200.0, h + 330.0), "beam", BEAM, "start")
    return out.svg()


def drawings() -> dict[str, str]:
    """Return every drawing by the name of its file."""
    instrument = load_instrument("bshem_wd4", {"plate.sample_distance_um": 4700.0})
    return {f"drawing_{draw.__name__}.svg": draw(instrument) for draw in (side, top, raster, masks)}


if __name__ == "__main__":
    for name, svg in drawings().items():
        (HERE / name).write_text(svg, encoding="utf-8")
