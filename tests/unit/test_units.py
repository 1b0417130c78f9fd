"""Units of work: what they take and give, that their size does not matter, and what the key of a job covers."""

import copy
import tracemalloc

import numpy as np
import pytest
from scale import ARRAYS, SCENE, SMALL

from helio_jax.errors import GuardError, ResumeError
from helio_jax.formats.parts import Parts
from helio_jax.scene.surfaces import Body, flat_body
from helio_jax.trace import job as job_module
from helio_jax.trace import run, units
from helio_jax.trace.job import Job, differences
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.scan import ScanResult, trace_scene
from helio_jax.trace.units import UnitResult, trace_unit
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene

QUICK = SMALL | {"trace.rays": 16, "trace.paths_per_unit": 16 * 8 * 50}


def make_job(**changes) -> Job:
    scene = load_scene(SCENE, QUICK | {key.replace("__", "."): value for key, value in changes.items()})
    return Job.of(scene, scene.trace, scene.build_body())


def test_units_cover_the_scan_once():
    """Every pixel is in one unit, in order, and units hold as many paths as asked. Catches a lost last unit."""
    job = make_job()
    cut = job.units()
    assert [u.number for u in cut] == list(range(8)) and [u.stop - u.start for u in cut] == [50] * 7 + [10]
    assert np.array_equal(np.concatenate([job.pixels(u.start, u.stop)[0] for u in cut]), np.arange(360))
    grid_x, grid_y = np.meshgrid(*job.scene.positions())
    _, x, y = job.pixels(0, 360)
    assert np.array_equal(x, grid_x.ravel()) and np.array_equal(y, grid_y.ravel())
    assert len(make_job(trace__paths_per_unit=1).units()) == 360


@pytest.mark.parametrize("estimator", ["expected", "analog"])
def test_size_of_units_and_blocks_does_not_matter(estimator, monkeypatch):
    """One unit, 52 units and 8 units of small blocks give the bits that `trace_pixels` gives of the whole raster.

    Catches random numbers or positions counted from the start of a unit, and results stored at the wrong pixels.
    """
    jobs = [make_job(trace__paths_per_unit=n, trace__estimator=estimator) for n in (10**9, 16 * 8 * 7, 6400)]
    stacks = [trace_scene(j.scene, j.settings) for j in jobs[:2]]
    monkeypatch.setattr(run, "RAYS_PER_BLOCK", 500)
    stacks.append(trace_scene(jobs[2].scene, jobs[2].settings))
    for name in ARRAYS:
        for other in stacks[1:]:
            assert np.array_equal(getattr(stacks[0], name), getattr(other, name)), name
    scene = jobs[0].scene
    experiment = make_experiment(scene.build_body(), scene.instrument, jobs[0].settings)
    grid_x, grid_y = np.meshgrid(*scene.positions())
    found = trace_pixels(experiment, grid_x.ravel(), grid_y.ravel())
    if estimator == "analog":
        assert np.array_equal(stacks[0].counts.reshape(3, -1), found.hits.sum(0))  # whole numbers
    else:
        counts = np.maximum(found.total()[0], 0.0) * scene.scan.atoms_per_pixel
        assert np.array_equal(stacks[0].counts.reshape(3, -1), counts)


def test_unit_is_a_pure_function_that_travels():
    """A copy of a job gives the same result from scratch, stored and read back too. Catches state left behind."""
    job = make_job()
    unit = job.units()[3]
    unit_result = trace_unit(job, unit)
    sent = copy.deepcopy(job)
    units._prepared.cache_clear()
    assert sent == job and hash(sent) == hash(job)
    again = UnitResult.from_arrays(trace_unit(sent, unit).arrays(), sent, unit)
    for name, value in unit_result.arrays().items():
        assert np.array_equal(value, getattr(again, name)), name
    assert unit_result.fates.sum() == 50 * 16 * 8


@pytest.mark.parametrize("change", ["missing", "shape", "nan", "text"])
def test_wrong_unit_results_are_refused(change):
    """What is stored must be what this unit gives. Catches a part of an older format that is accepted."""
    job = make_job()
    arrays = trace_unit(job, job.units()[0]).arrays()
    changed = {
        "missing": {k: v for k, v in arrays.items() if k != "total"},
        "shape": arrays | {"total": arrays["total"][:, 1:]},
        "nan": arrays | {"variance": arrays["variance"] * np.nan},
        "text": arrays | {"fates": np.array(["1", "2", "3", "4"])},
    }[change]
    with pytest.raises(ValueError, match="must"):
        UnitResult.from_arrays(changed, job, job.units()[0])


