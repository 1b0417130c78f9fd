"""The effusive beam and rays from a file: closed forms over a flat, weights, frames, and files that are refused.

A point source of cos^n above a flat at distance h lights it by K_n(r) = (n + 1) h^(n + 1) / (2 pi (r^2 + h^2)^m) with
m = (n + 3) / 2, whose 2-D Fourier transform is (n + 1) h^(n + 1) (q / 2h)^v K_v(q h) / Gamma(v + 1), v = (n + 1) / 2. A
cosine flat hands it on by K_1, so a hole of area A in the source's plane, R aside, catches
A / (2 pi) integral over q of q J_0(q R) K_n(q) K_1(q) (own derivation).
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gamma, j0, kv
from stats import assert_mean

from helio_jax.errors import InputFileError, SceneError
from helio_jax.instrument import Beam, Detector, Effusive, Instrument, Plate
from helio_jax.micrograph import MicrographStack
from helio_jax.scene.rays import read_rays
from helio_jax.scene.shapes import FlatSample
from helio_jax.trace.direct import form_factors
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.scan import trace_scene
from helio_jax.trace.settings import TraceSettings
from helio_jax.workflows.scene_file import load_scene

H = 1000.0
HOLE = Detector(name="hole", center_um=(H, 0.0), axes_um=(60.0, 60.0))


def instrument(**beam) -> Instrument:
    """A transparent plate H above the sample, a pinhole of no extent."""
    settings = Beam.model_validate({"source": "pencil", "pinhole_radius_um": 0.0} | beam)
    return Instrument(beam=settings, plate=Plate(working_distance_um=H), detector=(HOLE,))


@pytest.mark.parametrize("exponent", [1.0, 4.0])
def test_effusive_flat(exponent):
    """The effusive counts of a flat against the integral, to 1 %; the beam's own counts do not change by a bit.

    Catches cos^(n + 1) or cos^(n - 1) (20 % and more), an effusive beam about the beam's axis, and shared random
    numbers or tallies.
    """
    v = 0.5 * (exponent + 1.0)

    def along(s):
        return s * j0(s) * (exponent + 1.0) * (0.5 * s) ** v * kv(v, s) / gamma(v + 1.0) * s * kv(1.0, s)

    exact = np.pi * 30.0**2 / (2.0 * np.pi * H**2) * quad(along, 1e-12, 60.0, limit=400)[0]
    tilted = {"incidence_deg": 30.0, "effusive": Effusive(exponent=exponent, atoms_per_pixel=1.0, rays=4096)}
    middle = H * np.tan(np.radians(30.0))  # here the pinhole stands above the origin; the hole moves with it
    hole = HOLE.model_copy(update={"center_um": (H - middle, 0.0)})
    here, settings = np.full(8, middle), TraceSettings(rays=64, branches=1, seed=3)
    body = FlatSample(size_um=4e5).build()
    both = make_experiment(body, instrument(**tilted).model_copy(update={"detector": (hole,)}), settings)
    assert both.effusive is not None and both.effusive.sampling.seed != both.sampling.seed
    found = trace_pixels(both.effusive, here, 0.0 * here)
    mean, std = found.total_mean.mean(), np.sqrt(found.total_variance.sum()) / here.size
    assert_mean(mean, exact, max(std, 1e-3 * exact), f"effusive beam of cos^{exponent:g}")
    assert std < 0.01 * exact and found.n_unaccounted == 0 and found.mean[1:].sum() == 0.0
    alone = both.instrument.model_copy(update={"beam": both.instrument.beam.model_copy(update={"effusive": None})})
    one, other = (trace_pixels(e, here, 0.0 * here) for e in (both, make_experiment(body, alone, settings)))
    assert np.array_equal(one.total_mean, other.total_mean) and not np.array_equal(one.total_mean, found.total_mean)


def scene_file(folder, beam: str, plate: str = "") -> str:
    """Write a small scene and return its path."""
    text = f"""
