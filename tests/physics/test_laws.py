"""Scattering laws: every sampler against the integral of its density, energy, closed forms, and both estimators."""

import numpy as np
import pytest
from stats import assert_likely, assert_mean, pooled_chi2

from helio_jax.kernel import kernel
from helio_jax.scene.body import Body
from helio_jax.scene.scattering import (
    BackscatteringLaw,
    BroadSpecularLaw,
    CosineLaw,
    CosinePowerLaw,
    CosineSpecularLaw,
    DebyeWaller,
    DiffractionLaw,
    MixtureLaw,
    MixturePart,
    RoughDiffuseLaw,
    SpecularLaw,
    TableLaw,
    UniformLaw,
)
from helio_jax.scene.shapes import FlatSample, Sphere, SpheresSample, TrenchSample
from helio_jax.trace.laws import lobe_density, scatter_atoms
from helio_jax.trace.lawtable import make_law_table, open_share
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings
from helio_jax.trace.tally import STOPPED

COLD = DebyeWaller(energy_mev=63.0, mass_u=28.0, temperature_k=100.0, debye_k=450.0)
SQUARE = {"wavelength_nm": 0.2, "lattice_nm": ((1.0, 0.0), (0.0, 1.0))}
N_DRAWN = 100_000
UP = np.array([0.0, 0.0, 1.0])
LAWS = {
    "cosine": CosineLaw(),
    "uniform": UniformLaw(half_angle_deg=60.0),
    "broad_specular": BroadSpecularLaw(sigma_deg=25.0, diffuse_fraction=0.2),
    "backscattering": BackscatteringLaw(sigma_deg=40.0, albedo=0.8),
    "cosine_specular": CosineSpecularLaw(),
    "rough_diffuse": RoughDiffuseLaw(roughness=0.6),
    "power": CosinePowerLaw(exponent=0.7),
    "diffraction": DiffractionLaw(**SQUARE, max_order=(3, 3), peak_sigma=0.08, diffuse_fraction=0.1),
    "attenuated": BroadSpecularLaw(sigma_deg=30.0, debye_waller=COLD),
    "mixture": MixtureLaw(
        parts=(
            MixturePart(weight=3.0, law=RoughDiffuseLaw(roughness=1.0)),
            MixturePart(weight=1.0, law=BroadSpecularLaw(sigma_deg=15.0)),
        )
    ),
}


def incoming(tilt_deg: float, azimuth_deg: float = 0.0) -> np.ndarray:
    """Direction of an atom that falls onto a horizontal face."""
    t, a = np.radians([tilt_deg, azimuth_deg])
    return np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), -np.cos(t)])


def turn(normal: np.ndarray) -> np.ndarray:
    """Matrix that turns z into `normal` [3, 3]."""
    first = np.cross(normal, [0.3, -0.5, 0.8])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first), normal], 1)


def draw(law, direction, normal=UP, n=N_DRAWN, seed=3):
    """Draw n atoms; return directions, densities and whether they leave."""
    rng = np.random.default_rng(seed)
    copies = (np.tile(np.asarray(v, float), (n, 1)) for v in (direction, normal))
    none = np.zeros(n, np.int64)
    return scatter_atoms(make_law_table([law.terms()]), none, *copies, rng.random((n, 2)), none, np.arange(n), 0, seed)


def density(law, direction, out, normal=UP):
    """Density of the lobes for directions out [..., 3]."""
    d, n = (np.asarray(v, float) for v in (direction, normal))
    flat = np.ascontiguousarray(out.reshape(-1, 3))
    return lobe_densities(make_law_table([law.terms()]), d, n, flat).reshape(out.shape[:-1])


@kernel
def lobe_densities(table, d, n, out):
    """`lobe_density` of the first material for directions out [n, 3]."""
    found = np.empty(out.shape[0])
    for i in range(found.size):
        found[i] = lobe_density(table, 0, d, n, out[i])
    return found


def hemisphere(n_cosines: int, n_turns: int) -> np.ndarray:
    """Midpoints of cells of equal solid angle above a horizontal face [n_cosines, n_turns, 3]."""
    z = (np.arange(n_cosines) + 0.5) / n_cosines
    turns = 2 * np.pi * (np.arange(n_turns) + 0.5) / n_turns
    r = np.sqrt(1 - z**2)[:, None]
    return np.stack([r * np.cos(turns), r * np.sin(turns), np.broadcast_to(z[:, None], (n_cosines, n_turns))], -1)


