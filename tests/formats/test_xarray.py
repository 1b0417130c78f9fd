"""Records as xarray datasets, and the message where xarray is not installed."""

import sys

import numpy as np
import pytest

from helio_jax.errors import MissingDependencyError, SceneError
from helio_jax.heightmap import HeightMap
from helio_jax.micrograph import MicrographStack
from tests.height_maps import make_rec


def test_message_without_xarray(monkeypatch):
    """Catches an ImportError that does not say what to install."""
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'helio-jax\[xarray\]'"):
        make_rec(lambda x, y: x, n=(4, 5)).to_xarray()


def test_reconstruction():
    """Asymmetric heights keep place, axes, units and gaps; samples and reasons go along; point_x at oblique incidence.

    Catches exchanged axes, positions of the raster for those of the points, and invalid heights as numbers.
    """
    pytest.importorskip("xarray")
    is_valid = np.ones((12, 17), bool)
    is_valid[2, 3] = False
    rec = make_rec(lambda x, y: 0.1 * x + 0.02 * y, n=(12, 17), incidence=30.0, is_valid=is_valid)
    rec = rec.replace(height_samples=np.arange(2 * 12 * 17.0).reshape(2, 12, 17))
    found = rec.to_xarray()
    assert found.height.dims == ("y", "x") and found.height.attrs["units"] == "um"
    np.testing.assert_array_equal(found.x, rec.raster_x)
    np.testing.assert_array_equal(found.y, rec.raster_y)
    at = found.height.sel(x=rec.raster_x[9], y=rec.raster_y[4])
    assert float(at) == rec.height[4, 9] and float(at.point_x) == rec.x[4, 9]
    assert np.isnan(found.height[2, 3]) and int(found.height.isnull().sum()) == 1
    assert float(rec.to_xarray(invalid="keep").height[2, 3]) == rec.height[2, 3]
    assert found.height_samples.dims == ("sample", "y", "x") and "too few images" in found.reason.attrs["flag_meanings"]
    assert found.normals.sel(component="z").min() == 1.0 and found.attrs["method"] == "linear"
    with pytest.raises(SceneError, match="--invalid must be one of"):
        rec.to_xarray(invalid="zero")


def test_stack_and_height_map(bshem):
    """Detectors by name, orders from 1; a height map has x and y of its own."""
    pytest.importorskip("xarray")
    n = len(bshem.detector)
    orders = np.random.default_rng(0).uniform(1.0, 2.0, (2, n, 4, 5))
    x, y = np.arange(5.0), 3.0 + np.arange(4.0)
    found = MicrographStack(orders.sum(0), x, y, bshem, by_order=orders).to_xarray()
    for k, name in enumerate(bshem.detector_names):
        np.testing.assert_array_equal(found.counts.sel(detector=name), orders[:, k].sum(0))
    np.testing.assert_array_equal(found.by_order.sel(order=2, detector=bshem.detector_names[1]), orders[1, 1])
    z = np.arange(20.0).reshape(4, 5)
    assert float(HeightMap(z, x, y).to_xarray().height.sel(x=2.0, y=6.0)) == z[3, 2]
