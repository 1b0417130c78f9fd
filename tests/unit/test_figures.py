"""Figures: drawn without a display, with the right orientation, for one to six detectors and for missing data."""

import sys

import numpy as np
import pytest
from sphere_case import CAP, TAN, make_case

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
        "Profile along y",
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


def test_profile_is_at_the_points_own_positions(case):
    """The apex is drawn at x = 0, not at X = H tan t; the occlusion gap is reported. Catches: raster positions."""
    _, rec, truth = make_case(161, 91, pitch=20.0)
    pixel = plot_data.apex_pixel(truth.height)
    at, height, gaps = plot_data.profile_line(rec, truth.height, "x", pixel)
    assert rec.raster_x[pixel[1]] == pytest.approx(CAP * TAN, abs=10.0)
    assert at[np.argmax(height)] == pytest.approx(0.0, abs=20.0)
    assert len(gaps) == 1 and 740 < at[gaps[0] - 1] < at[gaps[0]] < 1010
    band = plot_data.profile_band(
        rec.replace(height_std=np.full_like(height, 5.0) + 0 * truth.height), truth.height, "y", pixel
    )
    assert band[1].size == 2 * rec.raster_y.size and band[1].max() == pytest.approx(truth.height.max() + 5.0)


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
