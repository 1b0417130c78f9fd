"""A scene: instrument, sample and scan, checked for consistency. Frames and units: docs/conventions.md.

A scene file has further tables, see `helio_jax.workflows.scene_file.SceneFile`.
"""

import math
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from helio_jax.detector import Aperture, Cone, axis_frame
from helio_jax.errors import SceneError
from helio_jax.instrument import Instrument
from helio_jax.scene.body import COSINE, Body
from helio_jax.scene.plates import check_solid, read_plate
from helio_jax.scene.rays import read_rays
from helio_jax.scene.rough import RoughSample
from helio_jax.scene.sample import Sample
from helio_jax.scene.scan import AnyScan, PositionList, with_scan_kind
from helio_jax.scene.scattering import Law, Term
from helio_jax.scene.views import View, views_of

MIN_POINTS_PER_PIXEL = 4.0
"""A coarser rough surface could be represented exactly by a fit on the pixel grid, which is no honest test."""
_MAX_DISTANCE = 1e7  # as plate.sample_distance_um


class Scene(Instrument):
    """An instrument with a sample and a scan: `[beam] [plate] [[detector]] [sample] [material.NAME] [scan]`."""

    name: str = Field(default="scene", min_length=1, max_length=200)
    """Short name, shown in figures and files; default: of a scene file, its name without .toml."""
    description: str = Field(default="", max_length=10_000)
    """Description of the scene and the sources of its numbers."""
    sample: Sample
    """The sample."""
    scan: AnyScan
    """The beam positions."""
    material: dict[str, Law] = Field(default={}, max_length=1000)
    """Scattering laws by the names of the sample's materials."""
    _base_dir: Path = PrivateAttr(default_factory=Path)

    @model_validator(mode="before")
    @classmethod
    def _names_the_scan(cls, tables: Any) -> Any:
        return with_scan_kind(tables)

    @model_validator(mode="after")
    def _fits_together(self) -> "Scene":
        if problems := self._problems():
            raise ValueError("\n".join(problems))
        return self

    def _problems(self) -> list[str]:
        """List inconsistencies, each as "key: error: remedy"."""
        problems = []
        users = dict.fromkeys(self.sample.material_names, "sample: its")
        for name, whose in {self.plate.material or COSINE: "plate.material: its", **users}.items():
            if name != COSINE and name not in self.material:
                known = ", ".join(map(repr, (COSINE, *self.material)))
                problems.append(
                    f"{whose} material {name!r} is unknown, known are {known}: add the table [material.{name}]"
                )
        top = self.sample.top
        if top is not None and top >= self.sample_distance:
            problems.append(f"sample: {_too_high(top, self.sample_distance)}")
        problems += self.scan.view_problems(self.beam)
        if self.instrument.has_several_beams:
            problems.append("detector.beam_deg: an instrument of several scans cannot be simulated: simulate its scans")
        if self.plate.is_mesh and self.scan.rotations_deg and self.scan.rotate == "detectors":
            problems.append(
                "scan.rotate = 'detectors': the detectors of a plate of kind 'mesh' do not rotate without it: rotate "
                "the sample the other way instead (scan.rotate = 'sample')"
            )
        if self.sample.place != "as-given" and self.scan.sample_distances_um:
            problems.append("scan.sample_distances_um: sets what sample.place sets: remove one of the keys")
        if (problem := self.scan.problem(self.beam)) is not None:
            problems.append(f"scan.pitch: {problem}")
        elif not isinstance(self.scan, PositionList) and not self._overlaps_substrate():
            problems.append(
                f"scan.center_um: the raster about {list(self.scan.center_um)} um lies wholly beside the sample, whose "
                f"substrate ends {0.5 * self.substrate_size:g} um from {list(self.sample.translate_um[:2])} um: move "
                "scan.center_um or enlarge sample.size_um"
            )
        return problems

    def _in_short(self) -> str:
        ny, nx = self.image_shape
        return f"{self.name!r}: {self.sample.kind}, {nx} x {ny} pixels, {len(self.detector)} detectors"

    @property
    def instrument(self) -> Instrument:
        """Beam, plate, detectors and their uncertainty, as a micrograph stack carries them."""
        return Instrument(**{name: getattr(self, name) for name in Instrument.model_fields})

    @property
    def base_dir(self) -> Path:
        """Folder of relative file names."""
        return self._base_dir

    def with_base_dir(self, base_dir: Path) -> Self:
        """Return a copy whose relative file names start at `base_dir`."""
        copy = self.model_copy()
        copy._base_dir = Path(base_dir)
        return copy

    @property
    def substrate_size(self) -> float:
        """Side of the substrate around the sample [um]; infinity if a file defines it or the sample is tilted."""
        return math.inf if self.sample.is_tilted else self.sample.shape_size * self.sample.scale

    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute the beam positions x [x] and y [y], um (of a list: see `PositionList.positions`)."""
        return self.scan.positions(self.beam, self.base_dir)

    def points(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the beam positions x, y of pixels [n], numbered row by row, um."""
        return self.scan.points(self.beam, ids, self.base_dir)

    @property
    def image_shape(self) -> tuple[int, int]:
        """Rows and columns of the images."""
        x, y = self.positions()
        return y.size, x.size

    def views(self) -> tuple[View, ...]:
        """Construct the views of the scan: one, unless it is repeated at several distances or rotations."""
        return views_of(self.scan, self.instrument)

    def build_body(self) -> Body:
        """Read and build the sample's geometry (sample frame, um).

        Raises:
            InputFileError: the sample's file is missing or wrong.
            SceneError: the sample touches the plate, or is not placed as its key `place` states.
        """
        body = self.sample.build(self.base_dir)
        if body.max_height >= self.sample_distance:
            raise SceneError(f"sample: {_too_high(body.max_height, self.sample_distance)}")
        gap = self.sample_distance - body.max_height
        if self.sample.place != "as-given" and not math.isclose(gap, self.working_distance, rel_tol=1e-9):
            raise SceneError(
                f"sample.place = {self.sample.place!r} requires its top {self.working_distance:g} um below the plate, "
                f"plate.sample_distance_um = {self.sample_distance:g} puts it {gap:g} um below: remove one of the keys"
            )
        return body

    def with_sample_distance(self) -> Self:
        """Return the scene with the plate's sample distance computed from `sample.place`, if it is not given.

        Raises:
            InputFileError: the sample's file is missing or wrong.
        """
        if self.sample.place == "as-given" or self.plate.sample_distance_um is not None:
            return self
        distance = self.working_distance + self.sample.build(self.base_dir).max_height
        if not 0.0 < distance <= _MAX_DISTANCE:
            raise SceneError(
                f"sample.place = {self.sample.place!r}: the plane z = 0 would be {distance:g} um below the plate, it "
                f"must be 0 to {_MAX_DISTANCE:g}: correct sample.translate_um or sample.scale"
            )
        return self.model_copy(update={"plate": self.plate.model_copy(update={"sample_distance_um": distance})})

    @property
    def used_materials(self) -> dict[str, Law]:
        """Scattering laws of the materials that sample and plate use, by name, except the default one."""
        return {name: law for name, (law, _) in self._used_laws().items()}

    def read_laws(self) -> dict[str, tuple[Term, ...]]:
        """Resolve the scattering laws of the materials that sample and plate use, and read their files.

        Raises:
            InputFileError: the table of a law, or a file of the sample that defines laws, is missing or wrong.
        """
        return {name: law.terms(folder) for name, (law, folder) in self._used_laws().items()}

    def _used_laws(self) -> dict[str, tuple[Law, Path]]:
        """Return the laws in use and the folders of their relative file names, by the materials' names."""
        names = {*self.sample.material_names, self.plate.material}
        out = {name: (law, self.base_dir) for name, law in self.material.items() if name in names}
        for name, found in self.sample.file_laws(self.base_dir).items():
            own = self.material.get(found.name)
            out[name] = (found.law, found.folder) if own is None else (own, self.base_dir)
        return out

    def read_rays(self) -> np.ndarray | None:
        """Read the beam's rays (see `scene.rays`); None: no file of rays."""
        return None if self.beam.file is None else read_rays(self.base_dir / self.beam.file)

    def read_plate(self) -> Body | None:
        """Read the plate's mesh (see `scene.plates`); None: a flat plate."""
        return read_plate(self.plate, self.detector, self.base_dir) if self.plate.is_mesh else None

    def warnings(self) -> list[str]:
        """List probable mistakes, for `helio validate`."""
        out = []
        pinhole, openings, w = self.pinhole_center[:2], self.openings(), self.working_distance
        for detector, opening in zip(self.detector, openings, strict=True):
            if isinstance(opening, Aperture) and aperture_contains(opening, pinhole[None])[0]:
                out.append(
                    f"detector {detector.name!r}: its aperture contains the pinhole at {pinhole.round(1).tolist()} um"
                )
        for i, first in enumerate(openings):
            for j, second in enumerate(openings[:i]):
                if first is None or second is None or self.plate.is_mesh:
                    continue
                if _catches(first, _sights(second, w), w).any() or _catches(second, _sights(first, w), w).any():
                    names = self.detector_names
                    out.append(f"detectors {names[j]!r} and {names[i]!r} overlap: atoms there count for {names[j]!r}")
        reach = max(float(np.abs(a).max()) for a in self._positions_on_substrate())
        if reach > 0.5 * self.substrate_size:
            out.append(
                f"the raster reaches {reach:g} um from the centre of the substrate, which ends at "
                f"{0.5 * self.substrate_size:g} um: its border misses the sample"
            )
        if isinstance(self.sample, RoughSample) and (step := self.sample.step * self.sample.scale) > (
            coarsest := (self.scan.spacing or math.inf) / MIN_POINTS_PER_PIXEL
        ):
            out.append(
                f"the rough surface has a point every {step:g} um, too coarse to test a fit on this raster: set "
                f"sample.resolution_um to at most {coarsest:g} um"
            )
        if (plate := self.read_plate()) is not None and not check_solid(plate)["is_watertight"]:
            out.append(
                f"{self.plate.file}: the plate is not closed: atoms that enter its solid are lost; parts that no "
                "detector names belong to the plate (such as a channel's end) unless plate.part names the plate"
            )
        return out + self._plate_warnings(openings) + self.sample.warnings(self.base_dir)

    def _plate_warnings(self, openings: tuple[Aperture | Cone | None, ...]) -> list[str]:
        """List probable mistakes in a scattering plate's outline."""
        if self.plate.kind != "scattering":
            return []
        out = []
        center, half = (np.array(pair) for pair in self.plate.outline)
        rims = {
            f"detector {d.name!r}: its aperture": a.rim(64)[0]
            for d, a in zip(self.detector, openings, strict=True)
            if isinstance(a, Aperture)
        }
        for what, points in {**rims, "the pinhole": self.pinhole_center[None, :2]}.items():
            relative = np.abs(points - center) / half
            reach = np.hypot(*relative.T) if self.plate.radius_um is not None else relative.max(1)
            if reach.max() > 1.0:
                out.append(f"{what} reaches beyond the plate's outline: there is no plate around it")
        if (end := (np.abs(center) + half).max()) > 0.5 * self.substrate_size:
            out.append(
                f"the plate reaches {end:g} um, the substrate ends at {0.5 * self.substrate_size:g} um: "
                "atoms that the plate scatters beside the substrate are lost"
            )
        return out

    def _positions_on_substrate(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute the beam positions relative to the centre of the substrate [um]."""
        is_list = isinstance(self.scan, PositionList)
        x, y = self.points(np.arange(self.image_shape[1])) if is_list else self.positions()
        return x - self.sample.translate_um[0], y - self.sample.translate_um[1]

    def _overlaps_substrate(self) -> bool:
        """Whether any beam position can lie on the substrate, for any rotation of it."""
        nearest = math.hypot(*(max(0.0, float(a.min()), -float(a.max())) for a in self._positions_on_substrate()))
        return nearest <= 0.5 * math.sqrt(2.0) * self.substrate_size


def aperture_contains(aperture: Aperture, points: np.ndarray) -> np.ndarray:
    """Test which points (x, y) on the plate lie inside an aperture [n]."""
    c, s = math.cos(aperture.rotation), math.sin(aperture.rotation)
    d = points - np.asarray(aperture.center)
    u, v = c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]
    return (u / aperture.semi_axes[0]) ** 2 + (v / aperture.semi_axes[1]) ** 2 <= 1.0


def _catches(opening: Aperture | Cone, sights: np.ndarray, distance: float) -> np.ndarray:
    """Test which directions [n, 3] from the nominal spot, `distance` um below the plate, a detector covers [n]."""
    if isinstance(opening, Cone):
        return sights @ np.asarray(opening.axis) >= math.cos(opening.half_angle)
    up = sights[:, 2] > 0.0
    out = np.zeros(len(sights), bool)
    out[up] = aperture_contains(opening, distance * sights[up, :2] / sights[up, 2:])
    return out


def _sights(opening: Aperture | Cone, distance: float) -> np.ndarray:
    """Compute unit directions from the nominal spot to a detector's rim and centre [n, 3]."""
    if isinstance(opening, Aperture):
        plane = np.concatenate([opening.rim(256)[0], np.array([opening.center])])
        sights = np.column_stack([plane, np.full(len(plane), distance)])
        return sights / np.linalg.norm(sights, axis=1, keepdims=True)
    first, second, axis = axis_frame(np.asarray(opening.axis))
    angle = 2.0 * np.pi * np.arange(256)[:, None] / 256
    side = np.cos(angle) * first + np.sin(angle) * second
    return np.concatenate([math.cos(opening.half_angle) * axis + math.sin(opening.half_angle) * side, axis[None]])


def _too_high(top: float, distance: float) -> str:
    """Format the message for a sample that would touch the plate."""
    return (
        f"the sample's top at {top:g} um must be below the plate, which is {distance:g} um above the substrate: "
        "increase plate.sample_distance_um or lower the sample"
    )
