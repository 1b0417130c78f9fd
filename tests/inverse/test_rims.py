"""Rims of domes: rises in closed form, none elsewhere, and a traced low dome whose height the trapezoid rule misses."""

import itertools
import math
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.ndimage import label

import helio_jax as hx
from helio_jax.forward.surface import Surface, along
from helio_jax.inverse.rims import OFFSETS, find_rims, rises
from helio_jax.micrograph import MicrographStack
from helio_jax.workflows.pipeline import record
from helio_jax.workflows.scene_file import SceneFile
from helio_jax.workflows.truth import true_height

NOISE = 0.02
SCENE = """
name = "low dome"
beam = { incidence_deg = 0.0, source_size_mrad = 0.1, pinhole_radius_um = 0.5 }
plate = { working_distance_um = 4000.0, sample_distance_um = 4034.0 }
detector = [
    { name = "d0", polar_deg = 38.0, azimuth_deg = 45.0, half_angle_deg = 8.0 },
    { name = "d1", polar_deg = 38.0, azimuth_deg = 135.0, half_angle_deg = 8.0 },
    { name = "d2", polar_deg = 38.0, azimuth_deg = 225.0, half_angle_deg = 8.0 },
    { name = "d3", polar_deg = 38.0, azimuth_deg = 315.0, half_angle_deg = 8.0 },
]
scan = { nx = 65, ny = 65, pixel_size_um = 9.7, pitch = "sample", atoms_per_pixel = 117000 }
trace = { rays = 32, seed = 1, maps = false }
noise = { seed = 1 }
sample = { kind = "height_map", file = "dome.npz", unit = "um", size_um = 16000.0, level_um = 0.0 }
reconstruct = { border = "flat" }
"""
X, Y = np.meshgrid(np.arange(61) - 30.3, np.arange(61) - 29.6)


def dome(foot: float, rise: float) -> Surface:
    """Make a half ellipsoid of a foot radius and a rise in pixels."""
    u = np.hypot(X, Y) / foot
    within = np.sqrt(np.maximum(1.0 - u**2, 0.0))
    slope = np.where(u < 1.0, -rise / foot**2 / np.maximum(within, 1e-9), 0.0)
    return Surface(rise * within, slope * X, slope * Y)


def cone(foot: float, rise: float) -> Surface:
    r = np.hypot(X, Y)
    slope = np.where(r < foot, -rise / foot / r, 0.0)
    return Surface(rise * np.maximum(1.0 - r / foot, 0.0), slope * X, slope * Y)


def noisy(surface: Surface, seed: int, noise: float = NOISE) -> Surface:
    steep = 1.0 + surface.slope_x**2 + surface.slope_y**2
    x, y = noise * steep * np.random.default_rng(seed).standard_normal((2, *steep.shape))
    return Surface(surface.height, surface.slope_x + x, surface.slope_y + y)