def test_key_covers_what_the_result_depends_on(monkeypatch):
    """Scene, settings, surface and program change the key; threads and the description do not. Catches mixed merges."""
    key = make_job().key
    assert make_job(trace__workers=3, description="other").key == key == make_job().key
    for change in ({"trace__seed": 2}, {"trace__rays": 24}, {"scan__nx": 21}, {"beam__pinhole_radius_um": 2.0}):
        assert make_job(**change).key != key, change
    job = make_job()
    body = job.scene.build_body()
    spheres = body.spheres.copy()
    assert Job.of(job.scene, job.settings, Body(body.vertices, body.faces, spheres * (1 + 1e-15))).key == key
    assert Job.of(job.scene, job.settings, Body(body.vertices, body.faces, spheres * (1 + 1e-5))).key != key
    monkeypatch.setattr(job_module, "_hash_program", lambda: "other")
    assert make_job().key != key


def test_worker_with_another_program_is_refused(monkeypatch):
    """A worker that runs other code says what differs. Catches a cluster with an old installation."""
    job = make_job(trace__seed=77)
    monkeypatch.setattr(job_module, "_hash_program", lambda: "old")
    with pytest.raises(ResumeError, match=r"program\.helio_jax: .*sender.*sources old.*worker on"):
        trace_unit(job, job.units()[0])


def test_differences_name_places():
    """Nested tables and lists are compared to the leaf. Catches a message that prints two whole scenes."""
    then, now = {"a": {"b": [1, {"c": 2}]}, "d": 1}, {"a": {"b": [1, {"c": 3}]}, "e": None}
    assert differences(then, now, ("then", "now")) == ["a.b.1.c: 2 (then), 3 (now)", "d: 1 (then), null (now)"]


def test_lost_rays_stop_a_scan_early():
    """A flat upside down is refused at the first unit, not at the end. Catches a guard that sees one unit alone."""
    job, flat = make_job(), flat_body(8000.0)
    n_seen = []
    with pytest.raises(GuardError, match="from behind"):
        turned = Body(flat.vertices, flat.faces[:, ::-1])
        trace_scene(job.scene, job.settings, lambda done, total: n_seen.append(done), turned)
    assert max(n_seen) <= 50


def test_memory_grows_with_the_block_not_the_raster(monkeypatch):
    """Nine times the pixels: what is needed beyond the output grows by less than 100 bytes per pixel.

    Catches replicates kept until the end (6 orders x 8 replicates x 3 detectors x 8 bytes = 1152 bytes per pixel).
    """
    monkeypatch.setattr(run, "RAYS_PER_BLOCK", 4096)
    beyond = []
    for n in (40, 120):
        changes = {"scan.nx": n, "scan.ny": n, "trace.branches": 1, "trace.n_orders": 6, "trace.paths_per_unit": 16_000}
        scene = load_scene(SCENE, QUICK | changes)
        trace_scene(scene, scene.trace)
        tracemalloc.start()
        stack = trace_scene(scene, scene.trace)
        beyond.append(tracemalloc.get_traced_memory()[1] - sum(getattr(stack, name).nbytes for name in ARRAYS))
        tracemalloc.stop()
    assert (beyond[1] - beyond[0]) / (120**2 - 40**2) < 100


def test_scan_result_must_be_complete():
    """Micrographs with holes are never handed out. Catches a merge of too few parts."""
    job = make_job()
    scan_result = ScanResult(job)
    scan_result.put(job.units()[0], trace_unit(job, job.units()[0]))
    with pytest.raises(ValueError, match=r"units \[1, 2, 3, 4, 5, 6, 7\] are missing"):
        scan_result.micrographs()


def test_mixed_cpus_are_noted():
    """Parts from CPUs of two kinds: both are named, with a note. Catches a merge that hides it."""
    from dataclasses import replace

    job, provenances = make_job(), []
    for kinds in (["a"] * 8, ["a"] * 7 + ["b"]):
        scan_result = ScanResult(job)
        for unit, kind in zip(job.units(), kinds, strict=True):
            scan_result.put(unit, replace(trace_unit(job, unit), cpu=kind))
        provenances.append(scan_result.micrographs().provenance)
    assert provenances[0]["cpu"] == ["a"] and "note" not in provenances[0]
    assert provenances[1]["cpu"] == ["a", "b"] and "several kinds" in provenances[1]["note"]


def test_killed_while_cleaning_up(tmp_path, monkeypatch):
    """Killed while the parts are removed: what is left is no unfinished run, and resume clears it away.

    Catches a finished file that is traced again because half of its parts are gone.
    """
    from helio_jax.formats import parts as parts_module

    output = tmp_path / "out.h5"

    def killed(folder):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(parts_module.Path, "iterdir", killed)
        with pytest.raises(KeyboardInterrupt):
            pipeline.simulate_file(SCENE, output, overrides=QUICK)
    assert output.is_file() and not Parts(output).exist
    said: list[str] = []
    assert pipeline.resume(output, say=said.append) == [] and "complete" in said[0]
    assert list(tmp_path.iterdir()) == [output]
