"""Figures: drawn without a display, with the right orientation, for one to six detectors and for missing data."""

import sys

import numpy as np
import pytest
from sphere_case import CAP, RADIUS, TAN, make_case

from helio_jax.errors import SceneError
from helio_jax.figures import plot_data
from helio_jax.figures.canvas import figure_png, save_figure
from helio_jax.figures.panel import micrograph_panel, panel
from helio_jax.reconstruction import REASONS
from helio_jax.scores.metrics import evaluate_height

PNG = b"\x89PNG"


def titles(fig):
    return [ax.get_title(loc="left") for ax in fig.axes if ax.get_title(loc="left")]


def image_of(fig, title):
    """Return the first image drawn in the axes whose title starts with `title`."""
    return next(ax for ax in fig.axes if ax.get_title(loc="left").startswith(title)).images[0]


@pytest.fixture(scope="module")
def case():
    return make_case(41, 45, pitch=80.0)


def test_panel_shows_all_and_the_numbers(case):
    """Catches: a map left out, numbers other than the scores', a panel that needs pyplot or a display."""
    stack, rec, truth = case
    rec = rec.replace(height=0.9 * truth.height, height_std=np.full_like(rec.height, 4.0))
    scores = evaluate_height(rec, truth)
    fig = panel(stack, rec, truth, scores)
    for start in (
        "Micrograph D3",
        "Height",
        "Shaded relief",
        "Height error",
        "Validity",
        "Standard",
        "Profile through the highest valid point, along y",
    ):
        assert any(t.startswith(start) for t in titles(fig)), start
    text = {t.get_text() for ax in fig.axes for t in ax.texts}
    assert {f"{100 * scores.recovered_height:.1f}", f"{100 * scores.rms_region:.2f}", "refine"} <= text
    assert figure_png(fig, dpi=40).startswith(PNG)
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_boxes_do_not_overlap(case):
    """Catches: labels, colour bars or legends of neighbouring maps drawn over each other or outside the page."""
    stack, rec, truth = case
    rec = rec.replace(height_std=np.full_like(rec.height, 4.0))
    fig = panel(stack, rec, truth, evaluate_height(rec, truth))
    fig.canvas.draw()
    boxes = [ax.get_tightbbox() for ax in fig.axes]
    page = fig.bbox
    for k, a in enumerate(boxes):
        assert a.x0 >= page.x0 and a.y0 >= page.y0 and a.x1 <= page.x1 and a.y1 <= page.y1, titles(fig)[k]
        for b in boxes[k + 1 :]:
            assert min(a.x1, b.x1) <= max(a.x0, b.x0) + 1 or min(a.y1, b.y1) <= max(a.y0, b.y0) + 1


def test_maps_have_orientation_and_scale(case):
    """Origin lower, um axes, equal aspect; a bright pixel at +x, +y is drawn there. Catches: transposed or upside
    down pictures, half-pixel shifts of the extent, axes in pixels."""
    stack, _, _ = case
    counts = np.ones(stack.shape)
    counts[0, -3, -7] = 9.0
    image = image_of(micrograph_panel(stack.replace(counts=counts)), "Micrograph D1")
    assert image.origin == "lower" and image.axes.get_aspect() == 1.0
    x0, x1, y0, y1 = image.get_extent()
    row, column = np.unravel_index(np.argmax(image.get_array()), counts.shape[1:])
    at = (x0 + (column + 0.5) * (x1 - x0) / 41, y0 + (row + 0.5) * (y1 - y0) / 45)
    assert at == pytest.approx((stack.x[-7], stack.y[-3]))


@pytest.mark.parametrize("n_detectors", [1, 4, 6])
def test_any_number_of_detectors(n_detectors):
    """Catches: a layout for three detectors only; missing optional fields; NaN heights and unrecorded counts."""
    stack, rec, _ = make_case(21, 13, n_detectors, pitch=160.0)
    height = rec.height.copy()
    height[3:5, 4:9] = np.nan
    is_observed = np.ones(stack.shape, bool)
    is_observed[0, :2] = False
    stack = stack.replace(is_observed=is_observed, masked=None, shadowed=None)
    fig = panel(stack, rec.replace(height=height, residuals=None))
    assert sum(t.startswith("Micrograph") for t in titles(fig)) == n_detectors
    assert image_of(fig, "Micrograph D1").get_array().mask[:2].all()
    assert figure_png(fig, dpi=30).startswith(PNG)
    fig = micrograph_panel(stack)
    assert sum(t.startswith("Multiple") for t in titles(fig)) == n_detectors
    assert figure_png(fig, dpi=30).startswith(PNG)


