"""The HTML report: one file, opens offline, holds the numbers, escapes what comes from files."""

import json
from html.parser import HTMLParser

import numpy as np
import pytest
from sphere_case import make_case

from helio_jax.errors import InputFileError, SceneError
from helio_jax.figures.interactive import report_groups
from helio_jax.figures.report import write_report
from helio_jax.scores.metrics import evaluate_height

PNG = b"\x89PNG\r\n\x1a\n fake"
VOID = {"meta", "img", "br", "link", "hr", "input"}


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


def report(tmp_path, *args, **more):
    path = write_report(tmp_path / "r.html", *args, **more)
    text = path.read_text(encoding="utf-8")
    return Page(text), text


def test_report_is_complete_and_offline(tmp_path):
    """Catches: an external script, picture or font; an upload button; plotly.js twice; a section or a number left
    out."""
    stack, rec, truth = make_case()
    rec = rec.replace(height=0.9 * truth.height, height_std=np.full_like(rec.height, 4.0))
    scores = evaluate_height(rec, truth)
    page, text = report(tmp_path, stack, rec, truth, scores, panel_png=PNG, title="Sphere <A>")
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "object", "embed", "base", "a"), tag
        for name in ("src", "href", "srcset", "data", "poster"):
            assert attributes.get(name, "data:").startswith("data:"), (tag, attributes)
    assert "plotlyServerURL: ''" in text and "modeBarButtonsToRemove: ['sendChartToCloud'" in text  # no upload button
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style and "@import" not in style
    assert text.count("* plotly.js v") == 1
    words = " ".join(page.text)
    for word in (
        "Sphere <A>", "Numbers", "Micrographs", "Multiple scattering", "Height", "Surface", "Profiles", "Validity",
        "Panel", "Provenance", "How to cite", "arXiv:2501.14833", "converged",
        f"{100 * scores.recovered_height:.1f}", f"{100 * scores.rms_image:.2f}", '"seed": 7',
    ):  # fmt: skip
        assert word in words, word
    figures = json.loads(page.figures)
    places = [a["id"] for tag, a in page.tags if tag == "div" and a.get("id", "").startswith("figure-")]
    assert places == list(figures) and len(places) == 3 + 3 + 3 + 1 + 2 + 3
    assert all(f["data"] for f in figures.values())


def test_text_from_files_is_escaped(tmp_path):
    """A provenance and a detector name with tags stay text. Catches: a script smuggled in by a data file."""
    stack, rec, _ = make_case()
    evil = "<img src=x onerror=alert(1)>"
    detectors = tuple(d.model_copy(update={"name": f"{evil}{k}"}) for k, d in enumerate(stack.instrument.detector))
    instrument = stack.instrument.model_copy(update={"detector": detectors})
    stack, rec = stack.replace(instrument=instrument, name=evil, unit=evil), rec.replace(instrument=instrument)
    page, text = report(tmp_path, stack, rec.replace(status=evil), title=evil)
    assert [tag for tag, _ in page.tags].count("script") == 3 and "img" not in [tag for tag, _ in page.tags]
    assert evil not in text
    assert evil not in json.dumps(json.loads(page.figures))  # plotly reads a few tags in its titles


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
        assert "valid pixels" in page.text


@pytest.mark.parametrize("n_detectors", [3, 6])
def test_size_at_the_reference_raster(tmp_path, n_detectors):
    """351 x 304 pixels stay under 15 MB (plotly.js is 4.8). Catches: undecimated surface, floats as text."""
    stack, rec, truth = make_case(304, 351, n_detectors, pitch=11.0)
    rec = rec.replace(height_std=np.full_like(rec.height, 4.0))
    stack = stack.replace(counts=stack.counts + 0.37)
    report(tmp_path, stack, rec, truth, evaluate_height(rec, truth), panel_png=PNG + bytes(1_000_000))
    assert (tmp_path / "r.html").stat().st_size < 15e6


def test_surface_is_drawn_at_its_own_positions():
    """The apex is at x = 0 (not at H tan t = 416 um), in metres of the sample; no triangle spans the occlusion gap.
    Catches: raster positions in 3-D, a curtain over jumps, wrong vertex numbers after thinning."""
    stack, rec, truth = make_case(304, 351, pitch=11.0)
    groups = {g.title: g for g in report_groups(stack, rec, truth)}
    mesh = groups["Surface"].figures[0]["data"][0]
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
    """Catches: a half-written report, an embedded file that is not a PNG, HTML in a .png."""
    stack, rec, _ = make_case(21, 21, pitch=150.0)
    with pytest.raises(SceneError, match=r"r.png: a report is HTML: give it the suffix .html, got '.png'"):
        write_report(tmp_path / "r.png", stack, rec)
    with pytest.raises(InputFileError, match="must be a PNG"):
        write_report(tmp_path / "r.html", stack, rec, panel_png=b"<svg>")
    with pytest.raises(InputFileError, match="cannot be read"):
        write_report(tmp_path / "r.html", stack, rec, panel_png=tmp_path / "none.png")
    monkeypatch.setattr("helio_jax.formats.safe.os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(SceneError, match="disk full"):
        write_report(tmp_path / "r.html", stack, rec)
    assert list(tmp_path.iterdir()) == []
