"""Single atoms: the very ones that an analog simulation counts, where they are and how they fly."""

import csv

import numpy as np
import pytest
from scale import SCENE, SMALL
from stats import assert_likely, pooled_chi2
from typer.testing import CliRunner

from helio_jax.__main__ import app
from helio_jax.errors import SceneError
from helio_jax.scene.scattering import COSINE_LAW
from helio_jax.scene.shapes import FlatSample, TrenchSample
from helio_jax.scene.surfaces import Body
from helio_jax.trace.direct import ApertureTable, find_aperture
from helio_jax.trace.follow import Atoms, follow_atoms, follow_scene
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.tally import DETECTED, ESCAPED, FATES
from helio_jax.workflows.scene_file import load_scene

RUNNER = CliRunner()


@pytest.mark.parametrize("law", ["cosine", "mixture"])
def test_atoms_are_those_of_an_analog_simulation(bshem, law):
    """Fates per pixel, and detected atoms by order and detector, are those of the tracer: exact integers.

    A slot, with cosine walls and with a mixture that mirrors, sticks and broadens. Catches an order counted one off, a
    random number used twice, and atoms that stick but go on.
    """
    from pydantic import TypeAdapter

    from helio_jax.scene.scattering import Law

    body: Body = TrenchSample(width_um=100.0, length_um=600.0, depth_um=200.0, material=law).build()
    terms = {"kind": "broad_specular", "sigma_deg": 20.0, "diffuse_fraction": 0.5, "albedo": 0.8}
    laws = {"mixture": TypeAdapter(Law).validate_python(terms).terms()} if law == "mixture" else {}
    settings = TraceSettings(rays=2000, estimator="analog", n_orders=6, max_events=8, seed=5)
    experiment = make_experiment(body, bshem, settings, {"cosine": COSINE_LAW} | laws)
    x, y = np.array([0.0, 30.0, 100.0]), np.array([0.0, -20.0, 60.0])
    found, atoms = trace_pixels(experiment, x, y), follow_atoms(experiment, np.arange(3), x, y)
    for p in range(3):
        mine = atoms.pixel == p
        assert [int(np.sum(atoms.fate[mine] == f)) for f in range(len(FATES))] == found.fates[:, p].tolist()
        for k in range(3):
            order = np.minimum(atoms.order[mine & (atoms.detector == k)], 6)
            assert np.bincount(order, minlength=7)[1:].tolist() == found.hits[:, k, p].tolist()
    assert found.fates[2].sum() > 0 and np.all((atoms.detector >= 0) == (atoms.fate == DETECTED))


def test_positions_and_directions(bshem):
    """Off a flat every atom leaves from the beam's spot, its line meets the plate in the aperture it hit.

    Catches points after the last flight, plate points in the sample frame, and directions that are those before.
    """
    experiment = make_experiment(FlatSample().build(), bshem, TraceSettings(rays=4000, estimator="analog"))
    atoms = follow_atoms(experiment, np.array([7]), np.array([300.0]), np.array([-100.0]))
    np.testing.assert_allclose(atoms.point, np.broadcast_to([300.0, -100.0, 0.0], atoms.point.shape), atol=8.0)
    assert np.all(atoms.order == 1) and np.all(atoms.pixel == 7)
    np.testing.assert_allclose(np.linalg.norm(atoms.direction, axis=1), 1.0, atol=1e-12)
    table = ApertureTable(bshem)
    where = [find_aperture(x, y, 0.0, 0.0, 1.0, table.shapes) for x, y in atoms.plate_point]
    assert np.array_equal(where, atoms.detector) and 30 < np.sum(atoms.fate == DETECTED) < 400


def test_free_scattering_follows_the_law(bshem):
    """Directions off a flat: cos(theta) / pi per steradian in every bin; their integral is the share that left.

    60 000 atoms, chi-square over 90 bins; uniform directions are rejected. Catches solid angles of equal theta steps,
    atoms of order 0, and a histogram per detected atom.
    """
    experiment = make_experiment(FlatSample().build(), bshem, TraceSettings(rays=60_000, estimator="analog"))
    h = follow_atoms(experiment, np.zeros(1, int), np.zeros(1), np.zeros(1)).directions(9, 10)
    edges = np.radians(np.arange(0, 91, 10))
    share = np.repeat(np.diff(np.sin(edges) ** 2), 10) / 10
    assert_likely(pooled_chi2(h["counts"], 60_000 * share, 0 * share), "directions off a flat")
    flat = h["solid_angle_sr"] / (2 * np.pi)
    assert pooled_chi2(h["counts"], 60_000 * flat, 0 * flat) < 1e-12
    assert np.sum(h["density_per_sr"] * h["solid_angle_sr"]) == pytest.approx(1.0, abs=1e-3)
    assert h["theta_deg"][0] == pytest.approx(5.0) and h["phi_deg"][1] == pytest.approx(54.0)


def test_command_and_errors(tmp_path):
    """`helio rays` writes what it found; wrong pixels, suffixes and too many atoms say so.

    Catches rows and columns exchanged: pixel (2, 3) is number 2 nx + 3.
    """
    scene = load_scene(SCENE, SMALL | {"trace.rays": 64})
    atoms = follow_scene(scene, scene.trace, (2, 3))
    assert isinstance(atoms, Atoms) and np.all(atoms.pixel == 2 * 20 + 3) and atoms.fate.size == 64
    assert np.any(atoms.fate == ESCAPED)
    args = ["rays", str(SCENE), "-o", str(tmp_path / "a.csv"), "--pixel", "60", "60", "--rays", "64"]
    result = RUNNER.invoke(app, [*args, "--directions", str(tmp_path / "d.npz")])
    assert result.exit_code == 0 and "64 atoms" in result.stdout, result.output
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert len(rows) == 64 and {"x_um", "direction_z", "plate_x_um", "order", "fate", "detector"} <= set(rows[0])
    assert np.load(tmp_path / "d.npz")["counts"].sum() > 50
    for bad, message in ((["--pixel", "121", "0"], "row from 0 to 120"), (["--view", "1"], "view must be 0 to 0")):
        result = RUNNER.invoke(app, [*args[:4], *bad, "--force"])
        assert isinstance(result.exception, SceneError) and message in str(result.exception)
    plate = {
        "plate": {"kind": "scattering", "radius_um": 1e4, "working_distance_um": 4e3, "sample_distance_um": 4720.0}
    }
    with pytest.raises(SceneError, match=r"plate.kind = 'scattering': .* set plate.kind = 'transparent'"):
        follow_scene(load_scene(SCENE, plate), TraceSettings(rays=8), (2, 3))
    with pytest.raises(SceneError, match="at most 5000000 atoms"):
        follow_scene(load_scene(SCENE, {"trace.rays": 4096}), TraceSettings(rays=4096))
