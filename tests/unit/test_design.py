"""Design of layouts: walls between apertures, starts, search, records and files, the command; closed forms first."""

import json
import math
from pathlib import Path

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

import helio_jax as hx
import helio_jax.__main__
from helio_jax.commands.app import app
from helio_jax.commands.planning import DESIGN
from helio_jax.errors import SceneError
from helio_jax.forward.layout import Layout
from helio_jax.planning.design_settings import MAX_KEPT, DesignSettings
from helio_jax.planning.search import minimise
from helio_jax.planning.starts import Ranges, free_pattern, paired, paired_pattern
from helio_jax.workflows import design as designing
from helio_jax.workflows.design_result import Design, Proposal, distinct, kept, with_best
from helio_jax.workflows.scene_file import SceneFile, load_scene

W = 4000.0
RANGES = Ranges((0.2, 1.0), (-0.5, 0.5), (0.0, 0.0))
SCENE = """
extends = "bshem_wd4"
[plate]
sample_distance_um = 4060.0
[sample]
kind = "spheres"
size_um = 8000.0
[[sample.spheres]]
radius_um = 300.0
cap_height_um = 120.0
[scan]
nx = 14
ny = 12
pixel_size_um = 60.0
atoms_per_pixel = 1e5
[design]
apertures = [3]
pixels = 7
steps = 3
starts = 1
masked_weights = [1.0]
"""


def layout(polar_deg, azimuth_deg, area) -> Layout:
    return Layout(np.radians(polar_deg), np.radians(azimuth_deg), np.asarray(area, float), np.asarray(W))


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> SceneFile:
    path = tmp_path_factory.mktemp("design") / "cap.toml"
    path.write_text(SCENE)
    return load_scene(path)


@pytest.fixture(scope="module")
def found(scene) -> designing.Design:
    return hx.design(scene)


def test_walls_of_circles_and_ellipses():
    """Two channels at opposite azimuths are W (tan p1 + tan p2) apart, less their semi-axes r / cos p along the line.

    The disc about the pinhole lies W tan(30 deg) against the beam. To 1e-4 of the distance, and never above it. Catches
    semi-axes that are exchanged, a pinhole on the wrong side, and radii instead of semi-axes.
    """
    with jax.enable_x64(True):
        one = layout([30.0, 45.0], [0.0, 180.0], [1e6, 2e6])
        shift = np.array([math.tan(math.radians(30.0)), 0.0])
        gaps = np.asarray(one.gaps(shift, 300.0))
        reach, optics = np.asarray(one.reach(500.0)), one.optics(shift, 20.0)
        axes = np.asarray(optics.axes)
    semi = [math.sqrt(a / math.pi / math.cos(p)) for a, p in ((1e6, math.pi / 6), (2e6, math.pi / 4))]
    x = [W * math.tan(math.pi / 6), -W]
    pinhole = -W * math.tan(math.pi / 6)
    expected = [x[0] - x[1] - sum(semi), x[0] - pinhole - semi[0] - 300.0, pinhole - x[1] - semi[1] - 300.0]
    assert gaps == pytest.approx(expected, rel=1e-4) and np.all(gaps <= np.array(expected) + 1e-9)
    assert reach == pytest.approx([(1 + 500 / W) * abs(c) + s for c, s in zip(x, semi, strict=True)])
    assert abs(np.linalg.det(axes[:, :2])) * math.pi == pytest.approx([1e6, 2e6])
    assert float(optics.sample_distance) == W + 20.0


def test_walls_are_distances():
    """Of two ellipses side by side in any direction: the least distance of 2000 x 2000 rim points, to 1e-3.

    Catches a distance along the line of the centres alone, which is too large.
    """
    with jax.enable_x64(True):
        one = layout([40.0, 50.0], [20.0, 65.0], [9e5, 2.4e6])
        gap = float(np.asarray(one.gaps(np.zeros(2), 1.0))[0])
        center, axes = np.asarray(one.center), np.asarray(one.axes())
    s = 2.0 * np.pi * np.arange(2000) / 2000
    rims = [c + np.stack([np.cos(s), np.sin(s)], -1) @ a.T for c, a in zip(center, axes, strict=True)]
    apart = np.sqrt(((rims[0][:, None] - rims[1][None]) ** 2).sum(-1).min())
    assert gap == pytest.approx(apart, rel=1e-3)


