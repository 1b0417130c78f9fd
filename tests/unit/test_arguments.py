"""Arguments of a wrong type end in an error that names what makes the right one."""

import inspect
import re
from pathlib import Path

import numpy as np
import pytest

import helio_jax as hx
from helio_jax.arguments import checked, expect
from helio_jax.errors import HelioError, WrongType
from helio_jax.workflows.scene_file import SceneFile


@pytest.fixture(scope="module")
def scene() -> SceneFile:
    return hx.load_scene("sphere_a", {"scan.nx": 9, "scan.ny": 9, "scan.pixel_size_um": 400.0, "trace.rays": 8})


@pytest.fixture(scope="module")
def stack(scene):
    return hx.simulate(scene)


AXIS, FLAT = np.arange(9.0), np.zeros((9, 9))
RECORD = "a MicrographStack or MicrographSet"
WRONG = {
    f"reconstruct: stack must be {RECORD}, got a ndarray: hx.simulate": lambda scene, stack: hx.reconstruct(FLAT),
    "simulate: scene must be a SceneFile, got a str 'sphere_a': hx.load": lambda scene, stack: hx.simulate("sphere_a"),
    "evaluate: rec must be a Reconstruction, got a SceneFile: hx.recon": lambda scene, stack: hx.evaluate(scene, scene),
    "true_height: rec must be a Reconstruction, got None": lambda scene, stack: hx.true_height(scene, None),
    "import_micrographs: path must be a name of a file, got a list": lambda scene, stack: hx.import_micrographs(["a"]),
    "import_micrographs: instrument must be an Instrument, got a str 'bshem': hx.load_instrument": (
        lambda scene, stack: hx.import_micrographs("a.mat", "bshem")
    ),
    "MicrographStack: instrument must be an Instrument, got a str 'bshem'": (
        lambda scene, stack: hx.MicrographStack(stack.counts, AXIS, AXIS, "bshem")
    ),
    "read: path must be a name of a file, got a MicrographStack": lambda scene, stack: hx.read(stack),
    "load_scene: path must be a name of a file, got a dict": lambda scene, stack: hx.load_scene({"sample": {}}),
    "load_instrument: path must be a name of a file, got an int 3": lambda scene, stack: hx.load_instrument(3),
    "render: optics must be an Optics, got an Instrument: hx.Optics.of": (
        lambda scene, stack: hx.render(FLAT, stack.instrument, stack)
    ),
    "render: raster must be a Raster, got a MicrographStack: hx.Raster.of": (
        lambda scene, stack: hx.render(FLAT, hx.Optics.of(stack.instrument), stack)
    ),
    "measure_texture: heights must be a Reconstruction or HeightMap, got a": lambda _, stack: hx.measure_texture(stack),
    "find_steps: stack must be a MicrographStack, got a SceneFile": lambda scene, stack: hx.find_steps(scene),
    "plan: scene must be a SceneFile, got a str 'sphere_a'": lambda scene, stack: hx.plan("sphere_a"),
    "design: scene must be a SceneFile, got a MicrographStack": lambda scene, stack: hx.design(scene=stack),
    "fisher: optics must be an Optics": lambda scene, stack: hx.fisher(FLAT, stack.instrument, None, 1.0),
}


@pytest.mark.parametrize("said", WRONG)
def test_the_error_names_argument_type_and_remedy(scene, stack, said):
    """A HelioError that is a TypeError, too. Catches an AttributeError from deep inside."""
    with pytest.raises(WrongType, match=re.escape(said)) as e:
        WRONG[said](scene, stack)
    assert isinstance(e.value, TypeError) and isinstance(e.value, HelioError)


def test_what_is_right_passes(stack):
    """Positional, by name, None where it may be, paths; signature and help stay. Catches a check of other arguments."""

    @checked
    def function(path: str | Path, instrument: hx.Instrument | None = None, *, count: int = 1) -> int:
        """Help."""
        return count

    assert function("a") == function(Path("a"), stack.instrument) == function(path="a", instrument=None, count=1) == 1
    assert list(inspect.signature(function).parameters) == ["path", "instrument", "count"]
    assert function.__doc__ == "Help."
    assert "stack" in inspect.signature(hx.reconstruct).parameters
    expect("x", 1, int)
