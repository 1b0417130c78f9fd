"""Materials of a scene: which face has which law, several samples at once, and what is said when something is wrong."""

import numpy as np
import pytest

from helio_jax.errors import InputFileError, SceneError
from helio_jax.scene.files import read_scattering_table
from helio_jax.scene.sample import MeshSample
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.run import make_experiment
from helio_jax.trace.scan import trace_scene
from helio_jax.trace.settings import TraceSettings
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene

SCENE = """
[plate]
working_distance_um = 4000
[[detector]]
name = "a"
polar_deg = 30
half_angle_deg = 9
[sample]
kind = "flat"
material = "x"
[scan]
nx = 3
ny = 2
pixel_size_um = 10
"""
DIFFRACTION = '[material.x]\nkind = "diffraction"\nwavelength_nm = 0.1\n'
OBJ = """o box
v 0 0 0
v 10 0 0
v 0 10 0
v 10 10 0
usemtl gold
f 1 2 3
usemtl salt
f 2 4 3
v 20 0 0
v 30 0 0
v 20 10 0
v 30 10 0
usemtl plain
g tip
f 5 6 8 7
"""


def told(folder, text: str) -> str:
    path = folder / "scene.toml"
    path.write_text(SCENE + text)
    with pytest.raises(SceneError) as error:
        load_scene(path)
    assert "Input should" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "sample: its material 'x' is unknown, known are 'cosine': add the table [material.x]"),
        ('[material.x]\nkind = "broad_specula"', "did you mean 'broad_specular'?"),
        ("[material.x]\nsigma_deg = 3", "material.x.kind: is missing: say which, one of 'cosine', "),
        ('[material.x]\nkind = "broad_specular"\nsigma_deg = -3', "material.x.sigma_deg = -3: must be >= 1 deg"),
        ('[material.x]\nkind = "broad_specular"\nsigma_dg = 3', "did you mean 'sigma_deg'?"),
        ('[material.x]\nkind = "specular"\nalbedo = 0', "material.x.albedo = 0: must be > 0"),
        (DIFFRACTION + "lattice_nm = [[1, 0], [2, 0]]", "lattice_nm must be two vectors in different directions"),
        (DIFFRACTION + "lattice_nm = [[1, 0], [2, 0, 0]]", "must be two vectors, both of 2 or both of 3 numbers"),
        (DIFFRACTION + "lattice_nm = [[1, 0], [0, 1]]\npeaks = [[0, 0, 0.0]]", "must have at least one intensity > 0"),
        (
            DIFFRACTION + "lattice_nm = [[1, 0], [0, 1]]\nmax_order = [6, 60]",
            "max_order must be two numbers from 0 to 50",
        ),
        (
            '[material.x]\nkind = "mixture"\n[[material.x.parts]]\nweight = 1\n'
            'law = {kind = "uniform", half_angle_deg = 99}',
            "material.x.parts[0].law.half_angle_deg = 99: must be <= 90 deg",
        ),
        (
            '[material.x]\nkind = "specular"\ndebye_waller = {energy_mev = -1, mass_u = 3, temperature_k = 3}',
            "material.x.debye_waller.energy_mev = -1: must be > 0 meV",
        ),
    ],
)
def test_bad_materials(tmp_path, text, expected):
    """Each error names path, value, limit and remedy; catches tracebacks and union tags in paths."""
    assert expected in told(tmp_path, text)


def test_groups_of_a_mesh(tmp_path):
    """Faces get the material of their OBJ material, else group, else the sample's; catches faces out of order."""
    (tmp_path / "m.obj").write_text(OBJ)
    mesh = MeshSample(file="m.obj", unit="um", material="rest", materials={"salt": "b", "tip": "c"}, flat_size_um=100.0)
    body = mesh.model_copy(update={"flat_size_um": None}).build(tmp_path)
    where = {
        tuple(c[:2]): body.materials[m] for c, m in zip(body.triangles.mean(1).round(), body.face_material, strict=True)
    }
    assert where == {(3.0, 3.0): "rest", (7.0, 7.0): "b", (27.0, 3.0): "c", (23.0, 7.0): "c"}
    assert mesh.build(tmp_path).materials == ("rest", "b", "c")
    with pytest.raises(InputFileError, match="has no part 'gold2'"):
        MeshSample(file="m.obj", unit="um", materials={"gold2": "b"}).build(tmp_path)


