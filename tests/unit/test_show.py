"""Pictures for a first look: places and sizes of what is drawn, checked on the artists' own coordinates."""

import numpy as np
import pytest
from sphere_case import make_case

import helio_jax as hx
from helio_jax.errors import SceneError
from helio_jax.figures import canvas
from helio_jax.figures.image_numbers import image_numbers
from helio_jax.figures.instrument_views import draw_plan, draw_side
from helio_jax.figures.micrograph_page import MAX_IMAGES, draw_micrographs
from helio_jax.figures.notebook import as_html
from helio_jax.figures.plot_data import DETECTOR_COLORS, highest_valid
from helio_jax.figures.scale_bar import bar_length, draw_scale_bar
from helio_jax.figures.summary import summarise, text_lines
from helio_jax.figures.wording import amount, angle, duration, length, lengths, share, typeset
from helio_jax.heightmap import HeightMap
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.micrograph import MicrographSet
from helio_jax.trace.intersect import Intersector
from helio_jax.workflows.scene_file import SceneFile
from helio_jax.workflows.show import draw, heights_from_above, sample_surface


def instrument(azimuth_deg=0.0, incidence_deg=30.0):
    """Apertures of azimuth 0, 90 and 225 deg, the last one at infinity; sample 1 mm below the design distance."""
    detectors = (
        Detector(name="east", polar_deg=40.0, azimuth_deg=0.0, half_angle_deg=8.0),
        Detector(name="north", center_um=(0.0, 2500.0), axes_um=(900.0, 500.0)),
        Detector(name="sky", polar_deg=80.0, azimuth_deg=225.0, half_angle_deg=5.0, at_infinity=True),
    )
    plate = Plate(working_distance_um=3000.0, sample_distance_um=4000.0)
    beam = Beam(incidence_deg=incidence_deg, azimuth_deg=azimuth_deg)
    return Instrument(beam=beam, plate=plate, detector=detectors)


def scene(**scan):
    """Sphere A's cap, off the origin, in the instrument above; the beam travels towards +y."""
    sample = {"kind": "spheres", "size_um": 8000.0}
    sample["spheres"] = [{"radius_um": 1000.0, "cap_height_um": 720.0, "center_um": [500.0, -200.0]}]
    scan = {"kind": "raster", "nx": 21, "ny": 31, "pixel_size_um": 100.0, "center_um": [300.0, 0.0], **scan}
    return SceneFile.model_validate(instrument(90.0).model_dump() | {"sample": sample, "scan": scan, "name": "cap"})


def by_gid(ax, gid):
    return next(a for a in ax.get_children() if a.get_gid() == gid)


def axes_titled(figure, start):
    return next(ax for ax in figure.axes if ax.get_title(loc="left").startswith(start))


@pytest.fixture
def ax():
    return canvas.new_figure(5.0, 5.0).add_subplot()


@pytest.fixture(scope="module")
def case():
    return make_case(41, 45, pitch=80.0)


def test_azimuth_counts_counter_clockwise_from_x(ax):
    """An aperture of azimuth 90 deg is drawn at +y, one of 0 deg at +x, one of 225 deg below and left; y grows upwards.

    Catches clockwise azimuths, swapped axes, a view from below.
    """
    draw_plan(ax, instrument())
    centers = {name: np.mean(by_gid(ax, name).get_xydata()[:-1], axis=0) for name in ("east", "north", "sky")}
    assert centers["north"] == pytest.approx([0.0, 2.5], abs=1e-9)
    assert centers["east"][0] > 2.0 and abs(centers["east"][1]) < 1e-9
    assert centers["sky"][0] == pytest.approx(centers["sky"][1]) and centers["sky"][0] < -1.0
    assert ax.get_ylim()[0] < ax.get_ylim()[1] and ax.get_xlim()[0] < ax.get_xlim()[1] and ax.get_aspect() == 1.0
    assert by_gid(ax, "sky").get_linestyle() == "--" and by_gid(ax, "north").get_linestyle() == "-"
    width = np.ptp(by_gid(ax, "north").get_xydata(), axis=0)
    assert width == pytest.approx([0.9, 0.5], rel=1e-3)  # full axes, in mm


