"""Multiple scattering with guided first bounces: a furnace, the plain tracer, and guides that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import t as student
from stats import assert_likely, assert_mean
from test_closed_forms import SKIES, furnace

from helio_jax.errors import GuardError
from helio_jax.heightmap import HeightMap
from helio_jax.scene.body import COSINE
from helio_jax.scene.maps import HeightMapSample
from helio_jax.scene.scattering import BroadSpecularLaw, CosineLaw, CosinePowerLaw
from helio_jax.scene.shapes import Sphere, SpheresSample
from helio_jax.trace import guided
from helio_jax.trace.guided import Guide, trace_multiple
from helio_jax.trace.intersect import MISS
from helio_jax.trace.run import first_hits, make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.tally import ESCAPED, LOST

SEEDS = range(8)
FINE = 35, 27
"""Beam positions so dense that neighbouring pixels see the same."""
LAWS = {
    "cosine": None,
    "albedo 0.6": {COSINE: CosineLaw(albedo=0.6).terms()},
    "lobe": {COSINE: BroadSpecularLaw(sigma_deg=20.0, diffuse_fraction=0.5).terms()},
}


def ball(bshem, law: str = "cosine", n: tuple[int, int] = (7, 5)):
    """Return an experiment on a ball that touches a substrate, and n beam positions about its foot [y, x]."""
    body = SpheresSample(spheres=(Sphere(radius_um=200.0, cap_height_um=400.0),), size_um=1.2e4).build()
    x, y = np.meshgrid(np.linspace(-330.0, 330.0, n[0]), np.linspace(-280.0, 280.0, n[1]))
    return lambda seed: make_experiment(body, bshem, TraceSettings(rays=8, seed=seed), LAWS[law]), x, y


def runs(make, x, y, n_paths: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of the mean over `SEEDS` [detector, y, x], so many paths in each pixel."""
    first = first_hits(make(0).intersector, make(0).instrument, x.ravel(), y.ravel())
    found = np.array([trace_multiple(make(seed), first, x, y, n_paths * x.size) for seed in SEEDS])
    return found.mean(0), found.var(0, ddof=1) / len(SEEDS)


def unguided(n_pixels: int) -> Guide:
    """Return a guide by which paths take all cells alike."""
    return Guide(guided.AREA[None].copy(), np.zeros(n_pixels, int), 1.0)


def noted_gains(monkeypatch) -> list[float]:
    """Return a list to which the gain of every further guide is added."""
    of_pilot, gains = guided.make_guide, []

    def noted(*args):
        guide = of_pilot(*args)
        gains.append(guide.gain)
        return guide

    monkeypatch.setattr(guided, "make_guide", noted)
    return gains


@pytest.mark.parametrize("name", ["sphere", "slot"])
def test_furnace(name):
    """Below a detector all over the sky what is not scattered into it at once is later: the sum is 1, but for escapes.

    The mean over the pixels, limit 0.2 %, four standard deviations. Catches a weight that does not go with the cell,
    random numbers that do not fill it, and the hidden part of the aperture left out.
    """
    body, x, y = furnace(name)
    experiment = make_experiment(body, SKIES["aperture"][0], TraceSettings(rays=64, max_events=500))
    single = trace_pixels(experiment, x, y)
    assert single.fates[ESCAPED].sum() < 1e-3 * single.fates.sum()
    first = first_hits(experiment.intersector, experiment.instrument, x, y)
    grid = (15, 15)
    found = trace_multiple(experiment, first, x.reshape(grid), y.reshape(grid), 1024 * x.size).ravel()
    total = single.mean[0, 0] + found
    assert found.max() > 0.3
    assert abs(total.mean() - 1.0) < 2e-3, total.mean()


