"""Every suffix of `helio export`, read back by a second reader (second_readers.py) on an asymmetric surface.

The surface has another number of rows than columns, another pitch in y than in x, an origin far from its middle,
heights that equal themselves under no rotation or mirror, and pixels without a height; one is not valid, another NaN.
"""

import numpy as np
import pytest
from second_readers import READERS
from typer.testing import CliRunner

import helio_jax as hx
from helio_jax.__main__ import app
from helio_jax.errors import SceneError
from helio_jax.formats.export_formats import FORMATS, SUFFIXES, help_text
from helio_jax.heightmap import HeightMap
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction

NX, NY, DX, DY, X0, Y0 = 7, 5, 0.75, 1.3, -3.1, 12.4
NOT_VALID, NO_NUMBER = (1, 5), (3, 2)
IMAGES = [s for known in FORMATS for s in known.suffixes if not known.has_points or known.amount == "all"]
MESHES = [s for known in FORMATS for s in known.suffixes if known.has_points and known.amount != "all"]
SEVERAL = [s for known in FORMATS for s in known.suffixes if s in IMAGES and known.amount != "image"]
FLOAT32 = {"rtol": 2e-7, "atol": 1e-7}
TOLERANCE = {".gsf": FLOAT32, ".tif": FLOAT32, ".tiff": FLOAT32, ".stl": FLOAT32, ".png": {"atol": 2e-4, "rtol": 0}}
"""Of what is stored in less than double precision; PNG: half of 1/65534 of the range, here 19 um."""
EXACT = {"rtol": 1e-12, "atol": 1e-12}


@pytest.fixture
def rec(bshem) -> Reconstruction:
    """The asymmetric surface, as a reconstruction from oblique micrographs."""
    rng = np.random.default_rng(33)
    row, column = np.indices((NY, NX))
    height = 2.0 * row + 0.3 * column**2 + rng.normal(size=(NY, NX))
    height[NO_NUMBER] = np.nan
    is_valid = np.ones((NY, NX), bool)
    is_valid[NOT_VALID] = False
    normals = rng.normal(size=(NY, NX, 3))
    return Reconstruction(
        height=height,
        raster_x=X0 + DX * np.arange(NX),
        raster_y=Y0 + DY * np.arange(NY),
        instrument=bshem,
        method="refine",
        normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True),
        albedo=1 + 0.1 * rng.normal(size=(NY, NX)),
        is_valid=is_valid,
        reason=np.where(is_valid, 0, 3),
        height_std=rng.uniform(0.1, 0.2, (NY, NX)),
        status="converged, in <3> iterations & more",
    )


@pytest.fixture
def stack(bshem) -> MicrographStack:
    """Asymmetric micrographs with noise, one pixel not observed."""
    rng = np.random.default_rng(34)
    shape = (len(bshem.detector), NY, NX)
    counts = np.round(100 + 10 * rng.normal(size=shape) + 30 * np.arange(shape[0])[:, None, None])
    is_observed = np.ones(shape, bool)
    is_observed[(1, *NOT_VALID)] = False
    return MicrographStack(
        counts=counts,
        x=X0 + DX * np.arange(NX),
        y=Y0 + DY * np.arange(NY),
        instrument=bshem,
        variance=counts,
        is_observed=is_observed,
        by_order=np.stack([0.9 * counts, 0.1 * counts + 1]),
        n_rays=1e4,
        noise="poisson",
    )


def known_of(rec: Reconstruction) -> np.ndarray:
    """True where the surface has a valid height."""
    return rec.is_valid & np.isfinite(rec.height)


def test_every_suffix_has_a_second_reader():
    """Catches a format that nobody has read back."""
    assert set(READERS) == set(SUFFIXES) == {*IMAGES, *MESHES}


