"""The joint prior of an instrument's geometry: from the file, in the fit, in drawn instruments, and in error bars."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.alignment.resample import check_joinable, joined_instrument
from helio_jax.alignment.rigid import Rigid
from helio_jax.campaign import CampaignLaw
from helio_jax.errors import InputFileError, SceneError
from helio_jax.forward.render import Corrections
from helio_jax.geometry_prior import ROTATION_STD, GeometryPrior
from helio_jax.instrument import Covariance, Uncertainty
from helio_jax.inverse.correlated_errors import Errors
from helio_jax.inverse.fit import _incidence_error
from helio_jax.inverse.instrument_report import units_of
from helio_jax.inverse.posterior import exact_height_covariance, linearise, sample_posterior
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.state import FitState, set_corrections, with_responses
from helio_jax.inverse.steps import freeze
from helio_jax.micrograph import MicrographStack

SHIFT = 30.0
NAMES = ("plate shift x", "plate shift y", "sample distance")


def with_plate_error(instrument, std=(SHIFT, SHIFT, 20.0), correlation=0.5, **uncertainty):
    """Return an instrument whose plate is shifted by an unknown length, correlated with the distance."""
    matrix = np.eye(3)
    matrix[0, 2] = matrix[2, 0] = correlation
    covariance = Covariance(
        parameters=NAMES, units=("um", "um", "um"), std=std, correlation=tuple(map(tuple, matrix.tolist()))
    )
    update = {"covariance": covariance, "uncertainty": Uncertainty(**uncertainty)}
    return instrument.model_copy(update=update)


def test_a_moved_instrument_keeps_what_is_known_of_the_sample(bshem):
    """Its law; what is known of the plate's errors is of the stated one, and goes."""
    law = CampaignLaw(exponent=0.2, std=0.05)
    moved = with_plate_error(bshem.model_copy(update={"law": law})).moved(np.zeros((3, 2)), 10.0)
    assert moved.law == law and moved.covariance is None
    assert moved.sample_distance == pytest.approx(bshem.sample_distance + 10.0)


def test_shifted_plate_turns_all_apertures_together(bshem):
    """A shift along x turns every aperture by its closed form; distance correlates as stated.

    Catches wrong units, the order of polar angle and azimuth, and a lost correlation.
    """
    prior = GeometryPrior.of(with_plate_error(bshem, std=(SHIFT, 0.0, 20.0)))
    center = np.array([a.center for a in bshem.apertures()])
    radius, w = np.hypot(*center[:, :2].T), bshem.working_distance
    polar = SHIFT * center[:, 0] / radius * w / (w**2 + radius**2)
    azimuth = -SHIFT * center[:, 1] / radius**2
    along = np.array([0.5 * 20.0, *np.stack([polar, azimuth], 1).ravel()])
    expected = np.outer(along, along)
    expected[0, 0] = 20.0**2
    # what the shift alone explains; 0.001 of the largest direction is independent
    assert prior.covariance[1:, 1:] == pytest.approx(expected[1:, 1:], rel=3e-3, abs=3e-6 * expected[1:, 1:].max())
    assert prior.covariance[0] == pytest.approx(expected[0], rel=3e-3, abs=1e-9)
    factor = prior.factor()
    assert factor @ factor.T == pytest.approx(prior.covariance, rel=1e-9, abs=1e-15)


def test_draws_have_the_covariance(bshem):
    """20000 draws: 6 standard errors of a variance are 6 %. Rejects independent draws (0 instead of 0.5)."""
    prior = GeometryPrior.of(with_plate_error(bshem, incidence_deg=0.5))
    rng = np.random.default_rng(3)
    draws = [prior.draw(rng) for _ in range(20_000)]
    flat = np.array([[d, *np.stack([polar, azimuth], 1).ravel()] for d, polar, azimuth, _ in draws])
    size = np.sqrt(np.diag(prior.covariance))
    assert np.cov(flat.T) / np.outer(size, size) == pytest.approx(prior.covariance / np.outer(size, size), abs=0.06)
    assert np.std([d[3] for d in draws]) == pytest.approx(math.radians(0.5), rel=0.03)


