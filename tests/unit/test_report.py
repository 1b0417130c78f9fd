"""The HTML report: one file, opens offline, holds the numbers of its files, escapes what comes from them."""

import base64
import json
from html.parser import HTMLParser

import numpy as np
import pytest
from sphere_case import make_case

from helio_jax.errors import SceneError
from helio_jax.figures.report import Measured, sections, write_report
from helio_jax.measure.facets import find_facets
from helio_jax.scores.metrics import evaluate_height
from helio_jax.validity import MEANINGS, VALID_RULE

VOID = {"meta", "img", "br", "link", "hr", "input"}
MAX_BYTES = 8e6


class Page(HTMLParser):
    """Collects tags, text outside of scripts, and checks that tags are closed in order."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.text, self.figures = [], [], [], ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        if self.open and self.open[-1][0] == "script":
            if self.open[-1][1].get("id") == "figures":
                self.figures += data
        elif self.open and self.open[-1][0] != "style":
            self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).replace("\u00a0", " ").split())


def report(tmp_path, *args, **more):
    path = write_report(tmp_path / "r.html", *args, **more)
    text = path.read_text(encoding="utf-8")
    return Page(text), text


def decoded(values):
    """Return an array of a figure as numbers: plotly's typed arrays."""
    if not isinstance(values, dict):
        return np.array(values, float)
    found = np.frombuffer(base64.b64decode(values["bdata"]), np.dtype(values["dtype"]))
    return found.reshape([int(n) for n in values["shape"].split(",")]) if "shape" in values else found


def full_case(nx=41, ny=45, n_detectors=3, pitch=80.0):
    """Return a case of which everything is known, scores, history and error bars included."""
    stack, rec, truth = make_case(nx, ny, n_detectors, pitch)
    history = {
        "height_changes_um": [6.0, 2.0, 0.5],
        "assumed": "2 levels from mask bands",
        "reconstruct": {"refine": {"tolerance_um": 1.0, "gain_std": 0.02, "offset_std": 0.01}},
        "traced_chi_square": {"D1": 1.25, "D2": 0.75},
        "versions": {"helio-jax": "0.1.0"},
        "command": ["helio", "reconstruct"],
        "stack": {"rays": {"launched": 10, "detected": 3, "escaped": 7, "stopped": 0, "lost": 0}, "trace": {"seed": 7}},
    }
    rec = rec.replace(
        height=0.9 * truth.height, height_std=np.full_like(rec.height, 4.0), chi_square=np.ones_like(rec.height),
        provenance={**rec.provenance, **history},
    )  # fmt: skip
    return stack.replace(provenance=history["stack"]), rec, truth


def test_report_is_complete_and_offline(tmp_path):
    """Catches: an external script, picture or font; an upload button; plotly.js twice; a section or a number left
    out; a link that leads nowhere."""
    stack, rec, truth = full_case()
    scores = evaluate_height(rec, truth)
    measured = Measured(find_facets(rec), {"steps": []})
    page, text = report(tmp_path, stack, rec, truth, scores, measured=measured, title="Sphere <A>")
    ids = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "object", "embed", "base"), tag
        assert tag != "a" or attributes["href"].removeprefix("#") in ids
        for name in ("src", "srcset", "data", "poster"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, attributes)
    assert "plotlyServerURL: ''" in text and "modeBarButtonsToRemove: ['sendChartToCloud'" in text  # no upload button
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style and "@import" not in style
    assert text.count("* plotly.js v") == 1
    for word in (
        "Sphere <A>", "is supported: micrographs traced on it agree", f"{rec.height.max():.4g} ± 4.0 µm at x",
        f"relief {rec.height.max():.4g} µm", "limited by",
        "Instrument", "Micrographs", "Multiple scattering", "Height", "Surface", "Profiles", "Against the truth",
        "Uncertainty", "Validity and causes", VALID_RULE, MEANINGS["masked in too many detectors"],
        "Residuals and chi-square", "chi-square of the fit", f"D1 {np.mean(rec.residuals[0] ** 2):.2f}", "1.25",
        "Facets", "facet tilt (deg)", "Steps", "The fit took 2 levels from mask bands",
        "Convergence", "What was assumed", "assumed: 2 levels from mask bands", "gains are right within 2.0 %",
        "How it was made", "helio-jax 0.1.0", "seed 7",
        "10 atoms launched = 3 detected + 7 escaped + 0 stopped + 0 lost", "How to cite", "arXiv:2501.14833",
        f"{100 * scores.recovered_height:.1f}", f"{100 * scores.rms_image:.2f}",
        "Contours every 100 µm",
    ):  # fmt: skip
        assert word in page.words, word
    figures = json.loads(page.figures)
    places = [a["id"] for tag, a in page.tags if tag == "div" and a.get("id", "").startswith("figure-")]
    assert places == list(figures) and len(places) == 3 + 3 + 2 + 1 + 2 + 1 + 1 + 1 + 4 + 1
    assert all(f["data"] for f in figures.values())


