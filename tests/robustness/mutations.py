"""Mutated files of every kind that the program reads, read one after another; faults are collected.

    python tests/robustness/mutations.py 20000 [FIRST_SEED]

A fault is an error of another type than ours, a crash, more than 5 s of CPU time, or more than 1 GiB of memory. The
program parses foreign files in a child process each (helio_jax/child.py). Starting one takes half a second, so here one
worker process parses them all itself, with the memory limit of that child. What a parser does to the worker while it
stands in for the child (a crash, too much memory) is what the child is there to contain: the program turns it into an
InputFileError (tests/robustness/test_untrusted_files.py). It is counted, and a new worker goes on. Time counts in both.
"""

import contextlib
import json
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

CPU_SECONDS = 5.0
WALL_SECONDS = 300.0
"""Silence of the worker after which it hangs; much more than its CPU time, for machines that are busy."""
MEMORY_BYTES = 2**30
UNDAMAGED = -1
SCENE = """
name = "tiny"
[plate]
working_distance_um = 3000.0
[[detector]]
name = "a"
polar_deg = 40.0
half_angle_deg = 10.0
[sample]
kind = "mesh"
file = "cube.obj"
unit = "um"
flat_size_um = 900.0
rotate_deg = [0.0, 5.0, 0.0]
materials = { top = "broad" }
[material.broad]
kind = "broad_specular"
sigma_deg = 20.0
[scan]
nx = 3
ny = 4
pixel_size_um = 10.0
[trace]
rays = 64
seed = 1
"""
STUDY = """
scene = "scene.toml"
[set]
"trace.rays" = 32
[vary]
"trace.seed" = [1, 2]
"scan.nx" = { low = 3, high = 9, n = 3 }
"""
MTL = "newmtl top\nKd 0.1 0.2 0.3\nhelio_law broad_specular\nhelio_sigma_deg 20\nhelio_diffuse_fraction 0.5\n"
EXTREMES = ("9" * 5000, "1e400", "-1e400", "nan", "inf", "-1", "0", "1e-320", "18446744073709551616", "2147483648")
EXTREMES += ("true", "[]", "{}", '"x"', "[" * 40, "0x" + "f" * 5000, "65537", "1000000", "")
WORDS = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1, 0x7FF0000000000000, 0x7FF8000000000001)