@pytest.mark.parametrize(("azimuth", "pinhole"), [(0.0, (-1.0, 0.0)), (90.0, (0.0, -1.0)), (180.0, (1.0, 0.0))])
def test_beam_is_drawn_as_it_travels(ax, azimuth, pinhole):
    """The arrow runs from the pinhole, upstream by W tan t, to the spot at the origin. Catches a reversed beam."""
    draw_plan(ax, instrument(azimuth))
    arrow = next(t for t in ax.texts if getattr(t, "arrow_patch", None) is not None and t.xy == (0.0, 0.0))
    assert arrow.xyann == pytest.approx(3.0 * np.tan(np.radians(30.0)) * np.array(pinhole), abs=1e-9)


def test_side_view_has_the_beams_slope(ax):
    """From the plate, D = 4 mm up, the beam reaches the substrate D tan t downstream, at the given place.

    Catches W instead of D, and a plan in the lab frame where the sample's is meant.
    """
    draw_side(ax, instrument(), center=250.0)
    beam = max((t for t in ax.texts if getattr(t, "arrow_patch", None) is not None), key=lambda t: t.xyann[1] - t.xy[1])
    assert beam.xy == pytest.approx((0.25, 0.0))
    assert beam.xyann == pytest.approx((0.25 - 4.0 * np.tan(np.radians(30.0)), 4.0))


@pytest.mark.parametrize("width", [0.05, 3.0, 41.0, 3630.0, 1e4, 7.7e6])
def test_scale_bar_is_as_long_as_it_says(ax, width):
    """Length on the axes = number and unit of the label; a fifth to a quarter of the map or shorter by 1, 2, 5.

    Catches a bar in pixels, a wrong unit, a bar that is too long.
    """
    ax.set_xlim(-0.3 * width, 0.7 * width)
    ax.set_ylim(0.0, width)
    draw_scale_bar(ax)
    drawn = np.ptp(by_gid(ax, "scale bar").get_xy()[:, 0])
    number, unit = ax.texts[0].get_text().split()
    assert drawn == pytest.approx(float(number) * {"nm": 1e-3, "µm": 1.0, "mm": 1e3}[unit])
    assert 0.1 * width <= drawn <= 0.25 * width * (1 + 1e-9)
    assert f"{bar_length(width):e}"[0] in "125"


def test_micrographs_lie_as_the_raster_does(case):
    """A bright pixel at +x, +y is drawn there; the frame has the colour of its aperture; the title has its numbers.

    Catches transposed or reversed images, an image beside another aperture's name.
    """
    stack, _, _ = case
    counts = np.full(stack.shape, 100.0)
    counts[1, -3, -7] = 900.0
    bright = stack.replace(counts=counts, variance=counts)
    figure = draw_micrographs(bright)
    ax = axes_titled(figure, "D2")
    image = ax.images[0]
    x0, x1, y0, y1 = image.get_extent()
    row, column = np.unravel_index(np.argmax(image.get_array()), counts.shape[1:])
    at = (x0 + (column + 0.5) * (x1 - x0) / 41, y0 + (row + 0.5) * (y1 - y0) / 45)
    assert at == pytest.approx((stack.x[-7], stack.y[-3])) and image.origin == "lower"
    frame = {spine.get_edgecolor() for spine in ax.spines.values()}
    plan = axes_titled(figure, "Plate")
    rim = by_gid(plan, "D2")
    assert frame == {tuple(c for c in (*canvas_rgb(rim.get_color()), 1.0))}
    title = ax.get_title(loc="left")
    assert "polar 35°, azimuth 120°" in title and f"mean {counts[1].mean():.4g} counts" in title


def canvas_rgb(color):
    return tuple(int(color[i : i + 2], 16) / 255 for i in (1, 3, 5))


