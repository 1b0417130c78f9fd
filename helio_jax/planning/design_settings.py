"""Settings of a design of aperture layouts: table `[design]`. Read by the command line without importing JAX."""

from typing import Annotated

from pydantic import Field, model_validator

from helio_jax.settings import Settings

MAX_KEPT = 12
"""Most layouts that a design keeps."""
Angle = Annotated[float, Field(ge=0.0, le=75.0)]
Length = Annotated[float, Field(gt=0.0, le=1e7)]


class DesignSettings(Settings):
    """What layouts may be, and how they are searched."""

    apertures: tuple[Annotated[int, Field(ge=3, le=12)], ...] = Field(default=(3, 4), min_length=1, max_length=8)
    """Numbers of apertures that are tried."""
    total_area_um2: float | None = Field(default=None, gt=0.0, le=1e14)
    """Area of all apertures together, on the plate; default: that of the scene's [um^2]."""
    area_ratio: float = Field(default=4.0, ge=1.0, le=100.0)
    """Largest area of an aperture over the smallest one; 1: all are equal."""
    polar_deg: tuple[Angle, Angle] = (10.0, 60.0)
    """Least and largest polar angle of an aperture's centre, seen from the nominal spot [deg]."""
    wall_um: float = Field(default=200.0, ge=0.0, le=1e6)
    """Least wall of the plate between two apertures, from an aperture to the disc about the pinhole, and to the plate's
    edge [um]."""
    pinhole_clearance_um: float = Field(default=300.0, gt=0.0, le=1e6)
    """Radius of the disc about the pinhole that is kept free for the beam [um]."""
    plate_radius_um: float | None = Field(default=None, gt=0.0, le=1e8)
    """Radius of the plate about the point above the nominal spot; default: apertures end at the largest polar angle
    alone [um]."""
    plate_thickness_um: float = Field(default=500.0, ge=0.0, le=1e6)
    """Thickness of the plate, within which channels lean outwards; only with `plate_radius_um` [um]."""
    working_distance_um: tuple[Length, Length] | None = None
    """Least and largest working distance; default: that of the scene. The nearer the plate, the more atoms an aperture
    of the same area takes [um]."""
    incidences_deg: tuple[Annotated[float, Field(ge=0.0, le=75.0)], ...] = Field(default=(), max_length=8)
    """Incidence angles of the beam that are tried; default: that of the scene [deg]."""
    masked_weights: tuple[Annotated[float, Field(ge=0.0, le=100.0)], ...] = Field(
        default=(0.0, 1.0), min_length=1, max_length=8
    )
    """Weights of the masked area: each search minimises the logarithm of the heights' variance plus the weight times
    the masked area over that of the scene's layout."""
    pixels: int = Field(default=13, ge=7, le=31)
    """Pixels along the longer side of the raster on which a sample is assessed; the field is that of its scene."""
    starts: int = Field(default=2, ge=1, le=100)
    """Random starts, beside rings, symmetric pairs and the scene's layout. So many searches, of each number and weight,
    begin at the best starts without symmetry, and one at the best symmetric pairs."""
    steps: int = Field(default=30, ge=1, le=1000)
    """Most steps of a search."""
    seed: int = Field(default=1, ge=0, lt=2**63)
    """Seed of the random starts."""
    keep: int = Field(default=6, ge=1, le=MAX_KEPT)
    """Most layouts that are kept."""

    @model_validator(mode="after")
    def _has_ranges(self) -> "DesignSettings":
        for name in ("polar_deg", "working_distance_um"):
            ends = getattr(self, name)
            if ends is not None and not ends[0] <= ends[1]:
                raise ValueError(f"{name} must be [least, largest], got {list(ends)}: exchange the two")
        return self