def test_error_colours_are_symmetric(case):
    """Catches: a diverging map whose white is not zero."""
    stack, rec, truth = case
    image = image_of(panel(stack, rec.replace(height=0.9 * truth.height), truth), "Height error")
    low, high = image.get_clim()
    assert low == -high < 0


def test_surface_is_cut_at_the_occlusion_edge_only(case):
    """The sphere's occlusion gap, from x = R sin(60 deg) = 866 um at h = 220 um down the ray to x = 993 um, is cut; the
    flat and the top are whole. Catches: a curtain over the gap, holes elsewhere, cells off by one."""
    _, rec, _ = make_case(161, 91, pitch=20.0)
    cut = ~plot_data.surface_cells(rec)
    assert cut.shape == (90, 160)
    x = 0.25 * (rec.x[1:, 1:] + rec.x[1:, :-1] + rec.x[:-1, 1:] + rec.x[:-1, :-1])
    r = np.hypot(x, 0.5 * (rec.raster_y[1:, None] + rec.raster_y[:-1, None]))
    assert cut[45].sum() in (1, 2) and 866 - 20 < x[45][cut[45]].mean() < 993 + 20
    assert not cut[(r < 780) | (r > 1060)].any()
    height = rec.height.copy()
    height[10, 20] = np.nan
    hole = ~plot_data.surface_cells(rec.replace(height=height)) & ~cut
    assert hole.sum() == 4 and hole[9:11, 19:21].all()


def rotated(rec, degrees):
    """Return a reconstruction whose beam travels towards another azimuth; heights as they are."""
    beam = rec.instrument.beam.model_copy(update={"azimuth_deg": degrees})
    return rec.replace(instrument=rec.instrument.model_copy(update={"beam": beam}))


def test_profiles_run_through_the_highest_valid_point():
    """Along x at the point's own y and along y at its own x, in the sample frame: the sphere's true outline, within the
    chord of a pixel; a higher pixel that is not valid does not count; the occlusion gap is open.

    Catches raster positions (apex at H tan t = 416 um), the pixel farthest from the median, a line at fixed raster x.
    """
    _, rec, _ = make_case(161, 91, pitch=20.0)
    height = rec.height.copy()
    height[3, 5] = 5000.0
    is_valid = np.ones(height.shape, bool)
    is_valid[3, 5] = False
    rec = rec.replace(height=height, is_valid=is_valid, reason=np.where(is_valid, 0, 3))
    row, column = plot_data.highest_valid(rec)
    along_x, along_y = plot_data.profiles(rec)
    assert along_x.place == "y = 0 µm" and abs(rec.x[row, column]) < 20.0
    for cut in (along_x, along_y):
        assert np.nanmax(cut.height) == rec.height[row, column]
        z = np.sqrt(np.maximum(RADIUS**2 - cut.at**2, 0.0)) - (RADIUS - CAP)
        known = (cut.height > 20.0) & (np.abs(cut.at) < 600.0)
        assert known.sum() > 25 and np.abs(cut.height - z)[known].max() < 3.0
    gap = np.isnan(along_x.height) & (along_x.at > 740) & (along_x.at < 1010)
    assert gap.any() and np.isfinite(along_x.height[np.abs(along_x.at) < 700]).all()
    assert plot_data.profiles(rec.replace(is_valid=~np.ones_like(is_valid), reason=np.ones_like(rec.reason))) == []


