"""Placement of a sample, the same keys for all kinds: scale about the origin, rotate about x, y, z, then shift."""

import math
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from helio_jax.scene.body import Body
from helio_jax.scene.mtl import FileLaw
from helio_jax.settings import Settings


class PlaceableSample(Settings):
    """Base of all samples: placement, and conversion to a `Body`."""

    scale: float = Field(default=1.0, gt=0.0, le=1e9)
    """Factor on all lengths of the shape."""
    rotate_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotations about the fixed x, then y, then z axis, after scaling; the substrate rotates too [deg]."""
    translate_um: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift after scaling and rotation [um]."""
    place: Literal["as-given", "top-at-working-distance"] = "as-given"
    """`as-given`: z = 0 is plate.sample_distance_um below the plate; `top-at-working-distance`: that distance is set
    so that the sample's highest point is plate.working_distance_um below the plate."""

    def build_shape(self, base_dir: Path = Path()) -> Body:
        """Build the geometry before placement; relative file names start at `base_dir`."""
        raise NotImplementedError

    def build(self, base_dir: Path = Path()) -> Body:
        """Build the placed geometry (errors as those of its files)."""
        return self.place_body(self.build_shape(base_dir))

    def file_laws(self, base_dir: Path = Path()) -> dict[str, FileLaw]:
        """Read the scattering laws from the sample's files, by the material's name in the body."""
        return {}

    def warnings(self, base_dir: Path = Path()) -> list[str]:
        """List probable mistakes in the sample's files."""
        return []

    def place_body(self, body: Body, unit: float = 1.0) -> Body:
        """Return a shape, whose lengths are in `unit` um, scaled, rotated and shifted."""
        if unit == 1.0 and not self.is_placed:
            return body
        return body.transformed(rotation_matrix(self.rotate_deg), unit * self.scale, self.translate_um)

    @property
    def is_placed(self) -> bool:
        """Whether the shape is scaled, rotated or shifted."""
        return self.scale != 1.0 or any(self.rotate_deg) or any(self.translate_um)

    @property
    def is_tilted(self) -> bool:
        """Whether the shape is rotated about another axis than z."""
        return any(self.rotate_deg[:2])

    @property
    def shape_top(self) -> float | None:
        """Height of the shape's highest point before placement [um]; None: unknown before the shape is built."""
        return None

    @property
    def top(self) -> float | None:
        """Height of the highest point after placement [um]; None: unknown before the shape is built."""
        top = self.shape_top
        return None if top is None or self.is_tilted else top * self.scale + self.translate_um[2]

    @property
    def shape_size(self) -> float:
        """Side of the square substrate around the shape [um]; infinity if only the file defines it."""
        return math.inf


def rotation_matrix(angles_deg: tuple[float, float, float]) -> np.ndarray:
    """Compute the matrix of rotations about the fixed x, then y, then z axis [3, 3]."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(angles_deg)), np.sin(np.radians(angles_deg))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ about_y @ about_x
