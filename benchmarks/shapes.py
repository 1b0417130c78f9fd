"""Random test samples in families: what `benchmarks/families.py` simulates, reconstructs and scores.

Every member is drawn from (family, seed, number): size, height, turn, place by fractions of a pixel, raster, signal-to-
noise ratio, incidence (0 or 30 deg) and number of detectors (3 or 4). `Member.write` gives a scene file and the meshes
or height maps beside it, which `helio simulate` takes, too. All lengths in um.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from helio_jax.formats.toml import to_toml

DISTANCE = 4000.0
"""From the plate to the highest point of the sample [um]."""
SUBSTRATE = 16_000.0
"""Side of the substrate, beyond what any aperture could see multiply scattered atoms from [um]."""
SIDES = 48
"""Corners of a circle."""
SUBSTRATE_ALBEDO = 1 / 1.2
"""Of the substrate of family `albedo`, so that objects of relative albedo 1.2 can exist."""

Tables = dict[str, Any]
Rng = np.random.Generator


@dataclass(frozen=True)
class Member:
    """One random sample with its instrument and scan.

    Attributes:
        name: FAMILY-SEED-NUMBER.
        tables: of the scene file; [sample] without the names of files.
        mesh: the sample's solid, or None.
        map: x [x], y [y], height [y, x] of a height map, or None, um.
        levels: heights of the level patches that are scored, the substrate's apart [um].
        apexes: places x, y, z [um] of the tops of the objects that are scored where there are no such levels; none: the
            highest point.
        border: what reconstruction may assume.
        about: the numbers drawn, for tables.
        world: name of a disturbance of the micrographs (`benchmarks/families.py`), or "".
    """

    name: str
    tables: Tables
    mesh: manifold3d.Manifold | None = None
    map: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    levels: tuple[float, ...] = ()
    apexes: tuple[tuple[float, float, float], ...] = ()
    border: str = "flat"
    about: Tables = field(default_factory=dict)
    world: str = ""

    def write(self, folder: Path) -> Path:
        """Write scene, mesh and height map; return the scene's path."""
        folder.mkdir(parents=True, exist_ok=True)
        sample = dict(self.tables["sample"])
        if self.mesh is not None:
            found = self.mesh.to_mesh64()
            solid = trimesh.Trimesh(np.asarray(found.vert_properties)[:, :3], np.asarray(found.tri_verts))
            solid.export(folder / f"{self.name}.ply")
            sample |= {"kind": "mesh", "file": f"{self.name}.ply", "unit": "um"}
        if self.map is not None:
            x, y, height = self.map
            np.savez(folder / f"{self.name}.npz", x=x, y=y, height=height)
            sample |= {"kind": "height_map", "file": f"{self.name}.npz", "unit": "um"}
        path = folder / f"{self.name}.toml"
        path.write_text(to_toml({"name": self.name, **self.tables, "sample": sample}))
        return path


def members(family: str, seed: int, numbers: range, size: tuple[int, int] = (61, 101)) -> Iterator[Member]:
    """Draw members of a family on rasters of so many pixels a side (least, most)."""
    for number in numbers:
        rng = np.random.default_rng([list(FAMILIES).index(family), seed, number])
        scan = Scan.draw(rng, size, number)
        member = FAMILIES[family](rng, scan)
        top = member.about["top_um"]
        tables = scan.tables(top, float(member.about.get("atoms_factor", 1.0))) | member.tables
        yield replace(
            member,
            name=f"{family}-{seed}-{number}",
            tables=tables | {"reconstruct": {"border": member.border}},
            about={**scan.about, **member.about},
        )


