"""Scans: the beam positions of a micrograph. Settings table `[scan]`, selected by `kind`.

A beam position is where the beam axis meets the substrate plane z = 0, sample frame (arrays.py). A scan of any kind may
be repeated at several distances and rotations: its views (views.py).
"""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from helio_jax.errors import InputFileError
from helio_jax.instrument import Beam
from helio_jax.scene.files import read_positions
from helio_jax.settings import Settings

MAX_PIXELS = 4096**2
"""Largest number of pixels of a scan, all views together."""
MAX_VIEWS = 1000
"""Largest number of views of a scan."""


class Scan(Settings):
    """Base of all scans: dose per pixel, and views."""

    atoms_per_pixel: float = Field(default=35_000.0, gt=0.0, le=1e18)
    """Beam atoms per pixel that the counts correspond to (not the number of traced rays)."""
    sample_distances_um: tuple[Annotated[float, Field(gt=0.0, le=1e7)], ...] = Field(default=(), max_length=MAX_VIEWS)
    """z stack: the scan at each of these distances from the plate to the plane z = 0, with unchanged beam positions
    (the sample moves along the beam); default: plate.sample_distance_um [um]."""
    rotations_deg: tuple[Annotated[float, Field(ge=-360.0, le=360.0)], ...] = Field(default=(), max_length=MAX_VIEWS)
    """The scan at each of these rotations, counter-clockwise seen from above [deg]."""
    rotate: Literal["sample", "detectors"] = "sample"
    """What rotates: the sample under the scan, or all detector apertures about the point above the nominal spot."""
    about: Literal["normal", "beam"] = "normal"
    """Axis of rotation: plate normal or beam (oblique beam: the sample only, which then tilts)."""
    axis_um: tuple[float, float] = (0.0, 0.0)
    """Point in the plane z = 0 on the sample's axis of rotation [um]."""

    @property
    def n_views(self) -> int:
        """Number of views."""
        return max(1, len(self.sample_distances_um)) * max(1, len(self.rotations_deg))

    def view_problems(self, beam: Beam) -> list[str]:
        """List errors of the views, each as "key: error: remedy"."""
        out = []
        if self.n_views > MAX_VIEWS:
            out.append(f"scan.rotations_deg: at most {MAX_VIEWS} views, got {self.n_views}: split the scan")
        if self.rotate == "detectors" and self.about == "beam" and beam.incidence_deg > 0:
            out.append(
                f"scan.about: detectors in the plate cannot rotate about a beam at {beam.incidence_deg:g} deg: "
                'set scan.about = "normal" or scan.rotate = "sample"'
            )
        if self.rotate == "detectors" and any(self.axis_um):
            out.append("scan.axis_um: is the axis of a rotating sample: remove it or set scan.rotate")
        return out

    def problem(self, beam: Beam) -> str | None:
        """Return why the positions cannot be combined with `beam`, or None."""
        return None

    def positions(self, beam: Beam, base_dir: Path = Path()) -> tuple[np.ndarray, np.ndarray]:
        """Compute the axes of the scan's images: beam positions x [x] and y [y], um."""
        raise NotImplementedError

    def points(self, beam: Beam, ids: np.ndarray, base_dir: Path = Path()) -> tuple[np.ndarray, np.ndarray]:
        """Compute the beam positions x, y of some pixels [n], numbered row by row, um."""
        x, y = self.positions(beam, base_dir)
        return x[ids % x.size], y[ids // x.size]

    @property
    def spacing(self) -> float | None:
        """Distance of neighbouring pixels across the beam [um], or None."""
        return None


class Raster(Scan):
    """A regular raster, centred on `center_um`; x increases with the column, y with the row."""

    kind: Literal["raster"] = "raster"
    nx: int = Field(ge=1, le=65536)
    """Columns."""
    ny: int = Field(ge=1, le=65536)
    """Rows."""
    pixel_size_um: float = Field(gt=0.0, le=1e5)
    """Distance between neighbouring pixels, see `pitch`; of a column see pixel_size_y_um [um]."""
    pixel_size_y_um: float | None = Field(default=None, gt=0.0, le=1e5)
    """Distance between rows, where it is another one than between columns; default: pixel_size_um [um]."""
    pitch: Literal["beam", "sample"] = "beam"
    """`beam`: pixel size measured across the beam; on the sample it is pixel_size / cos t along the beam's azimuth
    (which must be a multiple of 90 deg); `sample`: equal in x and y on the sample."""
    center_um: tuple[float, float] = (0.0, 0.0)
    """Beam position of the raster's centre [um]."""

    @model_validator(mode="after")
    def _is_small_enough(self) -> "Raster":
        if self.nx * self.ny * self.n_views > MAX_PIXELS:
            times = f" in {self.n_views} views" if self.n_views > 1 else ""
            raise ValueError(
                f"nx * ny must be <= {MAX_PIXELS} pixels, got {self.nx} x {self.ny} = {self.nx * self.ny}{times}: "
                "use a larger pixel_size_um and fewer pixels"
            )
        return self

    def problem(self, beam: Beam) -> str | None:
        if self.pitch == "beam" and beam.incidence_deg > 0 and beam.azimuth_deg % 90 != 0:
            return (
                f"'beam' needs beam.azimuth_deg to be a multiple of 90, got {beam.azimuth_deg:g}: "
                'set scan.pitch = "sample" (equal pitch in x and y on the sample)'
            )
        return None

    def positions(self, beam: Beam, base_dir: Path = Path()) -> tuple[np.ndarray, np.ndarray]:
        stretch = 1.0 / math.cos(math.radians(beam.incidence_deg)) if self.pitch == "beam" else 1.0
        step_x, step_y = self.pixel_size_um, self.pixel_size_y_um or self.pixel_size_um
        if beam.azimuth_deg % 180 != 0:
            step_y *= stretch
        else:
            step_x *= stretch
        x = self.center_um[0] + (np.arange(self.nx) - 0.5 * (self.nx - 1)) * step_x
        y = self.center_um[1] + (np.arange(self.ny) - 0.5 * (self.ny - 1)) * step_y
        return x, y

    @property
    def spacing(self) -> float | None:
        return min(self.pixel_size_um, self.pixel_size_y_um or self.pixel_size_um)


class Line(Scan):
    """Equally spaced points along x or y of the sample, or one point while the sample moves along the beam."""

    kind: Literal["line"] = "line"
    along: Literal["x", "y", "beam"]
    """`x`, `y`: across the sample; `beam`: the sample distance changes at a constant beam position, one view of one
    pixel for each distance."""
    n: int = Field(ge=1, le=65536)
    """Points."""
    step_um: float = Field(gt=0.0, le=1e5)
    """Distance of neighbouring points; along the beam: of neighbouring sample distances [um]."""
    center_um: tuple[float, float] = (0.0, 0.0)
    """Beam position of the line's centre [um]."""

    @model_validator(mode="after")
    def _is_one_line(self) -> "Line":
        if self.along == "beam" and self.sample_distances_um:
            raise ValueError("a line along the beam sets sample_distances_um itself: remove them")
        if self.along == "beam" and self.n_views > MAX_VIEWS:
            raise ValueError(f"n must be <= {MAX_VIEWS} along the beam, got {self.n}: use a larger step_um")
        return self

    @property
    def n_views(self) -> int:
        return super().n_views * (self.n if self.along == "beam" else 1)

    def positions(self, beam: Beam, base_dir: Path = Path()) -> tuple[np.ndarray, np.ndarray]:
        steps = self.steps
        x, y = (np.array([c]) for c in self.center_um)
        return (x + steps, y) if self.along == "x" else (x, y + steps) if self.along == "y" else (x, y)

    @property
    def steps(self) -> np.ndarray:
        """Distances from the centre of the line [n], um."""
        return (np.arange(self.n) - 0.5 * (self.n - 1)) * self.step_um

    @property
    def spacing(self) -> float | None:
        return None if self.along == "beam" else self.step_um


class PositionList(Scan):
    """Any positions, in any order: images of one row whose x is an index; see `MicrographStack.positions`."""

    kind: Literal["list"] = "list"
    file: str | None = Field(default=None, min_length=1, max_length=4096)
    """Text file (.csv) relative to the scene file: x and y in um of one beam position on each line."""
    points_um: tuple[tuple[float, float], ...] = Field(default=(), max_length=100_000)
    """The positions (x, y), instead of a file [um]."""
    _found: tuple[Path, np.ndarray] | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _has_one_source(self) -> "PositionList":
        if (self.file is None) == (not self.points_um):
            raise ValueError("a list needs either file or points_um: give one of them")
        return self

    def read(self, base_dir: Path) -> np.ndarray:
        """Return the positions [n, 2], um; a file is read once.

        Raises:
            InputFileError: the file is missing or does not hold positions.
        """
        if self.file is None:
            return np.array(self.points_um)
        path = (base_dir / self.file).resolve()
        if self._found is None or self._found[0] != path:
            try:
                self._found = path, read_positions(base_dir / self.file)
            except InputFileError as e:
                raise InputFileError(f"scan.file = {self.file!r}: {e}") from None
        return self._found[1]

    def positions(self, beam: Beam, base_dir: Path = Path()) -> tuple[np.ndarray, np.ndarray]:
        """Return the index of every position, and a single 0: the axes of images of one row."""
        return np.arange(len(self.read(base_dir)), dtype=float), np.zeros(1)

    def points(self, beam: Beam, ids: np.ndarray, base_dir: Path = Path()) -> tuple[np.ndarray, np.ndarray]:
        x, y = self.read(base_dir)[ids].T
        return x, y


AnyScan = Annotated[Raster | Line | PositionList, Field(discriminator="kind")]
"""Any scan, selected by `kind`."""


def with_scan_kind(tables: Any) -> Any:
    """Return a scene's tables with scan.kind = "raster" if the key is missing."""
    scan = tables.get("scan") if isinstance(tables, dict) else None
    return {**tables, "scan": {"kind": "raster", **scan}} if isinstance(scan, dict) else tables