def cell_shares(law, direction, matrix, cells=(20, 24), fine=10) -> np.ndarray:
    """Share of the atoms that leaves into each cell of the hemisphere, by integrating the density."""
    out = hemisphere(cells[0] * fine, cells[1] * fine)
    lobes = density(law, direction, out @ matrix.T, matrix[:, 2])
    lobes = lobes.reshape(cells[0], fine, cells[1], fine).mean((1, 3)) * 2 * np.pi / (cells[0] * cells[1])
    edges = np.linspace(0.0, 1.0, cells[0] + 1) ** 2
    cosine = np.repeat(np.diff(edges)[:, None] / cells[1], cells[1], 1)
    rest = sum(term.share for term in law.terms()) - lobes.sum()
    return lobes + rest * cosine


def count_cells(out, matrix, cells=(20, 24)) -> np.ndarray:
    """Histogram of directions [n, 3] in the same cells."""
    local = out @ matrix
    row = np.minimum((local[:, 2] * cells[0]).astype(int), cells[0] - 1)
    turn_ = np.arctan2(local[:, 1], local[:, 0]) % (2 * np.pi)
    column = np.minimum((turn_ / (2 * np.pi) * cells[1]).astype(int), cells[1] - 1)
    return np.bincount(row * cells[1] + column, minlength=cells[0] * cells[1])


@pytest.mark.parametrize("tilt", [0.0, 40.0, 75.0])
@pytest.mark.parametrize("name", LAWS)
def test_sampler_against_density(name, tilt):
    """Chi-square of 100 000 draws against the integral of eval, on a tilted face too; rejects 8 % more on one side.

    Catches: a norm that forgets the horizon, a frame that is not about the normal, a wrong acceptance probability.
    """
    law = LAWS[name]
    for normal in (UP, np.array([0.36, -0.48, 0.8])):
        matrix = turn(normal)
        direction = matrix @ incoming(tilt, 20.0)
        out, _, leaves = draw(law, direction, normal)
        expected = N_DRAWN * cell_shares(law, direction, matrix).ravel()
        observed = count_cells(out[leaves], matrix)
        assert np.all(out[leaves] @ normal > 0)
        assert_likely(pooled_chi2(observed, expected, 0 * expected), f"{name} at {tilt} deg")
    wrong = expected * np.where(np.arange(expected.size) % 24 < 12, 1.08, 0.92)
    assert pooled_chi2(observed, wrong, 0 * expected) < 1e-9


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0, 85.0])
def test_energy(tilt):
    """Densities of lobes integrate to their share, for every incidence; catches a wrong norm (to 1e-3, 1e-4 mostly).

    For the rough-diffuse law this checks the closed directional albedo of the paper: any error in it shows.
    """
    out = hemisphere(800, 300)
    for name in ("uniform", "broad_specular", "backscattering", "cosine_specular", "rough_diffuse", "mixture"):
        law = LAWS[name]
        share = sum(term.share for term in law.terms() if term.shape != 0)
        total = density(law, incoming(tilt), out).mean() * 2 * np.pi
        assert total == pytest.approx(share, rel=1e-3 if tilt > 80 else 2e-4), name
    total = density(LAWS["diffraction"], incoming(tilt), out).mean() * 2 * np.pi
    assert total == pytest.approx(0.9, rel=2e-3)  # midpoints across the horizon, where the density has a root


def test_rough_diffuse_is_reciprocal_and_ends_in_the_cosine_law():
    """brdf(i, o) = brdf(o, i); r = 0 is cos / pi; r = 1 sends more back than forward, and by hand along the normal:

    A = 1 / (3/2 - 2 / (3 pi)), mean albedo <E> = A (5/3 - 28 / (15 pi)), pi brdf = A + (1 - A)^2 / (1 - <E>).
    Catches swapped angles, a wrong constant of the paper.
    """
    a_full = 1.0 / (1.5 - 2.0 / (3.0 * np.pi))
    by_hand = a_full + (1.0 - a_full) ** 2 / (1.0 - a_full * (5.0 / 3.0 - 28.0 / (15.0 * np.pi)))
    assert density(RoughDiffuseLaw(roughness=1.0), -UP, UP[None])[0] == pytest.approx(by_hand / np.pi, rel=1e-12)
    law, a, b = RoughDiffuseLaw(roughness=0.7), incoming(50.0), -incoming(20.0, 100.0)
    there, back = density(law, a, b[None])[0] / b[2], density(law, -b, -a[None])[0] / -a[2]
    assert there == pytest.approx(back, rel=1e-12)
    out = hemisphere(20, 20)
    np.testing.assert_allclose(density(RoughDiffuseLaw(roughness=0.0), a, out), out[..., 2] / np.pi, rtol=1e-9)
    rough, steep = RoughDiffuseLaw(roughness=1.0), incoming(60.0)
    assert density(rough, steep, -steep[None])[0] > 1.5 * density(rough, steep, steep[None] * [1, 1, -1])[0]