@dataclass(frozen=True)
class Scan:
    """Raster and instrument of a member."""

    n: int
    pitch: float
    snr: float
    incidence_deg: float
    n_detectors: int
    seed: int
    number: int

    @classmethod
    def draw(cls, rng: Rng, size: tuple[int, int], number: int) -> "Scan":
        n = int(rng.integers(size[0], size[1] + 1))
        field = rng.uniform(500.0, 2000.0)
        snr = math.exp(rng.uniform(math.log(30.0), math.log(100.0)))
        incidence, n_detectors = float(rng.choice((0.0, 30.0))), int(rng.choice((3, 4)))
        return cls(n, field / n, snr, incidence, n_detectors, int(rng.integers(2**31)), number)

    @property
    def field(self) -> float:
        """Side of the image [um]."""
        return self.n * self.pitch

    @property
    def about(self) -> Tables:
        return {"n": self.n, "pitch_um": self.pitch, "snr": self.snr, "incidence_deg": self.incidence_deg} | {
            "n_detectors": self.n_detectors
        }

    def place(self, rng: Rng, reach: float) -> np.ndarray:
        """Draw a centre from which `reach` to all sides stays inside a margin of 12 % of the image [um]."""
        room = max(0.0, 0.38 * self.field - reach)
        return rng.uniform(-room, room, 2) + rng.uniform(-0.5, 0.5, 2) * self.pitch

    def tables(self, top: float, atoms_factor: float) -> Tables:
        """Return instrument, raster and noise; the signal of the flat substrate is SNR^2 counts."""
        polar, turn = (30.0, 0.0) if self.n_detectors == 3 and self.incidence_deg else (38.0, 45.0)
        azimuths = (turn + np.arange(self.n_detectors) * 360.0 / self.n_detectors).tolist()
        half_angle = 8.0
        signal = math.sin(math.radians(half_angle)) ** 2 * math.cos(math.radians(polar))
        return {
            "beam": {"incidence_deg": self.incidence_deg, "source_size_mrad": 0.1, "pinhole_radius_um": 0.5},
            "plate": {"working_distance_um": DISTANCE, "sample_distance_um": DISTANCE + max(top, 0.0)},
            "detector": [
                {"name": f"d{k}", "polar_deg": polar, "azimuth_deg": a, "half_angle_deg": half_angle}
                for k, a in enumerate(azimuths)
            ],
            "scan": {
                "nx": self.n,
                "ny": self.n,
                "pixel_size_um": self.pitch,
                "pitch": "sample",
                "atoms_per_pixel": round(atoms_factor * self.snr**2 / signal),
            },
            "trace": {"rays": 32, "seed": self.seed % 1000, "maps": False},
            "noise": {"seed": self.seed},
        }


# --- solids ---------------------------------------------------------------------------------------------------------


def outline(points: np.ndarray) -> manifold3d.CrossSection:
    """Return the region inside a polygon [corner, 2]."""
    return manifold3d.CrossSection([np.asarray(points, np.float64)])


def rectangle(width: float, length: float) -> manifold3d.CrossSection:
    return manifold3d.CrossSection.square((width, length), True)


def random_outline(rng: Rng, width: float) -> tuple[manifold3d.CrossSection, str]:
    """Draw an outline of about a width, centred: rectangle, L, T, ring, cross or polygon."""
    kind = str(rng.choice(("rectangle", "L", "T", "ring", "polygon")))
    arm = rng.uniform(0.35, 0.5) * width
    if kind == "rectangle":
        return rectangle(width, rng.uniform(0.5, 1.0) * width), kind
    if kind == "L":
        parts = [rectangle(width, arm).translate((0, -0.5 * (width - arm)))]
        return parts[0] + rectangle(arm, width).translate((-0.5 * (width - arm), 0)), kind
    if kind == "T":
        return rectangle(width, arm).translate((0, 0.5 * (width - arm))) + rectangle(arm, width), kind
    if kind == "ring":
        hole = manifold3d.CrossSection.circle(rng.uniform(0.2, 0.3) * width, SIDES)
        return manifold3d.CrossSection.circle(0.5 * width, SIDES) - hole, kind
    angles = np.sort(rng.uniform(0, 2 * math.pi, 9))
    radii = 0.5 * width * rng.uniform(0.75, 1.0, 9)
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles)], -1)
    return outline(points).hull(), kind


