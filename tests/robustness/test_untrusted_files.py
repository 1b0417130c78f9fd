"""Bad files end in an InputFileError that names the file; they never crash or hang this process."""

import json
import os
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import trimesh

from helio_jax import child
from helio_jax.errors import InputFileError, MissingDependencyError, SceneError
from helio_jax.formats import hdf5, safe
from helio_jax.formats.matlab import import_micrographs
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.micrograph import MicrographStack
from helio_jax.scene.files import read_height_map
from helio_jax.scene.meshes import load_mesh, parse_mesh
from helio_jax.texts import parse_toml
from helio_jax.workflows.scene_file import load_scene
from helio_jax.workflows.study_file import load_study


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


def _many_links(file):
    file["entry/x0"] = np.zeros(2)
    for i in range(9):
        file[f"entry/x0_{i}"] = file["entry/x0"]


def _never_filled(file):
    del file["entry/micrographs/counts"]
    file["entry/micrographs"].create_dataset("counts", (3, 3000, 3000), "f8", chunks=(1, 500, 500), compression="gzip")


def _text(place: str, text: str):
    """Return what replaces a text by another one, without its checksum."""

    def spoil(file):
        file.pop(place, None)
        file[place] = np.array(text.encode())

    spoil.__name__ = f"_text_{place.rpartition('/')[2]}_{text[:9]}"
    return spoil


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
        (_many_links, "linked 10 times, the limit is 8"),
        (_never_filled, "64 MiB and 100 times the file"),
        (_text("entry/provenance/data", '{"a":' * 900 + "1" + "}" * 900), "nested deeper than 32"),
        (_text("entry/provenance/data", "[" * 200_000), "nested deeper than 32"),
        (_text("entry/provenance/data", '{"a": %s}' % ("9" * 5000)), "more than 64 bits"),
        (_text("entry/provenance/data", "[1]"), "must be a JSON object, got list"),
        (_text("entry/calibration", '{"how": 1}'), "unexpected keyword"),
        (_text("entry/instrument/settings", "[" * 200_000), "not a valid instrument"),
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