def test_closed_forms():
    """Uniform cone <cos> = (1 + cos a)/2; at normal incidence a cosine lobe is the cosine law; a lobe is Gaussian."""
    out, _, _ = draw(UniformLaw(half_angle_deg=60.0), incoming(40.0))
    assert_mean(out[:, 2].mean(), 0.75, out[:, 2].std() / np.sqrt(len(out)), "uniform cone")
    down, grid = incoming(0.0), hemisphere(20, 20)
    np.testing.assert_allclose(density(CosineSpecularLaw(), down, grid), grid[..., 2] / np.pi, rtol=1e-9)
    wide = density(BroadSpecularLaw(sigma_deg=180.0), down, grid) / (grid[..., 2] / np.pi)
    angle = np.arccos(grid[..., 2])
    np.testing.assert_allclose(wide / wide[-1, 0], np.exp(-0.5 * (angle**2 - angle[-1, 0] ** 2) / np.pi**2), rtol=1e-9)


def test_mirror_and_attenuation():
    """A mirror keeps exp(-B (2 cos t)^2) of its atoms in the exact direction: 2W = 3 hbar^2 dk^2 T / (M k_B Theta^2).

    B is computed here from the constants of nature. Catches a missing factor 2, energies in K, a wrong mass.
    """
    law = SpecularLaw(debye_waller=COLD)
    n = N_DRAWN
    out, found, _ = draw(law, incoming(40.0))
    is_exact = np.isinf(found)
    np.testing.assert_allclose(
        out[is_exact], np.tile([np.sin(np.radians(40)), 0, np.cos(np.radians(40))], (is_exact.sum(), 1)), atol=1e-12
    )
    hbar, k_b, u, mev = 1.054571817e-34, 1.380649e-23, 1.66053907e-27, 1.602176634e-22
    k_squared = 2 * 4.0 * u * COLD.energy_mev * mev / hbar**2
    two_w = 3 * hbar**2 * k_squared * COLD.temperature_k / (COLD.mass_u * u * k_b * COLD.debye_k**2)
    kept = np.exp(-two_w * (2 * np.cos(np.radians(40.0))) ** 2)
    assert 0.05 < kept < 0.95
    assert_mean(is_exact.mean(), kept, np.sqrt(kept * (1 - kept) / n), "Debye-Waller factor")


def test_diffraction_peaks_by_hand():
    """Hexagonal lattice of 0.3 nm, 0.1 nm atoms at 25 deg: order (n, m) leaves at k + lambda (n b1 + m b2).

    b1 = (1, -1/sqrt 3)/a, b2 = (0, 2/sqrt 3)/a by hand. Catches real instead of reciprocal vectors, a factor 2 pi.
    """
    a, k = 0.3, np.sin(np.radians(25.0))
    lattice = ((a, 0.0), (0.5 * a, 0.5 * np.sqrt(3.0) * a))
    peaks = ((0, 0, 1.0), (1, 0, 2.0), (0, 1, 3.0), (-1, 0, 4.0), (9, 9, 50.0))
    law = DiffractionLaw(wavelength_nm=0.1, lattice_nm=lattice, peaks=peaks)
    out, found, leaves = draw(law, incoming(25.0), n=50_000)
    assert leaves.all() and np.isinf(found).all()
    third, s = 1.0 / 3.0, 1.0 / np.sqrt(3.0)
    expected = np.array([[k, 0.0], [k + third, -third * s], [k, 2 * third * s], [k - third, third * s]])
    distance = np.linalg.norm(out[:, None, :2] - expected, axis=2)
    assert distance.min(1).max() < 1e-12
    share = np.bincount(distance.argmin(1), minlength=4) / len(out)
    for i, exact in enumerate((0.1, 0.2, 0.3, 0.4)):  # order (9, 9) is closed
        assert_mean(share[i], exact, np.sqrt(exact * (1 - exact) / len(out)), f"peak {i}")