def write_originals(folder: Path) -> None:
    """Write one small valid file of every kind."""
    import h5py
    import scipy.io
    import trimesh

    from helio_jax import HeightMap, MicrographSet, MicrographStack, Reconstruction, export, write
    from helio_jax.formats.parts import Parts
    from helio_jax.instrument import Detector, Instrument, Plate

    rng = np.random.default_rng(0)
    detectors = tuple(Detector(name=f"d{c}", polar_deg=30.0, half_angle_deg=9.0, channel=c) for c in (4, 2, 3))
    instrument = Instrument(plate=Plate(working_distance_um=3000.0), detector=detectors)
    x, y = 10.0 * np.arange(5), 10.0 * np.arange(6)
    stack = MicrographStack(counts=rng.random((3, 6, 5)), x=x, y=y, instrument=instrument, n_rays=7.0)
    write(stack, folder / "stack.h5")
    write(MicrographSet((stack, stack)), folder / "set.nxs")
    surface = rng.random((6, 5))
    maps = {"is_valid": np.ones((6, 5), bool), "reason": np.zeros((6, 5), int), "albedo": np.ones((6, 5))}
    height = Reconstruction(
        height=surface, raster_x=x, raster_y=y, instrument=instrument, method="linear", status="made up",
        normals=np.tile([0.0, 0.0, 1.0], (6, 5, 1)), **maps,
    )  # fmt: skip
    write(height, folder / "height.h5")
    image = np.empty(4, object)
    image[:] = [rng.poisson(9000.0, (6, 5)).astype("u2") for _ in range(4)]
    scan = {"image": image, "inputs": np.array(["fast_axis", "horizontal"], object), "dwell_time": 1000.0}
    scan |= {"hori_range": [0.0, 12e7], "vert_range": [0.0, 15e7], "hori_res": 3e7, "vert_res": 3e7}
    scipy.io.savemat(folder / "plain.mat", {"meas_list": scan}, do_compression=False)
    scipy.io.savemat(folder / "packed.mat", {"meas_list": scan}, do_compression=True)
    with h5py.File(folder / "seven.mat", "w", userblock_size=512) as file:
        file["meas_list/image"] = image[0]
    head = b"MATLAB 7.3 MAT-file".ljust(512)
    (folder / "seven.mat").write_bytes(head + (folder / "seven.mat").read_bytes()[512:])
    for name in ("heights.npz", "heights.csv", "heights.stl", "heights.ply", "heights.obj"):
        export(HeightMap(surface, x, y), folder / name)
    np.savez_compressed(folder / "map.npz", x=x, y=y, height=surface)
    rays = np.column_stack([rng.random((9, 3)), rng.random((9, 2)), -np.ones(9)])
    np.savez(folder / "rays.npz", position=rays[:, :3], direction=rays[:, 3:])
    np.save(folder / "rays.npy", rays)
    np.savetxt(folder / "rays.csv", rays, delimiter=",")
    np.savetxt(folder / "grid.csv", rng.random((6, 14)), delimiter=",")
    np.savetxt(folder / "positions.csv", rng.random((6, 2)), delimiter=",", header="x_um,y_um", comments="")
    angles = np.stack(np.meshgrid([0.0, 45.0, 90.0], [0.0, 90.0, 180.0]), -1).reshape(-1, 2)
    np.savetxt(folder / "scattering.csv", np.column_stack([angles, np.ones(9)]), delimiter=",")
    (folder / "points.csv").write_text("view,point,x_um,y_um\na,p1,0.0,1.0\na,p2,5.0,6.0\nb,p1,1.0,2.0\n")
    np.savetxt(folder / "grid.tsv", rng.random((6, 14)), delimiter="\t")
    np.savetxt(folder / "table.txt", rng.random((6, 3)), header="theta phi intensity")
    anchors = "name,kind,x_um,y_um,height_um,std_um\na,height,10.0,20.0,3.0,0.5\nb,height,5.0,6.0,7.0,\n"
    (folder / "anchors.csv").write_text(anchors)
    cube = trimesh.creation.box((200.0, 200.0, 100.0))
    for name, options in (("cube.stl", {}), ("cube.glb", {}), ("cube.ply", {}), ("ascii.ply", {"encoding": "ascii"})):
        cube.export(folder / name, **options)
    cube.export(folder / "ascii.stl", file_type="stl_ascii")
    vertices = "".join(f"v {a:g} {b:g} {c:g}\n" for a, b, c in cube.vertices)
    corners = [f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in cube.faces]
    parts = "usemtl top\n" + "".join(corners[:4]) + "g side\n" + "".join(corners[4:])
    (folder / "cube.obj").write_text(f"mtllib cube.mtl\n{vertices}{parts}")
    (folder / "cube.mtl").write_text(MTL)
    (folder / "scene.toml").write_text(SCENE)
    (folder / "instrument.toml").write_text(SCENE.partition("[sample]")[0].replace('name = "tiny"\n', ""))
    (folder / "study.toml").write_text(STUDY)
    kept = Parts(folder / "run.h5")
    kept.begin({"format": 2, "command": {"verb": "simulate"}, "about": {"scan": {"nx": 3}}, "n_units": 2})
    kept.save(0, {"total": rng.random((3, 4)), "job": np.array("key 0 4")})
    for name, new in (("manifest.json", "manifest.json"), ("000000.npz", "part.npz")):
        shutil.move(kept.folder / name, folder / new)
    kept.folder.rmdir()


def readers() -> dict[str, Callable[[Path], object]]:
    """Return what reads each file, as the program does it."""
    from helio_jax.formats.anchors import read_anchors
    from helio_jax.formats.parts import Parts
    from helio_jax.instrument import Instrument
    from helio_jax.scene.files import read_height_map, read_positions, read_scattering_table
    from helio_jax.scene.rays import read_rays
    from helio_jax.workflows.any_file import read_any
    from helio_jax.workflows.file_info import file_info
    from helio_jax.workflows.scene_file import load_instrument, load_scene
    from helio_jax.workflows.validate import check_file

    def manifest(path: Path) -> object:
        parts = Parts(path.with_name("run.h5"))
        parts.folder.mkdir(exist_ok=True)
        shutil.copy(path, parts.folder / "manifest.json")
        return parts.manifest()

    def part(path: Path) -> object:
        parts = Parts(path.with_name("run.h5"))
        parts.folder.mkdir(exist_ok=True)
        shutil.copy(path, parts.path(0))
        return parts.load(0)

    def laws(path: Path) -> object:
        file_info(path)
        return load_scene(path.with_name("scene.toml")).read_laws()

    instrument: Instrument | None = None

    def matlab(path: Path) -> object:
        from helio_jax.formats.matlab import import_micrographs

        nonlocal instrument
        instrument = instrument or load_instrument(path.with_name("instrument.toml"), CHANNELS)
        return import_micrographs(path, instrument)

    special: dict[str, Callable[[Path], object]] = {
        "scene.toml": check_file, "instrument.toml": check_file, "manifest.json": manifest, "part.npz": part,
        "rays.npz": read_rays, "rays.npy": read_rays, "rays.csv": read_rays, "positions.csv": read_positions,
        "grid.csv": lambda path: read_height_map(path, 1.0, 5.0), "scattering.csv": read_scattering_table,
        "cube.mtl": laws, "map.npz": read_any, "plain.mat": matlab, "packed.mat": matlab, "seven.mat": matlab,
        "anchors.csv": read_anchors,
    }  # fmt: skip
    return special | {"": file_info}