def ground(depth: float) -> manifold3d.Manifold:
    """Return the block below z = 0, thicker than a depth."""
    thickness = depth + 100.0
    return manifold3d.Manifold.cube((SUBSTRATE, SUBSTRATE, thickness), True).translate((0, 0, -0.5 * thickness))


def prism(section: manifold3d.CrossSection, low: float, high: float, scale: float = 1.0) -> manifold3d.Manifold:
    """Return what stands between two heights above a section; `scale`: size of the upper end over the lower one's."""
    return section.extrude(high - low, scale_top=(scale, scale)).translate((0, 0, low))


def solid_member(rng: Rng, solid: manifold3d.Manifold, top: float, **more: Any) -> Member:
    return Member("", {"sample": {}}, mesh=solid, **{**more, "about": {"top_um": top, **more.get("about", {})}})


# --- families -------------------------------------------------------------------------------------------------------


def mesa(rng: Rng, scan: Scan) -> Member:
    """A mesa or pit with vertical walls, one or two levels, any outline and turn."""
    width = rng.uniform(0.28, 0.5) * scan.field
    height = rng.uniform(0.1, 0.6) * width
    is_pit, has_two = rng.random() < 0.4, rng.random() < 0.25
    section, kind = random_outline(rng, width)
    turn, center = rng.uniform(0, 360.0), scan.place(rng, 0.5 * width)
    section = section.rotate(turn).translate(center)
    sign = -1.0 if is_pit else 1.0
    levels: tuple[float, ...] = (sign * height,)
    parts = [(section, height)]
    if has_two:
        inner = rectangle(0.5 * width, 0.4 * width).rotate(turn).translate(center)
        share = rng.uniform(1.3, 1.7)
        parts.append((section ^ inner, share * height))
        levels = (*levels, sign * share * height)
    deepest = max(h for _, h in parts)
    if is_pit:
        solid = ground(deepest)
        for part, depth in parts:
            solid -= prism(part, -depth, 10.0)
    else:
        solid = ground(0.0)
        for part, up in parts:
            solid += prism(part, -10.0, up)
    about = {"kind": ("pit " if is_pit else "mesa ") + kind, "width_um": width, "height_um": height, "turn_deg": turn}
    return solid_member(rng, solid, 0.0 if is_pit else deepest, levels=levels, about=about)


def slot(rng: Rng, scan: Scan) -> Member:
    """A slot inside the image, or a step through it (free border), at any angle to the beam."""
    turn = rng.uniform(0, 360.0)
    if rng.random() < 0.5:
        width = rng.uniform(0.12, 0.25) * scan.field
        depth = rng.uniform(0.5, 2.0) * width
        length = rng.uniform(0.5, 0.7) * scan.field
        section = rectangle(length, width).rotate(turn).translate(scan.place(rng, 0.5 * length))
        solid = ground(depth) - prism(section, -depth, 10.0)
        about = {"kind": "slot", "width_um": width, "height_um": depth, "turn_deg": turn}
        return solid_member(rng, solid, 0.0, levels=(-depth,), about=about)
    height = rng.uniform(0.05, 0.25) * scan.field
    shift = rng.uniform(-0.15, 0.15) * scan.field
    section = rectangle(SUBSTRATE, 2 * SUBSTRATE).translate((0.5 * SUBSTRATE + shift, 0)).rotate(turn)
    solid = ground(0.0) + prism(section ^ rectangle(SUBSTRATE, SUBSTRATE), -10.0, height)
    about = {"kind": "step", "width_um": scan.field, "height_um": height, "turn_deg": turn}
    return solid_member(rng, solid, height, levels=(height,), border="free", about=about)


