"""Calibration of turned scans: multiple scattering is taken off before gains and background are found."""

import math

import numpy as np
import pytest

from benchmarks.alignment import INSTRUMENT
from benchmarks.crystal import DRIFTS, FIELD_UM, GAINS, SHARE, Sample, make_sample, record, true_normals
from helio_jax import reconstruct
from helio_jax.alignment.resample import resample, scan_times
from helio_jax.alignment.rigid import Rigid
from helio_jax.calibration.self_calibration import Relief, self_calibrate
from helio_jax.errors import PredictionError
from helio_jax.forward.optics import Optics
from helio_jax.instrument import Detector
from helio_jax.micrograph import MicrographStack, ScanAlignment
from helio_jax.workflows import calibrate_rotated as rotated
from helio_jax.workflows.scene_file import load_instrument


@pytest.fixture(scope="module")
def aligned():
    """A crystal of 600 um on level ground by five turned scans of 41 x 41 pixels, background 75 % of the reading."""
    known = record(make_sample("crystal"), 41, 16, 4)
    return resample(known.scans, known.motions, "reference")


@pytest.fixture(scope="module")
def calibrated(aligned):
    """The same with and without its multiple scattering."""
    return [rotated.calibrate_rotated(aligned, keeps_multiple=k) for k in (True, False)]


def test_background_is_found_beside_walls(aligned, calibrated):
    """Catches multiple scattering taken for signal: it brightens flanks, and the background comes out 0.1 too low."""
    alone = self_calibrate(aligned)
    record = calibrated[1].provenance["self_calibrate"]
    assert abs(alone.polar_deg - 46.1) > 4.0  # single scattering in one plane only; or the test tests nothing
    assert np.abs(np.array(record["share"]) - SHARE).max() < 0.04
    assert np.abs(np.array(record["drift"]) - np.array(DRIFTS)).max() < 0.05
    assert np.allclose(np.array(record["gain"]) / record["gain"][0], np.array(GAINS) / GAINS[0], rtol=0.02)
    assert math.isclose(record["polar_deg"], 46.1, abs_tol=4.0)


def test_multiple_scattering_stays_for_a_fit(calibrated):
    """The same calibration either way; what is taken off is light, less than level ground's signal, nowhere negative.

    Catches a fit that takes off multiple scattering a second time.
    """
    kept, without = calibrated
    assert kept.provenance["self_calibrate"]["gain"] == without.provenance["self_calibrate"]["gain"]
    flat = rotated.substrate_signal(Optics.of(kept.instrument))[:, None, None]
    taken = np.where(kept.is_observed, (kept.counts - without.counts) / flat, 0.0)
    assert taken.min() > -1e-9 and 0.05 < taken.max() < 1.0


def test_what_stays_open_is_handed_to_the_fit(calibrated):
    """Gains, backgrounds and their drift as unknowns, and the distance as far as 5 deg make it; more rounds.

    A setting that is given wins. Catches a fit that takes the calibration for exact.
    """
    kept, _ = calibrated
    rec = reconstruct(kept, "nearfield", border="free", corrections=0, samples=0, refine={"max_rounds": 1})
    asked = rec.provenance["reconstruct"]["refine"]  # as `refine` would have them
    assert asked["max_rounds"] == 1 and asked["drift_std"] == 0.1 and asked["gain_std"] == 0.05
    radius, distance = 3120.0, kept.instrument.sample_distance
    per_degree = (radius**2 + distance**2) / radius * math.radians(1.0)  # distance = radius / tan(polar angle)
    assert asked["level_std_um"] == pytest.approx(5.0 * per_degree, rel=0.02)


def test_says_where_nothing_could_be_predicted(aligned, monkeypatch):
    """A surface too wild to trace from leaves the first calibration, and its record says so."""

    def refuse(stack):
        raise PredictionError("too rough")

    monkeypatch.setattr(rotated, "_relief_of", refuse)
    done = rotated.calibrate_rotated(aligned).provenance["self_calibrate"]
    assert done["share"] == self_calibrate(aligned).share.tolist()
    assert "not predicted" in done["note"] and "too rough" in done["note"]


