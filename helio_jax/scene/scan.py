"""Scans: which beam positions a micrograph is made of. Settings table `[scan]`.

Convention: a beam position is where the beam axis meets the sample's plane z = 0, sample frame (arrays.py).
"""

import math
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from helio_jax.instrument import Beam
from helio_jax.settings import Settings

MAX_PIXELS = 4096**2
"""Largest raster, in pixels."""


class Raster(Settings):
    """A regular raster, centred on `center_um`; x grows with the column, y with the row."""

    nx: int = Field(ge=1, le=65536)
    """Columns."""
    ny: int = Field(ge=1, le=65536)
    """Rows."""
    pixel_size_um: float = Field(gt=0.0, le=1e5)
    """Distance between neighbouring pixels; see `pitch` [um]."""
    pitch: Literal["beam", "sample"] = "beam"
    """`beam`: pixel size measured across the beam, so it is pixel_size / cos t on the sample along the beam's
    azimuth (which must be a multiple of 90 deg); `sample`: equal in x and y on the sample."""
    center_um: tuple[float, float] = (0.0, 0.0)
    """Beam position of the raster's middle [um]."""
    atoms_per_pixel: float = Field(default=35_000.0, gt=0.0, le=1e18)
    """Beam atoms per pixel that the counts stand for (not the number of traced rays)."""

    @model_validator(mode="after")
    def _is_small_enough(self) -> "Raster":
        if self.nx * self.ny > MAX_PIXELS:
            raise ValueError(
                f"nx * ny must be <= {MAX_PIXELS} pixels, got {self.nx} x {self.ny} = {self.nx * self.ny}: "
                "use a larger pixel_size_um and fewer pixels"
            )
        return self

    def problem(self, beam: Beam) -> str | None:
        """Return why this raster cannot be combined with `beam`, or None."""
        if self.pitch == "beam" and beam.incidence_deg > 0 and beam.azimuth_deg % 90 != 0:
            return (
                f"'beam' needs beam.azimuth_deg to be a multiple of 90, got {beam.azimuth_deg:g}: "
                'set scan.pitch = "sample" (equal pitch in x and y on the sample)'
            )
        return None

    def positions(self, beam: Beam) -> tuple[np.ndarray, np.ndarray]:
        """Return the beam positions x [x] and y [y], um."""
        stretch = 1.0 / math.cos(math.radians(beam.incidence_deg)) if self.pitch == "beam" else 1.0
        is_along_x = beam.azimuth_deg % 180 == 0
        step_x = self.pixel_size_um * (stretch if is_along_x else 1.0)
        step_y = self.pixel_size_um * (1.0 if is_along_x else stretch)
        x = self.center_um[0] + (np.arange(self.nx) - 0.5 * (self.nx - 1)) * step_x
        y = self.center_um[1] + (np.arange(self.ny) - 0.5 * (self.ny - 1)) * step_y
        return x, y