def test_profile_beside_pixels_that_are_not_valid():
    """The highest valid point is in both profiles though all its neighbours are not valid. Catches a search that needs
    whole cells, which loses the very point that the profiles are about."""
    _, rec, _ = make_case(41, 45, pitch=80.0)
    row, column = plot_data.highest_valid(rec)
    is_valid = rec.is_valid.copy()
    is_valid[row - 1 : row + 2, column - 1 : column + 2] = False
    is_valid[row, column] = True
    rec = rec.replace(is_valid=is_valid, reason=np.where(is_valid, 0, 3))
    assert [np.nanmax(cut.height) for cut in plot_data.profiles(rec)] == [rec.height[row, column]] * 2


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 30.0])
def test_band_of_a_profile_is_that_of_a_fixed_place(azimuth):
    """On a plane of slope dh/dX = 0.3 a height error e at a beam position moves the surface at a fixed x by
    e / (1 - tx dh/dX): seen by shifting the whole plane. Catches a band drawn along the beam, or the file's own s.d."""
    _, rec, _ = make_case(41, 45, pitch=80.0)
    rec = rotated(rec, azimuth)
    height = 0.3 * rec.raster_x - 1e-4 * np.abs(rec.raster_y)[:, None]  # the highest point is not in a corner
    flat = {"is_valid": np.ones(height.shape, bool), "reason": np.zeros(height.shape)}
    plane = rec.replace(height=height, height_std=np.full(height.shape, 5.0), **flat)
    cut, moved = (plot_data.profiles(r)[0] for r in (plane, plane.replace(height=height + 5.0)))
    shift = np.interp(0.0, moved.at, moved.height) - np.interp(0.0, cut.at, cut.height)
    tx = TAN * np.cos(np.radians(azimuth))
    assert shift == pytest.approx(5.0 / (1.0 - 0.3 * tx), rel=2e-3)
    assert np.interp(0.0, cut.at, cut.height_std) == pytest.approx(shift, rel=2e-3)


def test_residuals_test_only_what_is_over_determined(case):
    """Three images fix the three unknowns of a photometric pixel; a fit, or a fourth image, leaves something to check.

    Catches a colourful map of rounding errors."""
    _, rec, _ = case
    assert plot_data.is_checkable(rec) and not plot_data.is_checkable(rec.replace(residuals=None))
    assert not plot_data.is_checkable(rec.replace(method="nearfield"))
    _, four, _ = make_case(21, 21, 4, pitch=160.0)
    assert plot_data.is_checkable(four.replace(method="nearfield"))
    assert "Residuals" not in " ".join(titles(panel(None, rec.replace(method="linear"))))


def test_fractions_and_residuals(case):
    """Catches: division by zero where nothing arrives; detectors without data counted as zero residuals."""
    stack, _, _ = case
    orders = np.stack([np.full(stack.shape, 3.0), np.full(stack.shape, 1.0)])
    orders[:, 0, 0, 0] = 0.0
    fraction = plot_data.multiple_fraction(stack.replace(by_order=orders))
    assert np.isnan(fraction[0, 0, 0]) and np.nanmax(np.abs(fraction - 0.25)) == 0.0
    assert plot_data.multiple_fraction(stack.replace(by_order=None)) is None
    residuals = np.array([3.0, np.nan, 4.0]).reshape(3, 1, 1)
    assert plot_data.residual_rms(residuals) == pytest.approx(np.sqrt(12.5))
    assert np.isnan(plot_data.residual_rms(np.full((3, 1, 1), np.nan))).all()


def test_figures_are_written_by_suffix(case, tmp_path):
    """Catches: half-written files left behind, unknown suffixes passed to matplotlib."""
    stack, _, _ = case
    fig = micrograph_panel(stack)
    save_figure(fig, tmp_path / "m.png")
    assert (tmp_path / "m.png").read_bytes().startswith(PNG)
    with pytest.raises(SceneError, match="suffix must be one of png, pdf, svg"):
        save_figure(fig, tmp_path / "m.exe")
    assert [p.name for p in tmp_path.iterdir()] == ["m.png"]


def test_every_reason_has_a_colour_of_its_own():
    """Catches a reason added without a colour: the map then shows others in its neighbours' colours."""
    assert len(set(plot_data.REASON_COLORS)) == len(REASONS)
