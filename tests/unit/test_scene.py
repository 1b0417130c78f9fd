"""Scene files: what is read, and what is said when something is wrong."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from helio_jax.calibration.noise import NoiseSettings, add_noise
from helio_jax.errors import InputFileError, SceneError
from helio_jax.instrument import Instrument, Uncertainty
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows.scene_file import SceneFile, json_schema, load_instrument, load_scene, resolved

SCENES = Path(__file__).parents[2] / "scenes"
MINIMAL = """
[plate]
working_distance_um = 4000
[[detector]]
name = "a"
polar_deg = 30
half_angle_deg = 9
[sample]
kind = "flat"
[scan]
nx = 5
ny = 4
pixel_size_um = 10
"""


def write(folder: Path, text: str | bytes, name: str = "scene.toml") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def message(path, overrides=None) -> str:
    with pytest.raises(SceneError) as error:
        load_scene(path, overrides)
    assert str(path) in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_scenes_validate(path):
    """Every shipped scene loads without a warning, builds, stays below the plate and survives a round trip.

    Catches: a typo in a scene, a default that cannot be written down and read back.
    """
    scene = load_scene(path)
    assert scene.name == path.stem and scene.warnings() == []
    assert scene.build_body().max_height < scene.sample_distance
    assert SceneFile.model_validate(json.loads(json.dumps(resolved(scene)))).with_base_dir(scene.base_dir) == scene


@pytest.mark.parametrize("path", sorted((SCENES / "instruments").glob("*.toml")), ids=lambda p: p.stem)
def test_shipped_instruments_load(path):
    """Catches: a typo in an instrument file."""
    assert isinstance(load_instrument(path), Instrument)


def test_instrument_of_a_scene_keeps_its_uncertainty(tmp_path):
    """Every view's instrument carries the table [uncertainty]. Catches a fit that takes uncertain angles as exact."""
    scene = load_scene(write(tmp_path, MINIMAL + "sample_distances_um = [4000, 5000]\n[uncertainty]\npolar_deg = 2\n"))
    assert scene.uncertainty == Uncertainty(polar_deg=2.0)
    assert {i.uncertainty for i in (scene.instrument, *(v.instrument for v in scene.views()))} == {scene.uncertainty}


def test_sphere_a_is_the_reference():
    """Raster, pose and apertures of the reference simulation. Catches: any of its numbers mistyped."""
    scene = load_scene(SCENES / "sphere_a_full.toml")
    x, y = scene.positions()
    np.testing.assert_allclose(x, (np.arange(304) - 151.5) * 10 / np.cos(np.pi / 6), rtol=1e-12)
    np.testing.assert_allclose(y, (np.arange(351) - 175) * 10.0, atol=1e-9)
    assert (scene.sample_distance, scene.working_distance) == (4720.0, 4000.0)
    assert scene.scan.atoms_per_pixel == 35_000
    np.testing.assert_allclose(scene.build_body().spheres, [[0, 0, -280, 1000]])
    assert scene.detector_names == ("forward", "right", "left")
    wd3 = {d.name: d for d in load_instrument(SCENES / "instruments/bshem_wd3.toml").detector}
    assert {name: d.channel for name, d in wd3.items()} == {"forward": 4, "left": 2, "right": 3}
    for d in scene.detector:
        np.testing.assert_allclose(np.array(d.center_um) * 0.75, wd3[d.name].center_um, atol=0.01)
        np.testing.assert_allclose(np.array(d.axes_um) * 0.75, wd3[d.name].axes_um, atol=0.01)
        assert d.rotation_deg == wd3[d.name].rotation_deg
        azimuth = np.degrees(np.arctan2(d.center_um[1], d.center_um[0]))  # type: ignore[index]
        assert (azimuth - d.rotation_deg + 90) % 180 == pytest.approx(90.0, abs=0.01), "the long axis is radial"


