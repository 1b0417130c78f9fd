"""Lines in micrographs: filter responses, false alarms in noise with scan lines, drift and ripple, paths."""

import math

import numpy as np
import pytest
from scipy import stats
from stats import assert_likely

from helio_jax.errors import GuardError, SceneError
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.measure.line_paths import Path, trace_lines
from helio_jax.measure.lines import LineSettings, contrast_of, euler_density, find_lines, kernel
from helio_jax.micrograph import MicrographStack

PITCH, SIZE = 20.0, 80
AXIS = (np.arange(SIZE) - 0.5 * (SIZE - 1)) * PITCH
GRID_X, GRID_Y = np.meshgrid(AXIS, AXIS)
NOISE = (0.025, 0.034, 0.053)
"""Standard deviation of one pixel over the substrate's signal, as on the measured salt."""
AZIMUTHS = (0.0, 2.0 * math.pi / 3.0, -2.0 * math.pi / 3.0)


def instrument() -> Instrument:
    """The B-SHeM's plate: three apertures 30 deg from the normal, the beam 30 deg oblique."""
    detectors = tuple(
        Detector(name=n, center_um=(1732.0 * math.cos(a), 1732.0 * math.sin(a)), axes_um=(1000.0, 1000.0))
        for n, a in zip(("forward", "left", "right"), AZIMUTHS, strict=True)
    )
    return Instrument(beam=Beam(incidence_deg=30.0), plate=Plate(working_distance_um=3000.0), detector=detectors)


def make_stack(contrast=0.0, seed=0, noise=NOISE, **changes) -> MicrographStack:
    """Micrographs of signal 1 + contrast [detector, y, x] in white noise of a stated variance; rows are scanned."""
    std = np.array(noise)[:, None, None] * np.ones((3, SIZE, SIZE))
    images = 1.0 + contrast + std * np.random.default_rng(seed).standard_normal(std.shape)
    return MicrographStack(images, AXIS, AXIS, instrument(), variance=std**2, n_rays=1.0).replace(**changes)


def nuisance(seed: int) -> np.ndarray:
    """Drift of 10 %, scan lines of 8 % and a ripple of 1 %, as on salt: no line of the surface."""
    rng = np.random.default_rng(1000 + seed)
    drift = 0.05 * np.sin(GRID_Y / 400.0 + np.array([0.0, 1.0, 2.0])[:, None, None]) + 0.05 * GRID_X / 800.0
    ripple = 0.01 * np.sin(2.0 * np.pi * (GRID_X - GRID_Y) / math.sqrt(2.0) / 114.0)
    return drift + 0.08 * rng.standard_normal((3, SIZE, 1)) + ripple


@pytest.mark.parametrize("order", [1, 2])
def test_filter_responses(order):
    """Responses: a line lacking 2 pixels of signal 2, a step of 0.3 0.3, in any direction; a constant 0.

    To 5 % (pixels of finite size). Catches a kernel that is not normalised or rotated the wrong way.
    """
    for angle in np.radians([0.0, 30.0, 77.0, 120.0]):
        k = kernel(order, 1.6, angle)
        n = k.shape[0] // 2
        y, x = np.mgrid[-n : n + 1, -n : n + 1]
        t = math.cos(angle) * x + math.sin(angle) * y
        thin = -2.0 * np.exp(-0.5 * (t / 0.5) ** 2) / (0.5 * math.sqrt(2.0 * math.pi))
        wide = (1.0 + (0.5 / 1.6) ** 2) ** -1.5  # response of a line of deviation 0.5
        expected = {1: (0.15 * np.sign(t), 0.3), 2: (thin, 2.0 * wide)}[order]
        assert np.sum(k * expected[0]) == pytest.approx(expected[1], rel=0.05)
        assert abs(np.sum(k)) < 1e-6
        assert order == 1 or abs(np.sum(k * t)) < 1e-6


def test_density_of_maxima():
    """One degree of freedom is a Gaussian field with both signs, and so twice its density."""
    for score in (4.0, 5.5):
        assert euler_density(score, 1) == pytest.approx(2.0 * euler_density(score, 0), rel=1e-6)
    assert euler_density(5.0, 3) > euler_density(5.0, 1)


