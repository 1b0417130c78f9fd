"""The reference program's counts, per order and detector, against the expected estimator.

False-alarm rate: the suite's (stats.py); wrong models are rejected at p < 1e-9 with the same statistics.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from stats import assert_likely, pooled_chi2

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from benchmarks.reference_counts import TRENCH_ORDERS, order_p_values
from benchmarks.reference_sets import broad_sets, flat_sets, sphere_set, trench_sets
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings


def test_sphere_orders(shared):
    """Orders 1, 2, 3, 4+ of sphere A; catches wrong bounce laws, next-event weights and order labels."""
    p = order_p_values(sphere_set(shared), TraceSettings(rays=256, branches=32, n_orders=13))
    assert p.min() > 1e-4, p


@pytest.mark.parametrize("wrong", [{"mirror": True}, {"cap_height_um": 700.0}])
def test_sphere_rejects_wrong_models(shared, wrong):
    """The same test must fail for mirrored columns and for a burial wrong by 0.02 mm."""
    p = order_p_values(sphere_set(shared, **wrong), TraceSettings(rays=64, branches=8, n_orders=13))
    assert p[:, 0].max() < 1e-9


@pytest.mark.parametrize("number", [0, 1])
def test_broad_sources(shared, number):
    """Gaussian and uniform source with a 50 um pinhole; catches a wrong angular law or pinhole position."""
    p = order_p_values(broad_sets(shared)[number], TraceSettings(rays=8192, branches=16, n_orders=13))
    assert p.min() > 1e-4, p


def test_flat_at_twelve_distances(shared):
    """Our flat equals the cosine-law integral (spot size aside: 2e-5) and the counts; the wrong rotation does not."""
    chi2, is_wrong_seen = 0.0, False
    for count_set, exact in flat_sets(shared):
        mean, _ = count_set.expect(TraceSettings(rays=64, n_orders=13))
        assert mean[0, :, 0] / count_set.n_rays == pytest.approx(exact, rel=2e-5)
        chi2 += np.sum((count_set.counts[0, :, 0] - mean[0, :, 0]) ** 2 / mean[0, :, 0])
        turned = count_set.instrument.model_copy(
            update={
                "detector": tuple(
                    d.model_copy(update={"rotation_deg": -d.rotation_deg}) for d in count_set.instrument.detector
                )
            }
        )
        tally = trace_pixels(make_experiment(count_set.body, turned, TraceSettings(rays=8)), np.zeros(1), np.zeros(1))
        is_wrong_seen |= bool(np.any(np.abs(tally.total()[0][:, 0] / exact - 1) > 2e-3))
    from scipy.stats import chi2 as law

    assert_likely(float(law.sf(chi2, 36)), "flat counts at 12 distances")
    assert is_wrong_seen


@pytest.mark.parametrize("number", [0, 1])
def test_trench_every_order(shared, number):
    """Twelve orders and above in a deep slot (mesh), first ellipse wins; analog and expected, and the stopped rays."""
    count_set, stopped = trench_sets(shared)[number]
    p = order_p_values(count_set, TraceSettings(rays=8192, branches=4, n_orders=13), TRENCH_ORDERS)
    assert p.min() > 1e-4, p
    settings = TraceSettings(rays=60_000, estimator="analog", n_orders=13)
    tally = trace_pixels(make_experiment(count_set.body, count_set.instrument, settings), count_set.x, count_set.y)
    scale = count_set.n_rays / tally.n_rays
    ours = tally.hits.transpose(2, 1, 0) * scale
    p = [
        pooled_chi2(count_set.counts[:, k, j], ours[:, k, j], ours[:, k, j] * scale)
        for k in range(4)
        for j in range(13)
        if ours[:, k, j].sum() > 200
    ]
    assert min(p) > 1e-4, p
    mean = scale * tally.fates[2].sum()
    assert abs(stopped.sum() - mean) < 6 * np.sqrt(mean * (1 + scale))