def test_pairs_are_mirrored():
    """Tied apertures stand at beam azimuth + and - the same angle, with one polar angle and area; a single one in the
    plane of the beam. For 3, 4 and 5. Catches a lost sign and a single one that leaves the plane."""
    beam = 0.4
    for n, single in ((3, 0.0), (3, math.pi), (4, 0.0), (5, 0.0)):
        pattern = paired_pattern(n, beam, single, RANGES)
        x = paired(n, pattern, single, RANGES)
        x = np.clip(x + 0.05 * np.random.default_rng(n).normal(size=len(x)), pattern.low, pattern.high)
        polar, azimuth, log_area = (pattern.base + pattern.matrix @ x)[:-1].reshape(3, n)
        first = n % 2
        if first:
            assert math.remainder(azimuth[0] - beam - single, 2 * math.pi) == pytest.approx(0.0, abs=1e-12)
        for i in range(first, n, 2):
            assert azimuth[i] - beam == pytest.approx(beam - azimuth[i + 1])
            assert polar[i] == polar[i + 1] and log_area[i] == log_area[i + 1]
    even = paired_pattern(4, 0.0, 0.0, RANGES)
    azimuth = (even.base + even.matrix @ paired(4, even, 0.0, RANGES))[4:8]
    assert np.sort(np.degrees(azimuth)) == pytest.approx([-135.0, -45.0, 45.0, 135.0])
    fixed = free_pattern(3, Ranges((0.5, 0.5), (0.0, 0.0), (0.1, 0.1)))
    assert fixed.matrix.shape == (10, 3) and fixed.base[[0, 9]] == pytest.approx([0.5, 0.1])


def test_search_ends_at_the_constrained_minimum():
    """Least (x - 2)^2 + y^2 with x + y <= 1, in closed form (1.5, -0.5). Catches a constraint of the wrong sign."""
    end = minimise(
        lambda x: (float((x[0] - 2.0) ** 2 + x[1] ** 2), np.array([2.0 * (x[0] - 2.0), 2.0 * x[1]])),
        np.zeros(2),
        (np.full(2, -5.0), np.full(2, 5.0)),
        lambda x: np.array([1.0 - x.sum()]),
        lambda x: -np.ones((1, 2)),
        50,
    )
    assert end.x == pytest.approx([1.5, -0.5], abs=1e-3) and end.least_room >= 0.0 and end.status == "converged"


def proposal(scene: SceneFile, height: float, masked: float, counts: float) -> Proposal:
    return Proposal(scene.instrument, "free", 0.0, "", height, 1.0, (1.0,), masked, None, counts, 0.0)


def test_ranking(scene):
    """A layout that another one dominates is not among the best; equal ones are one; the best of a number is kept.

    Catches a comparison of the wrong sign for counts.
    """
    a, b, c = (proposal(scene, *v) for v in ((1.0, 0.1, 1.0), (2.0, 0.05, 1.0), (2.0, 0.2, 0.9)))
    fast = proposal(scene, 3.0, 0.3, 1.1)
    marked = with_best(distinct([c, b, a, proposal(scene, 1.001, 0.1, 1.0), fast]))
    assert [p.height_std_um for p in marked] == [1.0, 2.0, 2.0, 3.0]
    assert [p.is_best for p in marked] == [True, True, False, True]
    assert [p.masked for p in kept(marked, 2)] == [0.1, 0.05] and len(kept(marked, 9)) == 4


def test_masked_samples_are_warned_of(scene):
    """Catches a gain promised in silence where traced samples did not confirm it, and a warning of unmasked samples."""
    few, many = (proposal(scene, 1.0, masked, 1.0) for masked in (0.005, 0.05))
    told = [Design("s", (), p, (), (), 1.0).warnings for p in (few, many)]
    assert not told[0] and "walls" in told[1][0] and "5.0%" in told[1][0]


def test_limits_hold_in_the_result(scene, found):
    """Walls of at least 200 um, polar angles within the range, the scene's total area, a beam of 30 deg.

    Measured on the instruments themselves, by rim points. Catches a constraint that the search or the file lost.
    """
    s = scene.design
    area = sum(math.pi * np.prod(a.semi_axes) for a in scene.instrument.apertures())
    assert found.total_area_um2 == pytest.approx(area) and found.proposals
    for p in found.proposals:
        apertures = p.instrument.apertures()
        assert sum(math.pi * np.prod(a.semi_axes) for a in apertures) == pytest.approx(area, rel=1e-9)
        assert all(s.polar_deg[0] - 1e-6 <= polar <= s.polar_deg[1] + 1e-6 for polar, _ in p.angles_deg)
        rims = [a.rim(720)[0] for a in apertures]
        pairs = [(i, j) for i in range(len(rims)) for j in range(i)]
        walls = [np.sqrt(((rims[i][:, None] - rims[j][None]) ** 2).sum(-1).min()) for i, j in pairs]
        pinhole = p.instrument.pinhole_center[:2]
        walls += [np.hypot(*(rim - pinhole).T).min() - s.pinhole_clearance_um for rim in rims]
        assert min(walls) >= s.wall_um - 1e-6 and p.least_wall_um == pytest.approx(min(walls), rel=2e-3)
        areas = [np.prod(a.semi_axes) for a in apertures]
        assert max(areas) / min(areas) <= s.area_ratio * (1 + 1e-9)
    assert found.reference.variance_ratio == found.reference.count_ratio == 1.0


