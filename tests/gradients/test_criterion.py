"""The differentiable criterion of layouts: against closed forms, against `hx.fisher`, and its gradient."""

import jax
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.errors import SceneError
from helio_jax.forward.layout import Layout
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.criterion import MAX_PIXELS, Case, expect_errors, pose_case
from helio_jax.inverse.layout_objective import Goal, Ties
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings

W = 4000.0
RASTER = hx.Raster.regular((11, 11), 60.0)
X, Y = np.meshgrid(RASTER.x, RASTER.y)
EXACT = {"gain_std": 1e-6, "offset_std": 1e-6, "multiple_error": 0.0, "mask_error": 0.0}
KNOWN = ReconstructSettings(border_std_um=0.01, refine=RefineSettings(**EXACT))
"""Nothing but the heights is unknown, and the border lies on the substrate."""
SMALL = 3 * 2e4
"""Total area of apertures so small that each is a direction [um^2]."""


def ring(polar_deg: float, azimuths_deg: tuple[float, ...] = (0.0, 120.0, 240.0)) -> np.ndarray:
    return np.concatenate([np.full(3, np.radians(polar_deg)), np.radians(azimuths_deg), np.zeros(4)])


def free(area: float) -> Ties:
    """Three apertures whose polar angles, azimuths and areas are the unknowns."""
    return Ties(np.zeros(10), np.eye(10)[:, :9], area, W)


def optics(polar_deg: float, area: float) -> hx.Optics:
    with jax.enable_x64(True):
        layout = Layout(np.full(3, np.radians(polar_deg)), np.radians([0.0, 120.0, 240.0]), np.full(3, area / 3), W)
        return jax.tree.map(np.asarray, layout.optics(np.zeros(2), 0.0))


def oblique() -> hx.Optics:
    return hx.Optics.of(hx.load_instrument("bshem_wd4"))


@pytest.fixture(scope="module")
def flat() -> Goal:
    """A flat sample far below small apertures, beam along the normal, known gains, much noise."""
    case = pose_case(np.zeros((11, 11)), optics(40.0, SMALL), RASTER, 2e6, settings=KNOWN)
    return Goal((case,), (0.0,))


def variance(goal: Goal, vector: np.ndarray) -> float:
    return float(goal.assess(free(SMALL), vector[:9]).variance[0])


def test_variance_goes_with_the_contrast_of_small_apertures(flat):
    """An aperture of area A at polar angle p counts cos^4(p) A / (pi W^2), and the share tan(p) of it per slope.

    So the slopes' variance is a / (cos^4 tan^2), and that of the edges, whose floor goes with the noise of the signal,
    b / cos^4: two angles give a and b, which predict the other three to 2 %. Catches a wrong power of the distance
    (cos^3) and a variance that is not relative to the signal.
    """
    terms = lambda p: (np.cos(p) ** -4 * np.tan(p) ** -2, np.cos(p) ** -4)  # noqa: E731
    angles = np.radians([25.0, 62.0, 35.0, 45.0, 55.0])
    found = np.array([variance(flat, ring(float(np.degrees(p)))) for p in angles])
    slopes, edges = np.linalg.solve(np.array([terms(p) for p in angles[:2]]), found[:2])
    assert slopes > 3.0 * abs(edges)
    for p, value in zip(angles[2:], found[2:], strict=True):
        assert value == pytest.approx(np.dot(terms(p), (slopes, edges)), rel=0.02)


def test_even_azimuths_are_best_for_three(flat):
    """Three equal apertures at one polar angle know two slopes best at 120 deg from one another (A-optimality).

    Sum of 1 / eigenvalues of sum of e e' is least where both are equal. There the gradient by the azimuths is 0, and
    every displacement makes it worse. Catches a criterion that sees one slope only, or mixes up x and y.
    """
    even, ties = ring(45.0)[:9], free(SMALL)
    value, slope = flat.value_and_slope(ties, 0.0, even)
    assert np.abs(slope[3:6]).max() < 2e-3 * np.abs(flat.value_and_slope(ties, 0.0, ring(30.0)[:9])[1][:3]).max()
    for displaced in (np.array([0.0, 0.3, 0.0]), np.array([0.2, -0.2, 0.1]), np.array([0.0, -0.5, 0.5])):
        worse = even.copy()
        worse[3:6] += displaced
        found, back = flat.value_and_slope(ties, 0.0, worse)
        assert found > value + 0.005 and back[3:6] @ displaced > 0.0


def sample(kind: str) -> np.ndarray:
    if kind == "steep":
        return 400.0 * np.exp(-(X**2 + Y**2) / (2.0 * 120.0**2))
    return np.maximum(0.0, 200.0 - np.abs(X) - 0.3 * np.abs(Y))  # a roof: edges at kinks


@pytest.mark.parametrize("kind", ["steep", "roof"])
def test_agrees_with_sampled_errors(kind):
    """The variances are those of 4000 samples of `hx.fisher`: each to 1.1 %, their mean to 0.3 % or so.

    With masks, priors of gains and offsets, errors that agree between neighbours, a background. Catches a lost block,
    prior, or term of the correlated errors, each of which changes them by more than 3 %.
    """
    options = {"background": 20.0}
    found = hx.fisher(sample(kind), oblique(), RASTER, 1e5, n_samples=4000, **options)
    case = pose_case(sample(kind), oblique(), RASTER, 1e5, **options)
    with jax.enable_x64(True):
        expected = jax.tree.map(np.asarray, jax.jit(expect_errors)(case, oblique()))
    assert_same_std(np.sqrt(expected.variance) / found.height_std)
    assert expected.masked > 0.01


