"""The areal material ratio curve and the parameters of its core: Sk, Spk, Svk, Smr1, Smr2. Heights in, numbers out."""

import math

import numpy as np

_CORE = 0.4
"""Share of the heights whose secant of smallest slope marks the core."""


def material_ratio_parameters(heights: np.ndarray) -> dict[str, float]:
    """Compute Sk, Spk, Svk [um], Smr1 and Smr2 [%].

    The curve is the sorted heights over the share of the surface at or above them. The equivalent straight line is the
    least-squares line of the 40 % of the curve whose secant has the smallest slope, the first where several have it.
    Sk is its fall from 0 to 100 %; Smr1 and Smr2 are where the curve passes its ends. Spk is the height of the right
    triangle that has the area of the curve above the core and the base Smr1; Svk likewise below.

    Args:
        heights: of equal areas [n], um; 3 or more.

    Source: ISO 25178-2:2021, after ISO 13565-2:1996; tests/unit/test_texture.py.
    """
    z = np.sort(heights)[::-1]
    n = z.size
    share = (np.arange(n) + 0.5) / n  # each height stands for 1/n of the surface
    width = max(round(_CORE * n), 1)
    falls = z[: n - width] - z[width:]
    tolerance = 1e-9 * float(z[0] - z[-1])  # equal secants differ by rounding
    first = int(np.argmax(falls <= falls.min() + tolerance))
    core = slice(first, first + width + 1)
    slope, upper = np.polyfit(share[core] - 0.5, z[core], 1)
    upper, lower = upper - 0.5 * slope, upper + 0.5 * slope
    smr1, smr2 = (_ratio_at(level, z, share) for level in (upper, lower))
    above, below = float(np.mean(np.maximum(z - upper, 0.0))), float(np.mean(np.maximum(lower - z, 0.0)))
    return {
        "Sk": float(upper - lower),
        "Spk": 2.0 * above / smr1 if smr1 > 0 else 0.0,
        "Svk": 2.0 * below / (1.0 - smr2) if smr2 < 1 else 0.0,
        "Smr1": 100.0 * smr1,
        "Smr2": 100.0 * smr2,
    }


def _ratio_at(level: float, z: np.ndarray, share: np.ndarray) -> float:
    """Interpolate the share of the surface above a level, 0 to 1, from falling heights."""
    if not math.isfinite(level) or level >= z[0]:
        return 0.0
    if level <= z[-1]:
        return 1.0
    return float(np.interp(-level, -z, share))