def test_all_errors_at_once(tmp_path):
    """One message lists every error with its table path, value and limit. Catches: stopping at the first."""
    text = MINIMAL.replace("polar_deg = 30", "polar_deg = -30").replace("ny = 4", "ny = 4.5")
    text = text.replace("working_distance_um = 4000", "working_distance_um = 0\nworking_distanc = 3")
    text = text.replace("nx = 5\n", "") + "[beam]\nincidence_deg = 81\nsource = 'unifrm'\n[nois]\nseed = 1\n"
    told = message(write(tmp_path, text))
    for expected in (
        "8 errors:",
        "beam.incidence_deg = 81: must be <= 80 deg: choose a value at least 0 deg and at most 80 deg",
        "beam.source = 'unifrm': must be one of 'uniform', 'gaussian', 'pencil' or 'rays': did you mean 'uniform'?",
        "plate.working_distance_um = 0: must be > 0 um",
        "plate.working_distanc: unknown key 'working_distanc' (value 3): did you mean 'working_distance_um'?",
        "detector[0].polar_deg = -30: must be >= 0 deg",
        "scan.nx: is missing: add the key 'nx' to 'scan' (Columns)",
        "scan.ny = 4.5: must be a whole number",
        "nois: unknown key 'nois' (value {'seed': 1}): did you mean 'noise'?",
    ):
        assert expected in told


PLATE = {"kind": "scattering", "working_distance_um": 4000}
SPHERES = {"kind": "spheres", "spheres": [{"radius_um": 100.0}]}


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ({"sample.kind": "spheres"}, "sample.spheres: is missing: add the table 'spheres' to 'sample'"),
        ({"sample.kind": "sphere"}, "sample.kind = 'sphere': must be one of 'flat'"),
        ({"sample.kind": "sphere"}, "did you mean 'spheres'?"),
        (
            {"sample": {"kind": "step", "height_um": 3, "facng_deg": 3}},
            "sample.facng_deg: unknown key 'facng_deg' (value 3): did you mean 'facing_deg'?",
        ),
        ({"sample": SPHERES | {"spheres": []}}, "sample.spheres: must have at least 1 entries, got 0"),
        ({"sample": SPHERES | {"spheres": [{"radius_um": -1}]}}, "sample.spheres[0].radius_um = -1: must be > 0 um"),
        (
            {"sample": SPHERES | {"spheres": [{"radius_um": 1, "cap_height_um": 3}]}},
            "sample.spheres[0]: cap_height_um must be <= 2 * radius_um = 2 um, got 3",
        ),
        (
            {"sample": SPHERES | {"spheres": [{"radius_um": 9, "moat": {"width_um": 5000, "depth_um": 1}}]}},
            "sample: a moat reaches 5000 um from the centre, the substrate only 4000 um: enlarge size_um",
        ),
        ({"sample": {"kind": "step", "height_um": 9, "position_um": 4e3}}, "sample: the facet from 4000"),
        (
            {"sample": {"kind": "trench", "width_um": 9, "length_um": 8e3, "depth_um": 1}},
            "sample: the trench reaches 4000 um",
        ),
        ({"sample": {"kind": "pyramid", "base_um": 9, "height_um": 1, "top_um": 9}}, "top_um must be < base_um = 9 um"),
        (
            {"sample": {"kind": "step", "height_um": 4000}},
            "sample: the sample's top at 4000 um must be below the plate",
        ),
        ({"scan.nx": 5000, "scan.ny": 5000}, "scan: nx * ny must be <= 16777216 pixels, got 5000 x 5000"),
        ({"scan.center_um": [9000, 0]}, "scan.center_um: the raster about [9000.0, 0.0] um lies wholly beside"),
        ({"scan.center_um": [1, "x"]}, "scan.center_um[1] = 'x': must be a number"),
        ({"scan.center_um": [1]}, "scan.center_um: got [1]; element 1 is missing"),
        ({"beam.incidence_deg": 10, "beam.azimuth_deg": 33}, "scan.pitch: 'beam' needs beam.azimuth_deg"),
        ({"beam.pinhole_radius_um": float("nan")}, "beam.pinhole_radius_um = nan: must be a finite number"),
        ({"detector": []}, "detector: must have at least 1 entries, got 0"),
        ({"detector": [{"name": "x", "polar_deg": 3}]}, "detector[0]: detector 'x' must be given either by"),
        ({"detector": 3}, "detector = 3: must be a list in brackets"),
        ({"noise.gain": [1, 2]}, "noise.gain: must be one number or one per detector (1), got 2"),
        ({"noise.background_per_pixel": -1}, "noise.background_per_pixel: must be >= 0 counts, got [-1.0]"),
        ({"trace.rays": 7}, "trace.rays = 7: must be >= 8: choose a value at least 8 and at most 10000000"),
        ({"reconstruct": 3}, "reconstruct = 3: must be a table"),
        ({"plate.radius_um": 9}, 'plate: a transparent plate has no radius_um: set kind = "scattering" or remove'),
        ({"plate": {**PLATE, "size_um": [9, 0]}}, "plate: size_um must be > 0 um and <= 1e8 um, got [9.0, 0.0]"),
        ({"plate": PLATE}, "either radius_um (a disc) or size_um = [x, y] (a rectangle), got neither"),
        ({"plate": {**PLATE, "radius_um": 9, "material": "steel"}}, "plate.material: its material 'steel' is unknown"),
    ],
)
def test_error_messages(tmp_path, overrides, expected):
    """Each error names path, value, limit and remedy. Catches: pydantic's wording, union tags in paths."""
    told = message(write(tmp_path, MINIMAL), overrides)
    assert expected in told
    assert "pydantic" not in told and "Input should" not in told and "1 error:" in told


