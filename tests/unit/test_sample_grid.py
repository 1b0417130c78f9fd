"""Heights of an oblique beam on a regular grid of the sample frame, against surfaces in closed form."""

import math

import numpy as np
import pytest

from helio_jax.errors import GuardError, SceneError
from helio_jax.measure.sample_grid import resample_heights
from helio_jax.reconstruction import Reconstruction

TAN = math.tan(math.radians(30))


def hill(x, y):
    """A smooth hill that equals itself under no mirror."""
    return 60.0 * np.exp(-(((x - 30.0) / 90.0) ** 2) - ((y + 20.0) / 60.0) ** 2) + 0.05 * x - 0.02 * y


def seen(surface, bshem, step=5.0, azimuth=0.0) -> Reconstruction:
    """The heights of a surface as the beam sees them: the highest z with z = surface(X - z tx, Y - z ty)."""
    beam = bshem.beam.model_copy(update={"azimuth_deg": azimuth})
    instrument = bshem.model_copy(update={"beam": beam})
    x, y = np.arange(-250.0, 251.0, step), np.arange(-200.0, 201.0, 0.8 * step)
    tx, ty = instrument.beam_shift
    height = np.full((y.size, x.size), np.nan)
    for level in np.linspace(110.0, -40.0, 15001):  # the first surface that the beam meets
        meets = np.isnan(height) & (surface(x[None] - level * tx, y[:, None] - level * ty) >= level)
        height[meets] = level
    return Reconstruction(
        height=height,
        raster_x=x,
        raster_y=y,
        instrument=instrument,
        method="refine",
        normals=np.broadcast_to([0.0, 0.0, 1.0], (*height.shape, 3)),
        albedo=np.ones_like(height),
        is_valid=np.isfinite(height),
        reason=np.zeros_like(height),
        height_std=0.1 + 0.001 * np.abs(height),
    )


@pytest.mark.parametrize("azimuth", [0.0, 130.0])
def test_hill(bshem, azimuth):
    """The hill stands where it is in the sample, at every azimuth of the beam; the raster shows it 35 um beside.

    Catches a shift with the wrong sign (twice 35 um), one along x only, and grid positions that are not the file's.
    """
    rec = seen(hill, bshem, azimuth=azimuth)
    found = resample_heights(rec, 4.0)
    true = hill(found.x[None], found.y[:, None])
    is_known = np.isfinite(found.height)
    inner = (np.abs(found.x[None]) < 180) & (np.abs(found.y[:, None]) < 140)
    assert is_known[inner].all()
    assert np.abs(found.height - true)[is_known].max() < 0.15  # bilinear: pitch^2 / 8 times the curvature, 0.1 um
    assert np.abs(rec.height - hill(rec.raster_x[None], rec.raster_y[:, None])).max() > 10
    np.testing.assert_allclose(found.height_std[inner], 0.1 + 0.001 * np.abs(true[inner]), atol=0.02)


def test_shadow_stays_unknown(bshem):
    """Behind a wall of height d, where the beam does not come, d tan t of the substrate is unknown, and only there.

    Catches a sheet over the shadow, and a search that goes on below the surface.
    """
    found = resample_heights(seen(lambda x, y: 80.0 * ((x > -60) & (x < 40)) + 0 * y, bshem), 2.0)
    row = found.height[found.y.size // 2]
    at = lambda low, high: row[(found.x > low) & (found.x < high)]  # noqa: E731
    np.testing.assert_allclose(at(-50, 30), 80.0, atol=0.02)
    np.testing.assert_allclose(at(-200, -65), 0.0, atol=0.02)
    assert np.all(np.isnan(at(46, 40 + 80 * TAN - 6)))
    np.testing.assert_allclose(at(40 + 80 * TAN + 6, 200), 0.0, atol=0.02)


def test_normal_incidence_changes_nothing(bshem):
    """With the beam along the normal and the raster's pitch, heights, gaps and positions are those of the raster."""
    rng = np.random.default_rng(3)
    rec = seen(hill, bshem)
    beam = bshem.beam.model_copy(update={"incidence_deg": 0.0})
    height = rng.normal(size=rec.height.shape)
    is_valid = rng.uniform(size=height.shape) < 0.9
    is_valid[0, 0] = is_valid[-1, -1] = True
    square = 0.3 + 5.0 * np.arange(rec.raster_y.size)
    rec = rec.replace(
        height=height, is_valid=is_valid, raster_y=square, instrument=bshem.model_copy(update={"beam": beam})
    )
    found = resample_heights(rec, 5.0)
    np.testing.assert_allclose(found.x, rec.raster_x)
    np.testing.assert_allclose(found.y, rec.raster_y)
    np.testing.assert_allclose(found.height, np.where(is_valid, height, np.nan), atol=1e-12)
    np.testing.assert_allclose(resample_heights(rec, 5.0, use_all=True).height, height, atol=1e-12)


def test_refusals(bshem):
    """A pitch that is no length, a grid that fills the memory, heights none of which is valid."""
    rec = seen(hill, bshem, step=50.0)
    with pytest.raises(SceneError, match="grid pitch must be > 0 um, got -1"):
        resample_heights(rec, -1.0)
    with pytest.raises(SceneError, match="choose a larger pitch"):
        resample_heights(rec, 0.001)
    with pytest.raises(GuardError, match="no height is valid"):
        resample_heights(rec.replace(is_valid=np.zeros(rec.height.shape)), 10.0)