def overhang(rng: Rng, scan: Scan) -> Member:
    """A ball on a plane (whole, half or buried), a mushroom, or a block with re-entrant walls."""
    kind = str(rng.choice(("ball", "mushroom", "re-entrant")))
    width = rng.uniform(0.25, 0.45) * scan.field
    center = scan.place(rng, 0.5 * width)
    if kind == "ball":
        cap = float(rng.choice((1.0, 0.5, rng.uniform(0.3, 0.9)))) * width
        sphere = {"radius_um": 0.5 * width, "cap_height_um": cap, "center_um": center.tolist()}
        sample = {"kind": "spheres", "size_um": SUBSTRATE, "spheres": [sphere]}
        about = {"top_um": cap, "kind": f"ball {cap / width:.2f}", "width_um": width, "height_um": cap}
        return Member("", {"sample": sample}, about=about)
    height = rng.uniform(0.2, 0.6) * width
    if kind == "mushroom":
        stem = manifold3d.CrossSection.circle(rng.uniform(0.2, 0.35) * width, SIDES)
        cap = manifold3d.CrossSection.circle(0.5 * width, SIDES)
        thickness = rng.uniform(0.3, 0.6) * height
        solid = prism(stem, -10.0, height - 0.5 * thickness) + prism(cap, height - thickness, height)
    else:
        lower = rng.uniform(0.6, 0.9)
        section = rectangle(lower * width, lower * width * rng.uniform(0.6, 1.0)).rotate(rng.uniform(0, 360))
        solid = prism(section, 0.0, height, 1.0 / lower) + prism(section, -10.0, 1.0)
    solid = ground(0.0) + solid.translate((*center, 0.0))
    about = {"kind": kind, "width_um": width, "height_um": height}
    return solid_member(rng, solid, height, levels=(height,), about=about)