def test_grey_scales_are_own_or_common(case):
    """Own: each image spans its counts; common: all have one range. Catches an option without effect."""
    stack, _, _ = case
    dim = stack.replace(counts=stack.counts * np.array([1.0, 0.1, 1.0])[:, None, None])
    for common, n_ranges in ((True, 1), (False, 3)):
        figure = draw_micrographs(dim, common_scale=common)
        assert len({ax.images[0].get_clim() for ax in figure.axes if ax.images}) == n_ranges


def test_numbers_of_images(case):
    """SNR is (counts - background) over one pixel's deviation at the border; unknown with an unknown background.

    Catches a background counted as signal, a standard error in place of a deviation, an SNR that nobody can know.
    """
    stack, _, _ = case
    flat = np.full(stack.shape, 500.0)
    noisy = stack.replace(counts=flat, variance=flat, background=np.full(3, 100.0), noise="poisson")
    found = image_numbers(noisy)[0]
    assert (found.mean, found.highest) == (500.0, 500.0)
    assert found.snr == pytest.approx(400.0 / np.sqrt(500.0)) and found.noise == pytest.approx(np.sqrt(500.0))
    assert image_numbers(noisy.replace(noise="measured", background=None))[0].snr is None
    expected = stack.replace(counts=flat, variance=flat / 25, noise="expected")
    assert image_numbers(expected)[0].snr == pytest.approx(np.sqrt(500.0))
    assert image_numbers(expected)[0].relative_error == pytest.approx(np.sqrt(20.0) / 500.0)
    unseen = noisy.replace(is_observed=np.zeros(stack.shape, bool))
    assert image_numbers(unseen)[0].snr is None
    draw(unseen)  # nothing recorded: still a page


def test_highest_point_is_valid_and_at_its_own_place(case):
    """An invalid spike is not the highest point; the mark stands at the surface point, not at its raster position.

    Catches the apex of an outlier, and h tan t forgotten.
    """
    _, rec, truth = case
    height = truth.height.copy()
    height[2, 2] = 5000.0
    is_valid = np.ones(height.shape, bool)
    is_valid[2, 2] = False
    rec = rec.replace(height=height, is_valid=is_valid, reason=np.where(is_valid, 0, 2), height_std=0 * height + 7.0)
    top = highest_valid(rec)
    assert top is not None and rec.height[top] == truth.height.max()
    ax = axes_titled(draw(rec), "Height")
    mark = next(line for line in ax.lines if line.get_marker() == "+")
    assert mark.get_xydata()[0] == pytest.approx([rec.x[top], rec.y[top]])
    assert abs(rec.x[top] - rec.raster_x[top[1]]) > 300.0
    rows = dict(summarise(rec))
    assert rows["highest point"].startswith(f"{rec.height[top]:.4g} +- 7.0 um at x = {rec.x[top]:.0f} um")
    nothing = rec.replace(is_valid=np.zeros(height.shape, bool), reason=np.full(height.shape, 2))
    assert highest_valid(nothing) is None and "no height is valid" in dict(summarise(nothing))["highest point"]
    draw(nothing)


def test_scene_before_tracing():
    """The sample is where the scene puts it: cap 0.72 mm at (500, -200) um; the section runs along the beam's azimuth.

    The beam at the scan's centre meets the sphere, which the closed form confirms. Catches a sample drawn at the
    origin, a section along x, a beam that ends in the sample.
    """
    found = scene()
    surface = sample_surface(found, found.views()[0])
    i, j = np.unravel_index(np.argmax(surface.height), surface.height.shape)
    step = surface.x[1] - surface.x[0]
    assert (surface.x[j], surface.y[i]) == pytest.approx((500.0, -200.0), abs=step)
    assert surface.height.max() == pytest.approx(720.0, abs=0.001 * step**2)
    along, section = surface.section
    cut = np.sqrt(1000.0**2 - 200.0**2) - 280.0  # the section passes 200 um beside the sphere's axis
    assert np.nanmax(section) == pytest.approx(cut, abs=0.1)
    assert along[np.nanargmax(section)] == pytest.approx(-200.0, abs=10.0)
    assert surface.hit is not None
    assert np.linalg.norm(np.subtract(surface.hit, (500.0, -200.0, -280.0))) == pytest.approx(1000.0, abs=0.01)
    assert surface.hit[1] == pytest.approx(-surface.hit[2] * np.tan(np.radians(30.0)), abs=1e-6)
    beside = heights_from_above(Intersector(found.build_body()), 720.0, np.array([9000.0]), np.array([0.0]))
    assert np.isnan(beside).all()
    assert found.plot() is not None
    with pytest.raises(SceneError, match="view must be 0 to 0, got 3"):
        draw(found, view=3)


