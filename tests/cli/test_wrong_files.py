"""Files of the wrong kind and names of the wrong suffix: the documented exit code, at once, and nothing written."""

import numpy as np
import pytest
from typer.testing import CliRunner

from helio_jax import MicrographSet, MicrographStack, Reconstruction, write
from helio_jax.commands.app import app
from helio_jax.errors import InputFileError
from helio_jax.instrument import Detector, Instrument, Plate


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with a stack, a set of two, a height map and a scene."""
    import helio_jax.__main__  # noqa: F401 (registers the commands)

    folder = tmp_path_factory.mktemp("files")
    detector = Detector(name="a", polar_deg=40.0, half_angle_deg=10.0)
    instrument = Instrument(plate=Plate(working_distance_um=3000.0), detector=(detector,))
    axis = np.arange(4) * 10.0
    stack = MicrographStack(np.ones((1, 4, 4)), axis, axis, instrument)
    write(stack, folder / "stack.h5")
    write(MicrographSet((stack, stack)), folder / "set.h5")
    normals = np.tile([0.0, 0.0, 1.0], (4, 4, 1))
    rec = Reconstruction(
        height=np.zeros((4, 4)), raster_x=axis, raster_y=axis, instrument=instrument, method="linear",
        normals=normals, albedo=np.ones((4, 4)), is_valid=np.ones((4, 4), bool), reason=np.zeros((4, 4), int),
        status="made up",
    )  # fmt: skip
    write(rec, folder / "height.h5")
    return folder


@pytest.mark.parametrize(
    ("command", "needed"),
    [
        ("report stack.h5 -o r.html", "height map"),
        ("report height.h5 -o r.html --stack height.h5", "micrographs"),
        ("report height.h5 -o r.html --stack set.h5", "one stack"),
        ("evaluate stack.h5 --truth height.h5", "height map"),
        ("reconstruct height.h5 -o out.h5", "micrographs"),
        ("calibrate height.h5 -o out.h5", "micrographs"),
        ("measure stack.h5 --roughness", "height map"),
        ("align height.h5 -o out.h5 --auto", "micrographs"),
    ],
)
def test_wrong_kind_of_file(files, command, needed):
    """A helio file of another kind is an InputFileError (exit 3) that says what is needed; it was a traceback."""
    before = sorted(files.iterdir())
    words = [str(files / w) if w.endswith((".h5", ".html")) else w for w in command.split()]
    found = CliRunner().invoke(app, words)
    assert isinstance(found.exception, InputFileError) and needed in str(found.exception), found
    assert sorted(files.iterdir()) == before


@pytest.mark.parametrize("command", ["reconstruct stack.h5", "calibrate stack.h5", "import x.mat", "simulate s.toml"])
def test_wrong_suffix(files, command):
    """HDF5 under another suffix is refused while the command line is read (exit 2), not after an hour of tracing."""
    words = [str(files / w) if "." in w else w for w in command.split()]
    found = CliRunner().invoke(app, [*words, "-o", str(files / "out.png")])
    assert found.exit_code == 2 and ".h5" in found.output, found.output
    assert not (files / "out.png").exists()
