"""What a fit to known shapes tells, for people and files: table, chi-square by region, verdict. Pure NumPy."""

import math
from typing import Any, NamedTuple

import numpy as np

from helio_jax.arrays import robust_std
from helio_jax.calibration.known_scan import InstrumentFit
from helio_jax.calibration.known_shape import KnownFit
from helio_jax.calibration.shared_background import campaign_readout
from helio_jax.campaign import CampaignLaw
from helio_jax.geometry_prior import geometry_covariance
from helio_jax.instrument import Covariance, Instrument, Uncertainty

UNDETERMINED = 0.7
"""An unknown that keeps more than this share of its prior standard deviation is not determined by the scans."""
LARGE_CHI_SQUARE = 1.2
"""Robust chi-square per pixel up to which the model explains a region."""
INFLATED = 1.2
FAR = 3.0
"""Prior standard deviations from the stated value beyond which the scans contradict the instrument file."""
LAW_SPREAD = 0.05
"""Assumed standard deviation of the exponent of the scattering law between samples of one campaign."""
_MIN_PIXELS = 12


class Row(NamedTuple):
    """One line of the table; `pull` is (value - stated) over the prior standard deviation."""

    name: str
    unit: str
    value: float
    std: float
    stated: float
    prior: float
    pull: float
    is_determined: bool


def table(fit: InstrumentFit) -> list[Row]:
    """List the unknowns of instrument and objects."""
    columns = zip(fit.names, fit.units, fit.values.tolist(), fit.stds.tolist(), strict=True)
    priors = zip(fit.stated_values.tolist(), fit.priors.tolist(), strict=True)
    return [
        Row(name, unit, value, std, stated, prior, (value - stated) / prior, std <= UNDETERMINED * prior)
        for (name, unit, value, std), (stated, prior) in zip(columns, priors, strict=True)
    ]


def readout_rows(fit: KnownFit) -> list[dict[str, Any]]:
    """List gain, substrate's signal, offset, line noise, noise and error of the model of all detectors, in counts."""
    out = []
    for scan, linear, covariance, lines, error, seen, expected in zip(
        fit.scans, fit.linear, fit.linear_covariance, fit.line_std, fit.model_error, fit.seen, fit.expected, strict=True
    ):
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        for k, name in enumerate(fit.instrument.detector_names):
            background = np.tensordot(linear[k, 1:], scan.columns.modes, 1)
            signal = float(np.median((expected[k] - background)[~seen.is_object & ~seen.is_masked.any(0)]))
            out.append(
                {
                    "scan": scan.name,
                    "detector": name,
                    "gain": float(linear[k, 0]),
                    "gain_std": float(std[k, 0]),
                    "substrate_signal": signal,
                    "offset": float(linear[k, 1]),
                    "offset_std": float(std[k, 1]),
                    "line_std": float(lines[k]),
                    "model_error": dict(zip(("substrate", "object"), error[k].tolist(), strict=True)),
                    "noise": float(np.median(scan.sigma[k])),
                }
            )
    return out


def far_from_stated(fit: InstrumentFit) -> list[str]:
    """State which unknowns came out far from what is stated, measured by their priors."""
    return [
        f"{row.name} is {abs(row.pull):.1f} prior standard deviations from what is stated"
        for row in table(fit)
        if abs(row.pull) > FAR and not row.name.startswith("object")
    ]


def regions(fit: KnownFit, number: int) -> dict[str, np.ndarray]:
    """Divide the pixels of a scan: object, mask band of each detector, substrate [detector, y, x]."""
    seen = fit.seen[number]
    masked = seen.is_masked
    on = np.broadcast_to(seen.is_object, masked.shape)
    return {"object": on, "mask band": masked, "substrate": ~on & ~masked}


def chi_squares(fit: KnownFit) -> list[dict[str, Any]]:
    """Compute the mean and the robust chi-square per pixel of every scan, detector and region."""
    out = []
    for number, (scan, residual) in enumerate(zip(fit.scans, fit.residuals, strict=True)):
        for region, inside in regions(fit, number).items():
            for k, name in enumerate(fit.instrument.detector_names):
                here = residual[k][inside[k] & np.isfinite(residual[k])]
                if here.size >= _MIN_PIXELS:
                    numbers = {"mean": float(np.mean(here**2)), "robust": float(robust_std(here)) ** 2}
                    out.append(
                        {"scan": scan.name, "detector": name, "region": region, "pixels": int(here.size)} | numbers
                    )
    return out


def robust_chi_square(fit: KnownFit) -> float:
    """Compute the robust chi-square per pixel of all scans together."""
    return float(robust_std(np.concatenate([r.ravel() for r in fit.residuals]))) ** 2


def error_shares(fit: KnownFit) -> list[float]:
    """Compute the errors of the model on the object's tiles, over the substrate's signal, of all scans' detectors."""
    return [row["model_error"]["object"] / row["substrate_signal"] for row in readout_rows(fit)]


ON_TWINS = (
    "on 14 simulated scans the errors were 1.2 times the standard deviations stated (root mean square; of single "
    "parameters up to 1.4); what a real scan has and these lack is in none of them"
)
"""Measured: docs/calibrate.md. A sentence of every verdict: what its standard deviations were found to be worth."""


