"""Helio's own files: what is written is read back bit for bit, and other programs find the picture."""

import dataclasses
import json

import h5py
import numpy as np
import pytest
from nexusformat.nexus import nxload

from helio_jax.errors import HelioError, InputFileError, SceneError
from helio_jax.formats import hdf5
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.micrograph import Calibration, MicrographSet, MicrographStack, ScanAlignment
from helio_jax.reconstruction import Reconstruction

SHAPE = (2, 5, 4)


def make_instrument() -> Instrument:
    """Two detectors, one of each kind, with a name that is not ASCII."""
    return Instrument(
        beam=Beam(incidence_deg=30.0, azimuth_deg=0.1),
        plate=Plate(working_distance_um=4000.0),
        detector=(
            Detector(name="vorn µ", center_um=(2309.4, 0.1), axes_um=(1385.6, 1200.0), rotation_deg=-60.0, channel=3),
            Detector(name="cone", polar_deg=30.0, half_angle_deg=9.0),
        ),
    )


def make_full_stack(seed: int = 0) -> MicrographStack:
    """A stack in which nothing is None, with awkward numbers."""
    rng = np.random.default_rng(seed)
    counts = rng.random(SHAPE) * 1e-10
    counts[0, 1, 2] = np.nan
    return MicrographStack(
        counts=counts,
        x=(np.arange(4) - 1.5) * 10 / 3,
        y=np.arange(5) * 0.1,
        instrument=make_instrument(),
        variance=rng.random(SHAPE) * 1e-22,
        is_observed=rng.random(SHAPE) > 0.3,
        background=rng.random(SHAPE),
        by_order=rng.random((3, *SHAPE)),
        effuse=rng.random(SHAPE),
        plate=rng.random(SHAPE),
        masked=rng.random(SHAPE),
        shadowed=rng.random(SHAPE[1:]),
        n_rays=35000.1,
        dwell=0.1 + 0.2,
        fast_axis="y",
        sample_rotation=-1 / 3,
        noise="measured",
        unit="A",
        name="scan µ",
        calibration=Calibration("constant_albedo", {"gain_std": 0.1, "drift_degrees": (3, 2)}, True),
        alignment=ScanAlignment(((1 / 3, -0.1, 0.2),) * SHAPE[0]),
        materials={"flat µ": "cosine"},
        provenance={"seed": 2**63, "nested": {"list": [1, 2.5, None, "µ"], "on": True}},
    )


def make_bare_stack() -> MicrographStack:
    """A stack with required fields only."""
    return MicrographStack(counts=np.ones(SHAPE), x=np.arange(4.0), y=np.arange(5.0), instrument=make_instrument())


def make_reconstruction(**optional) -> Reconstruction:
    """A reconstruction whose height has gaps."""
    rng = np.random.default_rng(1)
    height = rng.random(SHAPE[1:]) * 100
    height[2, 2] = np.nan
    return Reconstruction(
        height=height,
        raster_x=np.arange(4) * 0.7,
        raster_y=np.arange(5) * 0.7,
        instrument=make_instrument(),
        method="refine",
        normals=rng.random((*SHAPE[1:], 3)),
        albedo=rng.random(SHAPE[1:]),
        is_valid=rng.random(SHAPE[1:]) > 0.5,
        reason=rng.integers(0, 5, SHAPE[1:]),
        **optional,
    )


def assert_equal_record(a, b) -> None:
    """Every field equal, arrays bit for bit and in type; None only where None was."""
    assert type(a) is type(b)
    for f in dataclasses.fields(a):
        left, right = getattr(a, f.name), getattr(b, f.name)
        if isinstance(left, np.ndarray):
            assert left.dtype == right.dtype and left.shape == right.shape, f.name
            assert left.tobytes() == right.tobytes(), f.name
        elif f.name == "stacks":
            assert len(left) == len(right)
            for one, other in zip(left, right, strict=True):
                assert_equal_record(one, other)
        else:
            assert left == right and type(left) is type(right), f.name


def nexus_plot(path):
    """What nexusformat, an independent reader, would draw."""
    return nxload(str(path)).plottable_data


