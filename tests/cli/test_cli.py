"""The command line, as a user meets it: files, output, exit codes."""

import functools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helio_jax import read, write
from helio_jax.instrument import Uncertainty
from helio_jax.workflows.scene_file import load_instrument

ROOT = Path(__file__).resolve().parents[2]


def helio(*args: object, **kwargs) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "helio_jax", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, **kwargs)


@pytest.fixture(scope="module")
def small_scene(tmp_path_factory) -> Path:
    """Sphere A on 21 x 21 pixels; its instrument is named by absolute path."""
    text = (ROOT / "scenes" / "sphere_a.toml").read_text()
    text = text.replace('"instruments/', f'"{(ROOT / "scenes" / "instruments").as_posix()}/')
    text = text.replace("nx = 121", "nx = 21").replace("ny = 121", "ny = 21")
    text = text.replace("pixel_size_um = 30.0", "pixel_size_um = 170.0")
    path = tmp_path_factory.mktemp("scene") / "small.toml"
    text = text.replace("[reconstruct.refine]", "[reconstruct.refine]\nmax_rounds = 1\nrays = 100_000")
    path.write_text(text.replace('method = "refine"', 'method = "nearfield"'))
    return path


@pytest.fixture(scope="module")
def finished(small_scene, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("run")
    done = helio("run", small_scene, "-o", out, "--json")
    assert done.returncode == 0, done.stderr
    scores = json.loads(done.stdout)  # stdout is one JSON object, progress went to stderr
    assert 0.5 < scores["recovered_height"] < 1.5
    return out


def test_run_leaves_all_files(finished):
    """Catches a stage that is skipped or writes elsewhere."""
    names = {p.name for p in finished.iterdir()}
    assert names == {"micrographs.h5", "height.h5", "report.html", "report.png", "scores.json"}


def test_steps_one_by_one(small_scene, finished, tmp_path):
    """simulate, reconstruct, evaluate, report, info on files give exit code 0 and say what they did."""
    stack, height = tmp_path / "s.h5", tmp_path / "h.h5"
    assert helio("simulate", small_scene, "-o", stack, "--rays", 16, "--noise").returncode == 0
    found = tmp_path / "found.toml"
    refused = helio("reconstruct", stack, "-o", height, "--write-instrument", found)
    assert refused.returncode == 2 and "[uncertainty]" in refused.stderr and not height.exists()
    known = read(stack)
    unsure = known.instrument.model_copy(update={"uncertainty": Uncertainty(polar_deg=1.0)})
    write(known.replace(instrument=unsure), stack)
    quick = "--settings", small_scene, "--method", "refine"
    done = helio("reconstruct", stack, "-o", height, *quick, "--write-instrument", found)
    assert done.returncode == 0 and len(load_instrument(found).detector_names) == 3
    scored = helio("evaluate", height, "--truth", small_scene, "--json")
    assert scored.returncode == 0 and json.loads(scored.stdout)["n_pixels"] > 50
    against = helio("evaluate", height, "--truth", finished / "height.h5", "--json")
    assert against.returncode == 0 and json.loads(against.stdout)["rms_image"] < 1.0
    report = helio("report", height, "-o", tmp_path / "r.html", "--stack", stack, "--truth", small_scene)
    assert report.returncode == 0 and (tmp_path / "r.png").stat().st_size > 10_000
    info = helio("info", stack)
    assert info.returncode == 0 and "micrographs" in info.stdout


@pytest.mark.parametrize(
    ("args", "code", "words"),
    [
        (["run", "nowhere.toml"], 2, "nowhere.toml"),
        (["frobnicate"], 2, ""),
        (["reconstruct", "nowhere.h5", "-o", "x.h5"], 3, "nowhere.h5"),
        (["import", "{junk}", "-o", "x.h5"], 3, "junk.mat"),
        (["info", "{junk}"], 3, "junk.mat"),
        (["reconstruct", "{stack}", "-o", "{out}", "--method", "magic"], 2, "method"),
        (["reconstruct", "{stack}", "-o", "{out}", "--write-instrument", "found.json"], 2, ".toml"),
    ],
)
def test_exit_codes(args, code, words, finished, tmp_path):
    """Documented exit codes, one clear message, no traceback; catches crashes reported as usage errors."""
    junk = tmp_path / "junk.mat"
    junk.write_bytes(b"\x00\x01 not a mat file" * 50)
    places = {"junk": junk, "stack": finished / "micrographs.h5", "out": tmp_path / "x.h5"}
    done = helio(*[str(a).format(**places) for a in args], cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert words in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "x.h5").exists()


def test_wrong_scene_lists_all_errors(tmp_path, small_scene):
    """Two errors in one file are both reported, with key and limit."""
    bad = tmp_path / "bad.toml"
    bad.write_text(
        small_scene.read_text().replace("nx = 21", "nx = -4").replace("radius_um = 1000.0", "radius_um = 0.0")
    )
    done = helio("validate", bad)
    assert done.returncode == 2
    assert "scan.nx" in done.stderr and "radius_um" in done.stderr


def test_validate_schema_doctor_cite():
    """The small commands work on a fresh installation."""
    for name in ("sphere_a", "sphere_b", "step", "trench", "pyramid", "measured_sphere_a", "measured_salt"):
        done = helio("validate", ROOT / "scenes" / f"{name}.toml")
        assert done.returncode == 0, done.stderr
    assert "properties" in json.loads(helio("schema").stdout)
    doctor = helio("doctor", "--json")
    assert doctor.returncode == 0 and json.loads(doctor.stdout)["ok"]
    assert "arXiv" in helio("cite").stdout


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_interrupt_ends_with_130(small_scene, tmp_path):
    """Ctrl-C once it says that it simulates: exit code 130, no half-written file.

    A first run compiles what is not compiled yet, for a signal that falls into the compiler's callbacks is lost;
    should something be left to compile, the signal is repeated every 10 s.
    """
    assert helio("simulate", small_scene, "-o", tmp_path / "first.h5", "--rays", "8", "--no-picture").returncode == 0
    (tmp_path / "first.h5").unlink()
    command = [sys.executable, "-m", "helio_jax", "simulate", str(small_scene), "-o", str(tmp_path / "s.h5")]
    # a shell's background job ignores Ctrl-C, and so does what it starts: the gate may be one
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen([*command, "--rays", "20000"], stderr=subprocess.PIPE, text=True, preexec_fn=heed)
    assert process.stderr is not None
    said = process.stderr.readline()
    for _ in range(6):
        process.send_signal(signal.SIGINT)
        try:
            said += process.communicate(timeout=10)[1]
            break
        except subprocess.TimeoutExpired:
            continue
    process.kill()
    assert process.returncode == 130, said
    left = [p.name for p in tmp_path.iterdir()]
    assert left == [] or (left == ["s.h5.parts"] and "helio resume" in said)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_stop_refuse_and_resume(small_scene, tmp_path):
    """SIGTERM ends with 75 and the way on; another seed is refused with 6; resume ends with 0 and removes the parts.

    Catches a command line that swallows the signal or the exit code, and options that do not reach the tracer.
    """
    scene, out = tmp_path / "scene.toml", tmp_path / "s.h5"
    scene.write_text(small_scene.read_text().replace("[trace]", "[trace]\npaths_per_unit = 75_000"))
    process = subprocess.Popen(
        [sys.executable, "-m", "helio_jax", "simulate", str(scene), "-o", str(out), "--rays", "256", "--workers", "1"],
        stderr=subprocess.PIPE,
        text=True,
    )
    while process.poll() is None and len(list(tmp_path.glob("s.h5.parts/*.npz"))) < 2:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 75 and f"helio resume {out}" in said, said
    refused = helio("simulate", scene, "-o", out, "--seed", "5", "--rays", "256")
    assert refused.returncode == 6 and "trace.seed: 1 (then), 5 (now)" in refused.stderr
    done = helio("resume", out)
    assert done.returncode == 0 and "units are finished" in done.stderr, done.stderr
    assert {p.name for p in tmp_path.iterdir()} == {"scene.toml", "s.h5", "s.show.png"}  # as simulate leaves
    assert "field of view" in done.stdout and "s.show.png" in done.stdout


def test_imports_measured_files(shared, tmp_path):
    """B-SHeM, A-SHeM and the reference simulator's files end as HDF5 that info reads."""
    scenes = ROOT / "scenes"
    cases = {
        "sc100351.mat": "measured_sphere_a.toml",
        "scan003259.mat": "instruments/ashem_normal.toml",
        "sphere_a_simulated.mat": "sphere_a.toml",
    }
    for name, instrument in cases.items():
        out = tmp_path / f"{name}.h5"
        done = helio("import", shared / "data" / name, "-o", out, "--instrument", scenes / instrument)
        assert done.returncode == 0, done.stderr
        assert helio("info", out, "--json").returncode == 0


def test_help_is_fast():
    """`helio --help` stays light: three times the 0.3 s aim, so that a busy machine does not fail it."""
    times = []
    for _ in range(3):
        start = time.perf_counter()
        assert helio("--help").returncode == 0
        times.append(time.perf_counter() - start)
    assert min(times) < 0.9


def test_calibrate_says_what_it_found(finished, tmp_path):
    """A measured scan is calibrated into a file with a picture and priors; a simulated one is refused.

    Catches priors that do not reach the file, and a second calibration of the same counts.
    """
    from helio_jax import read, write

    raw, done = tmp_path / "raw.h5", tmp_path / "done.h5"
    refused = helio("calibrate", finished / "micrographs.h5", "-o", done)
    assert refused.returncode == 2 and "calibrated already" in refused.stderr
    stack = read(finished / "micrographs.h5")
    write(stack.replace(n_rays=None, noise="measured", counts=stack.counts + 800.0, by_order=None), raw)
    found = helio("calibrate", raw, "-o", done, "--json")
    assert found.returncode == 0, found.stderr
    record = json.loads(found.stdout)
    assert record["background"] == pytest.approx([800.0] * 3, abs=120.0) and len(record["snr"]) == 3
    assert record["priors"]["offset_std"] == read(done).calibration.priors["offset_std"] == 0.3
    assert done.with_suffix(".png").stat().st_size > 10_000
    assert helio("calibrate", done, "-o", tmp_path / "again.h5").returncode == 2