def test_design_improves_and_repeats(scene, found):
    """Weighted as it was searched, the best layout beats the scene's; the same seed finds the same.

    Catches a search that goes uphill, and random numbers without a seed.
    """

    def goal(p: Proposal) -> float:
        return math.log(p.variance_ratio) + p.masked / max(found.reference.masked, designing.LEAST_MASKED)

    assert min(map(goal, found.proposals)) < goal(found.reference) - 0.01
    again = hx.design(scene)
    assert [p.angles_deg for p in again.proposals] == [p.angles_deg for p in found.proposals]


def test_files_of_a_design(tmp_path, scene, found):
    """Each kept layout as an instrument file that other commands read, apertures to 6 digits; table; pictures.

    Catches a file that lacks the beam, keeps the sample distance, or whose apertures are in another order.
    """
    files = found.write(tmp_path / "out")
    assert {f.name for f in files} <= set(DESIGN) and all(f.stat().st_size > 100 for f in files)
    assert len([name for name in DESIGN if name.endswith(".toml")]) == MAX_KEPT
    for i, p in enumerate(found.proposals, 1):
        path = tmp_path / "out" / f"layout_{i}.toml"
        read = hx.load_instrument(path)
        assert read.plate.sample_distance_um is None and read.beam == scene.beam
        for a, b in zip(read.apertures(), p.instrument.apertures(), strict=True):
            assert a.center == pytest.approx(b.center, rel=1e-5) and a.semi_axes == pytest.approx(b.semi_axes, rel=1e-5)
        done = CliRunner().invoke(app, ["validate", str(path)], catch_exceptions=False)
        assert done.exit_code == 0
    record = json.loads((tmp_path / "out" / "design.json").read_text())
    assert len(record["proposals"]) == len(found.proposals) and record["proposals"][0]["n_apertures"] == 3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reconstruct.border": "free"}, "needs reconstruct.border = 'flat'"),
        ({"design.total_area_um2": 5e8}, "no layout of 3 apertures of 5e[+]08 um.2 in all keeps walls"),
        ({"scan.rotations_deg": [0.0, 90.0], "scan.rotate": "detectors"}, "a raster at one distance and rotation"),
        ({"design.polar_deg": [50.0, 20.0]}, "least, largest"),
        ({"design.apertures": [2]}, "greater than or equal to 3|>= 3"),
        ({"design.apertrues": [3]}, "unknown key 'apertrues'"),
    ],
)
def test_what_is_refused(tmp_path, changes, message):
    """Each with its remedy. Catches a design that goes on where its criterion does not hold."""
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    with pytest.raises(SceneError, match=message):
        hx.design(load_scene(path, changes))


def test_command(tmp_path):
    """helio design: a table with the scene's layout first, the files, --json; existing files are kept.

    Catches options that do not arrive, and results that are replaced without --force.
    """
    (tmp_path / "cap.toml").write_text(SCENE)
    words = ["design", str(tmp_path / "cap.toml"), "-o", str(tmp_path / "out"), "--seed", "3", "--quiet"]
    done = CliRunner().invoke(app, [*words, "--set", "design.steps=1"], catch_exceptions=False)
    lines = done.stdout.splitlines()
    assert done.exit_code == 0 and "the scene's" in lines[1] and "1.00" in lines[1] and "design.json" in lines[-1]
    assert (tmp_path / "out" / "pareto.png").is_file()
    assert CliRunner().invoke(app, words).exception is not None  # exists
    more = ["--sample", str(tmp_path / "cap.toml"), "--json", "--force", "--set", "design.steps=1"]
    record = json.loads(CliRunner().invoke(app, [*words, *more], catch_exceptions=False).stdout)
    assert record["samples"] == ["cap", "cap"] and all(Path(f).is_file() for f in record["files"])
    assert DesignSettings().apertures == (3, 4)
