"""How the instrument is fitted: edges cut at first, freed from the first round on, error bars, names of findings."""

from types import SimpleNamespace

import numpy as np
import pytest

from helio_jax.forward.optics import Raster
from helio_jax.forward.render import Corrections
from helio_jax.forward.surface import Surface
from helio_jax.instrument import Uncertainty
from helio_jax.inverse import fit as refine
from helio_jax.inverse.instrument_report import plain_name
from helio_jax.inverse.law_prior import law_prior
from helio_jax.inverse.occlusion import find_occlusion_edges
from helio_jax.inverse.posterior import Posterior, birge_ratio
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_edges_are_cut_behind_rims_only(way):
    """A hill that falls steeply along the beam and changes all images there; the same steep rise before it stays.

    Catches the beam's direction reversed, edges of the other axis, and cuts where the images show no wall.
    """
    height, slope = np.zeros((20, 30)), np.zeros((20, 30))
    slope[:, 8:10], slope[:, 20:22] = 3.0, -3.0
    signal = np.ones((3, 20, 30))
    signal[:, :, 10:20] = 2.0
    surface = Surface(height, slope, np.zeros_like(slope))
    found = find_occlusion_edges(signal, np.full(signal.shape, 1e-3), surface, (0.577 * way, 0.0), 1)
    columns = set(np.flatnonzero(found.any(0)))
    right, wrong = (set(range(18, 23)), set(range(6, 12)))[:: 1 if way > 0 else -1]
    assert columns & right and not columns & wrong and found[:, list(columns)].all()
    assert not find_occlusion_edges(signal, np.full(signal.shape, 1e-3), surface, (0.577 * way, 0.0), 0).any()
    assert not find_occlusion_edges(
        np.ones_like(signal), np.full(signal.shape, 1e-3), surface, (0.577 * way, 0.0), 1
    ).any()


def test_parameters_have_plain_names():
    """Catches polar angle and azimuth exchanged, and a detector named by its number."""
    names = "forward", "left"
    shown = {
        "aim[1, 0]": "polar left",
        "aim[0, 1]": "azimuth forward",
        "tilt[1]": "tilt y",
        "distance[0]": "distance",
        "drift[1, 3]": "drift left 3",
        "log_gain[0]": "log_gain forward",
        "occluded[]": "occluded",
        "law[1]": "width of the lobe",
    }
    prior = law_prior(RefineSettings(law="broad_specular"))
    assert {name: plain_name(name, names, prior) for name in shown} == shown


@pytest.mark.parametrize("polar_deg, is_free", [(0.0, False), (3.0, True)])
def test_unknown_geometry_is_free_from_the_first_round_on(bshem, monkeypatch, polar_deg, is_free):
    """Catches heights fitted to a stated geometry that is wrong: they close rims, and no later round opens them again.

    Where the geometry is known, the first round keeps gains and offsets, for its prediction is still crude.
    """
    said = []

    class Enough(Exception):
        pass

    def step(problem, state, limit, cut, is_instrument_free, occluded):
        said.append((is_instrument_free, occluded is not None))
        raise Enough

    monkeypatch.setattr(refine, "step", step)
    instrument = bshem.model_copy(update={"uncertainty": Uncertainty(polar_deg=polar_deg)})
    flat, signal = np.zeros((12, 12)), np.ones((3, 12, 12))
    start, settings = Surface(flat, flat, flat), ReconstructSettings()
    problem = FitProblem.of(signal, 1e-4 * signal, instrument, Raster.regular(flat.shape, 30.0), start, settings)
    with pytest.raises(Enough):
        refine.fit_heights(problem, start, lambda *surface: Corrections.none(signal.shape))
    assert said == [(is_free, is_free)]


def ratio_of(values: np.ndarray, left: np.ndarray) -> float:
    """Birge ratio of combinations that independent errors leave with these variances."""
    return birge_ratio(values, np.diag(left), np.diag(left))


def test_birge_ratio():
    """Values drawn as right priors have it give 1; three times as far off gives 3; what data do not tell is left out.

    200 combinations: the ratio of right ones has a standard deviation of 0.05; the limit is three of them.
    Catches the posterior's share of the variance forgotten, and untold combinations counted, which lower the ratio.
    """
    rng = np.random.default_rng(4)
    left = np.full(200, 0.4)
    values = np.sqrt(1.0 - left) * rng.normal(size=left.size)
    assert ratio_of(values, left) == pytest.approx(1.0, abs=0.15)
    assert ratio_of(3.0 * values, left) == pytest.approx(3.0, rel=0.15)
    with_untold = np.concatenate([3.0 * values, np.zeros(50)]), np.concatenate([left, np.full(50, 0.99)])
    assert ratio_of(*with_untold) == pytest.approx(3.0, rel=0.15)
    assert ratio_of(np.zeros(2), np.ones(2)) == 1.0


def test_birge_ratio_of_what_data_should_not_tell():
    """A combination whose error stays that of the prior, found five prior deviations off: nothing explains that.

    The offsets of a ball's images came out 7 deviations off, with error bars as wide as the prior: 29 % too low, said
    to be known to 5 %. Rejects leaving such combinations out. A third of a deviation is linear theory's own error.
    """
    for left in (0.9, 0.99, 1.0):
        assert ratio_of(np.array([5.0, 0.0]), np.array([left, 0.5])) > 5.0
        assert ratio_of(np.array([0.2, 0.3]), np.array([left, 0.5])) == 1.0


def test_birge_ratio_where_errors_agree_between_pixels():
    """Combinations of which errors that agree leave 1.9 instead of 0.3, drawn so: 1, to 0.15; three times as far: 3.

    The contrast of sphere A's images, found 3 prior deviations off, is such a one. Rejects 1 - S, which is negative
    (its error bars were 6 % instead of 1 %), and 1 - C, which gives 1.8.
    """
    n, rng = 200, np.random.default_rng(6)
    independent, spread = 0.3 * np.eye(n), 1.9 * np.eye(n)
    values = np.sqrt(1.0 - 0.3 + 1.6) * rng.normal(size=n)
    assert birge_ratio(values, independent, spread) == pytest.approx(1.0, abs=0.15)
    assert birge_ratio(3.0 * values, independent, spread) == pytest.approx(3.0, rel=0.15)


def test_inflating_twice_counts_each_contradiction_once():
    """Two groups, each three times off, inflate by the product, whatever the order. Rejects inflated error bars as own.

    Covariances of 0.1: three expected deviations are 3 sqrt(0.9).
    """
    names = ("log_gain[0]", "distance[0]")
    none = np.zeros((1, 2, 2))
    posterior = Posterior(none, np.zeros((1, 2)), np.zeros((2, 2, 2)), 0.1 * np.eye(2), names)
    off = 3.0 * np.sqrt(0.9)
    parameters = SimpleNamespace(log_gain=np.array([off]), distance=np.array([off]))
    for order in (("log_gain", "distance"), ("distance", "log_gain")):
        found = posterior
        for name in order:
            found = found.inflated(parameters, (name,))
        assert found.inflation == pytest.approx(9.0, rel=1e-6)
