"""The report in a real browser: no error, no request, the value under the cursor, light and dark, phone width.

Skipped where there is no Chromium (HELIO_CHROMIUM names one).
"""

import re

import numpy as np
import pytest
from chromium import Chromium, find_chromium
from sphere_case import make_case

from helio_jax.figures.report import write_report

PROGRAM = find_chromium()
pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no Chromium on the PATH: set HELIO_CHROMIUM")
DRAW_ALL = """new Promise(async done => {
  for (let y = 0; y < document.body.scrollHeight; y += 400) {
    window.scrollTo(0, y); await new Promise(next => setTimeout(next, 60));
  }
  const figures = [...document.querySelectorAll('figure > div')];
  while (!figures.every(f => f.querySelector('.main-svg'))) await new Promise(next => setTimeout(next, 100));
  window.scrollTo(0, 0); done(figures.length);
})"""


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """A reconstruction with rough heights, and its report."""
    stack, rec, truth = make_case(41, 45, pitch=80.0)
    noise = np.random.default_rng(2).normal(0.0, 5.0, rec.height.shape)
    rec = rec.replace(height=rec.height + noise, height_std=np.full(rec.height.shape, 4.0), chi_square=1 + 0 * noise)
    rec = rec.replace(provenance={"height_changes_um": [5.0, 0.5]})
    return rec, write_report(tmp_path_factory.mktemp("report") / "r.html", stack, rec, truth)


@pytest.fixture
def browser():
    found = Chromium(PROGRAM)
    yield found
    found.close()


def resize(browser, width, scheme="light"):
    phone = width < 600
    browser.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=phone)
    browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (360, "light")])
def test_all_figures_are_drawn_without_errors_or_requests(browser, case, width, scheme):
    """Catches a figure that plotly refuses, a font or script from elsewhere, a page wider than a phone, dark text on a
    dark page."""
    resize(browser, width, scheme)
    browser.open(case[1].as_uri())
    assert browser.run(DRAW_ALL) == 19
    assert browser.faults() == []
    assert browser.requests() == [case[1].as_uri()]
    assert browser.run("document.documentElement.scrollWidth") <= width
    background = browser.run("getComputedStyle(document.body).backgroundColor")
    title = browser.run("getComputedStyle(document.querySelector('#figure-0 .gtitle')).fill")
    page, text = (sum(map(int, re.findall(r"\d+", c)[:3])) for c in (background, title))
    assert page < 100 < 600 < text if scheme == "dark" else text < 100 < 600 < page


@pytest.mark.parametrize(("row", "column"), [(22, 25), (3, 7), (40, 30)])
def test_cursor_reads_the_value_of_the_file(browser, case, row, column):
    """The mouse over a pixel of the height map shows its beam position and its height. Catches a map that is mirrored,
    shifted by half a pixel or drawn from other data, and a cover that hides the value."""
    rec, path = case
    resize(browser, 1280)
    browser.open(path.as_uri())
    browser.run(DRAW_ALL)
    place = browser.run(
        f"""(async () => {{
          const plot = [...document.querySelectorAll('figure > div')].find(f => f.layout.title.text == 'height');
          plot.scrollIntoView({{block: 'center'}}); await new Promise(next => setTimeout(next, 300));
          const box = plot.getBoundingClientRect(), {{xaxis, yaxis}} = plot._fullLayout;
          return [plot.id, box.x + xaxis._offset + xaxis.d2p({rec.raster_x[column]}),
                  box.y + yaxis._offset + yaxis.d2p({rec.raster_y[row]})];
        }})()"""
    )
    browser.move_mouse(place[1] - 3, place[2] - 3)
    browser.move_mouse(place[1], place[2])
    wait = "new Promise(next => setTimeout(next, 400))"
    shown = browser.run(f"{wait}.then(() => document.querySelector('#{place[0]} .hoverlayer').textContent)")
    x, y, z = map(float, re.findall(r"-?\d+(?:\.\d+)?", shown.replace("−", "-")))
    assert (x, y) == pytest.approx((rec.raster_x[column], rec.raster_y[row]), abs=0.06)
    assert z == pytest.approx(rec.height[row, column], rel=1e-4)
