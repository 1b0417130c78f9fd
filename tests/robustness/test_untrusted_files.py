"""Bad files end in an InputFileError that names the file; they never crash or hang this process."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from helio_jax import child
from helio_jax.errors import InputFileError, MissingDependencyError, SceneError
from helio_jax.formats import hdf5, safe
from helio_jax.formats.matlab import import_micrographs
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.micrograph import MicrographStack


def make_instrument() -> Instrument:
    """Three cones on channels 4, 2, 3."""
    detectors = (Detector(name=f"d{c}", polar_deg=30.0, half_angle_deg=9.0, channel=c) for c in (4, 2, 3))
    return Instrument(plate=Plate(working_distance_um=3000.0), detector=tuple(detectors))


@pytest.fixture
def helio_file(tmp_path) -> Path:
    """A small file of ours."""
    rng = np.random.default_rng(0)
    stack = MicrographStack(
        counts=rng.random((3, 6, 5)), x=np.arange(5.0), y=np.arange(6.0), instrument=make_instrument(), n_rays=7.0
    )
    hdf5.write(stack, tmp_path / "good.h5")
    return tmp_path / "good.h5"


@pytest.fixture
def matlab_file(tmp_path) -> Path:
    """A small uncompressed B-SHeM file: SciPy's reader sees every flipped bit."""
    rng = np.random.default_rng(0)
    image, inputs = np.empty(4, object), np.empty(2, object)
    for k in range(4):
        image[k] = rng.poisson(9000.0, (6, 5)).astype("u2")
    inputs[:] = ["fast_axis", "horizontal"]
    scan = {
        "image": image,
        "inputs": inputs,
        "hori_range": np.array([0.0, 4 * 3e7]),
        "vert_range": np.array([0.0, 5 * 3e7]),
        "hori_res": 3e7,
        "vert_res": 3e7,
        "dwell_time": 1000.0,
    }
    scipy.io.savemat(tmp_path / "good.mat", {"meas_list": scan}, do_compression=False)
    return tmp_path / "good.mat"


def flip_bits(good: bytes, seed: int, first: int = 0) -> bytes:
    """Flip three bits."""
    rng, data = np.random.default_rng(seed), bytearray(good)
    for _ in range(3):
        data[rng.integers(first, len(data))] ^= 1 << int(rng.integers(0, 8))
    return bytes(data)


def assert_refused(path: Path, match: str | None = None) -> None:
    """Both readers' verdict is an InputFileError that names the file."""
    with pytest.raises(InputFileError, match=match) as caught:
        hdf5.read(path) if path.suffix == ".h5" else import_micrographs(path, make_instrument())
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("suffix", [".h5", ".mat"])
def test_missing_empty_folder_random(suffix, tmp_path):
    """Catches a raw FileNotFoundError or a parser's own exception for what is no file of this kind."""
    path = tmp_path / f"a{suffix}"
    assert_refused(path, "does not exist")
    path.write_bytes(b"")
    assert_refused(path, "empty")
    path.write_bytes(np.random.default_rng(1).bytes(5000))
    assert_refused(path)
    path.unlink()
    path.mkdir()
    assert_refused(path, "regular file")


