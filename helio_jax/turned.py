"""Calibration of aligned scans of a turned sample: by their constant albedo, multiple scattering taken off.

Joins the self-calibration (`prepare.selfcalibrate`), which knows single scattering only, with the linear solution and
the prediction of what its surface scatters more than once. On synthetic crystals with ground in the field the
background came out a fifth too low, and flanks of 55 degrees at 32, without it (benchmarks/crystal.py).
"""

import numpy as np

from helio_jax.arrays import border_mask
from helio_jax.errors import GuardError
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack
from helio_jax.predict import make_predictor
from helio_jax.prepare.selfcalibrate import SelfCalibration, effective_instrument, self_calibrate
from helio_jax.prepare.selfcalibrate import apply as apply_calibration
from helio_jax.reconstruct.formfactor import SpotGeometry
from helio_jax.reconstruct.photometric import limited
from helio_jax.reconstruct.settings import ReconstructSettings
from helio_jax.reconstruct.solve import reconstruct_stack

_GROUND = 0.05
"""Quantile of the border's heights that is taken for level ground."""


def flat_signal(instrument: Instrument) -> np.ndarray:
    """Return the detection probability of the flat reference plane [detector]."""
    return SpotGeometry(instrument).form_factor(np.zeros(1))[:, 2, 0]


def calibrate_turned(stack: MicrographStack, *, keeps_multiple: bool = True) -> MicrographStack:
    """Bring aligned scans of a turned sample into units of the beam by a constant albedo (`prepare.selfcalibrate`).

    Done twice: what the surface of a first, linear solution scatters several times is predicted and taken off before
    the second, for else gains and background take it for signal. The lowest part of the border lies on level ground.

    Args:
        stack: aligned readings.
        keeps_multiple: leave multiple scattering in the result, for a method that predicts it itself.
    """
    first = _in_beam_units(stack, self_calibrate(stack))
    try:
        multiple = _multiple_of(first)
    except GuardError as error:
        return _noted(first, f"multiple scattering not predicted, so calibrated with it: {error}")
    reading = first.provenance["self_calibrate"]
    scale = np.asarray(reading["gain"]) * (1.0 - reading["share"]) / flat_signal(first.instrument)
    without = stack.replace(counts=stack.counts - scale[:, None, None] * multiple)
    found = self_calibrate(without)
    calibrated = _in_beam_units(stack if keeps_multiple else without, found)
    return _noted(calibrated, "multiple scattering predicted once", without_multiple=not keeps_multiple)


def _in_beam_units(stack: MicrographStack, found: SelfCalibration) -> MicrographStack:
    instrument = effective_instrument(stack.instrument, found.polar_deg)
    return apply_calibration(stack, found, flat_signal(instrument), instrument)


def _noted(stack: MicrographStack, note: str, *, without_multiple: bool = False) -> MicrographStack:
    """Return a self-calibrated stack whose record says how multiple scattering was dealt with."""
    record = stack.provenance["self_calibrate"] | {"multiple": note, "without_multiple": without_multiple}
    return stack.replace(provenance={**stack.provenance, "self_calibrate": record})


def _multiple_of(stack: MicrographStack) -> np.ndarray:
    """Return the multiple scattering [detector, y, x] of the linear solution's surface, in units of the beam."""
    settings = ReconstructSettings(method="linear", border="free")
    rec = reconstruct_stack(stack, settings)
    frame = border_mask(rec.height.shape, settings.border_fraction)
    height = limited(np.maximum(rec.height - np.quantile(rec.height[frame], _GROUND), 0.0), stack)
    return make_predictor(stack, settings.refine.paths(height.size))(height, rec.normals).multiple
