"""Areal surface texture parameters of a scale-limited surface: height, hybrid, material ratio, spatial. Arrays only.

Heights [y, x] in um are deviations from their mean, NaN where unknown, on a regular grid.
"""

import math
from typing import NamedTuple

import numpy as np

from helio_jax.measure.autocorrelation import spatial_parameters
from helio_jax.measure.material_ratio import material_ratio_parameters


class Kind(NamedTuple):
    """What is known of a parameter before it is measured.

    Attributes:
        unit: "um", "%" or "".
        meaning: what it is.
        grows_as_root: its square, not the parameter itself, grows in proportion to the variance of the noise.
    """

    unit: str
    meaning: str
    grows_as_root: bool = False


PARAMETERS = {
    "Sa": Kind("um", "arithmetical mean height", grows_as_root=True),
    "Sq": Kind("um", "root mean square height", grows_as_root=True),
    "Ssk": Kind("", "skewness"),
    "Sku": Kind("", "kurtosis"),
    "Sp": Kind("um", "maximum peak height", grows_as_root=True),
    "Sv": Kind("um", "maximum pit height", grows_as_root=True),
    "Sz": Kind("um", "maximum height", grows_as_root=True),
    "Sdq": Kind("", "root mean square gradient", grows_as_root=True),
    "Sdr": Kind("%", "developed interfacial area ratio"),
    "Sk": Kind("um", "core height", grows_as_root=True),
    "Spk": Kind("um", "reduced peak height", grows_as_root=True),
    "Svk": Kind("um", "reduced dale height", grows_as_root=True),
    "Smr1": Kind("%", "material ratio, peaks from core"),
    "Smr2": Kind("%", "material ratio, dales from core"),
    "Sal": Kind("um", "autocorrelation length"),
    "Str": Kind("", "texture aspect ratio"),
}
"""Every parameter, in the order in which they are reported."""


def texture_parameters(z: np.ndarray, steps: tuple[float, float]) -> dict[str, float]:
    """Compute all `PARAMETERS`; NaN where one is not defined.

    Args:
        z: deviations from their mean [y, x], um; NaN: unknown.
        steps: pitch along y and x [um].

    Source: ISO 25178-2:2021: height, spatial, hybrid parameters, and those of the areal material ratio curve.
    """
    v = z[np.isfinite(z)]
    sq = math.sqrt(np.mean(v**2))
    found = {
        "Sa": float(np.mean(np.abs(v))),
        "Sq": sq,
        "Ssk": float(np.mean(v**3)) / sq**3 if sq > 0 else math.nan,
        "Sku": float(np.mean(v**4)) / sq**4 if sq > 0 else math.nan,
        "Sp": float(v.max()),
        "Sv": float(-v.min()),
        "Sz": float(np.ptp(v)),
    }
    found |= hybrid_parameters(z, steps) | material_ratio_parameters(v) | spatial_parameters(z, steps)
    return {name: found[name] for name in PARAMETERS}


def hybrid_parameters(z: np.ndarray, steps: tuple[float, float]) -> dict[str, float]:
    """Compute Sdq and Sdr [%] of the surface that is bilinear in every cell of four known heights; NaN without a cell.

    Each cell is integrated at 2 x 2 Gauss points, which is exact for Sdq.
    """
    p = np.diff(z, axis=1) / steps[1]  # slope along x on every row
    q = np.diff(z, axis=0) / steps[0]
    whole = np.isfinite(p[:-1] + p[1:])
    p0, p1, q0, q1 = (a[whole] for a in (p[:-1], p[1:], q[:, :-1], q[:, 1:]))
    if not p0.size:
        return {"Sdq": math.nan, "Sdr": math.nan}
    square, area = 0.0, 0.0
    for u in (0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)):
        for v in (0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)):
            slope = (p0 + v * (p1 - p0)) ** 2 + (q0 + u * (q1 - q0)) ** 2
            square += 0.25 * float(np.mean(slope))
            area += 0.25 * float(np.mean(slope / (np.sqrt(1.0 + slope) + 1.0)))  # sqrt(1 + s) - 1 without cancellation
    return {"Sdq": math.sqrt(square), "Sdr": 100.0 * area}