@pytest.mark.parametrize("suffix", IMAGES)
def test_heights(tmp_path, rec, suffix):
    """Heights, pixel size and position come back; missing heights are missing.

    Catches rows in reversed order, x for y, um for m, half a pixel, and heights written where they are not valid.
    """
    path = tmp_path / f"a{suffix}"
    hx.export(rec, path)
    found = READERS[suffix](path)
    name = "height_um" if suffix == ".csv" else "height"
    expected = np.where(known_of(rec), rec.height, np.nan)
    np.testing.assert_allclose(found.images[name], expected, **TOLERANCE.get(suffix, EXACT))
    np.testing.assert_allclose(found.steps, (DX, DY), rtol=1e-8)
    form = next(known for known in FORMATS if suffix in known.suffixes)
    assert (found.first is not None) == form.has_origin
    if found.first is not None:
        np.testing.assert_allclose(found.first, (X0, Y0), rtol=1e-8)


@pytest.mark.parametrize("suffix", SEVERAL)
def test_errors_and_masks(tmp_path, rec, suffix):
    """Formats of several images hold the error bars and what is valid. Catches a mask with the wrong sense."""
    hx.export(rec, tmp_path / f"a{suffix}")
    images = READERS[suffix](tmp_path / f"a{suffix}").images
    unit = "_um" if suffix == ".csv" else ""
    expected = np.where(known_of(rec), rec.height_std, np.nan)
    np.testing.assert_allclose(images[f"height_std{unit}"], expected, **TOLERANCE.get(suffix, EXACT))
    assert np.array_equal(images["is_valid"], known_of(rec))


@pytest.mark.parametrize("suffix", MESHES)
def test_meshes(tmp_path, rec, suffix):
    """Every triangle joins three neighbouring surface points, faces up, and none touches a missing height.

    Catches points at the raster's positions (the beam is oblique), reversed triangles, filled holes, lost triangles.
    """
    hx.export(rec, tmp_path / f"a{suffix}")
    mesh = READERS[suffix](tmp_path / f"a{suffix}")
    known = known_of(rec)
    points = np.stack([rec.x, rec.y, rec.height], -1)[known]
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    distance = np.linalg.norm(corners[:, None] - points[None], axis=-1)
    assert distance.min(1).max() < (1e-5 if suffix == ".stl" else 1e-12)
    assert set(distance.argmin(1)) == set(range(len(points)))
    place = np.argwhere(known)[distance.argmin(1)].reshape(-1, 3, 2)
    assert np.all(np.ptp(place, axis=1) == 1)  # rows and columns of three corners of one pixel
    a, b = np.diff(place[:, :, ::-1], axis=1).transpose(1, 0, 2)
    assert np.all(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] == 1)  # counter-clockwise in the raster, seen from above
    assert np.all(np.abs(mesh.face_normals[:, 2]) > 0)
    n_quads = (NX - 1) * (NY - 1)
    n_touched = 8  # pixels' quads around the two missing heights: each keeps one of its two triangles
    assert len(mesh.faces) == 2 * n_quads - n_touched
    assert len({tuple(sorted(map(tuple, triangle))) for triangle in place.tolist()}) == len(mesh.faces)


def test_ply_holds_error_and_mask(tmp_path, rec):
    """Vertices have the error bars as a property. Catches properties in another order than the vertices."""
    hx.export(rec, tmp_path / "a.ply", invalid="keep")
    mesh = READERS[".ply"](tmp_path / "a.ply")
    data = mesh.metadata["_ply_raw"]["vertex"]["data"]
    row = np.round((mesh.vertices[:, 1] - Y0) / DY).astype(int)
    column = np.round((mesh.vertices[:, 0] + rec.instrument.beam_shift[0] * mesh.vertices[:, 2] - X0) / DX).astype(int)
    np.testing.assert_array_equal(np.ravel(data["height_std"]), rec.height_std[row, column])
    np.testing.assert_array_equal(np.ravel(data["is_valid"]), rec.is_valid[row, column])
    assert not rec.is_valid[row, column].all()