def test_every_picture_has_an_alternative_text(tmp_path):
    """Catches a picture that says nothing to those who cannot see it, or the same as its neighbour."""
    stack, rec, truth = full_case()
    page, _ = report(tmp_path, stack, rec, truth)
    texts = [a.get("aria-label", "") for tag, a in page.tags if tag == "figure"]
    texts += [a.get("alt", "") for tag, a in page.tags if tag == "img"]
    assert all(len(text) > 20 for text in texts) and len(set(texts)) == len(texts) == 20
    assert any("highest valid point at X" in text for text in texts)


@pytest.mark.parametrize("size", [(41, 45, 80.0), (401, 400, 9.0)])
def test_maps_hold_the_values_of_the_file(tmp_path, size):
    """Every value under the cursor is that of the file at the shown beam position, also where maps are thinned.

    Catches averaged or shifted pixels, exchanged axes, rounding beyond float32."""
    nx, ny, pitch = size
    stack, rec, _ = full_case(nx, ny, pitch=pitch)
    height = rec.height + np.random.default_rng(1).normal(0.0, 1.0, rec.height.shape)
    page, _ = report(tmp_path, stack, rec.replace(height=height))
    figures = {f["layout"]["title"]["text"]: f["data"][0] for f in json.loads(page.figures).values()}
    for title, image in (
        ("height", height),
        ("standard deviation", rec.height_std),
        ("micrograph D2", stack.counts[1]),
        ("residuals D3", rec.residuals[2]),
        ("chi-square, traced", rec.chi_square),
    ):
        trace = figures[title]
        at_x, at_y, shown = (decoded(trace[key]) for key in "xyz")
        columns, rows = (
            np.abs(a[:, None] - b[None]).argmin(0) for a, b in ((rec.raster_x, at_x), (rec.raster_y, at_y))
        )
        assert np.abs(rec.raster_x[columns] - at_x).max() < 0.01 and np.abs(rec.raster_y[rows] - at_y).max() < 0.01
        assert np.abs(shown - image[np.ix_(rows, columns)]).max() <= 1e-6 * np.abs(image).max()
        assert title != "height" or nx * ny > 130_000 or shown.shape == height.shape
    reasons = figures["validity"]["text"]
    assert reasons[0][0] == "valid" and any("masked in too many detectors" in row for row in reasons)


def test_highest_valid_point_is_marked_and_invalid_ones_are_covered(tmp_path):
    """Catches a mark at the highest pixel of all, a cover over the valid ones, contours of invalid heights."""
    _, rec, _ = full_case()
    height = rec.height.copy()
    height[2, 3] = 9000.0
    is_valid = rec.is_valid.copy()
    is_valid[2, 3] = False
    rec = rec.replace(height=height, is_valid=is_valid, reason=np.where(is_valid, 0, 3))
    page, _ = report(tmp_path, None, rec)
    image, cover, contours, mark = next(
        f["data"] for f in json.loads(page.figures).values() if f["layout"]["title"]["text"] == "height"
    )
    row, column = np.unravel_index(np.argmax(np.where(is_valid, height, -1)), height.shape)
    assert (mark["x"][0], mark["y"][0]) == pytest.approx((rec.raster_x[column], rec.raster_y[row]))
    assert np.array_equal(decoded(cover["z"]) == 1, ~is_valid) and cover["hoverinfo"] == "skip"
    assert image["zmax"] < 700 and decoded(contours["x"]).size > 50


def test_text_from_files_is_escaped(tmp_path):
    """A provenance and a detector name with tags stay text. Catches: a script smuggled in by a data file."""
    stack, rec, _ = make_case()
    evil = "<img src=x onerror=alert(1)>"
    detectors = tuple(d.model_copy(update={"name": f"{evil}{k}"}) for k, d in enumerate(stack.instrument.detector))
    instrument = stack.instrument.model_copy(update={"detector": detectors})
    history = {"assumed": evil, "stack": {"command": [evil], "versions": {evil: evil}, "source": {"file": evil}}}
    history["instrument"] = {"weak": [{"share": 0.9, "of": {evil: 1.0}}], "values": {evil: [0.0, 1.0, 1.0, evil]}}
    history["sensitivity"] = {evil: 2.0}
    stack, rec = stack.replace(instrument=instrument, name=evil, unit=evil), rec.replace(instrument=instrument)
    rec = rec.replace(status=evil, warnings=(evil,), provenance=history)
    page, text = report(tmp_path, stack, rec, title=evil)
    assert [tag for tag, _ in page.tags].count("script") == 3
    assert [tag for tag, _ in page.tags].count("img") == 1  # the drawing of the instrument
    assert evil not in text
    assert evil not in json.dumps(json.loads(page.figures))  # plotly reads a few tags in its titles