def test_uncertainty_widens_a_covariance(bshem):
    """A user who states more than the calibration gets more; who states less, what was calibrated."""
    calibrated = GeometryPrior.of(with_plate_error(bshem))
    wider = GeometryPrior.of(with_plate_error(bshem, sample_distance_um=50.0, polar_deg=5.0))
    less = GeometryPrior.of(with_plate_error(bshem, sample_distance_um=1.0, polar_deg=0.01))
    assert wider.distance_std == pytest.approx(50.0, rel=1e-3)
    assert np.sqrt(np.diag(wider.covariance)[1::2].max()) == pytest.approx(math.radians(5.0), rel=1e-3)
    assert less.covariance == pytest.approx(calibrated.covariance)
    assert not GeometryPrior.of(bshem.model_copy(update={"uncertainty": Uncertainty()})).covariance.any()


def test_turned_scans_share_the_errors_of_their_plate(bshem):
    """Joined scans: each scan's apertures move as the plate does in its own frame, the same in all scans.

    Against the directions of joined instruments that are joined anew from moved ones. Rejects independent errors of
    every scan, and a plate that is shifted in the sample's frame, by which scans turned by 120 deg differ in sign.
    """
    one = with_plate_error(bshem, polar_deg=0.5, azimuth_deg=2.0)
    blank = MicrographStack(np.ones((3, 4, 4)), 10.0 * np.arange(4), 10.0 * np.arange(4), one, n_rays=1.0)
    scans = tuple(blank.replace(name=f"scan {k}", sample_rotation=t) for k, t in enumerate((0.0, 2.0)))
    motions = tuple(Rigid(s.sample_rotation, (0.0, 0.0)) for s in scans)
    joined = joined_instrument(scans, motions)
    found, own = GeometryPrior.of(joined).covariance, GeometryPrior.of(one).covariance
    floor = 3e-6 * np.diag(own).max()
    turned = np.zeros((12, 12))  # the second scan's azimuths are off by its rotation, too
    turned[7::2, 7::2] = ROTATION_STD**2
    assert found[1:, 1:] == pytest.approx(np.tile(own[1:, 1:], (2, 2)) + turned, rel=1e-5, abs=floor)
    for rows in (slice(1, 7), slice(7, 13)):
        assert found[0, rows] == pytest.approx(own[0, 1:], rel=1e-5, abs=1e-9)
    assert found[0, 0] == pytest.approx(own[0, 0], rel=1e-5)

    def directions(shift: float) -> np.ndarray:
        moved = one.moved(np.zeros((3, 2)), 0.0, plate_shift=(shift, 0.0))
        at = joined_instrument(tuple(s.replace(instrument=moved) for s in scans), motions)
        return np.array([d.aim(at.working_distance) for d in at.detector]).ravel()

    by_shift = (directions(1.0) - directions(-1.0)) / 2.0
    alone = joined_instrument(
        tuple(s.replace(instrument=with_plate_error(bshem, std=(SHIFT, 0.0, 0.0))) for s in scans), motions
    )
    expected = SHIFT**2 * np.outer(by_shift, by_shift) + turned
    assert GeometryPrior.of(alone).covariance[1:, 1:] == pytest.approx(expected, rel=5e-3, abs=1e-5 * expected.max())
    known = joined_instrument(
        tuple(s.replace(instrument=bshem.model_copy(update={"uncertainty": Uncertainty()})) for s in scans), motions
    )
    assert known.covariance is None
    long = tuple(s.replace(name=f"{'a' * 70} {k}") for k, s in enumerate(scans))
    assert GeometryPrior.of(joined_instrument(long, motions)).covariance == pytest.approx(found)
    for wrong in (one.model_copy(update={"uncertainty": Uncertainty()}), bshem):
        with pytest.raises(InputFileError, match=r"'scan 1' and 'scan 0' are scans by one pinhole plate.*uncertainty"):
            check_joinable((scans[0], scans[1].replace(instrument=wrong)))