def test_false_alarms():
    """14 images of noise, drift, scan lines and ripple, 10 false alarms allowed in each: at most 140 lines, but some.

    Catches a threshold for one pixel instead of all, directions that are not counted (40 times as many lines), scan
    lines detected as lines (hundreds), and a threshold so high that nothing is ever detected.
    """
    s = LineSettings(false_alarms=10.0, min_length_px=3.0)
    everywhere, n = np.ones((SIZE, SIZE), bool), 0
    for seed in range(14):
        contrast = contrast_of(make_stack(nuisance(seed), seed))
        for kind in ("line", "groove"):
            n += len(trace_lines(find_lines(contrast, everywhere, kind, s), s))
    assert_likely(float(stats.poisson.sf(n - 1, 140.0)), f"{n} lines in 14 images of noise, 140 allowed")
    assert n > 5


def test_offsets_of_scan_lines_are_subtracted():
    """Offsets of 8 % of whole lines: their jumps fall below twice the noise of a mean; along the wrong axis they stay.

    Catches offsets determined along the slow axis.
    """
    lines = 0.08 * np.random.default_rng(5).standard_normal((3, SIZE, 1))
    right, wrong = (contrast_of(make_stack(lines, 1, fast_axis=axis)) for axis in ("x", "y"))
    jumps = [float(np.std(np.diff(c.values[0].mean(1)))) for c in (right, wrong)]
    assert jumps[0] < 2.0 * NOISE[0] * math.sqrt(2.0 / SIZE) and jumps[1] > 0.08


def test_path_of_a_bent_line():
    """A dark arc of 600 um radius, 90 deg long: one path of 942 um, every point within half a pixel of the arc.

    Catches a line broken at every change of direction, two paths side by side, and a wandering path.
    """
    r, a = np.hypot(GRID_X + 300.0, GRID_Y + 200.0), np.arctan2(GRID_Y + 200.0, GRID_X + 300.0)
    arc = -0.4 * np.exp(-0.5 * ((r - 600.0) / 12.0) ** 2) * ((a > 0.0) & (a < 0.5 * math.pi))
    s = LineSettings()
    contrast = contrast_of(make_stack(arc, 3))
    (path,) = trace_lines(find_lines(contrast, np.ones((SIZE, SIZE), bool), "line", s), s)
    assert path.length * PITCH == pytest.approx(0.5 * math.pi * 600.0, abs=60.0)
    x, y = (path.points * PITCH + AXIS[0]).T
    assert np.max(np.abs(np.hypot(x + 300.0, y + 200.0) - 600.0)) < 0.5 * PITCH


def test_pieces_of_a_path():
    """A path of 10 pixels extended by 3 at both ends is 16 long; its parts keep their places; shifted left by 1."""
    path = Path(np.stack([np.linspace(3.0, 9.0, 11), np.linspace(4.0, 12.0, 11)], -1), 9.0)
    assert path.length == pytest.approx(10.0) and path.extended(3.0).length == pytest.approx(16.0)
    piece = path.extended(3.0).between(3.0, 13.0)
    assert piece.points[[0, -1]] == pytest.approx(np.array([[3.0, 4.0], [9.0, 12.0]]))
    inside = np.zeros((20, 20), bool)
    inside[:, 4:8] = True  # x from 3.5 to 7.5: 4 / 0.6 pixels of the path
    assert path.extended(3.0).within(inside).length == pytest.approx(4.0 / 0.6, abs=0.6)
    assert path.moved(1.0).points[0] == pytest.approx(np.array([3.0 - 0.8, 4.0 + 0.6]))


def test_refused_stacks():
    """A stack that is not calibrated or of unknown noise, and a region without pixels are refused."""
    stack = make_stack()
    for changes, words in (({"n_rays": None}, "helio calibrate"), ({"variance": None}, "variance")):
        with pytest.raises(SceneError, match=words):
            contrast_of(stack.replace(**changes))
    with pytest.raises(GuardError, match="no pixel"):
        find_lines(contrast_of(stack), np.zeros((SIZE, SIZE), bool), "line", LineSettings())


def test_a_known_background_is_subtracted():
    """Catches contrast relative to the reading: with a background of twice the signal it is three times too small."""
    plain = make_stack(0.1 * nuisance(1))
    read = plain.replace(counts=plain.counts + 2.0, background=np.full(3, 2.0))
    assert contrast_of(read).values == pytest.approx(contrast_of(plain).values)
