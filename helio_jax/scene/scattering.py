"""Scattering laws of surfaces. Tables `[material.NAME]` of a scene, selected by `kind`.

Directions that a lobe would send below the surface are drawn again: its density is cut at the horizon and normalised. A
law is a sum of `Term`s, each a fraction of the atoms with one distribution; trace/laws.py samples them.
`compat = "shem-ray-tracing"` reproduces known errors of the program SHeM Ray Tracing, inferred from its counts, to
compare with its files; never use it for physics.
"""

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from helio_jax.scene.files import read_scattering_table
from helio_jax.settings import Settings

Compat = Literal["none", "shem-ray-tracing"]
"""Program whose errors are reproduced."""
DEBYE_WALLER = 278.5085
"""2W = this * E T / (M Theta^2) * |change of the unit direction|^2 with meV, K, u: 6 m_He / k_B in u K / meV."""


class Shape(IntEnum):
    """Distributions of a `Term`, and the meaning of its `numbers`."""

    COSINE = 0
    SPECULAR = 1
    UNIFORM = 2  # cosine of the cone's half-angle
    LOBE = 3  # width [rad], +1: about the specular direction, -1: about the backscattering direction
    COSINE_LOBE = 4
    DIFFRACTION = 5  # width of broadened peaks, 1: lattice rotates with the face; rows: order, order, weight, width
    ROUGH = 6  # roughness
    TABLE = 7  # table: intensity [incidence, theta, phi] on axes


@dataclass(frozen=True)
class Term:
    """A fraction of the atoms and the distribution of their directions.

    Attributes:
        shape: kind of distribution.
        share: fraction of the atoms; the fractions of a law add up to its albedo, the other atoms stick.
        numbers: parameters, see `Shape`.
        rows: diffraction peaks [n, 4].
        lattice: the two vectors of a diffraction lattice in wavelengths [2, 3].
        attenuation: B of the Debye-Waller factor exp(-B |u_out - u_in|^2); attenuated atoms leave by the cosine law.
        axes: incidence, theta and phi of a table [rad].
        intensity: of a table, per steradian [incidence, theta, phi].
    """

    shape: Shape
    share: float
    numbers: tuple[float, ...] = ()
    rows: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    lattice: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)))
    attenuation: float = 0.0
    axes: tuple[np.ndarray, ...] = ()
    intensity: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0)))


COSINE_LAW = (Term(Shape.COSINE, 1.0),)
"""Re-emission by the cosine law."""


class LawModel(Settings):
    """Base of all laws."""

    albedo: float = Field(default=1.0, gt=0.0, le=1.0)
    """Fraction of the atoms that leave again; the others stick and are counted as stopped."""

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        """Resolve the law into terms; relative file names start at `base_dir`."""
        raise NotImplementedError


class DebyeWaller(Settings):
    """Thermal attenuation of a coherent lobe: 2W = 3 hbar^2 dk^2 T / (M k_B Theta^2); the rest is diffuse."""

    energy_mev: float = Field(gt=0.0, le=1000.0)
    """Kinetic energy E of the atoms [meV]."""
    mass_u: float = Field(gt=0.0, le=1000.0)
    """Mass M of a surface atom [u]."""
    temperature_k: float = Field(ge=0.0, le=10_000.0)
    """Temperature T of the surface [K]."""
    debye_k: float = Field(gt=0.0, le=10_000.0)
    """Debye temperature Theta of the surface [K]."""

    @property
    def attenuation(self) -> float:
        """B of the factor exp(-B |u_out - u_in|^2), u unit directions."""
        return DEBYE_WALLER * self.energy_mev * self.temperature_k / (self.mass_u * self.debye_k**2)


class CosineLaw(LawModel):
    """The cosine (Knudsen) law: cos(theta) / pi per steradian."""

    kind: Literal["cosine"] = "cosine"

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        return (Term(Shape.COSINE, self.albedo),)