[beam]
pinhole_radius_um = 0.0
{beam}
[plate]
working_distance_um = 1000.0
{plate}
[[detector]]
name = "hole"
center_um = [500.0, 0.0]
axes_um = [400.0, 400.0]
[sample]
kind = "flat"
size_um = 9000.0
[scan]
nx = 3
ny = 2
pixel_size_um = 50.0
atoms_per_pixel = 1000.0
[trace]
rays = 64
"""
    path = folder / "scene.toml"
    path.write_text(text)
    return str(path)


def stack_of(scene) -> MicrographStack:
    """Trace a scene of one view."""
    stack = trace_scene(scene, scene.trace)
    assert isinstance(stack, MicrographStack)
    return stack


@pytest.mark.parametrize("estimator", ["expected", "analog"])
def test_effuse_is_counted_apart(tmp_path, estimator):
    """`counts` and the book-keeping of the beam stay to the bit, `effuse` is added, in numbers of its own.

    Catches effusive atoms among the beam's, an atom number of the wrong beam, and rays that are unaccounted for.
    """
    over = {"trace.estimator": estimator, "trace.maps": False}
    plate = 'kind = "scattering"\nradius_um = 4000.0'
    beam = "effusive = {atoms_per_pixel = 50000.0, rays = 3000}"
    with_effusive = load_scene(scene_file(tmp_path, beam, plate), over)
    without = load_scene(scene_file(tmp_path, "", plate), over)
    a, b = stack_of(with_effusive), stack_of(without)
    assert a.plate is not None and b.plate is not None and a.effuse is not None and b.effuse is None
    assert np.array_equal(a.counts, b.counts) and np.array_equal(a.plate, b.plate)
    assert a.provenance["rays"] == b.provenance["rays"]
    rays = a.provenance["effusive_rays"]
    assert rays["launched"] == 6 * 3000 * (8 if estimator == "expected" else 1)
    assert rays["launched"] == sum(rays[k] for k in ("detected", "escaped", "stopped", "lost"))
    if estimator == "analog":
        assert a.effuse.sum() == rays["detected"] > 0
    else:
        share = rays["detected"] / rays["launched"]
        assert a.effuse.mean() == pytest.approx(50_000 * share, rel=0.1)
        assert a.effuse.mean() > 5 * a.effuse.std()  # an even light: no pixel differs much


def test_rays_from_a_file(tmp_path):
    """One ray along the axis is the pencil; weights 1 : 3 mix two rays; directions are in lab axes.

    Catches rays about the beam's axis, weights that are not heeded, and a position relative to something else.
    """
    down, u = [0.0, 0.0, -1.0], instrument(incidence_deg=30.0).beam_direction
    aside = [300.0, 100.0, 0.0]
    body, x, y = FlatSample(size_um=9000.0).build(), np.array([0.0, 70.0]), np.array([0.0, -30.0])
    settings = TraceSettings(rays=64, branches=1)

    def traced(beam, rows=None):
        name = tmp_path / f"{len(list(tmp_path.iterdir()))}.npy"
        rays = None if rows is None else (np.save(name, rows), read_rays(name))[1]
        device = instrument(incidence_deg=30.0, source=beam, file="x.npy" if rows is not None else None)
        return trace_pixels(make_experiment(body, device, settings, rays=rays), x, y).mean[0, 0]

    np.testing.assert_allclose(traced("rays", [[0.0, 0.0, 0.0, *(3.0 * u)]]), traced("pencil"), rtol=1e-9)
    spot = [300.0 - H * np.tan(np.radians(30.0)), 100.0, 0.0]  # straight below, in the lab frame
    exact = form_factors(instrument(), np.array([spot]))[0, 0, 2]
    np.testing.assert_allclose(traced("rays", [[*aside, *down]]), exact, rtol=1e-6)
    both = traced("rays", [[0.0, 0.0, 0.0, *u, 1.0], [*aside, *down, 3.0]])
    np.testing.assert_allclose(both, 0.25 * traced("pencil") + 0.75 * exact, rtol=1e-6)
    with pytest.raises(SceneError, match="trace from the scene file"):
        make_experiment(body, instrument(source="rays", file="gone.csv"), settings)


def test_scene_with_rays(tmp_path):
    """A scene reads its rays beside itself, from .csv and .npz alike. Catches a file looked for elsewhere."""
    (tmp_path / "rays.csv").write_text("# x, y, z, dx, dy, dz\n0, 0, 0, 0, 0, -2\n5, 0, 1, 0, 0.01, -1\n")
    rows = read_rays(tmp_path / "rays.csv")
    np.savez(tmp_path / "rays.npz", position=rows[:, :3], direction=rows[:, 3:6])
    assert np.linalg.norm(rows[:, 3:6], axis=1) == pytest.approx(1.0) and rows[:, 6].tolist() == [1.0, 1.0]
    stacks = []
    for name in ("rays.csv", "rays.npz"):
        scene = load_scene(scene_file(tmp_path, f'source = "rays"\nfile = "{name}"'), {"trace.maps": False})
        stacks.append(stack_of(scene))
    np.testing.assert_allclose(stacks[0].counts, stacks[1].counts, rtol=1e-12)
    for beam, told in (('source = "rays"', "needs a file"), ('file = "rays.csv"', "only source = 'rays' reads it")):
        with pytest.raises(SceneError, match=told):
            load_scene(scene_file(tmp_path, beam))


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("none.csv", None, "no such file"),
        ("rays.txt", "1", "must be .csv, .npy or .npz, got '.txt'"),
        ("rays.csv", "x,y,z\n", "put a # before a line of titles"),
        ("rays.csv", "1,2,3\n", "need 6 or 7 columns"),
        ("rays.csv", "0,0,0,0,0,-1\n0,0,0,0,0,1\n", "must fly down to the sample (z of the direction < 0); ray 2 is"),
        ("rays.csv", "0,0,-3,0,0,-1\n", "must start in the plate's plane or above it (z >= 0 um)"),
        ("rays.csv", "0,0,nan,0,0,-1\n", "must be finite numbers"),
        ("rays.csv", "0,0,0,0,0,0\n", "a vector of length 0"),
        ("rays.csv", "0,0,0,0,0,-1,-2\n", "must have a weight >= 0"),
        ("rays.csv", "0,0,0,0,0,-1,0\n", "all 1 weights are 0"),
        ("rays.npy", "junk", "cannot be read, it is corrupt"),
        ("rays.npz", "junk", "is not a readable .npz file"),
    ],
)
def test_bad_rays(tmp_path, name, content, told):
    """Every unusable file is told with its name, the ray and the remedy. Catches tracebacks and silent NaN rays."""
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(InputFileError) as error:
        read_rays(tmp_path / name)
    assert told in str(error.value) and name in str(error.value)


@pytest.mark.parametrize("azimuth", [0.0, 60.0])
def test_footprint_widths(azimuth):
    """Standard deviations of the spot at two heights: pinhole r / 2 and angle s L.

    A Gaussian of s per axis has the standard deviation s L across, a uniform cone of s half of it; along the beam both
    grow as 1 / cos t, but the pinhole's disc, which lies in the plate, does not. To 1 %, by 32768 low-discrepancy rays.
    Catches a spot measured across the beam where the plane is meant, axes exchanged, and a height that is not heeded.
    """
    from helio_jax.figures.spot import measure_spot
    from helio_jax.trace.source import footprint

    cos = np.cos(np.radians(40.0))
    for source, factor in (("gaussian", 1.0), ("uniform", 0.5)):
        about = {"source": source, "source_size_mrad": 2.0, "pinhole_radius_um": 1.0}
        device = instrument(incidence_deg=40.0, azimuth_deg=azimuth, **about)
        for height, points in zip((0.0, 400.0), footprint(device, np.array([0.0, 400.0]), 32768, 1), strict=True):
            length, found = (H - height) / cos, measure_spot(points)
            across = np.hypot(0.5, factor * 2e-3 * length)
            along = np.hypot(0.5, factor * 2e-3 * length / cos)
            assert found["std_across_um"] == pytest.approx(across, rel=0.01)
            assert found["std_along_um"] == pytest.approx(along, rel=0.01)
            assert abs(found["center_along_um"]) < 0.02 and abs(found["center_across_um"]) < 0.02
    round_spot = measure_spot(np.random.default_rng(1).normal(size=(200_000, 2)))
    assert round_spot["diameter_50_um"] == pytest.approx(2.0 * np.sqrt(2.0 * np.log(2.0)), rel=0.01)


def test_draw_spot(tmp_path):
    """The spot of scenes/nano.toml is 0.3 um wide (FWHM across) where its header says; a picture comes, and refusals.

    Catches: a header that does not hold, heights from the plate downwards, no figure.
    """
    from helio_jax.workflows.spot import draw_spot

    scene = load_scene(Path(__file__).parents[2] / "scenes" / "nano.toml")
    low, high = draw_spot(scene, [0.0, 72.0], tmp_path / "spot.png")
    assert high["gaussian_fwhm_across_um"] == pytest.approx(0.3, rel=0.01)
    assert low["gaussian_fwhm_across_um"] > 1.1 * high["gaussian_fwhm_across_um"]
    assert (tmp_path / "spot.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(SceneError, match="472 um above the substrate, got 472 um"):
        draw_spot(scene, [472.0], None)