def test_cross_checks_are_told_together(tmp_path):
    """Checks between tables do not hide each other. Catches: raising at the first of them."""
    overrides = {"sample": {"kind": "step", "height_um": 5000}, "scan.center_um": [9000, 0], "noise.gain": [1, 2]}
    told = message(write(tmp_path, MINIMAL), overrides)
    assert "3 errors:" in told and "below the plate" in told and "wholly beside" in told and "noise.gain" in told


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "no such file"),
        (b"", "the file is empty"),
        (b"[plate]\nx = = 3", "is not valid TOML: Invalid value (at line 2, column 5)"),
        (b"[plate]\nname = '\xff\xfe'", "is not UTF-8 text (byte 0xff in line 2)"),
        (b"#" * 1_100_000, "the file has 1.1 MB, the limit is 1 MB"),
        (b"x = " + b"[" * 5000, "not valid TOML|nested too deeply"),
        (b"extends = 3", "extends must be the name of one TOML file"),
        (b"extends = 'none.toml'", "extends = 'none.toml': "),
    ],
)
def test_bad_files(tmp_path, content, expected):
    """Every unreadable file is a SceneError that names it and the place. Catches: tracebacks of tomllib."""
    path = tmp_path / "scene.toml"
    if content is not None:
        write(tmp_path, content)
    told = message(path)
    assert any(part in told for part in expected.split("|"))
    with pytest.raises(SceneError):
        load_scene(tmp_path)


def test_override_of_one_element():
    """An array's element is replaced by its number; others stay. Catches a list that is replaced whole, or grows."""
    scene = load_scene(SCENES / "sphere_a.toml", {"sample.spheres.0.cap_height_um": 500.0, "detector.1.name": "other"})
    assert scene.sample.spheres[0].cap_height_um == 500.0 and scene.sample.spheres[0].radius_um == 1000.0
    assert scene.detector_names == ("forward", "other", "left")
    for key in ("sample.spheres.1.radius_um", "sample.spheres.00.radius_um"):
        with pytest.raises(SceneError, match="spheres"):
            load_scene(SCENES / "sphere_a.toml", {key: 900.0})