def test_no_open_order_is_diffuse():
    """Where every order of a table is closed the atoms leave by the cosine law; catches an endless loop, lost atoms."""
    law = DiffractionLaw(**SQUARE, peaks=((9, 0, 1.0),))
    out, found, leaves = draw(law, incoming(10.0), n=100_000)
    assert leaves.all() and np.all(found == 0)
    assert_mean(out[:, 2].mean(), 2 / 3, np.sqrt(1 / 18 / len(out)), "diffuse")


def test_lattice_of_three_numbers_is_projected():
    """A tilted face whose lattice is given in space scatters as the same face laid flat; catches the wrong frame."""
    normal = np.array([0.6, 0.0, 0.8])
    along, across = np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.0, 0.0])
    tilted = DiffractionLaw(wavelength_nm=0.2, lattice_nm=(tuple(along), tuple(across)), max_order=(2, 1))
    direction = 0.5 * along - np.sqrt(0.75) * normal
    out, _, _ = draw(tilted, direction, normal, n=20_000)
    steps = np.stack([(out @ along - 0.5) / 0.2, out @ across / 0.2], 1)
    assert np.abs(steps - steps.round()).max() < 1e-9
    assert set(map(tuple, steps.round().astype(int))) >= {(n, m) for n in (-2, -1, 0, 1, 2) for m in (-1, 0, 1)}


def test_table(tmp_path):
    """A table sampled against its own interpolation, mirrored and all around, between two incidences.

    Catches: theta and phi swapped, a missing sin(theta), a table that is not mirrored, the wrong incidence's column.
    """
    for last in (180, 330):
        lines = ["# incidence theta phi intensity"]
        for i in (20, 60):
            for t in (0, 20, 50, 80):
                for p in range(0, last + 1, 30):
                    lines.append(f"{i} {t} {p} {1.0 + np.cos(np.radians(p - last / 9)) * t / 80 + i * t / 4000}")
        (tmp_path / "t.txt").write_text("\n".join(lines))
        law = _Bound(TableLaw(file="t.txt", albedo=0.9, diffuse_fraction=0.1), tmp_path)
        direction = incoming(30.0, 50.0)
        assert density(law, direction, hemisphere(800, 300)).mean() * 2 * np.pi == pytest.approx(0.81, rel=1e-3)
        out, _, leaves = draw(law, direction)
        assert_mean(leaves.mean(), 0.9, 0.3 / np.sqrt(len(leaves)), "albedo")
        expected = N_DRAWN * cell_shares(law, direction, np.eye(3)).ravel()
        assert_likely(pooled_chi2(count_cells(out[leaves], np.eye(3)), expected, 0 * expected), f"table to {last}")


def test_share_of_open_peaks():
    """Half of a narrow Gaussian on the disc's rim is inside, less sigma / sqrt(8 pi) for its curvature; centred: exact.

    Catches: a quadrature that misses the rim, where the half-chord grows like a root.
    """
    rim = 0.5 - 0.01 / np.sqrt(8.0 * np.pi)
    assert open_share(np.ones(1), 0.01)[0] == pytest.approx(rim, abs=1e-4 * 0.01)
    for sigma in (0.02, 0.3, 0.5):
        assert open_share(np.zeros(1), sigma)[0] == pytest.approx(-np.expm1(-0.5 / sigma**2), abs=1e-6)


class _Bound:
    """A law whose files are in a folder."""

    def __init__(self, law, folder):
        self.terms = lambda: law.terms(folder)


