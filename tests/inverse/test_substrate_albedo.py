"""A dark substrate, which the flat border shows, and dark patches: of few pixels, and with background in one image."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.errors import PredictionError
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.albedo_search import search_albedo_patches
from helio_jax.inverse.explanations import MIN_CONTRADICTED, NARROW, OTHER_TRIED, Explanation, _Fits, share_of_areas
from helio_jax.inverse.methods import reconstruct_stack
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack
from tests.predictions import nothing_traced

N, ATOMS, SNR = 25, 1e6, 60.0
ALBEDO = 0.8


@pytest.mark.parametrize(
    ("albedo", "border", "gain_std", "is_dark"),
    [
        (ALBEDO, "flat", 0.02, True),
        (0.97, "flat", 0.02, False),
        (1.3, "flat", 0.02, False),
        (ALBEDO, "flat", 0.3, False),
        (ALBEDO, "free", 0.02, False),
    ],
)
def test_a_dark_substrate_shows_at_the_border(bshem, albedo, border, gain_std, is_dark):
    """Not by what the gains may explain, nor with a free border, where nothing is flat; a bright one is none.

    Catches searches for pits and objects in vain, and background taken for albedo above 1.
    """
    level = albedo * substrate_signal(hx.Optics.of(bshem))[:, None, None] * np.ones((3, N, N))
    noise = level / SNR * np.random.default_rng(3).standard_normal(level.shape)
    axis = 20.0 * (np.arange(N) - N // 2)
    variance = np.broadcast_to((ATOMS * level / SNR) ** 2, level.shape)
    stack = MicrographStack(ATOMS * (level + noise), axis, axis, bshem, variance=variance, n_rays=ATOMS)
    settings = ReconstructSettings.model_validate({"border": border, "refine": {"gain_std": gain_std}})
    assert _Fits(stack, settings, None, None).is_substrate_dark is is_dark


def patched(bshem, background=0.0):
    """Heights [y, x], where a patch of albedo 0.6 is, and micrographs without masks: a hill and a round patch.

    The patch is six pixels wide; `background` of the second image is not known, in shares of its median.
    """
    x = 40.0 * np.arange(N)
    gx, gy = np.meshgrid(x - x.mean(), x - x.mean())
    height = 150.0 * np.exp(-((gx + 120.0) ** 2 + gy**2) / 2 / 110.0**2)
    is_patch = (gx - 150.0) ** 2 + (gy + 220.0) ** 2 < 120.0**2
    optics, raster = hx.Optics.of(bshem), hx.Raster(x=x, y=x)
    signal = np.asarray(hx.render(height, optics, raster, corrections="none", albedo=np.where(is_patch, 0.6, 1.0)))
    counts = np.random.default_rng(5).poisson(ATOMS * signal).astype(float)
    counts[1] += background * np.median(counts[1])
    stack = MicrographStack(counts, x, x, bshem, variance=np.maximum(counts, 1.0), n_rays=ATOMS, noise="poisson")
    return height, is_patch, stack


def test_a_round_area_is_an_area():
    """A disc of `NARROW` pixels' width counts and a line of less, along any direction, does not."""
    y, x = np.mgrid[:N, :N] - N // 2
    assert share_of_areas(x**2 + y**2 <= 0.25 * NARROW**2) > MIN_CONTRADICTED
    for turn in np.radians([0.0, 30.0, 45.0]):
        assert share_of_areas(np.abs(np.cos(turn) * x + np.sin(turn) * y) < 0.5 * (NARROW - 1)) == 0.0


def test_a_round_patch_of_few_pixels_is_found(bshem):
    """Its albedo to 1 %, the heights to 1 %; taken for relief, it is a hollow of 130 um in heights of 150 um."""
    height, is_patch, stack = patched(bshem)
    settings = ReconstructSettings.model_validate({"refine": {"objects": False, "samples": 0}})
    rec = reconstruct_stack(stack, settings, lambda _: nothing_traced)
    assert np.median(rec.albedo[is_patch]) == pytest.approx(0.6, rel=0.01)
    assert np.sqrt(np.mean((rec.height - height) ** 2)) < 0.01 * np.ptp(height)


def test_a_patch_is_found_with_background_in_one_image(bshem):
    """The one patch there is, within some pixels; with images at different levels all of the surface leans."""
    _, is_patch, stack = patched(bshem, 0.2)
    found = search_albedo_patches(stack, ReconstructSettings(), nothing_traced)
    albedo = found.albedo / np.median(found.albedo)
    assert len(found.objects) == 1 and np.mean((albedo < 0.8) != is_patch) < 0.01
    assert np.median(albedo[is_patch]) == pytest.approx(0.6, abs=0.1)


@dataclass(frozen=True)
class Known:
    """A fit of a known misfit, with an instrument as far from what is stated."""

    misfit: float
    strain: float = 0.0
    is_interrupted: bool = False
    status: str = ""
    state: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(surface=None))
    problem: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(region=np.ones((2, 2), int), anchors=None))


TOO_STEEP = PredictionError("too steep")
OBJECT = np.ones((2, 2), int)


@pytest.mark.parametrize(
    ("number", "with_objects", "without", "kept"),
    [
        (OBJECT, Known(50.0), Known(40.0), 40.0),
        (OBJECT, Known(50.0), Known(60.0), 50.0),
        (OBJECT, Known(50.0), Known(40.0, strain=20.0), 50.0),
        (OBJECT, Known(50.0, strain=20.0), Known(60.0), 60.0),
        (OBJECT, Known(50.0), TOO_STEEP, 50.0),
        (OBJECT, TOO_STEEP, Known(60.0), 60.0),
        (OBJECT, TOO_STEEP, TOO_STEEP, None),
        (OBJECT, Known(50.0), KeyboardInterrupt(), 50.0),
        (None, Known(50.0), Known(40.0), 50.0),
    ],
)
def test_patches_are_fitted_without_objects_too(monkeypatch, number, with_objects, without, kept):
    """Objects that leave something unexplained may be a patch: a hill with one became an object three times as high.

    What is known of the instrument counts. Levels that are no objects stay; what cannot be predicted, or is
    interrupted, loses nothing.
    """
    is_undecided = np.zeros((2, 2), bool)

    def given(fit):
        if isinstance(fit, BaseException):
            raise fit
        return fit

    patches = AlbedoPatches(np.array([[0, 1], [0, 0]]), np.log([0.7]))
    monkeypatch.setattr(_Fits, "albedo_search", SimpleNamespace(patches=patches))
    monkeypatch.setattr(_Fits, "is_strained", lambda self, fit: True)
    monkeypatch.setattr(_Fits, "traced_misfit", lambda self, fit: fit.misfit)
    monkeypatch.setattr(_Fits, "instrument_improvement", lambda self, fit, other: fit.strain - other.strain)
    monkeypatch.setattr(_Fits, "fitted", lambda self, *args: given(with_objects))
    monkeypatch.setattr(_Fits, "from_steps", lambda self, patches: Explanation(given(without), is_undecided))
    found = _Fits(None, ReconstructSettings(), None, None).from_albedo_patches(
        Explanation(Known(100.0), is_undecided, number), np.zeros((3, 2, 2))
    )
    if kept is None:
        assert found is None
        return
    assert found.fit.misfit == kept
    assert (found.number is None) == (number is None or found.fit is without)
    assert (OTHER_TRIED in found.fit.status) == isinstance(without, KeyboardInterrupt)
