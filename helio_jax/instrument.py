"""The microscope: beam, pinhole plate, detectors and the geometry derived from them.

Every micrograph stack carries its instrument, so that it can be reconstructed without its scene. Lab frame: z up from
sample to plate, origin on the beam axis at the design working distance W below the plate (the nominal spot). Sample
frame: same axes, z = 0 on the substrate, which is the sample distance D below the plate. See docs/conventions.md.
"""

import math
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from helio_jax.arrays import check_correlation
from helio_jax.campaign import CampaignLaw, CampaignReadout
from helio_jax.detector import Aperture, Cone, Detector
from helio_jax.drawable import Drawable
from helio_jax.errors import SceneError
from helio_jax.settings import Settings, Unit

MAX_DETECTORS = 64
"""Most detectors of an instrument, those of joined scans in all."""
POLAR_STD_DEG = 5.0
"""Prior standard deviation of the apertures' polar angles where rotated scans calibrate the instrument and its file
states none: they see the sample from somewhere between its base and its top [deg]."""


def _beam_shift(incidence_deg: float, azimuth_deg: float) -> tuple[float, float]:
    t, phi = math.radians(incidence_deg), math.radians(azimuth_deg)
    return math.tan(t) * math.cos(phi), math.tan(t) * math.sin(phi)


class Effusive(Settings):
    """Effusive beam: atoms that leave the pinhole with a cos^n distribution about the plate normal."""

    exponent: float = Field(default=1.0, ge=0.0, le=1000.0)
    """n of cos^n per steradian; 1: a thin orifice."""
    atoms_per_pixel: float = Field(gt=0.0, le=1e18)
    """Effusive atoms per pixel that the counts `effuse` correspond to (as scan.atoms_per_pixel for the beam)."""
    rays: int = Field(default=64, ge=8, le=10_000_000)
    """Effusive rays per pixel; with the estimator `analog` the counts are those of this number of atoms."""


class Beam(Settings):
    """The incident helium beam."""

    incidence_deg: float = Field(default=0.0, ge=0.0, le=80.0)
    """Angle t between the beam and the plate normal [deg]."""
    azimuth_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Direction in which the beam travels across the sample, counter-clockwise from +x seen from above [deg]."""
    pinhole_radius_um: float = Field(default=1.0, ge=0.0, le=1000.0)
    """Radius of the pinhole disc, which lies in the plate plane [um]."""
    source: Literal["uniform", "gaussian", "pencil", "rays"] = "uniform"
    """Angular distribution about the beam axis; `pencil` is parallel; `rays`: positions and directions from a file."""
    source_size_mrad: float = Field(default=0.5, ge=0.0, le=500.0)
    """`uniform`: largest polar angle; `gaussian`: standard deviation per axis; otherwise ignored [mrad]."""
    file: str | None = Field(default=None, min_length=1, max_length=4096)
    """`rays`: file of rays (.csv, .npy, .npz), relative to the scene file: position (x, y, z) relative to the pinhole's
    centre in um, direction (x, y, z) and optional weight of every ray; lab axes, z up to the plate's outer side."""
    effusive: Effusive | None = None
    """Effusive beam, traced separately and stored separately from the counts; default: none."""

    @model_validator(mode="after")
    def _has_a_file_for_rays(self) -> "Beam":
        if (self.file is None) == (self.source == "rays"):
            wrong = (
                "source = 'rays' needs a file: add the key" if self.file is None else "only source = 'rays' reads it"
            )
            raise ValueError(f"file: {wrong}")
        return self