def _grid(scan: Scan, rng: Rng, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the axes and coordinates of a height map four times finer than the raster, shifted by a fraction of it."""
    step = scan.pitch / 4.0
    half = math.ceil(reach * scan.field / step)
    shift = rng.uniform(-0.5, 0.5, 2) * scan.pitch
    x, y = (step * np.arange(-half, half + 1) + s for s in shift)
    return (x, y, *np.meshgrid(x, y))


def window(x: np.ndarray, y: np.ndarray, reach: float) -> np.ndarray:
    """Return 1 inside, 0 beyond a reach from the centre, smoothly."""
    r = np.hypot(x, y) / reach
    return np.where(r < 1.0, np.cos(0.5 * math.pi * np.minimum(r, 1.0)) ** 2, 0.0)


def _rough(rng: Rng, shape: tuple[int, int], length: float) -> np.ndarray:
    """Return smooth random heights of range 1 with a correlation length in points."""
    noise = gaussian_filter(rng.standard_normal(shape), length, mode="wrap")
    return (noise - noise.min()) / np.ptp(noise)


def _mapped(x: np.ndarray, y: np.ndarray, height: np.ndarray, **more: Any) -> Member:
    about = {"top_um": float(height.max()), "height_um": float(np.ptp(height)), **more.pop("about", {})}
    sample = {"size_um": SUBSTRATE, "level_um": more.pop("level", 0.0)}
    return Member("", {"sample": sample}, map=(x, y, height), about=about, **more)


def smooth(rng: Rng, scan: Scan) -> Member:
    """Hills, a pyramid, cone or ellipsoid, facets, waves or a rough patch, of 1 to 50 % of the field, on a flat."""
    kind = str(rng.choice(("hills", "pyramid", "cone", "ellipsoid", "rough", "facets", "waves")))
    x, y, gx, gy = _grid(scan, rng, 0.45)
    c = scan.place(rng, 0.25 * scan.field)
    reach = 0.4 * scan.field
    relief = math.exp(rng.uniform(math.log(0.01), math.log(0.5))) * scan.field
    angle = rng.uniform(0, math.pi)
    u = (gx - c[0]) * math.cos(angle) + (gy - c[1]) * math.sin(angle)
    v = -(gx - c[0]) * math.sin(angle) + (gy - c[1]) * math.cos(angle)
    if kind in ("pyramid", "cone", "ellipsoid", "facets"):
        relief = min(relief, 0.3 * scan.field)
    w = 0.24 * scan.field
    if kind == "hills":
        height = np.zeros_like(gx)
        for _ in range(int(rng.integers(2, 6))):
            p, s = rng.uniform(-0.22, 0.22, 2) * scan.field, rng.uniform(0.05, 0.1) * scan.field
            height += rng.uniform(-0.6, 1.0) * np.exp(-((gx - p[0]) ** 2 + (gy - p[1]) ** 2) / (2 * s**2))
        height *= window(gx, gy, reach) ** 0.25
    elif kind == "pyramid":
        height = np.maximum(0.0, 1.0 - np.maximum(np.abs(u), np.abs(v)) / w)
    elif kind == "cone":
        height = np.maximum(0.0, 1.0 - np.hypot(u, v) / w)
    elif kind == "ellipsoid":
        height = np.sqrt(np.maximum(0.0, 1.0 - (u / w) ** 2 - (v / (0.7 * w)) ** 2))
    elif kind == "facets":
        tilt = rng.uniform(-0.7, 0.7, (5, 2)) / w
        planes = [1.0 + t[0] * u + t[1] * v for t in tilt]
        sides = [2.5 * (1.0 - (u * math.cos(a) + v * math.sin(a)) / w) for a in np.arange(5) * 2 * math.pi / 5]
        height = np.maximum(0.0, np.min(planes + sides, axis=0))
    elif kind == "rough":
        height = (_rough(rng, gx.shape, rng.uniform(12, 30)) - 0.5) * window(gx, gy, reach) ** 0.5
    else:
        height = np.sin(2 * math.pi * u / (rng.uniform(0.15, 0.4) * scan.field)) * window(gx, gy, reach)
    sign = -1.0 if rng.random() < 0.3 else 1.0
    height = sign * height * relief / max(np.ptp(height), 1e-9)
    return _mapped(x, y, height, about={"kind": ("hollow " if sign < 0 else "") + kind})


def free(rng: Rng, scan: Scan) -> Member:
    """Relief across the border: waves, rough, a tilted ball, an object at the border, a saddle with a step."""
    kind = str(rng.choice(("waves", "rough", "tilted ball", "object at the border", "saddle with a step")))
    x, y, gx, gy = _grid(scan, rng, 1.2)
    angle = rng.uniform(0, 2 * math.pi)
    u = gx * math.cos(angle) + gy * math.sin(angle)
    v = -gx * math.sin(angle) + gy * math.cos(angle)
    relief = rng.uniform(0.03, 0.2) * scan.field
    if kind == "waves":
        height = 0.5 + 0.5 * np.sin(2 * math.pi * u / (rng.uniform(0.25, 0.6) * scan.field) + rng.uniform(0, 6))
    elif kind == "rough":
        height = _rough(rng, gx.shape, rng.uniform(20, 40))
    elif kind == "tilted ball":
        r, c = 0.3 * scan.field, scan.place(rng, 0.3 * scan.field)
        ball = np.sqrt(np.maximum(0.0, r**2 - (gx - c[0]) ** 2 - (gy - c[1]) ** 2)) * 0.5
        height = (ball + math.tan(math.radians(rng.uniform(2, 8))) * u) / scan.field
        relief = 0.35 * scan.field * np.ptp(height) / 2.4
    elif kind == "object at the border":
        c = 0.45 * scan.field * np.array([math.cos(angle), math.sin(angle)])
        s = 0.15 * scan.field
        height = np.exp(-((gx - c[0]) ** 2 + (gy - c[1]) ** 2) / (2 * s**2))
    else:
        height = 0.5 + 0.6 * (u**2 - v**2) / (1.2 * scan.field) ** 2 + np.where(u > 0.1 * scan.field, 0.08, 0.0)
    height = height * relief / max(np.ptp(height), 1e-9)
    return _mapped(x, y, height - height.min(), border="free", level=None, about={"kind": kind})


def albedo(rng: Rng, scan: Scan) -> Member:
    """Two to four caps of other albedos than the substrate's."""
    n = int(rng.integers(2, 5))
    places = [(-0.18, -0.18), (0.18, 0.18), (-0.18, 0.18), (0.18, -0.18)]
    spheres, materials = [], {"substrate": {"kind": "cosine", "albedo": SUBSTRATE_ALBEDO}}
    for i, (px, py) in enumerate(places[:n]):
        rim = rng.uniform(0.09, 0.15) * scan.field
        cap = rng.uniform(0.3, 0.9) * rim
        ratio = rng.uniform(0.6, 1.2)
        center = (np.array([px, py]) * scan.field + rng.uniform(-0.5, 0.5, 2) * scan.pitch).tolist()
        radius = (rim**2 + cap**2) / (2 * cap)
        spheres.append({"radius_um": radius, "cap_height_um": cap, "center_um": center, "material": f"m{i}"})
        materials[f"m{i}"] = {"kind": "cosine", "albedo": min(1.0, ratio * SUBSTRATE_ALBEDO)}
    sample = {"kind": "spheres", "size_um": SUBSTRATE, "material": "substrate", "spheres": spheres}
    top = max(s["cap_height_um"] for s in spheres)
    ratios = [round(m["albedo"] / SUBSTRATE_ALBEDO, 2) for m in list(materials.values())[1:]]
    about = {"top_um": top, "height_um": top, "kind": f"albedo {ratios}", "atoms_factor": 1.0 / SUBSTRATE_ALBEDO}
    apexes = tuple((s["center_um"][0], s["center_um"][1], s["cap_height_um"]) for s in spheres)
    return Member("", {"sample": sample, "material": materials}, apexes=apexes, about=about)


WORLDS = (
    "specular lobe",
    "back lobe",
    "instrument turned",
    "instrument nearer",
    "channels swapped",
    "background",
    "wide spot",
    "dead detector",
    "mirrored raster",
    "angles and distance",
    "aperture off",
)
"""What is wrong in family `wrong`, of its members 0, 1, 2 and so on."""


def wrong(rng: Rng, scan: Scan) -> Member:
    """A cap or mesa seen by an instrument, a surface or a file other than reconstruction is told."""
    width = rng.uniform(0.3, 0.45) * scan.field
    height = rng.uniform(0.15, 0.45) * width
    center = scan.place(rng, 0.5 * width)
    radius = ((0.5 * width) ** 2 + height**2) / (2 * height)
    sphere = {"radius_um": radius, "cap_height_um": height, "center_um": center.tolist(), "material": "all"}
    sample = {"kind": "spheres", "size_um": SUBSTRATE, "material": "all", "spheres": [sphere]}
    world = WORLDS[scan.number % len(WORLDS)]
    law: Tables = {"kind": "cosine"}
    if world.endswith("lobe"):
        kind = "broad_specular" if world == "specular lobe" else "backscattering"
        law = {"kind": kind, "sigma_deg": 25.0, "diffuse_fraction": 0.7}
    about = {"top_um": height, "height_um": height, "kind": world}
    return Member("", {"sample": sample, "material": {"all": law}}, about=about, world=world)


FAMILIES: dict[str, Callable[[Rng, Scan], Member]] = {
    "mesa": mesa,
    "slot": slot,
    "overhang": overhang,
    "smooth": smooth,
    "free": free,
    "albedo": albedo,
    "wrong": wrong,
}
"""Rows 1 to 7 of docs/results.md, Any shape."""