CHANNELS = {"detector.0.channel": 2}


def mutate(data: bytes, name: str, rng: np.random.Generator) -> bytes:
    """Return damaged bytes: bits, cuts, blocks repeated or moved, and numbers replaced by extreme ones."""
    is_text = Path(name).suffix in (".toml", ".csv", ".obj", ".mtl", ".json") or name.startswith("ascii")
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        if not data:
            return b"\0"
        at, end = sorted(int(i) for i in rng.integers(0, len(data) + 1, 2))
        how = rng.choice(["bits", "cut", "repeat", "drop", "move", "number", "number", "line"])
        if how == "bits":
            changed = bytearray(data)
            for place in rng.integers(0, len(data), int(rng.integers(1, 9))):
                changed[place] ^= 1 << int(rng.integers(8))
            data = bytes(changed)
        elif how == "cut":
            data = data[: max(1, end)]
        elif how == "repeat":
            data = data[:at] + data[at:end] * int(rng.integers(2, 50)) + data[end:]
        elif how == "drop":
            data = data[:at] + data[end:]
        elif how == "move":
            data = data[end:] + data[at:end] + data[:at]
        elif is_text:
            data = _change_text(data, str(how), rng)
        else:
            size = int(rng.choice([1, 2, 4, 8]))
            word = (int(rng.choice(np.array(WORDS, np.uint64))) % 256**size).to_bytes(size, "little")
            data = data[:at] + word + data[at + size :]
    return data


def _change_text(data: bytes, how: str, rng: np.random.Generator) -> bytes:
    """Replace a number by an extreme one; or drop, double or swap lines."""
    if how == "number":
        found = list(re.finditer(rb"-?\d[\d.e+-]*", data))
        if not found:
            return data
        one = found[int(rng.integers(len(found)))]
        return data[: one.start()] + EXTREMES[int(rng.integers(len(EXTREMES)))].encode() + data[one.end() :]
    lines = data.splitlines(keepends=True)
    i, j = rng.integers(len(lines), size=2)
    lines[i] = lines[j] * int(rng.integers(0, 3))
    return b"".join(lines)


def mutate_hdf5(path: Path, rng: np.random.Generator) -> None:
    """Change a valid file through the library, so that its own checksums are right: types, shapes, values, links."""
    import h5py

    with h5py.File(path, "r+") as file:
        places: list[str] = []
        file.visit(places.append)
        for _ in range(int(rng.integers(1, 4))):
            place = places[int(rng.integers(len(places)))]
            if place not in file:
                continue
            old = file[place]
            how = rng.choice(["drop", "attributes", "text", "shape", "values", "link"])
            if how == "drop":
                del file[place]
            elif how == "attributes":
                for name in list(old.attrs):
                    old.attrs[name] = EXTREMES[int(rng.integers(len(EXTREMES)))]
            elif how == "link":
                with contextlib.suppress(OSError, ValueError, RuntimeError):
                    file[f"{place}_{rng.integers(1000)}"] = old
            elif isinstance(old, h5py.Dataset):
                value = np.asarray(old[()])
                del file[place]
                if how == "text":
                    texts = ["", "{", "[1]", "null", '{"a": ' * 40, '{"detector": 3}', "9" * 5000, "NaN", '{"a": NaN}']
                    value = np.array(texts[int(rng.integers(len(texts)))].encode() or b"\0")
                elif how == "shape":
                    value = [value[None], np.zeros((0, 3)), np.zeros(7), np.zeros((2, 2), "u1")][int(rng.integers(4))]
                elif value.dtype.kind in "fiu":
                    value = np.full_like(value, [np.nan, np.inf, 0, -1, 1e300][int(rng.integers(5))], dtype=float)
                file.create_dataset(place, data=value)


