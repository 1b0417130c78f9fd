"""How far an instrument may be from what its file states: the joint prior of sample distance and aperture directions.

An instrument file states independent standard deviations (table [uncertainty]) and, once calibrated, how the errors of
plate, beam and apertures belong together (table [covariance]): a plate that is shifted turns all its apertures at once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.instrument import Covariance, Instrument, Uncertainty

_STEP = 0.1
"""Step of the difference quotients, in standard deviations of a parameter."""
_INDEPENDENT = 1e-3
"""Least independent share of the standard deviation of a direction: the plate's few motions do not determine all."""
ROTATION_STD = math.radians(0.3)
"""Standard deviation of the rotation that the stage states between two scans [rad]."""
_WIDER = 1.01
"""[uncertainty] widens what [covariance] states where it is larger by more than this factor."""


@dataclass(frozen=True)
class GeometryPrior:
    """Prior of the geometry, about what the file states.

    Attributes:
        covariance: of the sample distance [um], then of polar angle and azimuth [rad] of every aperture, aperture by
            aperture [1 + 2 * detector, 1 + 2 * detector].
        incidence_std: standard deviation of the beam's incidence [rad], taken as independent.
    """

    covariance: np.ndarray
    incidence_std: float = 0.0

    @classmethod
    def of_uncertainty(cls, stated: Uncertainty, n_detectors: int) -> "GeometryPrior":
        """Make the prior of independent errors."""
        aim = np.radians([stated.polar_deg, stated.azimuth_deg] * n_detectors)
        return cls(np.diag(np.array([stated.sample_distance_um, *aim]) ** 2), math.radians(stated.incidence_deg))

    @classmethod
    def of(cls, instrument: Instrument) -> "GeometryPrior":
        """Make the prior that an instrument file states; where its two tables differ, the wider counts.

        Raises:
            SceneError: [covariance] has a parameter that the instrument does not have.
        """
        alone = cls.of_uncertainty(instrument.uncertainty, len(instrument.detector))
        if instrument.covariance is None:
            return alone
        joint = geometry_covariance(instrument, instrument.covariance)
        kinds = np.array([0] + [1, 2] * len(instrument.detector))
        of_file, of_table = np.diag(alone.covariance), np.diag(joint)
        largest = np.array([of_table[kinds == kind].max() for kind in range(3)])[kinds]
        more = np.where(of_file > _WIDER**2 * largest, of_file - largest, 0.0)
        floor = _INDEPENDENT**2 * largest
        return cls(joint + np.diag(more + floor), alone.incidence_std)

    @property
    def distance_std(self) -> float:
        """Standard deviation of the sample distance [um]."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def is_aimed(self) -> bool:
        """Whether the directions of the apertures are uncertain."""
        return bool(np.any(np.diag(self.covariance)[1:] > 0.0))

    def with_distance(self, std: float) -> "GeometryPrior":
        """Return the prior with another standard deviation of the distance [um], independent of the directions."""
        covariance = self.covariance.copy()
        covariance[0], covariance[:, 0], covariance[0, 0] = 0.0, 0.0, std**2
        return GeometryPrior(covariance, self.incidence_std)

    def factor(self) -> np.ndarray:
        """Compute the lower triangular factor L, covariance = L L^T; rows of what is known are 0."""
        unknown = np.diag(self.covariance) > 0.0
        size = np.where(unknown, np.sqrt(np.diag(self.covariance)), 1.0)
        scaled = self.covariance / np.outer(size, size) + np.diag(np.where(unknown, 0.0, 1.0))
        return np.linalg.cholesky(scaled) * np.where(unknown, size, 0.0)[:, None]

    def draw(self, rng: np.random.Generator) -> tuple[float, np.ndarray, np.ndarray, float]:
        """Draw errors of the sample distance [um], polar angles, azimuths [detector] and incidence [rad]."""
        aim = rng.standard_normal(len(self.covariance) - 1)
        distance, *aim = self.factor() @ np.append(rng.standard_normal(), aim)
        incidence = self.incidence_std * float(rng.standard_normal()) if self.incidence_std else 0.0
        return float(distance), np.array(aim[::2]), np.array(aim[1::2]), incidence


def errors_in_common(
    instruments: Sequence[Instrument], plates: Sequence[tuple[int, Sequence[int]]], names: Sequence[str]
) -> Covariance | None:
    """State the errors of the instruments of several scans, between which the sample was turned.

    Polar angles and azimuths of one plate are off by the same in all of its scans, those of different plates
    independently; the azimuths of every scan but the first also by the error of its rotation (`ROTATION_STD`). The
    distance is one for all: as uncertain as that of the scan which knows least of it.

    Args:
        instruments: of every scan.
        plates: for every scan, the number of the scan that has all apertures of its plate, and which of those each of
            its own is; scans by one plate state the same errors.
        names: of the joined scans' detectors, scan by scan, each in its instrument's order.

    Returns:
        [covariance] of the joined scans; None where nothing is uncertain.
    """
    priors = [GeometryPrior.of(instrument).covariance for instrument in instruments]
    if not any(prior.any() for prior in priors):
        return None
    distance = max(prior[0, 0] for prior in priors)
    scan = np.repeat(np.arange(len(priors)), [len(prior) - 1 for prior in priors])
    plate = np.array([number for number, _ in plates])[scan]
    own = np.concatenate([[1 + 2 * a + k for a in apertures for k in (0, 1)] for _, apertures in plates])
    is_azimuth = own % 2 == 0
    # how the directions change with one standard deviation of the distance; those of different plates only so together
    by_distance = np.concatenate([p[0, 1:] / math.sqrt(p[0, 0]) if p[0, 0] else p[0, 1:] for p in priors])
    joint = np.outer(by_distance, by_distance)
    for number in np.unique(plate):
        of = plate == number
        prior = priors[number]
        joint[np.ix_(of, of)] = prior[np.ix_(own[of], own[of])]
    rotation = (scan[:, None] == scan) & (scan > 0) & np.outer(is_azimuth, is_azimuth)
    joint = np.block(
        [
            [np.full((1, 1), distance), math.sqrt(distance) * by_distance[None]],
            [math.sqrt(distance) * by_distance[:, None], joint + ROTATION_STD**2 * rotation],
        ]
    )
    parameters = ("sample distance", *(f"{kind} of {name}" for name in names for kind in ("polar", "azimuth")))
    is_known = np.diag(joint) <= 0.0
    degrees: tuple[Literal["deg"], ...] = ("deg",) * (len(parameters) - 1)
    std = np.sqrt(np.diag(joint))
    correlation = joint / np.outer(*2 * [np.where(is_known, 1.0, std)]) + np.diag(1.0 * is_known)
    return Covariance(
        parameters=parameters,
        units=("um", *degrees),
        std=(float(std[0]), *np.degrees(std[1:]).tolist()),
        correlation=tuple(map(tuple, correlation.tolist())),
    )


def geometry_covariance(instrument: Instrument, stated: Covariance) -> np.ndarray:
    """Compute the covariance of sample distance and directions, as in `GeometryPrior`, to first order.

    Raises:
        SceneError: a parameter that the instrument does not have.
    """
    slopes = [
        (_geometry(instrument, name, _STEP * std) - _geometry(instrument, name, -_STEP * std)) / (2.0 * _STEP * std)
        if std
        else np.zeros(1 + 2 * len(instrument.detector))
        for name, std in zip(stated.parameters, stated.std, strict=True)
    ]
    by = np.stack(slopes, 1)
    return by @ stated.matrix() @ by.T


def _geometry(instrument: Instrument, name: str, step: float) -> np.ndarray:
    """Compute sample distance and directions of an instrument of which one parameter is changed, in its unit."""
    names, aim = instrument.detector_names, np.zeros((len(instrument.detector), 2))
    kind, _, of = name.partition(" of ")
    distance, moves = 0.0, {}
    if kind in ("polar", "azimuth") and of in names:
        aim[names.index(of), int(kind == "azimuth")] = math.radians(step)
    elif name == "sample distance":
        distance = step
    elif name in ("plate shift x", "plate shift y"):
        moves["plate_shift"] = (step, 0.0) if name.endswith("x") else (0.0, step)
    elif name == "plate scale":
        moves["scale"] = 1.0 + step
    elif name == "plate rotation":
        moves["rotation"] = math.radians(step)
    elif name == "incidence":
        moves["incidence"] = math.radians(step)
    else:
        raise SceneError(
            f"covariance.parameters: {name!r} is not a parameter of this instrument, whose detectors are "
            f"{', '.join(names)}: calibrate it anew (helio calibrate --known), or remove the table"
        )
    moved = instrument.moved(aim, distance, **moves)
    directions = np.array([d.aim(moved.working_distance) for d in moved.detector], float)
    stated = np.array([d.aim(instrument.working_distance) for d in instrument.detector], float)
    turned = stated + np.remainder(directions - stated + np.pi, 2.0 * np.pi) - np.pi
    return np.array([moved.sample_distance, *turned.ravel()])