def test_truncated_or_flipped_helio_file(helio_file):
    """Catches reading in this process, and silent damage: what is accepted must equal the original."""
    good = helio_file.read_bytes()
    reference = hdf5.read(helio_file)
    for length in (7, len(good) // 2, len(good) - 1):
        helio_file.write_bytes(good[:length])
        assert_refused(helio_file)
    for seed in range(3):
        helio_file.write_bytes(flip_bits(good, seed))
        try:
            found = hdf5.read(helio_file)
        except InputFileError as e:
            assert str(helio_file) in str(e)
            continue
        assert found.counts.tobytes() == reference.counts.tobytes() and found.n_rays == reference.n_rays
        assert found.instrument == reference.instrument


def test_truncated_or_flipped_matlab_file(matlab_file):
    """Catches parsing in this process: SciPy dies of SIGSEGV on 2-3 % of such files (seeds 37, 49 did)."""
    good = matlab_file.read_bytes()
    assert import_micrographs(matlab_file, make_instrument()).shape == (3, 5, 6)
    for length in (len(good) // 2, len(good) - 1):
        matlab_file.write_bytes(good[:length])
        assert_refused(matlab_file)
    for seed in (37, 49):
        matlab_file.write_bytes(flip_bits(good, seed, first=128))
        try:
            import_micrographs(matlab_file, make_instrument())
        except InputFileError as e:
            assert str(matlab_file) in str(e)


def test_truncated_real_file(shared, tmp_path):
    """Catches a partial scan taken for a whole one."""
    good = (shared / "data" / "sc100351.mat").read_bytes()
    path = tmp_path / "a.mat"
    path.write_bytes(good[:-200])
    assert_refused(path)


def test_wrong_kinds(shared, helio_file, tmp_path):
    """Catches a guess at foreign content: HDF5 that is not ours, MATLAB without micrographs, MATLAB 7.3."""
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["data"] = np.zeros(3)
    assert_refused(tmp_path / "foreign.h5", "not a helio file")
    assert_refused(helio_file.rename(tmp_path / "b.mat"), "not a MATLAB file")
    (tmp_path / "c.mat").write_bytes(b"MATLAB 7.3 MAT-file, Platform: x".ljust(600))
    assert_refused(tmp_path / "c.mat", "-v7")
    assert_refused(shared / "data" / "albedo_sphereA.mat", "rho")


def _external_link(file):
    file["entry/extra"] = h5py.ExternalLink("/etc/passwd", "/")


def _soft_link(file):
    file["entry/extra"] = h5py.SoftLink("/entry/title")


def _external_storage(file):
    file["entry"].create_dataset("extra", (4,), "u1", external=[("/etc/passwd", 0, 4)])


def _virtual(file):
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (4,))
    file["entry"].create_virtual_dataset("extra", layout)


def _huge(file):
    del file["entry/micrographs/counts"]
    file["entry/micrographs"].create_dataset("counts", (3, 10**6, 10**6), "f8", chunks=(1, 100, 100))


def _filter(file):
    file["entry"].create_dataset("extra", data=np.zeros(100), compression="lzf")


def _objects(file):
    file["entry"].create_dataset("extra", data=["a", "b"], dtype=h5py.string_dtype())


def _cycle(file):
    file["entry/again"] = file["entry"]


def _new_major(file):
    file.attrs["helio_format"] = "2.0"


def _kind(file):
    file.attrs["filetype"] = "spectrum"


def _no_counts(file):
    del file["entry/micrographs/counts"]


def _wrong_number(file):
    file["entry/n_rays"][()] = 8.0


def _shape(file):
    del file["entry/micrographs/x"]
    file["entry/micrographs/x"] = np.arange(4.0)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (_external_link, "/entry/extra is an external link"),
        (_soft_link, "/entry/extra is a soft link"),
        (_external_storage, "/entry/extra keeps its data in another file"),
        (_virtual, "/entry/extra is a virtual dataset"),
        (_huge, "/entry/micrographs/counts must take at most"),
        (_filter, "gzip only"),
        (_objects, "/entry/extra must hold numbers"),
        (_cycle, "8 deep"),
        (_new_major, "helio_format must be 1.x, got '2.0'"),
        (_kind, "filetype must be one of"),
        (_no_counts, "counts missing"),
        (_wrong_number, "/entry/n_rays does not match its checksum"),
        (_shape, "counts must have the shape"),
    ],
)
def test_spoiled_helio_file(spoil, match, helio_file):
    """Catches following what leaves the file, decompression bombs, endless walks, and later formats misread."""
    with h5py.File(helio_file, "r+") as file:
        spoil(file)
    assert_refused(helio_file, match)


def _with_child_function(monkeypatch, body: str) -> str:
    """Add a function to the child's copy of `child` and return its name."""
    code = f"from helio_jax import child; import ctypes, time, sys; child.probe = {body}; "
    monkeypatch.setattr(child, "_BOOT", code + child._BOOT)
    return "helio_jax.child:probe"


