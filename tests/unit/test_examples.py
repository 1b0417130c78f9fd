"""Every public name has an example in its help, and the examples run."""

import doctest
from typing import Any

import jax
import numpy as np
import pytest

import helio_jax as hx

NAMES = sorted(set(hx.__all__) - {"__version__"})
LONG = {"add_positions", "design", "next_scan", "plan", "plan_windows", "reconstruct_scans", "run"}
LONG |= {"measure_step_height", "measure_texture"}
"""Their examples compile, but take long, or need measured files or larger maps; other tests call these."""


def examples(name: str) -> list[str]:
    """Return the lines of code in the help of a public name."""
    found = doctest.DocTestParser().get_examples(getattr(hx, name).__doc__ or "")
    return [example.source for example in found]


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> dict[str, Any]:
    """What the examples take as given, small, and the files that they read."""
    tiny = {"scan.nx": 11, "scan.ny": 11, "scan.pixel_size_um": 330.0, "trace.rays": 8}
    scene = hx.load_scene("sphere_a", tiny)
    stack = hx.simulate(scene).replace(dwell=0.1)
    rec = hx.reconstruct(stack, "nearfield")
    folder = tmp_path_factory.mktemp("examples")
    hx.write(rec, folder / "height.h5")
    hx.export(stack, folder / "scan.mat")
    images = np.zeros((3, 3, 11, 11)), np.zeros((3, 11, 11))
    return {
        "folder": folder,
        "hx": hx,
        "np": np,
        "jax": jax,
        "scene": scene,
        "stack": stack,
        "rec": rec,
        "height": rec.height,
        "counts": stack.counts,
        "x": stack.x,
        "y": stack.y,
        "masked": images[0],
        "multiple": images[1],
        "optics": hx.Optics.of(stack.instrument),
        "raster": hx.Raster.of(stack),
        "instrument": stack.instrument,
    }


@pytest.mark.parametrize("name", NAMES)
def test_example(name, known, monkeypatch):
    """Catches a public name without an example, and an example that the program has left behind."""
    monkeypatch.chdir(known["folder"])
    names, lines = dict(known), examples(name)
    assert lines, f"hx.{name}: add an example to its docstring"
    for line in lines:
        code = compile(line, f"example of {name}", "single")
        if name not in LONG:
            exec(code, names)