@pytest.mark.parametrize(
    "make",
    [
        make_full_stack,
        make_bare_stack,
        lambda: make_full_stack().replace(background=np.array([1.0, 2.0])),
        lambda: MicrographSet(tuple(make_full_stack(s) for s in range(11)), {"from": "test"}),
        lambda: MicrographSet((make_bare_stack(),)),
        make_reconstruction,
        lambda: make_reconstruction(
            height_std=np.full(SHAPE[1:], 0.1),
            residuals=np.full(SHAPE, 1 / 3),
            gain=np.array([0.1, 0.2]),
            offset=np.zeros(2),
            status="converged",
            border="free",
            provenance={"a": 1},
        ),
    ],
)
def test_what_is_written_is_read_back(make, tmp_path):
    """Catches float32 storage, variance rebuilt from its root, masks as floats, None turned into zeros, scan 10 < 2."""
    record = make()
    hdf5.write(record, tmp_path / "a.h5")
    assert_equal_record(record, hdf5.read(tmp_path / "a.h5"))


OLD = {
    "align": {"scans": []},
    "scan_time": [[0.0, 0.1, 0.2]] * SHAPE[0],
    "self_calibrate": {"gain": [1.0], "note": "", "priors": {"drift_degrees": [3, 3]}, "without_multiple": True},
    "materials": {"gold": "specular"},
}
"""What files of format 1.0 keep in the provenance of a stack."""


def write_old(record, path, provenance) -> None:
    """Write a record as format 1.0 had it."""
    hdf5.write(record.replace(provenance=provenance), path)
    with h5py.File(path, "a") as file:
        file.attrs["helio_format"] = b"1.0"
        for name in set(file["entry"]) & {"calibration", "alignment", "materials", "border"}:
            del file[f"entry/{name}"]


def test_files_of_format_1_0(tmp_path):
    """Their calibration, alignment and border become records. Catches an old file that is calibrated a second time."""
    path = tmp_path / "old.h5"
    write_old(make_full_stack(), path, OLD)
    found = hdf5.read(path)
    assert found.calibration == Calibration("constant_albedo", {"drift_degrees": [3, 3]}, True)
    assert found.alignment == ScanAlignment(((0.0, 0.1, 0.2),) * SHAPE[0]) and found.materials == {"gold": "specular"}
    assert found.provenance == OLD
    write_old(make_bare_stack(), path, {"calibrate": {"priors": {"gain_std": 0.3}}})
    found = hdf5.read(path)
    assert found.calibration == Calibration("border", {"gain_std": 0.3}) and found.alignment is None
    write_old(make_bare_stack(), path, {})
    assert_equal_record(make_bare_stack(), hdf5.read(path))
    write_old(make_reconstruction(border="free"), path, {"reconstruct": {"border": "free"}})
    assert hdf5.read(path).border == "free"
    for wrong in ({"calibrate": [1]}, {"self_calibrate": {"priors": {"gain_std": "x"}}}, {"scan_time": [[1.0]]}):
        write_old(make_bare_stack(), path, wrong)
        with pytest.raises(InputFileError, match=r"old\.h5: /entry"):
            hdf5.read(path)


def test_provenance_of_a_new_file_is_history(tmp_path):
    """Catches a step that depends on the provenance of a file of the present format."""
    hdf5.write(make_bare_stack().replace(provenance=OLD), tmp_path / "a.h5")
    found = hdf5.read(tmp_path / "a.h5")
    assert found.calibration is None and found.alignment is None and found.scan_time is None


def test_records_are_checked_when_made():
    """Catches a calibration of unknown kind, priors that are no numbers, and times of another number of images."""
    for wrong in (("flat",), ("border", {"gain_std": "x"}), ("border", [1.0]), ("border", {}, 1)):
        with pytest.raises(InputFileError, match="calibration"):
            Calibration(*wrong)
    with pytest.raises(InputFileError, match="time_planes must hold one plane for each of 2 images, got 1"):
        make_bare_stack().replace(alignment=ScanAlignment(((0.0, 0.0, 0.0),)))