def test_extends_merges_one_level(tmp_path):
    """Tables of the extended file lie beneath; `detector` is replaced whole; overrides win over both.

    Catches: detectors merged by index, the base winning, a chain of files.
    """
    write(tmp_path, MINIMAL + "[beam]\nincidence_deg = 20\nsource = 'pencil'\n", "base.toml")
    text = "extends = 'base.toml'\n[beam]\nincidence_deg = 40\n[[detector]]\nname='b'\npolar_deg=1\nhalf_angle_deg=1\n"
    path = write(tmp_path, text)
    scene = load_scene(path, {"scan.nx": 9, "trace": {"seed": 7}})
    assert (scene.beam.incidence_deg, scene.beam.source) == (40.0, "pencil")
    assert scene.detector_names == ("b",) and (scene.scan.nx, scene.scan.ny, scene.trace.seed) == (9, 4, 7)
    assert load_instrument(path) == scene.instrument
    write(tmp_path, "extends = 'scene.toml'", "third.toml")
    assert "only one level is allowed" in message(tmp_path / "third.toml")


def test_sample_of_another_kind_replaces_the_extended_one(tmp_path):
    """Catches: a step that inherits a sphere's keys."""
    write(tmp_path, MINIMAL.replace('kind = "flat"', 'kind = "step"\nheight_um = 3'), "base.toml")
    path = write(tmp_path, "extends = 'base.toml'\n[sample]\nkind = 'flat'\nsize_um = 300.0\n")
    assert load_scene(path).sample.kind == "flat"


def test_mesh_paths_start_at_the_scene_file(tmp_path):
    """A relative mesh path is found from any working directory, also through `extends` from another folder.

    Catches: paths taken from the working directory or from the wrong one of the two files.
    """
    (tmp_path / "sub").mkdir()
    write(tmp_path / "sub", "v 0 0 0\nv 9 0 0\nv 0 9 5\nf 1 2 3\n", "m.obj")
    text = MINIMAL.replace('kind = "flat"', 'kind = "mesh"\nunit = "um"\nfile = "m.obj"')
    direct = load_scene(write(tmp_path / "sub", text, "base.toml"))
    extended = load_scene(write(tmp_path, "extends = 'sub/base.toml'"))
    assert len(direct.build_body().faces) == len(extended.build_body().faces) == 1
    with pytest.raises(InputFileError, match="no such file"):
        load_scene(write(tmp_path, text, "wrong.toml")).build_body()
    with pytest.raises(SceneError, match="must be below the plate"):
        load_scene(tmp_path / "scene.toml", {"sample.translate_um": [0, 0, 3999]}).build_body()


def test_warnings_of_validate(tmp_path):
    """Apertures over the pinhole or over each other and a raster beyond the substrate give warnings.

    Catches: silence, and a check that mistakes an enclosed aperture for a separate one.
    """
    ellipse = {"center_um": [0, 0], "axes_um": [8000, 8000]}
    detectors = [{"name": "all", **ellipse}, {"name": "small", "polar_deg": 20, "half_angle_deg": 3}]
    scene = load_scene(write(tmp_path, MINIMAL), {"detector": detectors, "sample.size_um": 30})
    told = "\n".join(scene.warnings())
    assert "'all': its aperture contains the pinhole" in told and "'all' and 'small' overlap" in told
    assert "its border misses the sample" in told
    assert load_scene(SCENES / "sphere_a.toml").warnings() == []
    plate = {**PLATE, "size_um": [40, 9e3], "center_um": [-4000 / 3**0.5, 0]}
    told = "\n".join(load_scene(tmp_path / "scene.toml", {"plate": plate, "beam.incidence_deg": 30}).warnings())
    assert "reaches beyond the plate's outline" in told and "the pinhole" not in told and "beside the substrate" in told
    four = load_instrument(SCENES / "instruments/bshem_4detector.toml").model_dump(mode="json", exclude_none=True)
    assert load_scene(tmp_path / "scene.toml", four).warnings() == []


