"""Where a sample stands: scaled, turned, moved, and how far from the plate. Keys that every sample shares.

One mechanism for all kinds: the shape, in its own frame, is scaled about the origin, then turned about the fixed x, y
and z axes, then moved. Knows nothing of shapes.
"""

import math
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from helio_jax.scene.body import Body
from helio_jax.scene.mtl import FileLaw
from helio_jax.settings import Settings


class PlaceableSample(Settings):
    """What all samples share: where they stand, and a way to become a `Body`."""

    scale: float = Field(default=1.0, gt=0.0, le=1e9)
    """Factor on all lengths of the shape."""
    rotate_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotations about the fixed x, then y, then z axis, after scaling; the sample's flat turns along [deg]."""
    translate_um: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Shift after scaling and turning [um]."""
    place: Literal["as-given", "top-at-working-distance"] = "as-given"
    """`as-given`: z = 0 stands plate.sample_distance_um below the plate; `top-at-working-distance`: that distance is
    set so that the sample's highest point stands plate.working_distance_um below the plate."""

    def shape(self, base_dir: Path = Path()) -> Body:
        """Return the geometry before it is placed; relative file names start at `base_dir`."""
        raise NotImplementedError

    def build(self, base_dir: Path = Path()) -> Body:
        """Return the geometry where it stands (errors as those of its files)."""
        return self.put(self.shape(base_dir))

    def file_laws(self, base_dir: Path = Path()) -> dict[str, FileLaw]:
        """Return the scattering laws that the sample's files bring along, by the material's name in the body."""
        return {}

    def warnings(self, base_dir: Path = Path()) -> list[str]:
        """Return what is allowed but probably not meant about the sample's files."""
        return []

    def put(self, body: Body, unit: float = 1.0) -> Body:
        """Return a shape, whose lengths are in `unit` um, scaled, turned and moved."""
        if unit == 1.0 and not self.is_placed:
            return body
        return body.transformed(rotation_matrix(self.rotate_deg), unit * self.scale, self.translate_um)

    @property
    def is_placed(self) -> bool:
        """Whether the shape is scaled, turned or moved."""
        return self.scale != 1.0 or any(self.rotate_deg) or any(self.translate_um)

    @property
    def is_tilted(self) -> bool:
        """Whether the shape is turned about another axis than z."""
        return any(self.rotate_deg[:2])

    @property
    def shape_top(self) -> float | None:
        """Height of the shape's highest point [um]; None where only a file or the built shape tells."""
        return None

    @property
    def top(self) -> float | None:
        """Height of the highest point where it stands [um]; None where it is known only once built."""
        top = self.shape_top
        return None if top is None or self.is_tilted else top * self.scale + self.translate_um[2]

    @property
    def shape_size(self) -> float:
        """Side of the square flat around the shape [um]; infinity where only a file tells."""
        return math.inf


def rotation_matrix(angles_deg: tuple[float, float, float]) -> np.ndarray:
    """Return the matrix of rotations about the fixed x, then y, then z axis [3, 3]."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(angles_deg)), np.sin(np.radians(angles_deg))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ about_y @ about_x