@pytest.mark.parametrize("invalid", ["keep", "fill"])
@pytest.mark.parametrize("suffix", [s for s in IMAGES if s != ".png"])
def test_kept_and_filled(tmp_path, rec, suffix, invalid):
    """`keep` writes what is not valid as it is, `fill` leaves no gap. Catches a treatment that a writer forgets."""
    hx.export(rec, tmp_path / f"a{suffix}", invalid=invalid)
    found = READERS[suffix](tmp_path / f"a{suffix}").images["height_um" if suffix == ".csv" else "height"]
    tolerance = TOLERANCE.get(suffix, EXACT)
    np.testing.assert_allclose(found[known_of(rec)], rec.height[known_of(rec)], **tolerance)
    if invalid == "keep":
        assert np.isnan(found[NO_NUMBER])
        if suffix != ".gwy":  # there the mask covers it still
            np.testing.assert_allclose(found[NOT_VALID], rec.height[NOT_VALID], **tolerance)
    elif suffix != ".gwy":
        i, j = NO_NUMBER
        around = rec.height[i - 1 : i + 2, j - 1 : j + 2]
        assert np.nanmin(around) < found[NO_NUMBER] < np.nanmax(around) and np.all(np.isfinite(found))


@pytest.mark.parametrize("suffix", [s for known in FORMATS if "micrographs" in known.kinds for s in known.suffixes])
def test_micrographs(tmp_path, stack, suffix):
    """Micrographs with noise are written by every format that can hold them, each image under its detector's name.

    Catches detectors in another order, images upside down, and counts in metres.
    """
    path, form = tmp_path / f"a{suffix}", next(known for known in FORMATS if suffix in known.suffixes)
    names = stack.instrument.detector_names
    expected = np.where(stack.is_observed, stack.counts, np.nan)
    images = {}
    for name in names if form.amount == "image" else [None]:
        hx.export(stack, path, detector=name)
        images |= READERS[suffix](path).images
    for name, image in zip(names, expected, strict=True):
        tolerance = {"atol": 1e-3, "rtol": 0} if suffix == ".png" else FLOAT32 if suffix in TOLERANCE else EXACT
        np.testing.assert_allclose(images[f"counts_{name}"], image, **tolerance)
    if form.amount != "image":
        for k, name in enumerate(names):
            assert np.array_equal(images[f"is_observed_{name}"], stack.is_observed[k])
            error = np.where(stack.is_observed[k], stack.std_error[k], np.nan)
            np.testing.assert_allclose(
                images[f"std_error_{name}"], error, **(FLOAT32 if suffix in TOLERANCE else EXACT)
            )
    if form.amount == "all":
        np.testing.assert_allclose(images[f"by_order_2_{names[0]}"], stack.by_order[1, 0], **EXACT)


