"""What a fit of directions by masks tells, for people and files: table, verdict, instrument. Pure NumPy."""

from typing import Any

import numpy as np

from helio_jax.arrays import robust_std
from helio_jax.calibration.known_report import (
    FAR,
    INFLATED,
    LARGE_CHI_SQUARE,
    UNDETERMINED,
    far_from_stated,
    geometry_uncertainty,
    table,
)
from helio_jax.calibration.mask_directions import MaskFit
from helio_jax.instrument import Instrument, Uncertainty


def direction_rows(fit: MaskFit) -> list[dict[str, Any]]:
    """List polar angle and azimuth of all apertures [deg]: found, stated, and how far they lie apart."""
    out = []
    degrees = [np.degrees(a) for a in (fit.directions, fit.direction_stds, fit.stated_directions, fit.direction_priors)]
    for k, name in enumerate(fit.instrument.detector_names):
        for i, angle in enumerate(("polar", "azimuth")):
            value, std, stated, prior = (float(a[k, i]) for a in degrees)
            away = (value - stated + 180.0) % 360.0 - 180.0
            out.append(
                {
                    "name": f"{angle} of {name}",
                    "unit": "deg",
                    "value": stated + away,
                    "std": std,
                    "stated": stated,
                    "prior": prior,
                    "pull": away / std,
                    "is_determined": std <= UNDETERMINED * prior,
                }
            )
    return out


def robust_chi_square(fit: MaskFit) -> float:
    """Compute the robust chi-square per pixel of all scans together."""
    return float(robust_std(np.concatenate([r.ravel() for r in fit.residuals]))) ** 2


def verdict(fit: MaskFit) -> list[str]:
    """State in sentences what the masks contradict, and what they do not determine."""
    rows, out = direction_rows(fit), []
    chi, far = robust_chi_square(fit), far_from_stated(fit)
    if far:
        out.append(
            f"the outlines fit no instrument within its priors, do not trust these directions: {'; '.join(far)}; "
            "dust or a crevice at the ball's foot?"
        )
    for row in rows:
        if row["is_determined"] and abs(row["pull"]) > FAR:
            out.append(
                f"the masks contradict the instrument file: {row['name']} is {row['value']:.1f} +- {row['std']:.1f} "
                f"deg, the file states {row['stated']:.1f}"
            )
    if chi > LARGE_CHI_SQUARE or fit.inflation > INFLATED:
        out.append(
            f"the model does not explain all of the scans: robust chi-square {chi:.2f} per pixel; standard deviations "
            f"are enlarged {fit.inflation:.2f} times; what lies at the foot can be left out by --leave-out-ring"
        )
    if not fit.is_converged:
        out.append(f"the fit has not converged in {fit.rounds} rounds: raise max_rounds")
    loose = [row["name"] for row in rows if not row["is_determined"]]
    if loose:
        out.append(
            f"not determined by masks: {', '.join(loose)}; a ball that stands out farther has longer masks, a finer "
            "pitch shows more of them"
        )
    return out


def instrument_by_masks(fit: MaskFit) -> Instrument:
    """Return the fitted instrument with the covariance of what is unknown of it."""
    found, covariance = geometry_uncertainty(fit)
    found["discrepancy"] = fit.stated.uncertainty.discrepancy
    return fit.instrument.model_copy(update={"uncertainty": Uncertainty(**found), "covariance": covariance})


def as_record(fit: MaskFit) -> dict[str, Any]:
    """Return all that is printed, JSON-compatible."""
    return {
        "directions": direction_rows(fit),
        "table": [row._asdict() for row in table(fit)],
        "robust_chi_square": robust_chi_square(fit),
        "inflation": fit.inflation,
        "rounds": fit.rounds,
        "is_converged": fit.is_converged,
        "verdict": verdict(fit),
    }
