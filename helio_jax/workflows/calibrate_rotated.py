"""Calibration of aligned scans of a rotated sample by their constant albedo, multiple scattering included.

Joins the self-calibration (calibration/self_calibration.py), which knows no surface, with the near-field solution and a
prediction of the multiple scattering of its surface. Without that prediction the background of synthetic crystals on a
substrate came out a fifth too low, and flanks of 55 degrees at 32 (benchmarks/crystal.py).
"""

import numpy as np

from helio_jax.arrays import as_json, nearest_known, substrate_level
from helio_jax.calibration.self_calibration import (
    Relief,
    SelfCalibration,
    apply_calibration,
    distance_std,
    effective_instrument,
    self_calibrate,
)
from helio_jax.errors import PredictionError
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.inverse.methods import reconstruct_stack
from helio_jax.inverse.nearfield import limited
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import Calibration, MicrographStack
from helio_jax.workflows.corrections import make_predictor

_MAX_ITERATIONS, _CONVERGED = 8, (0.01, 0.5)
"""Iterations end when share and polar angle [deg] change by less than this (flanks of 55 deg of a tall crystal are
40 deg after the first calibration, 52 and 55 after the next ones)."""
_PRIORS = {"gain_std": 0.05, "offset_std": 0.1, "max_rounds": 12}
_DRIFT_PRIORS = {"drift_std": 0.1, "drift_degrees": (3, 3)}
"""Priors of the fit after the self-calibration: errors of gains, backgrounds and their drift, over the signal of the
substrate, on the synthetic samples of benchmarks/crystal.py (1 to 2 % of the reading), and the iterations of the fit.
With drift held fixed their heights are wrong by 20 to 30 um."""
_JUMPS = {"robust_limits": (10.0, 10.0, 10.0, 8.0), "jump_limits": (100.0, 30.0, 10.0, 4.0)}
"""A beam along the normal sees depth jumps only at walls as steep as itself, so edges are cut gradually. Edges that the
start cuts by mistake stay cut otherwise, with strips of substrate 60 um too low at the foot of a tall crystal.
Source: graduated non-convexity, Blake and Zisserman, Visual Reconstruction (1987)."""


def calibrate_rotated(stack: MicrographStack, *, keeps_multiple: bool = True) -> MicrographStack:
    """Bring aligned scans of a rotated sample into units of the beam by a constant albedo.

    Iterates: the surface found with one calibration gives the next one the distance of each point and the multiple
    scattering, whose factor is fitted.

    `Calibration.priors` leaves gains, backgrounds, their drift and the distance to the fit, which determines them again
    from the same readings and a better surface. So the prior of the distance is as wide as the calibration's own.

    Args:
        stack: aligned readings.
        keeps_multiple: leave multiple scattering in the result, for a method that predicts it itself (`refine`).
    """
    found = self_calibrate(stack)
    done, note, is_subtracted = _in_beam_units(stack, found), "predicted, not converged", False
    for _ in range(_MAX_ITERATIONS):
        try:
            relief = _relief_of(done)
        except PredictionError as error:
            note = f"not predicted and not subtracted: {error}"
            break
        before, found = found, self_calibrate(stack, relief=relief, start=found)
        multiple = (found.multiple * found.signal)[:, None, None] * relief.multiple
        done, is_subtracted = _in_beam_units(stack.replace(counts=stack.counts - multiple), found), not keeps_multiple
        changes = abs(np.mean(found.share - before.share)), abs(found.polar_deg - before.polar_deg)
        if all(change < limit for change, limit in zip(changes, _CONVERGED, strict=True)):
            note = "predicted, converged"
            break
    calibrated = _in_beam_units(stack, found) if keeps_multiple else done
    priors = _PRIORS | _JUMPS | ({} if stack.scan_time is None else _DRIFT_PRIORS)
    priors |= {"level_std_um": distance_std(calibrated.instrument, calibrated.instrument.polar_std_deg)}
    history = as_json(found._asdict()) | {"note": f"multiple scattering {note}"}
    return calibrated.replace(
        calibration=Calibration("constant_albedo", priors, is_subtracted),
        provenance={**stack.provenance, "self_calibrate": history},
    )


def _in_beam_units(stack: MicrographStack, found: SelfCalibration) -> MicrographStack:
    instrument = effective_instrument(stack.instrument, found.polar_deg)
    return apply_calibration(stack, found, substrate_signal(Optics.of(instrument)), instrument)


def _relief_of(stack: MicrographStack) -> Relief:
    """Compute the near-field heights of a calibrated stack and the multiple scattering of that surface.

    Pixels in fewer than three images get the height of the nearest valid one: slopes guessed there would make cliffs,
    which scatter much. The lowest part of the border is taken as the level of the substrate around.
    """
    settings = ReconstructSettings(method="nearfield", border="free")
    rec = reconstruct_stack(stack, settings)
    height = limited(rec.height[nearest_known(rec.is_valid)], Optics.of(stack.instrument))
    normals = np.where(rec.is_valid[..., None], rec.normals, np.array([0.0, 0.0, 1.0]))
    substrate = substrate_level(height)
    on_substrate = stack.replace(instrument=stack.instrument.at_distance(stack.instrument.sample_distance - substrate))
    predict = make_predictor(on_substrate, settings.refine.paths(height.size))
    multiple = predict(np.maximum(height - substrate, 0.0), normals).multiple
    return Relief(height, multiple / substrate_signal(Optics.of(stack.instrument))[:, None, None])
