"""What all scans of one measuring campaign share: tables `[readout]` and `[law]` of an instrument file.

Most counts of a real detector do not come from the sample. This background changes smoothly with the position of the
stage and, as far as scans of one campaign tell, not from scan to scan. `helio calibrate --known` writes both tables,
`calibration.shared_background` reads the read-out for another scan, `inverse.law_prior` the law.
"""

import numpy as np
from pydantic import Field, model_validator

from helio_jax.arrays import check_correlation
from helio_jax.settings import Settings


class DetectorReadout(Settings):
    """One detector: table `[[readout.detector]]`, in the unit of the readings."""

    name: str = Field(min_length=1, max_length=64)
    """Name of the detector."""
    signal: float = Field(gt=0.0)
    """What the level substrate adds to the background. The sum of both is known much better than either."""
    background: tuple[float, ...] = Field(min_length=1, max_length=50)
    """Background: in the middle of the stage window, then amplitudes of the shapes of `hx.pedestal_modes` over it."""
    std: tuple[float, ...]
    """Standard deviation of each of these numbers."""
    correlation: tuple[tuple[float, ...], ...]
    """Their correlation matrix."""

    @model_validator(mode="after")
    def _is_a_covariance(self) -> "DetectorReadout":
        check_correlation(len(self.background), self.std, self.correlation)
        return self

    def covariance(self) -> np.ndarray:
        """Compute the covariance of the numbers of `background`."""
        return np.array(self.correlation) * np.outer(self.std, self.std)


class CampaignReadout(Settings):
    """Read-out of a measuring campaign: table `[readout]` of an instrument file."""

    unit: str = Field(default="counts", max_length=32)
    """Unit of the readings."""
    dwell_s: float | None = Field(default=None, gt=0.0)
    """Dwell time per pixel that the readings belong to; others are scaled by it [s]. Default: unknown, never scaled."""
    window_um: tuple[float, float]
    """Half the width of the stage window in x and y, over which the background is a polynomial [um]."""
    stage_um: tuple[float, float, float] | None = None
    """Stage position (x, y) of its middle, and the height of the stage, to which the plate's sample distance belongs;
    default: unknown, then only the mean background is taken from here [um]."""
    degree: int = Field(ge=0, le=6)
    """Degree of the polynomial."""
    detector: tuple[DetectorReadout, ...] = Field(min_length=1, max_length=64)

    @model_validator(mode="after")
    def _has_a_window(self) -> "CampaignReadout":
        if min(self.window_um) <= 0.0:
            raise ValueError(f"window_um must be > 0 in x and y, got {list(self.window_um)}")
        n = (self.degree + 1) * (self.degree + 2) // 2
        for d in self.detector:
            if len(d.background) != n:
                raise ValueError(
                    f"a background of degree {self.degree} has {n} numbers, got {len(d.background)} for {d.name!r}"
                )
        return self


MAX_LAW_STD = 1.0
"""Largest standard deviation of the exponent of a law that is stated."""


class CampaignLaw(Settings):
    """Scattering law of the samples of a measuring campaign, cos^(1 + m): table `[law]` of an instrument file."""

    exponent: float = Field(gt=-1.0, le=50.0)
    """m; 0 is the cosine law."""
    std: float = Field(gt=0.0, le=MAX_LAW_STD)
    """Standard deviation of m, that between samples included."""
