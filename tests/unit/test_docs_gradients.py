"""The Python blocks of docs/gradients.md run in order and recover what the page states; rasters are small."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "gradients.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
SMALL = {
    "hx.Raster.regular((21, 21), 60.0)": "hx.Raster.regular((13, 13), 94.0)",
    "hx.Raster.regular((41, 41), 30.0)": "hx.Raster.regular((21, 21), 60.0)",
}
"""The same fields of view on fewer pixels."""


def test_page_runs():
    """Catches a renamed argument, a model that is not differentiable, a wrong sign or unit of the sensitivity.

    The page asserts that the derivative agrees with a difference, that the fit recovers the true values within three
    standard errors, and that a second fit confirms the sensitivity. Here: the sensitivity is height / distance, to
    10 % (the page's reason is of first order), and each plan lists the parameters of all of its detectors.
    """
    names: dict = {}
    for number, block in enumerate(BLOCKS):
        code = block
        for text, smaller in SMALL.items():
            code = code.replace(text, smaller)
        exec(compile(code, f"docs/gradients.md, block {number}", "exec"), names)
    assert names["raster"].shape == (21, 21) and names["coarse"].shape == (13, 13)
    assert names["probability"].shape == (3, 21, 21) and names["by_height"].shape == (21, 21)
    assert names["series"].shape == (5, 3, 21, 21) and np.all(np.diff(names["series"].mean(axis=(1, 2, 3))) < 0.0)
    assert names["sensitivity"][0] == pytest.approx(60.0 / 4000.0, rel=0.1)
    for n, plan in names["plans"].items():
        assert f"polar {n - 1}" in plan.parameters and f"polar {n}" not in plan.parameters


def test_notebook_has_the_same_code():
    """Only the rasters differ. Catches a page and a notebook that drift apart."""
    book = json.loads((ROOT / "notebooks" / "gradients.ipynb").read_text(encoding="utf-8"))
    cells = ["".join(cell["source"]) for cell in book["cells"] if cell["cell_type"] == "code"]

    def lines(blocks: list[str]) -> list[str]:
        own = r"Raster\.regular|n_pixels|^import os$|^$"
        return [line for block in blocks for line in block.splitlines() if not re.search(own, line)]

    assert lines(BLOCKS) == lines(cells)