def pages():
    stack, rec, _ = make_case(41, 45, pitch=80.0)
    six = make_case(21, 13, 6, pitch=160.0)[0]
    listed = stack.replace(
        **{k: getattr(stack, k)[:, :1] for k in ("counts", "variance", "masked", "is_observed")},
        by_order=None, shadowed=None, y=np.zeros(1), positions=np.zeros((41, 2)), name="line",
    )  # fmt: skip
    return {
        "stack": stack,
        "six": six,
        "list": listed,
        "set": MicrographSet(tuple(stack.replace(name=f"scan {i}", sample_rotation=0.1 * i) for i in range(12))),
        "rec": rec.replace(height_std=np.full_like(rec.height, 4.0)),
        "no errors": rec,
        "map": HeightMap(rec.height, rec.raster_x, rec.raster_y),
        "instrument": instrument(90.0),
        "normal": instrument(incidence_deg=0.0),
        "long names": with_long_names(stack),
        "narrow": stack.replace(
            counts=stack.counts[:, :3],
            variance=stack.variance[:, :3],
            is_observed=None,
            by_order=None,
            masked=None,
            shadowed=None,
            y=stack.y[:3],
        ),
        "scene": scene(),
    }


def with_long_names(stack):
    detectors = tuple(
        d.model_copy(update={"name": d.name + " in the basement room" * 2}) for d in stack.instrument.detector
    )
    return stack.replace(name="scan " * 40, instrument=stack.instrument.model_copy(update={"detector": detectors}))


@pytest.mark.parametrize("name", pages())
def test_pages_keep_their_texts_apart(name):
    """No axes, titles and labels included, overlap others or leave the page. Catches labels drawn over each other."""
    figure = draw(pages()[name])
    figure.canvas.draw()
    page = figure.bbox
    boxes = [ax.get_tightbbox() for ax in figure.axes if ax.name != "3d"]
    heads = [text.get_window_extent() for text in figure.texts]
    for k, a in enumerate([*boxes, *heads]):
        assert a.x0 >= page.x0 - 1 and a.y0 >= page.y0 - 1 and a.x1 <= page.x1 + 1 and a.y1 <= page.y1 + 1, k
        for b in [*boxes, *heads][k + 1 :]:
            assert min(a.x1, b.x1) <= max(a.x0, b.x0) + 1 or min(a.y1, b.y1) <= max(a.y0, b.y0) + 1, k
    assert figure._repr_png_().startswith(b"\x89PNG")  # what a notebook shows


def test_large_sets_fit_on_a_page():
    """12 scans of 3 detectors: the first 23 images, and the heading says so. Catches a page metres long."""
    figure = draw(pages()["set"])
    assert sum(bool(ax.images) for ax in figure.axes) == MAX_IMAGES
    assert f"the first {MAX_IMAGES} of 36 images" in figure.texts[0].get_text()


def test_records_introduce_themselves(case):
    """`repr` is one short line; the notebook's view is small and escapes names. Catches dumped arrays, HTML from a
    file, thumbnails that are not to scale."""
    stack, rec, _ = case
    records = [stack.replace(name="<b>x</b>"), MicrographSet((stack,)), rec, instrument(), scene()]
    records.append(HeightMap(rec.height, rec.raster_x, rec.raster_y))
    for record in records:
        assert repr(record).startswith(f"<{type(record).__name__}") and len(repr(record)) < 120
        assert str(record) == repr(record)
        page = as_html(record)
        assert page == record._repr_html_() and len(page) < 200_000
        assert "<b>x</b>" not in page and page.count("<tr>") == len(summarise(record))
    wide = HeightMap(np.zeros((20, 10)), np.arange(10) * 40.0, np.arange(20) * 10.0)  # 400 x 200 um
    assert "width:160px;height:80px" in as_html(wide)
    assert as_html(stack).count("<img") == 3 and as_html(rec).count("<img") == 1


