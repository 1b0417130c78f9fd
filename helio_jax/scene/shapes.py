"""Parametric samples: flat, spheres, step, trench, pyramid. Models of the `[sample]` table.

surfaces.py builds their geometry: z up, z = 0 on the substrate, um.
"""

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from helio_jax.scene import surfaces
from helio_jax.scene.body import COSINE, Body
from helio_jax.scene.placement import PlaceableSample
from helio_jax.settings import Settings

Length = Annotated[float, Field(gt=0.0, le=1e6)]
"""A length of a sample [um]."""
MAX_MOATS = 100
"""Largest number of moats of a sample; each is made of thousands of triangles and takes 0.1 s."""


class MaterialSample(PlaceableSample):
    """Base of samples with a default material."""

    material: str = Field(default=COSINE, min_length=1, max_length=200)
    """Material of all surfaces without a material of their own: a table `[material.NAME]`, or "cosine"."""

    @property
    def material_names(self) -> tuple[str, ...]:
        """Names of all materials of the sample."""
        return (self.material,)


class SubstrateSample(MaterialSample):
    """Base of parametric samples: a square substrate at z = 0 about the z axis."""

    size_um: Length = 8000.0
    """Side of the square substrate around the structure [um]."""

    @property
    def shape_top(self) -> float | None:
        return 0.0

    @property
    def shape_size(self) -> float:
        return self.size_um


class FlatSample(SubstrateSample):
    """The bare substrate."""

    kind: Literal["flat"] = "flat"

    def build_shape(self, base_dir: Path = Path()) -> Body:
        return surfaces.flat_body(self.size_um).with_material(self.material)


class Moat(Settings):
    """An annular groove in the substrate around a sphere, which is its inner wall."""

    width_um: Length
    """From the sphere's rim at z = 0 to the vertical outer wall [um]."""
    depth_um: Length
    """Depth of the level floor below the substrate [um]."""


class Sphere(Settings):
    """A sphere partly buried in the substrate."""

    radius_um: Length
    """Radius R [um]."""
    cap_height_um: Length | None = None
    """Height H of the top above the substrate, at most 2 R; default 2 R: the sphere rests on the substrate [um]."""
    center_um: tuple[float, float] = (0.0, 0.0)
    """Position (x, y) of the axis [um]."""
    moat: Moat | None = None
    """Groove around the rim, or none."""
    material: str | None = Field(default=None, min_length=1, max_length=200)
    """Material of the sphere; default: the sample's."""

    @model_validator(mode="after")
    def _is_on_flat(self) -> "Sphere":
        if self.cap_height > 2 * self.radius_um:
            raise ValueError(
                f"cap_height_um must be <= 2 * radius_um = {2 * self.radius_um:g} um, got {self.cap_height:g}: "
                "the sphere would float above the substrate"
            )
        return self

    @property
    def cap_height(self) -> float:
        """Height of the top above the substrate [um]."""
        return 2 * self.radius_um if self.cap_height_um is None else self.cap_height_um

    @property
    def rim_radius(self) -> float:
        """Radius of the circle in which the sphere meets the substrate [um]."""
        return math.sqrt(max(0.0, self.cap_height * (2 * self.radius_um - self.cap_height)))

    @property
    def row(self) -> tuple[float, float, float, float]:
        """x, y, z of the centre and radius [um]."""
        return (*self.center_um, self.cap_height - self.radius_um, self.radius_um)


class SpheresSample(SubstrateSample):
    """Spheres partly buried in the substrate; exact, not tessellated."""

    kind: Literal["spheres"] = "spheres"
    spheres: tuple[Sphere, ...] = Field(min_length=1, max_length=1000)
    """The spheres; they may touch and overlap."""

    @model_validator(mode="after")
    def _has_room_for_moats(self) -> "SpheresSample":
        moats = self._moats()
        if len(moats) > MAX_MOATS:
            raise ValueError(f"at most {MAX_MOATS} spheres can have a moat, got {len(moats)}: remove some of them")
        reach = np.abs(moats[:, :2]) + moats[:, 2:3]
        if reach.size and reach.max() >= 0.5 * self.size_um:
            raise ValueError(
                f"a moat reaches {reach.max():g} um from the centre, the substrate only {0.5 * self.size_um:g} um: "
                "enlarge size_um"
            )
        gap = np.hypot(*(moats[:, None, :2] - moats[None, :, :2]).transpose(2, 0, 1))
        touching = np.triu(gap <= moats[:, None, 2] + moats[None, :, 2], 1)
        if touching.any():
            i, j = np.argwhere(touching)[0]
            raise ValueError(
                f"moats must not overlap, got two {gap[i, j]:g} um apart with outer radii {moats[i, 2]:g} and "
                f"{moats[j, 2]:g} um: move the spheres apart or reduce width_um"
            )
        return self

    def _moats(self) -> np.ndarray:
        """Return x, y, outer radius and depth of every moat [m, 4]."""
        rows = [(*s.center_um, s.rim_radius + s.moat.width_um, s.moat.depth_um) for s in self.spheres if s.moat]
        return np.array(rows, np.float64).reshape(-1, 4)

    @property
    def material_names(self) -> tuple[str, ...]:
        return (self.material, *(s.material for s in self.spheres if s.material))

    @property
    def sphere_array(self) -> np.ndarray:
        """x, y, z of the centres and radii [s, 4], um."""
        return np.array([s.row for s in self.spheres])

    @property
    def shape_top(self) -> float | None:
        return max(s.cap_height for s in self.spheres)

    def build_shape(self, base_dir: Path = Path()) -> Body:
        body = surfaces.moated_body(self.size_um, self._moats(), self.sphere_array)
        return body.with_material(self.material, [s.material or self.material for s in self.spheres])


