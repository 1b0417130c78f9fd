"""Studies: which points a design makes, what a point's folder holds, and going on."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.errors import GuardError, InterruptedRun, ResumeError, SceneError
from helio_jax.formats.toml import to_toml
from helio_jax.trace.scan import Executor
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene, resolved
from helio_jax.workflows.study import load_study, resume_study, run_study

SCENES = Path(__file__).resolve().parents[2] / "scenes"
SMALL = """
[set]
"trace.rays" = 8
"trace.branches" = 1
"scan.nx" = 12
"scan.ny" = 12
scan.pixel_size_um = 300.0
"""
QUIET = pipeline.SimulateOptions(executor=Executor(1))


def write(folder: Path, text: str) -> Path:
    path = folder / "study.toml"
    path.write_text(f'scene = "{(SCENES / "sphere_a.toml").as_posix()}"\n{text}')
    return path


def grid(folder: Path, more: str = "") -> Path:
    """A study of 2 x 2 points without reconstruction."""
    vary = '[vary]\n"sample.spheres.0.cap_height_um" = [300.0, 700.0]\ntrace.seed = [1, 2]\n'
    return write(folder, f"reconstruct = false\n{more}{SMALL}{vary}")


def test_designs(tmp_path):
    """Grid: all combinations; list: side by side; Sobol: within the range, each half equally often, seeded.

    Catches a grid that pairs values, and a range that is left or not filled.
    """
    made = load_study(grid(tmp_path)).points()
    assert [tuple(p.values()) for p in made] == [(300.0, 1), (300.0, 2), (700.0, 1), (700.0, 2)]
    text = 'design = "list"\n[vary]\n"a.b" = { low = 1.0, high = 100.0, n = 3, log = true }\nc = ["x", "y", "z"]'
    made = load_study(write(tmp_path, text)).points()
    assert [p["a.b"] for p in made] == pytest.approx([1.0, 10.0, 100.0]) and [p["c"] for p in made] == ["x", "y", "z"]
    ranges = "x = { low = -1.0, high = 1.0 }\nn = { low = 1, high = 9, whole = true }"
    text = f'design = "sobol"\nn_points = 32\n[vary]\n{ranges}'
    made = load_study(write(tmp_path, text)).points()
    x = np.array([p["x"] for p in made])
    assert (x < 0).sum() == 16 and np.all(np.abs(x) <= 1) and all(isinstance(p["n"], int) for p in made)
    assert (
        made == load_study(write(tmp_path, text)).points() != load_study(write(tmp_path, "seed = 2\n" + text)).points()
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[vary]\n"a" = []', "at least one value"),
        ('design = "list"\n[vary]\na = [1, 2]\nb = [1]', '"a" 2, "b" 1'),
        ('design = "sobol"\n[vary]\na = [1.0]', "must be a range"),
        ("[vary]\na = { low = 2.0, high = 1.0, n = 3 }", "low < high"),
        ("[vary]\na = { low = 1.0, high = 2.0 }", "needs n"),
        ("colour = 1\n[vary]\na = [1]", "colour"),
        ('[vary]\n"scan.nx" = [12, -3]', "point 2.*scan.nx"),
        ('[vary]\n"sample.spheres.4.radius_um" = [1.0]', "spheres"),
    ],
)
def test_wrong_studies_are_refused_before_anything_runs(tmp_path, text, words):
    """Each error names file, place and remedy; no folder is made. Catches a study that fails after hours."""
    with pytest.raises(SceneError, match=f"(?s)study.toml.*{words}"):
        run_study(write(tmp_path, text), tmp_path / "out", options=QUIET)
    assert not (tmp_path / "out").exists()


def test_documented_study_is_valid():
    """Catches an example that the program refuses."""
    path = SCENES.parent / "docs" / "study_cap_height.toml"
    study = load_study(path)
    points = study.points()
    assert len(points) == 10
    for values in points:
        load_scene(path.parent / study.scene, study.set | values)


@pytest.mark.parametrize("name", ["sphere_a", "step", "trench", "pyramid", "measured_sphere_a"])
def test_scene_as_toml_is_read_back(tmp_path, name):
    """A point's scene file is the whole scene. Catches a value that is lost or changed on the way."""
    scene = load_scene(SCENES / f"{name}.toml")
    odd = scene.model_copy(update={"description": 'tab\t"quotes" \\ back\nline \x7f é'})
    for each in (scene, odd):
        (tmp_path / "s.toml").write_text(to_toml(resolved(each)), encoding="utf-8")
        assert resolved(load_scene(tmp_path / "s.toml")) == resolved(each)