def damage(original: Path, path: Path, seed: int) -> None:
    """Write the mutation `seed` of a file; the seed `UNDAMAGED`: a copy."""
    if seed == UNDAMAGED:
        shutil.copy(original, path)
        return
    rng = np.random.default_rng([seed, *original.name.encode()])
    if original.suffix in (".h5", ".nxs") and seed % 2:
        shutil.copy(original, path)
        mutate_hdf5(path, rng)
    else:
        path.write_bytes(mutate(original.read_bytes(), original.name, rng))


def work(folder: Path) -> None:
    """Read jobs (file and seed) from stdin; answer "stage child", then a line with the verdict and the CPU time."""
    from helio_jax import child
    from helio_jax.errors import HelioError

    def stand_in(request: dict, wall_seconds: float) -> int:
        print("stage child", flush=True)
        child.serve(request)
        print("stage parent", flush=True)
        return 0

    child._run_child = stand_in
    known = readers()
    used = int(re.search(r"VmSize:\s+(\d+)", Path("/proc/self/status").read_text())[1]) * 1024  # type: ignore[index]
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, resource.RLIM_INFINITY))
    here = Path(tempfile.mkdtemp(dir=folder.parent))
    for file in folder.iterdir():
        shutil.copy(file, here)
    print("ready", flush=True)
    for line in sys.stdin:
        name, seed = line.split()
        path, start = here / name, time.process_time()
        damage(folder / name, path, int(seed))
        verdict, start = "read", time.process_time()
        try:
            known.get(name, known[""])(path)
        except HelioError as e:
            verdict = "refused" if e.exit_code in (2, 3, 4, 6) else f"exit code {e.exit_code}: {e}"
        except BaseException as e:
            verdict = f"{type(e).__name__}: {e}"
        shutil.copy(folder / name, path)
        print(json.dumps([verdict[:300], time.process_time() - start]), flush=True)


@dataclass
class Found:
    """Numbers of mutations by verdict, the same of the undamaged files, and the faults."""

    verdicts: Counter[str] = field(default_factory=Counter)
    n_undamaged: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)


def try_mutations(folder: Path, n: int, first_seed: int = 0) -> Found:
    """Read `n` mutations, the files in turn; the same ones for the same numbers."""
    originals = folder / "originals"
    originals.mkdir()
    write_originals(originals)
    names = sorted(file.name for file in originals.iterdir())
    found, at = Found(), 0
    _with_one_worker(originals, [(name, UNDAMAGED) for name in names], found)
    found.n_undamaged, found.verdicts = found.verdicts, Counter()
    jobs = [(names[i % len(names)], first_seed + i // len(names)) for i in range(n)]
    while at < len(jobs):
        at += _with_one_worker(originals, jobs[at:], found)
    return found


def _with_one_worker(originals: Path, jobs: list[tuple[str, int]], found: Found) -> int:
    """Let one worker do jobs until it ends; return the number of those done."""
    command = [sys.executable, __file__, "work", str(originals)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1) as worker:
        assert worker.stdin and worker.stdout
        assert worker.stdout.readline() == "ready\n"
        for i, (name, seed) in enumerate(jobs):
            worker.stdin.write(f"{name} {seed}\n")
            stage, line, has_hung = "stage parent", "stage", threading.Event()
            watchdog = threading.Timer(WALL_SECONDS, lambda hung=has_hung: (hung.set(), worker.kill()))
            watchdog.start()
            while line.startswith("stage"):
                stage = line if line != "stage" else stage
                line = worker.stdout.readline().strip()
            watchdog.cancel()
            if has_hung.is_set():
                found.faults.append(f"{name} {seed}: hangs")
                return i + 1
            if not line:
                code = worker.wait()
                if stage == "stage child" and code < 0:
                    found.verdicts["contained crash"] += 1
                else:
                    found.faults.append(f"{name} {seed}: the reader ended with code {code}")
                return i + 1
            verdict, seconds = json.loads(line)
            found.verdicts[verdict if verdict in ("read", "refused") else "fault"] += 1
            if verdict not in ("read", "refused"):
                found.faults.append(f"{name} {seed}: {verdict}")
            elif seconds > CPU_SECONDS:
                found.faults.append(f"{name} {seed}: {verdict} after {seconds:.1f} s of CPU time")
        worker.stdin.close()
    return len(jobs)


if __name__ == "__main__":
    if sys.argv[1] == "work":
        work(Path(sys.argv[2]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            result = try_mutations(Path(temporary), int(sys.argv[1]), *map(int, sys.argv[2:]))
        print(dict(result.verdicts), *result.faults, sep="\n")
        sys.exit(bool(result.faults))