def test_geometries_of_a_glb(tmp_path):
    """Geometries of a GLB are identified by name and keep their places in the scene; catches lost transforms."""
    import trimesh

    scene = trimesh.Scene()
    for name, x in (("left", -3.0), ("right", 3.0)):
        scene.add_geometry(
            trimesh.creation.box(), geom_name=name, transform=trimesh.transformations.translation_matrix([x, 0, 0])
        )
    scene.export(tmp_path / "m.glb")
    body = MeshSample(file="m.glb", unit="um", materials={"right": "b"}).build(tmp_path)
    is_b = np.array(body.materials)[body.face_material] == "b"
    np.testing.assert_array_equal(is_b, body.triangles[..., 0].mean(1) > 0)
    assert is_b.sum() == 12


MTL = """# from a CAD program
newmtl gold
Kd 0.8 0.7 0.1
helio_law broad_specular   # as measured
helio_sigma_deg 20
helio_diffuse_fraction 0.25
newmtl salt
Ns 10
helio_law diffraction
helio_wavelength_nm 0.1
helio_lattice_nm [[0.3, 0.0], [0.0, 0.4]]
helio_debye_waller {energy_mev = 60, mass_u = 29, temperature_k = 300, debye_k = 300}
newmtl plain
Kd 1 1 1
newmtl unused
helio_law specular
"""


def mtl_scene(tmp_path, text: str = "", obj: str = f"mtllib parts.mtl\n{OBJ}"):
    """A scene of the mesh OBJ, in a folder of its own, and further tables."""
    (tmp_path / "cad").mkdir(exist_ok=True)
    (tmp_path / "cad" / "m.obj").write_text(obj)
    table = 'kind = "mesh"\nfile = "cad/m.obj"\nunit = "um"\nmaterial = "x"\n[material.x]\nkind = "uniform"\n'
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.replace('kind = "flat"\nmaterial = "x"', table + text))
    return load_scene(path)