@pytest.mark.slow
def test_agrees_with_sampled_errors_of_an_uncertain_plate():
    """The same with distance, tilt and aperture angles unknown. Catches a nuisance that is taken for known."""
    unknown = Uncertainty(sample_distance_um=100.0, polar_deg=2.0, azimuth_deg=1.0, tilt_deg=0.5, discrepancy=0.01)
    options = {"uncertainty": unknown, "settings": ReconstructSettings(refine=RefineSettings(drift_std=0.02))}
    found = hx.fisher(sample("steep"), oblique(), RASTER, 1e5, n_samples=4000, **options)
    case = pose_case(sample("steep"), oblique(), RASTER, 1e5, **options)
    with jax.enable_x64(True):
        expected = jax.tree.map(np.asarray, jax.jit(expect_errors)(case, oblique()))
    assert_same_std(np.sqrt(expected.variance) / found.height_std)


def assert_same_std(ratio: np.ndarray) -> None:
    """Each of 121 standard deviations is known to 1.1 %, and 6 of these are a false alarm below 1e-6."""
    assert np.abs(ratio - 1.0).max() < 6.0 / np.sqrt(8000.0) and abs(ratio.mean() - 1.0) < 0.01


def posed() -> Case:
    return pose_case(sample("steep"), oblique(), RASTER, 1e5, background=20.0)


def test_slope_by_taylor_remainder():
    """log variance + weight * masked share: the remainder of the first order falls with the square of the step.

    Along a random direction of angles and areas, with masks, whose slices come into view one by one: the gradient has
    kinks about 1e-4 apart, so the steps are shorter. Catches a path without a gradient: the masks, the weights of the
    edges, the priors of the offsets that go with the signal.
    """
    goal, ties = Goal((posed(),), (0.0,)), free(3.9e6)
    rng = np.random.default_rng(4)
    x = np.concatenate([np.radians([33.0, 29.0, 36.0]), np.radians([10.0, 130.0, 235.0]), 0.1 * rng.normal(size=3)])
    way = rng.normal(size=9)
    value, slope = goal.value_and_slope(ties, 2.0, x)
    steps = np.array([2e-5, 1e-5, 5e-6])
    rests = [abs(goal.value_and_slope(ties, 2.0, x + h * way)[0] - value - h * slope @ way) for h in steps]
    assert abs(slope @ way) > 0.05
    assert rests[0] < 0.01 * steps[0] * abs(slope @ way)
    assert np.log2(rests[0] / rests[2]) / 2.0 == pytest.approx(2.0, abs=0.2)


def test_the_smoothed_criterion_has_no_kinks_where_pixels_exchange_ranks():
    """Along 3 deg without masks, the slope of the smoothed criterion changes evenly: all its changes add up to < 0.2.

    With the medians that the fit takes, they add up to five times that. Catches a smoothing over detectors alone.
    """
    goal = Goal((pose_case(sample("steep"), oblique(), RASTER, 1e5, background=20.0, is_masked=False),), (0.0,))
    ties, x, way = free(3.9e6), ring(33.0)[:9], np.array([0.6, -1.0, 0.3, 0.5, 0.2, -0.4, 0.1, 0.2, -0.3])
    steps = np.radians(np.arange(0.0, 3.0, 0.05))

    def sum_of_changes(is_smooth: bool) -> float:
        found = [goal._assessed(goal._optics(ties, x + t * way), 0.0, is_smooth=is_smooth)[0] for t in steps]
        slope = np.diff([np.log(f.variance[0]) for f in found]) / np.diff(steps)
        return np.abs(np.diff(slope)).sum()

    assert sum_of_changes(True) < 0.2
    assert sum_of_changes(False) > 1.0


def test_a_tie_pulls_the_gradient_back():
    """The slope by the unknowns of a symmetric pair is the sum of those of both apertures. Catches a lost sign."""
    goal, x = Goal((posed(),), (0.0,)), ring(35.0, (0.0, 110.0, -110.0))
    matrix = np.zeros((10, 1))
    matrix[[4, 5], 0] = 1.0, -1.0
    _, slope = goal.value_and_slope(Ties(x, matrix, 3.9e6, W), 0.0, np.zeros(1))
    _, both = goal.value_and_slope(free(3.9e6), 0.0, x[:9])
    assert slope[0] == pytest.approx(both[4] - both[5], rel=1e-6)


def test_what_is_refused():
    """A free border and too large a raster, each with its remedy. Catches a level that counts as known."""
    with pytest.raises(SceneError, match=r"needs reconstruct.border = 'flat', got 'free'"):
        pose_case(np.zeros((11, 11)), oblique(), RASTER, 1e5, settings=ReconstructSettings(border="free"))
    large = hx.Raster.regular((40, 40), 10.0)
    with pytest.raises(SceneError, match=f"at most {MAX_PIXELS} pixels, got 1600: coarsen"):
        pose_case(np.zeros((40, 40)), oblique(), large, 1e5)