def test_loading_a_scene_is_light():
    """Loading a scene imports no heavy library. Catches: trimesh, SciPy or JAX imported at the top of a module."""
    heavy = ["jax", "numba", "embreex", "trimesh", "scipy", "h5py", "matplotlib"]
    code = (
        "import sys; from helio_jax.workflows.scene_file import load_scene; load_scene(sys.argv[1]); "
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    out = subprocess.run(
        [sys.executable, "-c", code, SCENES / "sphere_a.toml"], capture_output=True, text=True, check=True
    )
    assert out.stdout.strip() == "[]"


def test_schema_describes_every_key():
    """The JSON schema knows all tables, `extends` and `append`. Catches: a table that editors cannot complete."""
    schema = json_schema()
    json.dumps(schema)
    assert {"extends", "append", "beam", "plate", "detector", "sample", "scan", "trace", "noise"} <= set(
        schema["properties"]
    )
    assert "incidence" in json.dumps(schema["$defs"]["Beam"]["properties"])
    assert schema["$defs"]["Beam"]["properties"]["incidence_deg"]["description"].startswith("Angle t")


def make_stack(**fields) -> MicrographStack:
    detectors = [{"name": n, "polar_deg": 30, "half_angle_deg": 9} for n in ("a", "b")]
    instrument = Instrument.model_validate({"plate": {"working_distance_um": 4000}, "detector": detectors})
    shape = (2, 80, 70)
    counts = np.broadcast_to(np.array([400.0, 90.0])[:, None, None], shape).copy()
    return MicrographStack(counts, np.arange(70.0), np.arange(80.0), instrument, **fields)


def test_noise_is_poisson_with_honest_variance():
    """Mean and variance are gain * expected + background; the Monte Carlo variance is added, times gain^2.

    5600 pixels: the mean is tested to 5 standard errors, the variance to 5 sqrt(2 / n) = 9 %; a variance without the
    background (33 % less for b) or a gain applied after drawing (variance 2 x) is rejected.
    """
    settings = NoiseSettings(gain=(2.0, 0.5), background_per_pixel=(100.0, 22.0))
    stack = make_stack(variance=np.full((2, 80, 70), 3.0))
    noisy = add_noise(stack, settings, seed=3)
    expected = np.array([900.0, 67.0])
    mean, var = noisy.counts.mean((1, 2)), noisy.counts.var((1, 2))
    np.testing.assert_array_less(np.abs(mean - expected), 5 * np.sqrt(expected / 5600))
    np.testing.assert_array_less(np.abs(var / expected - 1), 5 * np.sqrt(2 / 5600))
    np.testing.assert_allclose(noisy.variance[:, 0, 0], expected + [12.0, 0.75])
    np.testing.assert_array_equal(noisy.background, [100.0, 22.0])
    assert noisy.noise == "poisson" and noisy.provenance["noise"]["seed"] == 3
    json.dumps(dict(noisy.provenance))
    assert np.all(noisy.counts == np.round(noisy.counts))


def test_noise_is_reproducible_and_added_once():
    """Same seed, same counts; another seed, others; unobserved pixels stay so; a noisy stack is refused.

    Catches: global random state, noise on noise.
    """
    seen = np.ones((2, 80, 70), bool)
    seen[0, 3, 4] = False
    stack = make_stack(is_observed=seen)
    first, again, other = (add_noise(stack, NoiseSettings(seed=s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.counts, again.counts)
    assert np.mean(first.counts == other.counts) < 0.2
    assert not first.is_observed[0, 3, 4] and first.is_observed.sum() == seen.sum()
    with pytest.raises(SceneError, match="only to expected counts"):
        add_noise(first, NoiseSettings())
    with pytest.raises(SceneError, match=r"noise\.gain must be one number or one per detector \(2\), got 3"):
        add_noise(stack, NoiseSettings(gain=(1.0, 1.0, 1.0)))


def test_a_plate_may_become_a_scattering_one(tmp_path):
    """Another kind of plate keeps the distances of the file that is extended; another kind of sample starts afresh."""
    scene = load_scene(SCENES / "sphere_a.toml", {"plate.kind": "scattering", "plate.radius_um": 9000.0})
    assert scene.plate.is_scattering and scene.working_distance == 4000.0
    flat = load_scene(SCENES / "sphere_a.toml", {"sample.kind": "flat"})
    assert flat.sample.kind == "flat"