def make_glb(tree: dict) -> bytes:
    """A GLB file of one triangle with this JSON chunk."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + np.arange(3, dtype="<u4").tobytes()
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(corners)
    head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(corners), b"BIN\0") + corners


def glb_tree(n: int) -> dict:
    """The JSON of `n` nodes that show one triangle."""
    views = [{"buffer": 0, "byteOffset": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}]
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}]
    accessors += [{"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"}]
    return {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": list(range(n))}], "buffers": [{"byteLength": 48}],
        "nodes": [{"mesh": 0, "translation": [i, 0, 0]} for i in range(n)], "bufferViews": views,
        "accessors": accessors, "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    }  # fmt: skip


def write_mat_bomb(path: Path, n_bytes: int) -> None:
    """A level 5 file whose one compressed variable is a matrix of so many zeros."""
    element = lambda kind, data: struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)  # noqa: E731
    shape = struct.pack("<ii", 1, n_bytes)
    inner = element(6, struct.pack("<II", 9, 0)) + element(5, shape) + element(1, b"meas_list")
    inner += struct.pack("<II", 2, n_bytes)
    packed = zlib.compress(struct.pack("<II", 14, len(inner) + n_bytes) + inner + bytes(n_bytes))
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed)


def test_what_unpacks_to_far_more_is_refused(tmp_path):
    """Zeros packed a thousandfold, as MAT and as NPZ: refused by the size that they would have.

    Catches a limit on the file alone: 0.3 MB took 5 GB and more before.
    """
    write_mat_bomb(tmp_path / "a.mat", 200 * child.MIB)
    assert_refused(tmp_path / "a.mat", "its variables must take at most 8. MiB")
    axis = np.arange(4000.0)
    np.savez_compressed(tmp_path / "a.npz", x=axis, y=axis, height=np.zeros((4000, 4000), "u1"))
    with pytest.raises(InputFileError, match="8 bytes a number, must take at most"):
        read_height_map(tmp_path / "a.npz", 1.0, None)


def test_parts_of_meshes_are_limited(tmp_path):
    """Nodes of a GLB are counted before trimesh makes a mesh of each (100 000 took a minute and 10 GB).

    Catches a limit that is checked on the result. Few nodes are read, each at its place.
    """
    path = tmp_path / "a.glb"
    path.write_bytes(make_glb(glb_tree(3)))
    vertices, faces, _ = load_mesh(path, 1.0)
    assert len(faces) == 3 and sorted(set(vertices[:, 0])) == [0.0, 1.0, 2.0, 3.0]
    path.write_bytes(make_glb(glb_tree(1001)))
    with pytest.raises(InputFileError, match="1001 nodes, the limit is 1000"):
        load_mesh(path, 1.0)
    many = glb_tree(900)
    many["accessors"][1]["count"] = 30_000
    path.write_bytes(make_glb(many))
    with pytest.raises(InputFileError, match="9000000 triangles, the limit is 5000000"):
        load_mesh(path, 1.0)


def test_many_materials_are_parsed_once(tmp_path, monkeypatch):
    """200 materials of one OBJ: every face keeps its own. Catches one pass over all vertices for each (41 s)."""
    calls, load = [], trimesh.load_scene
    monkeypatch.setattr(trimesh, "load_scene", lambda *a, **options: (calls.append(1), load(*a, **options))[1])
    names = [f"m{i}" for i in range(200)]
    vertices = "".join(f"v {i % 40} {i // 40} 0\n" for i in range(1600))
    faces = "".join(f"usemtl m{i}\nf {i + 1} {i + 2} {i + 42}\n" for i in range(200))
    (tmp_path / "a.obj").write_text(vertices + faces)
    corners, triangles, parts = parse_mesh(tmp_path / "a.obj", names, [], False)
    found = {int(p): corners[f].min(0).tolist() for f, p in zip(triangles, parts, strict=True)}
    assert len(calls) == 1 and len(found) == 200
    for i in (0, 57, 130):
        assert found[i + 1] == [i % 40, i // 40, 0.0]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[plate]\n" + ".".join(["a"] * 20_000) + " = 1", "line 2 has more than 32 parts"),
        ("[" + ".".join(["'a'"] * 100_000) + "]", "line 1 has more than 32 parts"),
        ('["' + '"."'.join(['\\"'] * 50_000) + '"]', "line 1 has more than 32 parts"),
        ("x = " + "[" * 100_000 + "]" * 100_000, "nested deeper than 32"),
        ("x = " + "[" * 50 + "]" * 50, "nested deeper than 32"),
        ("x = " + "9" * 5000, "more than 64 bits"),
        ("x = 0x" + "f" * 5000, "20000 bits, the limit is 64"),
        ("\n".join(f"a{i} = 1" for i in range(10_001)), "a table of 10001 keys"),
    ],
)
def test_hostile_toml(tmp_path, text, told):
    """Scenes and studies are read by one function, which refuses within a second what took minutes or gigabytes.

    Catches tomllib's quadratic time for long keys, RecursionError, and whole numbers that Python refuses to print.
    """
    (tmp_path / "a.toml").write_text(text)
    before = time.process_time()
    for read in (load_scene, load_study):
        with pytest.raises(SceneError, match=told) as caught:
            read(tmp_path / "a.toml")
        assert "a.toml" in str(caught.value) and len(str(caught.value)) < 1000
    assert time.process_time() - before < 2.0


def test_dotted_numbers_and_texts_are_no_long_keys():
    """Catches a limit on the dots of a line: a list of numbers has many, and a text may."""
    text = f"x = [{', '.join(['1.5'] * 1000)}]\ny = 'see a.b.c and 1.2.3.4'\n" + '"a.b"."c\\"d".e = 1\n'
    assert parse_toml(text)["a.b"]['c"d'] == {"e": 1}


@pytest.mark.skipif(os.name != "posix", reason="file size limits need POSIX")
def test_full_disk_is_an_error(helio_file, tmp_path):
    """A file that may not grow, as on a full disk: SceneError, the old file kept, nothing left behind.

    Catches HDF5's crash (signal 11) when it cannot write while it closes a file.
    """
    script = (
        "import resource, sys; import helio_jax as hx; from helio_jax.errors import SceneError\n"
        f"stack = hx.read({str(helio_file)!r}); before = open({str(helio_file)!r}, 'rb').read()\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        f"try: hx.write(stack, {str(helio_file)!r})\n"
        f"except SceneError as e: print(e, open({str(helio_file)!r}, 'rb').read() == before)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0 and "File too large; check the folder, rights and space True" in done.stdout, done
    assert [p.name for p in tmp_path.iterdir()] == ["good.h5"]