def test_units_flags_and_status_are_in_the_file(tmp_path, rec):
    """Units, the meaning of flags, and the status that states whether to trust the heights. Catches bare numbers."""
    lists = {suffix: hx.export(rec, tmp_path / f"a{suffix}") for suffix in SUFFIXES}
    for form in FORMATS:
        path = tmp_path / f"a{form.suffixes[0]}"
        is_packed = form.name in ("X3P", "MAT", "NPZ")  # read below
        assert is_packed or (b"converged, in" in path.read_bytes()) == form.has_text
        assert any("converged, in" in line for line in lists[form.suffixes[0]]) != form.has_text
    found = {suffix: READERS[suffix](tmp_path / f"a{suffix}").texts for suffix in (".nc", ".mat", ".npz", ".x3p")}
    for suffix in (".nc", ".mat", ".npz"):
        assert found[suffix]["units"]["height"] == found[suffix]["units"]["height_std"] == "um"
    assert found[".nc"]["flags"]["is_valid"] == ["no", "yes"] and "depth_jump" in found[".nc"]["flags"]["reason"]
    assert found[".nc"]["about"]["status"] == found[".mat"]["about"]["status"] == rec.status
    assert rec.status in found[".x3p"]["comment"]
    assert READERS[".gwy"](tmp_path / "a.gwy").texts["shown"] == [True, False, False]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_equal_data_give_equal_bytes(tmp_path, rec, suffix):
    """Catches dates and random names inside files."""
    timed = rec.replace(provenance={"stack": {"time": "2026-01-02T03:04:05Z"}})
    for name in ("a", "b"):
        hx.export(timed, tmp_path / f"{name}{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"a{suffix}", f"b{suffix}"]


def test_height_map_becomes_a_sample(tmp_path):
    """A HeightMap written as .npz is a sample of a scene. Catches names of arrays that the scene cannot read."""
    from helio_jax.scene.files import read_height_map

    height = np.arange(12.0).reshape(3, 4) ** 2
    made = HeightMap(height, 2.0 * np.arange(4), 5.0 + np.arange(3))
    assert hx.export(made, tmp_path / "a.npz") == []  # nothing is left out
    back = read_height_map(tmp_path / "a.npz", 1.0, None)
    for name in ("x", "y", "height"):
        assert np.array_equal(getattr(back, name), getattr(made, name))


def test_list_of_positions(tmp_path, stack):
    """A scan of single positions is a table, no image. Catches an index that is written as a position."""
    n = 4
    places = np.array([[1.0, 2.0], [3.0, -4.0], [-5.0, 6.0], [7.0, 8.0]])
    spots = MicrographStack(
        counts=stack.counts[:, :1, :n],
        x=np.arange(float(n)),
        y=np.zeros(1),
        instrument=stack.instrument,
        positions=places,
    )
    hx.export(spots, tmp_path / "a.csv")
    rows = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    assert np.array_equal(np.stack([rows["x_um"], rows["y_um"]], 1), places)
    for suffix in (".npz", ".nc", ".mat"):
        hx.export(spots, tmp_path / f"a{suffix}")
    with pytest.raises(SceneError, match=r"list of positions: choose one of .mat .csv .npz .nc"):
        hx.export(spots, tmp_path / "a.tif")


def test_says_what_is_left_out(tmp_path, rec, stack):
    """What a format cannot hold is listed. Catches a silent loss, and points beside the pixels of an oblique beam."""
    lines = hx.export(rec, tmp_path / "a.sdf")
    assert [line.split(":")[0].split(",")[0] for line in lines] == [
        *("height_std", "x = -3.1 um", "positions of the surface points", "instrument")
    ]
    assert not any("positions" in line for line in hx.export(rec, tmp_path / "a.stl"))
    assert "counts have noise" in hx.export(stack, tmp_path / "a.mat")[0]


def test_refusals(tmp_path, rec, stack):
    """Each refusal names the remedy, and leaves no file."""
    wrong = tmp_path / "a.jpg"
    with pytest.raises(SceneError, match=r"no format has the suffix '.jpg': known are .x3p .sdf"):
        hx.export(rec, wrong)
    with pytest.raises(
        SceneError, match=r"X3P holds heights, these are micrographs: reconstruct them first, or choose one of .gwy"
    ):
        hx.export(stack, tmp_path / "a.x3p")
    with pytest.raises(SceneError, match=r"GSF holds one image, the scan has 3: give --detector forward or right"):
        hx.export(stack, tmp_path / "a.gsf")
    with pytest.raises(SceneError, match="no detector is called 'top': known are forward"):
        hx.export(stack, tmp_path / "a.gsf", detector="top")
    with pytest.raises(SceneError, match="heights belong to no detector"):
        hx.export(rec, tmp_path / "a.gsf", detector="left")
    with pytest.raises(SceneError, match="--invalid must be one of nan, keep, fill, got 'zero'"):
        hx.export(rec, tmp_path / "a.gsf", invalid="zero")
    with pytest.raises(SceneError, match="give --view 0 to 1"):
        hx.export(MicrographSet((stack, stack)), tmp_path / "a.tif")
    with pytest.raises(SceneError, match="no three neighbouring pixels"):
        hx.export(rec.replace(is_valid=np.zeros((NY, NX))), tmp_path / "a.stl")
    with pytest.raises(SceneError, match="nothing can be filled"):
        hx.export(rec.replace(is_valid=np.zeros((NY, NX))), tmp_path / "a.tif", invalid="fill")
    with pytest.raises(SceneError, match="No such file or directory"):
        hx.export(rec, tmp_path / "nowhere" / "a.tif")
    with pytest.raises(SceneError, match="a dict cannot be exported"):
        hx.export({}, tmp_path / "a.tif")
    assert list(tmp_path.iterdir()) == []


def test_grid_in_the_sample_frame(tmp_path, rec, stack):
    """`grid` writes heights where they are in the sample, and says what it leaves behind. Catches a grid ignored."""
    plane = rec.replace(height=2.0 + 0.1 * np.broadcast_to(rec.raster_x, (NY, NX)), is_valid=np.ones((NY, NX)))
    assert any("belong to the raster" in line for line in hx.export(plane, tmp_path / "a.nc", grid=0.5))
    found = READERS[".nc"](tmp_path / "a.nc")
    assert found.texts["about"]["status"] == rec.status
    shift = rec.instrument.beam_shift[0]
    x = found.first[0] + 0.5 * np.arange(found.images["height"].shape[1])
    expected = (2.0 + 0.1 * x) / (1 - 0.1 * shift)  # h = 2 + X / 10 with X = x + h tan t
    np.testing.assert_allclose(found.images["height"], np.broadcast_to(expected, found.images["height"].shape))
    assert not any("beside their pixels" in line for line in hx.export(plane, tmp_path / "a.sdf", grid=0.5))
    with pytest.raises(SceneError, match="--grid resamples reconstructed heights, this is a MicrographStack"):
        hx.export(stack, tmp_path / "a.nc", grid=0.5)


def test_command(tmp_path, rec, stack):
    """The command writes what Python writes and prints what is left out; its help is the table of formats.

    Catches an option that is not passed on, and a suffix that is only found to be wrong after the file was read.
    """
    hx.write(rec, tmp_path / "h.h5")
    hx.write(MicrographSet((stack, stack.replace(counts=stack.counts + 1))), tmp_path / "s.h5")

    def helio(*words: str) -> tuple[int, str]:
        found = CliRunner().invoke(app, ["export", *words])
        code = getattr(found.exception, "exit_code", found.exit_code)
        return code, f"{found.output} {found.exception or ''}"

    code, text = helio(str(tmp_path / "h.h5"), "-o", str(tmp_path / "h.gwy"), "--invalid", "keep", "--grid", "0.5")
    assert code == 0 and "not written: albedo" in text
    hx.export(hx.read(tmp_path / "h.h5"), tmp_path / "same.gwy", invalid="keep", grid=0.5)
    assert (tmp_path / "h.gwy").read_bytes() == (tmp_path / "same.gwy").read_bytes()
    name = stack.instrument.detector_names[2]
    code, _ = helio(str(tmp_path / "s.h5"), "-o", str(tmp_path / "s.gsf"), "--view", "1", "--detector", name)
    image = READERS[".gsf"](tmp_path / "s.gsf").images[f"counts_{name}"]
    assert code == 0 and np.array_equal(image, stack.counts[2] + 1)
    code, text = helio(str(tmp_path / "missing.h5"), "-o", str(tmp_path / "a.jpg"))
    assert code == 2 and ".x3p" in text and "missing.h5" not in text
    code, text = helio("--help")
    assert code == 0 and all(line.strip() in text for line in help_text().splitlines())