@pytest.mark.parametrize("law", LAWS)
def test_it_equals_the_plain_tracer(bshem, law):
    """About a ball: the mean of all pixels, and each detector's rows (Student's t, Sidak), as plain tracing gives them.

    Catches weights that are not followed into later flights, in the fused loop ("cosine"), with adsorbed atoms, and in
    the hits of lobes; 3 % of the multiple scattering of all pixels is rejected.
    """
    make, x, y = ball(bshem, law)
    plain = trace_pixels(
        make_experiment(make(0).intersector, bshem, TraceSettings(rays=512, branches=64, seed=99), LAWS[law]),
        x.ravel(),
        y.ravel(),
    )
    true, error = (a[1:].sum(0).reshape(-1, *x.shape) for a in (plain.mean, plain.variance))
    found, variance = runs(make, x, y, 1000)
    wide = np.sqrt(variance + error)
    assert np.sqrt((wide**2).sum()) < 0.03 / 6.0 * true.sum()
    assert_mean(found.mean(), true.mean(), np.sqrt((variance + error).sum()) / true.size, f"ball, {law}")
    t = np.abs((found - true).sum(2)) / np.sqrt((variance + error).sum(2))
    p = 2.0 * student.sf(t, len(SEEDS) - 1)
    assert_likely(float(-np.expm1(p.size * np.log1p(-p.min()))), f"rows of pixels about a ball, {law}")


def test_a_wrong_guide_costs_noise_only(bshem, monkeypatch):
    """Paths that prefer the cells in which the pilot met least: the same mean, and more than five times the variance.

    Catches weights that hold for the right guide only. Without a guide the variance is more than 1.5 times as large.
    """
    make, x, y = ball(bshem, n=FINE)
    of_pilot = guided.make_guide
    as_many = lambda *args: replace(of_pilot(*args), gain=1.0)  # noqa: E731
    monkeypatch.setattr(guided, "make_guide", as_many)
    right, variance = runs(make, x, y, 256)

    def opposite(*args):
        guide = as_many(*args)
        least = np.where(guide.shares <= guided.AREA, guided.AREA, 0.0)
        return replace(guide, shares=0.8 * least / least.sum((1, 2), keepdims=True) + 0.2 * guided.AREA)

    monkeypatch.setattr(guided, "make_guide", opposite)
    wrong, of_wrong = runs(make, x, y, 256)
    assert of_wrong.sum() > 5.0 * variance.sum()
    assert_mean(wrong.mean(), right.mean(), np.sqrt((of_wrong + variance).sum()) / wrong.size, "wrong guide")
    monkeypatch.setattr(guided, "make_guide", lambda *args: unguided(x.size))
    _, without = runs(make, x, y, 256)
    assert without.sum() > 1.5 * variance.sum()


def test_lobes_are_as_noisy_as_without_a_guide(bshem, monkeypatch):
    """A law of lobes only: there is no guide, the gain is 1, and the paths are the same."""
    monkeypatch.setitem(LAWS, "power", {COSINE: CosinePowerLaw(exponent=0.5).terms()})
    make, x, y = ball(bshem, "power")
    gains = noted_gains(monkeypatch)
    found, variance = runs(make, x, y, 64)
    monkeypatch.setattr(guided, "make_guide", lambda *args: unguided(x.size))
    plain, of_plain = runs(make, x, y, 64)
    np.testing.assert_allclose(gains, 1.0)
    np.testing.assert_allclose(found, plain, atol=1e-12)
    np.testing.assert_allclose(variance, of_plain, atol=1e-12)


def test_fewer_paths_have_the_noise_of_plain_ones(bshem, monkeypatch):
    """As many as the pilots ask for, less than 2 / 3: the variance is that of the plain number within 40 %."""
    make, x, y = ball(bshem, n=FINE)
    gains = noted_gains(monkeypatch)
    _, variance = runs(make, x, y, 512)
    monkeypatch.setattr(guided, "make_guide", lambda *args: unguided(x.size))
    _, plain = runs(make, x, y, 512)
    assert min(gains) > 1.7
    assert 1.0 / 1.4 < variance.sum() / plain.sum() < 1.4