BODIES = {
    "sphere": (
        SpheresSample(spheres=(Sphere(radius_um=1000.0, cap_height_um=720.0),), size_um=4000.0, material="m"),
        1400.0,
    ),
    "trench": (TrenchSample(width_um=200.0, length_um=1000.0, depth_um=150.0, material="m"), 140.0),
}
TRACED = LAWS | {
    "mirror": SpecularLaw(diffuse_fraction=0.3, debye_waller=COLD),
    "exact diffraction": DiffractionLaw(**SQUARE, diffuse_fraction=0.2, debye_waller=COLD),
}


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("name", [n for n in TRACED if n != "cosine"])
def test_expected_against_analog(bshem, name, body):
    """Both estimators agree per order and detector, masks included; a bias of 15 % of all counts is rejected.

    Catches: lobes counted twice (aimed at and hit) or not at all, a share of the branches, an order off by one.
    """
    sample, reach = BODIES[body]
    axis = np.linspace(-reach, reach, 8)
    x, y = (g.ravel() for g in np.meshgrid(axis, axis))
    laws = {"m": TRACED[name].terms()}
    settings = {"n_orders": 3, "maps": False}
    expected = trace_pixels(make_experiment(sample.build(), bshem, TraceSettings(rays=128, **settings), laws), x, y)
    analog_settings = TraceSettings(rays=2000, estimator="analog", seed=5, **settings)
    analog = trace_pixels(make_experiment(sample.build(), bshem, analog_settings, laws), x, y)
    assert expected.n_unaccounted == analog.n_unaccounted == 0
    mean, variance = (a.sum(-1) for a in expected.probability())
    hits = analog.hits.sum(-1)
    for order in range(3):
        for k in range(3):
            n = 2000 * mean[order, k]
            if n > 30:
                error = np.sqrt(n + 2000**2 * variance[order, k])
                assert_mean(hits[order, k], n, error, f"{name}: order {order + 1}, detector {k}")
    assert 0.15 * hits.sum() > 6 * np.sqrt(hits.sum() + 2000**2 * variance.sum())


def test_albedo_sticks_and_scales(bshem):
    """Albedo 0.5 on a flat halves the expected counts exactly and stops half of the atoms; catches a lost atom."""
    flat, x = FlatSample(material="m").build(), np.zeros(3)
    settings = TraceSettings(rays=4000, maps=False)
    full = trace_pixels(make_experiment(flat, bshem, settings, {"m": CosineLaw().terms()}), x, x)
    half = trace_pixels(make_experiment(flat, bshem, settings, {"m": CosineLaw(albedo=0.5).terms()}), x, x)
    np.testing.assert_allclose(half.total()[0], 0.5 * full.total()[0], rtol=1e-12)
    n = half.n_launched * 3
    assert half.n_unaccounted == 0
    assert_mean(half.fates[STOPPED].sum(), 0.5 * n, 0.5 * np.sqrt(n), "atoms that stick")


def test_laws_do_not_depend_on_workers(bshem):
    """Bitwise equal for 1 and 3 threads; catches random numbers of a lobe that depend on the schedule."""
    sample, reach = BODIES["sphere"]
    axis = np.linspace(-reach, reach, 30)
    x, y = (g.ravel() for g in np.meshgrid(axis, axis))
    experiment = make_experiment(sample.build(), bshem, TraceSettings(rays=64), {"m": LAWS["mixture"].terms()})
    one, three = (trace_pixels(experiment, x, y, workers=n) for n in (1, 3))
    assert np.array_equal(one.mean, three.mean) and np.array_equal(one.fates, three.fates)


def test_cosine_scene_is_untouched(bshem):
    """Cosine under another name takes the closed-form path; beside a mirror its own pixels keep their counts.

    Catches: materials mixed up between faces, a cosine face that is treated by sampling.
    """
    flats = [FlatSample(size_um=1000.0, material=m).build() for m in ("matt", "mirror")]
    body = Body.join([flats[0], flats[1].moved((1000.0, 0.0, 0.0))])
    laws = {"matt": CosineLaw().terms(), "mirror": SpecularLaw().terms()}
    settings, x = TraceSettings(rays=64), np.array([0.0, 1000.0])
    assert make_experiment(flats[0], bshem, settings, laws).laws is None
    both = trace_pixels(make_experiment(body, bshem, settings, laws), x, 0 * x).total()[0]
    matt = trace_pixels(make_experiment(flats[0], bshem, settings, laws), x[:1], 0 * x[:1]).total()[0]
    np.testing.assert_allclose(both[:, 0], matt[:, 0], rtol=1e-12)
    assert np.all(both[:, 1] == 0) or np.all(np.isin(both[:, 1], (0.0, 1.0)))  # the mirror hits an aperture or none