def test_default_plot_of_a_stack(tmp_path):
    """Catches a broken chain of default/signal/axes, axes in the wrong order, missing errors."""
    stack = make_full_stack()
    hdf5.write(stack, tmp_path / "a.h5")
    plot = nexus_plot(tmp_path / "a.h5")
    assert plot.nxsignal.nxname == "counts"
    assert [a.nxname for a in plot.nxaxes] == ["detector", "y", "x"]
    np.testing.assert_array_equal(plot.nxsignal.nxdata, stack.counts)
    np.testing.assert_array_equal(plot.nxaxes[2].nxdata, stack.x)
    np.testing.assert_array_equal(plot.nxerrors.nxdata, stack.std_error)
    assert plot.nxsignal.attrs["units"] == "A"


def test_default_plot_of_a_set_and_a_reconstruction(tmp_path):
    """Catches a set whose default stops at the entry, and heights plotted against the wrong axis."""
    hdf5.write(MicrographSet((make_bare_stack(), make_full_stack())), tmp_path / "set.h5")
    np.testing.assert_array_equal(nexus_plot(tmp_path / "set.h5").nxsignal.nxdata, make_bare_stack().counts)
    rec = make_reconstruction(height_std=np.full(SHAPE[1:], 0.1))
    hdf5.write(rec, tmp_path / "rec.h5")
    plot = nexus_plot(tmp_path / "rec.h5")
    np.testing.assert_array_equal(plot.nxsignal.nxdata, rec.height)
    np.testing.assert_array_equal(plot.nxaxes[0].nxdata, rec.raster_y)
    np.testing.assert_array_equal(plot.nxerrors.nxdata, rec.height_std)
    with h5py.File(tmp_path / "rec.h5") as file:
        np.testing.assert_array_equal(file["/entry/x"][()], rec.x)


def test_every_field_says_unit_and_meaning_in_plain_storage(tmp_path):
    """Catches a field without units or long_name, texts of variable length, a filter other programs lack, links."""
    hdf5.write(make_full_stack(), tmp_path / "a.h5")
    checked = []

    def check(name, item):
        for key in item.attrs:
            assert not h5py.check_string_dtype(item.attrs.get_id(key).dtype) or item.attrs.get_id(key).dtype.itemsize
            assert item.attrs.get_id(key).dtype.kind == "S", (name, key)
        if isinstance(item, h5py.Dataset):
            assert {"units", "long_name"} <= set(item.attrs), name
            assert item.dtype.kind != "O" and item.compression in (None, "gzip"), name
            checked.append(name)

    with h5py.File(tmp_path / "a.h5") as file:
        check("/", file)
        file.visititems(check)
        assert file.attrs["helio_format"] == b"1.1" and file.attrs["filetype"] == b"micrographs"
    assert len(checked) >= 20


def test_describe_tells_shapes_and_origin(tmp_path):
    """Catches a summary that is not JSON, loses the scans of a set, or says a wrong kind or unit."""
    hdf5.write(MicrographSet((make_bare_stack(), make_full_stack())), tmp_path / "a.h5")
    about = json.loads(json.dumps(hdf5.describe(tmp_path / "a.h5")))
    assert about["kind"] == "micrograph_set" and about["format"] == "1.1" and about["creator"] == "helio_jax"
    scan = about["entries"]["scan_2"]
    assert scan["fields"]["micrographs/counts"]["shape"] == list(SHAPE)
    assert scan["fields"]["micrographs/counts"]["unit"] == "A"
    assert scan["instrument"]["detector"][0]["name"] == "vorn µ"
    assert scan["provenance"]["seed"] == 2**63 and scan["calibration"]["priors"]["drift_degrees"] == [3, 2]


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    """Catches writing in place, and temporaries that stay behind."""
    path = tmp_path / "a.h5"
    hdf5.write(make_bare_stack(), path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(hdf5, "_put_node", fail)
    with pytest.raises(SceneError, match="No space left"):
        hdf5.write(make_full_stack(), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_unwritable_target_and_odd_objects(tmp_path):
    """Catches raw OSError or TypeError reaching the user, and a provenance silently turned into text."""
    with pytest.raises(SceneError, match="nowhere"):
        hdf5.write(make_bare_stack(), tmp_path / "nowhere" / "a.h5")
    with pytest.raises(SceneError, match="folder"):
        hdf5.write(make_bare_stack(), tmp_path)
    with pytest.raises(HelioError, match="provenance"):
        hdf5.write(make_bare_stack().replace(provenance={"a": object()}), tmp_path / "a.h5")
    with pytest.raises(HelioError, match="got a dict"):
        hdf5.write({}, tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []
