"""Plates that are meshes: channels against Clausing's tube, a thin plate against the flat one, the book-keeping."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2
from stats import assert_likely, assert_mean

from benchmarks import tracer
from helio_jax.__main__ import main
from helio_jax.errors import InputFileError, MissingDependencyError, SceneError
from helio_jax.formats.hdf5 import read
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.scene.drill import SOLID_NAME, DrilledPlate, drill_plate
from helio_jax.scene.meshes import load_mesh
from helio_jax.scene.plates import read_plate
from helio_jax.scene.scattering import CosineLaw
from helio_jax.scene.shapes import FlatSample, Sphere, SpheresSample
from helio_jax.trace.intersect import Hits
from helio_jax.trace.job import Job
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.tally import DETECTED, ESCAPED, LOST, STOPPED
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene

SCENES = Path(__file__).parents[2] / "scenes"
H = 1000.0
BEAM = Beam(incidence_deg=20.0, source="pencil", pinhole_radius_um=20.0)
HOLES = (
    Detector(name="right", center_um=(800.0, 0.0), axes_um=(900.0, 700.0), rotation_deg=20.0),
    Detector(name="left", center_um=(-600.0, 900.0), axes_um=(800.0, 800.0)),
)


def flat_plate(*holes: Detector, **keys) -> Instrument:
    about = {"kind": "scattering", "radius_um": 4000.0, "working_distance_um": H} | keys
    return Instrument(beam=BEAM, plate=Plate.model_validate(about), detector=holes or HOLES)


def from_mesh(folder: Path, instrument: Instrument, drilled: DrilledPlate, *detectors: Detector, **keys):
    """Write a plate into a file; return the instrument that has it, and its mesh."""
    (folder / "plate.obj").write_text(drilled.obj("a comment\nof two lines"))
    plate = Plate.model_validate({"kind": "mesh", "file": "plate.obj", "unit": "um", "working_distance_um": H} | keys)
    detectors = detectors or tuple(Detector(name=d.name, part=d.name) for d in instrument.detector)
    new = Instrument(beam=instrument.beam, plate=plate, detector=detectors)
    return new, read_plate(plate, detectors, folder)


def analog(rays: int, **more) -> TraceSettings:
    return TraceSettings(rays=rays, estimator="analog", maps=False, **more)


def test_thin_plate_is_the_flat_one(tmp_path):
    """A plate 0.5 um thin with upright channels gives a flat scattering plate's counts: orders, detectors, plate share.

    Over a sphere, from 5 pixels: the mesh's whole atoms against the flat plate's expected counts, two-sided z scores,
    to 1 to 5 % each (a wall of 0.5 um takes 0.1 %). Catches a plate that does not move with the raster, one at the
    working instead of the sample's distance, walls that raise the order, normals the wrong way and a solid pinhole.
    """
    flat = flat_plate(sample_distance_um=1100.0, material="steel")
    drilled = drill_plate(flat, 0.5, angle=0.0)
    mesh, body = from_mesh(tmp_path, flat, drilled, sample_distance_um=1100.0, material="steel")
    laws = {"steel": CosineLaw(albedo=0.9).terms()}
    sample = SpheresSample(spheres=(Sphere(radius_um=300.0, cap_height_um=350.0),), size_um=9000.0).build()
    x, n = np.linspace(-400.0, 400.0, 5), 40_000
    expected = trace_pixels(make_experiment(sample, flat, TraceSettings(rays=1024, seed=2), laws), x, 0.2 * x)
    found = trace_pixels(make_experiment(sample, mesh, analog(n, seed=3), laws, plate=body), x, 0.2 * x)
    assert found.n_unaccounted == 0
    assert found.fates[LOST].sum() <= 8  # that start within the restart distance of a rim: 0 or 1, by the processor
    for name, hits, mean, variance in (
        ("orders", found.hits, expected.mean, expected.variance),
        ("plate", found.plate_hits, expected.plate_mean, expected.plate_variance),
    ):
        hits, mean, variance = (v.sum(-1).ravel() for v in (hits, mean, variance))  # over the pixels
        error = np.sqrt(hits / n**2 + variance + (1e-3 * mean) ** 2)
        z = (hits / n - mean) / error
        assert_likely(float(chi2.sf(np.sum(z**2), z.size)), f"{name}: mesh against flat plate, z = {z.round(1)}")
        assert np.all(error < 0.05 * mean), name


@pytest.mark.parametrize("ratio", [1, 2])
def test_channel_is_clausings_tube(tmp_path, ratio):
    """Atoms that enter an upright channel by the cosine law reach its end with Clausing's probability, to 1 %.

    They start in rings of equal area just below the channel; those of order 1 have not met the sample again. Catches
    walls that do not scatter by their law, leaks, and a surface that counts at the wrong end.
    """
    radius = 100.0
    hole = Detector(name="tube", center_um=(300.0, 0.0), axes_um=(2.0 * radius, 2.0 * radius))
    flat = flat_plate(hole, radius_um=1000.0)
    mesh, body = from_mesh(tmp_path, flat, drill_plate(flat, ratio * radius, angle=0.0))
    rng, points, rays = np.random.default_rng(5), 400, 150
    r, turn = 0.9997 * radius * np.sqrt((np.arange(points) + rng.random(points)) / points), rng.random(points)
    start = np.stack(
        [300.0 + r * np.cos(2 * np.pi * turn), r * np.sin(2 * np.pi * turn), np.full(points, H - 1e-3)], -1
    )
    first = Hits.on_mesh(start, np.tile([0.0, 0.0, 1.0], (points, 1)))
    experiment = make_experiment(FlatSample(size_um=9000.0).build(), mesh, analog(rays, seed=7), plate=body)
    here = np.zeros(points)
    share = trace_pixels(experiment, here, here, first=first).hits[0, 0] / rays
    std = np.sqrt(0.5 * np.mean(np.diff(share) ** 2) / points)  # of neighbouring rings
    assert_mean(share.mean(), tracer.CLAUSING[ratio], std, f"transmission of a channel of L/R = {ratio}")
    assert std < 0.01 * tracer.CLAUSING[ratio]


def test_white_furnace_with_a_plate(tmp_path):
    """Channels, and a hemisphere at infinity behind them: all atoms are detected that do not leave beside the flat.

    Exact books. Catches atoms lost in walls, a sky that a plate hides, or that catches what a channel has counted.
    """
    flat = flat_plate()
    sky = Detector(name="sky", polar_deg=0.0, half_angle_deg=90.0, at_infinity=True)
    parts = (Detector(name="right", part="right"), sky)
    (tmp_path / "open").mkdir()
    drilled = drill_plate(flat, 300.0)
    without = replace(drilled, ends={"right": drilled.ends["right"]})  # the left channel is open to the sky
    mesh, body = from_mesh(tmp_path, flat, without, *parts)
    experiment = make_experiment(FlatSample(size_um=4e5).build(), mesh, analog(40_000, max_events=500), plate=body)
    found = trace_pixels(experiment, np.array([0.0, 50.0]), np.zeros(2))
    fates = found.fates.sum(1)
    assert found.n_unaccounted == 0 and fates[STOPPED] == 0 and fates[LOST] <= 8
    assert fates[DETECTED] == found.hits.sum() == found.n_launched * 2 - fates[ESCAPED] - fates[LOST]
    assert fates[ESCAPED] < 2e-3 * fates.sum()
    assert np.all(found.hits.sum((0, 2)) > 3000) and found.plate_hits.sum() > 3000


def test_an_ellipse_counts_like_the_part(tmp_path):
    """A surface that counts, given as an ellipse at a height, catches what the same one in the mesh does: same seed.

    They differ by the polygon's corners alone (0.02 %). At height 0 it catches all that enter. Catches an ellipse that
    the plate below it does not hide, half axes, and a height from the wrong plane.
    """
    flat = flat_plate(*(d.model_copy(update={"channel": None}) for d in HOLES))
    drilled = drill_plate(flat, 400.0, angle=0.0)
    sample, x = FlatSample(size_um=9000.0).build(), np.array([0.0, 30.0])
    counts = {}
    for name, detectors in (
        ("part", ()),
        ("end", tuple(d.model_copy(update={"height_um": 400.0}) for d in HOLES)),
        ("entry", HOLES),
    ):
        ends = drilled if name == "part" else replace(drilled, ends={})
        mesh, body = from_mesh(tmp_path, flat, ends, *detectors)
        settings = analog(60_000, seed=9)
        counts[name] = trace_pixels(make_experiment(sample, mesh, settings, plate=body), x, x).hits.sum((0, 2))
    assert counts["end"] == pytest.approx(counts["part"], rel=3e-3)
    assert np.all(counts["entry"] > 1.2 * counts["end"])


def test_drilled_plate(tmp_path):
    """Watertight; of the disc's volume less the channels' (base times height, however they lean); its ends.

    Catches single precision, channels that do not go through, and one that leans the wrong way.
    """
    flat = flat_plate()
    for angle in (None, 0.0, np.radians(30.0)):
        drilled = drill_plate(flat, 250.0, angle=angle)
        (tmp_path / "solid.obj").write_text(replace(drilled, ends={}).obj())
        import trimesh

        solid = trimesh.Trimesh(*load_mesh(tmp_path / "solid.obj", 1.0)[:2], process=False)
        holes = [np.pi / 4 * np.prod(d.axes_um) for d in HOLES] + [np.pi * BEAM.pinhole_radius_um**2]
        assert solid.is_watertight and solid.euler_number == 2 - 2 * 3
        assert solid.volume == pytest.approx(250.0 * (np.pi * 4000.0**2 - sum(holes)), rel=1e-7)
        slope = np.tan(angle) if angle is not None else np.hypot(600.0, 900.0) / H
        lean = 250.0 * slope * np.array([-600.0, 900.0]) / np.hypot(600.0, 900.0)
        assert drilled.ends["left"].mean(0) == pytest.approx([*(lean + [-600.0, 900.0]), 250.0], abs=1e-6)
    square = drill_plate(flat_plate(radius_um=None, size_um=(5000.0, 6000.0), center_um=(100.0, 0.0)), 10.0)
    assert np.ptp(square.vertices, axis=0) == pytest.approx([5000.0, 6000.0, 10.0])


@pytest.mark.parametrize(
    ("change", "keys", "message"),
    [
        ({}, {"thickness": -1.0}, "thickness must be > 0 um"),
        ({}, {"thickness": 10.0, "radius": 900.0}, "the channel of 'right' leaves the plate at its rim: enlarge"),
        (
            {"beam": {"incidence_deg": 25.0, "azimuth_deg": -56.3, "pinhole_radius_um": 50.0}},
            {"thickness": 900.0, "angle": 0.0},
            "the pinhole's channel meets that of 'left' within the plate: make the plate thinner",
        ),
        ({"detector": [{"name": SOLID_NAME, "polar_deg": 3, "half_angle_deg": 2}]}, {"thickness": 1.0}, "rename it"),
        (
            {"detector": [{"name": "a", "polar_deg": 3, "half_angle_deg": 2, "at_infinity": True}]},
            {"thickness": 1.0},
            "at infinity",
        ),
    ],
)
def test_impossible_plates(change, keys, message):
    """Each is told with its remedy; catches channels that leave by the rim, and ones that run into one another."""
    plate = {"working_distance_um": H}
    tables = {"plate": plate, "detector": [d.model_dump() for d in HOLES]} | change
    with pytest.raises(SceneError, match=message):
        drill_plate(Instrument.model_validate(tables), **keys)


def test_without_manifold(monkeypatch):
    """The optional package's absence is an error of its own (exit code 5), with what to install."""
    monkeypatch.setitem(__import__("sys").modules, "manifold3d", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'helio-jax\[plates\]'") as error:
        drill_plate(flat_plate(), 10.0)
    assert error.value.exit_code == 5


def scene_of(folder: Path, text: str = "", part: str = "") -> Path:
    """Write a scene that extends an instrument and uses plate.obj beside it."""
    path = folder / "scene.toml"
    tables = f'[plate]\nkind = "mesh"\nfile = "plate.obj"\nunit = "um"\n{part}' + "".join(
        f'[[detector]]\nname = "{name}"\npart = "{name}"\n' for name in ("forward", "right", "left")
    )
    rest = '[sample]\nkind = "flat"\n[scan]\nnx = 2\nny = 2\npixel_size_um = 20.0\n[trace]\nrays = 4000\n'
    path.write_text(f"extends = {json.dumps(str(SCENES / 'instruments' / 'bshem_wd4.toml'))}\n{tables}{rest}{text}")
    return path


def run(*words) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    return int(end.value.code or 0)


def test_from_instrument_to_file(tmp_path, capsys):
    """helio plate, validate, simulate: the tables that are printed make a scene; its file holds the plate's share.

    Catches a plate file that does not enter the key of a run, one sought elsewhere than beside the scene, and maps that
    know nothing of channels.
    """
    instrument = SCENES / "instruments" / "bshem_wd4.toml"
    assert run("plate", instrument, "-o", tmp_path / "plate.obj", "--thickness-um", 300) == 0
    printed = capsys.readouterr().out
    path = scene_of(tmp_path, 'estimator = "analog"\n', f'part = "{SOLID_NAME}"\n')
    assert all(line in printed for line in path.read_text().splitlines()[1:14])
    assert run("validate", path) == 0
    told = capsys.readouterr().out
    assert "plate's mesh " in told and "ok, a scene" in told and "warning" not in told
    assert run("validate", path, "--json") == 0
    assert json.loads(capsys.readouterr().out)["plate"]["is_watertight"]
    assert run("simulate", path, "-o", tmp_path / "a.h5") == 0
    stack = read(tmp_path / "a.h5")
    assert stack.counts.sum() > 100 and stack.masked is None and stack.noise == "poisson"
    assert stack.plate is not None and 0 < stack.plate.sum() < stack.counts.sum()
    scene = load_scene(path)
    job = Job.of(scene, scene.trace, scene.build_body())
    assert run("plate", instrument, "-o", tmp_path / "plate.obj", "--thickness-um", 301, "--force") == 0
    assert Job.of(scene, scene.trace, scene.build_body()) != job
    with pytest.raises(SceneError, match=r"plate\.kind = 'mesh': that can be simulated only; heights"):
        pipeline.reconstruct(stack, "linear")


def test_what_is_refused(tmp_path):
    """Expected counts, keys of other plates, turned detectors, meshes below the pinhole, inside out, without a part.

    Each with its remedy. Catches expected counts that know nothing of the channels.
    """
    (tmp_path / "plate.obj").write_text(drill_plate(load_scene(SCENES / "sphere_a.toml").instrument, 300.0).obj())
    with pytest.raises(SceneError, match=r"trace\.estimator = 'expected': .* set trace\.estimator = 'analog'"):
        load_scene(scene_of(tmp_path))
    scene = load_scene(scene_of(tmp_path, 'estimator = "analog"\n'))
    with pytest.raises(SceneError, match=r"needs trace\.estimator = 'analog'"):
        pipeline.simulate(scene, estimator="expected")
    for changes, message in (
        ({"plate.radius_um": 9.0}, 'a mesh plate has no radius_um: set kind = "scattering" or remove the key'),
        ({"plate.unit": None}, 'a plate of kind "mesh" needs unit'),
        ({"plate.kind": "transparent"}, 'a transparent plate has no file: set kind = "mesh"'),
        ({"detector.0.height_um": 3.0}, "not by a mixture"),
        ({"scan.rotations_deg": [0.0, 9.0], "scan.rotate": "detectors"}, "rotate the sample the other way"),
        ({"detector": [{"name": "a", "part": "a"}], "plate": {"kind": "x"}}, "must be one of"),
    ):
        with pytest.raises(SceneError) as error:
            load_scene(scene_of(tmp_path, 'estimator = "analog"\n'), changes)
        assert message in str(error.value)
    upside_down = {"plate.rotate_deg": [180.0, 0.0, 0.0]}
    for changes, message in (
        (upside_down, "reaches down to z = -300 um, it must lie at z >= 0"),
        ({"detector.0.part": "backward"}, "has no part 'backward'"),
        ({"plate.unit": "inch"}, "check plate.unit"),
        ({"plate.file": "none.obj"}, "none.obj: no such file"),
    ):
        changed = load_scene(scene_of(tmp_path, 'estimator = "analog"\n'), changes)
        with pytest.raises(InputFileError) as error:
            changed.read_plate()
        assert message in str(error.value)
    moved = load_scene(
        path=scene_of(tmp_path, 'estimator = "analog"\n'), overrides=upside_down | {"plate.translate_um": [0, 0, 300]}
    )
    assert moved.read_plate().bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
    assert "the plate is not closed" not in str(scene.warnings())
    one = [{"name": "o", "part": "right"}]
    one_less = load_scene(scene_of(tmp_path, 'estimator = "analog"\n'), {"detector": one})
    assert ["the plate is not closed" in w for w in one_less.warnings()].count(True) == 1
    alone = load_scene(scene_of(tmp_path, 'estimator = "analog"\n'), {"plate.part": SOLID_NAME, "detector": one})
    assert len(alone.read_plate().materials) == 2 and "not closed" not in str(alone.warnings())
    with pytest.raises(SceneError, match=r"plate\.part = 'right' is a detector's part, too"):
        load_scene(scene_of(tmp_path, 'estimator = "analog"\n'), {"plate.part": "right"})
    lines = [line.split() for line in (tmp_path / "plate.obj").read_text().splitlines()]
    (tmp_path / "plate.obj").write_text(
        "\n".join(" ".join([w, *rest[::-1]] if w == "f" else [w, *rest]) for w, *rest in lines)
    )
    with pytest.raises(InputFileError, match="the plate is inside out"):
        scene.read_plate()


def test_the_mesh_stays_beside_its_instrument(tmp_path):
    """A scene elsewhere extends an instrument file with a plate: the mesh is found beside it. Catches a lost folder."""
    from helio_jax.workflows.scene_file import load_instrument

    folder = tmp_path / "instruments"
    folder.mkdir()
    drilled = drill_plate(flat_plate(), 100.0)
    mesh, _ = from_mesh(folder, flat_plate(), drilled)
    tables = '[plate]\nkind = "mesh"\nfile = "plate.obj"\nunit = "um"\nworking_distance_um = 1000\n'
    tables += "".join(f'[[detector]]\nname = "{d.name}"\npart = "{d.part}"\n' for d in mesh.detector)
    (folder / "own.toml").write_text(tables + '[trace]\nestimator = "analog"\n')
    path = tmp_path / "scene.toml"
    path.write_text(
        'extends = "instruments/own.toml"\n[sample]\nkind = "flat"\n[scan]\nnx = 2\nny = 2\npixel_size_um = 9\n'
    )
    scene = load_scene(path)
    assert scene.plate.file == "instruments/plate.obj" and scene.read_plate() is not None
    with pytest.raises(SceneError, match=r"plate\.kind = 'mesh'"):
        drill_plate(load_instrument(folder / "own.toml"), 10.0)