def test_scans_by_different_plates_err_independently(bshem):
    """A plate with apertures in other directions, stated with the same table, and one with fewer, elsewhere.

    Rejects errors that are copied from the first scan, by name: those of a shifted plate are other ones of each.
    """
    one = with_plate_error(bshem, std=(SHIFT, 0.0, 0.0))
    elsewhere, further = (bshem.moved(np.full((3, 2), (0.0, np.radians(turn))), 0.0) for turn in (40.0, 80.0))
    others = (
        one.model_copy(update={"detector": elsewhere.detector}),
        with_plate_error(bshem.model_copy(update={"detector": further.detector[:2]}), std=(0.0, 0.0, 15.0)),
    )
    blank = MicrographStack(np.ones((3, 4, 4)), 10.0 * np.arange(4), 10.0 * np.arange(4), one, n_rays=1.0)
    few = MicrographStack(blank.counts[:2], blank.x, blank.y, others[1], n_rays=1.0, name="few")
    scans = blank.replace(name="first"), blank.replace(instrument=others[0], name="turned"), few
    check_joinable(scans)
    found = GeometryPrior.of(joined_instrument(scans, (Rigid(0.0, (0.0, 0.0)),) * 3)).covariance
    first, turned, last = (GeometryPrior.of(s.instrument).covariance for s in scans)
    floor = 3e-6 * first.max()
    is_azimuth = np.arange(6) % 2 == 1
    rotation = ROTATION_STD**2 * np.outer(is_azimuth, is_azimuth)
    assert found[1:7, 1:7] == pytest.approx(first[1:, 1:], rel=1e-5, abs=floor)
    assert found[7:13, 7:13] == pytest.approx(turned[1:, 1:] + rotation, rel=1e-5, abs=floor)
    assert found[1:7, 7:13] == pytest.approx(np.zeros((6, 6)), abs=floor)
    assert found[0, 0] == pytest.approx(last[0, 0], rel=1e-5)


def test_apertures_of_one_plate_err_alike_in_any_order(bshem):
    """A scan by two of three detectors, another with the table in another order: each aperture errs by the same.

    Rejects plates that are compared aperture by aperture in the order of the tables: their errors were independent.
    """
    uncertain = bshem.model_copy(update={"uncertainty": Uncertainty(polar_deg=2.0, azimuth_deg=1.0)})
    orders = (0, 1), (0, 1, 2), (2, 0, 1)
    scans = tuple(
        MicrographStack(
            np.ones((len(order), 4, 4)),
            10.0 * np.arange(4),
            10.0 * np.arange(4),
            uncertain.model_copy(update={"detector": tuple(bshem.detector[k] for k in order)}),
            n_rays=1.0,
            name=f"scan {number}",
        )
        for number, order in enumerate(orders)
    )
    check_joinable(scans)
    found = GeometryPrior.of(joined_instrument(scans, (Rigid(0.0, (0.0, 0.0)),) * 3)).covariance[1::2, 1::2]
    aperture = np.concatenate(orders)
    expected = np.radians(2.0) ** 2 * (aperture[:, None] == aperture)
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-5 * expected.max())
    other = scans[0].replace(instrument=scans[0].instrument.model_copy(update={"uncertainty": Uncertainty()}))
    with pytest.raises(InputFileError, match="'scan 0' and 'scan 1' are scans by one pinhole plate"):
        check_joinable((other, *scans[1:]))


@pytest.mark.parametrize("length", (62, 64))
def test_many_scans_and_long_names_are_joined(bshem, length: int):
    """Names of joined detectors differ and are not too long; more detectors than an instrument may have are refused."""
    detectors = tuple(d.model_copy(update={"name": f"{i}" * length}) for i, d in enumerate(bshem.detector))
    long = bshem.model_copy(update={"detector": detectors})
    blank = MicrographStack(np.ones((3, 4, 4)), 10.0 * np.arange(4), 10.0 * np.arange(4), long, n_rays=1.0, name="a")
    joined = joined_instrument((blank,) * 21, (Rigid(0.0, (0.0, 0.0)),) * 21)
    assert len(set(joined.detector_names)) == 63 and max(map(len, joined.detector_names)) <= 64
    GeometryPrior.of(joined)
    with pytest.raises(InputFileError, match="66 detectors in all, the limit is 64"):
        check_joinable((blank,) * 22)


