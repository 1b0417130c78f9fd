"""Micrographs in the reference simulator's layout (.mat): what `helio import` reads back, and what MATLAB sees."""

import numpy as np
import pytest
import scipy.io
from scale import SCENE
from typer.testing import CliRunner

from helio_jax.__main__ import app
from helio_jax.detector import Detector
from helio_jax.errors import SceneError
from helio_jax.formats.export import export
from helio_jax.formats.hdf5 import write
from helio_jax.formats.matlab import import_micrographs
from helio_jax.micrograph import MicrographSet
from helio_jax.workflows.pipeline import record, simulate
from helio_jax.workflows.scene_file import load_scene

SMALL = {"scan.nx": 7, "scan.ny": 5, "scan.pixel_size_um": 300.0, "scan.center_um": [40.0, -30.0], "trace.maps": False}


@pytest.fixture(scope="module")
def stacks():
    """The same few pixels as expected counts (orders as numbers of any kind) and as whole analog counts."""
    scene = load_scene(SCENE, SMALL | {"trace.n_orders": 3})
    return {e: simulate(scene, estimator=e, rays=2000 if e == "analog" else 64) for e in ("expected", "analog")}


def test_says_what_is_left_out(tmp_path, stacks):
    """Plate bounces, effusive counts and single orders have no field in that layout, which is reported.

    Catches an export without that report, and a report on stacks without such data.
    """
    stack = stacks["expected"]
    more = stack.replace(effuse=0.1 * stack.counts, plate=0.2 * stack.counts)
    told = export(more, tmp_path / "a.mat")
    assert [t.split(",")[0].split(" ")[0] for t in told] == ["effuse", "plate", "orders"] and "10.0%" in told[0]
    assert len(export(stack, tmp_path / "b.mat")) == 1


@pytest.mark.parametrize("estimator", ["expected", "analog"])
def test_round_trip(tmp_path, stacks, bshem, estimator):
    """Written and imported again: every count to the bit, raster and instrument as they were.

    Catches reversed columns or rows, half axes for full ones, an aperture's y not negated, an x pitch across the beam
    or along the sample, and counts that wrap in 8 bits.
    """
    stack = stacks[estimator]
    export(stack, tmp_path / "a.mat")
    back = import_micrographs(tmp_path / "a.mat", bshem)
    assert np.array_equal(back.by_order[0], stack.by_order[0]) and np.array_equal(back.by_order[1], stack.multiple)
    assert back.noise == stack.noise  # whole counts or expectations: noise may be added to the latter only
    if estimator == "analog":
        assert np.array_equal(back.counts, stack.counts) and stack.counts.max() > 20
    for name in ("x", "y"):
        np.testing.assert_allclose(getattr(back, name), getattr(stack, name), rtol=1e-12, atol=1e-9)
    assert back.n_rays == stack.n_rays and back.instrument.sample_distance == stack.instrument.sample_distance
    assert back.instrument.beam == stack.instrument.beam and back.instrument.working_distance == 4000.0
    for ours, theirs in zip(stack.instrument.apertures(), back.instrument.apertures(), strict=True):
        np.testing.assert_allclose(ours.center, theirs.center, atol=1e-6)
        np.testing.assert_allclose(ours.semi_axes, theirs.semi_axes, atol=1e-6)


def test_file_of_the_reference_is_written_as_it_was(tmp_path, shared, bshem):
    """The public file of sphere A, imported and exported: the same variables, values and types of whole numbers.

    Independent of our importer. Catches mm for um, another frame, names that the file does not have.
    """
    source = shared / "data" / "sphere_a_simulated.mat"
    export(import_micrographs(source, bshem), tmp_path / "again.mat")
    theirs, ours = (scipy.io.loadmat(p, simplify_cells=True) for p in (source, tmp_path / "again.mat"))
    for name in ("single", "multiple"):
        for a, b in zip(theirs["im"][name], ours["im"][name], strict=True):
            assert np.array_equal(a, b) and a.dtype == b.dtype
    for table, keys in (
        ("im", ("raster_movement_x", "raster_movement_y")),
        ("param", ("z_sample_to_detector", "rays_per_pixel", "detector_position", "detector_axes")),
        ("beam_param", ("init_angle", "source_size", "pinhole_r", "pinhole_c")),
    ):
        for key in keys:
            a, b = (np.vstack([*np.atleast_1d(file[table][key])]) for file in (ours, theirs))
            np.testing.assert_allclose(a, b, atol=1e-9)
    assert ours["beam_param"]["source_model"] == theirs["beam_param"]["source_model"]


def test_command_and_refusals(tmp_path, stacks):
    """What the layout cannot hold is written under other names, with the reason. Catches noise in single scattering."""
    write(stacks["analog"], tmp_path / "a.h5")
    result = CliRunner().invoke(app, ["export", str(tmp_path / "a.h5"), "-o", str(tmp_path / "a.mat")])
    assert result.exit_code == 0 and (tmp_path / "a.mat").stat().st_size > 500, result.output
    stack, scene = stacks["expected"], load_scene(SCENE, SMALL)
    noisy = record(scene, stack)
    cones = [
        Detector(name=name, polar_deg=40.0, azimuth_deg=120.0 * k, half_angle_deg=5.0, at_infinity=True)
        for k, name in enumerate(stack.instrument.detector_names)
    ]
    with_cones = stack.instrument.model_copy(update={"detector": cones})
    for other, reason in (
        (noisy, "both are expectations while the counts have noise"),
        (stack.replace(instrument=with_cones), "is at infinity"),
        (stack.replace(by_order=None), "which these micrographs do not"),
    ):
        assert reason in export(other, tmp_path / "other.mat")[0]
        assert "im" not in scipy.io.loadmat(tmp_path / "other.mat")
    counts = scipy.io.loadmat(tmp_path / "other.mat", simplify_cells=True)["counts"]
    assert np.array_equal(np.stack(list(counts)), stack.counts)
    both = MicrographSet((stack, stacks["analog"]))
    with pytest.raises(SceneError, match=r"give --view 0 to 1$"):
        export(both, tmp_path / "a.mat")
    for one in (stack, both):  # a view that is not there is not taken for another one
        with pytest.raises(SceneError, match="got 2"):
            export(one, tmp_path / "a.mat", view=2)
    export(both, tmp_path / "b.mat", view=1)
    assert (tmp_path / "b.mat").is_file()