class UniformLaw(LawModel):
    """Constant intensity per steradian within a cone about the normal."""

    kind: Literal["uniform"] = "uniform"
    half_angle_deg: float = Field(default=90.0, gt=0.0, le=90.0)
    """Half-angle of the cone [deg]."""

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        return (Term(Shape.UNIFORM, self.albedo, (math.cos(math.radians(self.half_angle_deg)),)),)


class DiffuseBackgroundLaw(LawModel):
    """Base of laws with a lobe and a diffuse background."""

    diffuse_fraction: float = Field(default=0.0, ge=0.0, lt=1.0)
    """Fraction of the atoms that leave by the cosine law instead of the lobe."""

    def lobe_terms(self, shape: Shape, numbers: tuple[float, ...] = (), **more) -> tuple[Term, ...]:
        """Return the term of the lobe, after that of the diffuse background, if any."""
        lobe = Term(shape, self.albedo * (1.0 - self.diffuse_fraction), numbers, **more)
        diffuse = self.albedo * self.diffuse_fraction
        return (Term(Shape.COSINE, diffuse), lobe) if diffuse else (lobe,)


class CoherentLaw(DiffuseBackgroundLaw):
    """Base of laws with a coherent lobe, which thermal vibrations attenuate."""

    debye_waller: DebyeWaller | None = None
    """Thermal attenuation, or none."""

    @property
    def attenuation(self) -> float:
        """B of the Debye-Waller factor."""
        return 0.0 if self.debye_waller is None else self.debye_waller.attenuation


class GaussianLobeLaw(DiffuseBackgroundLaw):
    """Base of laws with a lobe cos(theta) exp(-g^2 / (2 s^2)) per steradian, g the angle to its axis."""

    sigma_deg: float = Field(ge=1.0, le=180.0)
    """Width s of the lobe [deg]."""
    compat: Compat = "none"
    """`shem-ray-tracing`: half the stated width."""

    @property
    def sigma(self) -> float:
        """Width of the lobe [rad]."""
        return math.radians(self.sigma_deg) * (1.0 if self.compat == "none" else 0.5)


class SpecularLaw(CoherentLaw):
    """Mirror reflection."""

    kind: Literal["specular"] = "specular"

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        return self.lobe_terms(Shape.SPECULAR, attenuation=self.attenuation)


class BroadSpecularLaw(GaussianLobeLaw, CoherentLaw):
    """A Gaussian lobe about the specular direction."""

    kind: Literal["broad_specular"] = "broad_specular"

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        return self.lobe_terms(Shape.LOBE, (self.sigma, 1.0), attenuation=self.attenuation)


class BackscatteringLaw(GaussianLobeLaw):
    """A Gaussian lobe about the direction from which the atom came."""

    kind: Literal["backscattering"] = "backscattering"

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        return self.lobe_terms(Shape.LOBE, (self.sigma, -1.0))


class CosineSpecularLaw(DiffuseBackgroundLaw):
    """A cosine lobe about the specular direction, cut at the horizon."""

    kind: Literal["cosine_specular"] = "cosine_specular"

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        return self.lobe_terms(Shape.COSINE_LOBE)


class RoughDiffuseLaw(LawModel):
    """The energy-preserving Oren-Nayar model (EON): a diffuse surface that is rough below the beam's spot.

    Source: Portsmouth, Kutz, Hill, "EON: A practical energy-preserving rough diffuse BRDF", JCGT 14 (2025) 1, with
    albedo 1 of the multiple scattering, so that every atom leaves.
    """

    kind: Literal["rough_diffuse"] = "rough_diffuse"
    roughness: float = Field(ge=0.0, le=1.0)
    """r of the model: about the standard deviation of the facets' slope angle over pi/2; 0 is the cosine law."""

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        return (Term(Shape.ROUGH, self.albedo, (self.roughness,)),)


