"""Calibration of turned scans: multiple scattering is taken off before gains and background are found."""

import math

import numpy as np
import pytest

from benchmarks.alignment import INSTRUMENT
from benchmarks.crystal import DRIFTS, FIELD_UM, GAINS, SHARE, make_sample, record, true_normals
from helio_jax import turned
from helio_jax.config import load_instrument
from helio_jax.errors import GuardError
from helio_jax.instrument import Detector
from helio_jax.micrograph import MicrographStack
from helio_jax.prepare.resample import resample
from helio_jax.prepare.selfcalibrate import SelfCalibrateSettings, self_calibrate


@pytest.fixture(scope="module")
def aligned():
    """A crystal of 600 um on level ground by five turned scans of 41 x 41 pixels, background 75 % of the reading."""
    known = record(make_sample("crystal"), 41, 16, 4)
    return resample(known.scans, known.motions, "reference")


def test_background_is_found_beside_walls(aligned):
    """Catches multiple scattering taken for signal: it brightens flanks, and the background comes out 0.1 too low."""
    alone = self_calibrate(aligned)
    record = turned.calibrate_turned(aligned).provenance["self_calibrate"]
    assert abs(alone.polar_deg - 46.1) > 4.0  # single scattering in one plane only; or the test tests nothing
    assert np.abs(np.array(record["share"]) - SHARE).max() < 0.04
    assert np.abs(np.array(record["drift"]) - np.array(DRIFTS)).max() < 0.05
    assert np.allclose(np.array(record["gain"]) / record["gain"][0], np.array(GAINS) / GAINS[0], rtol=0.02)
    assert math.isclose(record["polar_deg"], 46.1, abs_tol=4.0)


def test_multiple_scattering_stays_for_a_fit(aligned):
    """The same calibration either way; what is taken off is light, less than level ground's signal, nowhere negative.

    Catches a fit that takes off multiple scattering a second time.
    """
    kept, without = (turned.calibrate_turned(aligned, keeps_multiple=k) for k in (True, False))
    assert kept.provenance["self_calibrate"]["gain"] == without.provenance["self_calibrate"]["gain"]
    flat = turned.flat_signal(kept.instrument)[:, None, None]
    taken = np.where(kept.is_observed, (kept.counts - without.counts) / flat, 0.0)
    assert taken.min() > -1e-9 and 0.05 < taken.max() < 1.0


def test_says_where_nothing_could_be_predicted(aligned, monkeypatch):
    """A surface too wild to trace from leaves the first calibration, and its record says so."""

    def refuse(stack):
        raise GuardError("too rough")

    monkeypatch.setattr(turned, "_relief_of", refuse)
    done = turned.calibrate_turned(aligned).provenance["self_calibrate"]
    assert done["share"] == self_calibrate(aligned).share.tolist()
    assert "not predicted" in done["note"] and "too rough" in done["note"]


def test_facets_side_by_side_are_not_taken_for_background():
    """Single scattering of pyramids in the far field, no noise, five azimuths: the background is found to 0.02.

    Catches readings averaged over the edges of facets: a mean of normals is shorter than one and reads as 0.78.
    """
    sample = make_sample("pyramids")
    axis = (np.arange(101) - 50) * FIELD_UM / 101
    azimuth = 2.0 * np.pi * np.arange(5) / 5
    to_aperture = np.stack([3120.0 * np.cos(azimuth), 3120.0 * np.sin(azimuth), np.full(5, 3000.0)], -1)
    signal = np.maximum(true_normals(sample, *np.meshgrid(axis, axis)) @ to_aperture.T / 3000.0, 0.0)  # level ground: 1
    reading = np.array(GAINS)[:, None, None] * (np.moveaxis(signal, -1, 0) * (1.0 - SHARE) + SHARE)
    detectors = tuple(
        Detector(name=f"turned{k}", center_um=(x, y), axes_um=(1790.0, 1400.0))
        for k, (x, y) in enumerate(to_aperture[:, :2].tolist())
    )
    instrument = load_instrument(INSTRUMENT).model_copy(update={"detector": detectors})
    found = self_calibrate(MicrographStack(reading, axis, axis, instrument))
    assert found.share == pytest.approx(SHARE, abs=0.02)
    assert found.polar_deg == pytest.approx(46.1, abs=1.5)
    np.testing.assert_allclose(found.gain, GAINS, rtol=0.003)
