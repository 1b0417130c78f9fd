"""Studies: which points a design makes, what a point's folder holds, and going on."""

import csv
import itertools
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.errors import GuardError, InterruptedRun, ResumeError, SceneError
from helio_jax.figures import sweep
from helio_jax.formats.toml import to_toml
from helio_jax.trace.scan import Executor
from helio_jax.workflows import pipeline
from helio_jax.workflows.file_info import file_info
from helio_jax.workflows.scene_file import load_scene, resolved
from helio_jax.workflows.shipped import locate
from helio_jax.workflows.study import load_study, resume_study, run_study
from helio_jax.workflows.study_table import Averaged, averaged, chosen_scores, image_scores, possible_scores, table

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
        ("name = 'nothing'", "vary: is empty"),
        ('score = ["rms_region", "rms_*x"]\n[vary]\n"scan.nx" = [12]', r"score must be among .*rms_image.*'rms_\*x'"),
        ('score = "rms_image"\nreconstruct = false\n[vary]\n"scan.nx" = [12]', "score must be among mean_forward"),
        ('repeat = 100\ndesign = "sobol"\nn_points = 2000\n[vary]\na = { low = 1, high = 2 }', "200000 points"),
        ('[case.a]\n"scan.nx" = -3', "point 1.*scan.nx"),
    ],
)
def test_wrong_studies_are_refused_before_anything_runs(tmp_path, text, words):
    """Each error names file, place and remedy; no folder is made. Catches a study that fails after hours."""
    with pytest.raises(SceneError, match=f"(?s)study.toml.*{words}"):
        run_study(write(tmp_path, text), tmp_path / "out", options=QUIET)
    assert not (tmp_path / "out").exists()


def test_cases_and_repetitions(tmp_path):
    """Each case with each value and each seed; a varied value wins over its case, that over what is set.

    Catches a case that reaches other points, and repetitions with the same noise.
    """
    text = 'repeat = 2\n[set]\n"scan.nx" = 5\n"scan.ny" = 6\n[case.one]\n"scan.nx" = 7\nscan.z = 3\n[case."a b"]\n'
    study = load_study(write(tmp_path, text + '"scan.nx" = 8\n[vary]\nscan.z = [1, 2]'))
    points = study.points()
    assert [tuple(p.values()) for p in points] == list(itertools.product(("one", "a b"), (1, 2), (1, 2)))
    seeds = {"trace.seed": 2, "noise.seed": 2}
    assert study.overrides(points[1]) == {"scan.nx": 7, "scan.ny": 6, "scan.z": 1} | seeds
    assert study.overrides(points[7]) == {"scan.nx": 8, "scan.ny": 6, "scan.z": 2} | seeds
    alone = load_study(write(tmp_path, '[case.x]\n"scan.nx" = 7'))
    assert alone.points() == [{"case": "x"}] and alone.overrides({"case": "x"}) == {"scan.nx": 7}


EXAMPLES = [SCENES.parent / "docs" / "study_cap_height.toml", *sorted(SCENES.glob("studies/*.toml"))]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_studies_that_come_with_the_program_are_valid(path):
    """Every point's scene; every score that is shown. Catches an example that the program refuses after an hour."""
    study = load_study(path)
    scenes = [load_scene(locate(study.scene, path.parent), study.overrides(p)) for p in study.points()]
    assert 8 <= len(scenes) <= 60 and set(study.label) <= {"case", *study.vary}
    names = scenes[-1].instrument.detector_names
    for pattern in [study.score] if isinstance(study.score, str) else study.score:
        assert chosen_scores(pattern, possible_scores(study.reconstruct, names, 1))


def test_averages(tmp_path):
    """Mean and standard deviation of runs, by hand; failed runs and other cases do not count.

    Catches units that are not those shown, and a standard deviation of one.
    """
    rows = [{"case": "a", "repeat": i, "status": "done", "rms_image": v} for i, v in ((1, 0.01), (2, 0.03))]
    rows += [{"case": "b", "status": "done", "rms_image": 0.5}, {"case": "b", "status": "failed"}]
    points = averaged(rows, ["case"], ["rms_image"])
    assert [p.n for p in points] == [2, 1] and points[1].std["rms_image"] is None
    assert points[0].mean["rms_image"] == pytest.approx(2.0)
    assert points[0].std["rms_image"] == pytest.approx(math.sqrt(2.0))
    lines = table(points, {"case": "sample"}, ["rms_image"]).splitlines()
    assert lines[0].split("|")[1:3] == [" sample ", " RMS error, whole image [%] "]
    assert "2 +- 1.4" in lines[2] and lines[3].split("|")[2].strip() == "50"


