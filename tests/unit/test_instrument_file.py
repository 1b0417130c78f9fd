"""The instrument that a fit found, written for the next scan."""

import math

import numpy as np
import pytest

from helio_jax.errors import SceneError
from helio_jax.formats.toml import write_instrument
from helio_jax.instrument import Uncertainty
from helio_jax.reconstruction import Reconstruction
from helio_jax.workflows.scene_file import load_instrument, load_scene

SURE = Uncertainty(polar_deg=5.0, azimuth_deg=3.0, tilt_deg=0.5)
AIM = np.radians([[4.0, -2.0], [-3.0, 1.0], [2.0, 2.5]])
FOUND = {
    "polar forward": [4.0, 0.8, 5.0, "deg"],
    "polar left": [2.0, 1.1, 5.0, "deg"],
    "azimuth right": [1.0, 70.0, 3.0, "deg"],
    "log_gain forward": [0.1, 9.0, 0.3, "relative"],
}


def fitted(bshem, values) -> Reconstruction:
    """A substrate whose fit moved the apertures by `AIM` and the sample by 55 um."""
    instrument = bshem.model_copy(update={"uncertainty": SURE}).moved(AIM, 55.0)
    provenance = {"instrument": {"values": values}, "stack": {"source": {"file": "scan\n[plate].mat"}}}
    flat, x = np.zeros((2, 3)), np.arange(3.0)
    up = np.broadcast_to([0.0, 0.0, 1.0], (2, 3, 3))
    about = {"normals": up, "albedo": flat + 1.0, "is_valid": flat == 0.0, "reason": flat.astype(np.uint8)}
    return Reconstruction(flat, x, x[:2], instrument, "refine", provenance=provenance, **about)


def test_fitted_instrument_comes_back_from_its_file(bshem, tmp_path):
    """Catches the stated apertures written instead of the fitted ones, and prior deviations instead of posterior ones.

    The name of a file from elsewhere must stay in its comment; an angle that is not known at all has the largest
    deviation that a file may state.
    """
    rec, path = fitted(bshem, FOUND), tmp_path / "found.toml"
    write_instrument(rec, path)
    read = load_instrument(path)
    assert read.detector == rec.instrument.detector != bshem.detector
    assert read.beam == bshem.beam and read.working_distance == bshem.working_distance
    assert read.uncertainty == Uncertainty(polar_deg=1.1, azimuth_deg=30.0, tilt_deg=0.5)


def test_distance_of_the_sample_is_the_scenes(bshem, tmp_path):
    """Catches the calibration sample's distance handed on to another sample, in the table or over the scene's own."""
    polar = {name: value for name, value in FOUND.items() if not name.startswith("azimuth")}
    write_instrument(fitted(bshem, polar), tmp_path / "found.toml")
    assert load_instrument(tmp_path / "found.toml").plate.sample_distance_um is None
    assert load_instrument(tmp_path / "found.toml").uncertainty == SURE.model_copy(update={"polar_deg": 1.1})
    scene = 'extends = "found.toml"\n[plate]\nsample_distance_um = 4321.0\n[sample]\nkind = "flat"\n'
    scan = "[scan]\nnx = 4\nny = 4\npixel_size_um = 30.0\n"
    (tmp_path / "scene.toml").write_text(scene + scan, encoding="utf-8")
    loaded = load_scene(tmp_path / "scene.toml")
    assert loaded.sample_distance == 4321.0
    centers = np.array([a.center for a in loaded.apertures()])
    stated = np.array([a.center for a in bshem.apertures()])
    moved = np.arctan(np.hypot(*centers.T) / loaded.working_distance)
    assert moved - np.arctan(np.hypot(*stated.T) / bshem.working_distance) == pytest.approx(AIM[:, 0])
    assert math.isclose(np.arctan2(*centers[0][::-1]), AIM[0, 1])


def test_an_instrument_that_was_not_fitted_is_not_called_so(bshem, tmp_path):
    """Catches the stated apertures written as fitted ones, after nearfield or a fit by a known instrument."""
    with pytest.raises(SceneError, match="uncertainty"):
        write_instrument(fitted(bshem, {"log_gain forward": [0.1, 9.0, 0.3, "relative"]}), tmp_path / "found.toml")
    assert not (tmp_path / "found.toml").exists()