def test_a_guide_does_not_vouch_for_itself(bshem, monkeypatch):
    """A level surface with noise of slopes, 3 %: little is met, each time elsewhere; variance as with plain paths.

    At most twice as large. Rejects a gain by the hits that made the guide: up to 50, and ten times the variance.
    """
    axis = 10.0 * np.arange(-20.0, 21.0)
    height = gaussian_filter(np.random.default_rng(0).normal(size=(41, 41)), 0.7)
    height *= 0.03 * 10.0 / np.std(np.diff(height))
    body = HeightMapSample.of(HeightMap(height, axis, axis)).build()
    x, y = np.meshgrid(axis[5:-5], axis[5:-5])
    make = lambda seed: make_experiment(body, bshem, TraceSettings(rays=8, seed=seed))  # noqa: E731
    gains = noted_gains(monkeypatch)
    _, variance = runs(make, x, y, 800)
    monkeypatch.setattr(guided, "make_guide", lambda *args: unguided(x.size))
    _, plain = runs(make, x, y, 800)
    assert max(gains) < guided.MOST_GAIN and variance.sum() < 2.0 * plain.sum()


def test_lobes_have_no_weights(bshem, monkeypatch):
    """Half cosine, half lobe: atoms of the lobe have the weight 1, of the others few have.

    Rejects weights of the cells for lobes, which draw their directions otherwise: 1.7 times the variance.
    """
    make, x, y = ball(bshem, "lobe", FINE)
    real, seen = guided.follow, []

    def noted(e, event, ids, paths, offset, tally):
        seen.append((tally.weights[paths.pixel, paths.path], paths.density != 0.0))
        real(e, event, ids, paths, offset, tally)

    monkeypatch.setattr(guided, "follow", noted)
    runs(make, x, y, 64)
    weights, by_lobe = map(np.concatenate, zip(*seen, strict=True))
    assert by_lobe.any() and np.all(weights[by_lobe] == 1.0) and np.mean(weights[~by_lobe] == 1.0) < 0.1


def test_atoms_that_start_below_the_surface_are_refused(bshem):
    """First points that lie inside the ball and the substrate: atoms meet them from behind."""
    make, x, y = ball(bshem)
    first = first_hits(make(0).intersector, bshem, x.ravel(), y.ravel())
    inside = replace(first, point=first.point - 1e-2 * first.normal, surface=np.zeros_like(first.surface))
    with pytest.raises(GuardError, match="from behind"):
        trace_multiple(make(0), inside, x, y, 64 * x.size)


def test_lost_atoms_count_by_their_weight(bshem):
    """One pixel of 35, beside those of the pilot, starts inside: of plain atoms 2.9 % would be lost.

    Rejects guided paths counted as they are or divided by the gain, and a check of the pilot's pixels alone.
    """
    make, x, y = ball(bshem)
    first = first_hits(make(0).intersector, bshem, x.ravel(), y.ravel())
    is_inside = np.arange(x.size) == 0
    point = np.where(is_inside[:, None], first.point - 1e-2 * first.normal, first.point)
    inside = replace(first, point=point, surface=np.where(is_inside, 0, first.surface))
    trace_multiple(make(0), inside, x, y, 64 * x.size, max_lost=0.031)
    with pytest.raises(GuardError, match="from behind"):
        trace_multiple(make(0), inside, x, y, 64 * x.size, max_lost=0.026)


def test_lost_atoms_are_those_of_plain_paths(bshem, monkeypatch):
    """A ball and a substrate that atoms meet from behind: the share lost is that of plain paths, 5 %.

    Rejects a sum of guided paths without their weights: twice as many.
    """
    make, x, y = ball(bshem, n=FINE)
    first = first_hits(make(0).intersector, bshem, x.ravel(), y.ravel())

    class Inverted:
        def __init__(self, intersector):
            self.intersector = intersector

        def __getattr__(self, name):
            return getattr(self.intersector, name)

        def nearest(self, *rays):
            hits = self.intersector.nearest(*rays)
            return replace(hits, is_back=hits.surface != MISS)

    shares = []
    monkeypatch.setattr(guided, "check_rays", lambda fates, missing, n, limit: shares.append(fates[LOST] / n))
    of_pilot = guided.make_guide
    for guide in (lambda *args: replace(of_pilot(*args), gain=1.0), lambda *args: unguided(x.size)):
        monkeypatch.setattr(guided, "make_guide", guide)
        experiment = replace(make(0), intersector=Inverted(make(0).intersector))
        trace_multiple(experiment, first, x, y, 64 * x.size)
    assert shares[0] == pytest.approx(shares[1], rel=0.05) and 0.02 < shares[1] < 0.5