class Plate(Settings):
    """The pinhole plate, which holds the pinhole and the detector apertures."""

    kind: Literal["transparent", "scattering", "mesh"] = "transparent"
    """`transparent`: atoms that miss every aperture are lost; `scattering`: its underside scatters by the law of its
    material, apertures and pinhole are holes; `mesh`: a solid from a file, with channels, that scatters by the law of
    its material (trace.estimator = "analog" only)."""
    working_distance_um: float = Field(gt=0.0, le=1e7)
    """Design working distance W: distance below the plate at which the apertures are aimed [um]."""
    sample_distance_um: float | None = Field(default=None, gt=0.0, le=1e7)
    """Distance D from the plate to the substrate (the sample's plane z = 0); default W [um]."""
    radius_um: float | None = Field(default=None, gt=0.0, le=1e8)
    """`scattering`: radius of a disc-shaped plate [um]."""
    size_um: tuple[float, float] | None = None
    """`scattering`: full sides of a rectangular plate along x and y, instead of a radius [um]."""
    center_um: tuple[float, float] | None = None
    """`scattering`: centre (x, y) of the plate, lab frame (default: above the nominal spot) [um]."""
    material: str | None = Field(default=None, min_length=1, max_length=64)
    """`scattering`, `mesh`: name of its material (default: the cosine law)."""
    file: str | None = Field(default=None, min_length=1, max_length=4096)
    """`mesh`: STL, OBJ, PLY or GLB file, relative to the scene file. Its x, y are those of the lab frame (0, 0: above
    the nominal spot), z = 0 is the plane of the pinhole, the whole plate lies at z >= 0; it moves with the beam."""
    unit: Unit | None = None
    """`mesh`: unit of the file's coordinates."""
    part: str | None = Field(default=None, min_length=1, max_length=200)
    """`mesh`: part of the file that is the plate (see detector.part); parts that no detector names are ignored
    (default: all parts that no detector names are the plate)."""
    rotate_deg: tuple[float, float, float] | None = None
    """`mesh`: rotations about the fixed x, then y, then z axis (default: none) [deg]."""
    translate_um: tuple[float, float, float] | None = None
    """`mesh`: shift after rotation (default: none) [um]."""

    @model_validator(mode="after")
    def _has_the_keys_of_its_kind(self) -> "Plate":
        own = {
            "scattering": ("radius_um", "size_um", "center_um", "material"),
            "mesh": ("file", "unit", "part", "rotate_deg", "translate_um", "material"),
        }
        names = dict.fromkeys(name for keys in own.values() for name in keys)
        given = [name for name in names if getattr(self, name) is not None]
        stray = [name for name in given if name not in own.get(self.kind, ())]
        if stray:
            kinds = " or ".join(f'"{kind}"' for kind, keys in own.items() if stray[0] in keys)
            raise ValueError(f"a {self.kind} plate has no {stray[0]}: set kind = {kinds} or remove the key")
        if self.kind == "mesh" and (missing := [name for name in ("file", "unit") if name not in given]):
            raise ValueError(f'a plate of kind "mesh" needs {" and ".join(missing)}: add the key')
        if self.kind == "scattering" and (self.radius_um is None) == (self.size_um is None):
            raise ValueError(
                "a scattering plate needs its outline, either radius_um (a disc) or size_um = [x, y] (a rectangle), "
                f"got {'both' if self.size_um else 'neither'}"
            )
        if self.size_um is not None and not 0.0 < min(self.size_um) <= max(self.size_um) <= 1e8:
            raise ValueError(f"size_um must be > 0 um and <= 1e8 um, got {list(self.size_um)}")
        return self

    @property
    def is_scattering(self) -> bool:
        """Whether the plate scatters atoms back."""
        return self.kind != "transparent"

    @property
    def is_mesh(self) -> bool:
        """Whether the plate is a solid from a file."""
        return self.kind == "mesh"

    @property
    def outline(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Centre (x, y) and half extents of a flat scattering plate, lab frame [um]."""
        a, b = self.size_um if self.size_um is not None else (2.0 * (self.radius_um or 0.0),) * 2
        return self.center_um or (0.0, 0.0), (0.5 * a, 0.5 * b)


class Uncertainty(Settings):
    """Prior standard deviations of the geometry, and of what the model lacks, in a fit; 0: known exactly."""

    sample_distance_um: float = Field(default=0.0, ge=0.0, le=1e5)
    """Of the distance from the plate to the substrate [um]."""
    tilt_deg: float = Field(default=0.0, ge=0.0, le=10.0)
    """Of the substrate's tilt relative to the plate, about each of x and y [deg]."""
    polar_deg: float = Field(default=0.0, ge=0.0, le=30.0)
    """Of the polar angle of each aperture's centre, seen from the nominal spot [deg]."""
    azimuth_deg: float = Field(default=0.0, ge=0.0, le=30.0)
    """Of the azimuth of each aperture about the nominal spot [deg]."""
    plate_shift_um: float = Field(default=0.0, ge=0.0, le=1e5)
    """Of the shift of the plate with all its apertures against the beam, along each of x and y; used by `helio
    calibrate --known`, as the next two [um]."""
    plate_scale: float = Field(default=0.0, ge=0.0, le=1.0)
    """Of the scale of the plate's plane, relative."""
    plate_rotation_deg: float = Field(default=0.0, ge=0.0, le=45.0)
    """Of the plate's rotation about its normal [deg]."""
    incidence_deg: float = Field(default=0.0, ge=0.0, le=20.0)
    """Of the beam's incidence: fitted by `helio calibrate --known`; elsewhere taken as stated, and its effect added to
    the error bars of heights, by `refine` only for scans of one beam [deg]."""
    discrepancy: float = Field(default=0.0, ge=0.0, le=1.0)
    """Of what the model lacks, such as the law of the scattering or the shape of the apertures: an error that varies
    slowly over each detector's image, over its median signal; measured by `helio calibrate --known`."""

    @property
    def is_stated(self) -> bool:
        """Whether anything is uncertain."""
        return any(self.model_dump().values())


class Covariance(Settings):
    """How the errors of a calibrated geometry belong together: table `[covariance]` of an instrument file.

    Written by `helio calibrate --known`; its parameters move the whole plate as `Optics.moved` does. Reconstructions
    take their prior of distance and directions from it (`GeometryPrior`).
    """

    parameters: tuple[str, ...] = Field(min_length=1, max_length=300)
    """Names of the parameters."""
    units: tuple[Literal["um", "deg", ""], ...]
    """Unit of each parameter; "": a ratio."""
    std: tuple[float, ...]
    """Standard deviation of each parameter, in its unit."""
    correlation: tuple[tuple[float, ...], ...]
    """Correlation matrix."""

    @model_validator(mode="after")
    def _is_a_covariance(self) -> "Covariance":
        n = len(self.parameters)
        if len(self.units) != n:
            raise ValueError(f"units must be of {n} parameters, got {len(self.units)}: calibrate anew")
        check_correlation(n, self.std, self.correlation)
        return self

    def matrix(self) -> np.ndarray:
        """Compute the covariance [parameter, parameter], in the parameters' units."""
        return np.array(self.correlation) * np.outer(self.std, self.std)


class Instrument(Drawable, Settings):
    """Beam, plate and detectors of one scan, and the geometry derived from them (um, radians).

    Example:
        >>> hx.load_instrument("bshem_wd4").detector_names
    """

    beam: Beam = Beam()
    plate: Plate
    uncertainty: Uncertainty = Uncertainty()
    covariance: Covariance | None = None
    readout: CampaignReadout | None = None
    law: CampaignLaw | None = None
    detector: tuple[Detector, ...] = Field(min_length=1, max_length=MAX_DETECTORS)

    @model_validator(mode="after")
    def _has_distinct_names(self) -> "Instrument":
        names = [d.name for d in self.detector]
        if len(set(names)) != len(names):
            raise ValueError(f"detector names must differ, got {names}: rename one of them")
        return self

    @model_validator(mode="after")
    def _has_a_plate_for_its_detectors(self) -> "Instrument":
        far = [d.name for d in self.detector if d.at_infinity]
        if far and self.plate.kind == "scattering":
            raise ValueError(
                f"detector {far[0]!r} is at infinity, which a flat scattering plate hides: set plate.kind = "
                "'transparent' (without size and material), or remove at_infinity"
            )
        if self.plate.part is not None and self.plate.part in [d.part for d in self.detector]:
            raise ValueError(f"plate.part = {self.plate.part!r} is a detector's part, too: name different parts")
        behind = [d.name for d in self.detector if d.needs_mesh]
        if behind and not self.plate.is_mesh:
            raise ValueError(
                f"detector {behind[0]!r} has part or height_um, which only a plate of kind 'mesh' has: set "
                "plate.kind = 'mesh' with its file, or remove the key"
            )
        return self

    def _in_short(self) -> str:
        names = ", ".join(self.detector_names[:4]) + (", ..." if len(self.detector) > 4 else "")
        return f"{len(self.detector)} detectors ({names}), incidence {self.beam.incidence_deg:g} deg"

    def idealised(self) -> "Instrument":
        """Return the instrument with a parallel beam and a cosine-law plate, which need no file or material."""
        beam = self.beam.model_copy(update={"source": "pencil", "file": None, "effusive": None})
        return self.model_copy(update={"beam": beam, "plate": self.plate.model_copy(update={"material": None})})

    @property
    def working_distance(self) -> float:
        """Design working distance W [um]."""
        return self.plate.working_distance_um

    @property
    def sample_distance(self) -> float:
        """Distance D from the plate to the sample's plane z = 0 [um]."""
        d = self.plate.sample_distance_um
        return self.plate.working_distance_um if d is None else d

    @property
    def polar_std_deg(self) -> float:
        """Prior standard deviation of the polar angles for a calibration: the stated one, else `POLAR_STD_DEG`."""
        return self.uncertainty.polar_deg or POLAR_STD_DEG

    @property
    def detector_names(self) -> tuple[str, ...]:
        """Names of the detectors, in array order."""
        return tuple(d.name for d in self.detector)

    @property
    def beam_shift(self) -> tuple[float, float]:
        """Lateral displacement (x, y) of the beam axis per um of depth: tan t (cos phi, sin phi)."""
        return _beam_shift(self.beam.incidence_deg, self.beam.azimuth_deg)

    @property
    def beam_shifts(self) -> np.ndarray:
        """`beam_shift` of the scan of every detector [detector, 2]; they differ where a stack joins several beams."""
        return np.array([_beam_shift(*d.beam_deg) if d.beam_deg else self.beam_shift for d in self.detector])

    @property
    def has_several_beams(self) -> bool:
        """Whether a detector's scan was taken by another beam than [beam], along which the raster sees the sample."""
        return any(d.beam_deg is not None for d in self.detector)

    def by_beam(self) -> tuple[tuple["Instrument", tuple[int, ...]], ...]:
        """Split into instruments of one beam each, without [covariance], with the indices of their detectors."""
        if not self.has_several_beams:
            return ((self, tuple(range(len(self.detector)))),)
        default = self.beam.incidence_deg, self.beam.azimuth_deg
        members: dict[tuple[float, float], list[int]] = {}
        for k, d in enumerate(self.detector):
            members.setdefault(d.beam_deg or default, []).append(k)
        out = []
        for (incidence, azimuth), of_beam in members.items():
            beam = self.beam.changed(incidence_deg=incidence, azimuth_deg=azimuth)
            detectors = tuple(self.detector[k].model_copy(update={"beam_deg": None}) for k in of_beam)
            update = {"beam": beam, "detector": detectors, "readout": None, "covariance": None}
            out.append((self.model_copy(update=update), tuple(of_beam)))
        return tuple(out)

    @property
    def beam_direction(self) -> np.ndarray:
        """Unit vector u of the beam axis, lab frame [3]."""
        t, phi = math.radians(self.beam.incidence_deg), math.radians(self.beam.azimuth_deg)
        return np.array([math.sin(t) * math.cos(phi), math.sin(t) * math.sin(phi), -math.cos(t)])

    @property
    def pinhole_center(self) -> np.ndarray:
        """Centre of the pinhole, lab frame [3, um]."""
        tx, ty = self.beam_shift
        w = self.working_distance
        return np.array([-w * tx, -w * ty, w])

    def openings(self) -> tuple[Aperture | Cone | None, ...]:
        """Return the ellipse or cone of every detector, in array order; None: a part of the plate's mesh."""
        return tuple(d.opening(self.working_distance) for d in self.detector)

    def apertures(self) -> tuple[Aperture, ...]:
        """Return the ellipse of every detector, in array order.

        Raises:
            SceneError: a detector is at infinity, or the plate is a mesh.
        """
        openings = self.openings()
        out = tuple(o for o in openings if isinstance(o, Aperture))
        if len(out) == len(openings) and not self.plate.is_mesh:
            return out
        far = [d.name for d in self.detector if d.at_infinity]
        raise SceneError(
            (f"detector {far[0]!r} is at infinity" if far else "plate.kind = 'mesh'")
            + ": that can be simulated only; heights, calibration, alignment and files in the reference's layout need "
            "apertures in a flat plate: give every detector center_um and axes_um"
            + ("" if not self.plate.is_mesh else " and set plate.kind = 'scattering' or 'transparent'")
        )

    def moved(
        self,
        aim: np.ndarray,
        distance: float,
        *,
        plate_shift: tuple[float, float] = (0.0, 0.0),
        scale: float = 1.0,
        rotation: float = 0.0,
        incidence: float = 0.0,
    ) -> "Instrument":
        """Return the instrument with changed aperture angles, plate, sample distance and incidence, without covariance.

        Each aperture is shifted along its azimuth by the change of polar angle of its centre, seen from the nominal
        spot, and rotated about the plate normal through that spot by the change of azimuth; then the plate moves as one
        rigid piece, as by `Optics.moved`.

        Args:
            aim: changes of polar angle and azimuth [detector, 2], rad.
            distance: change of the sample distance, um.
            plate_shift: shift of the plate in its plane, against the beam (x, y), um.
            scale: factor of all lengths in the plate's plane.
            rotation: of the plate about its normal, counter-clockwise seen from above, rad.
            incidence: change of the beam's incidence, rad.
        """
        detectors = []
        for d, a, (polar, azimuth) in zip(self.detector, self.apertures(), aim, strict=True):
            radius, direction = math.hypot(*a.center), math.atan2(a.center[1], a.center[0]) + azimuth
            radius = scale * self.working_distance * math.tan(math.atan2(radius, self.working_distance) + polar)
            place = np.array([math.cos(direction + rotation), math.sin(direction + rotation)]) * radius + plate_shift
            ellipse = {
                "center_um": tuple(place.tolist()),
                "axes_um": (2.0 * scale * a.semi_axes[0], 2.0 * scale * a.semi_axes[1]),
                "rotation_deg": math.degrees(math.remainder(a.rotation + azimuth + rotation, 2.0 * math.pi)),
            }
            detectors.append(Detector(name=d.name, channel=d.channel, beam_deg=d.beam_deg, **ellipse))
        plate = self.plate.model_copy(update={"sample_distance_um": self.sample_distance + distance})
        if incidence and self.has_several_beams:
            raise SceneError("the incidence of an instrument of several beams cannot be moved: move that of its scans")
        beam = self.beam.changed(incidence_deg=self.beam.incidence_deg + math.degrees(incidence))
        return Instrument(
            beam=beam,
            plate=plate,
            detector=tuple(detectors),
            uncertainty=self.uncertainty,
            readout=self.readout,
            law=self.law,
        )

    def at_distance(self, distance: float) -> "Instrument":
        """Return the instrument, its plate unchanged, at another sample distance [um]."""
        return self.model_copy(update={"plate": self.plate.model_copy(update={"sample_distance_um": distance})})

    def spot_position(self, height: Any) -> tuple[Any, Any, Any]:
        """Compute the lab position (x, y, z) [um] of the point that the beam hits at `height` above the substrate.

        In a raster scan it depends on the height alone. Works on NumPy and JAX arrays.
        """
        tx, ty = self.beam_shift
        drop = self.sample_distance - self.working_distance - height
        return drop * tx, drop * ty, -drop

    def directions(self) -> np.ndarray:
        """Compute x / z, y / z of each aperture's centre, seen from the beam's spot on the substrate [detector, 2]."""
        spots = (self.sample_distance - self.working_distance) * self.beam_shifts
        return (np.array([a.center for a in self.apertures()]) - spots) / self.sample_distance

    def surface_position(self, x: Any, y: Any, height: Any) -> tuple[Any, Any]:
        """Compute the sample-frame x, y of the surface point of `height` at beam position (x, y) [um]."""
        tx, ty = self.beam_shift
        return x - height * tx, y - height * ty

    def sample_origin(self, x: Any, y: Any) -> tuple[Any, Any, float]:
        """Compute the offset from lab to sample coordinates at beam position (x, y) [um]."""
        tx, ty = self.beam_shift
        drop = self.sample_distance - self.working_distance
        return x - drop * tx, y - drop * ty, drop