def ellipsoid(
    foot: tuple[float, float],
    rise: float,
    *,
    share: float = 0.5,
    at: tuple[float, float] = (0.0, 0.0),
    dx: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> Surface:
    """Make the cap of an ellipsoid as an oblique beam sees it, by the root of its quadratic equation.

    Args:
        foot: half-axes of its foot.
        rise: height of its top.
        share: `rise` over the ellipsoid's vertical half-axis, up to 1.
        at: middle of the foot.
        dx: pitch along x; that along y is 1.
        shift: of the beam per unit of height.
    """
    vertical = rise / share
    depth = vertical - rise
    wide, deep = (f / np.sqrt(1.0 - (depth / vertical) ** 2) for f in foot)
    u, v = (dx * X - at[0]) / wide, (Y - at[1]) / deep
    by_u, by_v = shift[0] / wide, shift[1] / deep
    a = by_u**2 + by_v**2 + vertical**-2
    b = -2.0 * (u * by_u + v * by_v) + 2.0 * depth / vertical**2
    c = u**2 + v**2 + (depth / vertical) ** 2 - 1.0
    root = np.sqrt(np.maximum(b**2 - 4.0 * a * c, 0.0))
    height = np.where(root > 0.0, (root - b) / (2.0 * a), 0.0)
    within = height > 0.0
    u, v = u - height * by_u, v - height * by_v
    down = np.where(within, 2.0 * (height + depth) / vertical**2 - 2.0 * (u * by_u + v * by_v), 1.0)
    return Surface(*(np.where(within, f, 0.0) for f in (height, -2.0 * u / wide / down, -2.0 * v / deep / down)))


def rises_over_rims(
    surface: Surface, seed: int, noise: float, dx: float = 1.0, shift=(0.0, 0.0), only: tuple[int, int] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the errors of the rise over each side of all rims, the same by the trapezoid rule, and what is stated.

    Rises are sums over the edges of a path from the level surface into the dome, weighted by their variances; what is
    common to a side adds up. `only`: axis and sign of the height's change along it of the sides that are looked at.
    """
    seen, found = noisy(surface, seed, noise), []
    for rims, axis, pitch in zip(find_rims(seen, noise, shift), (1, 0), (dx, 1.0), strict=True):
        slope = seen.slope_x if axis == 1 else seen.slope_y
        change = np.diff(surface.height, axis=axis) / pitch
        excess = change - 0.5 * sum(along(slope, axis))
        paths, n_paths = label(rims.is_rim, [[0, 0, 0], [1, 1, 1], [0, 0, 0]] if axis == 1 else [[0, 1, 0]] * 3)
        sides: dict[tuple, list] = {}
        for number in range(1, n_paths + 1):
            on = paths == number
            up = np.sign(change[on].sum())
            terms = (
                up * excess[on].sum(),
                up * rims.gap[on].sum(),
                np.sum(rims.sigma[on] ** 2),
                up * rims.common[on].sum(),
            )
            sides.setdefault((up, rims.outline[on].max()), []).append(terms)
        for (up, _), terms in sides.items():
            if only not in (None, (axis, up)):
                continue
            by_trapezoid, gap, variance, common = np.array(terms).T
            weight = 1.0 / variance / np.sum(1.0 / variance)
            stated = np.hypot(weight @ common, np.sqrt(weight**2 @ variance))
            found.append((weight @ (by_trapezoid - gap), weight @ by_trapezoid, stated))
    error, by_trapezoid, stated = np.reshape(found, (-1, 3)).T
    return error, by_trapezoid, stated


def level_pulls(*args, **kwargs) -> np.ndarray:
    """Compute by how many standard deviations the rise over each side is off; arguments as above."""
    error, _, stated = rises_over_rims(*args, **kwargs)
    return error / stated


OBLIQUE = np.tan(np.radians(30.0))
DOMES = {
    "low": {"foot": (12.0, 12.0), "rise": 4.0, "share": 0.2},
    "steep": {"foot": (9.0, 9.0), "rise": 8.0, "share": 0.88},
    "oblique": {"foot": (12.0, 12.0), "rise": 6.0, "share": 0.4, "shift": (OBLIQUE, 0.0)},
    "half ball, oblique": {"foot": (12.0, 12.0), "rise": 12.0, "share": 1.0, "shift": (OBLIQUE, 0.0)},
    "hidden foot": {"foot": (12.0, 12.0), "rise": 8.4, "share": 0.66, "shift": (OBLIQUE, 0.0)},
    "oblong pixels": {"foot": (24.0, 24.0), "rise": 16.8, "share": 0.66, "dx": 2.0},
    "elongated": {"foot": (16.0, 6.0), "rise": 4.0, "share": 0.5},
    "cut by the border": {"foot": (14.0, 14.0), "rise": 9.0, "share": 0.6, "at": (-32.0, 0.0)},
}
"""Noise of 0.005 to 0.02 are signals of 200 to 50 times the noise. With one r for all sides, the product of r and L the
same along x and y, coarse values of r, or crests put at the border, pulls are 2.5 to 150; with one r for the sides of
the half ball across the beam, of which the half behind hides its foot, 3 and more."""


@pytest.mark.parametrize("noise", (0.005, 0.02))
@pytest.mark.parametrize("name", DOMES)
def test_domes_rise_as_stated(name: str, noise: float):
    """Caps of ellipsoids: rms of the pulls of all sides and seeds below 1.8; about ten of them are independent."""
    about = DOMES[name]
    how = {key: about[key] for key in ("dx", "shift") if key in about}
    at = np.array(about.get("at", (0.0, 0.0)))
    places = np.random.default_rng(5).uniform(-0.5, 0.5, (4, 2))
    pulls = [
        level_pulls(ellipsoid(**(about | {"at": tuple(at + p)})), seed, noise, **how) for seed, p in enumerate(places)
    ]
    pulls = np.concatenate(pulls)
    assert len(pulls) >= 6
    assert np.sqrt(np.mean(pulls**2)) < 1.8, pulls


@pytest.mark.parametrize("noise", (0.005, 0.02))
def test_neighbouring_domes_have_rims_of_their_own(noise: float):
    """A steep and a low cap, a pixel apart: as one outline they are off by up to 30 standard deviations."""
    steep = ellipsoid((8.0, 8.0), 7.2, share=0.895, at=(-9.2, -0.2))
    low = ellipsoid((10.0, 10.0), 4.0, share=0.276, at=(9.8, -0.2))
    both = jax.tree.map(np.add, steep, low)
    pulls = []
    for seed in range(4):
        for rims in find_rims(noisy(both, seed, noise), noise):
            assert len(np.unique(rims.outline[rims.is_rim])) == 2
        pulls.append(level_pulls(both, seed, noise))
    pulls = np.concatenate(pulls)
    assert len(pulls) >= 24
    assert np.sqrt(np.mean(pulls**2)) < 1.8, pulls


def test_rises_in_closed_form():
    """Sections of half balls rise by their height at d and 1 + d; a constant slope s rises by s / 2 +- s / sqrt(12).

    The crests differ from section to section; without what they have in common, r L, no r fits all of them.
    """
    d, crest = np.array([0.1, 0.4, 0.9, 0.6]), np.array([12.0, 9.0, 5.0, 3.0])
    at = d[:, None] + np.arange(4)
    std = np.full((4, 4), 1e-3)
    for number, cut in ((0, 0.0), (20, OFFSETS[20] * 9.0)):  # r L
        length = crest + d

        def height(t, length=length, cut=cut):
            return np.sqrt(2.0 * length * t - t**2 + 2.0 * cut)

        slope = (length[:, None] - at) / height(at, length[:, None])
        found = rises(slope, std, crest, np.full(4, 9.0))
        assert np.argmax(found.evidence.sum(1)) == number
        np.testing.assert_allclose(found.rise[number], height(d) - height(0.0 * d), rtol=0.06)
        np.testing.assert_allclose(found.next_rise[number], height(1.0 + d) - height(d), rtol=0.03)
    even = rises(np.full((1, 4), 0.5), std[:1], np.full(1, 12.0), np.full(1, 12.0))
    assert np.argmax(even.evidence[:, 0]) == len(OFFSETS) - 1
    np.testing.assert_allclose(even.rise[-1], 0.25, rtol=1e-2)
    np.testing.assert_allclose(np.sqrt(even.variance[-1]), 0.5 / np.sqrt(12.0), rtol=1e-2)


@pytest.mark.parametrize("kind", ("half ellipsoids", "caps"))
def test_heights_of_domes_have_honest_error_bars(kind: str):
    """Mean rise over all sides of 40 domes, by random beams and noise: rms error below 1.2 of what is stated as common.

    Stated are 3 to 7 % of the height. With vertical tangents five times as likely as others near them, instead of
    twenty times, half ellipsoids are 10 % of their height too low, at 1.5 standard deviations.
    """
    pulls = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        foot, share = rng.uniform(8.0, 18.0), 1.0 if kind == "half ellipsoids" else rng.uniform(0.1, 0.9)
        tangent, turn = np.tan(np.radians(rng.choice([0.0, 25.0]))), rng.uniform(0.0, 2.0 * np.pi)
        shift = float(tangent * np.cos(turn)), float(tangent * np.sin(turn))
        shape = {"foot": (foot, foot * rng.uniform(0.8, 1.25)), "rise": foot * share * rng.uniform(0.1, 1.0)}
        seen = ellipsoid(**shape, share=share, at=tuple(rng.uniform(-2.0, 2.0, 2)), shift=shift)
        error, _, stated = rises_over_rims(seen, seed, float(rng.choice([0.005, 0.02])), shift=shift)
        if error.size:
            pulls.append(error.mean() / stated.mean())
    assert len(pulls) > 25
    assert np.sqrt(np.mean(np.square(pulls))) < 1.2, pulls


@pytest.mark.parametrize("incidence", (25.0, 45.0))
def test_a_low_foot_behind_the_limb_is_part_of_the_rise(incidence: float):
    """Sides of low half ellipsoids that fall along the beam: two thirds are off by less than 1.5 standard deviations.

    A foot of 0.05 to 0.2 pixels is hidden. Rejects a rise from the limb only, which is too low by 2 to 3 of them.
    """
    shear, pulls = np.tan(np.radians(incidence)), []
    for foot, seed in itertools.product((0.05, 0.1, 0.2), range(4)):
        at = np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
        low = ellipsoid((14.0, 14.0), np.sqrt(foot * 14.0 / shear), share=1.0, at=tuple(at), shift=(shear, 0.0))
        pulls.extend(level_pulls(low, seed, 0.01, shift=(shear, 0.0), only=(1, -1)))
    assert len(pulls) == 12 and np.quantile(np.abs(pulls), 0.68) < 1.5


def test_the_sides_of_a_dome_err_together():
    """They have one number, whose error is common. Catches sides that err independently: half of a dome's error."""
    for about in (DOMES["low"], DOMES["oblique"]):
        found = find_rims(noisy(ellipsoid(**about), 1, 0.005), 0.005, about.get("shift", (0.0, 0.0)))
        assert all(set(np.unique(rims.outline)) == {0, 1} for rims in found)


@pytest.mark.parametrize("sign", (1.0, -1.0))
def test_rim_of_a_dome_rises_by_more_than_the_trapezoid_rule(sign):
    """Half ellipsoids and bowls: off by less than by that rule, of 9 % of their height, and as stated."""
    error, by_trapezoid, stated = rises_over_rims(dome(18.4, 5.0 * sign), 1, 0.25 * NOISE)
    assert len(error) == 4
    assert np.all(by_trapezoid > 0.3)
    assert np.mean(error) < 0.9 * np.mean(by_trapezoid), (error, by_trapezoid)
    assert np.all(np.abs(error) < 1.8 * stated), (error, stated)


@pytest.mark.parametrize("fill", (0.0, 7.0, -7.0))
@pytest.mark.parametrize("border", (-3.0, 5.0))
def test_pixels_that_no_image_shows_tell_nothing(border, fill):
    """Whatever stands in pixels that are not observed, before the crest of a dome or beyond it."""
    surface = noisy(dome(18.4, 5.0), 1)
    noise = np.full(X.shape, NOISE)
    noise[:, X[0] > border] = np.inf
    slopes = (np.where(np.isinf(noise), fill, s) for s in (surface.slope_x, surface.slope_y))
    known, other = find_rims(surface, noise), find_rims(Surface(surface.height, *slopes), noise)
    assert known[1].is_rim.any()
    for rims, others in zip(known, other, strict=True):
        np.testing.assert_array_equal(rims.outline, others.outline)
        np.testing.assert_array_equal(rims.sigma, others.sigma)


@pytest.mark.parametrize("shape", [(n, m) for n in (1, 2, 3, 4) for m in (1, 2, 3, 4, 20)])
def test_small_rasters_have_no_rims(shape):
    """Rasters thinned to a few rows or columns, too."""
    surface = Surface(*np.random.default_rng(1).standard_normal((3, *shape)))
    for rims in find_rims(surface, NOISE, (OBLIQUE, 0.0)):
        assert not rims.is_rim.any()


def test_rims_do_not_depend_on_the_azimuth_of_the_beam():
    """The same dome under beams at 0, 90 and 180 deg, and a beam so steep that nothing is hidden."""
    tangent = math.tan(math.radians(30.0))
    rounding = 1e-17
    seen = noisy(ellipsoid((9.0, 9.0), 8.0, share=0.9, shift=(tangent, 0.0)), 1)
    at_0 = find_rims(seen, NOISE, (tangent, rounding))
    transposed = Surface(*(np.ascontiguousarray(f.T) for f in (seen.height, seen.slope_y, seen.slope_x)))
    at_90 = find_rims(transposed, NOISE, (rounding, tangent))
    mirrored = Surface(*(f[:, ::-1] for f in (seen.height, -seen.slope_x, seen.slope_y)))
    at_180 = find_rims(mirrored, NOISE, (-tangent, -rounding))
    assert at_0[0].is_rim.sum() > 20 and at_0[1].is_rim.sum() > 50
    for axis in (0, 1):
        np.testing.assert_allclose(at_90[1 - axis].sigma.T, at_0[axis].sigma, rtol=1e-9)
        np.testing.assert_allclose(at_180[axis].sigma[:, ::-1], at_0[axis].sigma, rtol=1e-9)
    steep = noisy(ellipsoid((9.0, 9.0), 8.0, share=0.9), 1)
    for rims, others in zip(find_rims(steep, NOISE), find_rims(steep, NOISE, (0.002, 0.0)), strict=True):
        np.testing.assert_array_equal(rims.sigma, others.sigma)


@pytest.mark.parametrize("seed", range(8))
def test_no_rims_where_slopes_are_even(seed):
    """Cones and hills have none. False alarms: of 8 noise seeds none (the limit is a Bayes factor of exp(0.75))."""
    hill = 4.0 * np.exp(-0.5 * (X**2 + Y**2) / 8.0**2)
    hills = Surface(hill, -hill * X / 64.0, -hill * Y / 64.0)
    for surface in (cone(18.4, 8.0), hills):
        assert not any((rims.outline > 0).any() for rims in find_rims(noisy(surface, seed), NOISE))


def traced_dome(rise: float, folder: Path) -> tuple[SceneFile, MicrographStack]:
    """Trace a half ellipsoid."""
    foot = 170.0
    at = np.linspace(-350.0, 350.0, 351)
    u = np.hypot(*np.meshgrid(at, at)) / foot
    np.savez(folder / "dome.npz", x=at, y=at, height=rise * np.sqrt(np.maximum(1.0 - u**2, 0.0)))
    (folder / "scene.toml").write_text(SCENE)
    scene = hx.load_scene(folder / "scene.toml")
    stack = record(scene, hx.simulate(scene))
    assert isinstance(stack, MicrographStack)
    return scene, stack


def error_of_the_top(rec: hx.Reconstruction, scene: SceneFile, rise: float) -> tuple[float, float]:
    """Compute the error of the mean height of the top, and its stated standard deviation [um]."""
    truth = true_height(scene, rec).height
    top = truth > 0.9 * rise
    height, std = rec.spread(lambda z: float(np.mean(z[top])))
    return height - truth[top].mean(), std


@pytest.mark.slow
@pytest.mark.parametrize(("rise", "limit"), ((34.0, 0.05), (140.0, 0.06)))
def test_height_of_a_traced_dome(rise: float, limit: float, tmp_path: Path):
    """Half ellipsoids, low and steep: within 2.5 stated standard deviations and a share of their height.

    With the trapezoid rule alone the low one came out 5.5 % too low, stated 1.0 %.
    """
    scene, stack = traced_dome(rise, tmp_path)
    error, std = error_of_the_top(hx.reconstruct(stack, settings=scene.reconstruct), scene, rise)
    assert abs(error) < min(2.5 * std, limit * rise), (error, std)
    assert std < 0.1 * rise


@pytest.mark.slow
def test_height_of_a_dome_in_two_images(tmp_path: Path):
    """Where two of four images show its inside; by the trapezoid rule alone 5.3 standard deviations too low."""
    scene, stack = traced_dome(34.0, tmp_path)
    is_seen = np.ones(stack.shape, bool)
    is_seen[2:, 8:-8, 8:-8] = False
    hidden = {name: np.where(is_seen, getattr(stack, name), np.nan) for name in ("counts", "variance")}
    rec = hx.reconstruct(stack.replace(is_observed=is_seen, **hidden), settings=scene.reconstruct)
    error, std = error_of_the_top(rec, scene, 34.0)
    assert abs(error) < 2.5 * std, (error, std)