def test_points_index_and_going_on(tmp_path):
    """Every point has its scene and micrographs, the index its values and scores; only what is missing is run again.

    Catches values that do not reach the tracer, an index that mixes points, a resume that begins anew, and defaults
    written into a point's scene, over which a calibration's priors then have no say.
    """
    path, out = grid(tmp_path), tmp_path / "out"
    index = run_study(path, out, options=QUIET)
    rows = list(csv.DictReader(index.read_text().splitlines()))
    assert [r["sample.spheres.0.cap_height_um"] for r in rows] == ["300.0", "300.0", "700.0", "700.0"]
    assert {r["status"] for r in rows} == {"done"} and (out / "index.png").stat().st_size > 5000
    assert json.loads((out / "index.json").read_text())[2]["trace.seed"] == 1
    point = out / "point_00003"
    stack = hx.read(point / "micrographs.h5")
    alone = hx.simulate(hx.load_scene(point / "scene.toml"))
    assert np.array_equal(stack.counts, alone.counts)
    assert float(rows[2]["mean_forward"]) == stack.counts[0].mean() != float(rows[0]["mean_forward"])

    with pytest.raises(ResumeError, match="--resume"):
        run_study(path, out, options=QUIET)
    shutil.rmtree(point)
    before = {p: p.stat().st_mtime_ns for p in out.glob("point_*/micrographs.h5")}
    resume_study(out, say=lambda text: None)
    assert (point / "micrographs.h5").exists() and before == {p: p.stat().st_mtime_ns for p in before}
    refine = hx.load_scene(point / "scene.toml").reconstruct.refine
    assert refine.model_fields_set == hx.load_scene(SCENES / "sphere_a.toml").reconstruct.refine.model_fields_set
    text = path.read_text()
    path.write_text(text.replace("700.0]", "701.0]"))
    with pytest.raises(ResumeError, match="changed since"):
        resume_study(out)
    path.write_text(text)
    (out / "study.json").write_text("{")
    with pytest.raises(ResumeError, match="damaged"):
        run_study(path, out, options=QUIET, resume=True)


def test_shards_of_a_study(tmp_path):
    """Two shards run half of the points each. Catches points that both or none run."""
    path, out = grid(tmp_path), tmp_path / "out"
    for shard, n in (("2/2", 2), ("1/2", 4)):
        said = []
        run_study(path, out, options=pipeline.SimulateOptions(executor=Executor(1), shard=shard, say=said.append))
        assert len(said) == 2
        assert sum(row["status"] == "done" for row in json.loads((out / "index.json").read_text())) == n


def test_interrupted_and_failed_points(tmp_path, monkeypatch):
    """Ctrl-C says how to go on with the study; a point that fails is told in the index, and tried again.

    Catches a study that dies of one point, or hides that one failed.
    """
    path, out = grid(tmp_path), tmp_path / "out"
    real = pipeline.simulate_file

    def broken(scene, output, **kwargs):
        if "point_00002" in str(output):
            raise error("no good")
        return real(scene, output, **kwargs)

    monkeypatch.setattr(pipeline, "simulate_file", broken)
    error: type[Exception] = InterruptedRun
    with pytest.raises(InterruptedRun, match=r"point 2.*helio resume"):
        run_study(path, out, options=QUIET)
    error = GuardError
    with pytest.raises(GuardError, match=r"1 of 4 points failed.*point 2: no good"):
        run_study(path, out, resume=True, options=QUIET)
    monkeypatch.undo()
    said: list[str] = []
    resume_study(out, say=said.append)
    assert len(said) == 1 and said[0].startswith("point 2 of 4")


def test_heights_are_scored(tmp_path):
    """A point with reconstruction has scores in the index, as `helio run` gives them. Catches another's scores."""
    text = '[vary]\n"sample.spheres.0.cap_height_um" = [500.0]\n'
    text = f'{SMALL}"reconstruct.method" = "nearfield"\n"scan.atoms_per_pixel" = 100000\n{text}'
    index = run_study(write(tmp_path, text), tmp_path / "out", options=QUIET)
    row = next(csv.DictReader(index.read_text().splitlines()))
    scores = json.loads((index.parent / "point_00001" / "scores.json").read_text())
    assert float(row["rms_image"]) == scores["rms_image"] and row["method"]
    assert not list(index.parent.glob("point_*/report.html"))