class CosinePowerLaw(LawModel):
    """cos^(1 + m) of the angle to the normal, from whatever side the atom comes."""

    kind: Literal["power"] = "power"
    exponent: float = Field(gt=-1.0, le=50.0)
    """m of cos^(1 + m); 0 is the cosine law."""

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        theta = np.radians(np.linspace(0.0, 90.0, 181))
        return (tabulated(theta, np.maximum(np.cos(theta), 0.0) ** (1.0 + self.exponent), self.albedo),)


def tabulated(theta: np.ndarray, intensity: np.ndarray, albedo: float = 1.0) -> Term:
    """Make a law of an intensity per steradian that depends on the angle to the normal alone [theta]."""
    phi = np.array([0.0, np.pi])
    table = np.broadcast_to(intensity[None, :, None], (1, theta.size, phi.size)).copy()
    return Term(Shape.TABLE, albedo, axes=(np.zeros(1), theta, phi), intensity=table)


class DiffractionLaw(CoherentLaw):
    """2-D diffraction: the direction's component along the surface changes by wavelength * (n b1 + m b2).

    b1, b2 are reciprocal (without 2 pi) to the lattice on the face. Peaks are Gaussian in the direction's component
    along the surface. Orders are given by a Gaussian envelope or as a table of intensities.
    """

    kind: Literal["diffraction"] = "diffraction"
    wavelength_nm: float = Field(gt=0.0, le=10.0)
    """Wavelength of the atoms [nm]."""
    lattice_nm: tuple[tuple[float, ...], tuple[float, ...]]
    """The two vectors of the surface lattice: x, y, z in the sample frame, projected onto the face; or x, y on a
    horizontal face, rotated to every other face by the shortest rotation from z to its normal [nm]."""
    max_order: tuple[int, int] = (6, 6)
    """Largest |n| and |m|."""
    order_sigma: float = Field(default=2.0, gt=0.0, le=1000.0)
    """Standard deviation s of the orders, whose weight is exp(-(n^2 + m^2) / (2 s^2))."""
    peaks: tuple[tuple[int, int, Annotated[float, Field(ge=0.0)]], ...] | None = Field(None, max_length=10_000)
    """Instead of the Gaussian: [n, m, intensity] of every peak, normalised to the sum of the intensities."""
    peak_sigma: float = Field(default=0.0, ge=0.0, le=0.5)
    """Standard deviation of a peak in direction cosines along the surface; 0: exact."""
    compat: Compat = "none"
    """`shem-ray-tracing`: its weights of the orders."""

    @model_validator(mode="after")
    def _has_lattice_and_orders(self) -> "DiffractionLaw":
        if {len(v) for v in self.lattice_nm} not in ({2}, {3}):
            got = list(map(list, self.lattice_nm))
            raise ValueError(f"lattice_nm must be two vectors, both of 2 or both of 3 numbers, got {got}")
        a, b = self.vectors
        if np.linalg.norm(np.cross(a, b)) <= 1e-6 * np.linalg.norm(a) * np.linalg.norm(b):
            raise ValueError("lattice_nm must be two vectors in different directions, got parallel ones or zero")
        if not all(0 <= n <= 50 for n in self.max_order):
            raise ValueError(f"max_order must be two numbers from 0 to 50, got {list(self.max_order)}")
        if self.peaks is not None and not sum(p[2] for p in self.peaks) > 0:
            raise ValueError("peaks must have at least one intensity > 0: add peaks, or remove the key")
        return self

    @property
    def _rotates_with_face(self) -> bool:
        """Whether the lattice rotates with the face."""
        return len(self.lattice_nm[0]) == 2

    @property
    def vectors(self) -> np.ndarray:
        """The lattice's vectors [2, 3], nm."""
        return np.array([(*v, 0.0)[:3] for v in self.lattice_nm])

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        n, m, weight = (np.array(column, float) for column in self._weights())
        width = np.full(n.shape, self.peak_sigma)
        if self.compat != "none" and (self.peaks is not None or not self._rotates_with_face):
            width[(n == 0) & (m == 0)] = 0.0
        rows = np.stack([n, m, weight / weight.sum(), width], 1)[weight > 1e-12 * weight.max()]
        lattice = self.vectors / self.wavelength_nm
        return self.lobe_terms(
            Shape.DIFFRACTION,
            (self.peak_sigma, float(self._rotates_with_face)),
            rows=rows,
            lattice=lattice,
            attenuation=self.attenuation,
        )

    def _weights(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute orders and weights of the peaks.

        The forms of `compat` were inferred from the counts of one data set each; other parameters may behave
        otherwise. Lattice of two numbers: (n^2 + m^2) / 2 is truncated to an integer. Of three numbers:
        min(1, (r^2 + c) exp(-r^2 / (2 s^2))) with r = |n| + |m| and c = 0.05 (0.0513 +- 0.0018 fitted), order (0, 0)
        not broadened. Table: the first intensity counts twice, the cumulative sum is cut at 1, order (0, 0) not
        broadened.
        """
        is_compat = self.compat != "none"
        if self.peaks is not None:
            n, m, weight = (np.array(c) for c in zip(*self.peaks, strict=True))
            if is_compat:
                weight = np.diff(np.minimum(1.0, weight[0] + np.cumsum(weight)), prepend=0.0)
            return n, m, weight
        n, m = (np.arange(-k, k + 1) for k in self.max_order)
        n, m = (a.ravel() for a in np.meshgrid(n, m, indexing="ij"))
        if not is_compat:
            return n, m, np.exp(-0.5 * (n**2 + m**2) / self.order_sigma**2)
        if self._rotates_with_face:
            return n, m, np.exp(-((n**2 + m**2) // 2) / self.order_sigma**2)
        square = (np.abs(n) + np.abs(m)) ** 2
        return n, m, np.minimum(1.0, (square + 0.05) * np.exp(-0.5 * square / self.order_sigma**2))


class TableLaw(DiffuseBackgroundLaw):
    """Intensities per steradian from a file, measured or computed.

    The file is text with columns theta, phi, intensity, or incidence, theta, phi, intensity, on a full grid: angles
    in degrees, theta from the normal, phi from the plane of incidence (0 forward, 180 back). Intensities are
    interpolated linearly in each angle, densities linearly between incidences and constant beyond the last ones.
    If phi covers only 0 to 180, the other half is the mirror image. Outside the given theta the intensity is zero.
    """

    kind: Literal["table"] = "table"
    file: str = Field(min_length=1, max_length=4096)
    """Text file (.csv: commas; otherwise white space), relative to the scene file."""

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        """Read the file.

        Raises:
            InputFileError: the file is missing or holds no full grid of intensities.
        """
        axes, intensity = read_scattering_table(base_dir / self.file)
        return self.lobe_terms(Shape.TABLE, axes=axes, intensity=intensity)


PureLaw = (
    CosineLaw
    | UniformLaw
    | SpecularLaw
    | BroadSpecularLaw
    | BackscatteringLaw
    | CosineSpecularLaw
    | RoughDiffuseLaw
    | CosinePowerLaw
    | DiffractionLaw
    | TableLaw
)
"""Any law except a mixture."""


class MixturePart(Settings):
    """One law of a mixture."""

    weight: float = Field(gt=0.0, le=1e6)
    """Relative frequency of the law."""
    law: Annotated[PureLaw, Field(discriminator="kind")]
    """The law."""


class MixtureLaw(LawModel):
    """A mixture of several laws."""

    kind: Literal["mixture"] = "mixture"
    parts: tuple[MixturePart, ...] = Field(min_length=1, max_length=100)
    """The laws and their weights."""

    def terms(self, base_dir: Path = Path()) -> tuple[Term, ...]:
        total = sum(part.weight for part in self.parts)
        return tuple(
            replace(term, share=term.share * self.albedo * part.weight / total)
            for part in self.parts
            for term in part.law.terms(base_dir)
        )


Law = Annotated[PureLaw | MixtureLaw, Field(discriminator="kind")]
"""Any law, selected by `kind`."""
