"""Samples given by heights: a height map from a file or from Python, or a reconstruction written by helio.

Models of the `[sample]` table. Both become triangulated sheets (surfaces.py).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr

from helio_jax.arrays import fill_gaps
from helio_jax.errors import InputFileError
from helio_jax.heightmap import HeightMap
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene import surfaces
from helio_jax.scene.body import Body
from helio_jax.scene.files import read_height_map
from helio_jax.scene.shapes import Length, MaterialSample
from helio_jax.settings import UNITS_UM, Unit

MAX_MAP_POINTS = 5_000_000
"""Largest number of points of a map; each makes two triangles."""


class MapSample(MaterialSample):
    """Base of samples given by heights: an optional substrate around the map."""

    file: str = Field(min_length=1, max_length=4096)
    """File name, relative to the scene file."""
    size_um: Length | None = None
    """Side of a substrate around the map; default: none [um]."""
    level_um: float | None = None
    """Height of that substrate; default: the median height of the map's border [um]."""

    def _triangulate(
        self, x: np.ndarray, y: np.ndarray, height: np.ndarray, beam_shift: tuple[float, float] = (0.0, 0.0)
    ) -> Body:
        """Triangulate heights [y, x] and join the border to the substrate along the beam."""
        if height.size > MAX_MAP_POINTS:
            raise InputFileError(
                f"{self.file}: the map has {height.size} points, the limit is {MAX_MAP_POINTS}: resample it"
            )
        reach = None if self.size_um is None else 0.5 * self.size_um
        body = surfaces.surface_body(x, y, height, reach, level=self.level_um, beam_shift=beam_shift)
        return body.with_material(self.material)


class HeightMapSample(MapSample):
    """A height map from a file (.npz with x, y, height; .csv, .txt, .tsv: a grid), or from Python: `of`."""

    kind: Literal["height_map"] = "height_map"
    pixel_size_um: Length | None = None
    """Grid pitch of a text file, whose rows start at the lowest y; the grid is then centred [um]."""
    unit: Unit = "um"
    """Unit of the lengths in the file (of the heights alone for a text file)."""
    _map: HeightMap | None = PrivateAttr(None)

    @classmethod
    def of(cls, height_map: HeightMap, size_um: float | None = None) -> "HeightMapSample":
        """Make a sample of a height map in memory; `file` then holds the hash of its data."""
        import hashlib

        digest = hashlib.sha256(b"".join(a.tobytes() for a in (height_map.x, height_map.y, height_map.height)))
        sample = cls(file=f"memory:{digest.hexdigest()[:32]}", size_um=size_um)
        sample._map = height_map
        return sample

    @property
    def shape_top(self) -> float | None:
        """Height of the highest point; None for a file [um]."""
        return None if self._map is None else float(np.max(self._map.height))

    def build_shape(self, base_dir: Path = Path()) -> Body:
        """Read the file, if any, and triangulate it.

        Raises:
            InputFileError: the file is missing, of an unknown kind or holds no complete height map.
        """
        height_map = self._map
        if height_map is None and self.file.startswith("memory:"):
            raise InputFileError(
                f"sample.file = {self.file!r}: this height map exists in Python only: save it as .npz and name the file"
            )
        if height_map is None:
            height_map = read_height_map(base_dir / self.file, UNITS_UM[self.unit], self.pixel_size_um)
        if not np.all(np.isfinite(height_map.height)):
            raise InputFileError(
                f"{self.file}: a sample's heights must be finite, got {int(np.sum(~np.isfinite(height_map.height)))} "
                "gaps: fill them first"
            )
        return self._triangulate(*np.meshgrid(height_map.x, height_map.y), height_map.height)


class ReconstructionSample(MapSample):
    """A height map written by `helio reconstruct` (.h5): every pixel at the x, y of its surface point.

    Regions that are shadowed in that scan are closed by a sheet along its beam.
    """

    kind: Literal["reconstruction"] = "reconstruction"
    use: Literal["all", "valid"] = "all"
    """`all`: all heights; `valid`: pixels that are not marked valid are gaps."""
    gaps: Literal["refuse", "fill"] = "refuse"
    """Treatment of pixels without a height: `fill` interpolates linearly."""
    _read: Callable[[Path], Reconstruction] | None = PrivateAttr(None)

    def model_post_init(self, context: Any) -> None:
        """Take the file reader from the scene loader, for scene/ may not import formats/."""
        if context and "read_reconstruction" in context:
            self._read = context["read_reconstruction"]

    def build_shape(self, base_dir: Path = Path()) -> Body:
        """Read the file, fill its gaps and triangulate it.

        Raises:
            InputFileError: the file is missing, is no reconstruction, or has gaps that are not to be filled.
        """
        if self._read is None:
            raise InputFileError(
                f"sample.file = {self.file!r}: a reconstruction can only be read by a scene that load_scene has read"
            )
        rec = self._read(base_dir / self.file)
        height = self._without_gaps(rec)
        x, y = rec.instrument.surface_position(*np.meshgrid(rec.raster_x, rec.raster_y), height)
        return self._triangulate(x, y, height, rec.instrument.beam_shift)

    def _without_gaps(self, rec: Reconstruction) -> np.ndarray:
        """Return the heights [y, x] with gaps filled."""
        has_height = np.isfinite(rec.height) & (rec.is_valid | (self.use == "all"))
        n_gaps = int(np.sum(~has_height))
        if n_gaps and self.gaps == "refuse":
            raise InputFileError(
                f"{self.file}: {n_gaps} of {has_height.size} pixels have no {'valid ' * (self.use == 'valid')}height: "
                'set sample.gaps = "fill" to interpolate them'
            )
        if n_gaps > has_height.size - 4:
            raise InputFileError(
                f"{self.file}: only {has_height.size - n_gaps} pixels have a height, at least 4 are needed to fill gaps"
            )
        return fill_gaps(rec.height, has_height) if n_gaps else rec.height