def pyramids(drifts=((0.0,),) * 5):
    """Return readings of pyramids: single scattering in the far field, no noise, five azimuths, a sample not turned."""
    sample = make_sample("pyramids")
    axis = (np.arange(101) - 50) * FIELD_UM / 101
    azimuth = 2.0 * np.pi * np.arange(5) / 5
    to_aperture = np.stack([3120.0 * np.cos(azimuth), 3120.0 * np.sin(azimuth), np.full(5, 3000.0)], -1)
    signal = np.maximum(true_normals(sample, *np.meshgrid(axis, axis)) @ to_aperture.T / 3000.0, 0.0)  # level ground: 1
    told = [[math.cos(a) / 1000.0, math.sin(a) / 1000.0, 0.0] for a in azimuth]  # each scan has its own direction
    x, y = np.meshgrid(axis, axis)
    times = np.stack([a * x + b * y + c for a, b, c in told])
    drift = np.stack([np.polynomial.legendre.legval(t, (0.0, *d)) for t, d in zip(times, drifts, strict=True)])
    reading = np.array(GAINS)[:, None, None] * (np.moveaxis(signal, -1, 0) * (1.0 - SHARE) + SHARE + drift)
    detectors = tuple(
        Detector(name=f"turned{k}", center_um=(x, y), axes_um=(1790.0, 1400.0))
        for k, (x, y) in enumerate(to_aperture[:, :2].tolist())
    )
    instrument = load_instrument(INSTRUMENT).model_copy(update={"detector": detectors})
    return MicrographStack(reading, axis, axis, instrument, alignment=ScanAlignment(tuple(map(tuple, told))))


def test_facets_side_by_side_are_not_taken_for_background():
    """Pyramids without drift: the background is found to 0.02.

    Catches readings averaged over the edges of facets: a mean of normals is shorter than one and reads as 0.78.
    """
    found = self_calibrate(pyramids(), drift_degree=0)
    assert found.share == pytest.approx(SHARE, abs=0.02)
    assert found.polar_deg == pytest.approx(46.1, abs=1.5)
    np.testing.assert_allclose(found.gain, GAINS, rtol=0.003)


def test_drift_of_each_background_is_found():
    """Pyramids whose backgrounds drift by 10 to 20 % of the reading, as the measured ones do: found to 0.01.

    What is left after the background is taken off is the signal, to 0.02 of level ground's. Catches a background that
    is constant in time, which is out by 0.1 then and makes slopes of it, and time along a wrong direction.
    """
    stack = pyramids(DRIFTS)
    found = self_calibrate(stack)
    np.testing.assert_allclose(found.drift, DRIFTS, atol=0.01)
    assert found.share == pytest.approx(SHARE, abs=0.03)
    steady = self_calibrate(stack, drift_degree=0)
    still = self_calibrate(pyramids())
    time = stack.scan_time
    rest = [(stack.counts - f.background(time)) / f.signal[:, None, None] for f in (found, steady)]
    signal = (pyramids().counts - still.background(time)) / still.signal[:, None, None]
    errors = [float(np.std(r - signal)) for r in rest]
    assert errors[0] < 0.03 and errors[1] > 0.1, errors


def test_time_of_turned_scans():
    """A point recorded in a scan's first or last row has the time -1 or 1, whatever the scan's turn and shift.

    Catches the fast axis for the slow one, and a rotation the other way round.
    """
    axis = (np.arange(41) - 20.0) * 20.0
    scan = MicrographStack(np.ones((1, 41, 41)), axis, axis, load_instrument(INSTRUMENT))
    for stack, row in ((scan, 1), (scan.replace(fast_axis="y"), 0)):
        motion = Rigid(1.2, (30.0, -50.0))
        ((a, b, c),) = scan_times((stack,), (motion,))
        for time, at in ((-1.0, -400.0), (0.0, 0.0), (1.0, 400.0)):
            place = np.array([123.0, 123.0])
            place[row] = at
            x, y = motion.inverse().apply(place)
            assert a * x + b * y + c == pytest.approx(time, abs=1e-9)


def test_what_stands_closer_to_the_plate_is_seen_from_there():
    """Pyramids 900 um high under an aperture at 46 deg, near field: with the heights the angle is right, else not.

    Catches one direction for all heights, which a tall crystal's flanks then pay for.
    """
    flat = pyramids()
    height = 3.0 * make_sample("pyramids").surface(*np.meshgrid(flat.x, flat.y))
    normal = true_normals(
        Sample(lambda x, y: 3.0 * make_sample("pyramids").surface(x, y), None), *np.meshgrid(flat.x, flat.y)
    )
    centers = np.array([a.center for a in flat.instrument.apertures()])
    ray = np.concatenate(
        [
            np.broadcast_to(centers[:, None, None], (5, 101, 101, 2)),
            np.broadcast_to(3000.0 - height, (5, 101, 101))[..., None],
        ],
        -1,
    )
    size = (3120.0**2 + 3000.0**2) ** 2 / 3000.0**2 * ray[..., 2] / np.sum(ray**2, -1) ** 2
    signal = np.maximum(np.sum(normal * ray, -1), 0.0) * size
    reading = np.array(GAINS)[:, None, None] * (signal * (1.0 - SHARE) + SHARE)
    stack = flat.replace(counts=reading)
    near = self_calibrate(stack, Relief(height, np.zeros(stack.shape)), drift_degree=0)
    far = self_calibrate(stack, drift_degree=0)
    assert near.share == pytest.approx(SHARE, abs=0.02)
    assert abs(near.polar_deg - 46.1) < 0.6 < 1.0 < abs(far.polar_deg - 46.1)
    assert near.misfit < far.misfit