def verdict(fit: KnownFit) -> list[str]:
    """State in sentences what the fit does not explain or determine, and how far its standard deviations hold."""
    out, chi = [], robust_chi_square(fit)
    worst = sorted(
        (row for row in chi_squares(fit) if row["robust"] > LARGE_CHI_SQUARE), key=lambda row: -row["robust"]
    )
    if chi > LARGE_CHI_SQUARE or worst:
        places = "; ".join(
            f"{row['region']} of {row['detector']!r} in {row['scan']} ({row['robust']:.2f})" for row in worst[:3]
        )
        out.append(
            f"the model does not explain all of the scans: robust chi-square {chi:.2f} per pixel"
            + (f", largest on the {places}" if places else "")
        )
    errors = [
        (share, f"{row['detector']!r} in {row['scan']}")
        for share, row in zip(error_shares(fit), readout_rows(fit), strict=True)
    ]
    if max(errors)[0] > 0.0:
        named = "; ".join(f"{share:.1%} for {name}" for share, name in sorted(errors, reverse=True)[:3] if share > 0.0)
        out.append(
            f"the object differs from the model by more than noise, tile by tile ({named}, of the substrate's signal): "
            "dust, its shape or its scattering law; the standard deviations allow for errors that differ from tile to "
            "tile, not for wider ones"
        )
    if fit.inflation > INFLATED:
        out.append(
            f"misfit and correlated residuals enlarge all standard deviations {fit.inflation:.2f} times: an effect "
            "that the model lacks may stand behind a parameter"
        )
    if not fit.is_converged:
        out.append(f"the fit has not converged in {fit.rounds} rounds: raise max_rounds")
    out += far_from_stated(fit)
    loose = [row.name for row in table(fit) if not row.is_determined]
    if loose:
        out.append(f"not determined, known by the prior alone: {', '.join(loose)}")
    return [*out, ON_TWINS]


def calibrated_instrument(fit: KnownFit) -> Instrument:
    """Return the fitted instrument with the covariance of what is unknown of it.

    [uncertainty] holds the standard deviations without their correlations: of the plate's motion, of the distance, and
    of the directions of the apertures that follow, the largest of all. The next sample is tilted otherwise: its tilt is
    as uncertain as these scans' was before. What the model lacked on these objects, root mean square over detectors and
    scans, it is taken to lack on others, too (`Uncertainty.discrepancy`).
    """
    found, covariance = geometry_uncertainty(fit)
    found["discrepancy"] = math.sqrt(np.mean(np.square(error_shares(fit))))
    uncertainty = Uncertainty(**found)
    signals = np.array([row["substrate_signal"] for row in readout_rows(fit)]).reshape(len(fit.scans), -1)
    readout = campaign_readout(fit, signals)
    tables = {"uncertainty": uncertainty, "covariance": covariance, "readout": readout, "law": campaign_law(fit)}
    return fit.instrument.model_copy(update=tables)


def geometry_uncertainty(fit: InstrumentFit) -> tuple[dict[str, float], Covariance]:
    """Return what is unknown of a fitted instrument's geometry, for [uncertainty] and [covariance] of its file."""
    n = fit.n_shared
    std = dict(zip(fit.names[:n], fit.stds[:n].tolist(), strict=True))
    size = np.sqrt(np.diag(fit.covariance[:n, :n]))
    correlation = fit.covariance[:n, :n] / np.outer(size, size)
    covariance = Covariance(
        parameters=tuple(fit.names[:n]),
        units=tuple(fit.units[:n]),  # type: ignore[arg-type]  # checked when made
        std=tuple(float(f"{s:.4g}") for s in fit.stds[:n]),
        correlation=tuple(tuple(np.round(row, 4).tolist()) for row in correlation),
    )
    directions = np.diag(geometry_covariance(fit.instrument, covariance))[1:].reshape(-1, 2)
    polar, azimuth = np.degrees(np.sqrt(directions.max(0))).tolist()
    stated = fit.stated.uncertainty
    tilts = [float(std) for name, std in zip(fit.names, fit.priors, strict=True) if name.startswith("tilt")]
    found = {
        "plate_shift_um": max(std.get("plate shift x", 0.0), std.get("plate shift y", 0.0)),
        "plate_scale": std.get("plate scale", 0.0),
        "plate_rotation_deg": std.get("plate rotation", 0.0),
        "sample_distance_um": std.get("sample distance", 0.0),
        "incidence_deg": std.get("incidence", 0.0),
        "polar_deg": min(polar, 30.0),
        "azimuth_deg": min(azimuth, 30.0),
        "tilt_deg": max([stated.tilt_deg, *tilts]),
    }
    return {name: float(f"{value:.4g}") for name, value in found.items()}, covariance


def campaign_law(fit: KnownFit) -> CampaignLaw | None:
    """Join the exponents of the scattering law that the scans have; None where the cosine law was taken as known.

    Other samples may differ by `LAW_SPREAD`, or by as much as those of these scans do.
    """
    found = [i for i, name in enumerate(fit.names) if name.startswith("exponent")]
    if not found:
        return None
    value, std = fit.values[found], fit.stds[found]
    mean = float(np.average(value, weights=std**-2))
    spread = max(LAW_SPREAD, float(np.std(value)))
    own = float(np.sum(std**-2)) ** -0.5
    return CampaignLaw(exponent=float(f"{mean:.4g}"), std=float(f"{np.hypot(own, spread):.3g}"))


def as_record(fit: KnownFit) -> dict[str, Any]:
    """Return all that is printed, JSON-compatible."""
    return {
        "table": [row._asdict() for row in table(fit)],
        "readout": readout_rows(fit),
        "chi_square": fit.chi_square,
        "robust_chi_square": robust_chi_square(fit),
        "regions": chi_squares(fit),
        "inflation": fit.inflation,
        "rounds": fit.rounds,
        "is_converged": fit.is_converged,
        "verdict": verdict(fit),
    }