def test_scores_of_micrographs(bshem):
    """A border of 10 counts, a middle of 25, all else 0; half multiple scattering. Catches means of other pixels."""
    counts = np.zeros((3, 9, 11))
    counts[:, [0, -1], :] = counts[:, :, [0, -1]] = 10.0
    counts[:, 4, 5] = 25.0
    by_order = np.stack([0.5 * counts, 0.5 * counts])
    masked = np.arange(3.0)[:, None, None] / 4 * np.ones((9, 11))
    axes = {"x": np.arange(11.0), "y": np.arange(9.0), "instrument": bshem}
    found = image_scores(hx.MicrographStack(counts, by_order=by_order, masked=masked, **axes))
    first, last = bshem.detector_names[0], bshem.detector_names[2]
    assert found[f"middle_{first}"] == 2.5 and found[f"multiple_{first}"] == 0.5 and found[f"masked_{last}"] == 0.5
    assert found[f"mean_{first}"] == pytest.approx((36 * 10 + 25) / 99) and f"plate_{first}" not in found


def test_figure_has_a_curve_for_each_case(tmp_path, monkeypatch):
    """Values side by side share an axis: two cases are two curves; points at random are a panel for each value.

    Catches a curve of its own for each point of a list, and a legend that hides the plot.
    """
    figures = []
    monkeypatch.setattr(sweep, "save_figure", lambda figure, path: figures.append(figure))
    labels = {"case": "method", "a": "a [um]", "b": "b"}
    rows = [({"case": case, "a": a, "b": 2.0 * a}, a) for case in ("x", "y") for a in (1.0, 10.0, 100.0)]
    many = [({"case": "x", "a": i * 7 % 20, "b": i * 3 % 20}, i) for i in range(20)]
    for made in (rows, many):
        points = [Averaged(values, {"s": mean}, {"s": 0.1}, 2) for values, mean in made]
        sweep.save_sweep(points, labels, {"s": "score"}, "title", tmp_path / "f.png")
    first, second = figures
    assert len(first.axes) == 1 and first.axes[0].get_xscale() == "log" and first.axes[0].get_xlabel() == "a [µm]"
    assert [text.get_text() for text in first.axes[0].get_legend().get_texts()] == ["x", "y"]
    assert [ax.get_xlabel() for ax in second.axes] == ["a [µm]", "b"] and all(
        ax.get_legend() is None for ax in second.axes
    )


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
    assert len((out / "table.md").read_text().splitlines()) == 2 + 4
    point = out / "point_00003"
    stack = hx.read(point / "micrographs.h5")
    alone = hx.simulate(hx.load_scene(point / "scene.toml"))
    assert np.array_equal(stack.counts, alone.counts)
    assert float(rows[2]["mean_forward"]) == stack.counts[0].mean() != float(rows[0]["mean_forward"])

    with pytest.raises(ResumeError, match="--resume"):
        run_study(path, out, options=QUIET)
    shutil.rmtree(point)
    assert dict(file_info(out).rows)["points"] == "4 done"  # as the index says
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
    told = dict(file_info(out).rows)
    assert sorted(told["points"].split(", ")) == ["1 failed", "3 done"] and told["to go on"] == f"helio resume {out}"
    monkeypatch.undo()
    said: list[str] = []
    resume_study(out, say=said.append)
    assert len(said) == 1 and said[0].startswith("point 2 of 4 (3 done, 1 left)")


def test_heights_are_scored(tmp_path):
    """A point with reconstruction has scores in the index, as `helio run` gives them. Catches another's scores."""
    text = '[vary]\n"sample.spheres.0.cap_height_um" = [500.0]\n'
    text = f'{SMALL}"reconstruct.method" = "nearfield"\n"scan.atoms_per_pixel" = 100000\n{text}'
    index = run_study(write(tmp_path, text), tmp_path / "out", options=QUIET)
    row = next(csv.DictReader(index.read_text().splitlines()))
    scores = json.loads((index.parent / "point_00001" / "scores.json").read_text())
    assert float(row["rms_image"]) == scores["rms_image"] and row["method"]
    assert not list(index.parent.glob("point_*/report.html"))