def test_laws_of_an_mtl_file(tmp_path):
    """Faces have the law that the .mtl gives their material; others the sample's, and the scene's tables win.

    What is traced equals to the bit the same mesh with the laws in the scene. Catches laws that
    come along but are not used, optical keys taken for laws, materials that no face uses, and a file that wins.
    """
    (tmp_path / "cad").mkdir()
    (tmp_path / "cad" / "parts.mtl").write_text(MTL)
    scene = mtl_scene(tmp_path)
    body, laws = scene.build_body(), scene.read_laws()
    where = {
        tuple(c[:2]): body.materials[m] for c, m in zip(body.triangles.mean(1).round(), body.face_material, strict=True)
    }
    gold, salt = "gold (cad/m.obj)", "salt (cad/m.obj)"
    assert where == {(3.0, 3.0): gold, (7.0, 7.0): salt, (27.0, 3.0): "x", (23.0, 7.0): "x"}
    assert set(laws) == {gold, salt, "x"} and scene.warnings() == []
    assert [(t.share, t.numbers[:1]) for t in laws[gold]] == [(0.25, ()), (0.75, (pytest.approx(np.radians(20.0)),))]
    assert laws[salt][0].attenuation > 1.0 and laws[salt][0].lattice[1] == pytest.approx([0.0, 4.0, 0.0])
    names = {name: law.kind for name, law in scene.used_materials.items()}
    assert names == {gold: "broad_specular", salt: "diffraction", "x": "uniform"}
    winner = mtl_scene(tmp_path, '[material.gold]\nkind = "specular"\n')
    assert len(winner.read_laws()[gold]) == 1 and winner.used_materials[gold].kind == "specular"
    mapped = mtl_scene(tmp_path, '[sample.materials]\ngold = "cosine"\ntip = "cosine"\n')
    assert mapped.build_body().materials == ("x", "cosine", salt) and set(mapped.read_laws()) == {salt, "x"}
    settings = TraceSettings(rays=16, seed=4)
    by_hand = mtl_scene(
        tmp_path,
        '[sample.materials]\ngold = "gold"\nsalt = "salt"\n[material.gold]\nkind = "broad_specular"\nsigma_deg = 20\n'
        'diffuse_fraction = 0.25\n[material.salt]\nkind = "diffraction"\nwavelength_nm = 0.1\n'
        "lattice_nm = [[0.3, 0.0], [0.0, 0.4]]\n"
        "debye_waller = {energy_mev = 60, mass_u = 29, temperature_k = 300, debye_k = 300}\n",
    )
    assert np.array_equal(trace_scene(scene, settings).counts, trace_scene(by_hand, settings).counts)
    assert not np.array_equal(trace_scene(scene, settings).counts, trace_scene(winner, settings).counts)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("newmtl gold\nhelio_law broad_specula\n", "line 2: helio_law broad_specula: must be one of 'cosine', "),
        (
            "newmtl gold\nhelio_law broad_specular\n",
            "line 2: helio_law broad_specular needs helio_sigma_deg: add the line",
        ),
        (
            "newmtl gold\nKd 1 1 1\nhelio_law specular\nhelio_sigma_deg 3\n",
            "line 4: helio_sigma_deg: the law 'specular' has",
        ),
        (
            "newmtl gold\nhelio_law specular\nhelio_albedo 2\n",
            "line 3: helio_albedo 2: should be less than or equal to 1",
        ),
        ("newmtl gold\nhelio_law specular\nhelio_albedo much\n", "line 3: helio_albedo much: should be a valid number"),
        ("newmtl gold\nhelio_albedo 0.5\n", "line 2: the material 'gold' has no helio_law: add one"),
        ("newmtl gold\nHelio_law specular\n", "line 2: Helio_law: keys are written helio_law and helio_KEY"),
        ("helio_law specular\n", "line 1: helio_law: stands before any newmtl NAME"),
        ("newmtl cosine\nhelio_law specular\n", "line 2: helio_law: 'cosine' is reserved for the cosine law"),
        ("newmtl gold\nhelio_law specular\nhelio_law cosine\n", "line 3: helio_law: 'gold' has it already in line 2"),
    ],
)
def test_bad_mtl(tmp_path, text, expected):
    """Each error names file, line and remedy; catches keys that are ignored as if they were optical ones."""
    (tmp_path / "cad").mkdir()
    (tmp_path / "cad" / "parts.mtl").write_text(text)
    with pytest.raises(InputFileError) as error:
        mtl_scene(tmp_path).build_body()
    assert f"parts.mtl, {expected}" in str(error.value)


def test_mtl_beside_the_mesh_only(tmp_path):
    """A missing file is a warning, and names lead to no other folder. Catches an untrusted path followed."""
    (tmp_path / "parts.mtl").write_text(MTL)
    scene = mtl_scene(tmp_path, obj=f"mtllib ../parts.mtl\n{OBJ}")
    assert set(scene.read_laws()) == {"x"}
    assert ["m.obj names parts.mtl, which is not beside it" in w for w in scene.warnings()] == [True]


def test_several_samples(tmp_path):
    """Two spheres on two flats, each with its own law, and the hits know it; catches indices mixed up when joined."""
    sphere = "kind = 'spheres', size_um = 200, spheres = [{radius_um = 20, material = 'y'}]"
    path = tmp_path / "scene.toml"
    path.write_text(
        SCENE.replace('kind = "flat"\nmaterial = "x"', 'kind = "several"')
        + f"[[sample.parts]]\nsample = {{{sphere}, material = 'x'}}\n"
        + f"[[sample.parts]]\nsample = {{{sphere.replace('y', 'z')}}}\nshift_um = [200, 0, 5]\n"
        + "".join(f'[material.{n}]\nkind = "uniform"\n' for n in "xyz")
    )
    scene = load_scene(path)
    body, hits = scene.build_body(), None
    intersector = Intersector(body)
    x = np.array([0.0, 50.0, 200.0, 250.0])
    origin = np.stack([x, 0 * x + 3.0, 0 * x + 1000.0], 1)
    hits = intersector.nearest(origin, np.tile([0.0, 0.0, -1.0], (4, 1)), np.full(4, -1, np.int32))
    assert [body.materials[i] for i in intersector.material_of(hits.surface)] == ["y", "x", "z", "cosine"]
    np.testing.assert_allclose(hits.point[[1, 3], 2], [0.0, 5.0], atol=1e-6)
    assert scene.sample.top == 45.0
    assert trace_scene(scene, TraceSettings(rays=8)).counts.shape == (1, 2, 3)