@pytest.mark.parametrize(
    "history", [{"stack": 3, "rays": 1}, {"instrument": {"weak": "x"}, "height_changes_um": ["a"]}]
)
def test_a_strange_history_is_left_out(tmp_path, history):
    """What a file states of its history is not trusted to be a table. Catches a report that ends in a bug."""
    _, rec, _ = full_case(21, 21, pitch=160.0)
    page, _ = report(tmp_path, None, rec.replace(provenance=history))
    assert "nothing converges" in page.words


@pytest.mark.parametrize("n_detectors", [1, 6])
def test_any_number_of_detectors_and_missing_data(tmp_path, n_detectors):
    """Catches: NaN written as bare NaN into the JSON, a report that needs a truth, scores, or a stack."""
    stack, rec, _ = make_case(31, 25, n_detectors, pitch=110.0)
    height = rec.height.copy()
    height[5:9, 7:12] = np.nan
    counts = stack.counts.copy()
    counts[0, 0] = np.nan
    for given in (stack.replace(counts=counts), None):
        page, _ = report(tmp_path, given, rec.replace(height=height, residuals=None))
        json.loads(page.figures, parse_constant=lambda c: pytest.fail(f"{c} is no JSON"))
        assert "of the pixels: a height is valid if" in page.words


@pytest.mark.parametrize("shape", [(10, 10), (2, 2), (1, 9), (60, 3)])
def test_small_rasters(tmp_path, shape):
    """Catches contours, surfaces or profiles that need more pixels than there are."""
    stack, rec, _ = make_case(*shape, pitch=300.0)
    page, _ = report(tmp_path, stack, rec)
    assert "Surface" in page.words


def test_what_cannot_be_shown_is_left_out_with_its_reason(tmp_path):
    """Catches an empty picture, and a section that vanishes without a word."""
    _, rec, _ = full_case(21, 21, pitch=160.0)
    nothing = np.zeros(rec.height.shape, bool)
    rec = rec.replace(
        method="linear", height_std=None, chi_square=None, is_valid=nothing, reason=np.full(nothing.shape, 2),
        provenance={},
    )  # fmt: skip
    page, _ = report(tmp_path, None, rec)
    for words in (
        "is not to be trusted: no height is valid; main reason: masked in too many detectors (100.0 % of the pixels)",
        "Micrographs Left out: they were not given", "Profiles Left out: no height is valid.",
        "Uncertainty Left out: the method gave no error bars.", "nothing is left to check", "not tested",
        "Facets Left out", "Steps Left out", "Convergence Left out",
    ):  # fmt: skip
        assert words in page.words, words


@pytest.mark.parametrize("n_detectors", [3, 6])
def test_size_at_the_reference_raster(tmp_path, n_detectors):
    """351 x 304 pixels stay under 8 MB (plotly.js is 4.8). Catches: undecimated surface, floats as text."""
    stack, rec, truth = full_case(351, 304, n_detectors, pitch=11.0)
    stack = stack.replace(counts=stack.counts + 0.37)
    report(tmp_path, stack, rec, truth, evaluate_height(rec, truth))
    assert (tmp_path / "r.html").stat().st_size < MAX_BYTES


def test_surface_is_drawn_at_its_own_positions():
    """The apex is at x = 0 (not at H tan t = 416 um), in metres of the sample; no triangle spans the occlusion gap.
    Catches: raster positions in 3-D, a curtain over jumps, wrong vertex numbers after thinning."""
    stack, rec, truth = make_case(304, 351, pitch=11.0)
    found = next(s for s in sections(stack, rec, truth, None) if s.title == "Surface")
    mesh = found.pictures[0].figure["data"][0]
    x, y, z = (mesh[k] for k in "xyz")
    top = np.argmax(z)
    assert np.hypot(x[top], y[top]) < 45.0 and z[top] == pytest.approx(720.0, abs=1.0)
    faces = np.stack([mesh[k] for k in "ijk"])
    assert faces.min() == 0 and faces.max() == x.size - 1 and np.unique(faces).size == x.size
    step = 11.0 * np.ceil(np.sqrt(304 * 351 / x.size) - 0.5)
    edges = np.hypot(x[faces] - x[np.roll(faces, 1, 0)], y[faces] - y[np.roll(faces, 1, 0)])
    assert edges.max() < 6.0 * 3 * step
    middle = np.abs(y[faces].mean(0)) < 100.0
    across = (x[faces].min(0) < 870.0) & (x[faces].max(0) > 985.0)
    assert not (middle & across).any()


def test_refusals_and_atomic_write(tmp_path, monkeypatch):
    """Catches: a half-written report, HTML in a .png."""
    stack, rec, _ = make_case(21, 21, pitch=150.0)
    with pytest.raises(SceneError, match=r"r.png: a report is HTML: give it the suffix .html, got '.png'"):
        write_report(tmp_path / "r.png", stack, rec)
    monkeypatch.setattr("helio_jax.formats.safe.os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(SceneError, match="disk full"):
        write_report(tmp_path / "r.html", stack, rec)
    assert list(tmp_path.iterdir()) == []
