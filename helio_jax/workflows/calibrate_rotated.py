"""Calibration of aligned scans of a turned sample: by their constant albedo, multiple scattering taken off.

Joins the self-calibration (`prepare.selfcalibrate`), which knows no surface, with the near-field solution and the
prediction of what its surface scatters more than once. On synthetic crystals with ground in the field the background
came out a fifth too low, and flanks of 55 degrees at 32, without it (benchmarks/crystal.py).
"""

import numpy as np

from helio_jax.arrays import as_json, nearest_known
from helio_jax.calibration.self_calibration import (
    Relief,
    SelfCalibrateSettings,
    SelfCalibration,
    distance_std,
    effective_instrument,
    self_calibrate,
)
from helio_jax.calibration.self_calibration import apply as apply_calibration
from helio_jax.errors import GuardError
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.instrument import Instrument
from helio_jax.inverse.methods import reconstruct_stack
from helio_jax.inverse.nearfield import limited
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack
from helio_jax.scene.border import substrate_level
from helio_jax.workflows.corrections import make_predictor

_ROUNDS, _SETTLED = 8, (0.01, 0.5)
"""The surface is found anew until share and polar angle [deg] change by less than this, or so often (flanks of 55 deg
are 40 by the first calibration of a tall crystal, and 52, 55 by the next ones)."""
_PRIORS = {"gain_std": 0.05, "offset_std": 0.1, "max_rounds": 12}
_DRIFT_PRIORS = {"drift_std": 0.1, "drift_degrees": (3, 3)}
"""What the self-calibration leaves open, handed on to the fit: how far gains, backgrounds and their drift, over level
ground's signal, were off on the synthetic samples of benchmarks/crystal.py (1 to 2 % of the reading), and its rounds.
Drift that is held bends the heights of those by 20 to 30 um."""
_JUMPS = {"robust_limits": (10.0, 10.0, 10.0, 8.0), "jump_limits": (100.0, 30.0, 10.0, 4.0)}
"""A beam along the normal sees no jumps but walls as steep as itself: edges begin whole and are cut by and by. Those
that the start parts by mistake stay so else, with strips of ground 60 um too low at the foot of a tall crystal.
Source: graduated non-convexity, Blake and Zisserman, Visual Reconstruction (1987)."""


def flat_signal(instrument: Instrument) -> np.ndarray:
    """Return the detection probability of the flat reference plane [detector]."""
    return substrate_signal(Optics.of(instrument))


def calibrate_turned(stack: MicrographStack, *, keeps_multiple: bool = True) -> MicrographStack:
    """Bring aligned scans of a turned sample into units of the beam by a constant albedo (`prepare.selfcalibrate`).

    Done several times: the surface found with one calibration tells the next one how far away each point is and what
    is scattered several times, which is taken off in the share that the readings ask for.

    What stays open is handed on to the fit (provenance, `self_calibrate.priors`): gains, backgrounds, their drift, and
    the distance: the fit finds it anew, from the same readings by a surface that is known better. So its prior is as
    wide as the calibration's own was.

    Args:
        stack: aligned readings.
        keeps_multiple: leave multiple scattering in the result, for a method that predicts it itself (`refine`).
    """
    found = self_calibrate(stack)
    done, note, is_off = _in_beam_units(stack, found), "not settled", False
    for _ in range(_ROUNDS):
        try:
            relief = _relief_of(done)
        except GuardError as error:
            note = f"not predicted, so calibrated with what is left of it: {error}"
            break
        before, found = found, self_calibrate(stack, relief=relief, start=found)
        taken = (found.multiple * found.signal)[:, None, None] * relief.multiple
        done, is_off = _in_beam_units(stack.replace(counts=stack.counts - taken), found), not keeps_multiple
        changes = abs(np.mean(found.share - before.share)), abs(found.polar_deg - before.polar_deg)
        if all(change < limit for change, limit in zip(changes, _SETTLED, strict=True)):
            note = "predicted until it settled"
            break
    return _noted(_in_beam_units(stack, found) if keeps_multiple else done, f"multiple scattering {note}", is_off)


def _in_beam_units(stack: MicrographStack, found: SelfCalibration) -> MicrographStack:
    instrument = effective_instrument(stack.instrument, found.polar_deg)
    return apply_calibration(stack, found, flat_signal(instrument), instrument)


def _noted(stack: MicrographStack, note: str, without_multiple: bool) -> MicrographStack:
    """Return a self-calibrated stack whose record says how multiple scattering was dealt with."""
    record = stack.provenance["self_calibrate"]
    priors = _PRIORS | _JUMPS | ({} if stack.scan_time is None else _DRIFT_PRIORS)
    priors |= {"level_std_um": distance_std(stack.instrument, SelfCalibrateSettings().polar_std_deg)}
    record = record | {"note": note, "without_multiple": without_multiple}
    record["priors"] = as_json(priors)
    return stack.replace(provenance={**stack.provenance, "self_calibrate": record})


def _relief_of(stack: MicrographStack) -> Relief:
    """Return heights of the near-field solution of a calibrated stack, and what its surface scatters several times.

    Beyond what three images show heights go on as at the nearest pixel; the slopes guessed there would be cliffs, which
    scatter much. The lowest part of the border is level ground, and there is such ground around.
    """
    settings = ReconstructSettings(method="nearfield", border="free")
    rec = reconstruct_stack(stack, settings)
    height = limited(rec.height[nearest_known(rec.is_valid)], Optics.of(stack.instrument))
    normals = np.where(rec.is_valid[..., None], rec.normals, np.array([0.0, 0.0, 1.0]))
    ground = substrate_level(height)
    above = stack.replace(instrument=stack.instrument.at_distance(stack.instrument.sample_distance - ground))
    predict = make_predictor(above, settings.refine.paths(height.size))
    multiple = predict(np.maximum(height - ground, 0.0), normals).multiple
    return Relief(height, multiple / flat_signal(stack.instrument)[:, None, None])
