"""A scene: instrument, sample and raster, checked against each other. What `simulate` needs and nothing else.

Frames and units: DESIGN.md section 1. A scene file has further tables; `helio_jax.config.SceneFile` adds them.
"""

import math
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from helio_jax.errors import SceneError
from helio_jax.instrument import Aperture, Instrument
from helio_jax.scene.body import COSINE, Body
from helio_jax.scene.rays import read_rays
from helio_jax.scene.sample import HeightMapSample, MeshSample, Sample, SeveralSamples
from helio_jax.scene.scan import Raster
from helio_jax.scene.scattering import Law, Term


class Scene(Instrument):
    """An instrument with a sample and a raster: `[beam] [plate] [[detector]] [sample] [material.NAME] [scan]`."""

    name: str = Field(default="scene", min_length=1, max_length=200)
    """Short name, shown in figures and files."""
    description: str = Field(default="", max_length=10_000)
    """What the scene is and where its numbers come from."""
    sample: Sample
    """What is imaged."""
    scan: Raster
    """Which beam positions."""
    material: dict[str, Law] = Field(default={}, max_length=1000)
    """Scattering laws by the names that the sample uses for its materials."""
    _base_dir: Path = PrivateAttr(default_factory=Path)

    @model_validator(mode="after")
    def _fits_together(self) -> "Scene":
        if problems := self._problems():
            raise ValueError("\n".join(problems))
        return self

    def _problems(self) -> list[str]:
        """Return what does not fit together, each as "key: what is wrong: what to do"."""
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
        if (problem := self.scan.problem(self.beam)) is not None:
            problems.append(f"scan.pitch: {problem}")
        elif not self._overlaps_flat():
            problems.append(
                f"scan.center_um: the raster about {list(self.scan.center_um)} um lies wholly beside the sample, whose "
                f"flat ends at +-{0.5 * self.flat_size:g} um: move scan.center_um or enlarge sample.size_um"
            )
        return problems

    @property
    def instrument(self) -> Instrument:
        """Beam, plate and detectors alone, as a stack carries them."""
        return Instrument(beam=self.beam, plate=self.plate, detector=self.detector)

    @property
    def base_dir(self) -> Path:
        """Folder at which the sample's relative file names start."""
        return self._base_dir

    def at(self, base_dir: Path) -> Self:
        """Return a copy whose relative file names start at `base_dir`."""
        copy = self.model_copy()
        copy._base_dir = Path(base_dir)
        return copy

    @property
    def flat_size(self) -> float:
        """Side of the flat around the sample's structure; infinity where only a file tells [um]."""
        if isinstance(self.sample, (HeightMapSample, MeshSample, SeveralSamples)):
            return math.inf
        return self.sample.size_um

    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the beam positions x [x] and y [y], um."""
        return self.scan.positions(self.beam)

    def build_body(self) -> Body:
        """Read and build the sample's geometry (sample frame, um).

        Raises:
            InputFileError: the sample's file is missing or wrong.
            SceneError: the sample is too high for the plate.
        """
        body = self.sample.build(self.base_dir)
        if body.max_height >= self.sample_distance:
            raise SceneError(f"sample: {_too_high(body.max_height, self.sample_distance)}")
        return body

    @property
    def used_materials(self) -> dict[str, Law]:
        """Scattering laws of the materials that sample and plate use, by name, but for the default one."""
        names = {*self.sample.material_names, self.plate.material}
        return {name: law for name, law in self.material.items() if name in names}

    def read_laws(self) -> dict[str, tuple[Term, ...]]:
        """Return the scattering laws of the materials that sample and plate use, and read their files.

        Raises:
            InputFileError: the table of a law is missing or wrong.
        """
        return {name: law.terms(self.base_dir) for name, law in self.used_materials.items()}

    def read_rays(self) -> np.ndarray | None:
        """Return position [um], unit direction and weight of the beam's rays [n, 7], where it is made of such.

        Raises:
            InputFileError: the file of the rays is missing or wrong.
        """
        return None if self.beam.file is None else read_rays(self.base_dir / self.beam.file)

    def warnings(self) -> list[str]:
        """Return what is allowed but probably not meant, for `helio validate`."""
        out = []
        pinhole = self.pinhole_center[:2]
        apertures = self.apertures()
        for detector, aperture in zip(self.detector, apertures, strict=True):
            if aperture_contains(aperture, pinhole[None])[0]:
                out.append(
                    f"detector {detector.name!r}: its aperture contains the pinhole at {pinhole.round(1).tolist()} um"
                )
        for i, first in enumerate(apertures):
            for j, second in enumerate(apertures[:i]):
                points = np.concatenate([second.rim(256)[0], np.array([second.center])])
                back = np.concatenate([first.rim(256)[0], np.array([first.center])])
                if aperture_contains(first, points).any() or aperture_contains(second, back).any():
                    names = self.detector_names
                    out.append(f"detectors {names[j]!r} and {names[i]!r} overlap: atoms there count for {names[j]!r}")
        x, y = self.positions()
        reach = max(np.abs(x).max(), np.abs(y).max())
        if reach > 0.5 * self.flat_size:
            out.append(
                f"the raster reaches {reach:g} um, the flat ends at {0.5 * self.flat_size:g} um: its rim misses it"
            )
        return out + self._plate_warnings(apertures)

    def _plate_warnings(self, apertures: tuple[Aperture, ...]) -> list[str]:
        """Return what is probably not meant about a scattering plate's outline."""
        if not self.plate.is_scattering:
            return []
        out = []
        middle, half = (np.array(pair) for pair in self.plate.outline)
        rims = {
            f"detector {d.name!r}: its aperture": a.rim(64)[0] for d, a in zip(self.detector, apertures, strict=True)
        }
        for what, points in {**rims, "the pinhole": self.pinhole_center[None, :2]}.items():
            share = np.abs(points - middle) / half
            reach = np.hypot(*share.T) if self.plate.radius_um is not None else share.max(1)
            if reach.max() > 1.0:
                out.append(f"{what} reaches beyond the plate's outline: there is no plate around it")
        if (end := (np.abs(middle) + half).max()) > 0.5 * self.flat_size:
            out.append(
                f"the plate reaches {end:g} um, the flat ends at {0.5 * self.flat_size:g} um: "
                "atoms that the plate sends down beside the flat are gone"
            )
        return out

    def _overlaps_flat(self) -> bool:
        """Whether any beam position can lie on the flat (whichever way that is turned)."""
        x, y = self.positions()
        nearest = math.hypot(*(max(0.0, float(a.min()), -float(a.max())) for a in (x, y)))
        return nearest <= 0.5 * math.sqrt(2.0) * self.flat_size


def aperture_contains(aperture: Aperture, points: np.ndarray) -> np.ndarray:
    """Return which points (x, y) on the plate lie inside an aperture [n]."""
    c, s = math.cos(aperture.rotation), math.sin(aperture.rotation)
    d = points - np.asarray(aperture.center)
    u, v = c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]
    return (u / aperture.semi_axes[0]) ** 2 + (v / aperture.semi_axes[1]) ** 2 <= 1.0


def _too_high(top: float, distance: float) -> str:
    """Return the message for a sample that would touch the plate."""
    return (
        f"the sample's top at {top:g} um must stay below the plate, which is {distance:g} um above the reference "
        "plane: enlarge plate.sample_distance_um or lower the sample"
    )