class StepSample(SubstrateSample):
    """A straight step: the lower terrace is z = 0, the upper one z = height."""

    kind: Literal["step"] = "step"
    height_um: Length
    """Height of the upper terrace above the lower one [um]."""
    position_um: float = 0.0
    """Distance of the upper edge from the centre, along `facing_deg` [um]."""
    facing_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Azimuth of the lower side, counter-clockwise from +x; the substrate rotates with it [deg]."""
    slope_deg: float = Field(default=90.0, ge=1.0, le=90.0)
    """Angle of the facet to the horizontal; 90 is a vertical wall [deg]."""

    @model_validator(mode="after")
    def _is_on_flat(self) -> "StepSample":
        run = 0.0 if self.slope_deg == 90 else self.height_um / math.tan(math.radians(self.slope_deg))
        if self.position_um <= -0.5 * self.size_um or self.position_um + run >= 0.5 * self.size_um:
            raise ValueError(
                f"the facet from {self.position_um:g} to {self.position_um + run:g} um must lie on the substrate, "
                f"which ends at +-{0.5 * self.size_um:g} um: enlarge size_um or move position_um"
            )
        return self

    @property
    def shape_top(self) -> float | None:
        return self.height_um

    def build_shape(self, base_dir: Path = Path()) -> Body:
        angles = map(math.radians, (self.facing_deg, self.slope_deg))
        return surfaces.step_body(self.size_um, self.height_um, self.position_um, *angles).with_material(self.material)


class TrenchSample(SubstrateSample):
    """A trench with vertical walls and closed ends in the substrate."""

    kind: Literal["trench"] = "trench"
    width_um: Length
    """Width of the trench [um]."""
    length_um: Length
    """Length of the trench [um]."""
    depth_um: Length
    """Depth of the floor below the substrate [um]."""
    azimuth_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Direction of the length, counter-clockwise from +x; the substrate rotates with it [deg]."""
    center_um: tuple[float, float] = (0.0, 0.0)
    """Position (x, y) of the trench's centre [um]."""

    @model_validator(mode="after")
    def _is_on_flat(self) -> "TrenchSample":
        _check_on_flat("trench", self.size_um, (self.length_um, self.width_um), self.center_um, self.azimuth_deg)
        return self

    def build_shape(self, base_dir: Path = Path()) -> Body:
        sides = (self.width_um, self.length_um, self.depth_um)
        body = surfaces.trench_body(self.size_um, *sides, math.radians(self.azimuth_deg), self.center_um)
        return body.with_material(self.material)


class PyramidSample(SubstrateSample):
    """A square pyramid on the substrate, pointed or truncated."""

    kind: Literal["pyramid"] = "pyramid"
    base_um: Length
    """Side of the base square [um]."""
    height_um: Length
    """Height of the top above the substrate [um]."""
    top_um: float = Field(default=0.0, ge=0.0, le=1e6)
    """Side of the top square; 0: pointed [um]."""
    azimuth_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Azimuth of one face, counter-clockwise from +x; the substrate rotates with it [deg]."""
    center_um: tuple[float, float] = (0.0, 0.0)
    """Position (x, y) of the axis [um]."""

    @model_validator(mode="after")
    def _is_on_flat(self) -> "PyramidSample":
        if self.top_um >= self.base_um:
            raise ValueError(f"top_um must be < base_um = {self.base_um:g} um, got {self.top_um:g}")
        _check_on_flat("pyramid", self.size_um, (self.base_um, self.base_um), self.center_um, self.azimuth_deg)
        return self

    @property
    def shape_top(self) -> float | None:
        return self.height_um

    def build_shape(self, base_dir: Path = Path()) -> Body:
        shape = (self.base_um, self.height_um, self.top_um)
        body = surfaces.pyramid_body(self.size_um, *shape, math.radians(self.azimuth_deg), self.center_um)
        return body.with_material(self.material)


def _check_on_flat(
    name: str, size: float, sides: tuple[float, float], center: tuple[float, float], azimuth_deg: float
) -> None:
    """Check that a rectangle lies strictly inside the substrate, which rotates with it."""
    c, s = math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))
    u, v = c * center[0] + s * center[1], -s * center[0] + c * center[1]
    reach = max(abs(u) + 0.5 * sides[0], abs(v) + 0.5 * sides[1])
    if reach >= 0.5 * size:
        raise ValueError(
            f"the {name} reaches {reach:g} um from the centre, the substrate only {0.5 * size:g} um: enlarge size_um"
        )