@pytest.mark.parametrize("stated_deg", [0.0, 1.5])
@pytest.mark.parametrize("order", [(0, 1), (2, 0, 1)])
def test_a_part_of_a_plate_states_the_rows_of_its_own_apertures(bshem, order, stated_deg):
    """[covariance] of a part of the apertures, or in another order, agrees; with one variance 20 % larger it does not.

    Catches tables that are compared as they stand: those of a part can never be the same; and priors that are compared
    after [uncertainty] widened them: by how much depends on the largest error of an instrument's own apertures.
    """
    uncertainty = Uncertainty(polar_deg=stated_deg, azimuth_deg=stated_deg)

    def scan(order, factor, name):
        names = [bshem.detector_names[k] for k in order]
        of = ("sample distance", *(f"{kind} of {one}" for one in names for kind in ("polar", "azimuth")))
        std = (10.0, *np.repeat(1.0 + 0.5 * np.array(order), 2).tolist())
        table = Covariance(
            parameters=of,
            units=("um", *["deg"] * (len(of) - 1)),
            std=(*std[:-1], std[-1] * math.sqrt(factor)),
            correlation=tuple(map(tuple, np.eye(len(of)).tolist())),
        )
        known = {"detector": tuple(bshem.detector[k] for k in order), "covariance": table, "uncertainty": uncertainty}
        counts, x = np.ones((len(order), 4, 4)), 10.0 * np.arange(4)
        return MicrographStack(counts, x, x, bshem.model_copy(update=known), n_rays=1.0, name=name)

    check_joinable([scan((0, 1, 2), 1.0, "whole"), scan(order, 1.0, "part")])
    with pytest.raises(InputFileError, match=r"their tables \[covariance\] differ"):
        check_joinable([scan((0, 1, 2), 1.0, "whole"), scan(order, 1.2, "part")])


def test_covariance_of_another_instrument_is_refused(bshem):
    """Catches a table that is silently ignored after a detector was renamed."""
    covariance = Covariance(parameters=("polar of left over",), units=("deg",), std=(1.0,), correlation=((1.0,),))
    with pytest.raises(SceneError, match=r"polar of left over.*calibrate it anew"):
        GeometryPrior.of(bshem.model_copy(update={"covariance": covariance}))


AXIS = 40.0 * (np.arange(13) - 6.0)
RASTER = hx.Raster(AXIS, AXIS)
NOISE = 0.002


@pytest.fixture(scope="module")
def hill():
    """A hill of 40 um, heights and slopes."""
    x, y = np.meshgrid(AXIS, AXIS)
    with jax.enable_x64(True):
        surface = hx.surface_of_heights(40.0 * np.exp(-0.5 * (x**2 + y**2) / 110.0**2), RASTER)
        return jax.tree.map(lambda f: np.asarray(f, np.float64), surface)


def images_of(hill, optics) -> np.ndarray:
    """Render without masks and multiple scattering."""
    with jax.enable_x64(True):
        none = Corrections.none((optics.n_detectors, *RASTER.shape))
        return np.asarray(hx.render(hill, jax.tree.map(jnp.asarray, optics), RASTER, corrections=none))


def fit_at(hill, instrument):
    """Pose the fit of the hill's images under an instrument, at the truth."""
    signal = images_of(hill, hx.Optics.of(instrument))
    variance = np.full(signal.shape, (NOISE * signal.mean()) ** 2)
    problem = FitProblem.of(signal, variance, instrument, RASTER, hill, ReconstructSettings())
    state = set_corrections(problem, FitState.at(problem, hill), Corrections.none(signal.shape), hill)
    return problem, with_responses(problem, state)