def test_show_is_public(case, tmp_path):
    """`hx.show` draws records and files and writes by suffix; other things are refused by name.

    Catches a picture written over the file that it shows.
    """
    stack, rec, _ = case
    for suffix, head in ((".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")):
        hx.show(rec, tmp_path / f"r{suffix}")
        assert (tmp_path / f"r{suffix}").read_bytes().startswith(head)
    hx.write(stack, tmp_path / "s.h5")
    assert len(hx.show(tmp_path / "s.h5").axes) == len(stack.plot().axes)
    with pytest.raises(SceneError, match="nothing can be drawn of a list"):
        hx.show([1, 2])
    (tmp_path / "link.png").symlink_to(tmp_path / "s.h5")
    with pytest.raises(SceneError, match="is the same file"):
        hx.show(tmp_path / "s.h5", tmp_path / "link.png")


def test_colours_tell_neighbouring_detectors_apart():
    """Catches a colour that occurs twice among the first seven detectors."""
    assert len(set(DETECTOR_COLORS)) == len(DETECTOR_COLORS) == 7


def test_summary_of_an_instrument():
    """Angles as the file states them; the sample distance and the design distance. Catches radians, W for D."""
    rows = dict(summarise(instrument(90.0)))
    assert rows["beam"] == (
        "30 deg from the plate normal, travels towards azimuth 90 deg; substrate 4 mm below the plate (aimed at 3 mm)"
    )
    assert rows["- east"] == "polar 40 deg, azimuth 0 deg" and rows["- sky"].endswith("azimuth 225 deg, at infinity")
    assert rows["- north"] == f"polar {np.degrees(np.arctan(2.5 / 3.0)):.1f} deg, azimuth 90 deg"
    lines = text_lines(list(rows.items()))
    assert len({line.index(text) for line, text in zip(lines, rows.values(), strict=True)}) == 1  # aligned


def test_numbers_are_written_with_their_units():
    """Catches a wrong prefix, a lost minus sign, rounding to the next unit and past 60 minutes."""
    written = [length(v) for v in (0.25, 30.0, 999.9, 999.96, 4720.0, -1280.0, 0.0)]
    assert written == ["250 nm", "30 um", "999.9 um", "1 mm", "4.72 mm", "-1.28 mm", "0 um"]
    assert lengths(34.641, 30.0) == "34.64 x 30 um" and angle(np.radians(-120.0)) == "-120 deg"
    assert [amount(v, "A") for v in (1.276e-10, 0.0, -2e-9)] == ["127.6 pA", "0 A", "-2 nA"]
    assert [amount(v, "counts") for v in (467.31, 14381.0)] == ["467.3 counts", "14,381 counts"]
    assert [share(v) for v in (0.048, 0.0012, 0.0, 1.0)] == ["4.8 %", "0.12 %", "0.0 %", "100.0 %"]
    assert [duration(v) for v in (2.34, 59.0, 18857.6, 3599.0)] == ["2.3 s", "59 s", "5 h 14 min", "1 h 0 min"]
    assert typeset("30 x 30 um, azimuth -120 deg +- 3 deg, number") == "30 × 30 µm, azimuth −120° ± 3°, number"


@pytest.mark.parametrize(
    "history",
    [{"source": 1, "scene": [3], "versions": "x"}, {"metadata": {"meas_list": []}, "scene": {"trace": "seed"}}],
)
def test_summary_of_a_strange_history(case, history):
    """What a foreign file states of its history is never trusted to be a table. Catches an AttributeError."""
    stack, _, _ = case
    assert "made" not in dict(summarise(stack.replace(provenance=history)))
    assert "<table>" in as_html(stack.replace(provenance={**history, "time": "<i>" * 999}))