@pytest.mark.skipif(os.name != "posix", reason="resource limits need POSIX")
@pytest.mark.parametrize(
    ("body", "match"),
    [
        ("lambda p: ctypes.string_at(0)", "killed by signal 11"),
        ("lambda p: bytearray(3 << 30)", "needs more than 1024 MiB"),
        ("lambda p: [0 for _ in iter(int, 1)]", "killed by signal|MiB"),
        ("lambda p: sys.exit(3)", "code 3"),
        ("lambda p: 1 / 0", "ZeroDivisionError"),
    ],
)
def test_child_that_fails_becomes_one_error(body, match, monkeypatch, tmp_path):
    """Catches a crash, an endless loop or a memory bomb that reaches the caller as anything else."""
    name = _with_child_function(monkeypatch, body)
    with pytest.raises(InputFileError, match=match) as caught:
        child.call_in_child(name, tmp_path / "bad.bin", memory_bytes=child.GIB, seconds=1 if "iter" in body else 30)
    assert "bad.bin" in str(caught.value)


def test_child_that_sleeps_is_stopped(monkeypatch, tmp_path):
    """Catches a CPU limit alone: a reader that waits (on a pipe, say) uses none."""
    name = _with_child_function(monkeypatch, "lambda p: time.sleep(60)")
    monkeypatch.setattr(child, "_run_child", lambda request, _, run=child._run_child: run(request, 1.5))
    with pytest.raises(InputFileError, match=r"stopped after 1\.5 s"):
        child.call_in_child(name, tmp_path / "bad.bin", seconds=1)


def test_missing_package_is_not_the_files_fault(monkeypatch, tmp_path):
    """Catches an ImportError in the child reported as a corrupt file."""
    name = _with_child_function(monkeypatch, "lambda p: __import__('no_such_package')")
    with pytest.raises(MissingDependencyError, match="no_such_package"):
        child.call_in_child(name, tmp_path / "a.bin")


def test_child_result_comes_back_whole(monkeypatch, tmp_path):
    """Catches arrays, tables or texts mixed up on the way, among them a table with a key named "array"."""
    numbers = "[1, None, 'µ', child.np.float64(0.1)]"
    body = f"lambda p, n: {{'array': child.np.arange(n), 'dict': {{'a': {numbers}}}, 'p': str(p)}}"
    name = _with_child_function(monkeypatch, body)
    value = child.call_in_child(name, tmp_path / "ä b.bin", 3)
    np.testing.assert_array_equal(value.pop("array"), [0, 1, 2])
    assert value == {"dict": {"a": [1, None, "µ", 0.1]}, "p": str(tmp_path / "ä b.bin")}


def test_reading_works_from_an_unguarded_script(helio_file, tmp_path):
    """Catches a child that imports the caller's main module (multiprocessing spawn), or modules beside the file."""
    (tmp_path / "h5py.py").write_text("raise SystemExit('imported from the working folder')")
    script = f"import helio_jax; print(helio_jax.read({str(helio_file)!r}).shape)"
    done = subprocess.run(
        [sys.executable, "-P", "-"], input=script, capture_output=True, text=True, cwd=tmp_path, timeout=60
    )
    assert done.stdout.strip() == "(3, 6, 5)", done.stderr


def test_atomic_path_keeps_or_replaces(tmp_path):
    """Catches a half-written target, a temporary left over, a replaced link, and lost file rights."""
    target, link = tmp_path / "a.txt", tmp_path / "link.txt"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    with pytest.raises(RuntimeError), safe.atomic_path(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    with safe.atomic_path(link) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old" and temporary.suffix == ".txt"
    assert target.read_text() == "new" and link.is_symlink() and target.stat().st_mode & 0o777 == 0o640
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "link.txt"]
    with pytest.raises(SceneError, match="nowhere"), safe.atomic_path(tmp_path / "nowhere" / "a"):
        pass


def test_check_size_refuses_large(tmp_path):
    """Catches a limit compared the wrong way round."""
    (tmp_path / "a").write_bytes(b"12345")
    assert child.check_size(tmp_path / "a", 5) == 5
    with pytest.raises(InputFileError, match="at most"):
        child.check_size(tmp_path / "a", 4)