def linearised(problem, state):
    """Linearise a fit at its state."""
    return linearise(*freeze(problem, state, problem.settings.robust_limits[-1], problem.settings.jump_limits[-1]))


def test_fit_has_the_joint_prior(bshem, hill):
    """Its derivative by the unknowns of the geometry is that by independent ones, times the prior's factor.

    The report gives each direction the prior of the file. Catches a fit that drops the correlations, and a factor that
    is transposed.
    """
    plain = bshem.model_copy(update={"uncertainty": Uncertainty()})
    joint = with_plate_error(plain)
    prior = GeometryPrior.of(joint)
    polar, azimuth = np.degrees(np.sqrt(np.diag(prior.covariance)[1:].reshape(-1, 2).max(0)))
    stated = Uncertainty(sample_distance_um=20.0, polar_deg=polar, azimuth_deg=azimuth)
    problems = [fit_at(hill, i) for i in (plain, joint, plain.model_copy(update={"uncertainty": stated}))]
    _, together, apart = linears = [linearised(*p) for p in problems]
    exact, less = (np.sqrt(np.diag(exact_height_covariance(f))).mean() for f in linears[:2])
    assert exact < less
    geometry = np.array([name.partition("[")[0] in ("distance", "aim") for name in together.names])
    assert together.names == apart.names and geometry.sum() == 7
    rows = slice(0, -len(together.names))  # all but the priors
    size = np.array([20.0, *np.radians([polar, azimuth] * 3)])
    by_units = apart.instrument[rows][:, geometry] / size
    found = together.instrument[rows][:, geometry]
    assert found == pytest.approx(by_units @ prior.factor(), rel=1e-6, abs=1e-9 * np.abs(found).max())
    matrix, units = units_of(problems[1][0], together.names)
    stds = np.linalg.norm(matrix, axis=1)[geometry]
    stds[np.array(units)[geometry] == "deg"] *= math.radians(1.0)
    assert stds == pytest.approx(np.sqrt(np.diag(prior.covariance)), rel=1e-6)


def test_incidence_that_is_not_fitted_is_in_the_error_bars(bshem, hill):
    """Data change by a wrong incidence as the images do, and heights by the answer of the fit to such data.

    Catches a missing term of the normals, of where the beam meets the surface, and a wrong sign or unit.
    """
    std = 0.2
    problem, state = fit_at(hill, bshem.model_copy(update={"uncertainty": Uncertainty(incidence_deg=std)}))
    unknowns, fixed = freeze(problem, state, problem.settings.robust_limits[-1], problem.settings.jump_limits[-1])
    error = _incidence_error(problem, unknowns, fixed)
    assert error is not None
    optics = jax.tree.map(jnp.asarray, problem.optics)
    tipped = [images_of(hill, optics.moved(incidence=s * math.radians(std))) for s in (1.0, -1.0)]
    expected = (0.5 * (tipped[0] - tipped[1]) * np.asarray(fixed.inverse_sigma)).ravel()
    assert error.ravel() == pytest.approx(expected, rel=1e-3, abs=2e-3 * np.abs(expected).max())
    linear = linearise(unknowns, fixed)
    dense = np.hstack([linear.surface.toarray() + linear.common @ linear.weights.T, linear.instrument])
    right = np.zeros(len(dense))
    error = 10.0 * error  # 2 deg: as large as what the noise leaves
    right[: len(expected)] = error.ravel()
    answer = np.linalg.lstsq(dense, right, rcond=None)[0][: 3 * AXIS.size**2 : 3]
    exact = np.sqrt(np.diag(exact_height_covariance(linear)) + answer**2)
    found = sample_posterior(linear, 4000, errors=Errors(unfitted=error)).height_std.ravel()
    assert np.abs(answer).max() > 0.3 * np.sqrt(np.diag(exact_height_covariance(linear))).min()
    assert found == pytest.approx(exact, rel=0.06)  # 5 standard errors