def test_material_without_law_is_refused(bshem):
    """A body painted from Python needs its law; catches a silent cosine law."""
    from helio_jax.scene.shapes import FlatSample

    with pytest.raises(SceneError, match="material 'gold' has no law"):
        make_experiment(FlatSample(material="gold").build(), bshem, TraceSettings())


def test_upright_lattice_is_refused(tmp_path, bshem):
    """A lattice perpendicular to a face has no reciprocal there; one that rotates with the face does."""
    from helio_jax.scene.scattering import DiffractionLaw
    from helio_jax.scene.shapes import StepSample

    step = StepSample(height_um=10.0, material="m").build()
    fixed, turned = (
        DiffractionLaw(wavelength_nm=0.1, lattice_nm=v).terms() for v in (((1, 0, 0), (0, 1, 0)), ((1, 0), (0, 1)))
    )
    with pytest.raises(SceneError, match=r"tilted by 90\.0 deg against a face"):
        make_experiment(step, bshem, TraceSettings(), {"m": fixed})
    assert make_experiment(step, bshem, TraceSettings(), {"m": turned}).laws is not None


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 2\n3 4\n", "needs 3 or 4 columns"),
        ("0 0 1\n0 180 1\n90 0 1\n", "do not fill a grid of 1 x 2 x 2"),
        ("0 0 1\n0 180 1\n95 0 1\n95 180 1\n", "must lie within 0 to 90 deg"),
        ("0 0 1\n0 90 1\n90 0 1\n90 90 1\n", "phi must run from 0 to 180 deg"),
        ("0 0 1\n0 180 1\n90 0 -1\n90 180 1\n", "intensities must be >= 0"),
        ("0 0 x\n", "is not a grid of numbers"),
    ],
)
def test_bad_tables(tmp_path, text, expected):
    """Every unusable table is an InputFileError that names the file; catches tracebacks and silent gaps."""
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(InputFileError, match=expected) as error:
        read_scattering_table(path)
    assert str(path) in str(error.value)


def test_tables_start_at_the_scene_file(tmp_path):
    """A table named in an extended file of another folder is found; catches paths taken from the wrong file."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "t.txt").write_text("0 0 1\n0 180 1\n90 0 1\n90 180 1\n")
    (tmp_path / "sub" / "base.toml").write_text(SCENE + '[material.x]\nkind = "table"\nfile = "t.txt"\n')
    path = tmp_path / "scene.toml"
    path.write_text("extends = 'sub/base.toml'\n")
    assert len(load_scene(path).read_laws()["x"]) == 1


def test_heights_of_another_law_say_so():
    """The fit takes every surface for cosine: where the scene's is another, a warning names it. Catches silence."""
    changes = {
        "scan.nx": 12,
        "scan.ny": 12,
        "scan.pixel_size_um": 200.0,
        "trace.rays": 16,
        "sample.spheres.0.material": "glass",
        "material.glass": {"kind": "rough_diffuse", "roughness": 0.4},
        "material.unused": {"kind": "specular"},
    }
    scene = load_scene("scenes/sphere_a.toml", changes)
    (said,) = (w for w in pipeline.reconstruct(pipeline.simulate(scene), "linear").warnings if "law" in w)
    assert "NOT the cosine law" in said and "glass (rough_diffuse)" in said and "unused" not in said
