"""What the mutation test found beyond the 2000 mutations of the default run: each case once, by hand."""

import struct

import h5py
import numpy as np
import pytest

from helio_jax.errors import InputFileError
from helio_jax.figures.report import write_report
from helio_jax.formats.hdf5 import read, write
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.reconstruction import Reconstruction
from helio_jax.validity import NONE_VALID
from helio_jax.workflows.file_info import file_info
from helio_jax.workflows.show import show

DIRECTORY = b"PK\x01\x02"
"""Begins the record of each member in a zip file's directory."""


@pytest.mark.parametrize(
    ("place", "word", "told"),
    [(6, 109, "zip file version 10.9"), (46, 0xFFFF, "utf-8")],
    ids=["version", "name"],
)
def test_directory_of_an_npz(place, word, told, tmp_path):
    """A later version of zip, and a name that is no UTF-8 (flag 0x800), are our error.

    Catches a reader that expects `BadZipFile` alone: `zipfile` raises NotImplementedError and UnicodeDecodeError, too.
    """
    path = tmp_path / "a.npz"
    np.savez(path, height=np.zeros(3))
    data = bytearray(path.read_bytes())
    at = data.index(DIRECTORY)
    data[at + 8 : at + 10] = struct.pack("<H", 0x800)
    data[at + place : at + place + 2] = struct.pack("<H", word)
    path.write_bytes(data)
    with pytest.raises(InputFileError, match=f"a.npz: is not a readable .npz file: .*{told}"):
        file_info(path)


def test_a_height_that_is_not_finite_is_not_valid(tmp_path):
    """A file that says "valid" of pixels without a height: they are not, and info, show and report say what remains.

    Catches a mask that is believed: the smallest of no heights ended `helio info` with a traceback.
    """
    axis = 10.0 * np.arange(6.0)
    instrument = Instrument(
        plate=Plate(working_distance_um=3000.0), detector=(Detector(name="a", polar_deg=30.0, half_angle_deg=9.0),)
    )
    flat = np.zeros((6, 6))
    rec = Reconstruction(
        height=flat, raster_x=axis, raster_y=axis, instrument=instrument, method="linear", albedo=flat + 1.0,
        normals=np.tile([0.0, 0.0, 1.0], (6, 6, 1)), is_valid=flat == 0, reason=np.zeros((6, 6)),
    )  # fmt: skip
    path = tmp_path / "height.h5"
    write(rec, path)
    for known, share in ((slice(2), 1 / 3), (slice(0), 0.0)):
        with h5py.File(path, "r+") as file:
            height = np.full((6, 6), np.nan)
            height[known] = 0.0
            del file["entry/height/height"]
            file["entry/height/height"] = height
        found = read(path)
        assert isinstance(found, Reconstruction) and found.valid_share == pytest.approx(share)
        assert (NONE_VALID in found.warnings) == (share == 0.0)
        assert f"{share:.1%}" in dict(file_info(path).rows)["valid"].replace(" %", "%")
    show(found, tmp_path / "none.png")
    write_report(tmp_path / "none.html", None, found)
